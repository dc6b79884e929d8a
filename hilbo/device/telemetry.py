"""Buffer of telemetry: samples of the device's ticks, stored until they are taken.

Ticks are the device's only clock, 32 bits on the wire; here they are continued without wrapping. Units: ticks, s, mm,
N.
"""

import threading
from collections import deque
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from hilbo.device.messages import Telemetry

__all__ = ["Counts", "Samples", "TelemetryBuffer", "joined"]

_MOST = 200_000  # messages: about twenty minutes at 1 kHz


class Samples(NamedTuple):
    """Columns of equal length: `tick`, `position_mm`, `force_N`, `sensed_N` (NaN where not sensed), `flags`."""

    tick: np.ndarray
    position_mm: np.ndarray
    force_N: np.ndarray
    sensed_N: np.ndarray
    flags: np.ndarray

    def table(self, tick_s: float, begun: int | None = None) -> Any:
        """Return the samples as a pandas table with the additional column `time_s`: the time (s) since the tick
        `begun`, or since the first sample if that is None. `tick_s`: period of a tick (s)."""
        import pandas as pd

        since = (self.tick - (self.tick[:1].sum() if begun is None else begun)) * tick_s
        columns = {"tick": self.tick, "time_s": since, "position_mm": self.position_mm, "force_N": self.force_N}
        return pd.DataFrame(columns | {"sensed_N": self.sensed_N, "flags": self.flags})


def joined(pieces: Sequence[Samples]) -> Samples:
    """Concatenate pieces of telemetry, of which there must be at least one, in their order."""
    return Samples(*(np.concatenate(column) for column in zip(*pieces, strict=True)))


class Counts(NamedTuple):
    """Counts of samples.

    `samples` received; `dropped` by the device for lack of room; `missing`: lost on the way or there; `unread`:
    received and discarded here, because they were not taken for too long.
    """

    samples: int
    dropped: int
    missing: int
    unread: int


class TelemetryBuffer:
    """Buffer from telemetry messages to `Samples`; filled by one thread, emptied by another."""

    def __init__(self, encoder_step_mm: float):
        self._step = encoder_step_mm
        self._messages: deque[tuple[int, Telemetry]] = deque()
        self._news = threading.Condition()
        self._samples = self._missing = self._dropped = self._unread = 0
        self._next: int | None = None  # tick that the next sample should have
        self._lost: int | None = None
        self.newest: Telemetry | None = None

    def add(self, message: Telemetry) -> None:
        """Store a message, update the counts and `newest`, and wake up `wait`. A message without samples is ignored.

        Messages must be added in the order of arrival. When the buffer is full, the oldest message is discarded and its
        samples count as `unread`.
        """
        if not message.samples:
            return
        with self._news:
            tick = message.tick
            if self._next is not None:
                tick = self._next + (message.tick - self._next + 2**31) % 2**32 - 2**31
                self._missing += max(0, (tick - self._next) // max(1, message.divisor))
            if self._lost is not None:
                self._dropped += (message.lost - self._lost) % 2**16
            self._next, self._lost = tick + len(message.samples) * message.divisor, message.lost
            self._samples += len(message.samples)
            self._messages.append((tick, message))
            if len(self._messages) > _MOST:
                self._unread += len(self._messages.popleft()[1].samples)
            self.newest = message
            self._news.notify_all()

    @property
    def tick(self) -> int:
        """Tick at which the next sample is due, counted on beyond 2^32; 0 before the first sample."""
        with self._news:
            return self._next or 0

    def counts(self) -> Counts:
        """Return the counts since the buffer was created; `take` does not reset them."""
        with self._news:
            return Counts(self._samples, self._dropped, self._missing, self._unread)

    @property
    def over_half_full(self) -> bool:
        """Whether the buffer is more than half full, so that `take` should be called."""
        return len(self._messages) > _MOST // 2

    def wait(self, timeout: float) -> bool:
        """Block until samples are added, for up to `timeout` s; return whether any were."""
        with self._news:
            seen = self._samples
            return self._news.wait_for(lambda: self._samples != seen, timeout)

    def take(self) -> Samples:
        """Remove all stored samples from the buffer and return them, oldest first; the columns are empty if there are
        none."""
        with self._news:
            messages = list(self._messages)
            self._messages.clear()
        ticks = [tick + message.divisor * i for tick, message in messages for i in range(len(message.samples))]
        rows = [sample for _, message in messages for sample in message.samples]
        counts, flags, force, sensed = zip(*rows, strict=True) if rows else ((), (), (), ())
        return Samples(
            np.array(ticks, np.int64),
            np.array(counts, np.float64) * self._step,
            np.array(force, np.float64),
            np.array([np.nan if value is None else value for value in sensed], np.float64),
            np.array(flags, np.int64),
        )
