"""Flags that the telemetry of a device may mark a trial with, and sentences about them. Loads no JAX and no pandas.

In tables the column `flags` contains the flags of a trial, separated by spaces: "saturated slewed". Other words in it
are ignored. `telemetry_samples` is the number of samples that were recorded with the trial; it is empty without
telemetry, which distinguishes such a trial from one without flags. `hilbo.study.tables.flag_counts` reads these
columns.
"""

from collections.abc import Collection, Iterable, Mapping
from typing import Literal, NamedTuple, get_args

__all__ = [
    "COLUMN",
    "COLUMN_OF_SAMPLES",
    "FLAGS",
    "SAMPLES",
    "FlagCounts",
    "TrialFlag",
    "flag_sentences",
    "flag_words",
]

TrialFlag = Literal["saturated", "slewed", "controlled", "input_held", "hold", "estop"]
FLAGS: tuple[TrialFlag, ...] = get_args(TrialFlag)
SAMPLES = "samples"
"""The count of all samples, among the counts of a trial."""
COLUMN, COLUMN_OF_SAMPLES = "flags", "telemetry_samples"


class FlagCounts(NamedTuple):
    """Counts over the trials that an analysis would use: `recorded`, with a record of the device's flags; `flagged`,
    flag -> number of trials; `excluded`, participant -> number of trials excluded for a flag."""

    recorded: int = 0
    flagged: Mapping[str, int] = {}
    excluded: Mapping[str, int] = {}

    @property
    def left_out(self) -> int:
        """Number of excluded trials, summed over participants."""
        return sum(self.excluded.values())

    def content(self) -> dict[str, int | dict[str, int]]:
        """The counts as a dict for result.json; excluded trials as their sum, `left_out`."""
        return {"recorded": self.recorded, "flagged": dict(self.flagged), "left_out": self.left_out}


def flag_words(flags: Iterable[str]) -> str:
    """Text of the table cell for these flags: known ones in the order of `FLAGS`, separated by spaces."""
    carried = set(flags)
    return " ".join(name for name in FLAGS if name in carried)


def flag_sentences(counts: FlagCounts, exclude: Collection[str], what: str = "trials") -> list[str]:
    """One sentence with the number of trials per flag and the number excluded; an empty list if no telemetry was
    recorded and the study excludes no flag. `what`: plural of the counted items."""
    rule = f"[study] exclude_flags ({', '.join(exclude)})"
    if not counts.recorded:
        return [f"No device flags were recorded for these {what}; {rule} excludes none."] if exclude else []
    words = ", ".join(f"{name.replace('_', ' ')} {count}" for name, count in counts.flagged.items()) or "none occurred"
    left = f"excluded by {rule}: {counts.left_out}" if exclude else f"no {what[:-1]} is excluded"
    return [f"Device flags were recorded for {counts.recorded} {what} ({words}); {left}."]
