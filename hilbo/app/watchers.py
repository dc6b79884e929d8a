"""Who looks at a session: open pages and programs of the two roles; a participant's newest window is the one that
counts."""

import asyncio
import contextlib
import math
import time
from collections.abc import Callable

from hilbo.app.security import Role

__all__ = ["Watcher", "Watchers"]

_SILENT = 10.0  # s without a word from a program in the participant's place until it counts as gone


class Watcher:
    """Somebody who looks at a role's view. `news` is set when there is a newer one; `ended` when it looks no more,
    because of `why`."""

    def __init__(self, role: Role, page: str):
        self.role, self.page = role, page
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

    @property
    def participant_here(self) -> bool:
        """Whether a participant's page is open, or a program in its place has asked for something lately."""
        return self._newest() is not None or time.monotonic() - self._asked < _SILENT

    def counts(self, page: str | None) -> bool:
        """Whether a participant's window is the newest; a program, which has none, always counts."""
        return page is None or self._newest() in (None, page)

    def _newest(self) -> str | None:
        return next((w.page for w in reversed(self._all) if w.role == "participant" and not w.ended), None)
