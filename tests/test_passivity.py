"""The closed passivity bounds against the frequency response, the numbers of the paper, and each other."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.stats import qmc

from hilbo import passivity, viscoelastic
from hilbo.mechanics import cosine_polynomials
from hilbo.viscoelastic import FOSLS

SETS = ((-2.89, 5.70, 5.89, 0.203), (-3.18, 5.58, 7.88, 0.176), (-5.01, 8.44, 10.28, 0.282))
B1s, orders = st.floats(0.001, 32), st.floats(0.01, 0.99)


@pytest.mark.parametrize(("printed", "damping"), list(zip(SETS, (0.91664, 0.76288, 1.34452), strict=True)))
def test_damping_of_the_published_sets_with_their_printed_K0(printed, damping):
    K_eff = viscoelastic.dc_gain(*printed)
    assert passivity.minimum_damping(*printed[1:], K_eff) == pytest.approx(damping, abs=5e-6)


@pytest.mark.parametrize(("printed", "damping"), list(zip(SETS, (0.91502, 0.75981, 1.34159), strict=True)))
def test_damping_of_the_published_sets_with_K_eff(printed, damping):
    assert passivity.minimum_damping(*printed[1:]) == pytest.approx(damping, abs=5e-6)


@pytest.mark.parametrize(("b", "K1"), [(0.836, 6.102), (0.9165, 6.643), (0.95, 6.867), (1.0, 7.198)])
def test_largest_K1_at_the_aggregate_optimum(b, K1):
    assert passivity.largest_K1(7.88, 0.176, b) == pytest.approx(K1, abs=5e-4)


@pytest.mark.parametrize(("b", "share"), [(0.5, 12.3), (0.917, 23.3), (0.95, 24.1), (1, 25.1), (2, 42.2), (5, 73.7)])
def test_passive_share_of_the_box(b, share):
    K1, B1, alpha = qmc.scale(qmc.Sobol(3, rng=0).random(2**15), (1, 0.001, 0.01), (32, 32, 0.99)).T
    passive = passivity.minimum_damping(K1, B1, alpha) <= b
    assert 100 * np.mean(passive) == pytest.approx(share, abs=0.2)
    np.testing.assert_array_equal(passive, passivity.largest_K1(B1, alpha, b) >= K1)


@pytest.mark.parametrize("N", [1, 25, 101])
@pytest.mark.parametrize("T", [1e-3, 2e-4])
def test_nyquist_binds_among_all_frequencies(N, T):
    rng = np.random.default_rng(N)
    angle = np.linspace(1e-3, np.pi, 4001)
    z = np.exp(-1j * np.outer(angle, np.arange(N + 1)))
    for K1, B1, alpha in rng.uniform((1, 0.001, 0.01), (32, 32, 0.99), (20, 3)):
        pot = B1 * T**-alpha * (z @ np.asarray(viscoelastic.gl_coefficients(alpha, N)))
        K0 = float(viscoelastic.K0_from_effective_stiffness(K1, B1, alpha, 0.44, N, T))
        response = K0 + K1 * pot / (K1 + pot)
        needed = 1000 * T / 2 / (1 - np.cos(angle)) * ((1 - np.exp(-1j * angle)) * response).real
        bound = passivity.minimum_damping(K1, B1, alpha, 0.44, N, T)
        assert needed.max() == pytest.approx(float(bound), rel=1e-12)


@settings(deadline=None)
@given(B1s, orders, st.floats(0.23, 40), st.sampled_from([1, 25, 101]), st.floats(1e-4, 2e-3))
def test_each_bound_is_the_inverse_of_the_other(B1, alpha, b, N, T):
    K1 = passivity.largest_K1(B1, alpha, b, 0.44, N, T)
    assume(0 < K1 < np.inf)
    assert passivity.minimum_damping(K1, B1, alpha, 0.44, N, T) == pytest.approx(b, rel=1e-10)


@settings(deadline=None)
@given(st.floats(0.1, 32), st.floats(0.1, 32), orders)
def test_single_precision_keeps_six_digits_of_the_damping(K1, B1, alpha):
    K1, B1, alpha = np.float32(K1), np.float32(B1), np.float32(alpha)
    single = passivity.minimum_damping(K1, B1, alpha)
    assert single.dtype == np.float32
    assert single == pytest.approx(float(passivity.minimum_damping(float(K1), float(B1), float(alpha))), rel=5e-6)
    limit = passivity.largest_K1(B1, alpha, np.float32(0.95))
    assert limit.dtype == np.float32
    if np.isfinite(limit):
        assert passivity.minimum_damping(limit, B1, alpha) == pytest.approx(0.95, rel=5e-6)


def test_the_limit_grows_to_infinity_and_shrinks_to_nothing_without_a_jump():
    unlimited = float(passivity.minimum_damping(1e300, 7.88, 0.176))
    below = passivity.largest_K1(7.88, 0.176, unlimited * (1 - np.array([1e-3, 1e-6, 1e-9, 1e-12])))
    assert np.all(np.diff(below) > 0)
    np.testing.assert_allclose(below[1:] / below[:-1], 1e3, rtol=2e-3)
    assert passivity.largest_K1(7.88, 0.176, unlimited * (1 + 1e-12)) == np.inf
    above = passivity.largest_K1(7.88, 0.176, 0.22 * (1 + np.array([1e-12, 1e-9, 1e-6])))
    assert np.all((above > 0) & (above < 1e-2)) and np.all(np.diff(above) > 0)


@pytest.mark.parametrize("b", [0.1, 0.22])
def test_nothing_is_passive_without_room_above_the_effective_stiffness(b):
    assert passivity.largest_K1(7.88, 0.176, b) == 0


def test_a_negative_static_stiffness_is_never_passive():
    assert passivity.minimum_damping(5.0, 7.88, 0.176, K_eff=-0.01) == np.inf
    assert passivity.largest_K1(7.88, 0.176, 10.0, K_eff=-0.01) == 0


@pytest.mark.parametrize("argument", range(3))
@pytest.mark.parametrize("f", [passivity.minimum_damping, passivity.largest_K1])
def test_gradients_match_finite_differences(f, argument):
    point = [5.58, 7.88, 0.176] if f is passivity.minimum_damping else [7.88, 0.176, 0.95]

    def along(x):
        return f(*point[:argument], x, *point[argument + 1 :])

    h = 1e-5 * point[argument]
    difference = (along(point[argument] + h) - along(point[argument] - h)) / (2 * h)
    assert jax.grad(along)(point[argument]) == pytest.approx(float(difference), rel=1e-7)


@pytest.mark.parametrize("b", [0.1, 0.22, 40.0])
def test_gradients_are_zero_where_the_limit_is_infinite_or_nothing(b):
    assert jax.grad(passivity.largest_K1, (0, 1, 2))(7.88, 0.176, b) == (0, 0, 0)


@pytest.mark.parametrize("call", [passivity.minimum_damping, passivity.largest_K1])
def test_even_N_is_refused(call):
    with pytest.raises(ValueError, match="odd"):
        call(1.0, 1.0, 0.5, N=100)


def model_of(K1, B1, alpha, N=101, memory="short"):
    K0 = viscoelastic.K0_from_effective_stiffness(K1, B1, alpha, 0.44, N, memory=memory)
    return FOSLS(K0, K1, B1, alpha, N=N, memory=memory)


def random_sets(count, seed=0):
    points = qmc.Sobol(3, rng=seed).random(2 ** (count - 1).bit_length())[:count]
    return qmc.scale(points, (1, 0.001, 0.01), (32, 32, 0.99)).T


@functools.partial(jax.jit, static_argnames=("N", "memory", "angles"))
def certified(K1, B1, alpha, b, N=101, memory="short", angles=0):
    """Lower and upper bound of the margin and frequency of each set; the least margin on a grid of frequencies."""

    def one(q):
        model = model_of(*q[:3], N=N, memory=memory)
        certificate = passivity.certify(model, q[3])
        grid = jnp.linspace(0, np.pi / model.T, angles) if angles else jnp.zeros(1)
        return (
            certificate.lower,
            certificate.upper,
            certificate.frequency,
            q[3] - jnp.max(passivity.needed_damping(model, grid)),
        )

    return jax.lax.map(one, (K1, B1, alpha, jnp.broadcast_to(b, K1.shape)), batch_size=32)


def disagreements(count, N=101):
    K1, B1, alpha = random_sets(count)
    lower, upper, frequency, _ = map(np.asarray, certified(K1, B1, alpha, 0.95, N))
    closed = 0.95 - np.asarray(passivity.minimum_damping(K1, B1, alpha, 0.44, N))
    undecided = (lower <= 0) & (upper > 0)
    assert np.all(undecided | ((lower > 0) == (closed > 0)))
    assert np.all((lower <= closed) & (closed <= upper)) and np.max(upper - lower) <= 1e-11
    np.testing.assert_allclose(frequency, np.pi * 1e3)
    return undecided.sum()


@pytest.mark.parametrize("N", [101, *(pytest.param(N, marks=pytest.mark.deep) for N in (1, 25))])
def test_the_certificate_agrees_with_the_closed_form(N):
    assert disagreements(128, N) == 0


@pytest.mark.deep
@pytest.mark.release
def test_the_certificate_agrees_with_the_closed_form_on_twenty_thousand_sets():
    undecided = disagreements(20_000)
    print(f"{undecided} of 20,000 sets undecided")
    assert undecided == 0


def test_only_the_rounding_of_the_boundary_is_undecided():
    _, B1, alpha = random_sets(128, 1)
    K1 = np.asarray(passivity.largest_K1(B1, alpha))
    limited = np.isfinite(K1) & (K1 > 0)
    K1 = np.where(limited, K1, 1.0)
    below = certified(K1 * (1 - 1e-10), B1, alpha, 0.95, 101)
    above = certified(K1 * (1 + 1e-10), B1, alpha, 0.95, 101)
    decided = (np.asarray(below[0]) > 0) & (np.asarray(above[1]) <= 0)
    # b hardly depends on K1 where the pot is much the softer: there 1e-10 of K1 is less than rounding.
    soft = B1 * 1e-3**-alpha < 0.1 * K1
    assert np.all((decided | soft)[limited]) and np.mean(decided[limited]) > 0.9


def test_a_cell_is_bounded_from_below_and_closely():
    """Random cosine polynomials, on cells so wide that the remainder counts."""
    rng, cells = np.random.default_rng(0), 16
    nodes, radius = np.arange(cells + 1) * np.pi / cells, np.pi / cells / 2
    inside = nodes[:, None] + np.linspace(-radius, radius, 201)[None, :]

    @jax.jit
    def bounded(p):
        rows = cosine_polynomials.rows(p, 9)
        taylor, fine = cosine_polynomials.on_grid(rows, cells), cosine_polynomials.at_angles(rows, nodes)
        coarse = cosine_polynomials.lowest(taylor, jnp.asarray(radius), rows)
        return taylor, fine, coarse, cosine_polynomials.lowest(fine, jnp.asarray(1e-3), rows)

    for _ in range(20):
        p = rng.normal(size=8)
        taylor, fine, coarse, bound = map(np.asarray, bounded(p))
        np.testing.assert_allclose(taylor, fine, atol=1e-12)
        least = np.polynomial.chebyshev.chebval(np.cos(inside), p).min(axis=1)
        assert np.all(coarse <= least + 1e-12) and np.max(least - coarse) < 2 * np.abs(p).sum()
        ends = np.polynomial.chebyshev.chebval(np.cos(nodes[:, None] + np.array([[-1e-3, 0, 1e-3]])), p).min(axis=1)
        assert np.all(bound <= ends + 1e-12) and np.max(ends - bound) < 1e-4


@pytest.mark.parametrize("N", [2, pytest.param(100, marks=pytest.mark.deep)])
def test_even_N_is_decided_by_the_certificate(N):
    K1, B1, alpha = random_sets(128, 2)
    lower, upper, _, on_grid = map(np.asarray, certified(K1, B1, alpha, 0.95, N, angles=4097))
    assert np.all(lower <= on_grid) and np.all(upper <= on_grid + 1e-11) and np.min(upper - on_grid) > -1e-3
    assert np.max(upper - lower) <= 1e-4 and np.median(upper - lower) <= 1e-11
    assert np.all((lower > 0) | (upper <= 0))
    at_nyquist = 0.95 - np.asarray(jax.vmap(lambda *q: 0.5 * model_of(*q, N=N).high_frequency_gain())(K1, B1, alpha))
    needed, closed = 0.95 - upper, 0.95 - at_nyquist
    assert np.all(needed >= closed * (1 - 1e-9)) and np.max(needed / closed) > 1 + 1e-5


def test_the_certificate_at_the_limits_of_the_model():
    """Spring-pot, Kelvin-Voigt, spring and SLS, with the closed forms of their H(-1)."""
    for model, damping in (
        (viscoelastic.spring(2.0), 1.0),
        (viscoelastic.kelvin_voigt(2.0, 0.001), 0.5 * (2 + 2 * 1.0)),
        (viscoelastic.sls(2.0, 5.0, 0.001), 0.5 * (2 + 5 * 2 / 7)),
    ):
        certificate = passivity.certify(model, 4.0)
        assert certificate.lower <= 4 - damping <= certificate.upper + 1e-13 and certificate.status == "passive"
        assert passivity.certify(model, damping * 0.999).status == "violated"


def test_a_negative_static_stiffness_is_a_violation_of_its_own():
    certificate = passivity.certify(FOSLS(-0.1, 1.0, 0.001, 0.9), 10.0)
    assert (
        certificate.lower > 0
        and certificate.status == "violated"
        and passivity.witness(FOSLS(-0.1, 1.0, 0.001, 0.9), 10.0) is None
    )


@pytest.mark.parametrize("b", [0.5, 0.95, 2.0])
def test_full_memory_binds_at_nyquist(b):
    K1, B1, alpha = random_sets(128, 3)
    lower, upper, _, on_grid = map(np.asarray, certified(K1, B1, alpha, b, memory="full", angles=2049))
    closed = b - np.asarray(passivity.minimum_damping(K1, B1, alpha, memory="full"))
    np.testing.assert_allclose(closed, on_grid, rtol=1e-10, atol=1e-12)
    assert np.all((lower <= closed) & (closed <= upper))
    limit = np.asarray(passivity.largest_K1(B1, alpha, b, memory="full"))
    np.testing.assert_array_equal(limit >= K1, closed >= 0)


@pytest.mark.parametrize(
    ("N", "memory"),
    [(101, "short"), (101, "full"), *(pytest.param(N, "short", marks=pytest.mark.deep) for N in (100, 2))],
)
def test_a_witness_creates_the_energy_of_the_formula(N, memory):
    for K1, B1, alpha in random_sets(3, 4).T:
        model = model_of(K1, B1, alpha, N, memory)
        if memory == "short":  # of NumPy's numbers, which need no programs
            model = FOSLS(np.float64(model.K0), K1, B1, alpha, N=N)
        needed = 0.95 - float(passivity.certify(model, 0.95).upper)
        b = 0.9 * needed
        witness = passivity.witness(model, b)
        # Σ Δx² of a cycle is 2·(1 - cos θ)·Σ x², and each Δx²/T takes up b - b(θ).
        angle = witness.frequency * model.T
        short = b - float(passivity.needed_damping(model, witness.frequency))
        squares = 2 * (1 - np.cos(angle)) * np.sum(witness.x[1:] ** 2)
        assert witness.energy < 0 and witness.lost > 0
        assert witness.energy == pytest.approx(1e-3 * short * squares / model.T, rel=1e-9)
        assert passivity.witness(model, 1.1 * needed) is None


def test_the_witness_is_what_the_recursion_renders():
    """After a warm-up of many cycles, for a fast set."""
    for model, b in ((FOSLS(-2.89, 5.7, 5.89, 0.203), 0.9), (FOSLS(0.44, 5.7, 5.89, 0.203, N=100), 0.5)):
        witness = passivity.witness(model, b)
        cycles = 2 + 2000 // len(witness.force)
        force = np.asarray(model.simulate(np.tile(witness.x[:-1], cycles)))[-len(witness.force) :]
        np.testing.assert_allclose(force, witness.force, atol=1e-9)
        taken = np.sum(force * np.diff(witness.x) + b / 1000 / model.T * np.diff(witness.x) ** 2)
        assert taken == pytest.approx(witness.energy, rel=1e-9)


def test_needed_damping_at_both_ends():
    model = FOSLS(-2.89, 5.7, 5.89, 0.203)
    needed = passivity.needed_damping(model, np.array([0.0, 1e-3, 1e3 * np.pi]))
    assert needed[0] == pytest.approx(float(needed[1]), rel=1e-6)
    assert needed[2] == pytest.approx(0.91664, abs=5e-6)


@pytest.mark.parametrize("numbers", [(-3.19, 5.58, 7.88, 0.176), (0.3, 0.0, 1.0, 0.5), (0.1, math.inf, 0.5, 0.9)])
def test_of_numpys_numbers_numpy_computes_the_same(numbers):
    ours, theirs = FOSLS(*map(np.float64, numbers)), FOSLS(*numbers)
    host, device = passivity.certify(ours, 0.95), passivity.certify(theirs, 0.95)
    assert isinstance(host.lower, np.generic) and isinstance(device.lower, jax.Array)
    for name in ("lower", "upper", "static_stiffness", "frequency"):
        np.testing.assert_allclose(getattr(host, name), getattr(device, name), rtol=1e-12, atol=1e-12)
    largest = passivity.largest_K1(theirs.B1, theirs.alpha, 0.95, theirs.dc_gain())
    np.testing.assert_allclose(passivity.largest_K1_beside(ours, 0.95), largest, rtol=1e-12)
