"""How long a session will still take. Loads no JAX."""

import numpy as np

from hilbo.session.log.state import LiveSession
from hilbo.study.file.protocols import protocol

__all__ = ["minutes_left"]


def minutes_left(state: LiveSession) -> float:
    """Minutes to the end, rests included: the trials left at this participant's median pace, or, before the third
    answer, at the protocol's seconds and half as many for the answer."""
    times = sorted(t.answered["time"] for t in state.trials if t.answered is not None)
    gaps = np.diff(times)
    total = 0.0
    for i, block in enumerate(state.header.blocks):
        left = 0 if state.full(i) else state.quota(i) - len(state.answers(i)) - len(state.skipped(i))
        pace = 1.5 * protocol(state.study.session, block.phase).seconds if len(gaps) < 2 else float(np.median(gaps))
        total += left * pace + (block.rest if left and state.gate(i) == "rest" else 0.0)
    return total / 60.0
