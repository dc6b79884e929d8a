"""Points of a search space from chunks of uniform numbers: the first feasible ones, in the unit cube.

What they need of a space is in `Searchable`, which `hilbo.search.space.SearchSpace` is.
"""

from typing import Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from hilbo.errors import InputError
from hilbo.numerics.host import to_device
from hilbo.numerics.tracing import program
from hilbo.search.box import Constraint, Mechanics, Parameter
from hilbo.search.columns import Columns, rosenblatt
from hilbo.search.space_filling import Chunks, take
from hilbo.search.steps import steps_of

__all__ = ["Searchable", "box_points", "feasible_points", "joined", "take_feasible", "unit_points"]


@runtime_checkable
class Searchable(Protocol):
    """A space of named parameters with a feasible part; points (..., d) of its unit cube and of its box."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """In the order of the coordinates."""
        ...

    @property
    def mechanics(self) -> Mechanics | None:
        """Of the renderer."""
        ...

    @property
    def constraints(self) -> tuple[Constraint, ...]:
        """Linear ones."""
        ...

    @property
    def dim(self) -> int:
        """Number of parameters."""
        ...

    def from_box(self, w: Float[ArrayLike, "*batch d"]) -> Float[Array, "*batch d"]:
        """Optimiser's coordinates to the unit cube."""
        ...

    def to_box(self, x: Float[ArrayLike, "*batch d"]) -> Float[Array, "*batch d"]:
        """Inverse of `from_box`."""
        ...

    def feasible(self, x: Float[ArrayLike, "*batch d"]) -> Bool[Array, "*batch"]:
        """Whether points of the unit cube are feasible, (...,)."""
        ...


@program
def feasible_points(space: Searchable, x: Float[ArrayLike, "n d"]) -> Bool[Array, " n"]:
    """`feasible` of a space, compiled."""
    return space.feasible(x)


@program
def box_points(space: Searchable, x: Float[ArrayLike, "n d"]) -> Float[Array, "n d"]:
    """`to_box` of a space, compiled."""
    return space.to_box(x)


@program
def unit_points(space: Searchable, w: Float[ArrayLike, "n d"]) -> tuple[Float[Array, "n d"], Bool[Array, " n"]]:
    """`from_box` of a space, compiled: points of the unit cube, and whether each is feasible."""
    x = space.from_box(w)
    return x, space.feasible(x)


@program
def _from_columns(
    space: Searchable, columns: Columns, w: Float[ArrayLike, "n d"]
) -> tuple[Float[Array, "n d"], Bool[Array, " n"]]:
    """Points of the unit cube from `w`, whose K1 is a share of its column, and whether each is feasible; compiled."""
    x = columns.from_shares(to_device(w, jnp.result_type(1.0, w)))
    return x, space.feasible(x)


def take_feasible(
    space: Searchable, count: int, chunks: Chunks, columns: Columns | None, hold: Chunks | None = None
) -> Float[np.ndarray, "count d"]:
    """Take the first `count` feasible points out of chunks of uniform numbers; points of the unit cube.

    `columns`: K1 is drawn within them; None: points are drawn in the box coordinates. `hold`: chunks of the same sizes
    with the coordinates that are fixed at an end, NaN for free ones. Raises `InputError` for too few.
    """

    def place(uniform):
        w = uniform if columns is None else rosenblatt(columns.drawn, uniform)
        if hold is not None:
            ends = next(hold)
            w = np.where(np.isnan(ends), w, ends)
        w = steps_of(space.parameters, w)
        x, feasible = unit_points(space, w) if columns is None else _from_columns(space, columns, w)
        return np.asarray(x), np.asarray(feasible)

    return joined(space, count, *take(count, chunks, place))


def joined(
    space: Searchable, count: int, kept: list[Float[np.ndarray, "_ d"]], taken: int, tried: int
) -> Float[np.ndarray, "count d"]:
    """Concatenate the arrays of points in `kept`. Raises `InputError` if `taken` is fewer than `count` (of `tried`)."""
    if taken < count:
        left = f"{taken} of {tried} {'points' if space.mechanics is None else 'passive points'}, too few to search"
        if space.constraints:
            raise InputError(f"constraints leave {left}; widen them.")
        raise InputError(f"renderer.effective_damping leaves {left}; widen it.")
    return np.concatenate(kept) if kept else np.zeros((0, space.dim))
