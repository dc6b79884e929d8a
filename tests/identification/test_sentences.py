"""What a fit says of drift, lag and filter."""

import pytest

from hilbo.identification import sentences
from hilbo.identification.estimates import Estimate


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
