"""Counts of the flagged telemetry samples of a trial, while it is presented."""

import threading
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from hilbo.device.reasons import SampleFlag
from hilbo.study.file.trial_flags import FLAGS, SAMPLES

__all__ = ["SampleCounter"]

_BITS = {name: int(SampleFlag[name.upper()]) for name in FLAGS}


class SampleCounter:
    """Counts of the presentation that began last. `take()` gives the flags (n,) of all samples that arrived since its
    last call.

    The thread of the device drains it regularly, so that no samples pile up, and the event loop reads it with an
    answer. Samples are taken and counted under one lock: none of an earlier presentation is counted with a later one.
    """

    def __init__(self, take: Callable[[], np.ndarray]):
        self._take, self._lock = take, threading.Lock()
        self._of: Any = None
        self._counts: dict[str, int] = {}

    def begin(self, of: Any) -> None:
        """Count from zero for this presentation from now on; `of` identifies it, (trial, presentation). Samples that
        arrived before are dropped."""
        with self._lock:
            self._take()
            self._of, self._counts = of, {SAMPLES: 0}

    def drain(self) -> None:
        """Add the samples that arrived since the last call to the counts of the present trial."""
        with self._lock:
            self._add()

    def counts(self, of: Any) -> Mapping[str, int] | None:
        """Number of all `samples`, and for each flag that occurred of the samples with it, including those that have
        just arrived; None for another presentation than the latest."""
        with self._lock:
            self._add()
            return dict(self._counts) if of == self._of else None

    def _add(self) -> None:
        """Take the new samples and count them, if a presentation has begun. The caller holds the lock."""
        flags = self._take()
        if self._of is None or not len(flags):
            return
        self._counts[SAMPLES] += len(flags)
        for name, bit in _BITS.items():
            if count := int(np.count_nonzero(flags & bit)):
                self._counts[name] = self._counts.get(name, 0) + count
