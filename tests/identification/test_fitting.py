"""Fits of measured tests: curves against filters, parameters against the truth, bounds and bad input."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import check_grad
from material import FOAM, foam_tests, force, loads, position

from hilbo.errors import InputError
from hilbo.identification.beginnings import untared
from hilbo.identification.fitting import Test, fit, nrmse
from hilbo.identification.memory_selection import select_memory, smallest
from hilbo.identification.sampled import Sampled
from hilbo.viscoelastic import FOSLS

ALONE = jnp.ones(1)


@pytest.mark.parametrize("N", [101, *(pytest.param(N, marks=pytest.mark.deep) for N in (1, 2, 1000))])
@pytest.mark.parametrize("kind", ["relaxation", "creep"])
def test_a_curve_is_that_of_the_filter(N, kind):
    parameters = FOAM if N <= 101 else (0.44, *FOAM[1:])
    test = next(t for t in foam_tests(N=N, parameters=parameters) if t.kind == kind)
    model = Sampled(N)
    predicted = model.predict(jnp.asarray(model.coordinates(*parameters)), model.prepare(test), ALONE)
    np.testing.assert_allclose(predicted, test.output[0], rtol=0, atol=1e-11 * np.ptp(test.output))


def test_full_memory_is_the_infinite_sum():
    (t, x), (u, F) = loads()
    exact = (0.44, 1.2, 3.0, 0.35)
    longer = 6001  # more taps than samples: nothing is cut
    K0 = exact[0]
    for kind, time, put, out in (
        ("relaxation", t, x, force(exact, x, longer)),
        ("creep", u, F, position(exact, F, longer)),
    ):
        model = Sampled(memory="full")
        q = jnp.asarray(model.coordinates(*exact))
        assert q[1] == K0
        predicted = model.predict(q, model.prepare(Test(kind, time, out[None], put[None])), ALONE)
        np.testing.assert_allclose(predicted, out, rtol=0, atol=1e-11 * np.ptp(out))


def test_an_equilibrium_before_the_first_row():
    (t, x), _ = loads()
    preload = x + 1.5
    model = Sampled()
    curve = model.prepare(Test("relaxation", t, force(FOAM, x)[None], preload[None], "equilibrium"))
    predicted = model.predict(jnp.asarray(model.coordinates(*FOAM)), curve, ALONE)
    expected = FOSLS(*FOAM).simulate(preload, start="equilibrium")
    np.testing.assert_allclose(predicted, expected, rtol=0, atol=1e-9)


def test_times_between_samples_are_interpolated():
    (t, x), _ = loads(hold=0.5)
    F = force(FOAM, x)
    times = np.sort(np.random.default_rng(0).uniform(0, 0.5, 50))
    times[0] = 0.0
    # The input has its corners at samples, so that nothing of it is lost.
    knots = np.unique(np.concatenate([times, [0.02]]))
    test = Test("relaxation", knots, np.interp(knots, t, F)[None], np.interp(knots, t, x)[None])
    model = Sampled()
    predicted = model.predict(jnp.asarray(model.coordinates(*FOAM)), model.prepare(test), ALONE)
    np.testing.assert_allclose(predicted, np.interp(knots, t, F), atol=1e-10)


def test_derivatives_of_a_curve():
    model, creep = Sampled(25), foam_tests(hold=0.1)[1]
    q, curve, pick = jnp.asarray(model.coordinates(*FOAM)), model.prepare(creep), jnp.arange(3, 200, 40)
    check_grad(jax.jit(lambda q: model.predict(q, curve, ALONE)[pick]), q, rtol=1e-6)


@pytest.mark.deep
@pytest.mark.parametrize("kinds", [("relaxation",), ("creep",), ("relaxation", "creep")])
def test_without_noise_the_parameters_come_back(kinds):
    tests = [test for test in foam_tests() if test.kind in kinds]
    fitted = fit(tests, Sampled())
    values = fitted.parameters()
    assert fitted.solution.converged
    assert [values[name] for name in ("K0", "K1", "B1", "alpha")] == pytest.approx(FOAM, rel=1e-6)
    assert values["K_eff"] == pytest.approx(0.44325, abs=5e-6)
    assert max(nrmse(fitted).values()) < 1e-9
    assert not np.any(fitted.held())


@pytest.mark.deep
def test_full_memory_comes_back_from_its_recursion():
    exact = FOSLS(0.44, 1.2, 3.0, 0.35, memory="full")
    (t, x), (u, F) = loads()
    tests = [
        Test("relaxation", t, np.asarray(exact.simulate(x))[None], x[None]),
        Test("creep", u, np.asarray(exact.simulate_force(F))[None], F[None]),
    ]
    values = fit(tests, Sampled(memory="full")).parameters()
    # The recursion is a sum of ten exponentials, off by up to 1e-4 of the largest force.
    assert [values[n] for n in ("K0", "K1", "B1", "alpha")] == pytest.approx((0.44, 1.2, 3.0, 0.35), rel=3e-3)
    assert nrmse(fit(tests, Sampled(memory="full")))["relaxation"] < 1e-4


@pytest.mark.deep
def test_repeats_with_different_inputs_are_one_fit():
    (t, x), _ = loads()
    sizes = np.array([[0.8], [1.0], [1.3]])
    test = Test("relaxation", t, sizes * force(FOAM, x), sizes * x)
    assert fit([test], Sampled()).parameters()["K1"] == pytest.approx(5.70, rel=1e-6)


@pytest.mark.deep
def test_a_fit_that_runs_away_says_so():
    (t, x), _ = loads()
    spring = Test("relaxation", t, (0.8 * x + 1e-4 * np.sin(40 * t))[None], x[None])
    fitted = fit([spring], Sampled())
    assert np.any(fitted.held()) or not fitted.solution.converged or fitted.parameters()["K_inst"] < 0.81


@pytest.mark.deep
def test_the_smallest_memory_of_an_n_101_material():
    rows = select_memory(foam_tests(), choices=(25, 101, None))
    errors = {row.N: row.nrmse for row in rows}
    assert max(errors[101].values()) < 1e-9
    assert min(errors[25].values()) > 5e-4
    best = smallest(rows)
    assert best is not None and best.N == 25  # all are far below 4 %
    assert smallest(rows, 1e-3).N == 101
    assert smallest([row for row in rows if row.N != 101], 5e-4) is None  # full memory has no number of taps


def of(kind="relaxation", points=50, **changes):
    t = np.arange(points) * 1e-3
    parts = {"time": t, "output": 1 + t[None], "input": np.ones((1, points))} | changes
    return Test(kind, **parts)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: of(points=5), "5 points"),
        (lambda: of(time=np.zeros(50)), "do not increase"),
        (lambda: of(output=np.full((1, 50), np.nan)), "not finite"),
        (lambda: of(output=np.ones((1, 50))), "does not change"),
        (lambda: of(input=np.zeros((1, 50))), "is 0 throughout"),
        (lambda: of(input=None), "needs the recorded input"),
        (lambda: of("modulus"), "has no input"),
        (lambda: Sampled(0), "N is 0"),
        (lambda: Sampled(T=-1.0), "T is -1.0"),
        (lambda: fit([], Sampled()), "no test to fit"),
        (lambda: fit([of("modulus", input=None)], Sampled()), "cannot be fitted"),
    ],
)
def test_bad_input_gets_one_sentence(make, words):
    with pytest.raises(InputError, match=words):
        make()


def signed(test, put=1.0, out=1.0, offset=0.0):
    """A test with other signs, and an offset of its position."""
    at = (0.0, offset) if test.kind == "creep" else (offset, 0.0)
    return Test(test.kind, test.time, out * test.output + at[1], put * test.input + at[0], test.start)


@pytest.mark.parametrize("kind", [0, 1])
def test_opposite_signs_are_refused_and_flipped_ones_are_not(kind):
    test = foam_tests(2, noise=0.04, hold=0.2)[kind]
    with pytest.raises(InputError, match=f"The {test.kind} test has position and force of opposite signs in repeat 1"):
        signed(test, put=-1)
    with pytest.raises(InputError, match="multiply one of them by -1"):
        signed(test, out=-1)
    signed(test, -1, -1)
    for offset in (-12.3, 12.3, -1000):  # a travel that is not tared is no opposite sign
        signed(test, offset=offset)


def test_one_repeat_of_opposite_sign_is_named():
    test = foam_tests(3, hold=0.2)[0]
    signs = np.array([[1.0], [-1.0], [1.0]])
    with pytest.raises(InputError, match="in repeat 2 of 3"):
        Test("relaxation", test.time, signs * test.output, test.input)


def test_opposite_signs_beside_a_preload():
    """From equilibrium the change counts: a pull from a push of 5 mm down to 0.1 mm has a force below 0 at first."""
    (t, x), _ = loads(hold=0.2)
    pull = 5 - 4.9 * x / 5
    F = FOSLS(*FOAM).simulate(pull, start="equilibrium")
    assert np.sum(np.asarray(F) * pull) < 0
    Test("relaxation", t, np.asarray(F)[None], pull[None], "equilibrium")
    with pytest.raises(InputError, match="opposite signs"):
        Test("relaxation", t, np.asarray(-F)[None], pull[None], "equilibrium")


def test_what_begins_off_zero_is_told_from_a_step_in_the_first_row():
    (t, x), (_, F) = loads(hold=0.2)
    relaxed, crept = force(FOAM, x), position(FOAM, F)
    assert untared(x, relaxed) is None and untared(F, crept) is None
    for offset in (0.5, -12.3, 1000):
        assert untared(x + offset, relaxed) == "input" and untared(F, crept + offset) == "output"
    assert untared(x, relaxed + 0.3) == "output"
    ideal, late = force(FOAM, np.full(t.size, 5.0)), position(FOAM, np.full(t.size, 3.0))
    late[0] = 0.0  # the row before the material moves
    assert untared(np.full(t.size, 5.0), ideal) is None and untared(np.full(t.size, 3.0), late) is None
    held = 3.0 - 2.5 * (t > 0.1)
    late = position(FOAM, held)
    late[0] = 0.0
    assert untared(held, late) is None
    assert untared(x[10:], relaxed[10:]) is None and untared(F[3:], crept[3:]) is None  # begins within the ramp


def test_a_test_that_lasts_too_long_for_its_t_is_refused_before_memory_ends():
    time = 60.0 * np.arange(1441)
    day = Test("relaxation", time, 1 + np.exp(-time / 3600)[None], np.ones((1, time.size)))
    words = "lasts 86400 s, which is 86,400,000 samples of T = 0.001 s, .* --longest 2000, or give a larger --T"
    with pytest.raises(InputError, match=words):
        fit([day], Sampled())
    Sampled(T=0.1).prepare(day)


def test_every_number_of_taps_is_the_same_compiled_function():
    tests = foam_tests(hold=0.2)
    one, other = (Sampled(N).at(tests) for N in (2, 101))
    static = [eqx.partition(model, eqx.is_array)[1] for model in (one, other)]
    assert static[0] == static[1]
