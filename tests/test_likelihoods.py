"""The ordinal probit against 25 digits: log p, its derivatives and class probabilities, in both tails and between.

The grid holds f within 100 noise units of a threshold, category widths of 1e-3 to 1e3 noise units (from 0.1 in
float32), and noises that are no powers of two; log p, gradient and curvature come from `jax.grad` taken twice.
"""

import math
from functools import cache

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pandas as pd
import pytest
from helpers import unchecked
from hypothesis import given, settings
from hypothesis import strategies as st
from mpmath import mp
from reference_laplace import ordinal_log_prob_mp
from scipy.special import log_ndtr

from hilbo.likelihoods import OrdinalProbit

DTYPES = [np.float64, np.float32]
OTHER_DTYPE_DEEP = [np.float64, pytest.param(np.float32, marks=pytest.mark.deep)]
FEW, MANY = 4, 22
"""Points of each width, noise and category: MANY take half a minute to compute at high precision."""
PARTS = [FEW, pytest.param(MANY, marks=pytest.mark.deep)]
NOISES = (1e-3, 0.1, 0.5, 0.7, math.pi, 10.0)
WIDTHS = (1e-3, 1e-2, 0.1, 0.5, 0.99, 1.01, 2.0, 5.0, 30.0, 1e3)
DISTANCES = np.array([0, 1e-9, 1e-3, 0.1, 0.5, 1, 2, 3, 4, 6, 8.3, 12, 20, 37.5, 38.6, 50, 75, 100])


def log_prob(f, q, thresholds, noise):
    return OrdinalProbit(thresholds, noise).log_prob(f, q)


gradient = jax.grad(log_prob)
second = jax.grad(gradient)
third = jax.grad(second)
by_parameters = jax.grad(log_prob, argnums=(2, 3))


@jax.jit
@jax.vmap
def evaluate(f, q, thresholds, noise):
    args = f, q, thresholds, noise
    return log_prob(*args), gradient(*args), -second(*args), third(*args), *by_parameters(*args)


@cache
def grid(dtype, part):
    """Arrays (f, q, thresholds, noise), `part` points of every width and noise in every category."""
    rng = np.random.default_rng(2)
    cases = []
    for noise in map(dtype, NOISES):
        for first in (0.3, -0.5):
            for width in WIDTHS if dtype is np.float64 else WIDTHS[2:]:
                t = np.array([first, first + width * noise], dtype)
                z = np.concatenate([DISTANCES, 10 ** rng.uniform(-2, 2, 8)])
                f = np.concatenate([edge + side * noise * z for edge in t for side in (-1, 1)]).astype(dtype)
                cases += [(s, q, t, noise) for q in range(3) for s in rng.choice(f, part, replace=False)]
    return tuple(map(np.array, zip(*cases, strict=True)))


@cache
def exact(dtype, part):
    """Of each case on the grid: log p, gradient and curvature as mpf, and the distance in noise units to its edge."""
    values = []
    for f, q, t, noise in zip(*grid(dtype, part), strict=True):
        lower, upper = np.array([-np.inf, *t, np.inf])[q : q + 2]
        nearest = min(abs(float(edge) - float(f)) for edge in (lower, upper)) / float(noise)
        values.append((*ordinal_log_prob_mp(f, lower, upper, noise, 25), nearest))
    return values


@cache
def evaluated(dtype, part):
    return [np.asarray(v) for v in evaluate(*map(jnp.asarray, grid(dtype, part)))]


def evaluate_few(f, q, t, noise):
    """`evaluate` of up to 12 cases by one program: they are repeated."""
    repeated = (np.resize(values, (12, *np.shape(values)[1:])) for values in (f, q, t, noise))
    return [np.asarray(values)[: len(f)] for values in evaluate(*repeated)]


