"""Discrete parameters (whole numbers and unordered levels): neighbouring points, and rounding of uniform numbers."""

import itertools
from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hilbo.search.box import Parameter

__all__ = ["neighbours", "steps_of"]

Parameters = tuple[Parameter, ...]


def neighbours(parameters: Parameters, coupled: bool, x: Float[Array, " d"]) -> Float[Array, "k d"]:
    """Points (k, d) of the unit cube that differ from `x` by a step of one discrete parameter; there must be one.

    Whole numbers change by ±1, ±2, ±4, ..., limited to the range, levels to every other. If `coupled`, also pairs of
    whole numbers, each by ±1.
    """
    values = [p.to_physical(x[i]) for i, p in enumerate(parameters)]
    changes = list(_changes(parameters, values))
    whole = [i for i, p in enumerate(parameters) if p.integer]
    for i, j in itertools.combinations(whole if coupled else (), 2):
        for a, b in itertools.product((-1, 1), repeat=2):
            changes.append({k: _moved(parameters[k], values[k], step) for k, step in ((i, a), (j, b))})
    rows = []
    for change in changes:
        row = x
        for i, value in change.items():
            row = row.at[i].set(parameters[i].to_unit(value))
        rows.append(row)
    return jnp.stack(rows)


def _changes(parameters: Parameters, values: list[Float[Array, ""]]) -> Iterator[dict[int, Float[Array, ""]]]:
    """Yield for every step of one discrete parameter a dict of its index and new physical value."""
    for i, p in enumerate(parameters):
        if p.levels:
            yield from ({i: (values[i] + step) % p.steps} for step in range(1, p.steps))
        elif p.integer:
            lengths = [2**k for k in range(max(p.steps - 1, 1).bit_length())]
            yield from ({i: _moved(p, values[i], sign * length)} for length in lengths for sign in (-1, 1))


def _moved(p: Parameter, value: Float[Array, ""], by: int) -> Float[Array, ""]:
    """Physical value changed by `by`, limited to the range of the parameter."""
    return jnp.clip(value + by, p.low, p.high)


def steps_of(parameters: Parameters, uniform: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
    """Uniform numbers (n, d) as points of the unit cube: discrete parameters become steps of equal probability.

    The array itself is returned if no parameter is discrete.
    """
    if not any(p.discrete for p in parameters):
        return uniform
    x = uniform.copy()
    for i, p in enumerate(parameters):
        if p.discrete:
            step = np.minimum(np.floor(uniform[:, i] * p.steps), p.steps - 1)
            x[:, i] = np.asarray(p.to_unit(p.low + step))
    return x
