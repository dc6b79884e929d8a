"""Leave-one-participant-out cross-validation: prediction of a participant's responses, and its calibration.

Each response is predicted from the other participants' responses and from the participant's own earlier ones. A session
chooses stimuli by these: predicted without them, "close" is given too often where it was tested again, though the model
is right.

From the class probabilities of held-out responses come

- the negative log predictive density, and the influence of each participant: the change of the map without them;
- the randomised probability integral transform u = F(q - 1) + v (F(q) - F(q - 1)), v uniform: uniform on [0, 1] for a
  calibrated prediction, so that 95 % of the u are in the central 95 %;
- z^2, the mean squared normal score Phi^-1(u), 1 for a calibrated prediction, more for an overconfident one;
- reliability: in bins of the predicted probability of a category, its observed frequency.

Responses of one participant are not independent: errors are clustered by participant. Reference: Czado, Gneiting & Held
(2009), Biometrics 65:1254, for the transform of discrete data.
"""

import dataclasses
from collections.abc import Callable, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.special import ndtri

from hilbo.errors import InputError
from hilbo.kernels import gram
from hilbo.numerics.host import to_device
from hilbo.numerics.rows import rows_of
from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import OrdinalGP, Posterior, Trials
from hilbo.population.learnt.posterior import Stated
from hilbo.population.learnt.rule import Learnt, learn
from hilbo.population.maps import RuleMap, learnt_map, rule_map
from hilbo.population.newcomer import InTurn, predicted_in_turn, with_variances
from hilbo.population.rules.registry import RECIPES
from hilbo.population.shared.posterior import ContextEffects
from hilbo.population.shared.scale_use import ScaleUse

__all__ = [
    "LeftOut",
    "calibration",
    "clustered",
    "influence",
    "integral_transform",
    "leave_one_out",
    "leave_one_out_learnt",
    "left_out_by",
    "newcomer_in_turn",
    "normal_scores",
    "reliability",
    "without",
]


@dataclasses.dataclass(frozen=True)
class LeftOut:
    """Predictions of all responses, each from the other participants' and the participant's own earlier ones
    (`newcomer.predicted_in_turn`), one row for each response.

    `person` (n,): row of the participant; `q` (n,): category; `probabilities` (n, C); `not_converged`: number of folds
    in which a fit did not converge.
    """

    person: Int[np.ndarray, " n"]
    q: Int[np.ndarray, " n"]
    probabilities: Float[np.ndarray, "n C"]
    not_converged: int = 0
    """Folds in which a fit did not converge."""
    log_given: Float[np.ndarray, " n"] | None = None
    """Log probability of each answer, finite where the probability is 0 in this precision; None: its logarithm."""

    @property
    def cost(self) -> Float[np.ndarray, " n"]:
        """Negative log predictive density of each response, (n,), in nats: -`log_given`, which is finite also where the
        probability is 0 in this precision; without `log_given` -log of the probability, inf at 0."""
        if self.log_given is None:
            return -np.log(self.probabilities[np.arange(len(self.q)), self.q])
        return -self.log_given


def without(trials: Trials, left: int | Int[np.ndarray, " k"]) -> Trials:
    """Copy of stacked trials without the participants in the rows `left`."""
    rows = np.delete(np.arange(trials.mask.shape[0]), left)
    return rows_of(trials, rows)


def leave_one_out(
    gp: OrdinalGP,
    trials: Trials,
    rule: str,
    *,
    share: Float[Array, ""] | None = None,
    posteriors: Posterior | None = None,
    inference: str = "laplace",
    groups: Sequence[Int[np.ndarray, " _"]] | None = None,
) -> tuple[LeftOut, list[RuleMap]]:
    """Predict each participant's responses without their data, by an aggregation method with fixed hyperparameters.

    **Arguments:** `share`: of the hierarchical method, None: learnt in each fold; `posteriors`: the individual ones of
    all participants, if known; `groups`: as for [`left_out_by`][].

    **Returns:** the predictions, and the map of each fold. Raises `InputError` as `left_out_by` and `rule_map`.
    """

    def fold(left: Int[np.ndarray, " k"]) -> tuple[OrdinalGP, RuleMap]:
        rest = np.delete(np.arange(trials.mask.shape[0]), left)
        others = None if posteriors is None else rows_of(posteriors, rest)
        given = without(trials, left)
        return gp, rule_map(gp, given, rule, posteriors=others, share=share, inference=inference)

    return left_out_by(trials, fold, groups)


