"""Starting points of the sampled model: the best non-adjacent points of a grid in (κ, α)."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hilbo.identification.fitting import Curve
from hilbo.numerics.tracing import program

__all__ = ["screened", "separate"]


@program
def screened(
    model: Any, curves: tuple[Curve, ...], scales: list[Float[Array, ""]], grid: Float[Array, "K A 2"]
) -> tuple[Float[Array, "K A"], Float[Array, "K A 2"]]:
    """Cost and best-fitting stiffnesses (K_inst, K_eff) at each grid point (log κ, logit α); compiled.

    `curves` must have position as input; `scales`: divisor (N) of the residuals of each curve. K_eff is not below 0. ->
    (K, A) and (K, A, 2).
    """
    weights = [jnp.full(c.output.shape[0], 1 / c.output.shape[0], c.scale.dtype) for c in curves]
    ends = jnp.eye(2, dtype=grid.dtype)

    def best_at(kappa_alpha):
        normal, right, total = jnp.zeros((2, 2), grid.dtype), jnp.zeros(2, grid.dtype), jnp.zeros((), grid.dtype)
        for curve, scale, w in zip(curves, scales, weights, strict=True):
            responses = [model.predict(jnp.concatenate([end, kappa_alpha]), curve, w) for end in ends]
            basis = jnp.stack(responses) / (scale * np.sqrt(curve.time.size))
            goal = w @ curve.output / (scale * np.sqrt(curve.time.size))
            normal, right, total = normal + basis @ basis.T, right + basis @ goal, total + goal @ goal
        a, b, c = normal[0, 0], normal[0, 1], normal[1, 1]
        K_eff = jnp.maximum((a * right[1] - b * right[0]) / (a * c - b * b), 0)
        stiffness = jnp.stack([(right[0] - b * K_eff) / a, K_eff])
        return total - 2 * right @ stiffness + stiffness @ normal @ stiffness, stiffness

    costs, stiffness = jax.lax.map(best_at, grid.reshape(-1, 2))
    return costs.reshape(grid.shape[:-1]), stiffness.reshape(grid.shape)


def separate(costs: Float[np.ndarray, "K A"], count: int) -> list[tuple]:
    """Indices (row, column) of the lowest costs, up to `count`, of which no two are adjacent, diagonally included.

    Costs that are not finite are left out.
    """
    remaining, indices = np.where(np.isfinite(costs), costs, np.inf), []
    while len(indices) < count and np.isfinite(remaining).any():
        i, j = np.unravel_index(np.argmin(remaining), remaining.shape)
        indices.append((i, j))
        remaining[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2] = np.inf
    return indices
