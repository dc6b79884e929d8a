"""Evidence of the paper's hypotheses: what ties with its bound says nothing, whichever way the scale runs."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from studies import plain

from hilbo.population.maps import RuleMap
from hilbo.report.study.hypotheses import _convergence, _individuals, _largest, _validation


@pytest.mark.parametrize(
    ("counts", "side"),
    [
        ([[10, 9, 1], [4, 12, 4], [1, 9, 10]], "supports"),
        ([[10, 10, 0], [4, 12, 4], [1, 9, 10]], "inconclusive"),  # best as often "similar"
        ([[10, 9, 1], [4, 12, 4], [0, 10, 10]], "inconclusive"),  # its mirror image
        ([[10, 10, 0], [4, 12, 4], [1, 11, 10]], "contradicts"),
        ([[5, 5, 5], [5, 5, 5], [5, 5, 5]], "inconclusive"),
    ],
)
def test_a_tie_of_answers_says_nothing_whichever_way_the_scale_runs(counts, side):
    """Best, mid and worst by the three answers, highest first; reversed, the worst set is the best."""
    for way in (1, -1):
        tables = SimpleNamespace(confusion=pd.DataFrame(np.array(counts)[::way, ::way]))
        (item,) = _validation(SimpleNamespace(tables=tables, regressions=dict), plain())
        assert item.side == side
        assert item.text.endswith("of the cases (supports: each is the most frequent response to its set).")


@pytest.mark.parametrize(
    ("first", "last", "sixth", "chances", "sides"),
    [
        ([2, 0], [2, 0], [2, 0, 2, 0], [[0.2, 0.3, 0.5], [0.5, 0.3, 0.2]], ["inconclusive", "inconclusive"]),
        ([2, 0], [2, 2], [0, 0, 2, 2], [[0.2, 0.3, 0.5], [0.4, 0.2, 0.4]], ["supports", "inconclusive"]),
        ([2, 2], [2, 0], [2, 2, 0, 0], [[0.2, 0.3, 0.5], [0.2, 0.3, 0.5]], ["contradicts", "supports"]),
        ([0, 0], [0, 0], [0, 0, 0, 0], [[0.5, 0.3, 0.2], [0.2, 0.6, 0.2]], ["inconclusive", "contradicts"]),
        ([2, 0], [2, 2], [2, 0, 2, 2], [[0.2, 0.3, 0.5], [0.4, 0.2, 0.4]], ["inconclusive", "inconclusive"]),
    ],
)
def test_equal_shares_half_of_the_people_and_differences_without_a_spread_say_nothing(
    first, last, sixth, chances, sides
):
    """Six participants with six trials each; five of them respond identically."""
    answers = np.array([[*first, 1, 1, *last]] * 5 + [[*sixth[:2], 1, 1, *sixth[2:]]])
    trials = SimpleNamespace(q=answers, mask=np.ones((6, 6), bool))
    cohort = SimpleNamespace(names=tuple("ABCDEF"), trials=trials, counts=lambda: np.full(6, 6))
    aggregate = SimpleNamespace(individuals=SimpleNamespace(class_probabilities=np.array(chances * 3)))
    progress = SimpleNamespace(counts=np.arange(2), splits=0)
    analysis = SimpleNamespace(study=plain(), cohort=cohort, aggregate=aggregate, progress=progress)
    assert [item.side for item in _individuals(SimpleNamespace(analysis=analysis))] == sides


def test_what_is_equal_to_rounding_is_equal():
    assert _largest(np.array([0.3, 0.35, 0.35 + 1e-16]), -1) == _largest(np.array([0.1, np.nan]), -1) == "inconclusive"
    assert _largest(np.array([0.3, 0.35, 0.35 + 1e-6]), -1) == "supports"


@pytest.mark.parametrize(
    ("farther", "side", "words"),
    [
        ([0.30, 0.40, 0.36, 0.36], "inconclusive", "farther by 0.5 % (95 % interval -6.1 to 7.1) on average"),
        ([0.50, 0.60, 0.56, 0.56], "supports", "farther by 20.5 % (95 % interval 13.9 to 27.1) on average"),
        ([0.10, 0.20, 0.16, 0.16], "contradicts", "farther by -19.5 % (95 % interval -26.1 to -12.9) on average"),
    ],
)
def test_individuals_and_halves_are_compared_with_an_interval(farther, side, words):
    """Distances of four individual optima after a third of the trials; of halves it is 0.35."""
    distances = np.array([[0.0] * 4, farther, [0.1] * 4])
    progress = SimpleNamespace(
        counts=np.array([1, 8, 25]), splits=2, halves=np.full((3, 4), 0.35), individual_to_half=distances
    )
    map_ = RuleMap("bcm", "by points", None, None, jnp.zeros(()), jnp.ones(()))
    analysis = SimpleNamespace(progress=progress, aggregate=SimpleNamespace(map=map_))
    (item,) = _convergence(SimpleNamespace(analysis=analysis, reference=None))
    assert item.side == side and words in item.text
