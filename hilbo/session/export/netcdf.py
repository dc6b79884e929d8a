"""Session logs as a netCDF file of groups, for xarray and ArviZ; made from the logs alone."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import xarray as xr

from hilbo.session.export.tables import trials_table
from hilbo.session.log.state import LiveSession
from hilbo.study.file.reading import StudyFile
from hilbo.study.tables.flag_counts import flagged
from hilbo.study.tables.trials import is_fitted

__all__ = ["netcdf"]


def netcdf(sessions: Sequence[LiveSession], path: Path, study: StudyFile) -> bool:
    """Write the answers that are fitted (single renderings, without warm-up, repetitions, voided trials and excluded
    flags) as a netCDF file, for xarray (DataTree) and ArviZ (InferenceData). Return False, and write nothing, if there
    are none.

    Groups, along `obs_id`: observed_data has `category` (from 0), constant_data the parameters (levels by their names)
    and the columns that identify a trial, such as participant. Attributes name the study.
    """
    table = trials_table(sessions)
    if len(table):
        excluded = flagged(table, study.exclude_flags)
        table = table[(table["voided"] == 0) & is_fitted(table["phase"]) & ~excluded]
    if table.empty:
        return False
    rows = {"obs_id": np.arange(len(table))}
    ranks = {label: i for i, label in enumerate(study.responses)}
    observed = xr.Dataset({"category": ("obs_id", table["response"].map(ranks).to_numpy(int))}, rows)
    observed["category"].attrs["labels"] = list(study.responses)
    constant = xr.Dataset(coords=rows)
    for column in ("participant", "session", "phase", "material"):
        if column in table:
            constant[column] = ("obs_id", table[column].to_numpy(str).astype(object))
    constant["trial"] = ("obs_id", table["trial"].to_numpy(int))
    for parameter in study.space.parameters:
        values = table[parameter.name]
        if parameter.levels:
            constant[parameter.name] = ("obs_id", values.to_numpy(str).astype(object))
            constant[parameter.name].attrs["levels"] = list(parameter.levels)
        else:
            constant[parameter.name] = ("obs_id", values.to_numpy(float))
            constant[parameter.name].attrs["units"] = parameter.unit
    attributes = {"study": study.hash, "study_name": study.name, "made_by": "hilbo"}
    groups = {"observed_data": observed, "constant_data": constant}
    tree = xr.DataTree.from_dict({name: group.assign_attrs(attributes) for name, group in groups.items()})
    tree.to_netcdf(path, engine="h5netcdf")
    return True
