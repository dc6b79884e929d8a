"""What tables call their own columns: a parameter of that name would be taken for one, or overwrite it.

Of the tables, netCDF files and DataFrames that have a column for each parameter; tests/report/test_reserved_names.py
compares them. Loads no JAX.
"""

from collections.abc import Collection

from hilbo.study.file.columns import COLUMNS
from hilbo.study.file.trial_flags import COLUMN, COLUMN_OF_SAMPLES

__all__ = ["TRIAL_COLUMNS", "is_reserved"]

TRIAL_COLUMNS = (
    *("participant", "trial", "response", "category", "phase", "material", "voided", "unblinded"),
    *(COLUMN, COLUMN_OF_SAMPLES),
)
"""Those that the reader of answers knows."""

_RENDERED = frozenset(("K0", "N", "T", "memory", "states", "force_limit"))
"""Beside the parameters of a set that a device renders; without a renderer they are names as others."""
_OF_CSV = {
    name
    for table in ("trials", "sets", "optima", "alternatives", "comparison")
    for name in COLUMNS[table]
    if name not in _RENDERED
}
_OF_FILES = {
    "map.nc": ("mean", "variance", "feasible", "point"),
    "inference.nc": ("thresholds", "edge", "noise", "answer"),
    "predicted": ("mean", "sd"),
}
_EVERYWHERE = frozenset((*TRIAL_COLUMNS, *_OF_CSV, *(name for names in _OF_FILES.values() for name in names)))


def is_reserved(name: str, responses: Collection[str], rendered: bool) -> bool:
    """Whether no parameter of a study with these answers may be called so. `rendered`: by a [renderer]."""
    predicted = {f"P({label})" for label in responses}
    return name in _EVERYWHERE or name in predicted or (rendered and name in _RENDERED)
