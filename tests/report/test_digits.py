"""Digits of numbers on pages: those that the uncertainty allows."""

import math

import pytest
from studies import PLAIN

from hilbo.report.digits import decimals, parameter_text, rounded
from hilbo.report.page import footnotes
from hilbo.study.config import Study

STUDY = Study.from_dict(
    PLAIN
    | {
        "parameters": {
            "rate": {"low": 300.0, "high": 25000.0, "scale": "log"},
            "order": {"low": 0.01, "high": 0.99},
            "count": {"low": 1, "high": 9, "integer": True},
            "texture": {"levels": ["silk", "wood"]},
        }
    }
)


@pytest.mark.parametrize(("spread", "number"), [(0.012, 3), (0.1, 2), (1.0, 1), (9.9, 1), (10.0, 0), (4071.0, 0)])
def test_an_uncertainty_has_two_significant_digits(spread, number):
    assert decimals(spread) == number


def test_a_number_has_the_digits_of_its_uncertainty():
    assert rounded(5.0374, 0.81) == "5.04" and rounded(5.0374, 4.9) == "5.0" and rounded(math.nan, 1.0) == "–"
    assert rounded(0.123456, 0.0) == rounded(0.123456, math.inf) == "0.1235"


def test_a_parameter_without_an_interval_has_digits_of_its_range():
    assert parameter_text(STUDY, "order", 0.15694) == "0.157" and parameter_text(STUDY, "order", 0.15694, 0.3) == "0.16"
    assert parameter_text(STUDY, "rate", 4073.7) == "4074" and parameter_text(STUDY, "rate", 301.26) == "301"
    assert parameter_text(STUDY, "count", 7.0, 0.4) == "7" and parameter_text(STUDY, "texture", "silk") == "silk"


def test_a_footnote_is_at_the_number_that_it_concerns():
    sentences = [
        "The optimum is at the highest order that was searched (0.99): values beyond it were not tested.",
        "Inconclusive: the 95 % credible region of the optimum covers 86 % of the feasible region.",
        "Participants differ in order.",
    ]
    marks = {"order": [1], "region": [2], "optimum": [3]}
    assert footnotes(sentences, ["rate", "order", "count"]) == marks
