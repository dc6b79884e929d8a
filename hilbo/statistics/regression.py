"""A logit fitted, with every kind of standard error side by side in one tidy table.

| errors | what they assume |
|---|---|
| iid | every answer independent of every other |
| clustered by A | A's clusters independent, and many; t with G - 1 degrees of freedom |
| clustered by A and B | answers that share neither independent; t with the smaller G - 1 |
| wild bootstrap by A | A's clusters independent; made for few of them |
| profile likelihood | as iid; for a coefficient that has no finite estimate |

`docs/statistics.md` says which to trust when, from their coverage in simulated studies.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy import stats

from hilbo.errors import InputError
from hilbo.statistics import ordered_logit, wild_bootstrap
from hilbo.statistics.cluster_robust import Covariance, Ways, iid, sandwich, ways
from hilbo.statistics.ordered_logit import Design
from hilbo.statistics.separation import Separation, decisive, independent, profile, separation

__all__ = ["FEW_CLUSTERS", "Clusters", "Errors", "Regression", "regress"]

Clusters = Mapping[str, Any] | pd.DataFrame  # a column for each way, n entries each
FEW_CLUSTERS = 12
_NO_SPREAD = 1e-8  # of the iid error: clusters that agree to rounding
_NOTHING_LEFT = (
    "nothing is left to estimate an error from (clusters agree exactly, or the two-way variance is negative)"
)


class Regression(eqx.Module):
    """A fitted logit.

    `table` has one row per coefficient and kind of error: `term`, `estimate`, `errors`, `std_error`, `statistic`,
    `degrees_of_freedom`, `p_value` (of 0), `low`, `high`, `odds_ratio`, `odds_low`, `odds_high`, `assumes`.
    `covariances` holds the covariance of the finite estimates by kind of error, `clusters` the number of clusters by
    each way, `warnings` one sentence for each thing to know before the table is believed.
    """

    table: pd.DataFrame
    covariances: dict[str, pd.DataFrame]
    log_likelihood: float
    answers: int
    clusters: dict[str, int]
    warnings: tuple[str, ...]

    def by(self, errors: str) -> pd.DataFrame:
        """The rows with one kind of error, indexed by term; coefficients that are not finite stay among them."""
        kinds = [errors, "profile likelihood"]
        return self.table[self.table["errors"].isin(kinds)].set_index("term")


class Errors(eqx.Module):
    """One kind of error: its name, what it assumes, its covariance, and the clusters if it has any."""

    name: str
    assumes: str
    covariance: Covariance
    clusters: Ways | None = None


def regress(
    model: Design,
    terms: Sequence[str],
    start: Float[np.ndarray, " k"],
    clusters: Clusters | None = None,
    *,
    nuisance: int = 0,
    level: float = 0.95,
    bootstrap: bool = True,
    seed: int = 0,
) -> Regression:
    """Fit `model` and put every kind of error beside the estimates.

    The last `nuisance` coefficients (edges of categories) get no bootstrap and no profile. `start` has its edges in
    order. Raises `InputError` for coefficients that depend on each other and for more than two ways of clustering.
    """
    n, names = len(model.upper), list(terms)
    labels = _labels(clusters, n)
    _check_independent(model, names, nuisance)
    found = separation(model)
    warnings = [_separated(names, found, nuisance)] if found.infinite.any() else []
    rows, covariances, log_likelihood = [], {}, 0.0
    if not found.certain.all():
        rest, keep, begin = decisive(model, start, found)
        theta = ordered_logit.fit(rest, begin)
        log_likelihood = ordered_logit.log_likelihood(rest, theta)
        kinds, said = _kinds(rest, theta, {name: codes[~found.certain] for name, codes in labels.items()})
        finite = {j: names[i] for j, i in enumerate(np.flatnonzero(keep)) if not found.infinite[i]}
        warnings += [*said, *_below_iid(kinds, finite)]
        covariances = {kind.name: _covariance(kind, finite) for kind in kinds}
        rows += [_wald(term, theta[j], j, kind, kinds[0], level) for j, term in finite.items() for kind in kinds]
        if bootstrap:
            tested = {j: term for j, term in finite.items() if term in names[: len(names) - nuisance]}
            rows += _bootstrapped(rest, theta, kinds, tested, level, seed)
    rows += [
        _profiled(model, j, names[j], start, found, level, j >= len(names) - nuisance)
        for j in np.flatnonzero(found.infinite).tolist()
    ]
    counts = {name: len(np.unique(codes)) for name, codes in labels.items()}
    return Regression(_tidy(rows, names, nuisance), covariances, log_likelihood, n, counts, tuple(warnings))


def _covariance(kind, terms):
    shown = list(terms.values())
    return pd.DataFrame(kind.covariance.matrix[np.ix_(list(terms), list(terms))], shown, shown)


def _labels(clusters, n):
    columns = {} if clusters is None else {str(name): np.asarray(clusters[name]) for name in clusters}
    if len(columns) > 2:
        raise InputError(f"errors can be clustered by one way or two, not by {len(columns)} ({', '.join(columns)}).")
    for name, codes in columns.items():
        if codes.shape != (n,):
            raise InputError(f'clusters "{name}" has {codes.size} entries for {n} answers; give one for each answer.')
        if pd.isna(codes).any():
            raise InputError(f'clusters "{name}" has empty entries; name the cluster of every answer.')
    return {name: np.unique(codes, return_inverse=True)[1].ravel() for name, codes in columns.items()}


def _check_independent(model, names, nuisance):
    order = np.roll(np.arange(len(names)), nuisance)  # edges first: a constant predictor is at fault, not an edge
    good = independent(model.columns(order))
    if not good.all():
        name = names[order[np.argmin(good)]]
        raise InputError(
            f'"{name}" is a combination of the other coefficients (a constant or a double, say); leave it out.'
        )


def _kinds(model, theta, labels):
    """Every kind of error that these answers allow, and a sentence for those that they do not."""
    scores, information = ordered_logit.scores(model, theta), ordered_logit.information(model, theta)
    kinds, warnings = [Errors("iid", "all answers are independent", iid(information))], []
    usable = {name: codes for name, codes in labels.items() if len(np.unique(codes)) > 1}
    warnings += [f"There is one {name} only: no error can be clustered by it." for name in labels if name not in usable]
    if usable and len(scores) <= len(theta):
        warnings.append(f"{len(scores)} answers decide {len(theta)} coefficients: no error can be clustered.")
        return kinds, warnings
    chosen = [[name] for name in usable] + ([list(usable)] if len(usable) == 2 else [])
    for names in chosen:
        both = " and ".join(names)
        clusters = ways(*(usable[name] for name in names))
        covariance = sandwich(scores, information, clusters)
        counts = " and ".join(f"{count} of {name}" for count, name in zip(clusters.counts, names, strict=True))
        assumes = f"answers that share no {both.replace(' and ', ' or ')} are independent; clusters: {counts}"
        kinds.append(Errors(f"clustered by {both}", assumes, covariance, clusters))
        if covariance.repaired:
            warnings.append(
                f"The covariance clustered by {both} was indefinite (worst eigenvalue {-covariance.repaired:.1%} of the"
                " largest of the one-way terms) and was repaired; its errors may be too small."
            )
    few = min((kind.clusters.degrees_of_freedom + 1 for kind in kinds if kind.clusters is not None), default=99)
    if few <= FEW_CLUSTERS:
        warnings.append(
            f"There are {few} clusters by one way: report the wider of the clustered and the wild bootstrap interval."
        )
    return kinds, warnings


def _below_iid(kinds, terms):
    """A sentence for each kind of clustered error that is below the iid one in some coefficient."""
    reference, said = np.sqrt(np.diag(kinds[0].covariance.matrix)), []
    for kind in kinds[1:]:
        errors = np.sqrt(np.diag(kind.covariance.matrix))
        below = [
            f"{name} ({errors[j]:.3g} against {reference[j]:.3g})"
            for j, name in terms.items()
            if errors[j] < reference[j]
        ]
        if below:
            said.append(
                f"Errors {kind.name} are below the iid ones for {', '.join(below)}: by chance, or because answers"
                " within a cluster differ more than chance allows; report the larger."
            )
    return said


def _wald(term, estimate, j, kind, reference, level):
    error, least = (float(np.sqrt(c.matrix[j, j])) for c in (kind.covariance, reference.covariance))
    dof = kind.covariance.degrees_of_freedom
    if error <= _NO_SPREAD * least:
        assumes = f"{kind.assumes}; {_NOTHING_LEFT}"
        return _row(term, estimate, kind.name, assumes, dof=dof)
    reach = float(stats.t.ppf((1 + level) / 2, dof)) * error
    p_value = float(2 * stats.t.sf(abs(estimate) / error, dof))
    return _row(
        term,
        estimate,
        kind.name,
        kind.assumes,
        error,
        estimate / error,
        dof,
        p_value,
        estimate - reach,
        estimate + reach,
    )


def _bootstrapped(model, theta, kinds, tested, level, seed):
    """Rows of the wild bootstrap by every way that has an error; by two ways the smaller one carries the weights."""
    rows, least = [], np.sqrt(np.diag(kinds[0].covariance.matrix))
    for kind in kinds[1:]:
        errors = np.sqrt(np.diag(kind.covariance.matrix))
        test = wild_bootstrap.wild(model, theta, errors, kind.clusters, seed)
        for j, term in tested.items():
            name = kind.name.replace("clustered", "wild bootstrap")
            if errors[j] <= _NO_SPREAD * least[j]:
                rows.append(_row(term, theta[j], name, f"{kind.assumes}; {_NOTHING_LEFT}"))
                continue
            low, high = wild_bootstrap.interval(test, j, level)
            p_value = wild_bootstrap.p_value(test, j, 0.0)
            statistic = theta[j] / errors[j]
            error = float(errors[j])
            rows.append(_row(term, theta[j], name, kind.assumes, error, statistic, np.nan, p_value, low, high))
    return rows


def _profiled(model, j, term, start, found, level, nuisance):
    low, high, p_value = (np.nan,) * 3 if nuisance else profile(model, j, start, found, level)
    both = found.rises[j] and found.falls[j]
    estimate = np.nan if both else np.inf if found.rises[j] else -np.inf
    assumes = "all answers are independent; no finite estimate"
    return _row(term, estimate, "profile likelihood", assumes, p_value=p_value, low=low, high=high)


def _separated(names, found: Separation, nuisance):
    shown = [name for name, gone in zip(names, found.infinite, strict=True) if gone]
    shown = [name for name in shown if name in names[: len(names) - nuisance]] or shown
    return (
        f"{', '.join(shown)} cannot be estimated: {int(found.certain.sum())} answers are separated (a cell of 0 or"
        " 100 %, or a combination that is). The one-sided interval of the profile likelihood is given, which takes all"
        " answers as independent."
    )


def _row(
    term, estimate, errors, assumes, error=np.nan, statistic=np.nan, dof=np.nan, p_value=np.nan, low=np.nan, high=np.nan
):
    found = {"term": str(term), "estimate": float(estimate), "errors": errors, "std_error": error}
    found |= {"statistic": statistic, "degrees_of_freedom": dof, "p_value": p_value, "low": low, "high": high}
    with np.errstate(over="ignore"):  # an odds ratio beyond 1e308 is inf
        odds = {"odds_ratio": np.exp(estimate), "odds_low": np.exp(low), "odds_high": np.exp(high)}
    return found | odds | {"assumes": assumes}


def _tidy(rows, names, nuisance):
    table = pd.DataFrame(rows)
    edges = table["term"].isin(names[len(names) - nuisance :])
    table.loc[edges, ["odds_ratio", "odds_low", "odds_high"]] = np.nan
    order = {name: place for place, name in enumerate(names)}
    return table.sort_values("term", key=lambda terms: terms.map(order), kind="stable").reset_index(drop=True)
