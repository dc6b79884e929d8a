"""The Laplace engine against two oracles, against exact Gaussians, and against the meaning of its certificate."""

import math
from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from datasets import SMALL, near_separable, noisy, repeated_19, separated
from jaxtyping import Array
from mpmath import mp
from reference_laplace import mpmath_laplace, numpy_laplace
from scipy.special import log_ndtr

from hilbo.gaussian import mean_and_explained
from hilbo.kernels import RBF, gram
from hilbo.laplace import Pointwise, laplace
from hilbo.likelihoods import OrdinalProbit

OF_ONE_SHAPE = [pytest.param(make, marks=[pytest.mark.deep] * (make is noisy)) for make in SMALL]
QUANTITIES = ("mode", "mean", "variance", "log_evidence")


class Ordinal(eqx.Module):
    likelihood: OrdinalProbit
    q: Array
    answered: Array

    def __call__(self, eta):
        expansion = jax.vmap(self.likelihood.expand)(eta, self.q)
        return tuple(jnp.where(self.answered, part, jnp.zeros_like(part)) for part in expansion)


class LogProb(eqx.Module):
    """The values alone."""

    terms: Ordinal

    def __call__(self, eta):
        value = jax.vmap(self.terms.likelihood.log_prob)(eta, self.terms.q)
        return jnp.where(self.terms.answered, value, jnp.zeros_like(value))


class Gaussian(eqx.Module):
    """Measurements of eta; a point with weight 0 is not measured."""

    y: Array
    noise: Array
    weight: Array

    def __call__(self, eta):
        z = (self.y - eta) / self.noise
        return self.weight * (-0.5 * z**2 - jnp.log(self.noise) - 0.5 * math.log(2 * math.pi))


class OrdinalAndPreference(eqx.Module):
    """`ordinal` speaks of the first eta's; of each later one only its sign was seen, through probit noise."""

    ordinal: Ordinal
    noise: Array

    def __call__(self, eta):
        n = len(self.ordinal.q)
        return jnp.concatenate([self.ordinal(eta[:n])[0], jax.scipy.stats.norm.logcdf(eta[n:] / self.noise)])


@cache
def problem(make, dtype=np.float64):
    """K, the terms, and the covariances with new points, of a data set; padded to 25, so that sets share a program."""
    data = make()
    n = len(data.q)
    kernel = RBF(np.asarray(data.theta, dtype), dtype(data.variance))
    likelihood = OrdinalProbit(np.asarray(data.thresholds, dtype), dtype(data.noise))
    terms = Ordinal(likelihood, jnp.asarray(np.pad(data.q, (0, 25 - n))), jnp.arange(25) < n)
    x, x_new = jnp.asarray(np.pad(data.x, ((0, 25 - n), (0, 0))).astype(dtype)), jnp.asarray(data.x_new.astype(dtype))
    return covariances(kernel, x, x), terms, covariances(kernel, x_new, x)


@cache
def exact(make):
    return mpmath_laplace(*make().problem(), digits=30)


covariances = jax.jit(gram)
program = jax.jit(laplace, static_argnames="max_steps")


def solve(covariance, terms, **options):
    """Each search has a start, so that one program serves them all."""
    return program(covariance, terms, **({"start": jnp.asarray(np.zeros_like(covariance[0]))} | options))


def results(covariance, terms, cross, variance):
    posterior = solve(covariance, terms)
    count = int(terms.answered.sum())
    explained = mean_and_explained(posterior.weights, posterior.factor, posterior.inverse, cross.T)[1]
    values = posterior.mode[:count], cross @ posterior.weights, variance - explained, posterior.log_evidence
    return posterior, dict(zip(QUANTITIES, values, strict=True))


def error(value, target) -> float:
    """Largest |value - target| / max(1, |target|)."""
    pairs = zip(np.ravel(np.asarray(value, float)), np.ravel(np.asarray(target, object)), strict=True)
    return max(float(abs(mp.mpf(float(v)) - t) / max(1, abs(t))) for v, t in pairs)


