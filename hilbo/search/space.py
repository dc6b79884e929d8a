"""Search space: named parameters, the unit cube, and its feasible part.

Three coordinate systems:

- *physical*: the numbers of tables and devices, in the units of the parameters; of a level its position in the list;
- *unit cube* x: every parameter on [0, 1] over its full range, linear or logarithmic; the kernels' coordinates;
- *box* w: the optimiser's coordinates, in which the feasible set is a polytope within [0, 1]^d. With mechanics, w_K1 is
  the fraction of a column along K1, from its first feasible point to its last (`columns`). A parameter in a linear
  constraint is linear in its unit (`linear`); all others are w = x.

An equality, as of the shares of a mixture, determines a dependent parameter. Its coordinate of the box has no
influence: `completed` computes it from the others, so that searches have one dimension less. In the unit cube, where
kernels measure distances, all parameters count alike, whichever is the dependent one.

Without constraints the polytope is the whole cube. With mechanics, a constraint on K1 bounds its column instead. Whole
numbers and levels are discrete coordinates: a search changes the others, then tries `neighbours`.

Uniform points of the feasible set are transformed uniform numbers: by the widths of the columns with mechanics, by
rejection or by hit and run between the walls of constraints.
"""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Real

from hilbo.errors import InputError
from hilbo.numerics.host import floating, namespace_of, to_device
from hilbo.numerics.polytope import Polytope
from hilbo.search import linear
from hilbo.search.box import Box, Constraint, Mechanics, Parameter
from hilbo.search.columns import Columns, check_volume, volume
from hilbo.search.drawing import box_points, feasible_points, joined, take_feasible, unit_points
from hilbo.search.equality import scale_of, solved, with_dependent
from hilbo.search.feasibility import K0_of, allowed, balanced, keeps, minimum_damping, passive
from hilbo.search.space_filling import HELD, latin_chunks, sobol_chunks, spread_out, take, wall_chunks
from hilbo.search.steps import neighbours, steps_of

__all__ = ["Bound", "SearchSpace", "share_of_cube"]

Bound = Literal["constraint", "passive boundary", "effective damping"]
"""Boundary of the feasible set, within the ranges, that a point may violate."""

_ROOMY, _PILOT = 0.02, 4096  # share of the cube, of so many points, from which constrained points are drawn in it
_CLUSTERED = 200  # points for each of a space-filling design between walls


