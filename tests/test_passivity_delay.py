"""Passivity at a delay of the force: against the truncated operator of all aliases, in time, and against each other."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import qmc

from hilbo import passivity, viscoelastic
from hilbo.errors import InputError
from hilbo.mechanics.delay import least_damping
from hilbo.report.passivity import passivity_result
from hilbo.viscoelastic import FOSLS

T = 1e-3
SETS = ((5.70, 5.89, 0.203), (5.58, 7.88, 0.176), (8.44, 10.28, 0.282))  # identified, aggregate, average of individuals
DELAYS = (105e-6, 271e-6, 376e-6)
COUNT = 8


def random_sets(count=COUNT, seed=0):
    """K1, B1, α of the search box, and delays from 0 to T."""
    return qmc.scale(qmc.Sobol(4, rng=seed).random(count), (1, 0.001, 0.01, 0), (32, 32, 0.99, T)).T


def host_model(K1, B1, alpha, N=101, K_eff=0.44):
    """Of NumPy's numbers, which need no programs."""
    still = FOSLS(np.float64(0), np.float64(K1), np.float64(B1), np.float64(alpha), N=N)
    return FOSLS(K_eff - still.dc_gain(), still.K1, still.B1, still.alpha, N=N)


def spring(K_eff, delay):
    """The damping that a spring needs at a delay, closed."""
    lag = delay / T
    return 500 * T * K_eff * (1 + 2 * lag + math.sqrt(1 + 8 * lag)) / 2


@pytest.mark.parametrize("memory", ["short", "full"])
def test_without_a_delay_every_number_is_the_closed_form_to_the_last_bit(memory):
    K1, B1, alpha, _ = random_sets()
    for function, place in ((passivity.minimum_damping, (K1, B1, alpha)), (passivity.largest_K1, (B1, alpha))):
        np.testing.assert_array_equal(function(*place, memory=memory, delay=0.0), function(*place, memory=memory))
    model = host_model(*SETS[0])
    assert repr(passivity.certify(model, 0.95, delay=0)) == repr(passivity.certify(model, 0.95))
    assert passivity.largest_K1_beside(model, 0.95, delay=0.0) == passivity.largest_K1_beside(model, 0.95)


@pytest.mark.parametrize(
    ("delay", "damping"),
    [
        (105e-6, (0.91974, 0.76788, 1.38147)),
        (271e-6, (1.11042, 0.92981, 1.68431)),
        (376e-6, (1.23594, 1.03619, 1.87787)),
    ],
)
def test_damping_of_the_published_sets(delay, damping):
    for one, needed in zip(SETS, damping, strict=True):
        certificate = passivity.certify(host_model(*one), 2.0, delay=delay)
        assert 2.0 - certificate.upper == pytest.approx(needed, abs=1e-5)
        assert certificate.upper - certificate.lower <= 1e-10


def aliased(model, angle, delay, aliases=20_000):
    """The damping at a frequency from the operator of so many aliases on both sides: the eigenvalue of its Hermitian
    part, of rank two, without the closed sums."""
    omega = (angle + 2 * np.pi * np.arange(-aliases, aliases + 1)) / T
    response = complex(np.asarray(model.frequency_response(angle / T)))
    force = (1 - np.exp(-1j * angle)) * response * np.exp(-1j * omega * delay) / (T * omega)
    pairs = [[np.vdot(a, c) for c in (force, 1 / omega)] for a in (1 / omega, force)]
    return 500 * np.linalg.eigvals(np.array(pairs)).real.max()


def test_the_damping_at_a_frequency_is_that_of_all_aliases():
    rng = np.random.default_rng(1)
    for K1, B1, alpha, delay in random_sets(8, 1).T:
        model, angle = host_model(K1, B1, alpha), rng.uniform(0.05, np.pi)
        model = FOSLS(float(model.K0), K1, B1, alpha)
        needed = float(passivity.needed_damping(model, angle / T, delay=delay))
        size = abs(complex(np.asarray(model.frequency_response(angle / T))))
        assert aliased(model, angle, delay) == pytest.approx(needed, abs=2e-5 * size)


