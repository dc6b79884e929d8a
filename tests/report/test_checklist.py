"""The checklist, which goes into papers, says which covariance was used and what the optimum is."""

import dataclasses
from types import SimpleNamespace

import equinox as eqx
import pytest
from studies import plain

from hilbo.kernels import Matern32
from hilbo.report.study.checklist import _model, _posterior


@pytest.mark.parametrize(
    ("rule", "kernel", "words", "optimum"),
    [
        ("bcm", None, "a squared-exponential covariance", "presented, the maximum of the population map: u 0.4"),
        (
            "learnt-2",
            Matern32([5.86, 4.07], 5.4),
            "a Matérn 3/2 covariance",
            "the point that is most often near",
        ),
    ],
)
def test_it_says_what_the_rule_used(rule, kernel, words, optimum):
    study = dataclasses.replace(plain(), rule=rule)
    if kernel is not None:
        study = eqx.tree_at(lambda s: s.gp.kernel, study, kernel)
    analysis = SimpleNamespace(study=study, aggregate=SimpleNamespace(map=SimpleNamespace(effects=None)))
    assert words in _model(analysis) and ("with θ = 5.86, 4.07" in _model(analysis) or rule == "bcm")
    best = {"parameters": {"u": 0.4, "v": 15.0}, "mean": 1.0, "sd": 0.2}
    assert optimum in _posterior(analysis, {"optimum": best})
