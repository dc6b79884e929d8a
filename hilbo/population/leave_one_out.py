"""Each person left out in turn: what a rule predicts of somebody it has not seen, and how far that can be trusted.

From the class probabilities of held-out answers come

* the negative log predictive density, and the influence of each person: what leaving that person out does to a map;
* the randomised probability integral transform u = F(q - 1) + v (F(q) - F(q - 1)), v uniform: uniform on [0, 1] for a
  calibrated prediction, so that 95 % of the u lie in the central 95 %;
* z^2, the mean squared normal score Phi^-1(u), 1 for a calibrated prediction, more for one that is too sure;
* reliability: in bins of the predicted probability of a category, how often it was chosen.

Answers of one person are not independent: errors are clustered by person.
Reference: Czado, Gneiting & Held (2009), Biometrics 65:1254, for the transform of discrete data.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.special import ndtri

from hilbo.errors import InputError
from hilbo.ordinal_gp import OrdinalGP, Posterior, Trials
from hilbo.population.maps import RuleMap, rule_map

__all__ = [
    "LeftOut",
    "calibration",
    "clustered",
    "influence",
    "integral_transform",
    "leave_one_out",
    "normal_scores",
    "reliability",
    "without",
]


@dataclasses.dataclass(frozen=True)
class LeftOut:
    """Predictions of everybody's answers from all others', one row for each answer."""

    person: Int[np.ndarray, " n"]
    q: Int[np.ndarray, " n"]
    probabilities: Float[np.ndarray, "n C"]

    @property
    def cost(self) -> Float[np.ndarray, " n"]:
        """Negative log predictive density of each answer."""
        return -np.log(self.probabilities[np.arange(len(self.q)), self.q])


def without(trials: Trials, person: int) -> Trials:
    """Stacked trials without one person."""
    rows = np.delete(np.arange(trials.mask.shape[0]), person)
    return jax.tree.map(lambda leaf: leaf[rows], trials)


def leave_one_out(
    gp: OrdinalGP,
    trials: Trials,
    rule: str,
    *,
    share: Float[Array, ""] | None = None,
    posteriors: Posterior | None = None,
    inference: str = "laplace",
) -> tuple[LeftOut, list[RuleMap]]:
    """What a rule predicts of each person's answers from all others' (hyperparameters and share as given); and the
    maps without them. Raises InputError for fewer than three people: two must be left to differ."""
    people = trials.mask.shape[0]
    if people < 3:
        raise InputError(f"leave_one_out: {people} people; at least three are needed, of whom two are left each time.")
    mask, q = np.asarray(trials.mask), np.asarray(trials.q)
    rows, maps = [], []
    for person in range(people):
        rest = np.delete(np.arange(people), person)
        others_posteriors = None if posteriors is None else jax.tree.map(lambda leaf, rest=rest: leaf[rest], posteriors)
        map_without = rule_map(
            gp, without(trials, person), rule, posteriors=others_posteriors, share=share, inference=inference
        )
        rows.append(np.asarray(_newcomer_probabilities(gp, map_without, trials.x[person]))[mask[person]])
        maps.append(map_without)
    person = np.nonzero(mask)[0]
    return LeftOut(person, q[mask].astype(int), np.concatenate(rows)), maps


def influence(whole: RuleMap, parts: list[RuleMap], x: Float[Array, "m d"]) -> Float[np.ndarray, " M"]:
    """Root mean square change of the map's mean at x, in its standard deviations, when each person is left out."""
    mean, variance = _predict(whole, x)
    moved = [_predict(map_without, x)[0] - mean for map_without in parts]
    return np.array([float(jnp.sqrt(jnp.mean(move**2 / variance))) for move in moved])


def integral_transform(
    probabilities: Float[np.ndarray, "n C"], q: Int[np.ndarray, " n"], seed: int = 0
) -> Float[np.ndarray, " n"]:
    """The randomised probability integral transform of answers q, (n,)."""
    n = np.arange(len(q))
    chance = probabilities[n, q]
    below = np.cumsum(probabilities, axis=1)[n, q] - chance
    return below + np.random.default_rng(seed).uniform(size=len(q)) * chance


def normal_scores(
    probabilities: Float[np.ndarray, "n C"], q: Int[np.ndarray, " n"], seed: int = 0
) -> Float[np.ndarray, " n"]:
    """Normal scores of the transform (n,), each from the smaller of its tails: finite in both."""
    n, v = np.arange(len(q)), np.random.default_rng(seed).uniform(size=len(q))
    chance = probabilities[n, q]
    ranks = np.arange(probabilities.shape[1])[None, :]
    below = np.sum(np.where(ranks < q[:, None], probabilities, 0.0), axis=1)
    above = np.sum(np.where(ranks > q[:, None], probabilities, 0.0), axis=1)
    lower, upper = below + v * chance, above + (1.0 - v) * chance
    return np.where(lower < upper, 1.0, -1.0) * ndtri(np.minimum(lower, upper))


def clustered(values: Float[np.ndarray, " n"], person: Int[np.ndarray, " n"]) -> tuple[float, float]:
    """Mean of values, and its standard error where values of one person go together."""
    mean, people = values.mean(), np.unique(person)
    sums = np.array([np.sum(values[person == p] - mean) for p in people])
    if len(people) < 2:
        return float(mean), float("nan")
    return float(mean), float(np.sqrt(len(people) / (len(people) - 1) * np.sum(sums**2)) / len(values))


def calibration(found: LeftOut, seed: int = 0) -> dict[str, float]:
    """Mean cost, share in the central 95 % and z^2, each with its error by person."""
    u = integral_transform(found.probabilities, found.q, seed)
    parts = {
        "negative_log_density": found.cost,
        "central_95": ((u > 0.025) & (u < 0.975)).astype(float),
        "z2": normal_scores(found.probabilities, found.q, seed) ** 2,
    }
    content = {}
    for name, values in parts.items():
        content[name], content[f"{name}_error"] = clustered(values, found.person)
    return content


def reliability(found: LeftOut, bins: int = 10) -> list[dict[str, float]]:
    """Predicted against observed: in bins of the probability of a category, over all answers and categories."""
    chance = found.probabilities.ravel()
    chosen = (found.q[:, None] == np.arange(found.probabilities.shape[1])[None, :]).ravel()
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


@eqx.filter_jit
def _predict(population_map: RuleMap, x: Float[Array, "m d"]) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    return population_map.predict(x)


@eqx.filter_jit
def _newcomer_probabilities(gp: OrdinalGP, population_map: RuleMap, x: Float[Array, "m d"]) -> Float[Array, "m C"]:
    return jax.vmap(gp.likelihood.class_probabilities)(*population_map.newcomer(x))
