"""Response quality: test-retest consistency, lapse rate and drift of criterion, each with an interval.

Consistency needs no model: a participant's responses to (nearly) the same stimulus are paired, each response once, and
the share of pairs that agree has an exact interval. The agreement expected by chance, from the proportions of the
paired responses, is next to it. A session that chooses its own trials repeats promising stimuli only, not clear ones.

The other two are from the likelihood of a participant's responses in sequence: each is predicted from the earlier ones,
by a model of that participant alone (`newcomer.in_turn`). A session tests again where a response was "close". A
response and the later ones are then dependent through the choice of stimuli, and only the order in which they were
given makes a likelihood. The lapse rate l is the share of responses that are any category at random; drift d is a shift
of the latent score from the first trial to the last, in prior standard deviations (negative: stricter): d (s - 1/2) at
the fraction s of the session. The model's prior has a constant of variance 4 k added: the level of a participant's
responses is individual, and a response far from all others is expected to be like them, not like the prior's mean.
Noise beyond the model's resembles lapses: the rate is the part of the responses that the participant's own model cannot
distinguish from chance.

The likelihood is computed on a grid of rates and drifts. Each estimate is the maximum of its profile likelihood, and
intervals are where twice the log profile falls by less than 3.84. Where an interval has no end there is no estimate.
The filter and that quantile are approximate; `benchmarks/coverage_people.py` measures the coverage of the intervals.

An exclusion rule, "trials < 10 or lapse_low > 0.3", uses a participant's own responses only, and is applied before
aggregation.
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
_INSIDE, _REFINEMENTS = 4, 3  # fewest points of the grid in an interval; times that it is refined, by 10 each
_RULE = re.compile(r"^\s*(\w+)\s*(<=|>=|<|>)\s*([-+0-9.eE]+)\s*$")


class _Levelled(eqx.Module):
    """A kernel plus a constant with 4 times its variance: functions of unknown level."""

    kernel: Kernel

    def __call__(self, x: Float[Array, " d"], y: Float[Array, " d"]) -> Float[Array, ""]:
        """Covariance of the latent function at `x` and `y`, both (d,); a scalar."""
        return self.kernel(x, y) + _LEVEL * self.kernel.diagonal(x)

    def diagonal(self, x: Float[Array, " d"]) -> Float[Array, ""]:
        """Prior variance at `x` (d,); a scalar."""
        return (1 + _LEVEL) * self.kernel.diagonal(x)


def measure_people(gp: OrdinalGP, trials: Trials, names: tuple[str, ...], *, near: float = _NEAR) -> pd.DataFrame:
    """Measures of response quality: one row for each participant, `participant` (of `names`) and `MEASURES`.

    `trials`: stacked (M, n), in the order of the responses; `near`: NRMSE up to which stimuli count as repeated.
    `surprise` is the mean of -log p of a response, in nats, predicted by the participant's own model from the earlier
    ones. Unknown values are NaN. Of more than 200 responses of a participant, 200 evenly spaced ones are used for
    lapse, drift and surprise.
    """
    model = OrdinalGP(_Levelled(gp.kernel), gp.likelihood)
    scale = jnp.sqrt(jnp.asarray(gp.kernel.variance))
    used = _evenly(trials)
    log_likelihoods = np.asarray(_log_likelihoods(model, used, scale * jnp.asarray(_DRIFTS, scale.dtype)))
    attentive = log_likelihoods[:, 0, np.flatnonzero(_DRIFTS == 0.0)[0]]
    rows = []
    for j, name in enumerate(names):
        mask = np.asarray(trials.mask[j])
        x, q = np.asarray(trials.x[j])[mask], np.asarray(trials.q[j])[mask]
        row = {"participant": name, "trials": len(q), "categories": len(np.unique(q))}
        row |= _consistency(x, q, near)
        own = jax.tree.map(lambda leaf, j=j: leaf[j : j + 1], used)
        drifts, log_likelihood = _refined(model, own, scale, log_likelihoods[j])
        row |= _estimate_columns("lapse", _lapse(log_likelihood, len(q)))
        row |= _estimate_columns("drift", _drift(drifts, log_likelihood, len(q)))
        rows.append(row | {"surprise": float(-attentive[j] / min(len(q), _MOST)) if len(q) else np.nan})
    return pd.DataFrame(rows, columns=["participant", *MEASURES])


def _evenly(trials: Trials) -> Trials:
    """Stacked trials with at most 200 responses of each participant, evenly spaced, in their order; then without
    contexts.
    """
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
    """Log likelihood of each participant's responses in sequence, at each lapse rate of `_RATES` and each of `drifts`,
    which are in units of the latent score.
    """

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


def _refined(
    gp: OrdinalGP, own: Trials, scale: Float[Array, ""], log_likelihood: Float[np.ndarray, "rates shifts"]
) -> tuple[Float[np.ndarray, " more"], Float[np.ndarray, "rates more"]]:
    """Drifts in prior standard deviations, those of `_DRIFTS` and more about the most likely one, and the log
    likelihood there: with small noise and many responses the 95 % interval may be narrower than the grid.

    `own`: the participant's trials, stacked (1, n); `scale`: the prior standard deviation.
    """
    drifts = _DRIFTS
    for _ in range(_REFINEMENTS if np.any(own.mask) else 0):
        profile = log_likelihood.max(axis=0)
        _, low, high = _profile(drifts, profile)
        if np.sum((drifts >= low) & (drifts <= high)) >= _INSIDE:
            break
        highest = int(np.argmax(profile))
        begin, end = max(highest - 1, 0), min(highest + 1, len(drifts) - 1)
        finer = np.linspace(drifts[begin], drifts[end], 21)
        near = np.min(np.abs(finer[:, None] - drifts), axis=1)
        finer = finer[near > 1e-3 * (drifts[end] - drifts[begin])]  # equal points but for rounding spoil interpolation
        more = np.asarray(_log_likelihoods(gp, own, scale * jnp.asarray(finer, scale.dtype)))[0]
        order = np.argsort(np.concatenate([drifts, finer]))
        drifts = np.concatenate([drifts, finer])[order]
        log_likelihood = np.concatenate([log_likelihood, more], axis=1)[:, order]
    return drifts, log_likelihood


def repeats(x: Float[np.ndarray, "n d"], near: float = _NEAR) -> np.ndarray:
    """Disjoint pairs (k, 2) of rows of `x` (n, d) within `near` of each other (NRMSE), nearest first, each row once."""
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
    """Lapse rate and the ends of its 95 % interval, from the log likelihood over rates and drifts.

    The rate is NaN if the interval is 0 to 1, as it is without `answers` (their number).
    """
    if not answers:
        return np.nan, 0.0, 1.0
    best, low, high = _profile(_RATES, log_likelihood.max(axis=1))
    return np.nan if (low, high) == (0.0, 1.0) else best, low, high


def _drift(
    drifts: Float[np.ndarray, " shifts"], log_likelihood: Float[np.ndarray, "rates shifts"], answers: int
) -> tuple[float, float, float]:
    """Drift in prior standard deviations and the ends of its 95 % interval, infinite where the grid ends.

    `drifts`: the grid. The drift is NaN if both ends are infinite, as they are for fewer than two `answers` (their
    number).
    """
    if answers < 2:
        return np.nan, -np.inf, np.inf
    best, low, high = _profile(drifts, log_likelihood.max(axis=0))
    below, above = low <= drifts[0], high >= drifts[-1]
    return np.nan if below and above else best, -np.inf if below else low, np.inf if above else high


def excluded(table: pd.DataFrame, rule: str) -> dict[str, str]:
    """Apply an exclusion rule to a table of `measure_people`: excluded participant -> reason, a text with the first
    fulfilled condition and the participant's value.

    A rule is one or more conditions joined by "or"; each has a measure, <, <=, > or >=, and a number; an empty rule
    excludes no participant. A measure that is NaN fulfils no condition. Raises `InputError` for another rule.
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
    """Parse one condition of a rule: its measure, the condition as text, and a function that tests a value.

    Raises `InputError` for an unknown measure, or if the text is no condition.
    """
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
    """Columns of a participant on repeated stimuli: pairs, consistency with its exact 95 % interval, and agreement by
    chance.

    `x` (n, d) and `q` (n,): points and categories. Without pairs the values are NaN and the interval 0 to 1.
    """
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
    """Estimate and interval ends as the columns NAME, NAME_low and NAME_high."""
    return dict(zip((name, f"{name}_low", f"{name}_high"), map(float, estimate), strict=True))


def _profile(grid: Float[np.ndarray, " k"], values: Float[np.ndarray, " k"]) -> tuple[float, float, float]:
    """Maximum of a log likelihood known at the points of a rising `grid` (k,), interpolated; and the ends of its 95 %
    interval, where twice it falls by the 95 % point of chi^2. An end beyond the grid is the grid's end.
    """
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
