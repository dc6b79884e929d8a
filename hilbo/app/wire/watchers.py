"""The open streams of views of both roles, participant and experimenter; of a participant's windows the newest is the
active one."""

import asyncio
import contextlib
import math
import time
from collections.abc import Callable

from hilbo.app.wire.security import Role

__all__ = ["Watcher", "Watchers"]

_SILENT = 10.0  # s without a word from a program in the participant's place until it counts as gone
_QUIET = 3.0  # s without a sign of life from a participant's page, which gives one every second


class Watcher:
    """A page or program that receives a role's view. `page`: id of its browser window; `news`: set when there is a
    newer view; `ended`: it gets no more, because of `why`; `seen`: time of its last sign of life, s, monotonic."""

    def __init__(self, role: Role, page: str):
        self.role, self.page, self.seen = role, page, time.monotonic()
        self.news = asyncio.Event()
        self.ended = False
        self.why = ""

    def end(self, why: str = "") -> None:
        """End its stream; `why` is sent to the page, unless it is empty."""
        self.ended, self.why = True, why
        self.news.set()


class Watchers:
    """All open streams. `moved()` gives the text for a window that another one replaced."""

    def __init__(self, moved: Callable[[], str]):
        self._moved, self._asked = moved, -math.inf
        self._all: list[Watcher] = []

    def add(self, role: Role, page: str) -> Watcher:
        """Add a stream, and return it; a participant's new window `page` ends those of the others."""
        if role == "participant":
            self.end(role, but=page)
        self._all.append(Watcher(role, page))
        return self._all[-1]

    def remove(self, watcher: Watcher) -> None:
        """Remove a stream, if it is still there."""
        with contextlib.suppress(ValueError):
            self._all.remove(watcher)

    def end(self, role: Role, but: str | None = None) -> None:
        """End the streams of a role, except those of the page `but`, with the text `moved`."""
        for watcher in self._all:
            if watcher.role == role and watcher.page != but:
                watcher.end(self._moved())

    def end_all(self) -> None:
        """End all streams, without a text."""
        for watcher in list(self._all):
            watcher.end()

    def tell(self) -> None:
        """Notify all streams of a newer view."""
        for watcher in self._all:
            watcher.news.set()

    def heard(self) -> None:
        """Record a sign of life of a program that acts as the participant."""
        self._asked = time.monotonic()

    def alive(self, page: str | None) -> None:
        """Record a sign of life of a participant's page: an open stream alone does not show a dead network."""
        for watcher in self._all:
            if watcher.role == "participant" and watcher.page == page:
                watcher.seen = time.monotonic()

    @property
    def participant_here(self) -> bool:
        """Whether a participant's page has given a sign of life within `_QUIET` s, or a program in its place within
        `_SILENT` s."""
        now, newest = time.monotonic(), self._newest()
        return (newest is not None and now - newest.seen < _QUIET) or now - self._asked < _SILENT

    def counts(self, page: str | None) -> bool:
        """Whether a participant's window is the newest, or none is open; a program (None) always counts."""
        newest = self._newest()
        return page is None or newest is None or newest.page == page

    def _newest(self) -> Watcher | None:
        """The participant's newest stream that has not ended; None without one."""
        return next((w for w in reversed(self._all) if w.role == "participant" and not w.ended), None)
