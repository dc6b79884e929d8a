"""How long a session will still take, and durations in words. Loads no JAX."""

import numpy as np

from hilbo.session.log.header_check import protocol_of
from hilbo.session.log.state import LiveSession

__all__ = ["duration", "minutes_left"]


def duration(seconds: float) -> str:
    """A duration of `seconds` in words, in its two largest units without zeros: "2 d 3 h", "1 h 5 min", "7 min"; below
    1 min in s."""
    if seconds < 60.0:
        return f"{seconds:.0f} s"
    minutes = int(seconds / 60.0)
    days, hours, minutes = minutes // 1440, minutes // 60 % 24, minutes % 60
    parts = [(days, "d"), (hours, "h")] if days else [(hours, "h"), (minutes, "min")]
    return " ".join(f"{count} {unit}" for count, unit in parts if count)


def minutes_left(state: LiveSession) -> float:
    """Estimated minutes to the end of the session: the trials left times the median time between this participant's
    answers or, before the third answer, times 1.5 times the duration of the protocol's steps; plus the rests ahead."""
    times = sorted(t.answered["time"] for t in state.trials if t.answered is not None)
    gaps = np.diff(times)
    total = 0.0
    for i, block in enumerate(state.header.blocks):
        left = 0 if state.full(i) else state.quota(i) - len(state.counted(i)) - len(state.skipped(i))
        pace = 1.5 * protocol_of(state.study, block).seconds if len(gaps) < 2 else float(np.median(gaps))
        total += left * pace + (block.rest if left and state.gate(i) == "rest" else 0.0)
    return total / 60.0
