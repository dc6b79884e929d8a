"""What a fit says of drift, lag and filter."""

import numpy as np
import pytest

from hilbo.identification import sentences
from hilbo.identification.estimates import Estimate
from hilbo.identification.fitting import Test
from hilbo.identification.recorded import hold_at_end


def test_drift_is_named_and_what_a_bootstrap_does_not_see():
    row = {"drift": 1e-4, "repeats": 6}
    (words,) = sentences._residuals({"creep": row})
    assert "The residuals of the creep test drift slowly" in words
    assert "bootstrap does not contain a drift that all repeats share" in words
    (words,) = sentences._residuals({"creep": row | {"repeats": 4}})  # too few for a bootstrap
    assert "bootstrap" not in words
    assert not list(sentences._residuals({"creep": row | {"drift": 0.02}}))


@pytest.mark.parametrize(
    ("value", "words"),
    [(0.3, "The force is recorded 0.3 ms late (0.28 to 0.32 ms)"), (-0.3, "The position is recorded 0.3 ms late")],
)
def test_a_lag_is_named_with_its_sign(value, words):
    (said,) = sentences._instrument({"lag": Estimate(value, value - 0.02, value + 0.02, "identified")})
    assert words in said


def test_a_perfect_instrument_is_not_mentioned():
    assert not list(sentences._instrument({"lag": Estimate(0.02, -0.001, 0.041, "identified")}))
    assert not list(sentences._instrument({"lag": Estimate(0.0, None, 0.5, "one-sided")}))
    assert not list(sentences._instrument({}))


def test_a_filter_is_named_with_its_corner():
    (said,) = sentences._instrument({"corner": Estimate(200.0, 190.0, 215.0, "identified")})
    assert "a first-order filter with a corner of 200 Hz (190 to 215 Hz)" in said and "--corner" in said


@pytest.mark.parametrize(
    ("kind", "output", "words"),
    [
        (
            "relaxation",
            1 + 0.1 * np.arange(20),
            "the force of the relaxation test rises from 1.1 to 2.9 N while its pos",
        ),
        (
            "creep",
            2 - 0.1 * np.arange(20),
            "the position of the creep test falls from 1.9 to 0.1 mm while its force is",
        ),
        ("relaxation", 3 - 0.1 * np.arange(20), "N/mm, below 0, which no viscoelastic material has; check the columns"),
    ],
)
def test_a_stiffening_material_is_described_by_its_hold(kind, output, words):
    test = Test(kind, np.arange(20.0), output[None], np.minimum(np.arange(20.0), 1)[None])
    sentence = sentences.stiffening(-0.5, (test,))
    assert words in sentence and sentence.startswith("The best fit has K1 = -0.5 N/mm")


def test_the_hold_at_the_end_of_a_test():
    time, applied = np.arange(20.0), np.r_[0, 1, np.full(8, 2.0), np.full(10, 1.0)]
    assert hold_at_end(Test("relaxation", time, time[None], applied[None])) == slice(10, None)
    assert hold_at_end(Test("relaxation", time, time[None], time[None])) is None
    assert hold_at_end(Test("modulus", time, 1 + time[None])) is None
