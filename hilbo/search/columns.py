"""Columns of K1 in a box with mechanics: the feasible interval of K1 given the other parameters, and its width.

A column is the set of feasible K1 for given other parameters, on [0, 1] of its range. It ends at the largest passive
K1. With a range of effective damping, or constraints on K1, it may start above the lowest K1, and end earlier
(`feasibility` has all ends). A column whose passive end is below the lowest K1, or with no K1 in the range, has width 0
and contains no feasible point.

Uniform points of the passive part come from uniform numbers by the Rosenblatt map whose density is the column's width
over (B1, α), from a table; Rosenblatt (1952), Ann. Math. Stat. 23:470. A constraint with another parameter, on which a
width would also depend, is not part of it (`drawn`): its points are rejected instead.
"""

import dataclasses
import functools
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from hilbo.errors import InputError
from hilbo.numerics.tracing import program
from hilbo.search.box import Constraint, Mechanics, Parameter
from hilbo.search.feasibility import K1_interval, largest_K1

__all__ = ["COLUMNS", "ROWS", "Columns", "check_volume", "column_ends", "column_table", "rosenblatt", "volume"]

# Cells of the table of column widths. At small B1 the width falls from all to little within 1/1000 of the range, so
# the rows crowd there: with even rows the share of the first one alone would be off by a sixth.
_CELLS = 256
ROWS = np.linspace(0, 1, _CELLS + 1) ** 3  # x_B1
COLUMNS = np.linspace(0, 1, _CELLS + 1)  # x_alpha
_MODEL = ("K1", "B1", "alpha")
_Batch = Float[Array, "*batch"]


@dataclass(frozen=True)
class Columns:
    """Feasible intervals of K1 (columns) given the other parameters; `constraints`: those that involve K1.

    Points are (..., d), in the unit cube; their own K1 has no influence on the ends of its column.
    """

    parameters: tuple[Parameter, ...]
    mechanics: Mechanics
    constraints: tuple[Constraint, ...] = ()

    @property
    def drawn(self) -> "Columns":
        """Columns from which uniform points are drawn: with the constraints on K1, B1 and alpha alone."""
        alone = (c for c in self.constraints if all(name in _MODEL for name, weight in c.terms if weight))
        return dataclasses.replace(self, constraints=tuple(alone))

    def index(self, name: str) -> int:
        """Coordinate of the parameter with this name."""
        return next(i for i, parameter in enumerate(self.parameters) if parameter.name == name)

    def from_shares(self, w: Float[Array, "*batch d"]) -> Float[Array, "*batch d"]:
        """Map points whose K1 is a fraction of its column, 0 to 1, to the unit cube; x_K1 is 0 in an empty column.

        `w` (..., d) -> (..., d); all other coordinates are those of the unit cube and unchanged.
        """
        K1 = self.index("K1")
        if not self.between:
            return w.at[..., K1].multiply(self.passive_end(w))
        start, width = self.interval(w)
        return w.at[..., K1].set(start + w[..., K1] * width)

    def to_shares(self, w: Float[Array, "*batch d"], x: Float[Array, "*batch d"]) -> Float[Array, "*batch d"]:
        """Inverse of `from_shares`: `w` with its K1 replaced by the fraction of the column at which the K1 of `x` is.

        `x`: the same points in the unit cube. Not finite in an empty column.
        """
        K1 = self.index("K1")
        if not self.between:
            return w.at[..., K1].divide(self.passive_end(x))
        start, width = self.interval(x)
        return w.at[..., K1].set((x[..., K1] - start) / width)

    def passive_end(self, x: Float[Array, "*batch d"]) -> _Batch:
        """Largest passive x_K1 (...,) in the columns of points, within the range of K1; 0 if there is none."""
        K1, B1, alpha = (self.index(name) for name in ("K1", "B1", "alpha"))
        physical = (self.parameters[i].to_physical(x[..., i]) for i in (B1, alpha))
        low, high = self.parameters[K1].low, self.parameters[K1].high
        return self.parameters[K1].to_unit(jnp.clip(largest_K1(self.mechanics, *physical), low, high))

    def interval(self, x: Float[Array, "*batch d"]) -> tuple[_Batch, _Batch]:
        """Start and width (...,) of the columns of points in x_K1, by passivity, effective damping and constraints.

        The width is 0 for an empty column.
        """
        K1 = self.parameters[self.index("K1")]
        physical = {p.name: p.to_physical(x[..., i]) for i, p in enumerate(self.parameters)}
        start, end = K1_interval(self.mechanics, K1, self.constraints, physical)
        end = jnp.minimum(end, self.passive_end(x))
        return start, jnp.maximum(end - start, 0)

    @property
    def between(self) -> bool:
        """Whether the columns are limited by effective damping or constraints, and not by passivity alone."""
        return self.mechanics.effective_damping is not None or self.constraints != ()


