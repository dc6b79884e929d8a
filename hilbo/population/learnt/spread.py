"""Posterior spread of the hyperparameters at the end of a search, by a normal approximation."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from hilbo.population.learnt.factors import FINE, Chosen, diagonals
from hilbo.population.learnt.posterior import Coordinates, Problem, cost_at
from hilbo.population.learnt.search import Search
from hilbo.population.shared.scale_use import INDIVIDUAL

__all__ = ["posterior_spread"]

_WHOLE = 32  # most participants with a full Hessian of the individual coordinates: one or two gradients each


def posterior_spread(chosen: Chosen) -> tuple[Coordinates, Float[Array, "k k"]]:
    """Posterior standard deviations of the free coordinates of a search, by a normal approximation, and their
    covariance (k, k) without widths and sensitivities.

    The curvature is from differences of gradients at the end of the search. A standard deviation is infinite where the
    variance comes out not positive: then there is no maximum.
    """
    search, problem, free, _ = chosen
    coordinates, end = search.coordinates, search.cost
    own = [name for name in INDIVIDUAL if name in free]
    common = {name: value for name, value in coordinates.items() if name in free - set(INDIVIDUAL)}
    flat, restore = ravel_pytree(common)

    def difference(way: Coordinates) -> Coordinates:
        moved = coordinates | {name: coordinates[name] + FINE * step for name, step in way.items()}
        ahead = cost_at(moved, end.weights, problem).gradient
        return jax.tree.map(lambda a, b: (a - b) / FINE, ahead, end.gradient)

    def of_common(moved: Coordinates) -> np.ndarray:
        return np.asarray(ravel_pytree({name: moved[name] for name in common})[0])

    columns = [difference(restore(unit)) for unit in jnp.eye(flat.size, dtype=flat.dtype)]
    hessian = np.stack([of_common(column) for column in columns])
    if not own:
        covariance = np.linalg.inv(hessian)
        return restore(jnp.asarray(_root_of_diagonal(covariance))), jnp.asarray(covariance)
    mixed = np.stack([np.concatenate([np.asarray(column[name]) for name in own]) for column in columns])
    curvature = _curvature_of_individuals(search, problem, difference, own)
    covariance = np.linalg.inv(np.block([[hessian, mixed], [mixed.T, curvature]]))
    sd, k = _root_of_diagonal(covariance), flat.size
    individual = zip(own, np.split(sd[k:], len(own)), strict=True)
    every = restore(jnp.asarray(sd[:k])) | {name: jnp.asarray(value) for name, value in individual}
    return every, jnp.asarray(covariance[:k, :k])


def _curvature_of_individuals(
    search: Search, problem: Problem, difference: Callable[[Coordinates], Coordinates], own: list[str]
) -> Float[np.ndarray, "o o"]:
    """Hessian (o, o) of the cost in the individual coordinates `own`, each of which has a value for each participant,
    one after the other, from `difference`, its product with a vector.

    Of more than 32 participants each one's curvature in the width is the row sum of the Hessian, which keeps that of
    all together: widths may rise where the gaps fall. With sensitivities the diagonals of all blocks are kept instead,
    and the mean of the other elements.
    """
    like = search.coordinates[own[0]]
    if like.size <= _WHOLE:
        columns = [difference({name: unit}) for name in own for unit in jnp.eye(like.size, dtype=like.dtype)]
        return np.stack([np.concatenate([np.asarray(column[name]) for name in own]) for column in columns])
    together = {name: difference({name: jnp.ones_like(like)}) for name in own}
    if "sensitivities" not in own:
        return np.diag(np.asarray(together["widths"]["widths"]))

    def block(name: str, other: str) -> Float[np.ndarray, "M M"]:
        diagonal = (of_each[name][other] + of_each[other][name]) / 2
        between = float(np.sum(np.asarray(together[name][other]) - diagonal)) / (like.size * (like.size - 1))
        return np.diag(diagonal - between) + between

    of_each = {name: diagonals(search, problem, name) for name in own}
    return np.block([[block(name, other) for other in own] for name in own])


def _root_of_diagonal(covariance: Float[np.ndarray, "k k"]) -> Float[np.ndarray, " k"]:
    """Standard deviations (k,) of a covariance; infinite where a variance is not positive."""
    variances = np.diagonal(covariance)
    return np.sqrt(np.where(variances > 0, variances, np.inf))
