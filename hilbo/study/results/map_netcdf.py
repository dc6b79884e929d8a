"""map.nc: the population map on a grid or at points, written with a digest of its content and checked when read.

A grid if there are at most three parameters, all continuous, and no equality; otherwise points: feasible ones of low
discrepancy, a fifth of them on walls, edges and corners, each with its values in physical units and the map's mean and
variance there.
"""

import hashlib
import json
import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import xarray as xr
from jax.typing import ArrayLike
from jaxtyping import Float

from hilbo.errors import InputError
from hilbo.search.box import Parameter
from hilbo.search.candidates import search_points
from hilbo.search.space import SearchSpace
from hilbo.study.config import Study

__all__ = ["CELLS", "map_dataset", "on_grid", "read_map", "write_map"]

CELLS = 41
"""Points of the map's grid along each parameter."""

_BLOCK = 4096  # points that are predicted at a time
_LARGEST = 10_000_000  # numbers in a variable: a damaged size is not to ask for all the memory
_FARTHEST = 100.0  # prior standard deviations from 0 that a map's mean may be
_WIDEST = 10.0  # prior variances that a map's variance may be


def on_grid(space: SearchSpace) -> bool:
    """Whether maps of this space are stored on a grid (at most three parameters, all continuous and free), and not at
    points."""
    return space.dim <= 3 and not any(space.discrete) and not space.dependent


def map_dataset(study: Study, surface: Callable[..., Any], cells: int = CELLS) -> xr.Dataset:
    """The population map as a dataset, on a grid with `cells` points per parameter, or at points (`on_grid`).

    `surface`: function of points (m, d) of the unit cube that returns mean and variance, (m,) each. A grid also has
    infeasible points, marked by the variable `feasible`.
    """
    if not on_grid(study.space):
        return _map_at_points(study, surface)
    shown = parameters = study.space.parameters
    side = np.linspace(0.0, 1.0, cells)
    x = np.stack(np.meshgrid(*(side,) * len(shown), indexing="ij"), axis=-1)
    flat = x.reshape(-1, len(parameters))
    mean, variance = _in_blocks(surface, flat)
    names = [p.name for p in shown]
    shape = x.shape[:-1]
    return xr.Dataset(
        {
            "mean": (names, np.asarray(mean).reshape(shape), {"long_name": f"{study.file.attribute}, posterior mean"}),
            "variance": (
                names,
                np.asarray(variance).reshape(shape),
                {"long_name": f"{study.file.attribute}, posterior variance"},
            ),
            "feasible": (
                names,
                np.asarray(study.space.feasible(flat)).reshape(shape),
                {"long_name": "feasible"},
            ),
        },
        coords={p.name: (p.name, p.to_physical(side), {"units": p.unit}) for p in shown},
        attrs={"study": study.file.hash},
    )


