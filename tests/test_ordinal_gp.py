"""The model of one participant: gradients against 40 digits, padding, batches, dtypes, and what it refuses."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from datasets import near_separable, repeated, repeated_19, separated
from helpers import assert_traces_once, check_grad, unchecked
from oracles import oracle
from reference_laplace import mpmath_laplace

from hilbo import RBF, OrdinalGP, OrdinalProbit, Trials, fit, ordinal_gp
from hilbo.errors import InputError, InputRemark
from hilbo.gaussian import shortfall
from hilbo.ordinal_gp import InferenceError
from tests.vectors.laplace import CASES, PER_DIMENSION, SCALAR, hyperparameters, unpack

CAPACITY = 25


def model(data, theta=None) -> OrdinalGP:
    kernel = RBF(data.theta if theta is None else theta, data.variance)
    return OrdinalGP(kernel, OrdinalProbit(data.thresholds, data.noise))


def answers(data, capacity: int = CAPACITY) -> Trials:
    return Trials.from_arrays(data.x, data.q, capacity)


def values(h, trials, x_new):
    """(7,): log evidence, and posterior mean and variance at the first three new points."""
    theta, variance, noise, thresholds = unpack(h)
    kernel = RBF(jnp.stack(theta) if isinstance(theta, list) else theta, variance)
    gp = OrdinalGP(kernel, OrdinalProbit(jnp.stack(thresholds), noise))
    posterior = fit(gp, trials, throw=False)
    return jnp.concatenate([posterior.log_evidence[None], *posterior.predict(x_new[:3])])


reverse = jax.jit(jax.jacrev(values))
forward = jax.jit(jax.jacfwd(values))
evidence_hessian = jax.jit(jax.jacfwd(jax.grad(lambda *args: values(*args)[0])))


def arguments(make, theta):
    data = make()
    return jnp.asarray(hyperparameters(data, theta)), answers(data), jnp.asarray(data.x_new)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.deep] * ("per dimension" in name)) for name in CASES]
)
def test_gradients_in_every_hyperparameter(name):
    """Of evidence, means and variances, with exactly repeated stimuli, by both modes under jit."""
    expected = oracle("laplace_slopes")[name]
    assert np.all(np.max(np.abs(expected), axis=0) > 1e-3)  # no hyperparameter is without effect
    for derivative in (reverse, forward):
        slopes = np.asarray(derivative(*arguments(*CASES[name])))
        scale = np.maximum(np.abs(expected), 1e-3 * np.max(np.abs(expected), axis=0))
        assert np.max(np.abs(slopes - expected) / scale) < 1e-8


def test_gradients_under_vmap():
    h, trials, x_new = arguments(repeated, SCALAR)
    several = jnp.asarray(np.asarray(h) * np.array([[1.0], [1.1], [0.7]]))
    batch = jax.jit(jax.vmap(jax.jacrev(values), in_axes=(0, None, None)))(several, trials, x_new)
    for row, one in zip(batch, several, strict=True):
        np.testing.assert_allclose(row, reverse(one, trials, x_new), rtol=1e-10, atol=1e-11)
    np.testing.assert_allclose(batch[0], oracle("laplace_slopes")["repeated"], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("theta", [SCALAR, pytest.param(PER_DIMENSION, marks=pytest.mark.deep)])
def test_second_derivatives_of_the_evidence(theta):
    h, *data = arguments(repeated, theta)
    hessian = np.asarray(evidence_hessian(h, *data))
    steps = 1e-5 * np.diag(np.asarray(h))
    rise = [np.asarray(reverse(h + s, *data)[0] - reverse(h - s, *data)[0]) for s in steps]
    expected = np.stack(rise, axis=1) / (2 * np.diag(steps))
    np.testing.assert_allclose(hessian, hessian.T, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(hessian, expected, rtol=1e-4, atol=1e-6)


def test_gradients_in_the_asked_point():
    data = repeated()
    posterior = fit(model(data), answers(data))
    check_grad(jax.jit(lambda x: jnp.stack(posterior.predict(x[None]), axis=0)[:, 0]), data.x_new[1])


def assert_same(one, other, rtol=1e-12):
    """Two posteriors agree in evidence, mode, mean and variance."""
    n = min(one.trials.capacity, other.trials.capacity, int(one.trials.mask.sum()))
    x = jnp.asarray(separated().x_new)
    np.testing.assert_allclose(one.log_evidence, other.log_evidence, rtol=rtol, atol=rtol)
    modes = (np.asarray(each.latent.mode)[:n] for each in (one, other))
    np.testing.assert_allclose(*modes, rtol=rtol, atol=rtol)
    np.testing.assert_allclose(one.predict(x), other.predict(x), rtol=rtol, atol=rtol)


# --- fixed capacity


def test_no_answers_give_exactly_the_prior():
    data = separated()
    gp, x = OrdinalGP(RBF(SCALAR, 1.7), model(data).likelihood), jnp.asarray(data.x_new)
    posterior = fit(gp, Trials.empty(CAPACITY, 3))
    mean, variance = posterior.predict(x)
    assert posterior.log_evidence == 0.0
    np.testing.assert_array_equal(mean, np.zeros(len(x)))
    np.testing.assert_array_equal(variance, np.full(len(x), 1.7))
    np.testing.assert_array_equal(posterior.class_probabilities(x)[0], gp.likelihood.class_probabilities(0.0, 1.7))
    assert posterior.certificate.converged
    assert posterior.certificate.iterations <= 1
    slopes = np.asarray(reverse(jnp.asarray(hyperparameters(data, SCALAR)), Trials.empty(CAPACITY, 3), x))
    np.testing.assert_array_equal(slopes, np.outer([0, 0, 0, 0, 1, 1, 1], [0, 1, 0, 0, 0]))


@pytest.mark.parametrize("category", [0, 1, 2])
def test_one_category_only(category):
    data = separated()
    q = np.full(len(data.q), category)
    posterior = fit(model(data), Trials.from_arrays(data.x, q, CAPACITY))
    exact = mpmath_laplace(data.x, q, *data.problem()[2:], digits=25)
    assert posterior.certificate.converged
    np.testing.assert_allclose(
        posterior.predict(jnp.asarray(data.x_new)),
        [exact["mean"].astype(float), exact["variance"].astype(float)],
        rtol=1e-12,
        atol=1e-12,
    )
    np.testing.assert_allclose(posterior.log_evidence, float(exact["log_evidence"]), rtol=1e-12)


@pytest.mark.parametrize("make", [repeated, pytest.param(near_separable, marks=pytest.mark.deep)])
def test_padded_equals_unpadded(make):
    data = make()
    bare = fit(model(data), answers(data, len(data.q)))
    assert_same(bare, fit(model(data), answers(data)))
    full = answers(data)
    x, q, mask = map(np.asarray, (full.x, full.q, full.mask))
    rubbish = Trials(jnp.asarray(np.where(mask[:, None], x, 0.77)), jnp.asarray(np.where(mask, q, 2)), full.mask)
    assert_same(bare, fit(model(data), rubbish))


def test_default_capacity_is_a_multiple_of_32():
    for count, capacity in ((0, 32), (1, 32), (32, 32), (33, 64)):
        assert Trials.from_arrays(np.zeros((count, 2)), np.zeros(count, int)).capacity == capacity


def test_a_batch_equals_a_loop():
    data = [make() for make in (separated, near_separable, repeated, repeated_19)]
    gp = model(data[0], theta=12.0)
    trials = [answers(each) for each in data]
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *trials)
    batch = jax.jit(jax.vmap(lambda t: fit(gp, t, throw=False)))(stacked)
    for index, each in enumerate(trials):
        one = jax.tree.map(lambda leaf, i=index: jnp.asarray(np.asarray(leaf)[i]), batch)
        assert one.certificate.converged
        assert_same(one, fit(gp, each))


@pytest.mark.parametrize("make", [separated, repeated, near_separable])
def test_float32_against_float64(make):
    """Four digits of the prior's standard deviation, in mean, variance, evidence and class probabilities."""
    data = make()
    low = fit(model(data), Trials.from_arrays(data.x.astype(np.float32), data.q, CAPACITY))
    high = fit(model(data), answers(data))
    x = data.x_new.astype(np.float32)
    for method in ("predict", "class_probabilities"):
        predicted = getattr(low, method)(jnp.asarray(x))
        assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(predicted))
        np.testing.assert_allclose(predicted, getattr(high, method)(jnp.asarray(x.astype(float))), rtol=0, atol=5e-5)
    np.testing.assert_allclose(low.log_evidence, high.log_evidence, rtol=2e-5)


