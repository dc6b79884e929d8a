"""Flags of the device in trial and validation tables: rows that carry one, and their counts
(`hilbo.study.file.trial_flags`)."""

from collections import Counter
from collections.abc import Collection, Iterable

import pandas as pd

from hilbo.study.file.trial_flags import COLUMN, COLUMN_OF_SAMPLES, FLAGS, FlagCounts, flag_sentences

__all__ = ["added", "counted_flags", "flag_counts", "flag_sentences_of", "flagged", "with_flag_counts"]

_COUNTS = "hilbo flags"
"""Key of the `FlagCounts` in a DataFrame's attributes."""
_NONE_RECORDED = ("", "0", "0.0", "nan", "none", "<na>")


def flagged(table: pd.DataFrame, exclude: Collection[str]) -> pd.Series:
    """Boolean Series of the rows with at least one of the flags `exclude`; all False without a column of flags."""
    if COLUMN not in table or not exclude:
        return pd.Series(False, table.index)
    return _carried(table).map(lambda names: not names.isdisjoint(exclude)).astype(bool)


def counted_flags(table: pd.DataFrame, exclude: Collection[str]) -> FlagCounts:
    """Flag counts of these rows: with recorded telemetry, per flag, and excluded ones per participant. All 0 if the
    table has neither column of the device. `exclude`: flags that exclude a row."""
    if COLUMN not in table and COLUMN_OF_SAMPLES not in table:
        return FlagCounts()
    carried = _carried(table)
    recorded = carried.map(bool).astype(bool)  # of no rows `map` gives the type of the cells
    if COLUMN_OF_SAMPLES in table:
        sampled = table[COLUMN_OF_SAMPLES].map(lambda cell: str(cell).strip().lower() not in _NONE_RECORDED)
        recorded |= sampled.astype(bool)
    rows_of = Counter(name for names in carried for name in names)
    excluded = Counter(table.loc[flagged(table, exclude), "participant"].map(str))
    return FlagCounts(int(recorded.sum()), {name: rows_of[name] for name in FLAGS if rows_of[name]}, excluded)


def with_flag_counts(table: pd.DataFrame, counts: FlagCounts) -> pd.DataFrame:
    """Store flag counts in the table's attributes (`DataFrame.attrs`, changed in place); returns the same table.
    Inverse of `flag_counts`."""
    table.attrs[_COUNTS] = counts
    return table


def flag_counts(*tables: pd.DataFrame) -> FlagCounts:
    """Sum of the flag counts that `with_flag_counts` stored in these tables; tables without count as 0."""
    return added(table.attrs.get(_COUNTS, FlagCounts()) for table in tables)


def added(parts: Iterable[FlagCounts]) -> FlagCounts:
    """Sum of several flag counts."""
    each = list(parts)
    total = sum((Counter(counts.flagged) for counts in each), Counter())
    flags = {name: total[name] for name in FLAGS if total[name]}
    excluded = sum((Counter(counts.excluded) for counts in each), Counter())
    return FlagCounts(sum(c.recorded for c in each), flags, excluded)


def flag_sentences_of(counts: FlagCounts, exclude: Collection[str], what: str = "trials") -> list[str]:
    """One sentence on the number of trials per flag and the number excluded; an empty list if no trial has a flag and
    the study excludes none. `what`: plural of the counted items."""
    return flag_sentences(counts, exclude, what) if counts.flagged or exclude else []


def _carried(table: pd.DataFrame) -> pd.Series:
    """Set of known flags in each row; empty sets without a column of flags."""
    if COLUMN not in table:
        return pd.Series([frozenset()] * len(table), table.index, dtype=object)
    return table[COLUMN].map(lambda cell: frozenset(FLAGS).intersection(str(cell).split()))
