"""Responses of one participant as arrays: tested points and categories, padded to a capacity and masked.

With a fixed capacity a session that grows from 0 to 25 responses compiles once.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from hilbo.errors import InputError
from hilbo.numerics.shown import concrete, floats, has_values, numbers, shown

__all__ = ["Trials"]


def __dir__() -> list[str]:
    return __all__


_BLOCK = 32  # default capacities are multiples of this, so that growing data rarely recompile


def _floats(x: Any) -> Any:
    """Array with integers and booleans converted to the default float type; other objects unchanged."""
    return floats(x) if isinstance(x, jax.Array | np.ndarray) else x


class Trials(eqx.Module):
    """Responses of one participant, padded to a fixed capacity.

    `x` (capacity, d) are the tested points in the unit cube, `q` (capacity,) the categories 0..C-1, `mask` marks the
    rows with a response. Rows without a response have no influence.
    """

    x: Float[Array, "n d"] = eqx.field(converter=_floats)
    q: Int[Array, " n"]
    mask: Bool[Array, " n"]
    context: Int[Array, " n"] | None = None
    """Condition of each response, such as the clip, as an index from 0: the level of a random effect."""

    @classmethod
    def from_arrays(cls, x: ArrayLike, q: ArrayLike, capacity: int | None = None) -> "Trials":
        """Trials from points `x` (n, d) and categories `q` (n,).

        `capacity` defaults to n rounded up to a multiple of 32. Raises `InputError` for shapes that do not match,
        values that are not finite, categories that are not integers >= 0, or a capacity below n.
        """
        points, answers = _array("x", x), _array("q", q)
        _check_points(points)
        _check_arrays(points, answers)
        count = len(points)
        capacity = max(_BLOCK * -(-count // _BLOCK), _BLOCK) if capacity is None else capacity
        if not isinstance(capacity, int | np.integer) or isinstance(capacity, bool):
            raise InputError(f"Trials: capacity is {capacity}; give a whole number.")
        if capacity < max(count, 1):
            raise InputError(f"Trials: capacity is {capacity}, but {count} answers need at least {count or 1}.")
        dtype = points.dtype.newbyteorder("=") if np.issubdtype(points.dtype, np.floating) else np.dtype(float)
        padded = np.zeros((capacity, points.shape[1]), jax.dtypes.canonicalize_dtype(dtype))
        categories = np.zeros(capacity, np.int32)
        padded[:count], categories[:count] = points, answers
        # Of NumPy's arrays, which need no program; jnp.asarray compiles one for each shape (jax 0.10).
        return cls(*jax.device_put((padded, categories, np.arange(capacity) < count)))

    def __repr__(self) -> str:
        """One line: numbers of participants (if stacked), responses and parameters, capacity; the fields of a traced
        one."""
        if not has_values(self.x, self.mask):
            return eqx.tree_pformat(self)
        people = f"{self.x.shape[0]} people, " if self.mask.ndim == 2 else ""
        return (
            f"Trials({people}{int(self.mask.sum())} answers, {self.x.shape[-1]} parameters, room for {self.capacity})"
        )

    @classmethod
    def empty(cls, capacity: int, dim: int) -> "Trials":
        """Trials without responses, with room for `capacity` of them at points of `dim` coordinates.

        Raises `InputError` for a capacity or dimension below 1.
        """
        return cls.from_arrays(np.zeros((0, dim)), np.zeros(0, int), capacity)

    @property
    def capacity(self) -> int:
        """Number of rows, with and without a response."""
        return self.x.shape[-2]

    def append(self, x: ArrayLike | Sequence[float], q: ArrayLike) -> "Trials":
        """Copy with one more response in the first row without one; shapes stay the same, so nothing recompiles.

        `x` (d,) in the unit cube, `q` a category in 0..C-1. The copy has no contexts. Raises `InputError` for a point
        of another shape, values that are not finite, an invalid category, trials of several participants, and a full
        table. Traced values are not checked; if a full table is traced, all x become NaN.
        """
        if self.mask.ndim != 1:
            raise InputError(f"Trials: {len(self.mask)} participants; append to the responses of one, or use jax.vmap.")
        point, dim = numbers("Trials", "x", x, self.x.dtype), self.x.shape[-1]
        if point.shape != (dim,):
            raise InputError(f"Trials: x has shape {point.shape}; append one point, of shape ({dim},).")
        if concrete(point) and not np.all(np.isfinite(point)):
            raise InputError(f"Trials: x is {shown(point)}; give finite numbers.")
        if concrete(q):
            _check_categories(np.atleast_1d(_array("q", q)))
        if concrete(self.mask) and np.all(self.mask):
            raise InputError(f"Trials: all {self.capacity} rows have a response; make it with a larger capacity.")
        row = jnp.argmin(self.mask)
        return Trials(
            jnp.where(jnp.all(self.mask), jnp.nan, self.x.at[row].set(point)),
            self.q.at[row].set(jnp.asarray(q, self.q.dtype)),
            self.mask.at[row].set(True),
        )

    def first(self, count: ArrayLike) -> "Trials":
        """Copy in which only the first `count` rows may have a response: the mask is False from row `count` on.

        Points, categories and capacity stay. `count`: an int, from 0 to the capacity, may be traced.
        """
        keep = jnp.arange(self.capacity) < count
        return Trials(self.x, self.q, self.mask & keep, self.context)


def _array(name: str, value: Any) -> np.ndarray:
    """Value as a NumPy array; `name` is for the error. Raises `InputError` for rows of different lengths and for
    traced values."""
    try:
        return np.asarray(value)
    except jax.errors.TracerArrayConversionError:
        raise InputError(
            f"Trials: {name} is traced; from_arrays takes arrays outside jit and vmap. Build Trials(x, q, mask) there."
        ) from None
    except ValueError:
        words = "has rows of different lengths; give numbers, in rows of one length"
        raise InputError(f"Trials: {name} {words}.") from None


def _check_points(points: np.ndarray) -> None:
    """Raise `InputError` for points that are not float32, float64, integers or booleans, and for points without
    coordinates.
    """
    kind, size = points.dtype.kind, points.dtype.itemsize
    if kind not in "biu" and (kind, size) not in {("f", 4), ("f", 8)}:
        raise InputError(f"Trials: x is of type {points.dtype}; give numbers, as float32 or float64.")
    if points.ndim == 2 and not points.shape[1]:
        raise InputError(f"Trials: x has shape {points.shape}; give one column at least: each is a parameter.")


def _check_arrays(points: np.ndarray, answers: np.ndarray) -> None:
    """Raise `InputError` unless points are (n, d) and categories (n,), the points are finite, and the categories valid
    (`_check_categories`).
    """
    if points.ndim != 2 or answers.ndim != 1 or len(points) != len(answers):
        raise InputError(
            f"Trials: x has shape {points.shape} and q has shape {answers.shape}; give x as (n, d) and q as (n,)."
        )
    if not np.all(np.isfinite(points)):
        row = int(np.argwhere(~np.isfinite(points))[0, 0])
        raise InputError(f"Trials: x[{row}] has a value that is not finite; remove that response or fix it.")
    if len(answers):
        _check_categories(answers)


def _check_categories(answers: np.ndarray) -> None:
    """Raise `InputError` for categories that are not integers from 0 to the largest 32-bit integer."""
    if not np.issubdtype(answers.dtype, np.integer) or answers.min() < 0 or answers.max() > np.iinfo(np.int32).max:
        raise InputError("Trials: q must contain the categories as integers from 0 (lowest) to C - 1 (highest).")
