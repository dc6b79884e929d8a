"""The device's own arithmetic: powers without libm, the closed forms, and which sets it takes."""

import ctypes
import zlib

import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from helpers_firmware import NAMES, REASONS, Device, build, cobs, decode, frame, library, parameters, unpack

from hilbo import passivity, viscoelastic

POWER_BOUND = 0.6  # units in the last place, as hb_math.h says


@pytest.fixture(scope="module")
def lib():
    return library(build())


def closed_forms(lib, *set_numbers) -> dict[str, float]:
    forms = (ctypes.c_double * 5)()
    lib.shim_closed_forms((ctypes.c_double * 7)(*map(float, set_numbers)), forms)
    return dict(zip(("b", "H1", "warm", "beta", "static"), forms, strict=True))


@pytest.mark.parametrize("base", [1, 2, 3, 100, 999, 1000, 4096, 10000, 65535])
def test_power_is_exact_to_less_than_a_unit(lib, base):
    """Against 60 digits, at random exponents and at both ends."""
    rng = np.random.default_rng(base)
    ends = [0, 2**-30, 2**-10, 0.5, 1 - 2**-24, 1]
    exponents = np.float32([*ends, *rng.uniform(0, 1, 300), *2 ** rng.uniform(-10, 0, 300)])
    with mpmath.workdps(60):
        for exponent in exponents:
            exact = mpmath.mpf(base) ** mpmath.mpf(float(exponent))
            unit = mpmath.mpf(2) ** (mpmath.floor(mpmath.log(exact, 2)) - 23)
            assert abs(lib.shim_power(base, ctypes.c_float(exponent)) - exact) <= POWER_BOUND * unit


@pytest.mark.parametrize("stride", [4099, pytest.param(1, marks=pytest.mark.deep)])
def test_power_over_every_exponent(lib, stride):
    """T^-alpha at 1 kHz and C(-1) = 2^alpha: every float32 that alpha may be, against double precision."""
    for base in (2, 1000):
        error = lib.shim_power_error(base, ctypes.c_float(2**-10), ctypes.c_float(1), stride)
        print(f"{base}^alpha: {error:.4f} units in the last place")
        assert error <= POWER_BOUND


def exact_forms(K0, K1, B1, alpha, N, full):
    """b_min, H(1), warm-up and beta in 50 digits."""
    with mpmath.workdps(50):
        K0, K1, B1, alpha = (mpmath.mpf(float(value)) for value in (K0, K1, B1, alpha))
        taps, c = [], mpmath.mpf(1)
        for i in range(1, N + 1):
            c = c * (i - 1 - alpha) / i
            taps.append(c)
        dc = 0 if full else 1 + sum(taps)
        nyquist = 2**alpha if full else 1 + sum((-1) ** i * c for i, c in enumerate(taps, 1))
        moment = -sum(i * c for i, c in enumerate(taps, 1))
        beta = B1 * mpmath.mpf(1000) ** alpha
        series = lambda pot: K1 * pot / (K1 + pot)  # noqa: E731
        warm = min(5000, mpmath.ceil(N + 3 * beta * moment / (K1 + beta * dc)))
        return (K0 + series(beta * nyquist)) / 2, K0 + series(beta * dc), None if full else warm, beta


@pytest.mark.parametrize("full", [False, True])
def test_closed_forms_against_fifty_digits(lib, full):
    rng = np.random.default_rng(5)
    for _ in range(60):
        N = int(rng.choice([1, 25, 101, 201, 255]))
        K1, B1, alpha = np.float32([rng.uniform(1, 32), rng.uniform(0.001, 32), rng.uniform(0.01, 0.99)])
        K0 = np.float32(rng.uniform(0, 1)) if full else np.float32(rng.uniform(-1, 1))
        forms = closed_forms(lib, int(full), N, 1000, K0, K1, B1, alpha)
        b, H1, warm, beta = exact_forms(K0, K1, B1, alpha, N, full)
        scale = abs(float(K0)) + float(b)
        assert abs(forms["b"] - b) <= 3e-6 * scale
        assert abs(forms["H1"] - H1) <= 2e-5 * scale
        assert abs(forms["beta"] / beta - 1) <= 1.2e-7
        assert warm is None or abs(forms["warm"] - warm) <= 1
        assert forms["static"] == (H1 >= 0) or abs(H1) < 1e-5


def test_golden_numbers(lib):
    """Sets S, A and V as they are printed: damping and static stiffness."""
    for row, b, H1 in [
        ((-2.89, 5.70, 5.89, 0.203), 0.91664, 0.44325),
        ((-3.18, 5.58, 7.88, 0.176), 0.76288, 0.44616),
        ((-5.01, 8.44, 10.28, 0.282), 1.34452, 0.44586),
    ]:
        forms = closed_forms(lib, 0, 101, 1000, *row)
        assert abs(forms["b"] - b) < 1.1e-5
        assert abs(forms["H1"] - H1) < 1.1e-5


def boundary_sets(count: int, b: float, memory: str, seed: int) -> np.ndarray:
    """K0, K1, B1, alpha (float32) whose b_min is `b`, as the host's search proposes them: K1 at its passive limit."""
    rng = np.random.default_rng(seed)
    rows = []
    while sum(map(len, rows)) < count:
        B1, alpha = rng.uniform(0.001, 32, 8192), rng.uniform(0.01, 0.99, 8192)
        K_eff = rng.choice([0.0, 0.1, 0.44], 8192)
        K1 = np.asarray(passivity.largest_K1(jnp.asarray(B1), jnp.asarray(alpha), b, jnp.asarray(K_eff), memory=memory))
        K0 = K_eff
        if memory == "short":
            K0 = np.asarray(viscoelastic.K0_from_effective_stiffness(*map(jnp.asarray, (K1, B1, alpha, K_eff))))
        rows.append(np.column_stack([K0, K1, B1, alpha])[(K1 >= 1) & (K1 <= 32)])
    return np.vstack(rows)[:count].astype(np.float32)