def leave_one_out_learnt(
    learnt: Learnt,
    trials: Trials,
    stated: Stated,
    *,
    again: bool = True,
    groups: Sequence[Int[np.ndarray, " _"]] | None = None,
) -> tuple[LeftOut, list[RuleMap]]:
    """`leave_one_out` by a versioned method that learns the hyperparameters; `learnt`: from all responses.

    **Arguments:** `stated`: hyperparameters specified by the study; `again`: whether the others are learnt again in
    each fold; else those from all responses are used, including those of the participant left out; `groups`: rows that
    are left out together, default: each participant alone.

    **Returns:** the predictions, and the map of each fold. Raises `InputError` for fewer than three participants.
    """
    categories = learnt.model.thresholds.shape[0] + 1

    def fold(left: Int[np.ndarray, " k"]) -> tuple[OrdinalGP, RuleMap]:
        rest = eqx.tree_at(lambda t: t.mask, trials, trials.mask.at[left].set(False))  # all shapes stay
        of_rest = learn(rest, categories, stated, RECIPES[learnt.recipe], learnt) if again else learnt
        return of_rest.model.gp, learnt_map(of_rest, rest)

    return left_out_by(trials, fold, groups)


def left_out_by(
    trials: Trials,
    fold: Callable[[Int[np.ndarray, " k"]], tuple[OrdinalGP, RuleMap]],
    groups: Sequence[Int[np.ndarray, " _"]] | None = None,
) -> tuple[LeftOut, list[RuleMap]]:
    """Predict participants' responses by models that were fitted without them.

    **Arguments:** `trials`: stacked; `fold`: takes rows (k,) and returns model and map without these participants;
    `groups`: rows that are left out together, default: each participant alone.

    **Returns:** the predictions, and the map of each fold, in order. Raises `InputError` for fewer than three
    participants.
    """
    people = trials.mask.shape[0]
    if people < 3:
        raise InputError(f"leave_one_out: {people} participants; cross-validation needs at least three.")
    x, mask, q = np.asarray(trials.x), np.asarray(trials.mask), np.asarray(trials.q)
    persons, categories, rows, logs, maps = [], [], [], [], []
    for group in np.arange(people)[:, None] if groups is None else groups:
        gp, map_without = fold(group)
        maps.append(map_without)
        for person in group:
            context = None if trials.context is None else trials.context[person]
            answers = to_device(x[person]), trials.q[person], trials.mask[person], context
            for part, values in zip((rows, logs), _newcomer(gp, map_without, *answers), strict=True):
                part.append(np.asarray(values)[mask[person]])
            persons.append(np.full(mask[person].sum(), person))
            categories.append(q[person][mask[person]])
    person, category, chances, log_given = (np.concatenate(part) for part in (persons, categories, rows, logs))
    failed = sum(not _converged(map_) for map_ in maps)
    return LeftOut(person, category.astype(int), chances, failed, log_given), maps


def influence(whole: RuleMap, parts: list[RuleMap], x: Float[Array, "m d"]) -> Float[np.ndarray, " M"]:
    """Root mean square change of the map's mean over points (m, d), in the whole map's standard deviations, for each of
    `parts`, the maps without one participant each.
    """
    mean, variance = _predict(whole, x)
    moved = [_predict(map_without, x)[0] - mean for map_without in parts]
    return np.array([float(jnp.sqrt(jnp.mean(move**2 / variance))) for move in moved])


def integral_transform(
    probabilities: Float[np.ndarray, "n C"], q: Int[np.ndarray, " n"], seed: int = 0
) -> Float[np.ndarray, " n"]:
    """Randomised probability integral transform (n,) of categories `q` (n,), in [0, 1]; `seed`: of the
    randomisation.
    """
    n = np.arange(len(q))
    chance = probabilities[n, q]
    below = np.cumsum(probabilities, axis=1)[n, q] - chance
    return below + np.random.default_rng(seed).uniform(size=len(q)) * chance


def normal_scores(
    probabilities: Float[np.ndarray, "n C"], q: Int[np.ndarray, " n"], seed: int = 0
) -> Float[np.ndarray, " n"]:
    """Normal scores Phi^-1(u) (n,) of the probability integral transform of the responses `q`, randomised within each
    response by `seed`; each from the smaller of its tails, so that large ones stay finite.
    """
    n, v = np.arange(len(q)), np.random.default_rng(seed).uniform(size=len(q))
    chance = probabilities[n, q]
    ranks = np.arange(probabilities.shape[1])[None, :]
    below = np.sum(np.where(ranks < q[:, None], probabilities, 0.0), axis=1)
    above = np.sum(np.where(ranks > q[:, None], probabilities, 0.0), axis=1)
    lower, upper = below + v * chance, above + (1.0 - v) * chance
    return np.where(lower < upper, 1.0, -1.0) * ndtri(np.minimum(lower, upper))


