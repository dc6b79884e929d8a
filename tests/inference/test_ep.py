"""Expectation propagation against the textbook's algorithm, quadrature, exact Gaussians and finite differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from datasets import SMALL, hostile_cases, near_separable, noisy, repeated, repeated_19, separated
from helpers import answers, assert_traces_once, complaint, model, unchecked
from jaxtyping import Array
from reference_ep import textbook_ep, tilted_moments

from hilbo import RBF, OrdinalGP, OrdinalProbit, Trials, fit, ordinal_gp
from hilbo.gaussian import mean_and_explained
from hilbo.inference.ep import ep
from hilbo.kernels import gram
from hilbo.likelihoods import TiltedTerms
from hilbo.ordinal_gp import InferenceError


def by_ep(data, capacity=25, **options):
    return fit(model(data), answers(data, capacity), inference="ep", **options)


def edges_of(data):
    edges = np.concatenate([[-np.inf], data.thresholds, [np.inf]])
    return edges[data.q], edges[data.q + 1]


@pytest.mark.parametrize("make", [pytest.param(make, marks=[pytest.mark.deep] * (make is noisy)) for make in SMALL])
def test_against_the_textbook(make):
    """Another algorithm, other formulas, moments by quadrature: the same fixed point."""
    data = make()
    posterior = by_ep(data)
    prior = np.asarray(gram(posterior.gp.kernel, jnp.asarray(data.x), jnp.asarray(data.x)))
    mean, variance, evidence = textbook_ep(prior, *edges_of(data), data.noise)
    ep_mean, ep_variance = posterior.predict(jnp.asarray(data.x))
    np.testing.assert_allclose(ep_mean, mean, rtol=0, atol=1e-7)
    np.testing.assert_allclose(ep_variance, variance, rtol=0, atol=1e-7)
    np.testing.assert_allclose(posterior.log_evidence, evidence, rtol=0, atol=1e-7)
    np.testing.assert_allclose(posterior.latent.mode[: len(data.q)], mean, rtol=0, atol=1e-7)


@pytest.mark.parametrize("category", [0, 1, 2])
@pytest.mark.parametrize("noise", [0.05, 0.5, 3.0])
def test_one_answer_is_exact(category, noise):
    likelihood = OrdinalProbit((-0.5, 0.7), noise)
    trials = Trials.from_arrays(np.full((1, 3), 0.3), np.array([category]), 25)
    posterior = fit(OrdinalGP(RBF(5.0, 1.7), likelihood), trials, inference="ep")
    edges = (-np.inf, -0.5, 0.7, np.inf)
    log_z, mean, variance, _ = tilted_moments(0.0, 1.7, edges[category], edges[category + 1], noise)
    np.testing.assert_allclose(posterior.log_evidence, log_z, rtol=1e-10)
    np.testing.assert_allclose(posterior.predict(trials.x[:1]), [[mean], [variance]], rtol=0, atol=1e-10)
    blurred = OrdinalProbit((-0.5, 0.7), np.sqrt(noise**2 + 1.7))
    np.testing.assert_allclose(posterior.log_evidence, blurred.log_prob(0.0, category), rtol=1e-13)


class Measured(eqx.Module):
    """Gaussian measurements y of eta; where `seen` is False there is none."""

    y: Array
    noise: Array
    seen: Array

    def __call__(self, mean, variance):
        spread = self.noise**2 + variance
        value = -0.5 * (self.y - mean) ** 2 / spread - 0.5 * jnp.log(2 * jnp.pi * spread)
        parts = value, (self.y - mean) / spread, 1.0 / self.noise**2
        return tuple(jnp.where(self.seen, part, jnp.zeros_like(part)) for part in parts)


def test_gaussian_terms_are_exact_with_their_derivatives():
    rng = np.random.default_rng(7)
    x = jnp.asarray(np.concatenate([rng.random((5, 2)), rng.random((2, 2)).repeat(2, axis=0)]))
    y, noise, seen = rng.standard_normal(9), rng.uniform(0.3, 2.0, 9), np.arange(9) != 4
    new = jnp.asarray(rng.random((3, 2)))

    def propagated(theta, y, noise):
        kernel = RBF(theta, 1.3)
        posterior = ep(gram(kernel, x, x), Measured(y, noise, jnp.asarray(seen)))
        mean, explained = mean_and_explained(
            posterior.weights, posterior.factor, posterior.inverse, gram(kernel, x, new)
        )
        return jnp.concatenate([posterior.log_evidence[None], mean, 1.3 - explained])

    def expected(theta, y, noise):
        kernel = RBF(theta, 1.3)
        covariance = gram(kernel, x[seen], x[seen]) + jnp.diag(noise[seen] ** 2)
        cross = gram(kernel, x[seen], new)
        solved = jnp.linalg.solve(covariance, jnp.concatenate([y[seen][:, None], cross], axis=1))
        log_det = jnp.linalg.slogdet(2 * jnp.pi * covariance)[1]
        evidence = -0.5 * (y[seen] @ solved[:, 0] + log_det)
        return jnp.concatenate([evidence[None], cross.T @ solved[:, 0], 1.3 - jnp.sum(cross * solved[:, 1:], axis=0)])

    args = jnp.asarray(4.0), jnp.asarray(y), jnp.asarray(noise)

    def everything(function):
        slopes = (mode(function, (0, 1, 2))(*args) for mode in (jax.jacfwd, jax.jacrev))
        return jax.tree.leaves((function(*args), *slopes))

    pairs = zip(jax.jit(lambda: everything(propagated))(), jax.jit(lambda: everything(expected))(), strict=True)
    for one, other in pairs:
        np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-11)


# --- derivatives


def values(h, trials, x):
    """(7,): log evidence, and posterior mean and variance at three points, of (theta, variance, noise, thresholds)."""
    gp = OrdinalGP(RBF(h[0], h[1]), OrdinalProbit(h[3:], h[2]))
    posterior = fit(gp, trials, inference="ep", throw=False)
    return jnp.concatenate([posterior.log_evidence[None], *posterior.predict(x[:3])])


def evidence(h, trials, x):
    return values(h, trials, x)[0]


compiled = jax.jit(values)
derivatives = jax.jit(lambda *args: (jax.jacfwd(values)(*args), jax.jacrev(values)(*args)))
evidence_slope = jax.jit(jax.grad(evidence))
evidence_hessian = jax.jit(jax.jacfwd(jax.grad(evidence)))


def differences(fn, h):
    """Jacobian by central differences, extrapolated from three steps. With steps this long the values' rounding, 1e-13,
    costs 1e-10 of a slope; ten times shorter ones left up to 4e-9."""
    columns = []
    for j, value in enumerate(np.asarray(h)):
        steps = (step * abs(value) for step in (0.016, 0.008, 0.004))
        coarse, middle, fine = ((fn(h.at[j].add(s)) - fn(h.at[j].add(-s))) / (2 * s) for s in steps)
        columns.append((coarse - 20 * middle + 64 * fine) / 45)
    return np.stack(columns, axis=-1)


@pytest.mark.deep
@pytest.mark.parametrize("make", [near_separable, repeated])
def test_gradients_in_every_hyperparameter(make):
    """Evidence, means and variances, by both modes, with exactly repeated stimuli; second derivatives of the
    evidence, whose slope uses no derivative of the sites."""
    data = make()
    h = jnp.asarray([3.0, data.variance, data.noise, *data.thresholds])
    trials, x = answers(data), jnp.asarray(data.x_new)
    expected = differences(lambda h: compiled(h, trials, x), h)
    assert np.all(np.max(np.abs(expected), axis=0) > 1e-3)  # no hyperparameter is without effect
    for derivative in (*derivatives(h, trials, x), evidence_slope(h, trials, x)[None, :]):
        np.testing.assert_allclose(derivative, expected[: len(derivative)], rtol=1e-8, atol=1e-9)
    hessian = evidence_hessian(h, trials, x)
    slopes = differences(lambda h: evidence_slope(h, trials, x), h)
    np.testing.assert_allclose(hessian, slopes, rtol=1e-7, atol=1e-7 * np.max(np.abs(slopes)))


# --- shapes, batches, padding


def assert_same(one, other, rtol=1e-12):
    n = min(one.trials.capacity, other.trials.capacity, int(one.trials.mask.sum()))
    x = jnp.asarray(separated().x_new)
    np.testing.assert_allclose(one.log_evidence, other.log_evidence, rtol=rtol, atol=rtol)
    np.testing.assert_allclose(one.latent.mode[:n], other.latent.mode[:n], rtol=rtol, atol=rtol)
    np.testing.assert_allclose(one.predict(x), other.predict(x), rtol=rtol, atol=rtol)


@pytest.mark.deep  # by default those of Laplace, and people of unequal numbers of answers (test_aggregate.py)
@pytest.mark.parametrize("make", [repeated, near_separable])
def test_padded_equals_unpadded(make):
    data = make()
    bare = by_ep(data, len(data.q))
    full = answers(data)
    rubbish = Trials(jnp.where(full.mask[:, None], full.x, 0.77), jnp.where(full.mask, full.q, 2), full.mask)
    assert_same(bare, by_ep(data))
    assert_same(bare, fit(model(data), rubbish, inference="ep"))


@pytest.mark.deep
def test_a_batch_equals_a_loop():
    data = [make() for make in (separated, near_separable, repeated, repeated_19)]
    gp, trials = model(data[0]), [answers(each) for each in data]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *trials)
    batch = jax.jit(jax.vmap(lambda t: fit(gp, t, inference="ep", throw=False)))(stacked)
    for index, each in enumerate(trials):
        one = jax.tree.map(lambda leaf, i=index: leaf[i], batch)
        assert one.certificate.converged
        assert_same(one, fit(gp, each, inference="ep"))


def test_no_answers_give_exactly_the_prior():
    gp, x = OrdinalGP(RBF(3.0, 1.7), model(separated()).likelihood), jnp.asarray(separated().x_new)
    posterior = fit(gp, Trials.empty(25, 3), inference="ep")
    mean, variance = posterior.predict(x)
    assert posterior.log_evidence == 0.0
    np.testing.assert_array_equal(mean, np.zeros(len(x)))
    np.testing.assert_array_equal(variance, np.full(len(x), 1.7))
    assert posterior.certificate.converged and posterior.certificate.iterations <= 1


@pytest.mark.empties_caches
@pytest.mark.deep
def test_growing_data_are_traced_once_and_start_warm():
    data = noisy()
    gp, whole, weights = model(data), answers(data, 27), jnp.zeros(27)
    with assert_traces_once(ordinal_gp._fit, ordinal_gp._predict):
        for count in range(1, 26):
            posterior = fit(gp, whole.first(count), inference="ep", start=weights)
            weights = posterior.latent.weights
            posterior.predict(jnp.asarray(data.x_new))
    assert_same(posterior, fit(gp, whole, inference="ep"), rtol=1e-11)


@pytest.mark.parametrize("make", [separated, near_separable, repeated_19])
def test_a_warm_start_changes_the_steps_and_not_the_result(make):
    data = make()
    cold = by_ep(data)
    for start in (cold.latent.weights, fit(model(data), answers(data)).latent.weights):  # also Laplace's
        assert_same(by_ep(data, start=start), cold, rtol=1e-10)
    warm = by_ep(data, start=cold.latent.weights)
    assert warm.certificate.iterations < cold.certificate.iterations
    wild = 1e3 * jnp.asarray(np.random.default_rng(8).standard_normal(25))
    assert_same(by_ep(data, start=jnp.where(cold.trials.mask, wild, 0.0)), cold, rtol=1e-10)


@pytest.mark.deep
@pytest.mark.parametrize("make", [separated, repeated, near_separable])
def test_float32_against_float64(make):
    data, x = make(), make().x_new.astype(np.float32)
    low = fit(model(data, np.float32), answers(data, dtype=np.float32), inference="ep")
    high = by_ep(data)
    for method in ("predict", "class_probabilities"):
        predicted = getattr(low, method)(jnp.asarray(x))
        assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(predicted))
        np.testing.assert_allclose(predicted, getattr(high, method)(jnp.asarray(x.astype(float))), rtol=0, atol=1e-4)
    np.testing.assert_allclose(low.log_evidence, high.log_evidence, rtol=2e-5)


# --- hostile hyperparameters


HOSTILE = [case for case in hostile_cases() if len(case.q) <= 25]


@pytest.mark.parametrize("dtype", [np.float64, pytest.param(np.float32, marks=pytest.mark.deep)])
def test_a_part_of_the_hostile_grid(dtype):
    assert [(case.name, wrong) for case in HOSTILE[::4] if (wrong := complaint(case, dtype, "ep"))] == []


@pytest.mark.deep
def test_the_whole_hostile_grid():
    for case in hostile_cases():
        assert (case.name, complaint(case, np.float64, "ep")) == (case.name, "")


@pytest.mark.parametrize("noise", [1e-3, 1e-4])
def test_conflicting_repeats_at_tiny_noise(noise):
    """Ten answers on one stimulus, half lowest, half highest: the posterior is a normal around the middle."""
    x, q = np.full((10, 3), 0.4), np.tile([0, 2], 5)
    gp = OrdinalGP(RBF(30.0, 1.0), OrdinalProbit((-0.5, 0.5), noise))
    posterior = fit(gp, Trials.from_arrays(x, q, 25), inference="ep")
    mean, variance = posterior.predict(jnp.asarray(x[:1]))
    # -log p(f) = 5 (1 + 1/4 + f^2 ...) / noise^2: both edges are half a unit away, ten curvatures 1 / noise^2
    rounding = 1e-16 * np.sum(np.abs(posterior.latent.weights))
    np.testing.assert_allclose(mean, 0.0, atol=1e-3 * noise + 4 * rounding)
    np.testing.assert_allclose(variance, noise**2 / 10, rtol=1e-4)


def test_a_failed_fit_says_so():
    data = separated()
    gp = OrdinalGP(RBF(data.theta, data.variance), unchecked((0.5, -0.5), 0.5))  # out of order: NaN
    with pytest.raises(InferenceError, match=r"expectation propagation was not found: its log evidence is not finite"):
        fit(gp, answers(data), inference="ep")
    assert not fit(gp, answers(data), inference="ep", throw=False).certificate.converged
    kernel, full = model(data).kernel, answers(data)
    terms = TiltedTerms(model(data).likelihood, full.q, full.mask)
    stopped = jax.jit(lambda covariance: ep(covariance, terms, max_steps=2))(gram(kernel, full.x, full.x)).certificate
    assert stopped.iterations == 2 and not stopped.converged and stopped.residual > stopped.tolerance