@pytest.mark.parametrize("make", SMALL)
def test_against_textbook_and_50_digits(make):
    posterior, quantities = results(*problem(make), make().variance)
    textbook = numpy_laplace(*make().problem())
    for name in QUANTITIES:
        assert error(quantities[name], exact(make)[name]) < 1e-12, name
        assert error(quantities[name], textbook[name]) < 1e-11, name
    assert posterior.certificate.converged
    assert posterior.certificate.residual <= 1e-10


@pytest.mark.parametrize("make", OF_ONE_SHAPE)
def test_float32_is_good_for_four_digits(make):
    posterior, quantities = results(*problem(make, np.float32), np.float32(make().variance))
    assert posterior.certificate.converged
    for name in QUANTITIES:
        assert quantities[name].dtype == jnp.float32
        assert error(quantities[name], exact(make)[name]) < 2e-5, name


# --- Gaussian terms, for which Laplace is exact

rng = np.random.default_rng(7)
X = jnp.asarray(np.concatenate([rng.random((8, 2)), rng.random((2, 2)).repeat(3, axis=0)]))  # two points three times
X_NEW = jnp.asarray(rng.random((3, 2)))
MEASURED = jnp.asarray(np.arange(14) != 4, float)
TERMS = Gaussian(jnp.asarray(rng.standard_normal(14)), jnp.asarray(rng.uniform(0.3, 2.0, 14)), MEASURED)
KERNEL = RBF((3.0, 7.0), 1.3)


def by_laplace(kernel, terms):
    posterior = laplace(gram(kernel, X, X), Pointwise(terms))
    cross = gram(kernel, X_NEW, X)
    explained = mean_and_explained(posterior.weights, posterior.factor, posterior.inverse, cross.T)[1]
    return jnp.concatenate([posterior.log_evidence[None], cross @ posterior.weights, kernel.variance - explained])


def by_linear_algebra(kernel, terms):
    """The same from the normal distribution of the 13 measurements that were made."""
    seen = np.flatnonzero(MEASURED)
    x, y, noise = X[seen], terms.y[seen], terms.noise[seen]
    covariance, cross = gram(kernel, x, x) + jnp.diag(noise**2), gram(kernel, X_NEW, x)
    solved = jnp.linalg.solve(covariance, jnp.concatenate([y[:, None], cross.T], axis=1))
    evidence = -0.5 * (y @ solved[:, 0] + jnp.linalg.slogdet(covariance)[1] + len(seen) * math.log(2 * math.pi))
    explained = jnp.sum(cross * solved[:, 1:].T, axis=1)
    return jnp.concatenate([evidence[None], cross @ solved[:, 0], kernel.variance - explained])


def test_gaussian_terms_are_exact_with_their_derivatives():
    values = (jax.jit(way)(KERNEL, TERMS) for way in (by_laplace, by_linear_algebra))
    np.testing.assert_allclose(*values, rtol=1e-12, atol=1e-12)
    expected = jax.jit(jax.jacrev(by_linear_algebra, argnums=(0, 1)))(KERNEL, TERMS)
    for mode in (jax.jacrev, jax.jacfwd):
        derivatives = jax.jit(mode(by_laplace, argnums=(0, 1)))(KERNEL, TERMS)
        for value, target in zip(jax.tree.leaves(derivatives[0]), jax.tree.leaves(expected[0]), strict=True):
            np.testing.assert_allclose(value, target, rtol=1e-12, atol=1e-12)
        for name in ("y", "noise"):
            value, target = getattr(derivatives[1], name), getattr(expected[1], name)
            np.testing.assert_allclose(value, target, rtol=1e-12, atol=1e-12, err_msg=name)


def test_gaussian_terms_take_one_step():
    assert solve(covariances(KERNEL, X, X), Pointwise(TERMS)).certificate.iterations <= 2


# --- a preference between two stimuli, beside ordinal answers


def newton_in_f(prior, design, terms, steps=60):
    """Laplace over f itself, whose precision design' w design is not diagonal: (f, log evidence)."""
    f = np.zeros(len(prior))
    for _ in range(steps):
        eta = design @ f
        log_p, slope, w = terms(eta)
        weight = design.T @ (w[:, None] * design)
        f = np.linalg.solve(np.eye(len(f)) + prior @ weight, prior @ (weight @ f + design.T @ slope))
    log_p, slope, w = terms(design @ f)
    weight = design.T @ (w[:, None] * design)
    log_det = np.linalg.slogdet(np.eye(len(f)) + prior @ weight)[1]
    return f, np.sum(log_p) - 0.5 * f @ np.linalg.solve(prior, f) - 0.5 * log_det