def test_the_parts_of_a_prediction_agree():
    data = repeated()
    posterior, x = fit(model(data), answers(data)), jnp.asarray(data.x_new)
    mean, variance = posterior.predict(x)
    same_mean, explained = posterior.predict_explained(x)
    np.testing.assert_array_equal(mean, same_mean)
    np.testing.assert_allclose(mean, posterior.mean(x), rtol=1e-14, atol=1e-15)
    np.testing.assert_array_equal(variance, data.variance - np.asarray(explained))
    expected = [posterior.gp.likelihood.class_probabilities(m, v) for m, v in zip(mean, variance, strict=True)]
    np.testing.assert_allclose(posterior.class_probabilities(x), np.stack(expected), rtol=1e-14)


# --- what is refused


@pytest.mark.parametrize(
    ("x", "q", "capacity", "message"),
    [
        (np.zeros((3, 2)), np.zeros(2, int), None, r"x has shape \(3, 2\) and q has shape \(2,\); give x as"),
        (np.zeros(3), np.zeros(3, int), None, r"x has shape \(3,\) .* give x as \(n, d\)"),
        (np.array([[0.0], [np.nan]]), np.zeros(2, int), None, r"x\[1\] has a value that is not finite"),
        (np.array([[np.inf], [0.0]]), np.zeros(2, int), None, r"x\[0\] has a value that is not finite"),
        (np.zeros((2, 1)), np.array([0.0, 1.0]), None, "q must contain the categories as integers from 0"),
        (np.zeros((2, 1)), np.array([0, -1]), None, "q must contain the categories as integers from 0"),
        (np.zeros((2, 1)), np.zeros(2, int), 1, "capacity is 1, but 2 answers need at least 2"),
        (np.zeros((0, 1)), np.zeros(0, int), 0, "capacity is 0, but 0 answers need at least 1"),
    ],
)
def test_bad_trials_are_refused_in_a_sentence(x, q, capacity, message):
    with pytest.raises(InputError, match=message):
        Trials.from_arrays(x, q, capacity)


