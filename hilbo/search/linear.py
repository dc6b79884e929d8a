"""Linear constraints between parameters: a polytope in the optimiser's coordinates, and points in it and on its walls.

NumPy numbers, computed once for a space. A constraint is linear in physical units, so that a parameter on a logarithmic
scale that is in one is searched in its unit, from 0 at its low end to 1 at its high one. A wall is `MARGIN` of the
ranges inside the specified inequality, so that rounding does not move a choice beyond it.

An equality determines a dependent parameter (`equality`), which is eliminated from all walls: its column is 0, and its
range becomes two walls, without a margin.

If few points of the cube are feasible, others are found by hit and run (Smith 1984, Oper. Res. 32:1296): many chains,
which all start at the centre of the largest inscribed ball.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from hilbo.errors import InputError
from hilbo.search.box import Constraint, Parameter
from hilbo.search.equality import Solved, check_equalities, solved

__all__ = ["MARGIN", "Walls", "check_room", "ends_of_rays", "inside", "rows_of"]

MARGIN = 1e-9
"""Distance of the search's walls inside the specified inequalities, as a fraction of the ranges."""
_FLAT = 1e-12  # length of a normal after the elimination, of 1 before: no influence
_LEAST = 1e-6  # radius of the largest ball, in units of the ranges: less is no volume
_CHAINS, _BURN_IN, _APART = 512, 200, 20  # steps of hit and run


class Walls(NamedTuple):
    """Polytope of the points w (d,) with `normals` (k, d) w <= `offsets` (k,), normals of length 1.

    `source`: number of the constraint of each wall, from 1; 0 for the range of a dependent parameter.
    """

    normals: Float[np.ndarray, "k d"]
    offsets: Float[np.ndarray, " k"]
    source: tuple[int, ...]


def rows_of(parameters: Sequence[Parameter], constraints: Sequence[Constraint], without: str | None = None) -> Walls:
    """Constraints as walls in coordinates that run linearly from 0 to 1 over each range, `MARGIN` inside.

    One wall for each `least` and each `most` of an inequality, and two for each parameter that an equality determines;
    constraints that involve the parameter `without` are left out.
    """
    names, low = [p.name for p in parameters], np.array([p.low for p in parameters])
    width = np.array([p.high for p in parameters]) - low
    normals, offsets, source = [], [], []
    for number, constraint in enumerate(constraints, 1):
        weights = np.zeros(len(names))
        for name, weight in constraint.terms:
            weights[names.index(name)] = weight
        if constraint.equality or (without is not None and weights[names.index(without)]):
            continue
        size = np.linalg.norm(weights * width)
        for side, end in ((1.0, constraint.most), (-1.0, constraint.least)):
            if end is not None:
                normals.append(side * weights * width / size)
                offsets.append(side * (end - weights @ low) / size - MARGIN)
                source.append(number)
    walls = Walls(np.array(normals).reshape(-1, len(names)), np.array(offsets), tuple(source))
    equalities = solved(tuple(parameters), tuple(constraints))
    return walls if equalities is None else _eliminated(walls, equalities)


def _eliminated(walls: Walls, equalities: Solved) -> Walls:
    """Walls without the dependent parameters, and those of their ranges.

    A wall on which the others have no influence is left out if it is kept; else its normal is 0, and no point keeps it.
    """
    at = list(equalities.dependent)
    normals = walls.normals + walls.normals[:, at] @ equalities.matrix
    normals[:, at] = 0.0
    normals = np.concatenate([normals, equalities.matrix, -equalities.matrix])
    offsets = walls.offsets - walls.normals[:, at] @ equalities.constant
    offsets = np.concatenate([offsets, 1.0 - equalities.constant, equalities.constant])
    source, sizes = np.array([*walls.source, *[0] * (2 * len(at))]), np.linalg.norm(normals, axis=1)
    flat = sizes <= _FLAT
    normals = np.where(flat[:, None], 0.0, normals / np.where(flat, 1.0, sizes)[:, None])
    offsets = offsets / np.where(flat, 1.0, sizes)
    left = ~flat | (offsets < 0)
    return Walls(normals[left], offsets[left], tuple(source[left].tolist()))


def check_room(parameters: Sequence[Parameter], constraints: Sequence[Constraint]) -> None:
    """Raise `InputError` for equalities that leave no freedom (`check_equalities`), and for constraints that leave no
    volume of the ranges, alone, in pairs or together."""
    check_equalities(tuple(parameters), tuple(constraints))
    if _radius(rows_of(parameters, constraints))[0] > _LEAST:
        return
    numbers = range(1, len(constraints) + 1)
    for number in numbers:
        radius, _ = _radius(rows_of(parameters, [constraints[number - 1]]))
        if abs(radius) <= _LEAST:
            raise InputError(
                f"constraints.{number} leaves no more than an edge of the ranges; narrow the range of one of its"
                " parameters instead."
            )
        if radius < _LEAST:
            raise InputError(f"constraints.{number} leaves nothing of the ranges; change its least or most.")
    for a in numbers:
        for b in range(a + 1, len(constraints) + 1):
            if _radius(rows_of(parameters, [constraints[a - 1], constraints[b - 1]]))[0] <= _LEAST:
                raise InputError(
                    f"constraints.{b} contradicts the {_ordinal(a)} within the ranges: together they leave nothing."
                )
    raise InputError("constraints leave nothing of the ranges, all together; change one of them.")


