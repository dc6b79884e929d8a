"""Telemetry as it arrives: samples of the device's ticks, kept until they are asked for.

Ticks are the device's only clock, 32 bits of it on the wire; here they count on for ever. Units: ticks, s, mm, N.
"""

import threading
from collections import deque
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from hilbo.device.messages import Telemetry

__all__ = ["Counts", "Samples", "TelemetryBuffer", "joined"]

_MOST = 200_000  # messages: some twenty minutes at 1 kHz


class Samples(NamedTuple):
    """Columns of equal length: `tick`, `position_mm`, `force_N`, `sensed_N` (NaN where not sensed), `flags`."""

    tick: np.ndarray
    position_mm: np.ndarray
    force_N: np.ndarray
    sensed_N: np.ndarray
    flags: np.ndarray

    def table(self, tick_s: float, begun: int | None = None) -> Any:
        """As a pandas table, with `time_s` from the tick `begun` on, or from the first sample's."""
        import pandas as pd

        since = (self.tick - (self.tick[:1].sum() if begun is None else begun)) * tick_s
        columns = {"tick": self.tick, "time_s": since, "position_mm": self.position_mm, "force_N": self.force_N}
        return pd.DataFrame(columns | {"sensed_N": self.sensed_N, "flags": self.flags})


def joined(pieces: Sequence[Samples]) -> Samples:
    """Pieces one after the other."""
    return Samples(*(np.concatenate(column) for column in zip(*pieces, strict=True)))


class Counts(NamedTuple):
    """What has arrived, and what has not: `dropped` by the device for want of room, `missing` on the way or there;
    `unread`: what had arrived and was given up here, because nobody asked for it for long."""

    samples: int
    dropped: int
    missing: int
    unread: int


class TelemetryBuffer:
    """Messages in, `Samples` out; filled by one thread, emptied by another."""

    def __init__(self, encoder_step_mm: float):
        self._step = encoder_step_mm
        self._messages: deque[tuple[int, Telemetry]] = deque()
        self._news = threading.Condition()
        self._samples = self._missing = self._dropped = self._unread = 0
        self._next: int | None = None  # tick that the next sample should have
        self._lost: int | None = None
        self.newest: Telemetry | None = None

    def add(self, message: Telemetry) -> None:
        """One message, in the order of arrival."""
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
        """The tick after the newest sample, or 0 before the first."""
        with self._news:
            return self._next or 0

    def counts(self) -> Counts:
        """Since the buffer was made."""
        with self._news:
            return Counts(self._samples, self._dropped, self._missing, self._unread)

    @property
    def much(self) -> bool:
        """Whether so much waits to be taken that it should be."""
        return len(self._messages) > _MOST // 2

    def wait(self, timeout: float) -> bool:
        """Whether something new came within `timeout` seconds."""
        with self._news:
            seen = self._samples
            return self._news.wait_for(lambda: self._samples != seen, timeout)

    def take(self) -> Samples:
        """Everything that has come since the last call, oldest first."""
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