def test_points_in_physical_units_get_a_warning():
    """They fit and predict without an error: hardly correlated answers, and the prior."""
    gp = model(repeated())
    with pytest.warns(InputRemark, match=r"fit: x\[1\] is \[5.7, 0.2\], outside the unit cube") as of_fit:
        fit(gp, Trials.from_arrays(np.array([[0.1, 0.2], [5.7, 0.2]]), np.zeros(2, int)))
    posterior = fit(gp, answers(repeated()))
    with pytest.warns(InputRemark, match="Posterior: x.0. is .* outside the unit cube") as of_points:
        posterior.predict(np.full((1, posterior.trials.x.shape[1]), 5.7))
    assert {warning.filename for warning in (*of_fit, *of_points)} == {__file__}  # the user's own line
    fit(gp, Trials.from_arrays(np.array([[1 + 1e-6, 0.0], [-1e-6, 1.0]]), np.zeros(2, int)))  # rounding


def test_an_unknown_inference_is_refused():
    with pytest.raises(InputError, match='inference is "magic"; it must be one of laplace, ep, ep_corrected, exact'):
        fit(model(repeated()), answers(repeated()), inference="magic")


def test_one_answer_too_many_is_not_forgotten_in_silence():
    data = separated()
    trials = answers(data, CAPACITY)
    while not trials.mask.all():
        trials = trials.append(jnp.full(3, 0.5), 2)
    with pytest.raises(InputError, match=f"all {CAPACITY} rows have a response; make it with a larger capacity"):
        trials.append(jnp.full(3, 0.5), 2)
    full = jax.jit(lambda trials: trials.append(jnp.full(3, 0.5), 2))(trials)  # traced, nobody knows that it is full
    assert np.all(np.isnan(full.x))
    with pytest.raises(InputError, match=r"x\[0\] of the trials is not finite"):
        fit(model(data), full)


