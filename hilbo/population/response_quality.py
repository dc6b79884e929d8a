"""How well people answer: test-retest consistency, lapse rate and drift of criterion, each with an interval.

Consistency needs no model: a person's answers to (nearly) the same rendering are paired, each answer once, and the
share of pairs that agree has an exact interval. Beside it stands the agreement by chance that the shares of the paired
answers would give. A session that chooses its own trials returns to promising places only, not to clear ones.

The other two ask a person's model for the answer i that it was not told. With the Gaussian posterior N(m, V) of
expectation propagation, C = (K + 1/W)^-1 and a = C's weights, leaving answer i out gives

    v_i = (C K)_ii / C_ii,   m_i = m_i - v_i a_i,   p_i(q) = P(q | N(m_i, v_i)),

so that no fit is repeated. Here the model's prior has a constant of variance 4 k added: the level of a person's answers
is their own affair, and an answer far from all others is expected to be like them, not like the prior's mean. The lapse
rate l is the share of answers that are any category at random, P(q_i) = (1 - l) p_i(q_i) + l / C; drift d is a shift of
the latent score from the first trial to the last, in prior standard deviations (negative: stricter), p_i(q) with
m_i + d (s_i - 1/2), s_i being the share of the session that is over, at whatever lapse rate is likeliest then. Noise
beyond the model's looks like lapses: a rate says how much of the answers the person's own model cannot tell from
chance. Both are maximum likelihood over these left-out probabilities, with intervals where twice the log likelihood
falls by less than 3.84. Those are approximate, since answers left out one at a time are not independent;
`benchmarks/coverage_people.py` measures how often they hold.

An exclusion rule, "trials < 10 or lapse_low > 0.3", speaks of a person's own answers only, and is applied before
anything is aggregated.
"""

import re
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Array, Float, Int
from scipy.optimize import brentq, minimize_scalar
from scipy.stats import binomtest, chi2

from hilbo.errors import InputError
from hilbo.kernels import Kernel, gram
from hilbo.likelihoods import OrdinalProbit
from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import OrdinalGP, Trials, fit

__all__ = ["MEASURES", "drift", "excluded", "lapse", "left_out", "measure_people", "repeats"]

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
_DRIFT = 6.0  # prior standard deviations: further the search does not go
_RATES = np.geomspace(1e-3, 0.999, 100)  # lapse rates under which a drift is judged
_RULE = re.compile(r"^\s*(\w+)\s*(<=|>=|<|>)\s*([-+0-9.eE]+)\s*$")


class _Levelled(eqx.Module):
    """A kernel and a constant of unknown height."""

    kernel: Kernel

    def __call__(self, x: Float[Array, " d"], y: Float[Array, " d"]) -> Float[Array, ""]:
        return self.kernel(x, y) + _LEVEL * self.kernel.diagonal(x)

    def diagonal(self, x: Float[Array, " d"]) -> Float[Array, ""]:
        return (1 + _LEVEL) * self.kernel.diagonal(x)


def measure_people(gp: OrdinalGP, trials: Trials, names: tuple[str, ...], *, near: float = _NEAR) -> pd.DataFrame:
    """One row for each person of stacked trials (M, n): `participant` and `MEASURES`.

    `surprise` is the mean of -log p_i, in nats, the person's own model being asked; what cannot be said is NaN.
    """
    model = OrdinalGP(_Levelled(gp.kernel), gp.likelihood)
    mean, variance, probabilities = (np.asarray(leaf) for leaf in _left_out(model, trials))
    scale, rows = float(np.sqrt(gp.kernel.variance)), []
    scaled = OrdinalProbit(gp.likelihood.thresholds / scale, gp.likelihood.noise / scale)
    for j, name in enumerate(names):
        mask = np.asarray(trials.mask[j])
        x, q = np.asarray(trials.x[j])[mask], np.asarray(trials.q[j])[mask]
        row = {"participant": name, "trials": len(q), "categories": len(np.unique(q))}
        row |= _consistency(x, q, near)
        given = probabilities[j][mask][np.arange(len(q)), q]
        row |= _estimate_columns("lapse", lapse(given, probabilities.shape[-1]))
        row |= _estimate_columns("drift", drift(scaled, mean[j][mask] / scale, variance[j][mask] / scale**2, q))
        rows.append(row | {"surprise": float(-np.log(given).mean()) if len(q) else np.nan})
    return pd.DataFrame(rows, columns=["participant", *MEASURES])


