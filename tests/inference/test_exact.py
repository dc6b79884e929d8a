"""The exact posterior against quadrature, slice sampling and SciPy's Genz; its stated errors; and EP and Laplace
against it."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from datasets import SIX, Dataset, near_separable, noisy, rated, repeated, repeated_19, separated
from helpers import answers, assert_traces_once, model
from oracles import oracle
from reference_exact import gram as covariances
from reference_exact import quadrature
from stress_cases import reference as one_variable

from hilbo import RBF, OrdinalGP, OrdinalProbit, Trials, bcm, fit, ordinal_gp
from hilbo.errors import InputError
from hilbo.inference.exact import exact
from hilbo.inference.tilting import ordered_box, tilting
from hilbo.kernels import gram
from hilbo.numerics.sobol import scrambled_sobol

CAPACITY = 25


@cache
def fitted(make, inference="exact"):
    return fit(model(make()), answers(make()), inference=inference)


def errors_apart(value, expected, *errors):
    """Difference over the standard error of both; rounding counts as 1e-12."""
    return np.abs(np.asarray(value) - expected) / np.sqrt(sum(np.asarray(e) ** 2 for e in errors) + 1e-24)


# --- right, within the stated errors


OTHER_SHAPES = (noisy, rated)  # which compile programs of their own


@pytest.mark.parametrize(
    "make", [pytest.param(make, marks=[pytest.mark.deep] * (make in OTHER_SHAPES)) for make in SIX]
)
def test_against_two_other_methods(make):
    """The latent function by elliptical slice sampling, the evidence by SciPy: within three standard errors."""
    data, posterior = make(), fitted(make)
    certificate, x = posterior.certificate, jnp.asarray(data.x_new)
    assert certificate.converged
    assert certificate.log_evidence_error < 1e-3 and certificate.mean_error < 2e-3
    known = oracle("exact")[data.name]
    evidence, error = known["genz"]
    assert errors_apart(posterior.log_evidence, evidence, error, certificate.log_evidence_error) < 3
    mean, error = known["slice_sampled"]
    assert np.max(errors_apart(posterior.predict(x)[0], mean, error, posterior.standard_errors(x)[0])) < 3


@pytest.mark.parametrize(
    ("make", "cells"), [(repeated, 71), pytest.param(repeated_19, 121, marks=pytest.mark.deep)]
)  # cells that leave 3e-12 and 4e-8
def test_against_quadrature(make, cells):
    """On three stimuli everything is an integral over three numbers: mean, variance, class probabilities, evidence."""
    data, posterior = make(), fitted(make)
    x = jnp.asarray(data.x_new)
    evidence, *expected = quadrature(data, cells)
    assert errors_apart(posterior.log_evidence, evidence, posterior.certificate.log_evidence_error) < 3
    values = (*posterior.predict(x), posterior.class_probabilities(x))
    for value, target, error in zip(values, expected, posterior.standard_errors(x), strict=True):
        assert np.max(errors_apart(value, target, error)) < 3
        assert np.max(error) < 1e-3


@pytest.mark.deep
@pytest.mark.release  # 200 samplers
def test_the_standard_errors_cover_in_95_percent():
    """200 keys: truth within two standard errors for about 95 % of evidence, means, variances and probabilities."""
    data, posterior = repeated(), fitted(repeated)
    x = jnp.asarray(data.x_new)[jnp.asarray([0, 1, 4])]
    evidence, mean, variance, probabilities = quadrature(data)
    rows = np.array([0, 1, 4])
    covariance = gram(posterior.gp.kernel, posterior.trials.x, posterior.trials.x)
    edges = jnp.asarray([-jnp.inf, *data.thresholds, jnp.inf])
    low, high = edges[posterior.trials.q], edges[posterior.trials.q + 1]

    @jax.jit
    def once(key):
        latent = exact(key, covariance, low, high, posterior.gp.likelihood.noise, posterior.trials.mask)
        again = ordinal_gp.Posterior(posterior.gp, posterior.trials, latent)
        values = (again.log_evidence[None], *again.predict(x), again.class_probabilities(x).ravel())
        m, v, p = again.standard_errors(x)
        errors = (again.certificate.log_evidence_error[None], m, v, p.ravel())
        return jnp.concatenate(values), jnp.concatenate(errors)

    truth = np.concatenate([[evidence], mean[rows], variance[rows], probabilities[rows].ravel()])
    estimates, errors = map(np.stack, zip(*(once(jax.random.key(seed)) for seed in range(200)), strict=True))
    covered = np.mean(np.abs(estimates - truth) <= 2 * errors + 1e-12, axis=0)
    assert np.all(covered >= 0.90), covered  # 95 % of 200 has a standard error of 1.5 %
    assert 0.93 <= np.mean(covered) <= 0.97, covered
    assert np.all(np.abs(np.mean(estimates - truth, axis=0)) <= 4 * np.std(estimates, axis=0) / np.sqrt(200) + 1e-12)


def test_one_answer_by_hand():
    """Evidence is the blurred likelihood, and a sample of one variable is a quantile of a confined normal."""
    gp = OrdinalGP(RBF(3.0, 1.7), OrdinalProbit((-0.5, 0.7), 0.3))
    for category in range(3):
        trials = Trials.from_arrays(np.full((1, 3), 0.3), np.array([category]), CAPACITY)
        posterior = fit(gp, trials, inference="exact")
        blurred = OrdinalProbit((-0.5, 0.7), np.sqrt(0.3**2 + 1.7))
        np.testing.assert_allclose(posterior.log_evidence, blurred.log_prob(0.0, category), rtol=1e-12)
        by_ep = fit(gp, trials, inference="ep")
        moments, errors = posterior.predict(trials.x[:1]), posterior.standard_errors(trials.x[:1])
        for value, expected, error in zip(moments, by_ep.predict(trials.x[:1]), errors, strict=False):
            assert errors_apart(value, expected, error) < 3 and error < 1e-3


# --- what the approximations miss (docs/methods/inference.md has the table)

BOUNDS = [(separated, 0.002, 0.03), (repeated, 0.002, 0.03), (repeated_19, 0.002, 0.03), (near_separable, 0.003, 0.15),
          pytest.param(noisy, 0.002, 0.03, marks=pytest.mark.deep)]  # fmt: skip


@pytest.mark.parametrize(("make", "of_mean", "of_evidence"), BOUNDS)
def test_expectation_propagation_is_near_and_laplace_is_not(make, of_mean, of_evidence):
    truth, count = fitted(make), len(make().q)
    misses = {}
    for inference in ("ep", "laplace"):
        other = fitted(make, inference)
        apart = np.asarray(other.latent.mode - truth.latent.mode)[:count]
        misses[inference] = np.sqrt(np.mean(apart**2)), abs(float(other.log_evidence - truth.log_evidence))
    assert misses["ep"][0] <= of_mean and misses["ep"][1] <= of_evidence, misses
    assert misses["laplace"][0] > 10 * misses["ep"][0], misses


# --- the machinery


@pytest.mark.parametrize("make", [separated, near_separable, repeated_19])
def test_no_weight_exceeds_the_bound(make):
    """psi <= psi* everywhere: what makes acceptance by exp(psi - psi*) exact."""
    latent = fitted(make).latent
    assert latent.tilt.gradient <= 1e-6
    relative = latent.shares / jnp.max(latent.shares)
    total = jnp.exp(latent.log_evidence - latent.tilt.highest)
    assert jnp.max(latent.shares) * latent.shares.size * total <= 1 + 1e-9
    assert 0 < total <= 1 and np.all(relative >= 0)
    np.testing.assert_allclose(jnp.sum(latent.shares), 1.0, rtol=1e-12)


@pytest.mark.parametrize("noise", [0.5, 0.01])
def test_conflicting_repeats_under_a_wide_prior(noise):
    """Ten answers at one point, lowest and highest in turn, a prior sd of 100: against quadrature in one variable."""
    x, q = np.full((10, 3), 0.4), np.tile([0, 2], 5)
    case = Dataset("conflicting", x, q, 1.0, 1e4, (-0.5, 0.5), noise, x[:1])
    posterior = fit(model(case), answers(case), inference="exact")
    evidence, mean, variance = one_variable(case)
    certificate = posterior.certificate
    assert certificate.iterations < 40
    np.testing.assert_allclose(posterior.log_evidence, evidence, rtol=1e-8, atol=4 * certificate.log_evidence_error)
    moments = posterior.predict(jnp.asarray(x[:1]))
    errors = posterior.standard_errors(jnp.asarray(x[:1]))
    np.testing.assert_allclose(moments[0], mean[:1], atol=4 * errors[0][0] + 1e-9)
    np.testing.assert_allclose(moments[1], variance[:1], rtol=1e-3, atol=4 * errors[1][0] + 1e-11)


def test_draws_have_the_moments_of_the_posterior():
    data, posterior = near_separable(), fitted(near_separable)
    x = data.x_new[[0, *range(len(data.x_new))]]
    draws = np.asarray(posterior.draw(jax.random.key(3), x, 10_000))
    mean, variance = posterior.predict(x)
    assert draws.shape == (10_000, len(x)) and np.all(np.isfinite(draws))
    assert np.max(errors_apart(np.mean(draws, axis=0), mean, np.std(draws, axis=0) / np.sqrt(10_000))) < 3
    np.testing.assert_allclose(np.var(draws, axis=0), variance, rtol=0.05)
    # asked twice at one point, a draw gives one value: it is a function
    np.testing.assert_allclose(draws[:, 0], draws[:, 1], rtol=0, atol=1e-7)


def test_points_are_uniform_and_even():
    sobol = jax.jit(scrambled_sobol, static_argnums=(1, 2, 3, 4))
    points = np.asarray(sobol(jax.random.key(0), 3, 256, 5, np.float64))
    assert points.shape == (3, 256, 5)
    for replicate in points:
        for column in replicate.T:  # one point in each of 256 slices
            np.testing.assert_array_equal(np.sort(np.floor(column * 256)), np.arange(256))
        corner = np.floor(replicate[:, :2] * 16).astype(int)  # the first two coordinates: one in each of 16 x 16 cells
        assert len({tuple(row) for row in corner}) == 256
    assert not np.allclose(points[0], points[1])
    single = np.asarray(sobol(jax.random.key(0), 3, 256, 5, np.float32))
    assert single.dtype == np.float32 and single.min() > 0 and single.max() < 1
    with pytest.raises(InputError, match="give a power of 2"):
        scrambled_sobol(jax.random.key(0), 3, 100, 5, np.float64)


def test_the_tilting_is_a_saddle_point():
    data = near_separable()
    prior = covariances(data.x, data.x, data.theta, data.variance)
    edges, n = np.array([-np.inf, *data.thresholds, np.inf]), len(data.q)
    given = map(jnp.asarray, (prior, edges[data.q], edges[data.q + 1], np.array(data.noise), np.ones(n, bool)))

    @jax.jit
    def tilted(*given):
        box = ordered_box(*given)
        return box, tilting(box)

    box, tilt = tilted(*given)
    assert tilt.gradient < 1e-7 and tilt.iterations < 15
    # half is L^-1 in the caller's order: it whitens S
    matrix = prior + data.noise**2 * np.eye(n)
    np.testing.assert_allclose(box.half @ matrix @ box.half.T, np.eye(n), rtol=0, atol=1e-9)


# --- shapes and the interface


def assert_same(one, other, rtol=1e-12):
    x = jnp.asarray(separated().x_new)
    np.testing.assert_allclose(one.log_evidence, other.log_evidence, rtol=rtol, atol=rtol)
    for value, expected in zip(one.predict(x), other.predict(x), strict=True):
        np.testing.assert_allclose(value, expected, rtol=rtol, atol=rtol)
    np.testing.assert_allclose(one.class_probabilities(x), other.class_probabilities(x), rtol=rtol, atol=rtol)


@pytest.mark.parametrize("make", [repeated])
@pytest.mark.deep
def test_padded_equals_unpadded_and_a_batch_a_loop(make):
    data, full = make(), answers(make())
    rubbish = Trials(jnp.where(full.mask[:, None], full.x, 0.77), jnp.where(full.mask, full.q, 2), full.mask)
    assert_same(fit(model(data), answers(data, len(data.q)), inference="exact"), fitted(make))
    assert_same(fit(model(data), rubbish, inference="exact"), fitted(make))
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), full, rubbish)
    batch = jax.jit(jax.vmap(lambda t: fit(model(data), t, inference="exact", throw=False)))(stacked)
    for index in range(2):
        assert_same(jax.tree.map(lambda leaf, i=index: leaf[i], batch), fitted(make), rtol=1e-10)


def test_no_answers_give_exactly_the_prior():
    gp, x = OrdinalGP(RBF(3.0, 1.7), model(separated()).likelihood), jnp.asarray(separated().x_new)
    posterior = fit(gp, Trials.empty(CAPACITY, 3), inference="exact")
    assert posterior.log_evidence == 0.0
    mean, variance = posterior.predict(x)
    np.testing.assert_array_equal(mean, np.zeros(len(x)))
    np.testing.assert_array_equal(variance, np.full(len(x), 1.7))
    assert posterior.certificate.converged


@pytest.mark.parametrize("category", [0, 1, 2])
def test_one_category_only(category):
    data = separated()
    trials = Trials.from_arrays(data.x, np.full(len(data.q), category), CAPACITY)
    posterior, by_ep = (fit(model(data), trials, inference=name) for name in ("exact", "ep"))
    assert posterior.certificate.converged
    np.testing.assert_allclose(posterior.log_evidence, by_ep.log_evidence, atol=0.03)
    np.testing.assert_allclose(posterior.predict(trials.x[:20])[0], by_ep.predict(trials.x[:20])[0], atol=0.01)


@pytest.mark.empties_caches
@pytest.mark.deep
def test_growing_data_are_traced_once():
    data = separated()
    gp, whole = model(data), answers(data, 26)
    with assert_traces_once(ordinal_gp._fit, ordinal_gp._sampled_probabilities):
        for count in (1, 7, 20):
            fit(gp, whole.first(count), inference="exact").class_probabilities(jnp.asarray(data.x_new))


def test_the_committee_takes_it():
    posteriors = [fitted(repeated), fitted(separated)]
    x = jnp.asarray(separated().x_new)
    means, explained = (jnp.stack(part) for part in zip(*(p.predict_explained(x) for p in posteriors), strict=True))
    mean, variance = bcm.combine_explained(means, explained, 1.0)
    assert np.all(np.isfinite(mean)) and np.all((variance > 0) & (variance <= 1 + 1e-12))


def test_what_it_cannot_do_it_says():
    data, trials = repeated(), answers(repeated())

    def evidence(noise):
        gp = OrdinalGP(model(data).kernel, OrdinalProbit(jnp.asarray(data.thresholds), noise))
        return fit(gp, trials, inference="exact", throw=False).log_evidence

    with pytest.raises(InputError, match=r'inference "exact" is sampled and has no derivatives; use "ep"'):
        jax.grad(evidence)(jnp.asarray(0.5))
    laplace = fitted(repeated, "laplace")
    with pytest.raises(InputError, match=r'draw: this posterior is not sampled; fit with inference="exact"'):
        laplace.draw(jax.random.key(0), trials.x[:2], 5)
    with pytest.raises(InputError, match=r"standard_errors: this posterior is not sampled"):
        laplace.standard_errors(trials.x[:2])
