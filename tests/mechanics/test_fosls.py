"""The record: recursion against the rational filter, the classical models, exact relaxation, and its refusals."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import check_grad
from scipy.optimize import brentq
from scipy.signal import lfilter

from hilbo import viscoelastic
from hilbo.errors import InputError
from hilbo.viscoelastic import FOSLS, PRESETS

SYSID, AGGREGATE, AVERAGE = PRESETS
MEMORIES = [{}, {"memory": "full"}]
both = pytest.mark.parametrize("memory", MEMORIES, ids=["short", "full"])


def random_sets(count, seed=0):
    K1, B1, alpha = np.random.default_rng(seed).uniform((1, 0.001, 0.01), (32, 32, 0.99), (count, 3)).T
    return np.asarray(viscoelastic.K0_from_effective_stiffness(K1, B1, alpha)), K1, B1, alpha


def hand(n, seed=0):
    """A lively motion of a few millimetres: slow waves, steps and tremor."""
    rng, t = np.random.default_rng(seed), np.arange(n) * 1e-3
    steps = np.repeat(rng.uniform(0, 3, n // 500 + 1), 500)[:n]
    return 2 + 2 * np.sin(1.3 * t) + steps + 0.2 * np.sin(60 * t)


def rational(K0, K1, B1, alpha, N=101, T=1e-3):
    """Numerator and denominator of H(z)."""
    pot = B1 * T**-alpha * np.asarray(viscoelastic.gl_coefficients(alpha, N))
    series = pot + K1 * (np.arange(N + 1) == 0)
    return K0 * series + K1 * pot, series


@eqx.filter_jit
def forces(sets, x, block, **memory):
    return jax.vmap(lambda *q: FOSLS(*q, **memory).simulate(x, block=block))(*sets)


def agrees_with_the_filter(count, seconds, blocks, bound):
    sets, x = random_sets(count), hand(1000 * seconds)
    expected = np.stack([lfilter(*rational(*q), x) for q in zip(*sets, strict=True)])
    scale = np.abs(expected).max(axis=1)
    for block in blocks:
        assert np.max(np.abs(forces(sets, x, block) - expected).max(axis=1) / scale) <= bound


def test_the_recursion_is_the_rational_filter():
    agrees_with_the_filter(10, 3, (1, 7, 64), 1e-12)


@pytest.mark.deep
def test_the_recursion_is_the_rational_filter_for_a_minute():
    agrees_with_the_filter(100, 60, (64,), 1e-12)


@both
def test_forces_and_positions_are_inverse(memory):
    x = hand(3000)
    for q in zip(*random_sets(3), strict=True):
        model = FOSLS(0.44 if memory else q[0], *q[1:], **memory)
        for start in ("rest", "equilibrium"):
            there = model.simulate(x, start=start)
            np.testing.assert_allclose(model.simulate_force(there, start=start), x, atol=1e-10)


@both
def test_blocks_change_rounding_only(memory):
    model, x = FOSLS(0.44, 5.7, 5.89, 0.203, **memory), hand(777)
    plain = model.simulate(x, block=1)
    for block in (7, 64):
        np.testing.assert_allclose(model.simulate(x, block=block), plain, atol=1e-13 * np.abs(plain).max())


@both
@pytest.mark.parametrize("alpha", [0.203, pytest.param(1.0, marks=pytest.mark.deep)])
def test_gradients_match_finite_differences(memory, alpha):
    load = np.concatenate([np.linspace(0, 5, 8), np.full(8, 5.0)])

    @jax.jit
    def both_ways(q, x):
        model = FOSLS(*q, **memory)
        return jnp.concatenate([model.simulate(x, block=8)[::5], model.simulate_force(x, block=8)[::5]])

    if alpha < 1:
        check_grad(both_ways, np.array([0.44, 5.7, 5.89, alpha]), load, rtol=1e-7)
    if alpha == 1:  # one-sided: α cannot go above 1

        def last(alpha):
            return both_ways(jnp.stack([0.44, 5.7, 5.89, alpha]), load)[3]

        slope = jax.jacfwd(last)(1.0)
        value = [float(last(1 - h)) for h in (0, 1e-5, 2e-5)]
        assert slope == pytest.approx((3 * value[0] - 4 * value[1] + value[2]) / 2e-5, rel=1e-5)


@eqx.filter_jit
def rendered(sets, x, drive, block, **memory):
    return jax.vmap(lambda *q: getattr(FOSLS(*q, **memory), drive)(x, block=block))(*sets)


# Largest error of a minute in float32, of the largest force or position: docs/methods/mechanics.md quotes these.
@pytest.mark.deep
@pytest.mark.parametrize(
    ("drive", "memory", "block", "bound"),
    [
        ("simulate", {}, 1, 5e-5),
        ("simulate", {}, 64, 5e-5),
        ("simulate_force", {}, 1, 1e-3),
        ("simulate_force", {}, 64, 1e-3),
        ("simulate", {"memory": "full"}, 64, 1e-3),
        ("simulate_force", {"memory": "full"}, 64, 5e-3),
    ],
)
def test_single_precision_for_a_minute(drive, memory, block, bound):
    sets, x = [value[:40].astype(np.float32) for value in random_sets(40)], hand(60_000).astype(np.float32)
    if memory:
        sets[0] = np.full(40, 0.44, np.float32)
    # The same rounded parameters on both sides: the error is that of the arithmetic.
    exact = np.asarray(rendered([value.astype(float) for value in sets], x.astype(float), drive, 64, **memory))
    single = rendered(sets, x, drive, block, **memory)
    assert single.dtype == jnp.float32
    error = np.max(np.abs(np.asarray(single, float) - exact).max(axis=1) / np.abs(exact).max(axis=1))
    print(f"float32, {drive}, {memory or 'short'}, block {block}: {error:.1e}")
    assert error <= bound


def test_published_sets():
    for name, gain, damping in ((SYSID, 0.44325, 35.6), (AGGREGATE, 0.44616, 27.4), (AVERAGE, 0.44586, None)):
        model = PRESETS[name].model()
        assert model.dc_gain() == pytest.approx(gain, abs=5e-6)
        assert damping is None or model.effective_damping() == pytest.approx(damping, abs=0.05)
        assert "paper" not in PRESETS[name].source and len(PRESETS[name].source) > 40
    assert PRESETS[SYSID].model().settling_time(0.9) == pytest.approx(0.081)
    assert PRESETS[SYSID].model().settling_time(0.99) == pytest.approx(0.160)


def test_short_memory_is_part_of_the_set():
    values, x = PRESETS[SYSID][:4], viscoelastic.relaxation_load()
    exact = 5 * viscoelastic.relaxation_modulus(np.arange(1, 3001) * 1e-3, *values)
    assert exact[-1] == pytest.approx(-2.40, abs=5e-3)
    for N, error in ((2, 76), (25, 50), (101, 32.8), (201, 24), (1000, 6.4)):
        force = FOSLS(*values, N=N).simulate(x)
        nrmse = 100 * np.sqrt(np.mean((force - exact) ** 2)) / np.ptp(exact)
        assert nrmse == pytest.approx(error, abs=0.5 if error > 33 else 0.4)


@both
def test_full_memory_approaches_the_continuous_model_as_T_shrinks(memory):
    values, seconds = (0.44, 16.0, 16.0, 0.4), 0.512
    errors = []
    for T in (4e-3, 2e-3):
        n = round(seconds / T)
        model = FOSLS(*values, N=n, T=T, **memory)
        relaxed = model.simulate(np.ones(n))[-1] - viscoelastic.relaxation_modulus(n * T, *values)
        crept = model.simulate_force(np.ones(n))[-1] - viscoelastic.creep_compliance(n * T, *values)
        errors.append([abs(float(relaxed)), abs(float(crept))])
    ratios = np.array(errors[:-1]) / errors[1:]
    bound = np.array(errors) <= np.array([[2e-2, 1e-4]])
    assert bound.all()
    if not memory:  # with exponentials their own error, 1e-5, is left
        assert np.all((ratios > 1.7) & (ratios < 2.3))


def test_continuous_references():
    K0, K1, B1, t = 0.5, 3.0, 2.0, np.linspace(0, 4, 9)
    sls = K0 + K1 * np.exp(-K1 / B1 * t)
    np.testing.assert_allclose(viscoelastic.relaxation_modulus(t, K0, K1, B1, 1.0), sls, atol=1e-13)
    crept = 1 / K0 - (1 / K0 - 1 / (K0 + K1)) * np.exp(-K0 * K1 / (K0 + K1) / B1 * t)
    np.testing.assert_allclose(viscoelastic.creep_compliance(t, K0, K1, B1, 1.0), crept, atol=1e-12)
    np.testing.assert_allclose(viscoelastic.creep_compliance(t, 0.0, K1, B1, 1.0), 1 / K1 + t / B1, rtol=1e-12)
    voigt = (1 - np.exp(-K0 / B1 * t)) / K0
    np.testing.assert_allclose(viscoelastic.creep_compliance(t, K0, np.inf, B1, 1.0), voigt, atol=1e-12)
    pot = viscoelastic.relaxation_modulus(t[1:], K0, np.inf, B1, 0.5) - K0
    np.testing.assert_allclose(pot, B1 / np.sqrt(np.pi * t[1:]), rtol=1e-12)
    check_grad(jax.jit(lambda q: viscoelastic.relaxation_modulus(t, *q)), np.array([K0, K1, B1, 0.4]))
    check_grad(jax.jit(lambda q: viscoelastic.creep_compliance(t, *q)), np.array([K0, K1, B1, 0.4]))


def test_the_product_of_the_laplace_transforms_is_one():
    """s²·G(s)·J(s) = 1, in the time domain ∫ G(t - u) dJ(u) = 1."""
    values, t = (0.5, 3.0, 2.0, 0.6), 1.0
    u = np.linspace(0, 1, 5_001) ** 3 * t
    G = np.asarray(viscoelastic.relaxation_modulus(t - (u[1:] + u[:-1]) / 2, *values))
    J = np.asarray(viscoelastic.creep_compliance(u, *values))
    assert np.sum(G * np.diff(J)) + J[0] * float(viscoelastic.relaxation_modulus(t, *values)) == pytest.approx(
        1, abs=2e-4
    )


@both
def test_settling_is_where_the_relaxation_is(memory):
    model = FOSLS(0.44, 5.7, 5.89, 0.4, **memory)
    for fraction in (0.0, 0.5, 0.9):
        t = float(model.settling_time(fraction))
        if memory:
            E = (viscoelastic.relaxation_modulus(t, 0.44, 5.7, 5.89, 0.4) - 0.44) / 5.7
            assert pytest.approx(1 - fraction, abs=1e-12) == float(E)
        else:
            force = np.asarray(model.simulate(np.ones(4000)))
            done = (force[0] - force) / (force[0] - float(model.dc_gain()))
            assert t == pytest.approx(1e-3 * np.argmax(done >= fraction))
    assert FOSLS(1.0, 0.0, 1.0, 0.5, **memory).settling_time(0.9) == (np.inf if memory else 0)


@both
@pytest.mark.parametrize("N", [1, 24, 101])
def test_responses_are_complex_arithmetic(memory, N):
    values, omega = (0.44, 5.7, 5.89, 0.203), np.array([1e-3, 1.0, 100.0, 3000.0, 1e3 * np.pi])
    model, z = FOSLS(*values, N=N, **memory), np.exp(-1e-3j * omega)
    if memory:
        fractional = (1 - z) ** 0.203
    else:
        fractional = np.stack([z**i for i in range(N + 1)], -1) @ np.asarray(viscoelastic.gl_coefficients(0.203, N))
    pot = 5.89 * 1e-3**-0.203 * fractional
    # The exponentials are fitted to 10 s, which the lowest frequency is beyond.
    response, expected = model.frequency_response(omega), 0.44 + 5.7 * pot / (5.7 + pot)
    np.testing.assert_allclose(
        response[1 if memory else 0 :], expected[1 if memory else 0 :], rtol=1e-4 if memory else 1e-12
    )
    assert model.frequency_response(0.0) == pytest.approx(complex(model.dc_gain()), abs=1e-15)
    assert abs(model.frequency_response(1e3 * np.pi) - complex(model.high_frequency_gain())) < 1e-12
    slow = 1e-9
    assert 1000 * model.frequency_response(slow).imag / slow == pytest.approx(
        float(model.effective_damping()), rel=1e-9
    )
    s = 5.89 * (1j * omega) ** 0.203
    np.testing.assert_allclose(model.continuous_response(omega), 0.44 + 5.7 * s / (5.7 + s), rtol=1e-13)


@both
def test_classical_models_by_the_same_code(memory):
    x, T = hand(400), 1e-3
    speed = np.diff(x, prepend=0.0) / T
    np.testing.assert_allclose(viscoelastic.spring(2.0, **memory).simulate(x), 2 * x, rtol=1e-15)
    voigt = viscoelastic.kelvin_voigt(2.0, 0.3, **memory)
    np.testing.assert_allclose(voigt.simulate(x), 2 * x + 0.3 * speed, atol=1e-11)
    np.testing.assert_allclose(voigt.simulate_force(voigt.simulate(x)), x, atol=1e-12)
    beta = 0.3 / T
    expected = lfilter([5 * beta, -5 * beta], [5 + beta, -beta], x)
    maxwell = viscoelastic.maxwell(5.0, 0.3, **memory)
    np.testing.assert_allclose(maxwell.simulate(x), expected, atol=1e-11)
    np.testing.assert_allclose(viscoelastic.sls(2.0, 5.0, 0.3, **memory).simulate(x), expected + 2 * x, atol=1e-11)
    c = np.asarray(viscoelastic.gl_coefficients(0.5, 400))
    taps = c if memory else np.where(np.arange(401) <= 101, c, 0)
    pot = viscoelastic.springpot(0.3, 0.5, **memory).simulate(x)
    direct = 0.3 * T**-0.5 * np.convolve(x, taps)[:400]
    np.testing.assert_allclose(pot, direct, atol=1e-4 * np.abs(direct).max() if memory else 1e-12)
    assert voigt.effective_damping() == pytest.approx(300)
    assert voigt.dc_gain() == 2 and viscoelastic.spring(2.0, **memory).effective_damping() == 0


@both
def test_limits_have_finite_gradients(memory):
    x = hand(40)
    last = jax.jit(jax.grad(lambda q: FOSLS(*q, **memory).simulate(x)[-1]))
    for q in ((0.5, np.inf, 2.0, 1.0), (0.5, 0.0, 2.0, 0.5), (0.5, 3.0, 0.0, 1.0), (0.5, 0.0, 0.0, 1.0)):
        assert np.all(np.isfinite(last(jnp.array(q))))


@both
def test_an_equilibrium_stays_one(memory):
    model = FOSLS(0.44, 5.7, 5.89, 0.203, **memory)
    gain = float(model.dc_gain())
    np.testing.assert_allclose(model.simulate(np.full(300, 4.0), start="equilibrium"), 4 * gain, rtol=1e-12)
    np.testing.assert_allclose(model.simulate_force(np.full(300, 4.0), start="equilibrium"), 4 / gain, rtol=1e-12)


def test_contact_only_pushes():
    model, x = FOSLS(-2.89, 5.7, 5.89, 0.203), 5 * np.sin(np.arange(2000) * 4e-3)
    force = np.asarray(model.simulate(x, unilateral=True))
    kept = np.asarray(model.simulate(np.maximum(x, 0)))
    np.testing.assert_array_equal(force, np.maximum(kept, 0))
    assert force.min() == 0 and kept.min() < 0 and np.abs(force - model.simulate(x)).max() > 0.1


def test_a_switch_has_no_jump_and_ends_in_the_new_set():
    old, new = PRESETS[SYSID].model(), PRESETS[AVERAGE].model()
    x = hand(2000)
    force = np.asarray(viscoelastic.switched_force(old, new, x, staged=600, flip=1000, slew=20.0))
    before, fresh = np.asarray(old.simulate(x)), np.asarray(new.simulate(x))
    np.testing.assert_array_equal(force[:1000], before[:1000])
    assert force[1000] == pytest.approx(before[1000], abs=1e-12)
    offset = force[1000:] - np.asarray(new.simulate(x[600:], start="equilibrium"))[400:]
    assert np.abs(np.diff(offset)).max() <= 20 * 1e-3 + 1e-12 and abs(offset[-1]) < 1e-12
    np.testing.assert_allclose(force[-300:], fresh[-300:], atol=1e-3)
    with pytest.raises(InputError, match="in this order"):
        viscoelastic.switched_force(old, new, x, staged=10, flip=5, slew=20.0)
    with pytest.raises(InputError, match="slew"):
        viscoelastic.switched_force(old, new, x, staged=1, flip=5, slew=0.0)
    with pytest.raises(InputError, match="same T"):
        viscoelastic.switched_force(old, FOSLS(0.0, 1.0, 1.0, 0.5, T=2e-3), x, staged=1, flip=5, slew=1.0)


def test_loads_of_the_paper():
    assert viscoelastic.relaxation_load().tolist() == [5.0] * 3000
    creep = viscoelastic.creep_load(2e-3)
    assert creep.shape == (3000,) and set(creep[:1500]) == {3.0} and set(creep[1500:]) == {0.5}


def test_a_record_has_one_dtype_and_transforms():
    model = FOSLS(np.float32(1), 5, 5, 0.5)
    assert {leaf.dtype for leaf in jax.tree.leaves(model)} == {jnp.dtype("float32")}
    models = jax.vmap(functools.partial(FOSLS, 0.44))(jnp.array([1.0, 2.0]), jnp.ones(2), jnp.array([0.2, 0.3]))
    np.testing.assert_allclose(jax.vmap(FOSLS.dc_gain)(models)[1], FOSLS(0.44, 2.0, 1.0, 0.3).dc_gain())


@pytest.mark.parametrize(
    ("build", "sentence"),
    [
        (lambda: FOSLS(1.0, 1.0, 1.0, 0.0), "alpha is 0.0; it must be above 0 and at most 1"),
        (lambda: FOSLS(1.0, 1.0, 1.0, 1.1), "alpha is 1.1"),
        (lambda: FOSLS(1.0, 1.0, 1.0, np.nan), "alpha is nan"),
        (lambda: FOSLS(1.0, -1.0, 1.0, 0.5), "K1 is -1.0; it must be 0 or above"),
        (lambda: FOSLS(1.0, 1.0, -1.0, 0.5), "B1 is -1.0"),
        (lambda: FOSLS(1.0, 1.0, np.inf, 0.5), "B1 is inf"),
        (lambda: FOSLS(np.inf, 1.0, 1.0, 0.5), "K0 is inf"),
        (lambda: FOSLS(1.0, 1.0, 1.0, 0.5, T=0.0), "T is 0.0 s"),
        (lambda: FOSLS(*PRESETS[SYSID][:4], memory="full"), "K0 is -2.89; it must be 0 or above with full memory"),
        (lambda: FOSLS(1.0, 1.0, 1.0, 0.5).settling_time(1.0), "fraction is 1.0"),
    ],
)
def test_a_set_that_cannot_be_is_refused(build, sentence):
    with pytest.raises(InputError, match=sentence):
        build()
    with pytest.raises(ValueError, match="N is 0"):
        FOSLS(1.0, 1.0, 1.0, 0.5, N=0)


def test_half_relaxation_of_a_maxwell_model():
    rate = brentq(lambda t: np.exp(-5.0 / 0.3 * t) - 0.5, 0, 1)
    assert viscoelastic.maxwell(5.0, 0.3, memory="full").settling_time(0.5) == pytest.approx(rate, rel=1e-9)
