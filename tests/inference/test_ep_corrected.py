"""Corrected expectation propagation against cumulants by quadrature, differences of the evidence, and sampling."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from datasets import SMALL, near_separable, noisy, repeated, repeated_19, separated
from helpers import answers, model, unchecked
from reference_ep import second_order
from reference_exact import gram

from hilbo import RBF, OrdinalGP, OrdinalProbit, Trials, fit
from hilbo.errors import InputError
from hilbo.hyperparameters.maximum_evidence import maximise_evidence
from hilbo.ordinal_gp import InferenceError


def corrected(data, capacity=25, **options):
    return fit(model(data), answers(data, capacity), inference="ep_corrected", **options)


def reference(data, shift):
    """EP's log evidence and its correction by the textbook, with `shift` for the prior mean at the asked points."""
    edges = np.concatenate([[-np.inf], data.thresholds, [np.inf]])
    prior = gram(data.x, data.x, data.theta, data.variance)
    return np.array(second_order(prior, edges[data.q] - shift, edges[data.q + 1] - shift, data.noise))


@pytest.mark.parametrize("make", [repeated, pytest.param(near_separable, marks=pytest.mark.deep)])
def test_against_the_textbook(make):
    """Evidence by cumulants from quadrature; mean and covariance as the evidence's slope and bend in the prior mean,
    by finite differences: E f = h + K dlog Z/dh, Cov f = K + K d2 log Z_EP/dh2 K."""
    data, posterior = make(), corrected(make())
    plain = fit(model(data), answers(data), inference="ep")
    n, step = len(data.q), 1e-2
    along = np.random.default_rng(4).standard_normal(n)
    middle, *apart = (reference(data, scale * step * along) for scale in (0, -2, -1, 1, 2))
    np.testing.assert_allclose(plain.log_evidence, middle[0], rtol=0, atol=1e-7)
    np.testing.assert_allclose(posterior.log_evidence, sum(middle), rtol=0, atol=1e-7)
    assert abs(middle[1]) > 0.01
    slope = (sum(apart[0]) - 8 * sum(apart[1]) + 8 * sum(apart[2]) - sum(apart[3])) / (12 * step)
    np.testing.assert_allclose(posterior.latent.weights[:n] @ along, slope, rtol=2e-5)
    bend = (-apart[0][0] + 16 * apart[1][0] - 30 * middle[0] + 16 * apart[2][0] - apart[3][0]) / (12 * step**2)
    np.testing.assert_allclose(-along @ posterior.latent.inverse[:n, :n] @ along, bend, rtol=2e-5)
    assert abs(plain.latent.weights[:n] @ along - slope) > 2e-4 * abs(slope)  # and EP's own are not these
    assert abs(along @ plain.latent.inverse[:n, :n] @ along + bend) > 2e-4 * abs(bend)


@pytest.mark.parametrize("make", [pytest.param(make, marks=[pytest.mark.deep] * (make is noisy)) for make in SMALL])
def test_nearer_to_the_truth_in_every_respect(make):
    """Within .0006 in the mean (RMS) and .003 in the evidence at noise 0.5 or more; .0015 and .02 at noise 0.1."""
    data, gp = make(), model(make())
    truth, corrected_ep, plain = (fit(gp, answers(data), inference=name) for name in ("exact", "ep_corrected", "ep"))
    of_mean, of_sd, of_evidence = (0.0006, 0.002, 0.003) if data.noise >= 0.5 else (0.0015, 0.004, 0.02)

    def misses(posterior):
        (mean, variance), (true_mean, true_variance) = (
            np.asarray(each.predict(each.trials.x))[:, : len(data.q)] for each in (posterior, truth)
        )
        apart = mean - true_mean, np.sqrt(variance) - np.sqrt(true_variance)
        off = abs(float(posterior.log_evidence) - float(truth.log_evidence))
        return np.array([*(np.sqrt(np.mean(a**2)) for a in apart), off])

    sure = truth.certificate
    slack = 2 * np.array([sure.mean_error, sure.mean_error, sure.log_evidence_error])
    assert np.all(misses(corrected_ep) <= [of_mean, of_sd, of_evidence]), misses(corrected_ep)
    assert np.all(misses(corrected_ep) <= misses(plain) + slack)