def clustered(values: Float[np.ndarray, " n"], person: Int[np.ndarray, " n"]) -> tuple[float, float]:
    """Mean of values (n,), and its standard error with clusters by `person` (n,); the error is NaN for one
    participant.
    """
    mean, people = values.mean(), np.unique(person)
    sums = np.array([np.sum(values[person == p] - mean) for p in people])
    if len(people) < 2:
        return float(mean), float("nan")
    return float(mean), float(np.sqrt(len(people) / (len(people) - 1) * np.sum(sums**2)) / len(values))


def calibration(left: LeftOut, seed: int = 0) -> dict[str, float]:
    """Mean cost (`negative_log_density`), share in the central 95 % (`central_95`) and mean squared normal score
    (`z2`); and the standard error of each, clustered by participant, under NAME_error.
    """
    u = integral_transform(left.probabilities, left.q, seed)
    parts = {
        "negative_log_density": left.cost,
        "central_95": ((u > 0.025) & (u < 0.975)).astype(float),
        "z2": normal_scores(left.probabilities, left.q, seed) ** 2,
    }
    content = {}
    for name, values in parts.items():
        content[name], content[f"{name}_error"] = clustered(values, left.person)
    return content


def reliability(left: LeftOut, bins: int = 10) -> list[dict[str, float]]:
    """Calibration curve: for each non-empty bin of the predicted probability of a category, over all responses and
    categories, mean predicted probability, observed frequency and count.
    """
    chance = left.probabilities.ravel()
    chosen = (left.q[:, None] == np.arange(left.probabilities.shape[1])[None, :]).ravel()
    place = np.minimum((chance * bins).astype(int), bins - 1)
    return [
        {
            "predicted": float(chance[place == b].mean()),
            "observed": float(chosen[place == b].mean()),
            "count": int((place == b).sum()),
        }
        for b in range(bins)
        if (place == b).any()
    ]


@program
def _predict(population_map: RuleMap, x: Float[Array, "m d"]) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Mean and variance (m,) of a map at points (m, d)."""
    return population_map.predict(x)


@program
def _newcomer(
    gp: OrdinalGP,
    population_map: RuleMap,
    x: Float[Array, "m d"],
    q: Int[Array, " m"],
    mask: Bool[Array, " m"],
    context: Int[Array, " m"] | None,
) -> InTurn:
    """Predict a new participant's responses `q` (m,) at points (m, d), by a map; see `newcomer_in_turn`."""
    apart = (1.0 - population_map.share) * population_map.prior
    moments = *population_map.predict(x), apart, population_map.effects
    return newcomer_in_turn(gp, moments, x, q, mask, context, population_map.scale)


def newcomer_in_turn(
    gp: OrdinalGP,
    moments: tuple[Float[Array, " m"], Float[Array, " m"], Float[Array, ""], ContextEffects | None],
    x: Float[Array, "m d"],
    q: Int[Array, " m"],
    mask: Bool[Array, " m"],
    context: Int[Array, " m"] | None,
    scale: ScaleUse | None,
) -> InTurn:
    """Predict a new participant's responses `q` (m,) at points (m, d), one after the other.

    `moments`: mean and variance (m,) of the map there, the variance of one participant's function about it, and the
    random effect or None. The participant's function has the kernel's correlation; responses in one context of a random
    effect have its effect in common. `mask` (m,): False in rows without a response.
    """
    mean, variance, apart, effects = moments
    covariance, variance = gram(gp.kernel, x, x), variance + apart
    if effects is not None and context is not None:
        of_context = jnp.sqrt(effects.variance[context])
        together = jnp.where(context[:, None] == context[None, :], jnp.outer(of_context, of_context), 0.0)
        covariance = with_variances(covariance, variance) + together
        shift, more = effects.added(x, context)
        mean, variance = mean + shift, variance + more
    return predicted_in_turn(gp.likelihood, mean, with_variances(covariance, variance), q, mask, scale)


def _converged(map_: RuleMap) -> bool:
    """Whether all fits behind a map have converged."""
    fits = map_.experts if map_.shared is None else map_.shared
    assert fits is not None
    return bool(np.all(np.asarray(fits.certificate.converged)))