def probit_terms(a, b, z, noise):
    """log p, slope and curvature of ordinal answers (noise 0.5) and then of preferences; moderate arguments only."""
    hazard = np.exp(-0.5 * z**2 - log_ndtr(z)) / math.sqrt(2 * math.pi)
    p = np.exp(log_ndtr(b)) - np.exp(log_ndtr(a))
    phi_a, phi_b = (np.exp(-0.5 * s**2) / math.sqrt(2 * math.pi) / p for s in (a, b))
    slope = phi_a - phi_b
    finite_a, finite_b = (np.where(np.isinf(s), 0.0, s) for s in (a, b))
    curvature = slope**2 + finite_b * phi_b - finite_a * phi_a
    return (
        np.concatenate([np.log(p), log_ndtr(z)]),
        np.concatenate([slope / 0.5, hazard / noise]),
        np.concatenate([curvature / 0.25, hazard * (hazard + z) / noise**2]),
    )


@pytest.mark.deep
def test_a_preference_is_a_term_on_a_difference():
    x = np.random.default_rng(5).random((9, 2))
    kernel, likelihood, noise = RBF(8.0, 1.4), OrdinalProbit((-0.5, 0.5), 0.5), 0.6
    prior = np.asarray(gram(kernel, jnp.asarray(x), jnp.asarray(x)))
    pairs = np.array([[0, 6], [6, 7], [8, 1], [2, 3]])  # the first is preferred
    design = np.zeros((6 + 4, 9))
    design[np.arange(6), np.arange(6)] = 1.0
    design[6 + np.arange(4), pairs[:, 0]], design[6 + np.arange(4), pairs[:, 1]] = 1.0, -1.0
    q = np.array([0, 1, 2, 2, 1, 0])

    edges = np.array([-np.inf, -0.5, 0.5, np.inf])

    def terms(eta):
        return probit_terms((edges[q] - eta[:6]) / 0.5, (edges[q + 1] - eta[:6]) / 0.5, eta[6:] / noise, noise)

    expected, evidence = newton_in_f(prior, design, terms)
    posterior = laplace(
        jnp.asarray(design @ prior @ design.T),
        Pointwise(OrdinalAndPreference(Ordinal(likelihood, jnp.asarray(q), jnp.ones(6, bool)), jnp.asarray(noise))),
    )
    assert posterior.certificate.converged
    np.testing.assert_allclose(posterior.mode, design @ expected, rtol=0, atol=1e-11)
    np.testing.assert_allclose(prior @ design.T @ posterior.weights, expected, rtol=0, atol=1e-11)
    np.testing.assert_allclose(posterior.log_evidence, evidence, rtol=0, atol=1e-11)


# --- the way to the mode, and the certificate


@pytest.mark.parametrize("make", [separated, near_separable, repeated_19])
def test_a_warm_start_changes_the_steps_and_not_the_mode(make):
    covariance, terms, _ = problem(make)
    cold = solve(covariance, terms)
    warm = solve(covariance, terms, start=cold.weights)
    np.testing.assert_allclose(warm.mode, cold.mode, rtol=0, atol=1e-10)
    assert warm.certificate.iterations <= 2 < cold.certificate.iterations


@pytest.mark.parametrize("make", [separated, near_separable, repeated_19])
@pytest.mark.parametrize("size", [1.0, 1e3, 1e6])
def test_every_start_leads_to_the_mode(make, size):
    covariance, terms, _ = problem(make)
    start = size * jnp.asarray(np.random.default_rng(8).standard_normal(25))
    posterior = solve(covariance, terms, start=start)
    assert posterior.certificate.converged
    assert error(posterior.mode[: len(make().q)], exact(make)["mode"]) < 1e-9


