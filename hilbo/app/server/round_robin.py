"""Round-robin scheduling of connections: one queue for each role and one for strangers; every few milliseconds the
first of each is served.

So no role can take more than its part of the thread that serves all. A connection that finds empty queues does not
wait.
"""

import asyncio
from collections.abc import Callable
from typing import Any

from hilbo.app.wire.security import Role

__all__ = ["RoundRobin"]

_INTERVAL = 0.005  # s from one turn to the next


class RoundRobin:
    """The queues, of all roles but the experimenter and of strangers (None). `serve` is called with the connection that
    is next, and its role."""

    def __init__(self, serve: Callable[[Any, Role | None], Any]):
        self._serve, self._due, self._waiting = serve, 0.0, False
        self._queues: dict[Role | None, dict[Any, None]] = {"stimulus": {}, "preparer": {}, "participant": {}, None: {}}

    def add(self, who: Any, role: Role | None) -> None:
        """Append to the queue of its role, unless it is there already, and schedule a turn."""
        self._queues[role][who] = None
        self._wait()

    def remove(self, who: Any) -> None:
        """Remove from the queues, if it is in one."""
        for queue in self._queues.values():
            queue.pop(who, None)

    def _wait(self) -> None:
        """Schedule the next turn, if a connection is queued and no turn is scheduled."""
        if any(self._queues.values()) and not self._waiting:
            self._waiting = True
            asyncio.get_running_loop().call_at(self._due, self._turn)

    def _turn(self) -> None:
        """Remove and serve the first of each queue."""
        self._waiting = False
        self._due = asyncio.get_running_loop().time() + _INTERVAL
        for role, queue in self._queues.items():
            if queue:
                who = next(iter(queue))
                del queue[who]
                self._serve(who, role)
        self._wait()