def distance(value, target) -> float:
    return float(abs(mp.mpf(float(value)) - target))


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("dtype", OTHER_DTYPE_DEEP)
def test_log_prob_against_mpmath(dtype, part):
    smallest = np.finfo(dtype).tiny
    for value, (target, _, _, z) in zip(evaluated(dtype, part)[0], exact(dtype, part), strict=True):
        if abs(target) >= smallest:
            bound = 1e-12 if dtype is np.float64 else 1e-5 * max(1.0, z**2 / 100)
            assert distance(value, target) <= bound * abs(target)


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-10), (np.float32, 1e-4)])
def test_gradient_against_mpmath(dtype, tolerance, part):
    noise = grid(dtype, part)[3].astype(float)
    for value, (_, target, *_), c in zip(evaluated(dtype, part)[1], exact(dtype, part), noise, strict=True):
        assert distance(value, target) <= tolerance * max(abs(target), 1 / c)


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-9), (np.float32, 1e-3)])
def test_curvature_against_mpmath(dtype, tolerance, part):
    noise = grid(dtype, part)[3].astype(float)
    for value, (_, _, target, _), c in zip(evaluated(dtype, part)[2], exact(dtype, part), noise, strict=True):
        assert distance(value, target) <= tolerance / c**2


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("dtype", DTYPES)
def test_curvature_is_that_of_a_log_concave_function_and_all_is_finite(dtype, part):
    noise = grid(dtype, part)[3].astype(float)
    scaled = evaluated(dtype, part)[2] * noise**2
    assert scaled.min() >= 0.0
    assert scaled.max() <= 1 + 4 * np.finfo(dtype).eps
    assert all(np.all(np.isfinite(values)) for values in evaluated(dtype, part))


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-12), (np.float32, 1e-4)])
@pytest.mark.parametrize("noise", [1e-3, 0.5])
def test_a_certain_answer_keeps_the_digits_of_its_small_slope(dtype, tolerance, noise):
    """Relative, where the grid asks for 1/noise: with a wide prior the mode lies where this slope is all there is."""
    c = dtype(noise)
    for t in (np.array([-0.5, 0.5], dtype), np.array([-40, 0], dtype) * c):
        for q, edge, side in ((2, t[1], 1), (0, t[0], -1), (1, t[1], -1)):
            f = (edge + side * c * np.array([1.5, 3, 5, 8, 12])).astype(dtype)
            columns = evaluate_few(f, np.full(5, q), np.tile(t, (5, 1)), np.full(5, c))
            for s, slope, curvature in zip(f, columns[1], columns[2], strict=True):
                _, *targets = ordinal_log_prob_mp(s, *np.array([-np.inf, *t, np.inf])[q : q + 2], c, 60)
                for value, target in zip((slope, curvature), targets, strict=True):
                    assert distance(value, target) <= tolerance * abs(target)


def exact_slopes(f, q, t, noise):
    """d log p / d(t_0, t_1, noise), from densities at 60 digits beyond those that the difference of tails loses."""
    with mp.workdps(60):
        edges = [-mp.inf, *(mp.mpf(float(s)) for s in t), mp.inf]
        f, noise = mp.mpf(float(f)), mp.mpf(float(noise))
        log_p = ordinal_log_prob_mp(f, edges[q], edges[q + 1], noise, 50)[0]
        slopes, by_noise = [mp.mpf(0)] * 4, mp.mpf(0)
        for k, sign in ((q, -1), (q + 1, 1)):
            z = (edges[k] - f) / noise
            if not mp.isinf(z):
                slopes[k] = sign * mp.exp(-(z**2) / 2 - log_p) / mp.sqrt(2 * mp.pi) / noise
                by_noise -= z * slopes[k]
    return slopes[1], slopes[2], by_noise


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-10), (np.float32, 1e-4)])
def test_gradients_in_thresholds_and_noise_against_mpmath(dtype, tolerance, part):
    cases = list(zip(*grid(dtype, part), *evaluated(dtype, part)[4:], strict=True))[::7]
    for f, q, t, noise, by_thresholds, by_noise in cases:
        *slopes, slope = exact_slopes(f, q, t, noise)
        steepest = max(map(abs, slopes))  # a narrow category pulls its edges apart with much more than 1/noise
        for value, target in zip(by_thresholds, slopes, strict=True):
            assert distance(value, target) <= tolerance * max(steepest, 1 / float(noise))
        assert distance(by_noise, slope) <= tolerance * max(abs(slope), steepest, 1 / float(noise))


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-8), (np.float32, 1e-2)])
def test_third_derivative_against_differences_at_40_digits(dtype, tolerance, part):
    for f, q, t, noise, value in list(zip(*grid(dtype, part), evaluated(dtype, part)[3], strict=True))[::37]:
        edges, c = [-mp.inf, *t, mp.inf], float(noise)
        with mp.workdps(60):
            step = mp.mpf(c) * mp.mpf(10) ** -12

            def curvature(s, lower=edges[q], upper=edges[q + 1], noise=noise):
                return ordinal_log_prob_mp(s, lower, upper, noise, 50)[2]

            target = -(curvature(mp.mpf(float(f)) + step) - curvature(mp.mpf(float(f)) - step)) / (2 * step)
        assert distance(value, target) <= tolerance / c**3