@program
def column_ends(columns: Columns, x: Float[ArrayLike, "*batch d"]) -> tuple[_Batch, _Batch]:
    """Lower and upper end (...,) in x_K1 of the columns of points (..., d); equal for an empty one."""
    x = jnp.asarray(x, jnp.result_type(1.0, x))
    if not columns.between:
        end = columns.passive_end(x)
        return jnp.zeros_like(end), end
    start, width = columns.interval(x)
    return start, start + width


@functools.lru_cache(maxsize=16)
def column_table(columns: Columns) -> tuple[Float[np.ndarray, "r c"], Float[np.ndarray, "r c"]]:
    """Lower and upper ends of the columns in x_K1, on a grid of x_B1 (`ROWS`) and x_alpha (`COLUMNS`); cached.

    Two arrays (257, 257); all other parameters are at the middle of their range.
    """
    x = np.full((_CELLS + 1, _CELLS + 1, len(columns.parameters)), 0.5)
    x[..., columns.index("B1")], x[..., columns.index("alpha")] = ROWS[:, None], COLUMNS
    start, end = column_ends(columns, x)
    return np.asarray(start, float), np.asarray(end, float)


@functools.lru_cache(maxsize=16)
def _cumulative_volume(columns: Columns) -> tuple[Float[np.ndarray, " r"], Float[np.ndarray, "cells c"]]:
    """Cumulative volume of the columns over the rows of B1, (257,), and within each row over alpha, (256, 257).

    The former ends at the total volume, the latter at 1 in each row. Cached.
    """
    start, end = column_table(columns)
    node = end - start
    mean = (node[1:, 1:] + node[1:, :-1] + node[:-1, 1:] + node[:-1, :-1]) / 4
    cells = mean * np.diff(ROWS)[:, None] * np.diff(COLUMNS)
    within = np.pad(np.cumsum(cells, axis=1), ((0, 0), (1, 0)))
    total = within[:, -1:]
    within = np.where(total > 0, within, COLUMNS) / np.where(total > 0, total, 1)
    return np.pad(np.cumsum(total), (1, 0)), within


def volume(columns: Columns) -> float:
    """Fraction of the unit cube that the columns fill: their mean width, on a grid. Valid for `drawn` columns only."""
    return float(_cumulative_volume(columns)[0][-1])


def rosenblatt(columns: Columns, uniform: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
    """Map uniform numbers (n, d) to points whose density in (B1, alpha) is proportional to the column's width.

    K1 stays a fraction of its column (`from_shares`), and other parameters stay. Valid for `drawn` columns only.
    """
    rows, within = _cumulative_volume(columns)
    B1, alpha = columns.index("B1"), columns.index("alpha")
    w = uniform.copy()
    w[:, B1] = np.interp(uniform[:, B1] * rows[-1], rows, ROWS)
    row = np.searchsorted(ROWS[1:-1], w[:, B1], side="right")
    # All rows at once: row r of the table climbs from r to r + 1.
    climbing = (within + np.arange(_CELLS)[:, None]).ravel()
    w[:, alpha] = np.interp(row + uniform[:, alpha], climbing, np.tile(COLUMNS, _CELLS))
    return w


def check_volume(columns: Columns) -> None:
    """Raise `InputError` if every column is empty, with the key of the study file to change. For `drawn` columns."""
    if volume(columns) > 0:
        return
    mechanics, K1 = columns.mechanics, columns.parameters[columns.index("K1")]
    if mechanics.effective_damping is not None:
        raise InputError(
            f"renderer.effective_damping leaves no parameter set: none is passive with renderer.damping = "
            f"{mechanics.damping} N.s/m and between {mechanics.effective_damping[0]} and "
            f"{mechanics.effective_damping[1]} N.s/m; widen it."
        )
    late, lower = (f" at a delay of {mechanics.delay} s", "delay, ") if mechanics.delay else ("", "")
    raise InputError(
        f"renderer.damping is {mechanics.damping} N.s/m, with which no K1 from {K1.low} N/mm up is passive for any B1 "
        f"and alpha{late}; check its unit, or lower {lower}K_eff or parameters.K1.low."
    )
