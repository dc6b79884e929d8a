"""Scrambled Sobol points under `jit`: independent low-discrepancy samples of the unit cube.

Reference: Matousek (1998), J. Complexity 14:527 (random linear scramble and shift).
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, PRNGKeyArray

from hilbo.errors import InputError

__all__ = ["scrambled_sobol"]


def scrambled_sobol(
    key: PRNGKeyArray, replicates: int, count: int, dim: int, dtype: DTypeLike
) -> Float[Array, "replicates count dim"]:
    """Independent scrambles (`replicates`) of the first `count` points of Sobol's sequence, in (0, 1)^dim. Raises
    `InputError` if `count` is not a power of 2, 2 or more.

    A random lower triangular bit matrix times the generators of each dimension, and a random shift: every point is
    uniform, and the points of a scramble have the sequence's low discrepancy.
    """
    bits = min(30, jnp.finfo(dtype).nmant)
    generators = jnp.asarray(_generators(count, dim, bits))  # (levels, dim)
    index = jnp.arange(count, dtype=jnp.uint32)

    def scrambled(key, columns):
        matrix, shift = jax.random.split(key)
        row = jnp.arange(bits, dtype=jnp.uint32)
        one = jnp.uint32(1) << row  # each row's own bit
        above = (jnp.uint32(1) << jnp.uint32(bits)) - (one << jnp.uint32(1))
        rows = (jax.random.bits(matrix, (bits,), jnp.uint32) & above) | one
        parity = jax.lax.population_count(rows[:, None] & columns[None, :]) & jnp.uint32(1)
        mixed = jnp.sum(parity << row[:, None], axis=0, dtype=jnp.uint32)
        point = jnp.full((count,), jax.random.bits(shift, (), jnp.uint32) >> jnp.uint32(32 - bits))
        for level in range(columns.shape[0]):
            point = point ^ jnp.where((index >> jnp.uint32(level)) & jnp.uint32(1) == 1, mixed[level], jnp.uint32(0))
        return (point.astype(dtype) + 0.5) * 2.0**-bits

    def replicate(key):
        return jax.vmap(lambda j, columns: scrambled(jax.random.fold_in(key, j), columns))(
            jnp.arange(dim), generators.T
        )

    points = jax.vmap(replicate)(jax.random.split(key, replicates))
    return jnp.moveaxis(points, 1, 2)


@functools.cache
def _generators(count: int, dim: int, bits: int) -> np.ndarray:
    """Sobol's generators (levels, dim) as integers, recovered from SciPy's sequence, which is in Gray-code order.

    Raises `InputError` for a count that is not a power of 2.
    """
    from scipy.stats import qmc  # imported late: slow, and only this method needs it

    levels = count.bit_length() - 1
    if 2**levels != count or count < 2:
        raise InputError(f"sobol: {count} points; give a power of 2, 2 or more.")
    points = qmc.Sobol(dim, scramble=False, bits=30).random(count)
    numbers = (points * 2.0**30).astype(np.uint32) >> np.uint32(30 - bits)
    generators = np.empty((levels, dim), np.uint32)
    generators[0] = numbers[1]
    for level in range(1, levels):
        generators[level] = numbers[2**level] ^ generators[level - 1]
    return generators
