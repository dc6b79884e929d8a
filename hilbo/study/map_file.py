"""map.nc: the population map on a grid, written with a digest of its numbers and read back checked."""

import hashlib
import json
import os
import warnings
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import xarray as xr

from hilbo.errors import InputError
from hilbo.study.config import Study

__all__ = ["read_map", "write_map"]

_LARGEST = 10_000_000  # numbers in a variable: a damaged size is not to ask for all the memory
_FARTHEST = 100.0  # prior standard deviations from 0 that a map's mean may be
_WIDEST = 10.0  # prior variances that a map's variance may be


def write_map(grid: xr.Dataset, path: str | os.PathLike) -> None:
    """Write a map with the digest of its content."""
    grid.assign_attrs(digest=_digest(grid)).to_netcdf(path, engine="h5netcdf")


def read_map(path: str | os.PathLike, study: Study) -> xr.Dataset:
    """A map over all parameters of a study, its numbers checked. Raises InputError."""
    try:
        Path(path).open("rb").close()
    except OSError as error:
        raise InputError(f"{path}: is no map that can be read ({error.strerror}); check the path.") from error
    try:
        grid = _loaded(path)
        changed = "digest" in grid.attrs and grid.attrs["digest"] != _digest(grid)
        mean, variance = (np.asarray(grid[name].values, float) for name in ("mean", "variance"))
        axes = {name: np.asarray(grid[name].values, float) for name in study.space.names if name in grid.coords}
    except Exception as error:  # a damaged file makes the HDF5 library raise nearly everything
        raise InputError(
            f"{path}: is no map that can be read ({_words(error)}); give a results folder's map.nc."
        ) from error
    if changed:
        raise InputError(
            f"{path}: has been changed since hilbo wrote it (its digest does not fit); restore it from a copy, or"
            " aggregate the answers again."
        )
    _check_grid(path, study, axes, mean.shape, grid["mean"].dims, grid["variance"].dims)
    _check_numbers(path, study, mean, variance)
    return grid


def _loaded(path: str | os.PathLike) -> xr.Dataset:
    import h5py

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with h5py.File(path, "r", track_order=True) as whole:  # as h5netcdf, which prints a traceback where it cannot
            for _ in (*whole.attrs.items(), *whole["/"]):
                pass
        with xr.open_dataset(path, engine="h5netcdf") as opened:
            for name, variable in opened.variables.items():
                if variable.size > _LARGEST:
                    raise ValueError(f"{name} would hold {variable.size} numbers")
            return opened.load()


def _digest(grid: xr.Dataset) -> str:
    """Of names, dimensions, numbers, units and attributes; the same before and after a file."""
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
    if len(shape) < study.space.dim:
        raise InputError(f"{path}: is a slice of a map of more dimensions; a warm start needs all of them.")
    whole = all(d == study.space.names for d in dims) and all(size > 1 for size in shape)
    for parameter, size in zip(study.space.parameters, shape, strict=False):
        wanted = np.asarray(parameter.to_physical(jnp.linspace(0.0, 1.0, size)))
        here = axes.get(parameter.name)
        whole = whole and here is not None and here.shape == wanted.shape and np.allclose(here, wanted, rtol=1e-6)
    if not whole:
        raise InputError(f"{path}: is a map of other parameters or ranges; give one of this study.")


def _check_numbers(path, study, mean, variance) -> None:
    prior = float(study.gp.kernel.variance)
    if not (np.isfinite(mean).all() and np.abs(mean).max() <= _FARTHEST * np.sqrt(prior)):
        raise InputError(f"{path}: the map's mean is no number, or far beyond the prior; aggregate the answers again.")
    if not (np.isfinite(variance).all() and variance.min() > 0 and variance.max() <= _WIDEST * prior):
        raise InputError(
            f"{path}: the map's variance is not above 0, or far beyond the prior's; aggregate the answers again."
        )


def _words(error: Exception) -> str:
    """An error's text in one line."""
    return " ".join(str(error).split())[:200] or type(error).__name__
