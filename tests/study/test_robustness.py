"""The robustness check: optima with fixed hyperparameters and with those of the criterion of the study's rule."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hilbo.errors import InputError
from hilbo.hyperparameters.maximum_evidence import maximise_evidence
from hilbo.ordinal_gp import Trials, fit
from hilbo.population.judged.left_out_evidence import left_out_evidence
from hilbo.search.candidates import search_points
from hilbo.study.cohort import Cohort
from hilbo.study.config import Study
from hilbo.study.estimate.aggregate import fit_cohort
from hilbo.study.estimate.learnt import that_learns
from hilbo.study.estimate.optimum import population_optimum
from hilbo.study.robustness.optimised import fixed_and_optimised
from hilbo.study.robustness.robustness import NEAR, nearby, robustness

pytestmark = pytest.mark.deep


@pytest.fixture(scope="module")
def scene():
    """Three people with 20 answers each, who like one rendering of the paper's study best."""
    study = Study.load("hilbo/data/paper.toml")
    rng = np.random.default_rng(3)
    x = study.space.candidates(60, 1)
    goal = np.array([0.15, 0.25, 0.2])
    felt = np.linalg.norm((x - goal) / [0.15, 0.4, 0.3], axis=1) + 0.3 * rng.standard_normal(60)
    q = (felt < 1.8).astype(int) + (felt < 1.0)
    trials = jax.tree.map(lambda *a: jnp.stack(a), *[Trials.from_arrays(x[i::3], q[i::3], 25) for i in range(3)])
    return study, Cohort(trials, np.zeros((3, 25, 3)), ("A", "B", "C"))


@pytest.fixture(scope="module")
def checked(scene):
    study, cohort = scene
    return study, cohort, robustness(study, cohort)


def test_the_optima_are_compared(checked):
    study, cohort, result = checked
    both, fixed, optimised = result.hyperparameters, result.fixed.optimum, result.optimised.optimum
    assert both.fixed is study and both.converged and both.learn == ("theta", "noise", "thresholds")
    before, after = (left_out_evidence(each.gp, cohort.trials, "bcm") for each in (both.fixed, both.optimised))
    assert both.gain == pytest.approx(after - before, rel=1e-9) and both.gain > 0
    assert result.nrmse == pytest.approx(float(np.sqrt(np.mean((fixed.x - optimised.x) ** 2))))
    assert result.individual_nrmse.shape == (3,) and result.flagged == (result.nrmse >= 0.03)
    assert float(optimised.mean) >= float(result.local.optimum.mean) >= float(result.fixed_again.optimum.mean)
    np.testing.assert_array_equal(result.fixed_again.optimum.x, fixed.x)
    assert result.resampled.fixed.shape == result.resampled.moves.shape


def test_an_exact_map_is_compared_as_it_is(scene):
    """Its sensitivity is that of the optimum of participants who are aggregated point by point."""
    study, cohort = scene
    result = robustness(dataclasses.replace(study, rule="pooled"), cohort, learn=("noise",))
    posteriors, candidates = fit_cohort(study, cohort), search_points(study.space, 0)
    top = population_optimum(study, posteriors, candidates).x
    assert float(jnp.max(jnp.abs(top - result.fixed.optimum.x))) > 0.01
    expected = robustness(study, cohort, learn=("noise",)).sensitivity["noise"]
    np.testing.assert_allclose(result.sensitivity["noise"], expected, atol=1e-6)
    assert float(np.min(result.resampled.fixed)) == 0.0


def test_exact_inference_has_no_derivatives_and_is_checked_by_ep(scene):
    study, cohort = scene
    result = robustness(dataclasses.replace(study, inference="exact"), cohort, learn=("noise",))
    by_ep = robustness(dataclasses.replace(study, inference="ep"), cohort, learn=("noise",))
    assert result.hyperparameters.gain == pytest.approx(by_ep.hyperparameters.gain, rel=1e-9)


def test_without_answers_there_is_an_error(scene):
    study, cohort = scene
    trials = eqx.tree_at(lambda t: t.mask, cohort.trials, jnp.zeros_like(cohort.trials.mask))
    with pytest.raises(InputError, match="there are no responses"):
        fixed_and_optimised(study, Cohort(trials, np.zeros((3, 25, 3)), ("A", "B", "C")))


