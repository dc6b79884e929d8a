"""Whose turn it is: who presents, participants and strangers wait in rows, and every few milliseconds the first of each
goes on.

So none can take more than a part of the one thread that serves everybody. Where nobody waits, nobody is kept.
"""

import asyncio
from collections.abc import Callable
from typing import Any

from hilbo.app.wire.security import Role

__all__ = ["Turns"]

_APART = 0.005  # s from one turn to the next


class Turns:
    """The rows. `go` is called with whoever goes on, and its role."""

    def __init__(self, go: Callable[[Any, Role | None], Any]):
        self._go, self._due, self._waiting = go, 0.0, False
        self._rows: dict[Role | None, dict[Any, None]] = {"stimulus": {}, "preparer": {}, "participant": {}, None: {}}

    def add(self, who: Any, role: Role | None) -> None:
        """At the end of its row, unless it is there."""
        self._rows[role][who] = None
        self._wait()

    def remove(self, who: Any) -> None:
        """It waits no more."""
        for row in self._rows.values():
            row.pop(who, None)

    def _wait(self) -> None:
        if any(self._rows.values()) and not self._waiting:
            self._waiting = True
            asyncio.get_running_loop().call_at(self._due, self._turn)

    def _turn(self) -> None:
        self._waiting = False
        self._due = asyncio.get_running_loop().time() + _APART
        for role, row in self._rows.items():
            if row:
                who = next(iter(row))
                del row[who]
                self._go(who, role)
        self._wait()
