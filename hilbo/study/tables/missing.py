"""Missing responses of a trial table: cells that the study file names in `[study] missing`, which are counted and not
fitted."""

from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import pandas as pd

__all__ = ["Missing", "missing_labels"]

_NAMED = 6  # participants named in a sentence


class Missing(NamedTuple):
    """Counts of missing responses by label, as written in the table, and by participant; and of all rows that would be
    fitted."""

    labels: Mapping[str, int] = MappingProxyType({})
    people: Mapping[str, int] = MappingProxyType({})
    rows: int = 0

    @classmethod
    def of(cls, participants: "pd.Series[str]", labels: "pd.Series[Any]") -> "Missing":
        """Count the rows that have a label (of `missing_labels`); `participants`: of the rows that would be fitted."""
        absent = labels.notna()
        return cls(Counter(labels[absent]), Counter(participants[absent].map(str)), len(labels))

    @classmethod
    def added(cls, parts: Iterable["Missing"]) -> "Missing":
        """Sum of several counts."""
        each = list(parts)
        labels: Counter[str] = sum((Counter(part.labels) for part in each), Counter())
        people: Counter[str] = sum((Counter(part.people) for part in each), Counter())
        return cls(labels, people, sum(part.rows for part in each))

    @property
    def sentences(self) -> list[str]:
        """A sentence with the counts; an empty list if nothing is missing."""
        if not self.labels:
            return []
        kinds = ", ".join(f'"{label}" {count}' for label, count in Counter(self.labels).most_common())
        first = Counter(self.people).most_common(_NAMED)
        more = len(self.people) - len(first)
        who = ", ".join(f"{name} {count}" for name, count in first) + (f" and {more} more" if more else "")
        total = sum(self.labels.values())
        verb = "is" if total == 1 else "are"
        return [f"{total} of {self.rows} responses {verb} missing ({kinds}) and not fitted; by participant: {who}."]

    def content(self) -> dict[str, Any]:
        """The counts as a dict for result.json."""
        return {"labels": dict(self.labels), "participants": dict(self.people), "rows": self.rows}


def missing_labels(cells: "pd.Series[str]", labels: Collection[str]) -> "pd.Series[Any]":
    """Series of the label of each cell that is one of `labels`, blanks around it not considered; None elsewhere."""
    if not labels:
        return pd.Series(None, cells.index, dtype=object)
    plain = cells.str.strip().astype(object)
    return plain.where(plain.isin([label.strip() for label in labels]), None)