def test_a_failed_fit_says_so():
    data = separated()
    gp = OrdinalGP(RBF(data.theta, data.variance), unchecked((0.5, -0.5), 0.5))  # out of order: NaN
    with pytest.raises(InferenceError, match=r"mode was not found: its residual is .* after \d+ steps and should be"):
        fit(gp, answers(data))
    assert not fit(gp, answers(data), throw=False).certificate.converged
    with pytest.raises(Exception, match="read the certificate") as caught:
        jax.block_until_ready(eqx.filter_jit(lambda t: fit(gp, t).log_evidence)(answers(data)))
    assert not isinstance(caught.value, InferenceError)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"residual": 1.0}, "not found: its residual is 1 after"),
        ({"smallest_variance": 0.0}, "but the responses leave too small"),
        ({"evidence_error": 7.0}, "not closely enough for its evidence, whose error is up to 7"),
        ({}, "not closely enough for the mean"),
    ],
)
def test_the_figure_that_failed_is_the_one_that_is_named(changed, words):
    posterior = fit(model(separated()), answers(separated()))
    figures = {name: jnp.asarray(value) for name, value in changed.items()}
    certificate = dataclasses.replace(posterior.certificate, **figures)
    assert words in shortfall(certificate, posterior.log_evidence)
    assert "its log evidence is not finite" in shortfall(posterior.certificate, jnp.asarray(jnp.nan))


def test_a_category_that_the_model_lacks_is_named():
    gp = OrdinalGP(RBF(30.0, 1.0), OrdinalProbit((-0.5, 0.5), 0.5))
    trials = Trials.from_arrays(np.full((2, 3), 0.5), np.array([1, 3]), CAPACITY)
    with pytest.raises(InputError, match="an answer has category 3, but the likelihood has 2 thresholds and so"):
        fit(gp, trials)


@pytest.mark.parametrize(("seed", "theta", "noise"), [(13, 0.1, 1e-3), (19, 0.1, 3e-3), (19, 0.03, 3e-4)])
def test_the_rounding_of_the_log_posterior_stops_no_search(seed, theta, noise):
    """Where the noise is small, eta's rounding times the slopes is what the log posterior is rounded by."""
    x = np.random.default_rng(seed).random((25, 3))
    away = np.linalg.norm(x - 0.2, axis=1)
    trials = Trials.from_arrays(x, (away < 0.6).astype(int) + (away < 0.3), 25)
    certificate = fit(OrdinalGP(RBF(theta, 1.0), OrdinalProbit((-0.5, 0.5), noise)), trials).certificate
    assert certificate.residual <= certificate.tolerance and certificate.iterations <= 60


@pytest.mark.empties_caches
def test_growing_data_are_traced_once():
    data = repeated_19()
    gp, trials, whole = model(data), Trials.empty(27, 3), answers(data, 27)

    @jax.jit
    def append_one(trials, x, q):
        return trials.append(x, q)

    x_new, weights = jnp.asarray(data.x_new), None
    with assert_traces_once(ordinal_gp._fit, ordinal_gp._predict, append_one):
        for count, (x, q) in enumerate(zip(data.x, data.q, strict=True), start=1):
            trials = append_one(trials, jnp.asarray(x), jnp.asarray(q))
            posterior = fit(gp, trials, start=jnp.zeros(27) if weights is None else weights)
            weights = posterior.latent.weights
            posterior.predict(x_new)
            kept = whole.first(count)
            np.testing.assert_array_equal(trials.mask, kept.mask)
            np.testing.assert_array_equal(np.asarray(trials.x)[:count], np.asarray(kept.x)[:count])
            np.testing.assert_array_equal(np.asarray(trials.q)[:count], np.asarray(kept.q)[:count])
    assert_same(posterior, fit(gp, whole), rtol=1e-11)
