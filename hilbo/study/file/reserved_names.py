"""Column names that tables use themselves; no parameter may have one, because it would be confused with it or overwrite
it.

Covers the tables, netCDF files and DataFrames that have a column for each parameter;
tests/report/test_reserved_names.py compares them. Loads no JAX.
"""

from collections.abc import Collection

from hilbo.study.file.columns import COLUMNS
from hilbo.study.file.trial_flags import COLUMN, COLUMN_OF_SAMPLES

__all__ = ["TRIAL_COLUMNS", "is_reserved"]

TRIAL_COLUMNS = (
    *("participant", "trial", "response", "category", "phase", "material", "voided", "unblinded"),
    *(COLUMN, COLUMN_OF_SAMPLES),
)
"""Columns that the reader of trial tables knows."""

_RENDERED = frozenset(("K0", "N", "T", "memory", "states", "force_limit"))
"""Further columns of a set that a device renders; without a renderer they are not reserved."""
_OF_CSV = {
    name
    for table in ("trials", "sets", "optima", "alternatives", "comparison")
    for name in COLUMNS[table]
    if name not in _RENDERED
}
_OF_FILES = {
    "map.nc": ("mean", "variance", "feasible", "point"),
    "inference.nc": ("thresholds", "edge", "noise", "answer", "obs_id"),
    "predicted": ("mean", "sd"),
}
_EVERYWHERE = frozenset((*TRIAL_COLUMNS, *_OF_CSV, *(name for names in _OF_FILES.values() for name in names)))


def is_reserved(name: str, responses: Collection[str], rendered: bool) -> bool:
    """Whether a parameter may not have exactly this name: that of a column of hilbo's tables or results, "P(LABEL)" of
    one of these response labels, or, if the study has a [renderer] (`rendered`), K0, N, T, memory, states or
    force_limit."""
    predicted = {f"P({label})" for label in responses}
    return name in _EVERYWHERE or name in predicted or (rendered and name in _RENDERED)
