"""Log posterior of the hyperparameters that a recipe maximises, with its gradient, in unconstrained coordinates."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from hilbo.kernels import RBF, Levels, Matern32, Stationary, theta_of
from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import OrdinalGP
from hilbo.population.rules.recipes import LEARNT_1, Prior
from hilbo.population.shared.features import Pivots
from hilbo.population.shared.low_rank import shared_evidence
from hilbo.population.shared.people_model import PeopleModel
from hilbo.population.shared.tallies import Tallies

__all__ = [
    "KERNELS",
    "LEFT",
    "NOTHING",
    "Coordinates",
    "Cost",
    "Problem",
    "Stated",
    "cost_at",
    "every_theta",
    "medians",
    "model_at",
    "prior_model",
]

Coordinates = dict[str, Float[Array, "..."]]
KERNELS: dict[str, type[Stationary]] = {"rbf": RBF, "matern32": Matern32}
"""By their names in recipes."""
LEFT = 1e-4
"""Of the shared function's prior variance, what the search may leave: 2e-4 of the log evidence of 600 answers."""


class Stated(NamedTuple):
    """Hyperparameters that a study file specifies; None is learnt.

    `theta`: of the numeric coordinates. `levels`: for each coordinate, None for numeric ones; empty if all are numeric.
    The levels' correlation is fixed if theta is specified, and else the centre of its prior.
    """

    theta: tuple[float, ...] | None = None
    variance: float | None = None
    thresholds: tuple[float, ...] | None = None
    noise: float | None = None
    levels: tuple[Levels | None, ...] = ()

    @property
    def numbers(self) -> dict[str, Any]:
        """The specified hyperparameters by their names in [gp], without `levels`."""
        return {name: value for name, value in self._asdict().items() if name != "levels" and value is not None}

    @property
    def counts(self) -> tuple[int, ...]:
        """For each coordinate its number of levels, 0 for numeric ones, as kernels take it; empty if all are
        numeric.
        """
        return tuple(0 if each is None else each.count for each in self.levels)


NOTHING = Stated()


class Problem(eqx.Module):
    """Data of a search: counts of responses, specified hyperparameters, priors, kernel, the pivots of the shared
    function's features, and the `theta` (d,) with which these were chosen.
    """

    answers: Tallies
    stated: Stated = eqx.field(static=True)
    priors: Mapping[str, Prior]
    kernel: type[Stationary] = eqx.field(static=True)
    pivots: Pivots
    """Of the shared function's features."""
    theta: Float[Array, " d"]
    """By which they were chosen."""
    information: Float[Array, " M"] | None = None
    """Curvature (M,), at least 0, of the log evidence in each participant's log sensitivity, with which Laplace's
    method integrates these out; their spread could not be learnt from their maximum."""
    fixed_point: Float[Array, ""] | None = None
    """Of the sensitivities, as in `PeopleModel`."""


class Cost(NamedTuple):
    """Minus the log posterior of the hyperparameters and its gradient; log evidence and weights (M, n) at the mode; and
    whether the fit converged and all is finite (`usable`).
    """

    value: Float[Array, ""]
    gradient: Coordinates
    log_evidence: Float[Array, ""]
    weights: Float[Array, "M n"]
    usable: Bool[Array, ""]


def every_theta(
    kernel: type[Stationary], theta: tuple[float, ...], levels: tuple[Levels | None, ...]
) -> tuple[float, ...]:
    """One theta for each coordinate, from those of the numeric coordinates and from the correlations of levels."""
    given = iter(theta)
    return tuple(next(given) if each is None else theta_of(kernel, each.correlation) for each in levels) or theta


def prior_model(dim: int, categories: int, stated: Stated = NOTHING) -> OrdinalGP:
    """One participant's model before any response, which sessions use: the specified hyperparameters, and the medians
    of the priors, which all recipes have in common, with the RBF. `dim`: number of coordinates.
    """
    nobody = Tallies(jnp.zeros((1, 1, dim)), jnp.zeros((1, 1, categories)))
    return model_at(medians(nobody, stated, LEARNT_1.priors, RBF), nobody, stated, RBF).gp


@program
def cost_at(coordinates: Coordinates, start: Float[Array, "M n"], problem: Problem) -> Cost:
    """Cost at the given coordinates; `start` (M, n): weights from which the mode is searched. Never raises: read
    `usable`.
    """

    def value(coordinates):
        model = model_at(coordinates, problem.answers, problem.stated, problem.kernel, problem.fixed_point)
        evidence = shared_evidence(model, problem.answers, start, problem.pivots)
        return -evidence.value - _log_prior(coordinates, problem), evidence

    (cost, evidence), gradient = jax.value_and_grad(value, has_aux=True)(coordinates)
    finite = jnp.all(jnp.isfinite(ravel_pytree(gradient)[0])) & jnp.isfinite(cost)
    return Cost(cost, gradient, evidence.value, evidence.weights, evidence.arrived & finite)


