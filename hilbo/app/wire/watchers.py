"""Who looks at a session: open pages and programs of the two roles; a participant's newest window is the one that
counts."""

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
    """Somebody who looks at a role's view. `news` is set when there is a newer one; `ended` when it looks no more,
    because of `why`. `seen` is when it last gave a sign of life, monotonic."""

    def __init__(self, role: Role, page: str):
        self.role, self.page, self.seen = role, page, time.monotonic()
        self.news = asyncio.Event()
        self.ended = False
        self.why = ""

    def end(self, why: str = "") -> None:
        """It shall look no more."""
        self.ended, self.why = True, why
        self.news.set()


class Watchers:
    """All who look now. `moved` says to a window that another one has taken over."""

    def __init__(self, moved: Callable[[], str]):
        self._moved, self._asked = moved, -math.inf
        self._all: list[Watcher] = []

    def add(self, role: Role, page: str) -> Watcher:
        """A new one; a participant's newest window ends the others."""
        if role == "participant":
            self.end(role, but=page)
        self._all.append(Watcher(role, page))
        return self._all[-1]

    def remove(self, watcher: Watcher) -> None:
        """It looks no more."""
        with contextlib.suppress(ValueError):
            self._all.remove(watcher)

    def end(self, role: Role, but: str | None = None) -> None:
        """The pages of a role are out, but one."""
        for watcher in self._all:
            if watcher.role == role and watcher.page != but:
                watcher.end(self._moved())

    def end_all(self) -> None:
        """The server ends."""
        for watcher in list(self._all):
            watcher.end()

    def tell(self) -> None:
        """There is news."""
        for watcher in self._all:
            watcher.news.set()

    def heard(self) -> None:
        """A program asks in the participant's place."""
        self._asked = time.monotonic()

    def alive(self, page: str | None) -> None:
        """A participant's page is there: an open stream alone says nothing of a network that went silently."""
        for watcher in self._all:
            if watcher.role == "participant" and watcher.page == page:
                watcher.seen = time.monotonic()

    @property
    def participant_here(self) -> bool:
        """Whether a participant's page is open and has said so lately, or a program in its place has asked lately."""
        now, newest = time.monotonic(), self._newest()
        return (newest is not None and now - newest.seen < _QUIET) or now - self._asked < _SILENT

    def counts(self, page: str | None) -> bool:
        """Whether a participant's window is the newest; a program, which has none, always counts."""
        newest = self._newest()
        return page is None or newest is None or newest.page == page

    def _newest(self) -> Watcher | None:
        return next((w for w in reversed(self._all) if w.role == "participant" and not w.ended), None)
