"""What tables call their own columns: a parameter of that name would be taken for one, or overwrite it.

Of the tables, netCDF files and DataFrames that have a column for each parameter; tests/report/test_reserved_names.py
holds them against these lists. Loads no JAX.
"""

from collections.abc import Collection

from hilbo.study.file.trial_flags import COLUMN, COLUMN_OF_SAMPLES

__all__ = ["TRIAL_COLUMNS", "is_reserved"]

TRIAL_COLUMNS = (
    *("participant", "trial", "response", "category", "phase", "material", "voided", "unblinded"),
    *(COLUMN, COLUMN_OF_SAMPLES),
)
"""Those that the reader of answers knows."""

_TABLES = {
    "trials.csv": (*TRIAL_COLUMNS, "session", "status", "response_time", "answered_at", "presentations", "proposed_at"),
    "sets.csv": ("set_id", "source", "role"),
    "optima.csv": ("source", "location"),
    "alternatives.csv": ("optimum", "mean", "sd", "p_top", "passivity_margin"),
    "comparison.csv": (
        *("rule", "method", "negative_log_density", "negative_log_density_error", "difference", "difference_error"),
        *("central_95", "central_95_error", "z2", "covered", "optimum_sd", "most_influential", "refused"),
    ),
    "map.nc": ("mean", "variance", "feasible", "point"),
    "inference.nc": ("thresholds", "edge", "noise", "answer"),
    "predicted": ("mean", "sd"),
}
_EVERYWHERE = frozenset(name for columns in _TABLES.values() for name in columns)
_RENDERED = frozenset(("K0", "N", "T", "memory", "states", "force_limit"))
"""Beside the parameters of a set that a device renders; without a renderer they are names as others."""


def is_reserved(name: str, responses: Collection[str], rendered: bool) -> bool:
    """Whether no parameter of a study with these answers may be called so. `rendered`: by a [renderer]."""
    predicted = {f"P({label})" for label in responses}
    return name in _EVERYWHERE or name in predicted or (rendered and name in _RENDERED)