def medians(answers: Tallies, stated: Stated, priors: Mapping[str, Prior], kernel: type[Stationary]) -> Coordinates:
    """Medians of the priors of the hyperparameters that are learnt, by coordinate: the start of the search.

    There is no entry for specified ones, for widths with fewer than three categories, and for an effect without
    contexts.
    """
    (people, _, d), categories, dtype = answers.x.shape, answers.counts.shape[-1], answers.x.dtype
    every = {
        "theta": jnp.full(d, priors["theta"].mean, dtype) - _lowered(stated, priors["theta"], kernel, d),
        "shared": jnp.asarray(priors["shared"].mean, dtype),
        "own": jnp.asarray(priors["own"].mean, dtype),
        "middle": jnp.asarray(priors["middle"].mean, dtype),
        "gaps": jnp.full(categories - 2, priors["gaps"].mean, dtype),
        "widths": jnp.full(people, priors["widths"].mean, dtype),
        "effect": jnp.asarray(priors["effect"].mean, dtype),
    }
    kept = {"theta"} if stated.theta is not None else set()
    kept |= {"middle", "gaps"} if stated.thresholds is not None else set()
    kept |= {"widths"} if categories < 3 else set()
    kept |= {"effect"} if answers.context is None else set()
    return {name: value for name, value in every.items() if name not in kept and value.size}


def model_at(
    coordinates: Coordinates,
    answers: Tallies,
    stated: Stated,
    kernel: type[Stationary],
    fixed_point: Float[Array, ""] | None = None,
) -> PeopleModel:
    """Hyperparameters at the given coordinates, completed by the specified ones (`stated`).

    Their unit is the specified noise, or the specified variance, or else a noise of 1. Only the shapes of `answers` are
    used. `fixed_point`: as in `PeopleModel`.
    """
    (people, _, d), dtype = answers.x.shape, answers.x.dtype
    shared, own = jnp.exp(coordinates["shared"]), jnp.exp(coordinates["own"])
    noise = jnp.asarray(1.0 if stated.noise is None else stated.noise, dtype)
    if stated.variance is not None:
        scale = stated.variance / (shared + own)
        noise = jnp.sqrt(scale) if stated.noise is None else noise
        shared, own = scale * shared, scale * own
    else:
        shared, own = noise**2 * shared, noise**2 * own
    if stated.theta is None:
        theta = jnp.exp(coordinates["theta"])
    else:
        theta = jnp.broadcast_to(jnp.asarray(every_theta(kernel, stated.theta, stated.levels), dtype), (d,))
    if stated.thresholds is None:
        gaps = jnp.exp(coordinates["gaps"]) if "gaps" in coordinates else jnp.zeros(0, dtype)
        edges = jnp.concatenate([jnp.zeros(1, dtype), jnp.cumsum(gaps)])
        thresholds = noise * (coordinates["middle"] + edges - jnp.mean(edges))
    else:
        thresholds = jnp.asarray(stated.thresholds, dtype)
    widths = coordinates.get("widths", jnp.zeros(people, dtype))
    effect = noise**2 * jnp.exp(coordinates["effect"]) if "effect" in coordinates else None
    sensitivities = coordinates.get("sensitivities")
    return PeopleModel(
        theta, shared, own, thresholds, noise, widths, kernel, stated.counts, effect, sensitivities, fixed_point
    )


def _log_prior(coordinates: Coordinates, problem: Problem) -> Float[Array, ""]:
    """Log prior density of the coordinates, up to a constant: a scalar, in nats. With sensitivities, the log of the
    Laplace factor of their integral is added.
    """
    d = problem.answers.x.shape[-1]
    total = jnp.zeros((), problem.answers.x.dtype)
    for name, value in coordinates.items():
        mean, sd = (0.0, jnp.exp(coordinates["spread"])) if name == "sensitivities" else problem.priors[name]
        lowered = _lowered(problem.stated, problem.priors[name], problem.kernel, d) if name == "theta" else 0.0
        total -= 0.5 * jnp.sum(((value - mean + lowered) / sd) ** 2)
    if problem.information is not None:
        total -= 0.5 * jnp.sum(jnp.log1p(jnp.exp(2 * coordinates["spread"]) * problem.information))
    return total


def _lowered(stated: Stated, prior: Prior, kernel: type[Stationary], d: int) -> Float[Array, "*d"]:
    """Amount subtracted from the prior's mean of log theta: the log of the number of numeric coordinates, a scalar;
    with levels (d,), and for categorical coordinates such that the mean gives their correlation.
    """
    if not stated.levels:
        return jnp.log(d)
    numbers = sum(each is None for each in stated.levels)
    by = (np.log(numbers) if e is None else prior.mean - np.log(theta_of(kernel, e.correlation)) for e in stated.levels)
    return jnp.asarray(list(by))