@jax.jit
def slopes(h, q):
    """First derivatives in h = (f, t_0, t_1, noise), and the second in f."""
    args = h[0], q, h[1:3], h[3]
    by_thresholds, by_noise = by_parameters(*args)
    return jnp.concatenate([jnp.stack([gradient(*args), second(*args), by_noise]), by_thresholds])


curvatures = jax.jit(jax.jacfwd(slopes))


@pytest.mark.parametrize("q", [0, 1, 2])
def test_second_and_third_derivatives_in_everything(q):
    """The evidence gradient in thresholds and noise needs the mixed ones; each regime of the code has a case."""
    for f, width in ((-0.4, 0.18), (0.1, 1.2), (3.9, 0.54), (-1.2, 3.6)):
        h, step = np.array([f, -0.2, -0.2 + width, 0.6]), 3e-6
        moves = step * np.eye(4)
        expected = np.stack([(slopes(h + move, q) - slopes(h - move, q)) / (2 * step) for move in moves], axis=1)
        np.testing.assert_allclose(curvatures(h, q), expected, rtol=1e-7, atol=1e-7 * np.max(np.abs(expected)))


@pytest.mark.deep
def test_the_oracle_agrees_with_a_plain_difference_at_2500_digits():
    f, q, t, noise = grid(np.float64, FEW)
    for i in range(5, len(f), 40):
        lower, upper = [-mp.inf, *t[i], mp.inf][q[i] : q[i] + 2]
        with mp.workdps(2500):
            a, b = ((mp.mpf(edge) - mp.mpf(f[i])) / mp.mpf(noise[i]) for edge in (lower, upper))
            log_p = mp.log(mp.ncdf(b) - mp.ncdf(a))
            assert abs(exact(np.float64, FEW)[i][0] / log_p - 1) < mp.mpf(10) ** -24


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("noise", [1e-3, 0.7, 10.0])
def test_nothing_is_lost_far_outside(dtype, noise):
    """1e5 noise units away, p = exp(-5e9); the gradient is z/noise and the curvature 1/noise^2."""
    t, c = np.array([0.3, 0.3 + 2 * noise], dtype), dtype(noise)
    f = np.concatenate([t[0] - c * np.array([1e3, 1e5]), t[1] + c * np.array([1e3, 1e5])]).astype(dtype)
    f, q = (v.ravel() for v in np.meshgrid(f, np.arange(3)))
    values = evaluate_few(f, q, np.tile(t, (len(f), 1)), np.full(len(f), c))
    assert all(np.all(np.isfinite(v)) for v in values)
    assert np.all(values[0] <= 0.0)
    scaled = values[2].astype(float) * noise**2
    assert np.all((scaled >= 0) & (scaled <= 1 + 4 * np.finfo(dtype).eps))
    wrong = values[0] < -1.0
    away = np.where(f < t[0], t[q - 1] - f, t[np.minimum(q, 1)] - f)[wrong].astype(float)
    assert wrong.sum() == 8
    np.testing.assert_allclose(values[1][wrong], away / noise**2, rtol=1e-5)
    np.testing.assert_allclose(scaled[wrong], 1.0, rtol=1e-5)


