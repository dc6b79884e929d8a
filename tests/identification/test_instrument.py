"""Lag and filter of a force channel, against a simulation on a grid ten times finer."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import identification_coverage as study
from hilbo.errors import InputError
from hilbo.identification.characterise import characterise
from hilbo.identification.fitting import Test, fit
from hilbo.identification.instrument import can_be_timed, clear_changes
from hilbo.identification.sampled import Sampled


def data_set(case, number=0, hold=0.15, noise=None):
    """Both tests of one data set; `noise` times that of the study."""
    silent = noise is not None
    kept = study.NOISE, study.JITTER
    study.NOISE, study.JITTER = (noise * size if silent else size for size in kept)
    try:
        records = list(study.records(case, number, hold))
    finally:
        study.NOISE, study.JITTER = kept
    return [Test(kind, t, *((F, x) if kind == "relaxation" else (x, F))) for kind, t, x, F in records]


@pytest.mark.parametrize(
    ("lag", "corner"),
    [
        (0.3, None),
        (0.0, 200.0),
        *(
            pytest.param(*pair, marks=pytest.mark.deep)
            for pair in ((-0.3, None), (0.7, None), (1.4, None), (0.4, 250.0), (-0.3, 250.0))
        ),
    ],
)
def test_a_recorded_curve_is_that_of_the_fine_grid(lag, corner):
    for test in data_set(study.Case("", repeats=1, lag=lag, corner=corner), noise=1e-3):
        model = Sampled(lag=1e-3 * lag, corner=corner or np.inf)
        q, curve = jnp.asarray(model.coordinates(*study.TRUTH)), model.prepare(test).fitted
        predicted = jax.jit(lambda q, m=model, c=curve: m.predict(q, c, jnp.ones(1)))(q)
        ideal = Sampled().predict(q, curve, jnp.ones(1))
        size, recorded = np.ptp(curve.output), curve.output[0]
        assert np.abs(ideal - recorded).max() > 5e-3 * size  # without an instrument
        np.testing.assert_allclose(predicted, recorded, rtol=0, atol=2e-4 * size if lag < 0 else 5e-5 * size)


def test_a_shift_does_not_touch_noise():
    rng, values = np.random.default_rng(0), np.repeat([0.0, 3.0], [200, 800])
    values[200:220] = np.linspace(0, 3, 20)
    clear = clear_changes(values + 0.02 * rng.standard_normal((6, 1000)))
    assert clear[200:221].all() and not clear[:190].any() and not clear[230:].any()


def test_a_creep_test_is_fitted_in_the_channel_that_has_the_noise():
    creep = data_set(study.Case("", repeats=2))[1]
    curve = Sampled().prepare(creep)
    assert curve.kind == "creep" and curve.fitted.kind == "relaxation"
    np.testing.assert_array_equal(curve.fitted.output, creep.input)
    loud = creep.output + 0.3 * np.random.default_rng(0).standard_normal(creep.output.shape)
    assert Sampled().prepare(Test("creep", creep.time, loud, creep.input)).other_way is None


def test_slow_inputs_have_no_lag():
    t = np.arange(2000) * 1e-3
    x = np.sin(2 * np.pi * 0.05 * t) + 0.01 * np.random.default_rng(0).standard_normal((2, t.size))
    assert not can_be_timed([Test("relaxation", t, x, x)])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"lag": 0.01}, "The lag is 10 ms; it must be between -2 and 2 ms"),
        ({"lag": "late"}, "each must be a number or"),
        ({"corner": 10.0}, "The corner is 10 Hz; it must be 31.8 Hz or more"),
        ({"corner": np.nan}, "The corner is nan Hz"),
    ],
)
def test_bad_instruments_get_one_sentence(options, words):
    with pytest.raises(InputError, match=words):
        Sampled(**options)


def test_a_fit_at_the_bounds_of_lag_and_corner_can_be_held():
    for corner in Sampled()._corners():
        Sampled(lag=2e-3 * (1 + 1e-15), corner=corner * (1 - 1e-15))


def test_coordinates_are_named_with_their_units():
    model = Sampled(lag="fit", corner="fit")
    q = jnp.asarray(model.coordinates(*study.TRUTH, lag=2e-4, corner=150.0))
    assert model.labels == ("K_inst", "K_eff", "kappa", "alpha", "lag", "corner")
    named = dict(zip(model.labels, np.asarray(model.natural(q)), strict=True))
    assert named["lag"] == pytest.approx(0.2) and named["corner"] == pytest.approx(150)
    assert Sampled(corner="fit").labels[4:] == ("corner",) and len(Sampled().coordinates(*study.TRUTH)) == 4


@pytest.mark.deep
@pytest.mark.parametrize(("lag", "corner"), [(0.3, None), (-0.7, None), (0.0, 200.0), (0.4, 250.0)])
def test_lag_and_corner_come_back(lag, corner):
    tests = data_set(study.Case("", repeats=1, lag=lag, corner=corner), hold=1.0, noise=1e-3)
    values = fit(tests, Sampled(lag="fit", corner="fit" if corner else np.inf))
    named = dict(zip(values.model.labels, np.asarray(values.model.natural(values.q)), strict=True))
    assert named["lag"] == pytest.approx(lag, abs=0.01)
    assert corner is None or named["corner"] == pytest.approx(corner, rel=0.02)
    assert values.parameters()["K1"] == pytest.approx(5.70, rel=0.02)


@pytest.mark.deep
@pytest.mark.parametrize("name", ["lag 0.3", "filter"])
def test_intervals_hold_the_truth_under_a_bad_instrument(name):
    case = study.CASES[name]
    truth, inside, kinds = study.truth_of(case), [], set()
    for number in range(4):
        result = characterise(data_set(case, number, hold=1.0), Sampled(lag="fit"))
        kinds |= {
            words.split(":")[0].split(" is ")[1][:8] for words in result.warnings if words.startswith("The force")
        }
        inside += [study.holds(tuple(result.estimates[p]), truth[p]) is True for p in ("K0", "K1", "B1", "alpha")]
    assert sum(inside) >= 13  # of 16
    assert ("filtered" if name == "filter" else "recorded") in kinds
