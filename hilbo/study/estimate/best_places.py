"""Posterior distribution of the optimum: the points at which joint draws of a map are closest to the goal.

The points are spread evenly over the feasible set, its walls included. The fraction of draws that are largest at a
point is the posterior probability that this point is the best of them; with posteriors under several draws of the
hyperparameters, these are integrated out.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from hilbo.kernels import RBF, Stationary
from hilbo.likelihoods import Goal
from hilbo.numerics.host import to_device
from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import Posterior
from hilbo.population.joint import posterior_map, quick_optima
from hilbo.search.candidates import search_points
from hilbo.search.space import SearchSpace

__all__ = ["DRAWS", "POINTS", "BestPlaces", "best_places", "nearness"]

POINTS = 800
"""Number of points inside the feasible set; a quarter as many are added on its walls."""
DRAWS = 4000
"""Number of joint draws for the location of the optimum; a 95 % region needs more."""
_AT_A_TIME = 2  # functions: their arithmetic is of one core each
_NEAR = 0.5  # lengths of the kernel


class BestPlaces(NamedTuple):
    """Even points of the unit cube, and the fraction of joint draws of which each was the maximum."""

    points: Float[Array, "m d"]
    share: Float[Array, " m"]
    """Fraction of draws that are largest at each point."""


def best_places(
    space: SearchSpace,
    goal: Goal,
    functions: Sequence[Posterior],
    seed: int = 0,
    count: int = POINTS,
    draws: int = DRAWS,
    say: Callable[[int, int], None] = lambda done, functions: None,
    *,
    quick: bool = False,
) -> BestPlaces:
    """Distribution of the optimum over `count` even points of the feasible set and a quarter as many on its walls.

    `functions`: equally probable posteriors, of each of which draws / number of posteriors (rounded up) are drawn. Two
    posteriors are processed at a time, in threads. `say`: called with the number of posteriors done, and of all.
    `quick`: by `quick_optima`, for analyses that are not part of a versioned method.
    """
    points, each = search_points(space, seed, count), -(-draws // len(functions))
    with ThreadPoolExecutor(_AT_A_TIME) as pool:
        seeds = map(to_device, range(seed, seed + len(functions)))
        shares = []
        for share in pool.map(
            lambda function, seed: _shares(function, goal, points, seed, each, quick), functions, seeds
        ):
            shares.append(jax.block_until_ready(share))
            say(len(shares), len(functions))
    return BestPlaces(points, sum(shares[1:], shares[0]) / len(shares))


@program
def _shares(
    function: Posterior, goal: Goal, points: Float[Array, "m d"], seed: ArrayLike, draws: int, quick: bool
) -> Float[Array, " m"]:
    """Fraction (m,) of `draws` joint draws of one posterior that are closest to the goal at each point."""
    closeness, key = partial(goal.closeness, function.gp.likelihood), jax.random.key(seed)
    if quick:
        return quick_optima(function, points, key, draws, closeness)
    return posterior_map(function, points).optima(key, draws, closeness=closeness)


def nearness(
    kernel: Stationary, points: Float[Array, "m d"], share: Float[Array, " m"], x: Float[Array, " d"]
) -> Float[Array, ""]:
    """Mean of exp(-s^2 / (2 * 0.5^2)) over the draws, a scalar; s is the distance of `x` from the best point of a draw
    in length scales of the kernel. `points` (m, d), `share` (m,): as in `BestPlaces`.

    Its maximum is the point that the best stimulus is most often near: the middle of one cluster of draws, and for
    several clusters a point in the densest, never between them. It is the Bayes decision for a loss that no longer
    grows beyond about one length scale.
    """
    narrow = RBF(kernel.theta / _NEAR**2, jnp.ones_like(kernel.variance), kernel.levels)
    return share @ jax.vmap(lambda place: narrow(x, place))(points)