@pytest.mark.deep
def test_root_and_covariance_agree_and_padding_has_no_part():
    for make in (separated, repeated_19):
        data, posterior = make(), corrected(make(), 29)
        latent, bare = posterior.latent, corrected(data, len(data.q)).latent
        scale = float(jnp.max(jnp.abs(latent.inverse)))
        np.testing.assert_allclose(latent.factor.T @ latent.factor, latent.inverse, rtol=0, atol=1e-12 * scale)
        np.testing.assert_array_equal(np.asarray(latent.weights)[len(data.q) :], 0.0)
        np.testing.assert_allclose(latent.weights[: len(data.q)], bare.weights, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(latent.log_evidence, bare.log_evidence, rtol=1e-12)


def test_no_answers_and_one_answer_are_expectation_propagation():
    gp, x = model(separated()), jnp.asarray(separated().x_new)
    nothing = fit(gp, Trials.empty(25, 3), inference="ep_corrected")
    assert nothing.log_evidence == 0.0 and nothing.certificate.converged
    np.testing.assert_array_equal(nothing.predict(x), [np.zeros(len(x)), np.ones(len(x))])
    one = Trials.from_arrays(np.array([[0.3, 0.2, 0.1]]), np.array([2]), 25)
    corrected_ep, expected = (fit(gp, one, inference=name) for name in ("ep_corrected", "ep"))
    np.testing.assert_allclose(corrected_ep.predict(x), expected.predict(x), rtol=0, atol=1e-14)
    np.testing.assert_allclose(corrected_ep.log_evidence, expected.log_evidence, rtol=1e-14)


@pytest.mark.deep
def test_a_batch_equals_a_loop():
    data = [make() for make in (separated, near_separable, repeated)]
    gp, trials = model(data[0]), [answers(each) for each in data]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *trials)
    batch = jax.jit(jax.vmap(lambda t: fit(gp, t, inference="ep_corrected", throw=False)))(stacked)
    for index, each in enumerate(trials):
        one = jax.tree.map(lambda leaf, i=index: leaf[i], batch)
        other = fit(gp, each, inference="ep_corrected")
        assert one.certificate.converged
        np.testing.assert_allclose(one.latent.weights, other.latent.weights, rtol=0, atol=1e-12)
        np.testing.assert_allclose(one.latent.factor, other.latent.factor, rtol=0, atol=1e-12)


def values(h, trials, x):
    """(5,): log evidence, and means and variances at two points, of (theta, variance, noise, thresholds)."""
    gp = OrdinalGP(RBF(h[0], h[1]), OrdinalProbit(h[3:], h[2]))
    posterior = fit(gp, trials, inference="ep_corrected", throw=False)
    return jnp.concatenate([posterior.log_evidence[None], *posterior.predict(x[:2])])


compiled = jax.jit(values)
HYPERPARAMETERS = jnp.asarray([3.0, 1.0, 0.1, -0.5, 0.5])


def difference(along, *data):
    """Of the values along a direction, by central differences of two steps."""

    def slope(s):
        above, below = (compiled(HYPERPARAMETERS + sign * s * along, *data) for sign in (1, -1))
        return (above - below) / (2 * s)

    return (4 * slope(1e-3) - slope(2e-3)) / 3


@pytest.mark.deep
def test_derivative_along_a_direction():
    along, data = jnp.asarray([1.0, -0.5, 0.03, 0.2, -0.1]), near_separable()
    args = answers(data), jnp.asarray(data.x_new)
    _, slope = jax.jit(lambda a: jax.jvp(lambda h: values(h, *args), (HYPERPARAMETERS,), (a,)))(along)
    np.testing.assert_allclose(slope, difference(along, *args), rtol=1e-7, atol=1e-8)


@pytest.mark.deep
def test_gradients_in_every_hyperparameter():
    data = near_separable()
    args = answers(data), jnp.asarray(data.x_new)
    expected = jnp.stack([difference(along, *args) for along in 0.05 * jnp.eye(5)], axis=-1) / 0.05
    np.testing.assert_allclose(jax.jit(jax.jacrev(values))(HYPERPARAMETERS, *args), expected, rtol=1e-6, atol=1e-7)


@pytest.mark.deep
def test_hyperparameters_can_be_learnt_by_it():
    learnt = maximise_evidence(model(noisy()), answers(noisy()), ("noise",), inference="ep_corrected", starts=1)
    assert learnt.converged


def test_a_failed_fit_says_so():
    with pytest.raises(InputError, match="the likelihood has 2 thresholds"):
        fit(model(separated()), Trials.from_arrays(np.zeros((1, 3)), np.array([3]), 25), inference="ep_corrected")
    wrong = OrdinalGP(RBF(3.0), unchecked((0.5, -0.5), 0.5))
    with pytest.raises(InferenceError, match=r"expectation propagation, corrected, was not found"):
        fit(wrong, answers(separated()), inference="ep_corrected")