class SearchSpace(eqx.Module):
    """Named parameters; with `mechanics` the passive part of their box, with `constraints` what they leave.

    With mechanics the parameters must include K1 (N/mm), B1 (N·s^α/mm) and alpha, in any order. Raises InputError if no
    column (B1, alpha) has a passive K1, or if the constraints leave nothing. So do methods for points with another
    number of coordinates.
    """

    parameters: tuple[Parameter, ...] = eqx.field(static=True)
    mechanics: Mechanics | None = eqx.field(static=True, default=None)
    constraints: tuple[Constraint, ...] = eqx.field(static=True, default=())

    def __check_init__(self):
        Box(self.parameters, self.mechanics, self.constraints)  # refuses invalid bounds
        if self.mechanics is not None:
            check_volume(self._passive)
        if self.constraints:
            linear.check_room(self.parameters, self.constraints)
            if self.mechanics is not None or any(self.discrete):
                self.candidates(1, 0)  # or reports an empty space

    @property
    def dim(self) -> int:
        """Number of parameters."""
        return len(self.parameters)

    @property
    def names(self) -> tuple[str, ...]:
        """Names in the order of the coordinates."""
        return tuple(parameter.name for parameter in self.parameters)

    @property
    def discrete(self) -> tuple[bool, ...]:
        """Mask of the discrete parameters: whole numbers and levels."""
        return tuple(parameter.discrete for parameter in self.parameters)

    @property
    def dependent(self) -> tuple[int, ...]:
        """Indices of the parameters that equalities determine from the others."""
        return self.determined() or ()

    def determined(self, kept: tuple[int, ...] = ()) -> tuple[int, ...] | None:
        """Indices of the parameters that `completed` computes; None if the `kept` ones leave nothing to compute."""
        if not any(constraint.equality for constraint in self.constraints):
            return ()
        equalities = solved(self.parameters, self.constraints, kept)
        return None if equalities is None else equalities.dependent

    @property
    def free(self) -> tuple[int, ...]:
        """Indices of the parameters that no equality determines; they span slices and figures."""
        return tuple(i for i in range(self.dim) if i not in self.dependent)

    @property
    def even(self) -> bool:
        """Whether all parameters are continuous and there are no constraints; mechanics are allowed."""
        return not self.constraints and not any(self.discrete)

    @property
    def searched(self) -> dict[str, Any]:
        """Keyword arguments of `acquisition.maximise` that describe this space: coordinate maps, `feasible`, and walls.

        Walls, discrete coordinates and their neighbours only where the space is not `even`, dependent coordinates only
        with equalities.
        """
        functions = {"from_box": self.from_box, "to_box": self.to_box, "feasible": self.feasible}
        if self.even:
            return functions
        walls, coupled = self._walls, bool(self.constraints)
        between = Polytope(jnp.asarray(walls.normals), jnp.asarray(walls.offsets))
        dependent = [i in self.dependent for i in range(self.dim)]
        if any(dependent):
            functions["dependent"] = jnp.asarray(dependent)
        return functions | {
            "walls": between,
            "held": jnp.asarray(self.discrete) | jnp.asarray(dependent),
            "neighbours": functools.partial(neighbours, self.parameters, coupled) if any(self.discrete) else None,
        }

    @property
    def columns(self) -> Columns | None:
        """Columns along K1, with the constraints that involve K1; None without mechanics."""
        if self.mechanics is None:
            return None
        on_K1 = (c for c in self.constraints if any(name == "K1" and weight for name, weight in c.terms))
        return Columns(self.parameters, self.mechanics, tuple(on_K1))

    @property
    def _drawn(self) -> Columns | None:
        """Columns from which uniform points are drawn (`Columns.drawn`); None without mechanics."""
        return None if self.columns is None else self.columns.drawn

    @property
    def _passive(self) -> Columns:
        """Columns along K1 without regard to the constraints."""
        assert self.mechanics is not None
        return Columns(self.parameters, self.mechanics)

    @property
    def _walls(self) -> linear.Walls:
        """Walls of the constraints in box coordinates; with mechanics, those on K1 bound its column instead."""
        return linear.rows_of(self.parameters, self.constraints, None if self.mechanics is None else "K1")

    @property
    def _linear(self) -> tuple[bool, ...]:
        """Mask of the parameters that are linear in the box, for a constraint, but logarithmic in the unit cube."""
        named = {name for constraint in self.constraints for name, weight in constraint.terms if weight}
        named -= set() if self.mechanics is None else {"K1"}
        return tuple(p.name in named and p.scale == "log" for p in self.parameters)

    def _check_axis(self, points: Any) -> None:
        """Raise `InputError` unless the last axis of the points has one coordinate per parameter.

        JAX would silently accept another number.
        """
        shape = np.shape(points)
        if not shape or shape[-1] != self.dim:
            raise InputError(
                f"SearchSpace: points have the shape {shape}; the last axis must have {self.dim} numbers, of"
                f" {', '.join(self.names)}."
            )

    def to_unit(self, physical: Real[ArrayLike, "*batch d"]) -> Float[Array, "*batch d"]:
        """Physical values to the unit cube, last axis = parameter; exact at both ends.

        (..., d) -> (..., d); each parameter in its own unit.
        """
        self._check_axis(physical)
        physical = _on_device(physical)
        return jnp.stack([p.to_unit(physical[..., i]) for i, p in enumerate(self.parameters)], axis=-1)

    def to_physical(self, unit: Real[ArrayLike, "*batch d"]) -> Float[Array, "*batch d"]:
        """Unit cube to physical values, last axis = parameter; exact at both ends, and never outside them.

        (..., d) -> (..., d); each parameter in its own unit. Discrete parameters are rounded to the nearest value.
        """
        self._check_axis(unit)
        points = floating(unit)
        xp = namespace_of(points)
        return to_device(xp.stack([p.to_physical(points[..., i]) for i, p in enumerate(self.parameters)], axis=-1))

    def from_box(self, w: Real[ArrayLike, "*batch d"]) -> Float[Array, "*batch d"]:
        """Optimiser's coordinates in [0, 1]^d to the unit cube; differentiable.

        With mechanics K1 is mapped to its feasible column; in one without a feasible point x_K1 is 0. Other
        inequalities are not enforced, and a dependent coordinate may lie outside [0, 1]: ask `feasible`.
        (..., d) -> (..., d). Raises `InputError` for another number of coordinates.
        """
        self._check_axis(w)
        w = _on_device(w)
        for i, (p, linear_in_box) in enumerate(zip(self.parameters, self._linear, strict=True)):
            w = w.at[..., i].set(p.to_unit(p.low + (p.high - p.low) * w[..., i])) if linear_in_box else w
        if self.dependent:
            return self.completed(w)
        return w if self.columns is None else self.columns.from_shares(w)

    def to_box(self, x: Real[ArrayLike, "*batch d"]) -> Float[Array, "*batch d"]:
        """Inverse of `from_box`, for `x` in the feasible set. (..., d) -> (..., d).

        In a column without a feasible point the coordinate of K1 is not finite.
        """
        self._check_axis(x)
        x = _on_device(x)
        w = x
        for i, (p, linear_in_box) in enumerate(zip(self.parameters, self._linear, strict=True)):
            w = w.at[..., i].set((p.to_physical(x[..., i]) - p.low) / (p.high - p.low)) if linear_in_box else w
        return w if self.columns is None else self.columns.to_shares(w, x)

    def completed(self, x: Real[ArrayLike, "*batch d"], kept: tuple[int, ...] = ()) -> Float[Array, "*batch d"]:
        """Points of the unit cube with the dependent parameters computed from the others; `x` without equalities.

        `kept`: indices of parameters that stay as they are, so that others are the dependent ones; `x` itself if that
        is not possible. (..., d) -> (..., d). A dependent parameter may come out beyond its range; differentiable.
        """
        equalities, points = solved(self.parameters, self.constraints, kept), floating(x)
        if equalities is None:
            return to_device(points)
        self._check_axis(points)
        return to_device(with_dependent(self.parameters, equalities, points))

    def feasible(self, x: Real[ArrayLike, "*batch d"]) -> Bool[Array, "*batch"]:
        """Whether points of the unit cube are in it, passive with the search margin, and within all constraints.

        The range of effective damping counts too. Discrete parameters are rounded first. (..., d) -> (...,).
        """
        self._check_axis(x)
        plain = self.mechanics is None and not self.constraints
        points = floating(x) if plain else _on_device(x)
        inside = namespace_of(points).all((points >= 0) & (points <= 1), axis=-1)
        if plain:
            return to_device(inside)
        physical = self.to_physical(points)
        if self.mechanics is not None:
            inside &= allowed(self.mechanics, self._split(physical))
        for constraint in self.constraints:
            inside &= self._keeps(constraint, self._split(physical))
        return inside

    def broken(self, x: Real[ArrayLike, " d"]) -> Bound | None:
        """Boundary that a point (d,) of the unit cube violates; None if it violates none.

        Constraints are reported first, then passivity, then effective damping. The ends of the ranges are not checked,
        but for dependent parameters, where they count as the constraint.
        """
        points, dependent = _on_device(x), [i for c in self.constraints if c.equality for i in self._of(c)]
        beyond = any(not 0 <= float(points[i]) <= 1 for i in dependent)
        physical = self._split(self.to_physical(points))
        if beyond or not all(self._keeps(constraint, physical) for constraint in self.constraints):
            return "constraint"
        if self.mechanics is None or allowed(self.mechanics, physical):
            return None
        return "effective damping" if passive(self.mechanics, physical) else "passive boundary"

    def derived(self, physical: Mapping[str, Real[ArrayLike, "..."]]) -> dict[str, Float[Array, "..."]]:
        """Derived parameters: K0 (N/mm) with mechanics, none without.

        `physical`: parameter -> values in its unit, of one shape; the results have that shape.
        """
        return {} if self.mechanics is None else {"K0": K0_of(self.mechanics, physical)}

    def passivity_margin(self, physical: Mapping[str, Real[ArrayLike, "..."]]) -> Float[Array, "..."] | None:
        """Passivity margin: damping of the device minus the smallest passive damping, N·s/m; None without mechanics.

        `physical`: parameter -> values in its unit, of one shape; so is the result.
        """
        return None if self.mechanics is None else self.mechanics.damping - minimum_damping(self.mechanics, physical)

    def volume(self) -> float:
        """Passive fraction of the unit cube: the mean width of its columns, on a grid; 1 without mechanics.

        The range of effective damping counts too, constraints do not.
        """
        return 1.0 if self.mechanics is None else volume(self._passive)

    def without_delay(self) -> "SearchSpace":
        """The same space with a delay of 0; the space itself if it has none."""
        if self.mechanics is None or not self.mechanics.delay:
            return self
        return dataclasses.replace(self, mechanics=dataclasses.replace(self.mechanics, delay=0.0))

    def candidates(self, m: int, seed: int) -> Float[np.ndarray, "m d"]:
        """`m` points of the unit cube, uniform over the feasible set with low discrepancy (scrambled Sobol').

        -> (m, d), the same for the same seed. In a very small set between constraints they are random (hit and run).
        Raises `InputError` if too few points are feasible.
        """
        if self.constraints and self.mechanics is None:
            return _take_between(self, m, seed)
        return take_feasible(self, m, sobol_chunks(self.dim, m, seed), self._drawn)

    def walls(self, m: int, seed: int) -> Float[np.ndarray, "m d"]:
        """`m` points on the boundary of the feasible set (walls, edges, corners), including the passivity boundary.

        -> (m, d), in the unit cube. Raises `InputError` if too few points are feasible.
        """
        if self.constraints and self.mechanics is None:
            return self._on_walls(m, seed)
        count = 2 ** max(m - 1, 0).bit_length()
        chunks, held = sobol_chunks(self.dim, count, seed), wall_chunks(self.dim, count, seed)
        return take_feasible(self, m, chunks, self.columns, held)

    def latin_hypercube(self, n: int, seed: int) -> Float[np.ndarray, "n d"]:
        """`n` feasible points of the unit cube: a Latin hypercube in the coordinates in which the set is uniform.

        Points that fall outside the feasible set (a few, at the foot of infeasible columns) are replaced from further
        hypercubes, at the price of the even spread. With constraints they are no hypercube, but the points nearest to
        the centres of `n` clusters of many. -> (n, d). Raises `InputError` if too few points are feasible.
        """
        if self.constraints and n:
            return spread_out(self.candidates(_CLUSTERED * n, seed), n, seed)
        return take_feasible(self, n, latin_chunks(self.dim, n, seed), self._drawn)

    def _on_walls(self, m: int, seed: int) -> Float[np.ndarray, "m d"]:
        """Points (m, d) on the walls of the constraints and of the cube, for a space without mechanics.

        If rounding makes such a point infeasible, the interior point it was found from takes its place.
        """
        starts, free = self.candidates(m, seed + 1), ~np.array(self.discrete)
        free[list(self.dependent)] = False
        ends = linear.ends_of_rays(self._walls, np.asarray(box_points(self, starts)), free, seed, HELD)
        x, feasible = unit_points(self, ends)
        return np.where(np.asarray(feasible)[:, None], np.asarray(x), starts)

    def _keeps(self, constraint: Constraint, physical: Mapping[str, Float[Array, "*batch"]]) -> Bool[Array, "*batch"]:
        """Whether parameter sets satisfy a constraint. `physical`: parameter -> values in its unit, (...,) each."""
        if not constraint.equality:
            return keeps(constraint, physical)
        return balanced(constraint, scale_of(constraint, self.parameters), physical)

    def _of(self, constraint: Constraint) -> list[int]:
        """Indices of the parameters in a constraint."""
        return [self.names.index(name) for name, weight in constraint.terms if weight]

    def _split(self, physical: Float[Array, "*batch d"]) -> dict[str, Float[Array, "*batch"]]:
        """Coordinates by parameter name, each (...,)."""
        return {name: physical[..., i] for i, name in enumerate(self.names)}