def test_needed_damping_at_the_ends_of_frequency_and_of_delay():
    model = FOSLS(-2.89, 5.7, 5.89, 0.203)
    ends = np.array([0.0, 1e-3, 1e3 * np.pi])
    slow, close, nyquist = np.asarray(passivity.needed_damping(model, ends, delay=0.3e-3))
    assert slow == pytest.approx(close, rel=1e-6)
    assert nyquist == pytest.approx(0.7 * 0.91664, abs=5e-6)
    # A delay of T is one more sample: z^{-1}·H without a delay, where that is not negative.
    angle = np.linspace(0.01, np.pi, 200)
    late = np.asarray(model.frequency_response(angle / T)) * np.exp(-1j * angle)
    undelayed = 0.5 * (late.real - late.imag / np.tan(angle / 2))
    np.testing.assert_allclose(
        passivity.needed_damping(model, angle / T, delay=T), np.maximum(undelayed, 0), atol=1e-12
    )


def test_a_spring_needs_its_closed_form():
    for delay in (*DELAYS, T):
        model = FOSLS(np.float64(2.0), np.float64(0.0), np.float64(1.0), np.float64(0.5))
        certificate = passivity.certify(model, 9.0, delay=delay)
        assert (
            certificate.lower <= 9 - spring(2.0, delay) + 1e-12 and certificate.upper >= 9 - spring(2.0, delay) - 1e-12
        )
        assert certificate.frequency == 0 and certificate.upper - certificate.lower < 1e-11
    nothing = FOSLS(np.float64(0.0), np.float64(0.0), np.float64(1.0), np.float64(0.5))
    assert passivity.certify(nothing, 0.1, delay=T).status == "passive"


@pytest.mark.parametrize("N", [101, 1, 2])
def test_the_certificate_encloses_a_fine_grid(N):
    angle = np.linspace(0, np.pi, 4001)[1:]
    powers = np.exp(-1j * np.outer(angle, np.arange(N + 1)))
    for K1, B1, alpha, delay in random_sets(8, 2).T:
        model, lag = host_model(K1, B1, alpha, N), delay / T
        pot = B1 * T**-alpha * (powers @ np.asarray(viscoelastic.gl_coefficients(alpha, N)))
        response = float(model.K0) + K1 * pot / (K1 + pot)
        psi = response.real - response.imag / np.tan(angle / 2) + 2 * lag * (np.exp(-1j * angle) * response).real
        grid = 0.25 * np.max(psi + np.sqrt(psi**2 + 4 * lag * (1 - lag) * np.abs(response) ** 2))
        certificate = passivity.certify(model, 0.95, delay=delay)
        assert 0.95 - certificate.lower >= grid * (1 - 1e-12)
        assert 0.95 - certificate.upper <= grid * (1 + 1e-4)
        assert certificate.upper - certificate.lower <= 1e-6 * grid


def test_the_damping_of_random_sets_is_what_is_proved():
    K1, B1, alpha, delay = random_sets()
    needed = np.asarray(passivity.minimum_damping(K1, B1, alpha, delay=delay))
    for i in range(COUNT):
        certificate = passivity.certify(host_model(K1[i], B1[i], alpha[i]), 0.95, delay=delay[i])
        assert needed[i] * (1 - 1e-12) <= 0.95 - certificate.lower <= needed[i] * (1 + 2e-6)


def test_the_largest_k1_is_proved_passive_and_little_more_is_not():
    _, B1, alpha, delay = random_sets()
    largest = np.asarray(passivity.largest_K1(B1, alpha, 0.95, delay=delay))
    limited = np.isfinite(largest) & (largest > 0)
    assert limited.sum() > COUNT / 2
    for i in np.flatnonzero(limited):
        certificate = passivity.certify(host_model(largest[i], B1[i], alpha[i]), 0.95, delay=delay[i])
        assert certificate.lower > 0 and certificate.upper <= 2e-5 * 0.95
    for i in np.flatnonzero(np.isinf(largest)):
        assert passivity.certify(host_model(np.inf, B1[i], alpha[i]), 0.95, delay=delay[i]).passive


