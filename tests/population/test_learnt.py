"""learnt-2 and learnt-1: a maximum by another way of computing it; what is stated stays, what is not learnt is said."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hilbo import RBF, OrdinalGP, OrdinalProbit, Trials
from hilbo.errors import InputError
from hilbo.kernels import Matern32
from hilbo.population.learnt import rule, search
from hilbo.population.learnt.posterior import KERNELS, NOTHING, Stated, medians, model_at, prior_model
from hilbo.population.learnt.rule import drawn_maps, learn, learnt_function
from hilbo.population.learnt.search import first_search, searched
from hilbo.population.rules.recipes import LEARNT_1, LEARNT_2
from hilbo.population.shared.hierarchical import fit_people, of_people, shared_posterior
from hilbo.population.shared.tallies import tallied

PEOPLE, ANSWERS = 4, 12


def answers(seed=0, rule=None):
    """Stacked trials of people who like one place, or answer by a rule of points."""
    rng = np.random.default_rng(seed)
    each = []
    for j in range(PEOPLE):
        x = rng.uniform(size=(ANSWERS, 2))
        felt = np.hypot(*(x - 0.4 - 0.05 * j).T) + 0.1 * rng.normal(size=ANSWERS)
        q = (felt < 0.5).astype(int) + (felt < 0.25) if rule is None else rule(x)
        each.append(Trials.from_arrays(x, q, ANSWERS))
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *each)


@pytest.fixture(scope="module")
def learnt():
    return learn(answers(), 3, recipe=LEARNT_2)


def dense_objective(z, trials, kernel=Matern32, sd=(1.2, 1.2, 2.0, 2.0, 4.0, 2.0)):
    """The log posterior of [log theta (2), log shared, log own, middle, log gap], by the model of all answers at once
    and the priors as docs/methods/which_method_models.md states them; learnt-2's, unless others are given."""
    theta, shared, own = np.exp(z[:2]), np.exp(z[2]), np.exp(z[3])
    half = 0.5 * np.exp(z[5])
    gp = OrdinalGP(kernel(tuple(theta), shared + own), OrdinalProbit((z[4] - half, z[4] + half), 1.0))
    evidence = fit_people(gp, of_people(trials), shared / (shared + own)).log_evidence
    mean = np.array([np.log(12.0), np.log(12.0), np.log(3.0), 0.0, 0.0, np.log(0.8)])
    return float(evidence) - 0.5 * float(np.sum(((z - mean) / np.array(sd)) ** 2))


def at(learnt):
    c = learnt.coordinates
    return np.concatenate([np.atleast_1d(np.asarray(c[k])) for k in ("theta", "shared", "own", "middle", "gaps")])


def assert_maximum(learnt, **dense):
    trials, z = answers(), at(learnt)
    best = dense_objective(z, trials, **dense)
    assert bool(learnt.converged)
    steps = np.concatenate([np.eye(6), -np.eye(6)]) * 0.1
    assert all(dense_objective(z + step, trials, **dense) < best for step in steps)


def test_the_end_is_a_maximum_of_the_dense_posterior(learnt):
    assert isinstance(learnt.model.gp.kernel, Matern32)
    assert_maximum(learnt)


@pytest.mark.deep  # a search of its own
def test_the_end_of_learnt_1_is_a_maximum_of_the_dense_posterior():
    assert_maximum(learn(answers(), 3, recipe=LEARNT_1), kernel=RBF, sd=(1.2, 1.2, 1.0, 1.0, 1.5, 0.7))


def test_the_end_does_not_depend_on_the_start_and_has_the_features_of_its_own_lengths(learnt):
    """From functions that are so smooth that 8 features are all they need."""
    data = tallied(answers(), 3)
    start = medians(data, NOTHING, LEARNT_2.priors, KERNELS[LEARNT_2.kernel])
    begun, problem = first_search(start | {"theta": start["theta"] - 7.0}, data, NOTHING, LEARNT_2)
    end, its_problem = searched(begun, problem, frozenset(start) - {"widths"})
    theta = model_at(end.coordinates, data, NOTHING, KERNELS[LEARNT_2.kernel]).theta
    assert np.all(np.abs(np.log(theta / its_problem.theta)) < 0.35)
    assert its_problem.pivots.used.sum() > problem.pivots.used.sum()
    for name, value in learnt.coordinates.items():
        np.testing.assert_allclose(end.coordinates[name], value, atol=0.02)