def _ordinal(number: int) -> str:
    """Ordinal number in words up to "third"; for other numbers such as "4th"."""
    return {1: "first", 2: "second", 3: "third"}.get(number, f"{number}th")


def _radius(walls: Walls) -> tuple[float, Float[np.ndarray, " d"]]:
    """Radius and centre (d,) of the largest ball between the walls within the cube.

    The radius is below 0 if no point is between them.
    """
    from scipy.optimize import linprog  # slow to import, and only studies with constraints need it

    normals, offsets = _with_cube(walls)
    goal = np.append(np.zeros(normals.shape[1]), -1.0)
    rows = np.column_stack([normals, np.linalg.norm(normals, axis=1)])
    solution = linprog(goal, A_ub=rows, b_ub=offsets, bounds=[(0, 1)] * normals.shape[1] + [(None, None)])
    return (float(solution.x[-1]), solution.x[:-1]) if solution.success else (-1.0, goal[:-1])


def _with_cube(walls: Walls) -> tuple[Float[np.ndarray, "r d"], Float[np.ndarray, " r"]]:
    """Normals and offsets of the walls and of the unit cube."""
    d = walls.normals.shape[1]
    return (
        np.concatenate([walls.normals, np.eye(d), -np.eye(d)]),
        np.concatenate([walls.offsets, np.ones(d), np.zeros(d)]),
    )


def inside(walls: Walls, count: int, seed: int) -> Iterator[Float[np.ndarray, "n d"]]:
    """Yield without end chunks of `count` points or more, uniform between the walls within the cube, by hit and run.

    There must be room (`check_room`).
    """
    rng, (_, middle) = np.random.default_rng(seed), _radius(walls)
    w = np.tile(middle, (_CHAINS, 1))
    for _ in range(_BURN_IN):
        w = _hit(walls, w, rng)
    while True:
        kept = []
        for _ in range(-(-count // _CHAINS)):
            for _ in range(_APART):
                w = _hit(walls, w, rng)
            kept.append(w)
        yield np.concatenate(kept)


def _hit(walls: Walls, w: Float[np.ndarray, "n d"], rng: np.random.Generator) -> Float[np.ndarray, "n d"]:
    """One step of hit and run: from each point to a uniform point on a random line through it, between the walls."""
    direction = rng.standard_normal(w.shape)
    ahead, behind = (_distance_to_wall(*_with_cube(walls), w, side * direction)[0] for side in (1.0, -1.0))
    return w + (rng.random(len(w)) * (ahead + behind) - behind)[:, None] * direction


def _distance_to_wall(normals, offsets, w, direction) -> tuple[Float[np.ndarray, " n"], np.ndarray]:
    """Distance from each point, in units of `direction`, to the first wall ahead, and that wall's row.

    Infinite, with row 0, if none is ahead.
    """
    speed, left = direction @ normals.T, np.maximum(offsets - w @ normals.T, 0.0)
    moving = speed > 1e-12
    lengths = np.where(moving, left / np.where(moving, speed, 1.0), np.inf)
    return lengths.min(axis=1), lengths.argmin(axis=1)


def ends_of_rays(
    walls: Walls, w: Float[np.ndarray, "n d"], free: Bool[np.ndarray, " d"], seed: int, shares: Sequence[float]
) -> Float[np.ndarray, "n d"]:
    """Points on the walls, the cube's faces among them: from each point along a random ray to a wall, then along that
    wall to the next, and so on.

    `shares`, which sum to 1: fractions of the points that stop after one wall, after two, and so on, at most at a
    corner. Coordinates that are not `free` stay fixed.
    """
    rng, (normals, offsets) = np.random.default_rng(seed), _with_cube(walls)
    d = int(free.sum())
    if d == 0:
        return w
    ends = np.minimum(np.searchsorted(np.cumsum(shares), rng.random(len(w))) + 1, d)
    ends = np.where(rng.random(len(w)) < 1 - sum(shares), d, ends)
    met = np.zeros((len(w), w.shape[1], w.shape[1]))  # the normals of walls that were met
    met[:] = np.diag(np.where(free, 0.0, 1.0))
    for turn in range(d):
        direction = rng.standard_normal(w.shape)
        direction -= np.einsum("nij,nj->ni", np.linalg.pinv(met, rcond=1e-9) @ met, direction)
        length, row = _distance_to_wall(normals, offsets, w, direction)
        going = (turn < ends) & np.isfinite(length) & (np.linalg.norm(direction, axis=1) > 1e-9)
        w = np.where(going[:, None], w + np.where(going, length, 0.0)[:, None] * direction, w)
        new = np.flatnonzero(going)
        met[new, np.flatnonzero(free)[turn]] = normals[row[new]]
    return np.clip(w, 0.0, 1.0)