@pytest.mark.parametrize("dtype", OTHER_DTYPE_DEEP)
def test_a_certain_answer_is_finite_without_the_compilers_help(dtype):
    """Operation by operation: XLA makes one exponential of two factors, which hides that they are 0 and infinite."""
    likelihood = OrdinalProbit(np.array([-0.3, 0.4], dtype), dtype(1.0))
    f = -(10 ** np.random.default_rng(4).uniform(2, 7, 50)).astype(dtype)
    with jax.disable_jit():
        assert all(np.all(value == 0) for value in jax.vmap(likelihood.expand, in_axes=(0, None))(f, 0))


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-15), (np.float32, 1e-6)])
@pytest.mark.parametrize(
    "categories", [pytest.param(count, marks=[pytest.mark.deep] * (count not in (2, 3, 10))) for count in range(2, 11)]
)
def test_class_probabilities_sum_to_one(dtype, tolerance, categories):
    rng = np.random.default_rng(categories)
    n, narrowest = 4000, -3 if dtype is np.float64 else -1
    noise = 10 ** rng.uniform(-3, 1, n)
    gaps = 10 ** rng.uniform(narrowest, 1, (n, categories - 1)) * noise[:, None]
    t = np.cumsum(gaps, axis=1) - rng.uniform(0, 1, (n, 1)) * gaps.sum(axis=1, keepdims=True)
    mean = rng.uniform(-3, 3, n) * noise * rng.choice([0.1, 1, 10], n)
    variance = rng.choice([0, 0.1, 1, 100], n) * noise**2
    arrays = [jnp.asarray(v.astype(dtype)) for v in (t, noise, mean, variance)]
    p = jax.jit(jax.vmap(lambda t, c, m, v: OrdinalProbit(t, c).class_probabilities(m, v)))(*arrays)
    assert p.shape == (n, categories) and p.dtype == dtype
    assert np.min(p) >= 0.0
    assert max(abs(math.fsum(row) - 1) for row in np.asarray(p, float)) <= tolerance


def test_class_probabilities_against_mpmath():
    t, noise = (-0.5, 0.4, 1.3), 0.7
    class_probabilities = jax.jit(lambda *moments: OrdinalProbit(t, noise).class_probabilities(*moments))
    for mean, variance in ((0.1, 0.0), (-2.3, 0.9), (30.0, 0.01), (0.8, 1e4)):
        spread = mp.sqrt(mp.mpf(noise) ** 2 + mp.mpf(variance))
        edges = [mp.ncdf((s - mp.mpf(mean)) / spread) for s in (-mp.inf, *map(mp.mpf, t), mp.inf)]
        expected = np.diff(np.array(edges, object)).astype(float)
        np.testing.assert_allclose(class_probabilities(mean, variance), expected, rtol=1e-12, atol=1e-15)


def test_a_blurred_answer_is_the_average_over_the_blur():
    """The closed form of section VI against quadrature of p(q | f) over f ~ N(0.2, 0.6)."""
    likelihood = OrdinalProbit((-0.5, 0.5), 0.5)
    nodes, weights = np.polynomial.hermite_e.hermegauss(80)
    f = jnp.asarray(0.2 + math.sqrt(0.6) * nodes)
    p = jax.jit(jax.vmap(lambda s: jnp.exp(jax.vmap(lambda q: likelihood.log_prob(s, q))(jnp.arange(3)))))(f)
    averaged = weights @ np.asarray(p) / math.sqrt(2 * math.pi)
    np.testing.assert_allclose(likelihood.class_probabilities(0.2, 0.6), averaged, rtol=1e-10)


small = st.floats(-60, 60)
evaluate_log_prob = jax.jit(lambda f, q, t, noise: log_prob(jnp.asarray(f), q, t, jnp.asarray(noise)))