def test_curvature_gives_the_standard_deviations(learnt):
    """Of the gap, against the dense posterior along the whole of its conditional curve."""
    trials, z, h = answers(), at(learnt), 0.05
    hessian = np.empty((6, 6))
    unit = h * np.eye(6)
    for i in range(6):
        for j in range(i, 6):
            corners = [dense_objective(z + a * unit[i] + b * unit[j], trials) for a in (1, -1) for b in (1, -1)]
            hessian[i, j] = hessian[j, i] = (corners[0] - corners[1] - corners[2] + corners[3]) / (4 * h * h)
    by_differences = np.sqrt(np.diagonal(np.linalg.inv(-hessian)))
    names = ("theta", "shared", "own", "middle", "gaps")
    said = np.concatenate([np.atleast_1d(np.asarray(learnt.sd[k])) for k in names])
    np.testing.assert_allclose(said, by_differences, rtol=0.05)


def test_drawn_maps_have_the_hyperparameters_of_the_posterior(learnt):
    drawn = drawn_maps(learnt, answers(), NOTHING, 0, 100)
    assert len(drawn) == 100
    log_theta = np.log([np.asarray(each.function.gp.kernel.theta) for each in drawn])
    learnt_theta = np.log(np.asarray(learnt.model.theta))
    standardised = (log_theta - learnt_theta) / np.asarray(learnt.sd["theta"])
    np.testing.assert_allclose(standardised.mean(axis=0), 0.0, atol=0.4)  # 4 standard errors
    np.testing.assert_allclose(standardised.std(axis=0), 1.0, atol=0.3)
    correlation = learnt.covariance[-2, -1] / np.prod(np.asarray(learnt.sd["theta"]))
    np.testing.assert_allclose(np.corrcoef(log_theta.T)[0, 1], correlation, atol=0.4)
    means = np.stack([np.asarray(each.function.predict(np.full((1, 2), 0.5))[0]) for each in drawn[:2]])
    assert means[0] != means[1]


def test_no_functions_are_drawn_where_the_search_ended_at_no_maximum(learnt):
    saddle = eqx.tree_at(lambda each: each.covariance, learnt, learnt.covariance.at[0, 0].multiply(-1.0))
    assert drawn_maps(saddle, answers(), NOTHING, 0, 4) == []


def test_the_map_is_that_of_the_dense_model(learnt):
    trials, model = answers(), learnt.model
    x = jnp.asarray(np.random.default_rng(1).uniform(size=(20, 2)))
    dense = shared_posterior(fit_people(model.gp, of_people(trials), model.share))
    for by_features, by_all in zip(learnt_function(learnt, trials).function.predict(x), dense.predict(x), strict=True):
        np.testing.assert_allclose(by_features, by_all, atol=2e-3)


def test_the_map_without_the_person_who_was_asked_most(learnt):
    """Others have fewer points; nothing that stays depends on the room that the most would take."""
    fewer = jnp.asarray(np.arange(ANSWERS)[None, :] < np.array([12, 11, 9, 8])[:, None])
    everybody = eqx.tree_at(lambda t: t.mask, answers(), fewer)
    rest = eqx.tree_at(lambda t: t.mask, everybody, fewer.at[0].set(False))
    x = jnp.asarray(np.random.default_rng(1).uniform(size=(20, 2)))
    by_map = learnt_function(learnt, rest).function.predict(x)
    dense = shared_posterior(fit_people(learnt.model.gp, of_people(rest), learnt.model.share)).predict(x)
    for by_features, by_all in zip(by_map, dense, strict=True):
        np.testing.assert_allclose(by_features, by_all, atol=2e-3)


def test_before_the_answers_stand_the_medians_and_what_is_stated():
    gp = prior_model(3, 3)
    np.testing.assert_allclose(gp.kernel.theta, 8.0)
    np.testing.assert_allclose(gp.kernel.variance, 4.0)
    np.testing.assert_allclose(gp.likelihood.thresholds, (-0.4, 0.4))
    stated = prior_model(3, 3, Stated(theta=(1.0, 2.0, 3.0), noise=0.5))
    np.testing.assert_allclose(stated.kernel.theta, (1.0, 2.0, 3.0))
    np.testing.assert_allclose(stated.kernel.variance, 1.0)  # in the unit of the noise
    np.testing.assert_allclose(stated.likelihood.thresholds, (-0.2, 0.2))
    by_variance = prior_model(3, 3, Stated(variance=1.0))
    np.testing.assert_allclose(by_variance.likelihood.noise, 0.5)
    assert prior_model(2, 2).likelihood.thresholds.shape == (1,)


