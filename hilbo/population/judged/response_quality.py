"""How well people answer: test-retest consistency, lapse rate and drift of criterion, each with an interval.

Consistency needs no model: a person's answers to (nearly) the same rendering are paired, each answer once, and the
share of pairs that agree has an exact interval. Beside it stands the agreement by chance that the shares of the paired
answers would give. A session that chooses its own trials returns to promising places only, not to clear ones.

The other two are from the likelihood of a person's answers in turn: each is predicted from those before it, by a model
of that person alone (`newcomer.in_turn`). A session asks again where an answer was "close". An answer and those after
it then depend on each other through what was asked, and only the order in which they were given makes a likelihood. The
lapse rate l is the share of answers that are any category at random; drift d is a shift of the latent score from the
first trial to the last, in prior standard deviations (negative: stricter): d (s - 1/2) where the share s of the session
is over. The model's prior has a constant of variance 4 k added: the level of a person's answers is their own affair,
and an answer far from all others is expected to be like them, not like the prior's mean. Noise beyond the model's looks
like lapses: a rate says how much of the answers the person's own model cannot tell from chance.

The likelihood is known on a grid of rates and drifts. Each estimate is where it is largest, the other being the
likeliest then, and intervals are where twice its logarithm falls by less than 3.84. Where an interval has no end the
answers do not tell, and there is no estimate. The filter and that quantile are approximate;
`benchmarks/coverage_people.py` measures how often intervals hold.

An exclusion rule, "trials < 10 or lapse_low > 0.3", speaks of a person's own answers only, and is applied before
anything is aggregated.
"""

import re
from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Array, Float, Int
from scipy.interpolate import Akima1DInterpolator
from scipy.optimize import brentq, minimize_scalar
from scipy.stats import binomtest, chi2

from hilbo.errors import InputError
from hilbo.kernels import Kernel, gram
from hilbo.numerics.host import to_device
from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import OrdinalGP, Trials
from hilbo.population.newcomer import in_turn

__all__ = ["MEASURES", "excluded", "measure_people", "repeats"]

MEASURES = (
    "trials",
    "categories",
    "pairs",
    "consistency",
    "consistency_low",
    "consistency_high",
    "chance",
    "lapse",
    "lapse_low",
    "lapse_high",
    "drift",
    "drift_low",
    "drift_high",
    "surprise",
)
"""Columns of `measure_people`, of which rules may speak."""

_NEAR = 0.02  # of the search ranges (NRMSE): the same rendering to a finger
_LEVEL = 4.0  # prior variances
_MOST = 200  # answers of a person that are filtered, at the price of their cube
_RATES = np.linspace(0.0, 1.0, 18) ** 3  # an answer that is all but excluded takes small ones
_DRIFTS = np.array([6.0 * part * abs(part) for part in np.linspace(-1.0, 1.0, 21)])  # prior standard deviations
_RULE = re.compile(r"^\s*(\w+)\s*(<=|>=|<|>)\s*([-+0-9.eE]+)\s*$")


class _Levelled(eqx.Module):
    """A kernel and a constant of unknown height."""

    kernel: Kernel

    def __call__(self, x: Float[Array, " d"], y: Float[Array, " d"]) -> Float[Array, ""]:
        return self.kernel(x, y) + _LEVEL * self.kernel.diagonal(x)

    def diagonal(self, x: Float[Array, " d"]) -> Float[Array, ""]:
        return (1 + _LEVEL) * self.kernel.diagonal(x)


