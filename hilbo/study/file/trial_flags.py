"""Flags that the telemetry of a device may mark a trial with, and sentences about them. Loads no JAX and no pandas.

In tables the column `flags` holds the flags of a trial, separated by spaces: "saturated slewed". Other words in it are
ignored. `telemetry_samples` is the number of samples that were recorded with the trial; it is empty where there was no
telemetry, which tells such a trial from one without flags. `hilbo.study.tables.flag_counts` reads these columns.
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
    """Trials that an analysis would take: how many have a record of the device's flags, how many carry each flag, and
    how many of each participant's are excluded for theirs."""

    recorded: int = 0
    flagged: Mapping[str, int] = {}
    excluded: Mapping[str, int] = {}

    @property
    def left_out(self) -> int:
        """Excluded trials of all participants."""
        return sum(self.excluded.values())

    def content(self) -> dict[str, int | dict[str, int]]:
        """As result.json has it."""
        return {"recorded": self.recorded, "flagged": dict(self.flagged), "left_out": self.left_out}


def flag_words(flags: Iterable[str]) -> str:
    """The cell of these flags, in their order."""
    carried = set(flags)
    return " ".join(name for name in FLAGS if name in carried)


def flag_sentences(counts: FlagCounts, exclude: Collection[str], what: str = "trials") -> list[str]:
    """How many trials carried which flag, and how many are excluded; nothing where no flag was recorded or excluded."""
    rule = f"[study] exclude_flags ({', '.join(exclude)})"
    if not counts.recorded:
        return [f"No device flags were recorded for these {what}; {rule} excludes none."] if exclude else []
    words = ", ".join(f"{name.replace('_', ' ')} {count}" for name, count in counts.flagged.items()) or "none occurred"
    left = f"excluded by {rule}: {counts.left_out}" if exclude else f"no {what[:-1]} is excluded"
    return [f"Device flags were recorded for {counts.recorded} {what} ({words}); {left}."]