def _in_blocks(
    surface: Callable[..., tuple[ArrayLike, ArrayLike]], x: Float[np.ndarray, "m d"]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Mean and variance (m,) of a map at many points, from blocks of one size: covariances with all points at once
    would take hundreds of megabytes. The last block is filled up with copies of the last point."""
    size = min(_BLOCK, len(x))
    blocks = np.pad(x, ((0, -len(x) % size), (0, 0)), mode="edge").reshape(-1, size, x.shape[1])
    means, variances = zip(*([np.asarray(moment) for moment in surface(block)] for block in blocks), strict=True)
    return np.concatenate(means)[: len(x)], np.concatenate(variances)[: len(x)]


def _map_at_points(study: Study, surface: Callable[..., Any], seed: int = 0) -> xr.Dataset:
    """The map at points that fill the feasible set, drawn by `seed`; levels by name. `surface`: as in `map_dataset`."""
    x = search_points(study.space, seed)
    mean, variance = (np.asarray(moment) for moment in surface(np.asarray(x)))
    physical = np.asarray(study.space.to_physical(x)).T.tolist()
    columns = {
        p.name: ("point", [p.shown(value) for value in values], {"units": p.unit})
        for p, values in zip(study.space.parameters, physical, strict=True)
    }
    words = f"{study.file.attribute}, posterior"
    return xr.Dataset(
        {
            "mean": ("point", mean, {"long_name": f"{words} mean"}),
            "variance": ("point", variance, {"long_name": f"{words} variance"}),
        },
        coords=columns,
        attrs={"study": study.file.hash},
    )


def write_map(grid: xr.Dataset, path: str | os.PathLike) -> None:
    """Write a map as netCDF, with the digest of its content as an attribute; an existing file is overwritten."""
    grid.assign_attrs(digest=_digest(grid)).to_netcdf(path, engine="h5netcdf")


def read_map(path: str | os.PathLike, study: Study) -> xr.Dataset:
    """Read a map of all parameters of this study, on a grid or at points; coordinates of points are physical numbers,
    levels by index.

    Raises InputError for an unreadable or changed file, another study's parameters or ranges, infeasible points, and
    implausible numbers.
    """
    try:
        Path(path).open("rb").close()
    except OSError as error:
        raise InputError(f"{path}: is no map that can be read ({error.strerror}); check the path.") from error
    try:
        grid = _loaded(path)
        changed = "digest" in grid.attrs and grid.attrs["digest"] != _digest(grid)
        mean, variance = (np.asarray(grid[name].values, float) for name in ("mean", "variance"))
        axes = {p.name: _numbers(p, grid[p.name].values) for p in study.space.parameters if p.name in grid.coords}
    except Exception as error:  # a damaged file makes the HDF5 library raise nearly everything
        raise InputError(
            f"{path}: is no map that can be read ({_words(error)}); give a results folder's map.nc."
        ) from error
    if changed:
        raise InputError(
            f"{path}: has been changed since hilbo wrote it (its digest does not fit); restore it from a copy, or"
            " aggregate the answers again."
        )
    check = _check_grid if on_grid(study.space) else _check_points
    check(path, study, axes, mean.shape, grid["mean"].dims, grid["variance"].dims)
    _check_numbers(path, study, mean, variance)
    return grid if on_grid(study.space) else grid.assign_coords({name: ("point", v) for name, v in axes.items()})


def _numbers(parameter: Parameter, values: np.ndarray) -> np.ndarray:
    """A coordinate as physical numbers, levels by index; NaN for values that are none."""
    return np.array([parameter.number(value) for value in values.tolist()], float)


def _loaded(path: str | os.PathLike) -> xr.Dataset:
    """Load a netCDF file into memory. Raises an exception of any type if it is damaged, and ValueError if a variable
    has more than 10 million entries."""
    import h5py

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with h5py.File(path, "r", track_order=True) as whole:  # as h5netcdf, which prints a traceback where it cannot
            for _ in (*whole.attrs.items(), *whole["/"]):
                pass
        with xr.open_dataset(path, engine="h5netcdf") as opened:
            for name, variable in opened.variables.items():
                if variable.size > _LARGEST:
                    raise ValueError(f"{name} would have {variable.size} numbers")
            return opened.load()


def _digest(grid: xr.Dataset) -> str:
    """First 16 hex digits of the SHA-256 of names, dimensions, numbers and attributes; the same before writing and
    after reading."""
    hashed = hashlib.sha256()
    for name in sorted(map(str, grid.variables)):
        variable = grid[name]
        values = np.asarray(variable.values)
        kept = values.tolist() if values.dtype.kind in "OUS" else np.asarray(values, float).tolist()
        attributes = {key: str(value) for key, value in variable.attrs.items()}
        hashed.update(json.dumps([name, variable.dims, kept, attributes], sort_keys=True, default=str).encode())
    attributes = {key: str(value) for key, value in grid.attrs.items() if key != "digest"}
    hashed.update(json.dumps(attributes, sort_keys=True).encode())
    return hashed.hexdigest()[:16]


def _check_grid(path, study, axes, shape, *dims) -> None:
    """Raise InputError unless the map is on a grid over the study's parameters and ranges.

    `axes`: parameter -> its coordinate in physical units; `shape`: of the mean; `dims`: dimension names of mean and
    variance.
    """
    if len(shape) < study.space.dim:
        raise InputError(f"{path}: is a slice of a map of more dimensions; a warm start needs all of them.")
    whole = all(d == study.space.names for d in dims) and all(size > 1 for size in shape)
    for parameter, size in zip(study.space.parameters, shape, strict=False):
        wanted = np.asarray(parameter.to_physical(jnp.linspace(0.0, 1.0, size)))
        here = axes.get(parameter.name)
        whole = whole and here is not None and here.shape == wanted.shape and np.allclose(here, wanted, rtol=1e-6)
    if not whole:
        raise InputError(f"{path}: is a map of other parameters or ranges; give one of this study.")


def _check_points(path, study, axes, shape, *dims) -> None:
    """Raise InputError unless the points of a map have all parameters of the study, within their ranges, and are
    feasible.

    `axes`: parameter -> its values in physical units; `shape`: of the mean; `dims`: dimension names of mean and
    variance.
    """
    whole = all(d == ("point",) for d in dims) and set(axes) == set(study.space.names)
    for p in study.space.parameters if whole else ():
        whole = whole and axes[p.name].shape == shape and all(p.holds(value) for value in axes[p.name].tolist())
    if not whole:
        raise InputError(f"{path}: is a map of other parameters or ranges; give one of this study.")
    values = np.stack([axes[name] for name in study.space.names], axis=-1)
    if not np.asarray(study.space.feasible(study.space.to_unit(values))).all():
        raise InputError(f"{path}: has points that may not be rendered in this study; aggregate the answers again.")


def _check_numbers(path, study, mean, variance) -> None:
    """Raise InputError for means and variances (arrays of any shape) that are not finite, or implausible under the
    study's prior."""
    prior = float(study.gp.kernel.variance)
    if not (np.isfinite(mean).all() and np.abs(mean).max() <= _FARTHEST * np.sqrt(prior)):
        raise InputError(f"{path}: the map's mean is no number, or far beyond the prior; aggregate the answers again.")
    if not (np.isfinite(variance).all() and variance.min() > 0 and variance.max() <= _WIDEST * prior):
        raise InputError(
            f"{path}: the map's variance is not above 0, or far beyond the prior's; aggregate the answers again."
        )


def _words(error: Exception) -> str:
    """An error's text in one line of at most 200 characters; the name of its type if it has none."""
    return " ".join(str(error).split())[:200] or type(error).__name__
