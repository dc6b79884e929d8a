"""Where joint draws of a map are largest: what the answers say of where the best rendering is.

The points are spread evenly over the feasible set, its walls included. Their shares of the draws are the posterior
probability, point by point, that nothing is better; with functions by several draws of the hyperparameters, these are
integrated out.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from hilbo.kernels import RBF, Stationary
from hilbo.numerics.host import to_device
from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import Posterior
from hilbo.population.joint import posterior_map
from hilbo.search.candidates import search_points
from hilbo.search.space import SearchSpace

__all__ = ["DRAWS", "POINTS", "BestPlaces", "best_places", "nearness"]

POINTS = 800
"""Inside the feasible set; a quarter more are on its walls."""
DRAWS = 4000
"""Which say where the best is; a region that holds 95 % takes more."""
_AT_A_TIME = 2  # functions: their arithmetic is of one core each
_NEAR = 0.5  # lengths of the kernel


class BestPlaces(NamedTuple):
    """Even points of the unit cube, and how often each was the best."""

    points: Float[Array, "m d"]
    share: Float[Array, " m"]
    """Of the draws that are largest at each point."""


def best_places(
    space: SearchSpace, functions: Sequence[Posterior], seed: int = 0, count: int = POINTS, draws: int = DRAWS
) -> BestPlaces:
    """By `draws` joint draws of equally probable posteriors, as many of each, at `count` even points, and a quarter as
    many on the walls."""
    points, each = search_points(space, seed, count), -(-draws // len(functions))
    with ThreadPoolExecutor(_AT_A_TIME) as pool:
        seeds = map(to_device, range(seed, seed + len(functions)))
        shares = list(pool.map(lambda function, seed: _shares(function, points, seed, each), functions, seeds))
    return BestPlaces(points, sum(shares[1:], shares[0]) / len(shares))


@program
def _shares(function: Posterior, points: Float[Array, "m d"], seed: ArrayLike, draws: int) -> Float[Array, " m"]:
    return posterior_map(function, points).optima(jax.random.key(seed), draws)


def nearness(
    kernel: Stationary, points: Float[Array, "m d"], share: Float[Array, " m"], x: Float[Array, " d"]
) -> Float[Array, ""]:
    """The mean of exp(-s^2 / (2 * 0.5^2)) over the draws, s the distance of `x` from the best place of a draw in
    lengths of the kernel.

    Where it is largest the best rendering is most often near. Where draws scatter about one place that is their middle;
    of several places it is in the most crowded one, never between them. It is the decision for a loss that no longer
    grows from about a length on: so far away one wrong rendering is as wrong as another.
    """
    narrow = RBF(kernel.theta / _NEAR**2, jnp.ones_like(kernel.variance), kernel.levels)
    return share @ jax.vmap(lambda place: narrow(x, place))(points)