def measure_people(gp: OrdinalGP, trials: Trials, names: tuple[str, ...], *, near: float = _NEAR) -> pd.DataFrame:
    """One row for each person of stacked trials (M, n) in the order in which they were answered: `participant` and
    `MEASURES`.

    `surprise` is the mean of -log p of an answer, in nats, p being the person's own model's that was told of the
    earlier ones; what cannot be said is NaN. Of more than 200 answers of a person so many are chosen, evenly, for
    lapse, drift and surprise.
    """
    model = OrdinalGP(_Levelled(gp.kernel), gp.likelihood)
    scale = jnp.sqrt(jnp.asarray(gp.kernel.variance))
    log_likelihoods = np.asarray(_log_likelihoods(model, _evenly(trials), scale * jnp.asarray(_DRIFTS, scale.dtype)))
    attentive = log_likelihoods[:, 0, np.flatnonzero(_DRIFTS == 0.0)[0]]
    rows = []
    for j, name in enumerate(names):
        mask = np.asarray(trials.mask[j])
        x, q = np.asarray(trials.x[j])[mask], np.asarray(trials.q[j])[mask]
        row = {"participant": name, "trials": len(q), "categories": len(np.unique(q))}
        row |= _consistency(x, q, near)
        row |= _estimate_columns("lapse", _lapse(log_likelihoods[j], len(q)))
        row |= _estimate_columns("drift", _drift(log_likelihoods[j], len(q)))
        rows.append(row | {"surprise": float(-attentive[j] / min(len(q), _MOST)) if len(q) else np.nan})
    return pd.DataFrame(rows, columns=["participant", *MEASURES])


def _evenly(trials: Trials) -> Trials:
    """At most `_MOST` answers of each person, evenly chosen, in their order."""
    mask = np.asarray(trials.mask)
    if mask.shape[1] <= _MOST:
        return trials
    rows = np.zeros((len(mask), _MOST), int)
    held = np.arange(_MOST)[None, :] < np.minimum(mask.sum(axis=1), _MOST)[:, None]
    for j, (given, part) in enumerate(zip(map(np.flatnonzero, mask), held, strict=True)):
        rows[j, part] = given[np.linspace(0, len(given) - 1, part.sum()).round().astype(int)]
    person = np.arange(len(mask))[:, None]
    x, q = (to_device(np.asarray(leaf)[person, rows]) for leaf in (trials.x, trials.q))
    return jax.vmap(Trials)(x, q, to_device(held))


@program
def _log_likelihoods(gp: OrdinalGP, trials: Trials, drifts: Float[Array, " shifts"]) -> Float[Array, "M rates shifts"]:
    """Of everybody's answers, at each lapse rate and drift, which is in the unit of the latent score."""

    def person(trials: Trials) -> Float[Array, "rates shifts"]:
        covariance = gram(gp.kernel, trials.x, trials.x)
        last = jnp.maximum(jnp.sum(trials.mask) - 1, 1)
        progress = (jnp.cumsum(trials.mask) - 1) / last - 0.5

        def at(rate: Float[Array, ""], drift: Float[Array, ""]) -> Float[Array, ""]:
            shift = (drift * progress).astype(covariance.dtype)
            predicted = in_turn(gp.likelihood, shift, covariance, trials.q, trials.mask, rate)
            return jnp.sum(jnp.where(trials.mask, predicted.log_given, 0.0))

        return jax.lax.map(lambda rate: jax.vmap(partial(at, rate))(drifts), jnp.asarray(_RATES, drifts.dtype))

    return jax.lax.map(person, trials)


def repeats(x: Float[np.ndarray, "n d"], near: float = _NEAR) -> np.ndarray:
    """Disjoint pairs (k, 2) of rows within `near` of each other (NRMSE), nearest first, each row once."""
    distance = np.sqrt(np.mean((x[:, None, :] - x[None, :, :]) ** 2, axis=2))
    rows, columns = np.nonzero(np.triu(distance <= near, 1))
    pairs, used = [], set()
    for i in np.argsort(distance[rows, columns], kind="stable"):
        pair = int(rows[i]), int(columns[i])
        if not used & set(pair):
            pairs.append(pair)
            used |= set(pair)
    return np.array(pairs, int).reshape(-1, 2)


def _lapse(log_likelihood: Float[np.ndarray, "rates shifts"], answers: int) -> tuple[float, float, float]:
    """Lapse rate and its 95 % interval; NaN where any rate is in it."""
    if not answers:
        return np.nan, 0.0, 1.0
    best, low, high = _profile(_RATES, log_likelihood.max(axis=1))
    return np.nan if (low, high) == (0.0, 1.0) else best, low, high