def test_nobody_answered():
    trials = answers()
    with pytest.raises(InputError, match="learnt-1: there are no responses"):
        learn(jax.tree.map(lambda leaf: leaf, Trials(trials.x[0], trials.q[0], trials.mask[0] & False)), 3)


@pytest.mark.deep  # a search each
@pytest.mark.parametrize("stated", [Stated((3.0, 5.0), 2.0, (-0.3, 0.7), 0.5), Stated(noise=2.0), Stated(variance=9.0)])
def test_what_is_stated_is_kept(stated):
    model = learn(answers(), 3, stated).model
    kept = {"theta": model.theta, "variance": model.shared + model.own, "thresholds": model.thresholds}
    for name, value in (kept | {"noise": model.noise}).items():
        if getattr(stated, name) is not None:
            np.testing.assert_allclose(value, getattr(stated, name), rtol=1e-12)


@pytest.mark.deep
def test_another_unit_of_the_noise_is_the_same_model(learnt):
    """Noise, and what scales with it; the maps agree in units of the noise."""
    scaled = learn(answers(), 3, Stated(noise=3.0), LEARNT_2)
    np.testing.assert_allclose(at(scaled), at(learnt), atol=1e-4)
    np.testing.assert_allclose(scaled.model.thresholds, 3.0 * learnt.model.thresholds, atol=1e-3)
    np.testing.assert_allclose(scaled.model.shared, 9.0 * learnt.model.shared, rtol=1e-3)


@pytest.mark.deep
@pytest.mark.parametrize(
    ("name", "rule", "categories"),
    [
        ("one category only", lambda x: np.zeros(len(x), int), 3),
        ("two of three", lambda x: (x[:, 0] > 0.5).astype(int), 3),
        ("contradictory repeats", lambda x: np.arange(len(x)) % 3, 3),
        ("two categories", lambda x: (x[:, 1] > 0.3).astype(int), 2),
    ],
)
def test_hostile_answers_are_learnt_or_said_not_to_be(name, rule, categories):
    trials = answers(rule=rule)
    end = learn(trials, categories)
    assert bool(end.converged), name
    assert all(np.isfinite(np.asarray(sd)).all() for sd in end.sd.values())
    if name == "one category only":
        assert np.all(np.asarray(end.sd["theta"]) > 0.9 * LEARNT_1.priors["theta"].sd)


@pytest.mark.deep
def test_widths_are_found_where_people_have_them():
    """Half of the people have a wide middle category, half a narrow one."""
    rng = np.random.default_rng(0)
    each = []
    for j in range(8):
        x = rng.uniform(size=(60, 2))
        felt = 2.0 * np.sin(4.0 * x[:, 0]) + x[:, 1] + rng.normal(size=60)
        half = 2.2 if j % 2 else 0.25
        each.append(Trials.from_arrays(x, (felt > 0.5 - half).astype(int) + (felt > 0.5 + half), 60))
    end = learn(jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *each), 3)
    assert end.gains["widths"] > 3
    widths = np.asarray(end.coordinates["widths"])
    assert widths[1::2].min() > widths[::2].max() + 0.5


@pytest.mark.deep
def test_features_that_are_too_few_for_the_noise_are_noticed_and_more_are_taken(monkeypatch):
    """People almost without noise: 32 features leave a few percent of the variance, and shift the hyperparameters."""
    rng = np.random.default_rng(0)
    x = rng.uniform(size=(8, 24, 2))
    felt = np.sin(9 * x[..., 0]) + np.cos(8 * x[..., 1]) + 0.02 * rng.standard_normal((8, 24))
    q = jnp.asarray((felt > -0.4).astype(int) + (felt > 0.5))
    trials = jax.vmap(Trials)(jnp.asarray(x), q, jnp.ones((8, 24), bool))
    enough = learn(trials, 3, recipe=LEARNT_2)
    monkeypatch.setattr(search, "LARGEST", 32)
    monkeypatch.setattr(rule, "LARGEST", 32)
    few = learn(trials, 3, recipe=LEARNT_2)
    assert int(enough.rank) == int(few.rank) > 32 and bool(few.converged)
    assert off(few, enough) < 0.25
    monkeypatch.setattr(rule, "_MOST_FEATURES", 32)
    rough = learn(trials, 3, recipe=LEARNT_2)
    assert not bool(rough.converged) and off(rough, enough) > 1.0


def off(learnt, other):
    """Largest difference of a hyperparameter, in the other's posterior standard deviations."""
    return max(float(np.max(np.abs(learnt.coordinates[k] - v) / other.sd[k])) for k, v in other.coordinates.items())
