"""Simulated people answer as they should, and a simulated study is a study."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hilbo.errors import InputError
from hilbo.simulation import simulate
from hilbo.simulation.folder import simulate_folder
from hilbo.simulation.presets import PRESETS
from hilbo.simulation.simulate import Person
from hilbo.study.config import Study
from hilbo.study.folder import read_folder

STUDY = Study.load("hilbo/data/paper.toml")


def person(**changes):
    plain = {"noise": 0.0, "lapse": 0.0, "drift": 0.0}
    values = {name: jnp.asarray(changes.get(name, value)) for name, value in plain.items()}
    return Person(jnp.array([0.5, 0.5]), jnp.array([0.1, 0.2]), jnp.array([2.0, 1.0]), **values)


def answers(who, x, count=2000, progress=0.0):
    keys = jax.random.split(jax.random.key(1), count)
    return jax.vmap(lambda key: who.answer(key, jnp.asarray(x), jnp.asarray(progress)))(keys)


@pytest.mark.parametrize(("x", "category"), [([0.5, 0.5], 2), ([0.59, 0.5], 2), ([0.5, 0.85], 1), ([0.8, 0.5], 0)])
def test_without_noise_the_criteria_decide(x, category):
    assert jnp.all(answers(person(), x) == category)


def test_noise_and_lapses_have_their_probabilities():
    at_criterion = answers(person(noise=0.5), [0.6, 0.5])
    assert abs(float(jnp.mean(at_criterion == 2)) - 0.5) < 0.04
    lapsing = answers(person(lapse=0.3), [0.5, 0.5])
    assert abs(float(jnp.mean(lapsing != 2)) - 0.2) < 0.04  # a guess is right one time in three


def test_drift_makes_people_stricter_in_time():
    assert jnp.all(answers(person(drift=0.8), [0.55, 0.5], progress=0.0) == 2)
    assert jnp.all(answers(person(drift=0.8), [0.55, 0.5], progress=1.0) == 1)


@pytest.mark.deep  # as `make demo` does
def test_the_preset_makes_a_study():
    population = PRESETS["paper"]
    people = simulate.people(STUDY, population, 3, seed=1)
    trials = simulate.simulate_study(STUDY, people, seed=1)
    assert trials.mask.shape == (3, 25)
    assert bool(jnp.all(trials.mask))
    assert bool(jnp.all(STUDY.space.feasible(trials.x)))
    again = simulate.simulate_study(STUDY, people, seed=1)
    np.testing.assert_array_equal(again.x, trials.x)
    table = simulate.to_table(STUDY, trials)
    assert table["participant"].unique().tolist() == ["P01", "P02", "P03"]
    assert table["trial"].tolist() == [*range(1, 26)] * 3


def test_a_population_of_another_study_is_refused():
    five = Study.load("hilbo/data/video_quality.toml")
    with pytest.raises(InputError, match="2 criteria"):
        simulate.people(five, PRESETS["paper"], 2, 0)


def test_each_material_is_simulated(tmp_path):
    study = tmp_path / "s.toml"
    study.write_text("""
schema = 1
[study]
name = "two"
responses = ["no", "yes"]
[parameters]
u = {low = 0.0, high = 1.0}
[selection]
trials = 3
space_filling = 3
[aggregation]
rule = "learnt-2"
[materials.gel]
[materials.foam.parameters.u]
high = 5.0
""")
    (tmp_path / "out").mkdir()
    gel, foam = simulate_folder(tmp_path / "out", None, 2, 0, study)
    folder = read_folder(tmp_path / "out")
    assert [material.name for material in folder.materials] == [gel.material, foam.material] == ["gel", "foam"]
    for simulated, material in zip((gel, foam), folder.materials, strict=True):
        assert material.cohort.names == ("P01", "P02") and material.study.space == simulated.study.space
        np.testing.assert_allclose(material.cohort.trials.x, simulated.cohort.trials.x, atol=1e-9)
    assert gel.population.truth != foam.population.truth