def _on_device(x: Real[ArrayLike, "..."]) -> Float[Array, "..."]:
    """The values as a JAX array of floating-point numbers."""
    return to_device(x, jnp.result_type(1.0, x))


@functools.lru_cache(maxsize=16)
def share_of_cube(space: SearchSpace) -> float:
    """Feasible fraction of the unit cube of the free parameters, estimated from 4096 points; cached."""
    points = next(sobol_chunks(space.dim, _PILOT, 0))
    return float(np.asarray(feasible_points(space, space.completed(steps_of(space.parameters, points)))).mean())


def _take_between(space: SearchSpace, count: int, seed: int) -> Float[np.ndarray, "count d"]:
    """Draw `count` uniform feasible points of the unit cube, with constraints and without mechanics.

    By rejection, or by hit and run if less than 2 % of the cube is feasible. Raises `InputError` for too few.
    """
    chunks = sobol_chunks(space.dim, count, seed)
    if share_of_cube(space) < _ROOMY:
        chunks = (np.asarray(unit_points(space, w)[0]) for w in linear.inside(space._walls, count, seed))

    def place(uniform):
        x = np.asarray(space.completed(steps_of(space.parameters, uniform)))
        return x, np.asarray(feasible_points(space, x))

    return joined(space, count, *take(count, chunks, place))