def left_out(
    gp: OrdinalGP, trials: Trials
) -> tuple[Float[Array, " n"], Float[Array, " n"], Float[Array, "n categories"]]:
    """Mean and variance (n,) of f at each answer's point without that answer, and class probabilities (n, C).

    Rows without an answer hold the prediction from all answers.
    """
    posterior = fit(gp, trials, inference="ep", throw=False)
    covariance, latent = gram(gp.kernel, trials.x, trials.x), posterior.latent
    inverse = jnp.diagonal(latent.inverse)
    shared = jnp.sum(latent.inverse * covariance, axis=1)
    answered = trials.mask & (inverse > 0)
    mean, explained = posterior.predict_explained(trials.x)
    full = jax.vmap(gp.kernel.diagonal)(trials.x) - explained
    variance = jnp.where(answered, shared / jnp.where(answered, inverse, jnp.ones_like(inverse)), full)
    mean = mean - jnp.where(answered, variance * latent.weights, jnp.zeros_like(mean))
    return mean, variance, jax.vmap(gp.likelihood.class_probabilities)(mean, variance)


@program
def _left_out(gp: OrdinalGP, trials: Trials) -> tuple[Float[Array, "M n"], Float[Array, "M n"], Float[Array, "M n C"]]:
    return jax.lax.map(lambda t: left_out(gp, t), trials)


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


def lapse(given: Float[np.ndarray, " n"], categories: int) -> tuple[float, float, float]:
    """Lapse rate and its 95 % interval from the probabilities (n,) of the answers given, each left out."""
    if not len(given):
        return np.nan, 0.0, 1.0

    def likelihood(rate):
        return float(np.sum(np.log((1 - rate) * given + rate / categories)))

    return _profile(likelihood, 0.0, 1.0)


def drift(
    likelihood: OrdinalProbit,
    mean: Float[np.ndarray, " n"],
    variance: Float[np.ndarray, " n"],
    q: np.ndarray,
) -> tuple[float, float, float]:
    """Shift of the latent score from the first trial to the last, and its 95 % interval; from left-out moments (n,), in
    their unit and the likelihood's; sought within 6 of them. At each shift the likeliest of a hundred lapse rates
    counts, since guesses are no sign of a firm criterion."""
    if len(q) < 2:
        return np.nan, -np.inf, np.inf
    progress = np.linspace(-0.5, 0.5, len(q))
    edges = np.concatenate([[-np.inf], np.asarray(likelihood.thresholds, float), [np.inf]])
    width = np.sqrt(float(likelihood.noise) ** 2 + variance)
    attentive, guess = np.log1p(-_RATES)[:, None], np.log(_RATES / likelihood.categories)[:, None]

    def log_likelihood(shift):
        centre = mean + shift * progress
        log_chances = _log_between((edges[q] - centre) / width, (edges[q + 1] - centre) / width)
        return float(np.sum(np.logaddexp(attentive + log_chances, guess), axis=1).max())

    best, low, high = _profile(log_likelihood, -_DRIFT, _DRIFT)
    return best, -np.inf if low <= -_DRIFT else low, np.inf if high >= _DRIFT else high


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


def _profile(log_likelihood: Callable[[float], float], low: float, high: float) -> tuple[float, float, float]:
    """Maximum of a concave function within bounds, and where twice it has fallen by the 95 % point of chi^2."""
    best = minimize_scalar(lambda v: -log_likelihood(v), bounds=(low, high), method="bounded").x
    best = max((low, float(best), high), key=log_likelihood)
    bar = log_likelihood(best) - chi2.ppf(0.95, 1) / 2

    def end(bound):
        if log_likelihood(bound) >= bar:
            return bound
        return brentq(lambda v: log_likelihood(v) - bar, best, bound)

    return best, end(low), end(high)


def _log_between(a: Float[np.ndarray, "*s"], b: Float[np.ndarray, "*s"]) -> Float[np.ndarray, "*s"]:
    """log(Phi(b) - Phi(a)), in whichever tail keeps its digits."""
    from scipy.special import log_ndtr

    flip = a > 0
    a, b = np.where(flip, -b, a), np.where(flip, -a, b)
    top = log_ndtr(b)
    return top + np.log1p(-np.exp(log_ndtr(a) - top))