def test_is_passive_knows_damping_and_delay():
    K1, B1, alpha = np.array(SETS).T
    passive = [passivity.is_passive(K1, B1, alpha, 0.95, delay=delay).tolist() for delay in (0.0, 105e-6, 271e-6)]
    assert passive == [[True, True, False], [True, True, False], [False, True, False]]


def test_passive_at_a_delay_means_at_every_shorter_one():
    """The identified set needs 0.915 N·s/m without delay, and 0.882 at 50 µs."""
    K1, B1, alpha = SETS[0]
    assert not passivity.is_passive(K1, B1, alpha, 0.9, delay=50e-6)
    content = passivity_result(host_model(K1, B1, alpha), 0.9, 50e-6)
    assert content["status"] == "violated" and content["binding_delay"] == 0
    assert content["largest_K1"] == pytest.approx(float(passivity.largest_K1(B1, alpha, 0.9)))
    assert passivity_result(host_model(K1, B1, alpha), 0.95, 271e-6)["binding_delay"] == 271e-6


def test_no_k1_is_given_on_a_device_that_hardly_holds_the_spring():
    least = least_damping(0.44, T, 271e-6)
    assert least == pytest.approx(1.05 * spring(0.44, 271e-6))
    B1, alpha = np.full(2, 0.01), np.full(2, 0.3)
    below, above = np.asarray(passivity.largest_K1(B1, alpha, least * np.array([0.999, 1.001]), delay=271e-6))
    assert below == 0 and above > 0


@pytest.mark.parametrize("memory", ["short", "full"])
def test_needed_damping_rises_in_k1_beyond_the_least(memory):
    """The evidence for one interval of passive K1, on the sets where it comes nearest to failing."""
    K1 = np.concatenate([np.geomspace(1e-3, 1e4, 63), [np.inf]])
    for pot, alpha, lag in ((0.33, 0.32, 1.0), (0.55, 0.54, 0.75)):
        B1 = pot * T**alpha
        needed = np.asarray(passivity.minimum_damping(K1 * pot, B1, alpha, 1.0, memory=memory, delay=lag * T))
        beyond = needed[needed > 1.05 * spring(1.0, lag * T)]
        assert np.all(np.diff(beyond) > 0) and np.max(np.maximum.accumulate(needed) - needed) > 0


def test_gradients_match_finite_differences():
    point = np.array([7.88, 0.176, 0.95])
    slope = jax.grad(lambda *place: passivity.largest_K1(*place, delay=271e-6), (0, 1, 2))(*map(float, point))
    step = 1e-5 * point
    above, below = (passivity.largest_K1(*(point[:, None] + side * np.diag(step)), delay=271e-6) for side in (1, -1))
    np.testing.assert_allclose(slope, (np.asarray(above) - np.asarray(below)) / (2 * step), rtol=1e-6)


def energy(witness, b, parts=1000):
    """Of one cycle, by a sum over short times: force in force times velocity, and the loss in the damping (mJ)."""
    split = round(parts * witness.delay / T)
    total = 0.0
    for n in range(len(witness.force)):
        path = np.concatenate(
            [
                np.linspace(witness.x[n], witness.bend[n], split + 1)[:-1],
                np.linspace(witness.bend[n], witness.x[n + 1], parts - split + 1),
            ]
        )
        force = np.where(np.arange(parts) < split, witness.force[n - 1], witness.force[n])
        step = np.diff(path)
        total += np.sum(force * step + b / 1000 * step**2 / (T / parts))
    return total


@pytest.mark.parametrize("delay", [*DELAYS, T])
def test_a_motion_creates_energy_just_below_the_bound(delay):
    model = host_model(*SETS[0])
    needed = 0.95 - float(passivity.certify(model, 0.95, delay=delay).upper)
    witness = passivity.witness(model, 0.9999 * needed, delay=delay)
    assert witness.energy < 0 < witness.lost
    assert energy(witness, 0.9999 * needed) == pytest.approx(witness.energy, rel=1e-9, abs=1e-12)
    assert energy(witness, 1.0001 * needed) > 0
    assert passivity.witness(model, 1.0001 * needed, delay=delay) is None
    cycles = 2 + 2000 // len(witness.force)
    rendered = np.asarray(model.simulate(np.tile(witness.x[:-1], cycles)))[-len(witness.force) :]
    np.testing.assert_allclose(rendered, witness.force, atol=1e-9)


