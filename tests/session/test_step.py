"""The compiled step: one fit gives the next point and the posterior, certificate included."""

import jax
import numpy as np
import pytest
from live import STUDY

from hilbo.ordinal_gp import fit
from hilbo.session.ask_tell import Session, physical_trials

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