@settings(deadline=None, max_examples=200)
@given(small, small, st.floats(0.05, 0.95), st.floats(1e-3, 50), st.floats(1e-3, 10), st.integers(0, 2))
def test_log_concave(f1, f2, share, width, noise, q):
    t = jnp.array([0.3, 0.3 + width])
    f1, f2 = f1 * noise, f2 * noise
    ends = [evaluate_log_prob(f, q, t, noise) for f in (f1, f2)]
    between = evaluate_log_prob(share * f1 + (1 - share) * f2, q, t, noise)
    chord = share * ends[0] + (1 - share) * ends[1]
    assert between >= chord - 1e-11 * max(1.0, abs(chord))


@settings(deadline=None, max_examples=100)
@given(small, st.floats(1e-3, 1e3), st.floats(1e-3, 10), st.integers(0, 2))
def test_mirror_symmetry(z, width, noise, q):
    """Turning the sign of f and of the thresholds turns the order of the categories and the sign of odd derivatives."""
    t, f = np.array([0.3, 0.3 + width * noise]), 0.3 + z * noise
    mirrored = -f, 2 - q, -t[::-1], noise
    values = [evaluate_few(*(np.asarray(v)[None] for v in args)) for args in ((f, q, t, noise), mirrored)]
    (p, g, w, s, by_t, by_c), (p_, g_, w_, s_, by_t_, by_c_) = values
    original = np.array([p, g * noise, w * noise**2, s * noise**3])
    turned = np.array([p_, -g_ * noise, w_ * noise**2, -s_ * noise**3])
    np.testing.assert_allclose(original, turned, rtol=1e-13, atol=1e-13)
    scale = np.max(np.abs(by_t))
    np.testing.assert_allclose(by_t, -by_t_[:, ::-1], rtol=0, atol=1e-13 * scale)
    np.testing.assert_allclose(by_c, by_c_, rtol=1e-13, atol=1e-13 * scale)


def test_two_categories_are_the_probit():
    probit = jax.jit(jax.vmap(OrdinalProbit((0.2,), 0.8).log_prob, in_axes=(0, None)))
    f = jnp.linspace(-30.0, 30.0, 61)
    for q, sign in ((0, -1.0), (1, 1.0)):
        expected = log_ndtr(sign * (np.asarray(f) - 0.2) / 0.8)
        computed = np.asarray(probit(f, q))
        zeroed = (np.abs(expected) < np.finfo(float).tiny) & (computed == 0.0)  # as older XLA does to subnormals
        np.testing.assert_allclose(computed[~zeroed], expected[~zeroed], rtol=1e-12)


@pytest.mark.parametrize(("thresholds", "noise"), [((0.5, -0.5), 0.5), ((-0.5, 0.5), -0.5), ((-0.5, 0.5), 0.0)])
def test_nonsense_gives_nan_and_no_plausible_number(thresholds, noise):
    assert np.isnan(unchecked(thresholds, noise).log_prob(0.0, 1))


@pytest.mark.parametrize("given", [np.array([-1, 1]), pd.Series([-1, 1]), jnp.array([-1, 1]), np.array([-1.0, 1.0])])
def test_whole_thresholds_are_the_same_thresholds(given, monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # who uses hilbo has no checks of types
    listed, other = OrdinalProbit([-1, 1], noise=1.9), OrdinalProbit(given, noise=1.9)
    assert other.thresholds.dtype == other.noise.dtype == np.float64
    assert other.thresholds.tolist() == listed.thresholds.tolist() and other.noise == listed.noise == 1.9
    assert OrdinalProbit(np.array([-1, 1], np.float32), 1.9).noise.dtype == np.float32


@pytest.mark.parametrize("zero", [0, np.int64(0), jnp.array(0)])
def test_a_whole_latent_value_is_the_same_value(zero):
    likelihood = OrdinalProbit((-0.5, 0.5), 0.7)
    assert float(likelihood.log_prob(zero, 1)) == float(likelihood.log_prob(0.0, 1))
    assert likelihood.class_probabilities(zero).tolist() == likelihood.class_probabilities(0.0).tolist()
