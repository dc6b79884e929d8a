"""Validation and conversion of the inputs of the statistics: outcomes, predictors, clusters and confidence levels."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float, Int

from hilbo.errors import InputError

__all__ = ["Columns", "check_aligned", "check_level", "is_yes_or_no", "labels_of", "predictors_of"]

Columns = Mapping[str, Any] | pd.DataFrame | pd.Series  # a column for each name, n entries each


def check_level(level: Any) -> None:
    """Raise `InputError` for a confidence level that is not between 0 and 1, such as 95."""
    number = isinstance(level, int | float | np.number) and not isinstance(level, bool)
    if not number or not 0 < level < 1:
        raise InputError(f"level is {level!r}; it must be above 0 and below 1, such as 0.95.")


def check_aligned(**given: Any) -> None:
    """Raise `InputError` for Series and frames whose row labels differ, since rows are matched by position.

    Unlabelled arrays, and mappings of columns, are not checked.
    """
    labelled = [
        (name, column.index)
        for name, value in given.items()
        for column in (value.values() if isinstance(value, Mapping) else [value])
        if isinstance(column, pd.Series | pd.DataFrame)
    ]
    for name, index in labelled[1:]:
        if not index.equals(labelled[0][1]):
            raise InputError(
                f"{name} and {labelled[0][0]} have different row labels; bring their rows into one order, then"
                " reset_index(drop=True) both."
            )


def is_yes_or_no(values: np.ndarray) -> bool:
    """Whether the array is not empty and all entries are 0 or 1; a missing value is neither."""
    return bool(values.size and not pd.isna(values).any() and np.isin(values, (0, 1)).all())


def predictors_of(given: Columns | None, n: int) -> tuple[list[str], Float[np.ndarray, "n p"]]:
    """Names and columns (n, p) of the predictors; none for None.

    Raises `InputError` for objects without names, values that are not finite numbers, and wrong lengths.
    """
    columns = {name: _numbers(values) for name, values in _columns("predictors", given).items()}
    for name, values in columns.items():
        if values.shape != (n,) or not np.isfinite(values).all():
            raise InputError(f'predictor "{name}" must have one finite number for each of the {n} answers.')
    return list(columns), np.array(list(columns.values())).T.reshape(n, len(columns))


def labels_of(given: Columns | None, n: int) -> dict[str, Int[np.ndarray, " n"]]:
    """Cluster index (from 0, in sorted order) of every response, by clustering variable; an empty dict for None.

    Raises `InputError` for objects without names, more than two variables, wrong lengths and missing values.
    """
    columns = {name: np.asarray(values) for name, values in _columns("clusters", given).items()}
    if len(columns) > 2:
        raise InputError(f"errors can be clustered by one way or two, not by {len(columns)} ({', '.join(columns)}).")
    for name, codes in columns.items():
        if codes.shape != (n,):
            raise InputError(f'clusters "{name}" has {codes.size} entries for {n} answers; give one for each answer.')
        if pd.isna(codes).any():
            raise InputError(f'clusters "{name}" has empty entries; name the cluster of every answer.')
    return {name: pd.factorize(codes, sort=True)[0] for name, codes in columns.items()}  # numbers and texts in one too


def _columns(what: str, given: Columns | None) -> dict[str, Any]:
    """Columns by name; a Series by its own name, or `what` if it has none; no columns for None. Raises `InputError` for
    objects without names."""
    if given is None:
        return {}
    if isinstance(given, pd.DataFrame | Mapping):
        return {str(name): given[name] for name in given}
    if isinstance(given, pd.Series):
        name = getattr(given, "name", None)
        return {what if name is None else str(name): given}
    words = "give a DataFrame, a Series or a dict, so that each column has a name"
    raise InputError(f"{what} is a {type(given).__name__}; {words}.")


def _numbers(values: Any) -> Float[np.ndarray, "..."]:
    """Values as float64; NaN if they are not numeric."""
    try:
        return np.asarray(values, float)
    except (TypeError, ValueError):
        return np.full(np.shape(values), np.nan)