def _drift(log_likelihood: Float[np.ndarray, "rates shifts"], answers: int) -> tuple[float, float, float]:
    """Drift in prior standard deviations and its 95 % interval, open where the grid ends; NaN where it has no end."""
    if answers < 2:
        return np.nan, -np.inf, np.inf
    best, low, high = _profile(_DRIFTS, log_likelihood.max(axis=0))
    below, above = low <= _DRIFTS[0], high >= _DRIFTS[-1]
    return np.nan if below and above else best, -np.inf if below else low, np.inf if above else high


def excluded(table: pd.DataFrame, rule: str) -> dict[str, str]:
    """Who is left out by a rule, and why: participant -> the condition that holds, with the person's value.

    A rule is one or more conditions joined by "or"; each names a measure, <, <=, > or >=, and a number. A measure that
    is NaN fulfils nothing. Raises `InputError` for another rule.
    """
    conditions = [_condition(condition) for condition in rule.split(" or ")] if rule.strip() else []
    reasons = {}
    for row in table.to_dict("records"):
        for measure, words, holds in conditions:
            if holds(row[measure]):
                reasons[str(row["participant"])] = f"{measure} is {row[measure]:.3g}, and the rule leaves out {words}"
                break
    return reasons


def _condition(text: str) -> tuple[str, str, Callable[[float], bool]]:
    """A condition of a rule: the measure it is about, the condition in words, and whether a value fulfils it."""
    matched = _RULE.match(text)
    if matched is None or matched[1] not in MEASURES:
        raise InputError(
            f'exclusion rule: "{text.strip()}" is no condition; write for example "trials < 10 or lapse_low > 0.3", of'
            f" {', '.join(MEASURES)}."
        )
    measure, sign = matched[1], matched[2]
    try:
        limit = float(matched[3])
    except ValueError:
        raise InputError(f'exclusion rule: "{matched[3]}" is no number.') from None
    holds = {
        "<": lambda v: v < limit,
        "<=": lambda v: v <= limit,
        ">": lambda v: v > limit,
        ">=": lambda v: v >= limit,
    }[sign]
    return measure, f"{measure} {sign} {limit:g}", holds


def _consistency(x: Float[np.ndarray, "n d"], q: Int[np.ndarray, " n"], near: float) -> dict[str, float | int]:
    """The columns of a person that come from repeated renderings."""
    pairs = repeats(x, near)
    row = {"pairs": len(pairs), "consistency": np.nan, "consistency_low": 0.0, "consistency_high": 1.0}
    row["chance"] = np.nan
    if len(pairs):
        row["chance"] = float(np.sum((np.bincount(q[pairs.ravel()]) / pairs.size) ** 2))
        agree = int(np.sum(q[pairs[:, 0]] == q[pairs[:, 1]]))
        ends = binomtest(agree, len(pairs)).proportion_ci()
        row |= {"consistency": agree / len(pairs), "consistency_low": ends.low, "consistency_high": ends.high}
    return row


def _estimate_columns(name: str, estimate: tuple[float, float, float]) -> dict[str, float]:
    return dict(zip((name, f"{name}_low", f"{name}_high"), map(float, estimate), strict=True))


def _profile(grid: Float[np.ndarray, " k"], values: Float[np.ndarray, " k"]) -> tuple[float, float, float]:
    """Where a log likelihood that is known on a grid is largest, and the ends of where twice it is not below by the
    95 % point of chi^2."""
    between = Akima1DInterpolator(grid, values, method="makima")
    highest = int(np.argmax(values))
    sides = grid[max(highest - 1, 0)], grid[min(highest + 1, len(grid) - 1)]
    best = minimize_scalar(lambda v: -between(v), bounds=sides, method="bounded").x
    best = max((float(grid[highest]), float(best)), key=between)
    bar = between(best) - chi2.ppf(0.95, 1) / 2

    def end(bound: float, beyond: np.ndarray) -> float:
        """The nearest end of the interval: between the last point of the grid above the bar, and the next."""
        inner = best
        for outer in beyond:
            if between(outer) < bar:
                return brentq(lambda v: between(v) - bar, inner, outer)
            inner = outer
        return bound

    return best, end(grid[0], grid[grid < best][::-1]), end(grid[-1], grid[grid > best])