def test_answers_near_an_optimum_are_counted(checked):
    _, cohort, result = checked
    mask, x, q = (np.asarray(part) for part in (cohort.trials.mask, cohort.trials.x, cohort.trials.q))
    away = np.sqrt(np.mean((x[mask] - np.asarray(result.fixed.optimum.x)) ** 2, axis=1))
    assert result.fixed.answers == np.sum(away <= NEAR) > 0
    assert result.fixed.highest == np.sum(q[mask][away <= NEAR] == 2)


def test_the_optimum_moves_as_its_derivative_says(checked):
    study, cohort, result = checked
    candidates = jnp.asarray(study.space.candidates(4096, 0))
    step = 0.02

    def optimum(log_noise):
        changed = eqx.tree_at(lambda s: s.gp.likelihood.noise, study, jnp.exp(jnp.asarray(log_noise)))
        return population_optimum(changed, fit_cohort(changed, cohort), candidates).x

    middle = float(jnp.log(study.gp.likelihood.noise))
    moved = (optimum(middle + step) - optimum(middle - step)) / (2 * step)
    np.testing.assert_allclose(result.sensitivity["noise"], moved, atol=1e-3)


def test_one_model_of_all_answers_has_its_evidence(scene):
    study, cohort = scene
    both = fixed_and_optimised(dataclasses.replace(study, rule="pooled"), cohort)
    mask = np.asarray(cohort.trials.mask)
    everybody = Trials.from_arrays(np.asarray(cohort.trials.x)[mask], np.asarray(cohort.trials.q)[mask])
    before, after = (fit(each.gp, everybody).log_evidence for each in (both.fixed, both.optimised))
    assert "by one model" in both.criterion and both.gain == pytest.approx(float(after - before), abs=1e-4)
    by_newton = maximise_evidence(study.gp, everybody, both.learn, weak_priors=True)
    assert both.gain == pytest.approx(float(by_newton.log_evidence - before), abs=0.02)
    np.testing.assert_allclose(both.optimised.gp.kernel.theta, by_newton.gp.kernel.theta, rtol=0.05)


def test_a_single_participant_has_an_evidence_too(scene):
    study, cohort = scene
    trials = eqx.tree_at(lambda t: t.mask, cohort.trials, cohort.trials.mask.at[1:].set(False))
    alone = fixed_and_optimised(study, Cohort(trials, np.zeros((3, 25, 3)), ("A", "B", "C")), ("noise",))
    assert "only participant" in alone.criterion and alone.gain > 0


def test_a_rule_that_learns_is_compared_with_its_priors_medians(scene):
    study, cohort = scene
    learns = that_learns(study)
    both = fixed_and_optimised(learns, cohort)
    np.testing.assert_allclose(both.fixed.gp.kernel.theta, learns.gp.kernel.theta, rtol=1e-12)
    assert both.gain > 0 and float(both.optimised.learnt.steps) > 0 and int(both.fixed.learnt.steps) == 0
    assert both.fixed.learnt.coordinates == {} and bool(both.fixed.learnt.converged)
    result = robustness(learns, cohort)
    assert result.sensitivity is None and np.isfinite(result.nrmse)


@pytest.mark.parametrize(("learn", "words"), [(("variance",), "prior variance"), (("x",), '"x"'), ((), "nothing")])
def test_what_cannot_be_optimised_is_said(scene, learn, words):
    with pytest.raises(InputError, match=words):
        robustness(*scene, learn=learn)


def test_points_near_an_optimum_are_feasible_and_keep_levels(scene):
    study, _ = scene
    x = jnp.asarray(study.space.candidates(1, 3)[0])
    points = np.asarray(nearby(study.space, x, 500, 0))
    assert np.asarray(study.space.feasible(points)).all()
    away = np.abs(points - np.asarray(x)).max(axis=1)
    assert away.max() < 0.25 and 0.001 < np.median(away) < 0.05
    levels = Study.from_dict(
        {
            "schema": 1,
            "study": {"name": "levels", "responses": ["bad", "good"]},
            "parameters": {"kind": {"levels": ["a", "b", "c"]}, "gain": {"low": 0.0, "high": 1.0}},
            "aggregation": {"rule": "learnt-2"},
        }
    )
    x = jnp.asarray(levels.space.candidates(4, 0)[0])
    assert np.all(np.asarray(nearby(levels.space, x, 50, 0))[:, 0] == float(x[0]))