def verdicts(device: Device, sets: np.ndarray, full: bool) -> list[str]:
    """ACK or the reason, for each set sent in SET_PARAMS."""
    answers = []
    device.collect()
    for number, (K0, K1, B1, alpha) in enumerate(sets.tolist()):
        model = {"K0": K0, "K1": K1, "B1": B1, "alpha": alpha} | ({"states": [0] * 10} if full else {})
        device.feed(frame("SET_PARAMS", number % 256, parameters(model)))
        kind, _, payload = decode(device.drain()[:-1])
        answers.append("ACK" if NAMES[kind] == "ACK" else REASONS[unpack("NACK", payload)["reason"]])
    return answers


@pytest.mark.parametrize("count", [500, pytest.param(12_500, marks=pytest.mark.deep)])
@pytest.mark.parametrize("memory", ["short", "full"])
@pytest.mark.parametrize("b", [0.5, 0.95, 2.0, 5.0])
def test_every_proposal_on_the_passive_boundary_is_taken(b, memory, count):
    """The host searches with b(1 - 1e-3); eight cases of 12,500 are the 1e5."""
    sets = boundary_sets(count, b * (1 - 1e-3), memory, seed=1)
    answers = verdicts(Device(damping=b, K0_low=-40.0), sets, memory == "full")
    assert answers.count("ACK") == count


@pytest.mark.parametrize("count", [300, pytest.param(1_250, marks=pytest.mark.deep)])
@pytest.mark.parametrize("memory", ["short", "full"])
@pytest.mark.parametrize("b", [0.5, 0.95, 2.0, 5.0])
def test_every_set_slightly_beyond_is_refused(b, memory, count):
    """By 1e-3, and by a tenth of that: float32 is far finer."""
    for beyond in (1e-3, 1e-4):
        sets = boundary_sets(count, b * (1 + beyond), memory, seed=2)
        answers = verdicts(Device(damping=b, K0_low=-40.0), sets, memory == "full")
        assert answers.count("NOT_PASSIVE") == count


def test_negative_static_stiffness_is_refused():
    device = Device(damping=50.0)
    rng = np.random.default_rng(4)
    K1, B1, alpha = rng.uniform(1, 32, 300), rng.uniform(0.01, 32, 300), rng.uniform(0.01, 0.99, 300)
    for K_eff, verdict in ((-1e-3, "STATIC_STIFFNESS"), (0.0, "ACK")):
        K0 = np.asarray(viscoelastic.K0_from_effective_stiffness(*map(jnp.asarray, (K1, B1, alpha)), K_eff))
        answers = verdicts(device, np.column_stack([K0, K1, B1, alpha]).astype(np.float32), False)
        assert set(answers) == {verdict}
    full = verdicts(device, np.float32([[-1e-6, 2, 3, 0.3]]), True)
    assert full == ["STATIC_STIFFNESS"]


def test_the_helper_stuffs_as_cobs_is_defined():
    assert cobs(b"\x11\x00\x00\x22") == bytes.fromhex("0211010222")
    assert cobs(b"\0") == b"\1\1"
    assert zlib.crc32(b"123456789") == 0xCBF43926


# Delay


def needed_at(angle, H, sigma):
    """Damping/(T/2) at each angle: the largest eigenvalue of the held and late force's operator on all aliases.

    The aliases of the angle are k = -K … K; what they leave out of the sums is below 1/K of them.
    """
    K = 1000
    wave = angle[:, None] + 2 * np.pi * np.arange(-K, K + 1)
    left, right = np.exp(-1j * sigma * wave) / wave, 1 / wave
    change = (1 - np.exp(-1j * angle)) * H
    inner = change * np.sum(left * right, 1)
    size = np.abs(change) * np.sqrt(np.sum(np.abs(left) ** 2, 1) * np.sum(right**2, 1))
    return np.real(inner) + np.sqrt(size**2 - np.imag(inner) ** 2)


@pytest.mark.parametrize("delay", [100, 376, 1000])
def test_the_damping_at_a_delay_against_a_truncated_operator(delay):
    """The device looks at 256 angles and adds its margin: never below the largest of 250 others, nor 1 % above."""
    rng = np.random.default_rng(delay)
    angle = np.pi * (np.arange(250) + 1) / 250
    lib = library(build())
    for _ in range(6):
        K1, B1, alpha, N = np.exp(rng.uniform(0, 3)), np.exp(rng.uniform(-3, 3)), rng.uniform(0.05, 0.95), 101
        c = np.cumprod(np.r_[1, 1 - (1 + alpha) / np.arange(1, N + 1)])
        beta = B1 * 1e3**alpha
        K0 = 0.44 - K1 * beta * c.sum() / (K1 + beta * c.sum())
        C = np.exp(-1j * np.outer(angle, np.arange(N + 1))) @ c
        H = K0 + K1 * beta * C / (K1 + beta * C)
        needed = max(0.5 * needed_at(angle, H, delay / 1000).max(), 0.5 * H[-1].real)
        numbers = (ctypes.c_double * 7)(0, N, 1000, K0, K1, B1, alpha)
        found = lib.shim_delayed_damping(numbers, None, None, ctypes.c_uint32(delay))
        assert needed * (1 - 1e-3) <= found <= needed * 1.01
