"""Fitted logit with every kind of standard error in one tidy table.

| errors | what they assume |
|---|---|
| iid | every response independent of every other |
| clustered by A | A's clusters independent, and many; t with G - 1 degrees of freedom |
| clustered by A and B | responses that share neither independent; t with the smaller G - 1 |
| jackknife by A | as clustered by A; larger where few or unequal clusters decide an estimate |
| profile likelihood | as iid; for a coefficient that has no finite estimate |

`docs/methods/statistics.md` recommends which to use, from their coverage in simulated studies. statsmodels fits and
clusters; the table, its warnings and the separated coefficients are added here.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import numpy as np
import pandas as pd
from jaxtyping import Float, Int
from scipy import stats

from hilbo.errors import InputError
from hilbo.statistics import ordered_logit
from hilbo.statistics.cluster_robust import Covariance, clustered, jackknifed
from hilbo.statistics.columns import Columns, check_level, labels_of
from hilbo.statistics.ordered_logit import Design, Fit
from hilbo.statistics.separation import Separation, decisive, independent, profile, separation

__all__ = ["Clusters", "Errors", "Regression", "regress"]

Clusters = Columns  # one for each way
_FEW_CLUSTERS = 12
_NO_SPREAD = 1e-8  # of the iid error: clusters that agree to rounding
_NOTHING_LEFT = (
    "nothing is left to estimate an error from (clusters agree exactly, or the two-way variance is negative)"
)


class Regression(eqx.Module):
    """A fitted logit.

    `table` has one row per coefficient and kind of error: `term`, `estimate`, `errors`, `std_error`, `statistic`,
    `degrees_of_freedom`, `p_value` (of 0), `low`, `high`, `odds_ratio`, `odds_low`, `odds_high`, `assumes`.
    `covariances` contains the covariance of the finite estimates by kind of error, `clusters` the number of clusters by
    each way, `warnings` one sentence for each thing to know before the table is believed.
    """

    table: pd.DataFrame
    covariances: dict[str, pd.DataFrame]
    log_likelihood: float
    answers: int
    clusters: dict[str, int]
    warnings: tuple[str, ...]

    def by(self, errors: str) -> pd.DataFrame:
        """Rows with one kind of error, indexed by term; coefficients without a finite estimate are included."""
        kinds = [errors, "profile likelihood"]
        return self.table[self.table["errors"].isin(kinds)].set_index("term")


class Errors(eqx.Module):
    """One kind of standard error: its name, its assumptions, and the covariance."""

    name: str
    assumes: str
    covariance: Covariance

    def in_units(self, units: Float[np.ndarray, " k"]) -> "Errors":
        """Errors of the coefficients after multiplying each column by its unit."""
        matrix = self.covariance.matrix / np.outer(units, units)
        return eqx.tree_at(lambda errors: errors.covariance.matrix, self, matrix)

    @property
    def std_errors(self) -> Float[np.ndarray, " k"]:
        """Standard error of every coefficient."""
        return np.sqrt(np.diag(self.covariance.matrix))


def regress(
    model: Design,
    terms: Sequence[str],
    start: Float[np.ndarray, " k"],
    clusters: Clusters | None = None,
    *,
    nuisance: int = 0,
    level: float = 0.95,
) -> Regression:
    """Fit `model` and tabulate the estimates with every kind of standard error.

    The last `nuisance` coefficients (edges of categories) get no profile. `start` has its edges in order. Raises
    `InputError` for linearly dependent coefficients, for more than two clustering variables, and for a level that is
    not between 0 and 1.

    Everything is computed in units in which the largest entry of each column is about 1, because ranks, linear programs
    and the repair of covariances compare columns with each other. The units are powers of two, which cause no rounding.
    """
    check_level(level)
    names, effects = list(terms), len(terms) - nuisance
    model, units = _in_own_units(model)
    start = start * units
    labels = labels_of(clusters, len(model.upper))
    _check_independent(model, names, nuisance)
    separated = separation(model)
    warnings = [_separated_sentence(names, separated, effects)] if separated.infinite.any() else []
    rows, covariances, log_likelihood = [], {}, 0.0
    if not separated.certain.all():
        rest, keep, rest_start = decisive(model, start, separated)
        fitted = ordered_logit.fit(rest, rest_start)
        log_likelihood = fitted.log_likelihood
        kinds, refused = _kinds(rest, fitted, {name: codes[~separated.certain] for name, codes in labels.items()})
        kinds, estimate = [kind.in_units(units[keep]) for kind in kinds], fitted.estimate / units[keep]
        finite = {j: names[i] for j, i in enumerate(np.flatnonzero(keep)) if not separated.infinite[i]}
        warnings += [*refused, *_below_iid(kinds, finite)]
        covariances = {kind.name: _covariance(kind, finite) for kind in kinds}
        least = kinds[0].std_errors
        rows += [_wald(term, estimate[j], j, kind, least, level) for j, term in finite.items() for kind in kinds]
    rows += [
        _profiled(model, j, names[j], start, separated, level if j < effects else None, units[j])
        for j in np.flatnonzero(separated.infinite).tolist()
    ]
    counts = {name: len(np.unique(codes)) for name, codes in labels.items()}
    table = _tidy(rows, names, effects)
    return Regression(table, covariances, log_likelihood, len(model.upper), counts, tuple(warnings))


def _in_own_units(model: Design) -> tuple[Design, Float[np.ndarray, " k"]]:
    """Design with columns scaled to a largest entry of about 1, and the power of two by which each was divided (k,)."""
    largest = np.abs(np.vstack([model.upper, model.lower])).max(axis=0)
    units = 2.0 ** np.round(np.log2(np.where(largest > 0, largest, 1.0)))
    return model._replace(upper=model.upper / units, lower=model.lower / units), units


def _covariance(kind: Errors, terms: Mapping[int, str]) -> pd.DataFrame:
    """Covariance of the coefficients `terms` (index -> name) as a table with their names."""
    shown = list(terms.values())
    return pd.DataFrame(kind.covariance.matrix[np.ix_(list(terms), list(terms))], shown, shown)


def _check_independent(model: Design, names: list[str], nuisance: int) -> None:
    """Raise `InputError` for a column that is a linear combination of the others."""
    order = np.roll(np.arange(len(names)), nuisance)  # edges first: a constant predictor is at fault, not an edge
    good = independent(model.columns(order))
    if not good.all():
        name = names[order[np.argmin(good)]]
        raise InputError(
            f'"{name}" is a combination of the other coefficients (such as a constant or a duplicate); leave it out.'
        )


def _kinds(model: Design, fitted: Fit, labels: Mapping[str, Int[np.ndarray, " n"]]) -> tuple[list[Errors], list[str]]:
    """All kinds of standard errors that the data allow, iid first, and a sentence for each that they do not allow.
    `model`: the design of `fitted`."""
    kinds = [Errors("iid", "all answers are independent", Covariance(fitted.covariance, np.inf, 0.0))]
    counts = {name: len(np.unique(codes)) for name, codes in labels.items()}
    usable = [name for name, count in counts.items() if count > 1]
    warnings = [f"There is one {name} only: no error can be clustered by it." for name in labels if name not in usable]
    n, k = fitted.scores.shape
    if usable and n <= k:
        warnings.append(f"{n} answers decide {k} coefficients: no error can be clustered.")
        return kinds, warnings
    for names in [[name] for name in usable] + ([usable] if len(usable) == 2 else []):
        both = " and ".join(names)
        covariance = clustered(fitted, *(labels[name] for name in names))
        sizes = " and ".join(f"{counts[name]} of {name}" for name in names)
        assumes = f"answers that share no {' or '.join(names)} are independent; clusters: {sizes}"
        kinds.append(Errors(f"clustered by {both}", assumes, covariance))
        if covariance.repaired:
            warnings.append(
                f"The covariance clustered by {both} was indefinite (worst eigenvalue {-covariance.repaired:.1%} of the"
                " largest of the one-way terms) and was repaired; its errors may be too small."
            )
    for name in usable:
        covariance = jackknifed(model, fitted, labels[name])
        if covariance is None:
            warnings.append(f"Without one {name} the answers do not decide all coefficients: no jackknife by {name}.")
            continue
        assumes = f"answers that share no {name} are independent; clusters: {counts[name]} of {name}"
        kinds.append(Errors(f"jackknife by {name}", assumes, covariance))
    few = min((counts[name] for name in usable), default=_FEW_CLUSTERS + 1)
    if few <= _FEW_CLUSTERS:
        warnings.append(f"There are {few} clusters by one way: report the widest interval.")
    return kinds, warnings


def _below_iid(kinds: list[Errors], terms: Mapping[int, str]) -> list[str]:
    """A warning for each kind of clustered error that is smaller than the iid error of some coefficient. `kinds`: iid
    first; `terms`: index -> name of the coefficients to compare."""
    reference, sentences = kinds[0].std_errors, []
    for kind in kinds:
        if not kind.name.startswith("clustered"):
            continue
        errors = kind.std_errors
        less = {j: name for j, name in terms.items() if errors[j] < reference[j]}
        below = [f"{name} ({errors[j]:.3g} against {reference[j]:.3g})" for j, name in less.items()]
        if below:
            sentences.append(
                f"Errors {kind.name} are below the iid ones for {', '.join(below)}: by chance, or because answers"
                " within a cluster differ more than chance allows; report the larger."
            )
    return sentences


def _wald(
    term: str, estimate: float, j: int, kind: Errors, iid_errors: Float[np.ndarray, " k"], level: float
) -> dict[str, Any]:
    """Table row of coefficient j with one kind of error, by t (normal for iid). Without an interval if the error is 0
    up to rounding."""
    error, dof = float(kind.std_errors[j]), kind.covariance.degrees_of_freedom
    if error <= _NO_SPREAD * iid_errors[j]:
        return _row(term, estimate, kind.name, f"{kind.assumes}; {_NOTHING_LEFT}", degrees_of_freedom=dof)
    half_width, statistic = float(stats.t.ppf((1 + level) / 2, dof)) * error, estimate / error
    numbers = {"std_error": error, "statistic": statistic, "degrees_of_freedom": dof}
    numbers |= {"p_value": float(2 * stats.t.sf(abs(statistic), dof))}
    return _row(
        term, estimate, kind.name, kind.assumes, **numbers, low=estimate - half_width, high=estimate + half_width
    )


def _profiled(
    model: Design, j: int, term: str, start: np.ndarray, separated: Separation, level: float | None, unit: float
) -> dict[str, Any]:
    """Table row of coefficient j, which has no finite estimate; no interval if `level` is None. `unit`: by which its
    column was divided."""
    low, high, p_value = (np.nan,) * 3 if level is None else profile(model, j, start, separated, level)
    both = separated.rises[j] and separated.falls[j]
    estimate = np.nan if both else np.inf if separated.rises[j] else -np.inf
    assumes = "all answers are independent; no finite estimate"
    return _row(term, estimate, "profile likelihood", assumes, p_value=p_value, low=low / unit, high=high / unit)


def _separated_sentence(names: list[str], separated: Separation, effects: int) -> str:
    """Warning that names the separated coefficients, of the first `effects` if any of them is separated."""
    infinite = [name for name, without in zip(names, separated.infinite, strict=True) if without]
    shown = [name for name in infinite if name in names[:effects]] or infinite
    return (
        f"{', '.join(shown)} cannot be estimated: {int(separated.certain.sum())} answers are separated (a cell of 0 or"
        " 100 %, or a combination that is). The one-sided interval of the profile likelihood is given, which takes all"
        " answers as independent."
    )


def _row(term: str, estimate: float, errors: str, assumes: str, **numbers: float) -> dict[str, Any]:
    """Row of the table in the order of its columns; missing values are NaN."""
    columns = ("std_error", "statistic", "degrees_of_freedom", "p_value", "low", "high")
    row = {"term": str(term), "estimate": float(estimate), "errors": errors}
    row |= dict.fromkeys(columns, np.nan) | numbers
    with np.errstate(over="ignore"):  # an odds ratio beyond 1e308 is inf
        odds = {"odds_ratio": estimate, "odds_low": row["low"], "odds_high": row["high"]}
        return row | {name: np.exp(value) for name, value in odds.items()} | {"assumes": assumes}


def _tidy(rows: list[dict[str, Any]], names: list[str], effects: int) -> pd.DataFrame:
    """The rows as a table in the order of `names`; those from index `effects` on (edges of categories) get no odds
    ratio."""
    table = pd.DataFrame(rows)
    table.loc[table["term"].isin(names[effects:]), ["odds_ratio", "odds_low", "odds_high"]] = np.nan
    order = {name: place for place, name in enumerate(names)}
    return table.sort_values("term", key=lambda terms: terms.map(order), kind="stable").reset_index(drop=True)