def test_a_motion_creates_energy_on_a_device_without_damping():
    assert passivity.witness(host_model(*SETS[0]), 0.0, delay=DELAYS[1]).energy < 0


def test_no_random_motion_creates_energy_above_the_bound():
    """Cycles of random steps with the bends that lose least, at the damping that is needed."""
    rng, delay, n = np.random.default_rng(0), 271e-6, 64
    model, lag = FOSLS(*map(float, (-2.89, 5.7, 5.89, 0.203))), 0.271
    b = float(passivity.minimum_damping(5.7, 5.89, 0.203, model.dc_gain(), delay=delay)) / 1000
    x = np.cumsum(rng.normal(size=(20, n)), axis=1)
    x -= np.linspace(0, 1, n) * (x[:, -1:] - x[:, :1])
    angle = 2 * np.pi * np.arange(1, n // 2 + 1) / n
    response = np.concatenate([[model.dc_gain()], np.asarray(model.frequency_response(angle / T))])
    force = np.fft.irfft(np.fft.rfft(x, axis=1) * response, n, axis=1)
    step, change = np.roll(x, -1, axis=1) - x, force - np.roll(force, 1, axis=1)
    taken = (force - lag * change) * step + b * step**2 / T - lag * (1 - lag) * T * change**2 / (4 * b)
    assert np.all(taken.sum(axis=1) > 0)


@pytest.mark.parametrize("delay", [math.nan, -1e-6, 1.001e-3, math.inf])
def test_a_delay_that_is_none_is_refused(delay):
    model = host_model(*SETS[0])
    for call in (
        lambda: passivity.minimum_damping(*SETS[0], delay=delay),
        lambda: passivity.largest_K1(*SETS[0][1:], delay=delay),
        lambda: passivity.certify(model, 0.95, delay=delay),
        lambda: passivity.largest_K1_beside(model, 0.95, delay=delay),
    ):
        with pytest.raises(InputError, match=r"delay is .* s; it must be from 0 to the sampling time"):
            call()


def test_a_traced_delay_beyond_t_is_not_a_number():
    needed = jax.jit(lambda delay: passivity.minimum_damping(*SETS[0], delay=delay))
    assert np.isnan(needed(1.1e-3)) and needed(0.0) == pytest.approx(0.91502, abs=5e-6)


@pytest.mark.deep
@pytest.mark.parametrize("N", [101, 25, 1, pytest.param(401, marks=pytest.mark.release)])
def test_bounds_of_many_sets_are_what_is_proved(N):
    K1, B1, alpha, delay = random_sets(256, N)
    needed = np.asarray(passivity.minimum_damping(K1, B1, alpha, 0.44, N, delay=delay))
    largest = np.asarray(passivity.largest_K1(B1, alpha, 0.95, 0.44, N, delay=delay))
    for i in range(len(K1)):
        certificate = passivity.certify(host_model(K1[i], B1[i], alpha[i], N), 0.95, delay=delay[i])
        assert needed[i] * (1 - 1e-12) <= 0.95 - certificate.lower <= needed[i] * (1 + 2e-6)
        if largest[i] > 0:
            assert passivity.certify(host_model(largest[i], B1[i], alpha[i], N), 0.95, delay=delay[i]).passive


@pytest.mark.deep
def test_full_memory_is_that_of_a_fine_grid():
    K1, B1, alpha, delay = random_sets(64, 5)
    needed = np.asarray(passivity.minimum_damping(K1, B1, alpha, memory="full", delay=delay))
    angle = np.pi * np.linspace(0, 1, 20_001) ** 3
    for i in range(len(K1)):
        model = FOSLS(0.44, K1[i], B1[i], alpha[i], memory="full")
        grid = float(jnp.max(passivity.needed_damping(model, angle / T, delay=delay[i])))
        assert needed[i] == pytest.approx(grid, rel=1e-6)
        certificate = passivity.certify(model, 0.95, delay=delay[i])
        assert certificate.lower <= 0.95 - grid <= certificate.upper
