"""Dense factorisations that can be mapped by `vmap`: one matrix at a time on a CPU, batched elsewhere.

jaxlib's batched LAPACK kernels wait for the thread pool from inside that pool. If two of them are ready at once, all
workers of a small machine can deadlock (seen with jaxlib 0.10 on two cores: every worker in `ParallelBatchMap`). A
kernel on one matrix does not wait. Under `jax.vmap` these functions therefore loop over the matrices on a CPU, and stay
batched on other devices. They are not differentiable; their callers define derivative rules.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

__all__ = ["cholesky", "eigh", "one_at_a_time", "solve_lower", "solve_lower_transposed"]


def one_at_a_time(function: Callable, together: Callable | None = None) -> Callable:
    """Decorator that sets what `vmap` does: on a CPU it loops over `function`; elsewhere it maps `together`.

    `together` (default: `function` itself) is an equivalent that is batched well. Without `vmap` the function is
    unchanged.
    """
    mapped = jax.custom_batching.custom_vmap(function)
    batched = jax.vmap(function if together is None else together)

    @mapped.def_vmap
    def rule(size, in_batched, *args):
        whole = jax.tree.map(
            lambda a, b: a if b else jnp.broadcast_to(a, (size, *jnp.shape(a))), args, tuple(in_batched)
        )
        out = jax.lax.platform_dependent(
            *whole, cpu=lambda *stacked: jax.lax.map(lambda row: mapped(*row), stacked), default=batched
        )
        return out, jax.tree.map(lambda _: True, out)

    return mapped


@one_at_a_time
def eigh(matrix: Float[Array, "n n"]) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """Eigenvalues (n,), increasing, and eigenvectors (columns) of a symmetric matrix; its lower triangle is read."""
    vectors, eigenvalues = jax.lax.linalg.eigh(matrix, symmetrize_input=False)
    return eigenvalues, vectors


@one_at_a_time
def cholesky(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Lower Cholesky factor of a positive definite matrix, of which the lower triangle is read; NaN if it is not."""
    return jax.lax.linalg.cholesky(matrix, symmetrize_input=False)


@one_at_a_time
def solve_lower(factor: Float[Array, "n n"], right: Float[Array, "n m"]) -> Float[Array, "n m"]:
    """X with `factor` X = `right`, for a lower triangular factor."""
    return jax.scipy.linalg.solve_triangular(factor, right, lower=True)


@one_at_a_time
def solve_lower_transposed(factor: Float[Array, "n n"], right: Float[Array, "n m"]) -> Float[Array, "n m"]:
    """X with `factor`' X = `right`, for a lower triangular factor."""
    return jax.scipy.linalg.solve_triangular(factor, right, lower=True, trans=1)
