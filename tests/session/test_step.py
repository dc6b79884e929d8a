"""The compiled step: one fit gives the next point and the posterior, certificate included."""

from pathlib import Path

import jax
import numpy as np
import pytest
from live import RAW, STUDY

import hilbo
from hilbo.numerics.tracing import keep_with
from hilbo.ordinal_gp import fit
from hilbo.programs.description import describe
from hilbo.programs.entries import Entries
from hilbo.programs.keeping import Programs
from hilbo.session.choose import selection, step
from hilbo.session.choose.ask_tell import Session, physical_trials
from hilbo.study.config import Study

POINTS = np.array([[0.2, 0.3], [0.8, 0.7], [0.5, 0.5], [0.4, 0.9]])
ANSWERS = (0, 2, 1, 2)


@pytest.mark.parametrize("count", [0, 1, 3, 4])
def test_it_hands_out_the_posterior_that_a_fit_gives(count):
    step = Session.start(STUDY).step
    fitted = step.fitted(POINTS[:count], ANSWERS[:count])
    expected = fit(STUDY.gp, physical_trials(STUDY, POINTS[:count], np.array(ANSWERS[:count], int), step.capacity))
    flat, structure = jax.tree.flatten(expected)
    assert jax.tree.structure(fitted.posterior) == structure
    for ours, one in zip(jax.tree.leaves(fitted.posterior), flat, strict=True):
        assert ours.dtype == one.dtype
        np.testing.assert_allclose(ours, one, rtol=1e-9, atol=1e-14)
    assert fitted.posterior.certificate.converged
    if count >= len(step.initial):
        np.testing.assert_array_equal(fitted.point, step(POINTS[:count], ANSWERS[:count]))


def test_the_largest_mean_of_a_known_posterior_is_found_without_answers():
    step = Session.start(STUDY).step
    posterior = step.fitted(POINTS, ANSWERS).posterior
    best = step.best(posterior)
    grid = np.stack(np.meshgrid(*[np.linspace(0.0, 1.0, 101)] * 2), axis=-1).reshape(-1, 2)
    highest = float(posterior.mean(STUDY.space.to_unit(grid)).max())
    assert highest - 1e-9 <= float(posterior.mean(STUDY.space.to_unit(best[None]))[0]) <= highest + 1e-2
    assert step.compiled._cache_size() == 1  # by the very program that chooses


def test_another_session_of_a_study_traces_nothing(monkeypatch):
    Session.start(STUDY).step.fitted(POINTS, ANSWERS)
    monkeypatch.setattr(jax, "eval_shape", None)  # a layout that is traced again would call it
    step = Session.start(STUDY, seed=1).step
    assert step.fitted(POINTS, ANSWERS).posterior.certificate.converged
    assert step.compiled._cache_size() == 1


@pytest.fixture
def another_process(tmp_path):
    """Forgets what this process has traced and compiled, and keeps programs."""
    remarks = []

    def begin():
        jax.clear_caches()
        keep_with(Programs(Entries(tmp_path, remarks.append), Path(hilbo.__file__).parent))

    yield begin
    keep_with(None)
    assert remarks == []


@pytest.mark.empties_caches
@pytest.mark.deep  # compiles the step twice
def test_another_process_traces_no_step_and_finds_the_same_bits(another_process, monkeypatch):
    def arrays():
        begun = Session.start(STUDY, seed=2).step
        fitted = begun.fitted(POINTS, ANSWERS)
        return [fitted.point, begun.best(fitted.posterior), *jax.tree.leaves(fitted.posterior)]

    traced = arrays()
    another_process()
    made = arrays()
    another_process()
    monkeypatch.setattr(step, "_shapes", None)
    monkeypatch.setattr(step, "point_after", None)
    for results in (made, arrays()):
        for ours, one in zip(results, traced, strict=True):
            np.testing.assert_array_equal(ours, one)


def words(**changes):
    """By which the step of a study with these changes would be kept."""
    tables = {name: RAW[name] | change if isinstance(change, dict) else change for name, change in changes.items()}
    return describe(step._step, (selection.Choosing.of(Study.from_dict(RAW | tables)),), {})


def test_studies_share_a_step_unless_a_choice_depends_on_what_differs():
    same = words()
    assert words(study={"name": "another", "responses": ["x", "y", "z"]}) == same
    assert words(gp={"theta": 20.0, "noise": 0.1}) == same
    assert words(selection={"weight": 2.0, "space_filling": 3}) == same
    for differs in (
        {"parameters": {"u": {"low": 0, "high": 2}, "v": {"low": 0, "high": 1}}},
        {"gp": {"inference": "ep"}},
        {"gp": {"thresholds": [-1.0, 0.0, 1.0]}, "study": {"responses": ["a", "b", "c", "d"]}},
        {"selection": {"acquisition": "log_ei"}},
        {"selection": {"minimum_distance": 0.1}},
        {"selection": {"trials": 7}},
    ):
        assert words(**differs) != same
