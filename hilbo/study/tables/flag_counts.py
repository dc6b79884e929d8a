"""Flags of the device in tables of answers: which rows carry one, and how many do (`hilbo.study.file.trial_flags`)."""

from collections import Counter
from collections.abc import Collection, Iterable

import pandas as pd

from hilbo.study.file.trial_flags import COLUMN, COLUMN_OF_SAMPLES, FLAGS, FlagCounts, flag_sentences

__all__ = ["added", "counted_flags", "flag_counts", "flag_sentences_of", "flagged", "with_flag_counts"]

_COUNTS = "hilbo flags"
"""Of the attributes that pandas carries along with a table, the one that holds its `FlagCounts`."""
_NONE_RECORDED = ("", "0", "0.0", "nan", "none", "<na>")


def flagged(table: pd.DataFrame, exclude: Collection[str]) -> pd.Series:
    """Which rows carry one of these flags."""
    if COLUMN not in table or not exclude:
        return pd.Series(False, table.index)
    return _carried(table).map(lambda names: not names.isdisjoint(exclude)).astype(bool)


def counted_flags(table: pd.DataFrame, exclude: Collection[str]) -> FlagCounts:
    """The counts of the rows that an analysis would take if no flag were excluded; cells are texts."""
    if COLUMN not in table and COLUMN_OF_SAMPLES not in table:
        return FlagCounts()
    carried = _carried(table)
    recorded = carried.map(bool)
    if COLUMN_OF_SAMPLES in table:
        recorded |= table[COLUMN_OF_SAMPLES].map(lambda cell: str(cell).strip().lower() not in _NONE_RECORDED)
    rows_of = Counter(name for names in carried for name in names)
    excluded = Counter(table.loc[flagged(table, exclude), "participant"].map(str))
    return FlagCounts(int(recorded.sum()), {name: rows_of[name] for name in FLAGS if rows_of[name]}, excluded)


def with_flag_counts(table: pd.DataFrame, counts: FlagCounts) -> pd.DataFrame:
    """The table, which carries these counts along."""
    table.attrs[_COUNTS] = counts
    return table


def flag_counts(*tables: pd.DataFrame) -> FlagCounts:
    """The counts that tables of comparisons carry, together."""
    return added(table.attrs.get(_COUNTS, FlagCounts()) for table in tables)


def added(parts: Iterable[FlagCounts]) -> FlagCounts:
    """The counts of several tables together."""
    each = list(parts)
    total = sum((Counter(counts.flagged) for counts in each), Counter())
    flags = {name: total[name] for name in FLAGS if total[name]}
    excluded = sum((Counter(counts.excluded) for counts in each), Counter())
    return FlagCounts(sum(c.recorded for c in each), flags, excluded)


def flag_sentences_of(counts: FlagCounts, exclude: Collection[str], what: str = "trials") -> list[str]:
    """The sentences of `flag_sentences`; nothing where no trial carries a flag and none is excluded."""
    return flag_sentences(counts, exclude, what) if counts.flagged or exclude else []


def _carried(table: pd.DataFrame) -> pd.Series:
    """The flags of each row."""
    if COLUMN not in table:
        return pd.Series([frozenset()] * len(table), table.index, dtype=object)
    return table[COLUMN].map(lambda cell: frozenset(FLAGS).intersection(str(cell).split()))