@pytest.mark.parametrize(("noise", "sharp"), [(None, 0.0), (10.0, 0.8)])
def test_the_residual_bounds_the_distance_to_the_mode(noise, sharp):
    """Stopped early, eta is no further from the mode than that, in the prior's norm; with weak data, just as far."""
    covariance, terms, _ = problem(near_separable)
    if noise is not None:
        terms = eqx.tree_at(lambda t: t.likelihood.noise, terms, jnp.asarray(noise, float))
    n, mode = len(near_separable().q), solve(covariance, terms).mode
    for steps in (1, 3) if noise is None else (1,):
        posterior = solve(covariance, terms, max_steps=steps)
        certificate, apart = posterior.certificate, np.asarray(posterior.mode - mode)[:n]
        assert not certificate.converged
        assert certificate.iterations == steps
        assert certificate.residual > certificate.tolerance
        distance = math.sqrt(apart @ np.linalg.solve(covariance[:n, :n], apart))
        assert sharp * certificate.residual < distance <= certificate.residual * (1 + 1e-9)


@jax.jit
@partial(jax.vmap, in_axes=(None, 0, 0))
def second_derivatives(likelihood, eta, q):
    return jax.grad(jax.grad(lambda eta: likelihood.log_prob(eta, q)))(eta)


@pytest.mark.parametrize("make", OF_ONE_SHAPE)
def test_the_other_figures_of_the_certificate(make):
    covariance, terms, _ = problem(make)
    posterior = solve(covariance, terms)
    certificate = posterior.certificate
    variance = np.diagonal(covariance) - np.diagonal(covariance @ posterior.inverse @ covariance)
    curvature = -np.asarray(second_derivatives(terms.likelihood, posterior.mode, terms.q))
    root = np.sqrt(curvature) * np.asarray(terms.answered)
    matrix = np.eye(len(root)) + root[:, None] * np.asarray(covariance) * root
    assert certificate.jitter <= 1e-13
    assert np.linalg.cond(matrix) <= certificate.condition <= len(root) * np.linalg.cond(matrix)
    np.testing.assert_allclose(certificate.smallest_variance, variance[terms.answered].min(), rtol=1e-9)
    assert certificate.variance_resolution <= 1e-13 < certificate.smallest_variance
    np.testing.assert_allclose(posterior.factor.T @ posterior.factor, posterior.inverse, rtol=0, atol=1e-12)


def test_slopes_and_curvatures_may_be_given_or_derived():
    """`expand` states what `Pointwise` differentiates; the posteriors are the same, and so are their derivatives."""
    covariance, terms, _ = problem(near_separable)
    derived = Pointwise(LogProb(terms))
    for stated, expected in zip(*jax.jit(lambda eta: (terms(eta), derived(eta)))(covariance[0]), strict=True):
        np.testing.assert_allclose(stated, expected, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(solve(covariance, derived).mode, solve(covariance, terms).mode, rtol=0, atol=1e-10)


def test_steps_that_overshoot_are_damped():
    """Newton's own step on -20 sqrt(1 + (eta - 5)^2) goes past the mode by the cube of its distance."""
    terms = Pointwise(lambda eta: -20.0 * jnp.sqrt(1.0 + (eta - 5.0) ** 2))
    posterior = jax.jit(lambda: laplace(1e4 * jnp.eye(2), terms))()
    assert posterior.certificate.converged
    slope = -20.0 * (posterior.mode - 5.0) / np.sqrt(1.0 + (posterior.mode - 5.0) ** 2)
    np.testing.assert_allclose(posterior.mode, 1e4 * slope, rtol=1e-9)


def test_terms_that_are_nothing_leave_the_prior():
    posterior = jax.jit(lambda: laplace(jnp.eye(3), Pointwise(jnp.zeros_like)))()
    np.testing.assert_array_equal(posterior.mode, np.zeros(3))
    np.testing.assert_array_equal(posterior.inverse, np.zeros((3, 3)))
    assert posterior.log_evidence == 0.0
    assert posterior.certificate.smallest_variance == 1.0


def test_both_searches_find_the_same_mode(monkeypatch):
    covariance, terms, _ = problem(separated)
    plain = solve(covariance, terms)
    monkeypatch.setattr("hilbo.laplace._PLAIN_STEPS", 0)
    safe = jax.jit(lambda: laplace(covariance, terms))()
    assert bool(plain.certificate.converged) and bool(safe.certificate.converged)
    assert float(plain.certificate.jitter) == 0.0 < float(safe.certificate.jitter)
    np.testing.assert_allclose(plain.mode, safe.mode, atol=1e-10)
