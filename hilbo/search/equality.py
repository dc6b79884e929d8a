"""Linear equalities between parameters, as of the shares of a mixture: each determines one parameter from the others.

A parameter's *share* of its range runs linearly in its unit from 0 at the low end to 1 at the high one. The shares of
the dependent parameters are an affine function of the others, by Gaussian elimination with complete pivoting: of each
equality the parameter with the largest weight times range is the dependent one, of equal ones the last.
"""

import functools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from hilbo.errors import InputError
from hilbo.numerics.host import namespace_of, stopped
from hilbo.search.box import Constraint, Parameter

__all__ = ["Solved", "check_equalities", "scale_of", "solved", "unbalanced", "with_dependent"]

_NOTHING = 1e-9  # a pivot, of a row of length 1: below it the row depends on the earlier ones
_TIE = 1e-12
_SNAP = 64  # units of eps: so near to an end of its range a dependent parameter is at the end
_WRITTEN = 2e-3  # of the sum of the absolute terms: rounding of the cells of a table


_Array = Float[Any, "..."]


class Solved(NamedTuple):
    """Shares of the `dependent` parameters (indices) = `matrix` (k, d) @ shares (d,) + `constant` (k,); the columns of
    the dependent ones are 0."""

    dependent: tuple[int, ...]
    matrix: Float[np.ndarray, "k d"]
    constant: Float[np.ndarray, " k"]


@functools.lru_cache(maxsize=256)
def solved(
    parameters: tuple[Parameter, ...], constraints: tuple[Constraint, ...], kept: tuple[int, ...] = ()
) -> Solved | None:
    """The dependent parameters of the equalities among `constraints`; None if there are no equalities.

    `kept`: indices of parameters that must not be dependent. Whole numbers never are. None, too, if the equalities have
    no solution of this kind; `check_equalities` has excluded that for up to one kept parameter.
    """
    rows, ends = _rows(parameters, constraints)
    usable = np.array([not p.discrete and i not in kept for i, p in enumerate(parameters)])
    dependent: list[int] = []
    for k in range(len(rows)):
        left = np.where(usable, np.abs(rows[k:]), 0.0)
        if left.max() <= _NOTHING:
            return None
        row, column = max(np.argwhere(left >= left.max() - _TIE), key=lambda place: (place[1], -place[0]))
        rows[[k, k + row]], ends[[k, k + row]] = rows[[k + row, k]], ends[[k + row, k]]
        ends[k], rows[k] = ends[k] / rows[k, column], rows[k] / rows[k, column]
        for other in range(len(rows)):
            if other != k:
                ends[other] -= rows[other, column] * ends[k]
                rows[other] -= rows[other, column] * rows[k]
        usable[column] = False
        dependent.append(int(column))
    if not dependent:
        return None
    rows[:, dependent] = 0.0
    return Solved(tuple(dependent), -rows + 0.0, ends)


def check_equalities(parameters: tuple[Parameter, ...], constraints: tuple[Constraint, ...]) -> None:
    """Raise `InputError` for an equality that depends on earlier ones, or that has fewer than two continuous parameters
    which are free to change together."""
    rows, _ = _rows(parameters, constraints)
    numbers = [number for number, constraint in enumerate(constraints, 1) if constraint.equality]
    for k, number in enumerate(numbers):
        if np.linalg.matrix_rank(rows[: k + 1], tol=_NOTHING) <= k:
            raise InputError(
                f"constraints.{number} follows from the earlier equalities, or contradicts them; leave it out."
            )
    for i, parameter in enumerate(parameters):
        concerned = [number for k, number in enumerate(numbers) if rows[k, i]]
        if concerned and solved(parameters, constraints, (i,)) is None:
            raise InputError(
                f"constraints.{concerned[-1]} leaves {parameter.name} no freedom: an equality needs two continuous"
                " parameters or more that no other equality fixes; leave one of them out of the study."
            )


def scale_of(constraint: Constraint, parameters: Sequence[Parameter]) -> float:
    """Largest sum of the absolute terms of a constraint within the ranges."""
    weights = dict(constraint.terms)
    return sum(abs(weights.get(p.name, 0.0)) * max(abs(p.low), abs(p.high)) for p in parameters)


def with_dependent(parameters: Sequence[Parameter], equalities: Solved, x: _Array) -> _Array:
    """Points (..., d) of the unit cube with the dependent parameters computed from the others; of NumPy for NumPy."""
    columns = [x[..., i] for i in range(len(parameters))]
    for i, weights, constant in zip(*equalities, strict=True):
        share = float(constant) + sum(
            float(weights[j]) * _share(parameters[j], x[..., j]) for j in np.flatnonzero(weights).tolist()
        )
        columns[i] = _at_share(parameters[i], share)
    return namespace_of(x).stack(columns, axis=-1)


def _share(parameter: Parameter, x: _Array) -> _Array:
    """Share of a parameter's range at values of the unit cube (array)."""
    if parameter.scale == "linear" and not parameter.discrete:
        return x
    return (parameter.to_physical(x) - parameter.low) / (parameter.high - parameter.low)


def _at_share(parameter: Parameter, share: _Array) -> _Array:
    """Inverse of `_share` for a continuous parameter; at an end of the range within `_SNAP` of it.

    The slope is that without the snap, so that a search can leave the end.
    """
    xp = namespace_of(share)
    near, end = _SNAP * float(xp.finfo(share.dtype).eps), xp.where(share < 0.5, 0.0, 1.0).astype(share.dtype)
    gap = xp.where(xp.abs(share - end) <= near, end - share, xp.zeros_like(share))
    share = share + stopped(gap)
    if parameter.scale == "linear":
        return share
    return parameter.to_unit(parameter.low + (parameter.high - parameter.low) * share)


def unbalanced(
    constraint: Constraint, values: Mapping[str, Float[np.ndarray, " n"]], allowed: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Sums (n,) of an equality in rows of physical values, and which of them differ by more than the rounding of cells.

    `values`: parameter -> values (n,); `allowed` (n,): further difference that is allowed. Rounding: 0.2 % of the sum
    of the absolute terms.
    """
    parts = [weight * np.asarray(values[name], float) for name, weight in constraint.terms]
    total, size = sum(parts, np.zeros(len(allowed))), sum(map(np.abs, parts), np.zeros(len(allowed)))
    assert constraint.least is not None
    return total, np.abs(total - constraint.least) > _WRITTEN * size + allowed


def _rows(
    parameters: Sequence[Parameter], constraints: Sequence[Constraint]
) -> tuple[Float[np.ndarray, "k d"], Float[np.ndarray, " k"]]:
    """The equalities as equations of the shares (d,): rows (k, d), each of length 1, @ shares = ends (k,)."""
    names, low = [p.name for p in parameters], np.array([p.low for p in parameters])
    width = np.array([p.high for p in parameters]) - low
    rows, ends = [], []
    for constraint in constraints:
        if not constraint.equality:
            continue
        weights = np.zeros(len(names))
        for name, weight in constraint.terms:
            weights[names.index(name)] = weight
        assert constraint.least is not None
        size = np.linalg.norm(weights * width)
        rows.append(weights * width / size)
        ends.append((constraint.least - weights @ low) / size)
    return np.array(rows, float).reshape(-1, len(names)), np.array(ends, float)
