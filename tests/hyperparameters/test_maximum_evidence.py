"""Maximum evidence against SciPy on the independent reference, the model's freedoms, and derivatives of an optimum."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from datasets import noisy, separated
from reference_laplace import numpy_laplace
from scipy.optimize import minimize

from hilbo.errors import InputError
from hilbo.hyperparameters import maximum_evidence as hyper
from hilbo.hyperparameters.coordinates import coordinates_of, log_prior, model_at
from hilbo.numerics.polytope import Polytope
from hilbo.ordinal_gp import RBF, OrdinalGP, OrdinalProbit, Trials, fit
from tests.vectors.evidence import three


def problem(make=noisy):
    d = make()
    theta = float(np.mean(d.theta))
    return d, OrdinalGP(RBF(theta, d.variance), OrdinalProbit(d.thresholds, d.noise)), Trials.from_arrays(d.x, d.q, 25)


@jax.jit
def maximum_by_laplace(gp, trials):
    """Compiled once for several tests."""
    return hyper.maximise_evidence(gp, trials, ("theta", "noise"))


def test_the_maximum_is_scipys():
    d, gp, trials = problem(three)
    maximum = maximum_by_laplace(gp, trials)

    def cost(log):
        return -numpy_laplace(d.x, d.q, np.exp(log[0]), d.variance, d.thresholds, np.exp(log[1]), d.x)["log_evidence"]

    best = minimize(cost, np.log([float(gp.kernel.theta), d.noise]), method="Nelder-Mead", options={"fatol": 1e-9})
    assert bool(maximum.converged) and not bool(maximum.runaway)
    assert float(maximum.log_evidence) == pytest.approx(-best.fun, abs=1e-4)


def test_coordinates_keep_thresholds_ordered_and_the_rest():
    _, gp, _ = problem(separated)
    coordinates = coordinates_of(gp, ("thresholds",))
    np.testing.assert_allclose(model_at(coordinates, gp).likelihood.thresholds, gp.likelihood.thresholds, rtol=1e-14)
    moved = model_at({name: at - 7.0 for name, at in coordinates.items()}, gp)
    assert bool(jnp.all(jnp.diff(moved.likelihood.thresholds) > 0))
    assert (moved.kernel.theta, moved.likelihood.noise) == (gp.kernel.theta, gp.likelihood.noise)


@pytest.mark.deep
def test_learnt_thresholds_stay_ordered_and_the_rest_stays():
    _, gp, trials = problem(separated)
    maximum = jax.jit(lambda t: hyper.maximise_evidence(gp, t, ("thresholds",), weak_priors=True, starts=1))(trials)
    assert bool(jnp.all(jnp.diff(maximum.gp.likelihood.thresholds) > 0))
    assert maximum.gp.kernel.theta == gp.kernel.theta
    assert float(maximum.log_evidence) >= float(fit(gp, trials).log_evidence) - 1e-9


def test_the_scale_freedom_is_real_and_refused():
    d, gp, trials = problem()
    likelihood = OrdinalProbit(2.0 * gp.likelihood.thresholds, 2.0 * gp.likelihood.noise)
    scaled = OrdinalGP(RBF(gp.kernel.theta, 4.0 * gp.kernel.variance), likelihood)
    assert float(fit(scaled, trials).log_evidence) == pytest.approx(float(fit(gp, trials).log_evidence), rel=1e-12)
    with pytest.raises(InputError, match="scale of the latent"):
        hyper.maximise_evidence(gp, trials, ("variance", "noise", "thresholds"))
    with pytest.raises(InputError, match='cannot learn "length"'):
        hyper.maximise_evidence(gp, trials, ("length",))
    del d


@jax.jit
def maximum_with_thresholds(gp, trials):
    """Compiled once for all units."""
    return hyper.maximise_evidence(gp, trials, ("theta", "noise", "thresholds"), weak_priors=True)


@pytest.mark.deep
@pytest.mark.parametrize("unit", [1e-3, 30.0, 1e4])
def test_the_unit_of_f_does_not_matter(unit):
    """f, thresholds and noise times `unit`: the same search, step by step."""
    d, gp, trials = problem(three)
    likelihood = OrdinalProbit(unit * gp.likelihood.thresholds, unit * gp.likelihood.noise)
    scaled = OrdinalGP(RBF(gp.kernel.theta, unit**2 * gp.kernel.variance), likelihood)
    here, there = maximum_with_thresholds(gp, trials), maximum_with_thresholds(scaled, trials)
    assert bool(here.converged) and bool(there.converged) and not bool(there.runaway)
    assert float(there.log_evidence) == pytest.approx(float(here.log_evidence), rel=1e-10)
    assert float(there.gp.kernel.theta) == pytest.approx(float(here.gp.kernel.theta), rel=1e-6)
    np.testing.assert_allclose(there.gp.likelihood.thresholds, unit * here.gp.likelihood.thresholds, rtol=1e-5)
    del d


def assert_unmoved(maximum, gp):
    assert float(maximum.log_evidence) == 0.0 and bool(maximum.runaway)
    assert maximum.gp.kernel.theta == pytest.approx(float(gp.kernel.theta), rel=1e-12)
    assert maximum.gp.likelihood.noise == pytest.approx(float(gp.likelihood.noise), rel=1e-12)


def test_without_answers_the_model_stays():
    _, gp, trials = problem(three)
    assert_unmoved(maximum_by_laplace(gp, trials.first(0)), gp)


@pytest.mark.deep
def test_without_answers_the_model_stays_under_expectation_propagation():
    _, gp, trials = problem(three)
    assert_unmoved(jax.jit(lambda t: hyper.maximise_evidence(gp, t, inference="ep"))(trials.first(0)), gp)


def test_the_prior_is_largest_at_its_centre():
    _, gp, _ = problem()
    every = ("theta", "noise", "thresholds")
    assert float(log_prior(gp, gp, every)) == 0.0
    away = eqx.tree_at(lambda g: g.likelihood.noise, gp, gp.likelihood.noise * np.e)
    assert float(log_prior(away, gp, every)) == pytest.approx(-0.5)


@pytest.mark.deep
def test_evidence_may_be_that_of_expectation_propagation():
    _, gp, trials = problem()
    maximum = jax.jit(lambda t: hyper.maximise_evidence(gp, t, ("noise",), starts=1, inference="ep"))(trials)
    assert bool(maximum.converged)
    nearby = [
        eqx.tree_at(lambda g: g.likelihood.noise, maximum.gp, maximum.gp.likelihood.noise * f) for f in (0.9, 1.1)
    ]
    for other in nearby:
        assert float(fit(other, trials, inference="ep").log_evidence) < float(maximum.log_evidence)
    with pytest.raises(InputError, match="has no derivatives"):
        hyper.maximise_evidence(gp, trials, inference="exact")


def test_a_hyperparameter_without_influence_is_said_to_run_away():
    """Where all was asked at one point theta says nothing, while the noise has its best value."""
    _, gp, _ = problem(three)
    q = np.array([0, 1, 1, 1, 2, 1, 0, 2])
    maximum = maximum_by_laplace(gp, Trials.from_arrays(np.full((8, 3), 0.4), q, 25))
    assert bool(maximum.converged)
    assert bool(maximum.runaway)
    assert 0.1 < float(maximum.gp.likelihood.noise) < 10.0


@pytest.mark.deep  # another model to compile the search for
def test_one_threshold_alone_is_learnt():
    """Two categories: there is no gap to learn."""
    gp = OrdinalGP(RBF(4.0, 1.0), OrdinalProbit((0.0,), 0.5))
    rng = np.random.default_rng(0)
    trials = Trials.from_arrays(rng.uniform(size=(20, 2)), (rng.uniform(size=20) < 0.8).astype(int), 25)
    maximum = hyper.maximise_evidence(gp, trials, ("thresholds",), weak_priors=True, starts=1)
    assert bool(maximum.converged)
    assert -2.0 < float(maximum.gp.likelihood.thresholds[0]) < -0.1


WALL = Polytope(np.array([[0.6, 0.8, 0.0]]), np.array([1.0]))
HELD = np.array([False, False, True])


def test_free_directions_are_along_the_walls_and_change_no_step():
    across, along = np.array([0.6, 0.8, 0.0]), np.array([0.8, -0.6, 0.0])
    for w, expected in (
        ([0.2, 0.3, 0.5], np.diag([1.0, 1.0, 0.0])),
        ([0.6, 0.8, 0.5], np.outer(along, along)),
        ([1.0, 0.5, 0.5], np.zeros((3, 3))),
        ([0.0, 0.5, 0.5], np.diag([0.0, 1.0, 0.0])),
    ):
        free = hyper._free_directions(jnp.array(w), Polytope(*map(jnp.asarray, WALL)), jnp.asarray(HELD))
        np.testing.assert_allclose(free, expected, atol=1e-12)
    np.testing.assert_allclose(across @ along, 0.0, atol=1e-15)


def test_an_optimum_at_a_linear_wall_moves_along_it_and_steps_do_not_move():
    gp = OrdinalGP(RBF(4.0), OrdinalProbit((-0.5, 0.5), 0.5))
    sharp, way = np.array([[4.0, 1.0, 0.0], [1.0, 2.0, 0.0], [0.0, 0.0, 0.0]]), np.array([0.3, -0.1, 0.4])

    def height(w, top):
        return -0.5 * (w - top) @ sharp @ (w - top)

    def refit(model):
        return jnp.array([0.7, 0.9, 0.5]) + way * (jnp.log(model.kernel.theta) - jnp.log(4.0))

    def moved(w):
        between = {"walls": Polytope(*map(jnp.asarray, WALL)), "held": jnp.asarray(HELD)}
        return hyper.optimum_sensitivity(height, refit, jnp.array(w), gp, lambda w: w, ("theta",), **between)["theta"]

    along = np.array([0.8, -0.6, 0.0])  # on the wall only what is along it counts
    expected = along * (along @ sharp @ way) / (along @ sharp @ along)
    np.testing.assert_allclose(moved([0.6, 0.8, 0.5]), expected, atol=1e-12)
    np.testing.assert_allclose(moved([0.2, 0.3, 0.5]), way * np.array([1.0, 1.0, 0.0]), atol=1e-12)
