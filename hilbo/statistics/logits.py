"""Binary and ordered logit of the responses of a validation session, with every kind of standard error.

Binary: P(y = 1) = σ(β0 + x·β). Ordered, categories 0..C-1: P(y <= c) = σ(t_c - x·β), so that a positive coefficient
shifts responses to higher categories (McCullagh 1980). `hilbo.statistics.regression` documents the assumptions of each
kind of error, and separated coefficients. `hilbo.statistics.paper_tables` makes the paper's tables II to IV with these.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pandas as pd
from scipy.special import logit

from hilbo.errors import InputError
from hilbo.statistics import ordered_logit as likelihood
from hilbo.statistics.columns import Columns, check_aligned, is_yes_or_no, predictors_of
from hilbo.statistics.regression import Clusters, Regression, regress

__all__ = ["binary_logit", "ordered_logit", "tied_preferences"]

Predictors = Columns


def binary_logit(
    outcome: Sequence | np.ndarray | pd.Series,
    predictors: Predictors | None = None,
    clusters: Clusters | None = None,
    *,
    intercept: str = "Intercept",
    level: float = 0.95,
) -> Regression:
    """Logit of a yes/no outcome (n,) on an intercept and the columns of `predictors`.

    `clusters`: up to two columns that name the cluster of every answer, participants say. An outcome that never
    changes has no finite intercept and is answered with a one-sided interval.
    Raises `InputError` for an outcome that is empty or not of 0 and 1, and, here and below, for Series and frames whose
    row labels differ.
    """
    check_aligned(outcome=outcome, predictors=predictors, clusters=clusters)
    success = np.asarray(outcome)
    if success.ndim != 1 or not is_yes_or_no(success):
        raise InputError("the outcome of a binary logit must be a list of 0 and 1 (or no and yes), and not empty.")
    names, x = predictors_of(predictors, len(success))
    x = np.column_stack([np.ones(len(success)), x])
    model = likelihood.design(success.astype(int), x, np.zeros((1, 0)))
    start = np.zeros(x.shape[1])
    return regress(model, [intercept, *names], start, clusters, level=level)


def ordered_logit(
    category: Sequence | np.ndarray | pd.Series,
    predictors: Predictors,
    clusters: Clusters | None = None,
    *,
    categories: Sequence[str] | None = None,
    level: float = 0.95,
) -> Regression:
    """Ordered logit of categories (n,), ints from 0, on the columns of `predictors` (no constant).

    `categories` names them, lowest first; the edge between two is the term "a|b". A category that never occurs has no
    edge of its own. Raises `InputError` for categories that are no such list or have no name, if fewer than two occur,
    and as `binary_logit`.
    """
    check_aligned(category=category, predictors=predictors, clusters=clusters)
    answers = np.asarray(category)
    if answers.ndim != 1 or not answers.size or not np.issubdtype(answers.dtype, np.integer) or answers.min() < 0:
        raise InputError("the categories of an ordered logit must be a list of whole numbers from 0, and not empty.")
    labels = [str(c) for c in range(answers.max() + 1)] if categories is None else list(categories)
    used, ranks = np.unique(answers, return_inverse=True)
    if used[-1] >= len(labels):
        raise InputError(f"category {used[-1]} has no name; {len(labels)} are given.")
    if len(used) < 2:
        raise InputError(f'all {len(answers)} answers are "{labels[used[0]]}": there is nothing to compare.')
    names, x = predictors_of(predictors, len(answers))
    edges = [f"{labels[a]}|{labels[b]}" for a, b in pairwise(used)]
    model = likelihood.design(ranks.ravel(), x, np.eye(len(edges)))
    below = np.cumsum(np.bincount(ranks.ravel()))[:-1] / len(answers)
    start = np.concatenate([np.zeros(x.shape[1]), logit(below)])
    return regress(model, [*names, *edges], start, clusters, nuisance=len(edges), level=level)


def tied_preferences(
    first: Sequence | np.ndarray | pd.Series,
    second: Sequence | np.ndarray | pd.Series,
    preferred: Sequence | np.ndarray | pd.Series,
    clusters: Clusters | None = None,
    *,
    reference: str | None = None,
    order: Sequence | np.ndarray | None = None,
    level: float = 0.95,
) -> Regression:
    """Strengths of sets from paired comparisons with ties, by the model of Rao & Kupper (1967).

    P(a beats b) = σ(λ_a - λ_b - η), P(b beats a) = σ(λ_b - λ_a - η), the rest are ties: an ordered logit with edges
    ∓η. Without ties η = 0 and it is Bradley & Terry's model. `preferred` is one of the two sets or "tie" for each
    comparison; the strength of `reference` (default: the last in the alphabet) is 0. `order` (+1 if `first` was shown
    first, -1 if not, 0 if not known) adds the term "shown first".
    All sequences are (n,), one entry a comparison. Raises `InputError` for a preference that is neither set nor a tie,
    for a set called "tie", for a `reference` that is in no comparison, and for another `order`.
    """
    check_aligned(first=first, second=second, preferred=preferred, clusters=clusters, order=order)
    left, right, chosen = (np.asarray(column, str) for column in (first, second, preferred))
    sets = _sets_compared(left, right, chosen)
    reference = sets[-1] if reference is None else reference
    if reference not in sets:
        raise InputError(f'the reference "{reference}" is in no comparison; the sets are {", ".join(sets)}.')
    sets.remove(reference)
    x = np.array([(left == name).astype(float) - (right == name) for name in sets]).T.reshape(len(left), len(sets))
    shown_first = _shown_first(order, len(left))
    if shown_first.any():
        sets, x = [*sets, "shown first"], np.column_stack([x, shown_first.astype(float)])
    ties = bool((chosen == "tie").any())
    won = np.where(chosen == left, 1, 0) * (2 if ties else 1) + (chosen == "tie")
    model = likelihood.design(won, x, np.array([[-1.0], [1.0]]) if ties else np.zeros((1, 0)))
    start = np.concatenate([np.zeros(x.shape[1]), np.ones(int(ties))])
    terms = [*sets, *(["tie"] if ties else [])]
    return regress(model, terms, start, clusters, nuisance=int(ties), level=level)


def _sets_compared(left: np.ndarray, right: np.ndarray, chosen: np.ndarray) -> list[str]:
    """Names of all sets in the comparisons (n,), sorted. Raises `InputError` for invalid comparisons."""
    if not left.shape == right.shape == chosen.shape == (left.size,):
        raise InputError("first, second and preferred must be lists of one length: an entry each for a comparison.")
    wrong = (chosen != left) & (chosen != right) & (chosen != "tie")
    if not left.size or wrong.any():
        raise InputError(
            "every comparison must prefer one of its two sets, or be a tie; and there must be one at least."
        )
    sets = sorted({*left, *right})
    if "tie" in sets:
        raise InputError('a set called "tie" cannot be distinguished from a tie; give it another name.')
    return sets


def _shown_first(order: Sequence | np.ndarray | None, count: int) -> np.ndarray:
    """`order` as an array (count,), all 0 if it is None. Raises `InputError` for other values than 1, -1 and 0, and a
    wrong length."""
    shown_first = np.zeros(count) if order is None else np.asarray(order)
    if shown_first.shape != (count,) or pd.isna(shown_first).any() or not np.isin(shown_first, (-1, 0, 1)).all():
        raise InputError("order must be 1, -1 or 0 for each comparison: first was shown first, second, or unknown.")
    return shown_first
