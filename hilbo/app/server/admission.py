"""Admission of connections: the experimenter's at once, all others by round robin.

An accepted connection is first only inspected: its data are read without being consumed. That costs a tenth of serving
it, so that a thousand strangers who reconnect again and again do not delay others. Connections that have sent nothing
are pending; the oldest of too many, and each after `PATIENCE`, is closed.
"""

import asyncio
import contextlib
import socket
from collections.abc import Callable
from typing import Any

from hilbo.app.server.connections import LOOKED, PATIENCE
from hilbo.app.server.round_robin import RoundRobin
from hilbo.app.wire.security import Gate, Role

__all__ = ["Listener"]

_AT_ONCE = 64  # connections accepted at one turn
_BACKLOG = 1024  # those that wait for it in the kernel


class Listener:
    """Accepts the connections of a listening socket. `admit` is called with each admitted connection and the role whose
    key came with it, or None; at most `most` connections are pending."""

    def __init__(
        self, listening: socket.socket, gate: Gate, most: int, admit: Callable[[socket.socket, Role | None], Any]
    ):
        self._listening, self._gate, self._most, self._admit = listening, gate, most, admit
        self._pending: dict[socket.socket, float] = {}  # deadlines, oldest first
        self._silent: set[socket.socket] = set()
        self._queues = RoundRobin(self._admit_line)  # of those that have sent something

    def open(self) -> None:
        """Listen and start to accept, in the running event loop."""
        self._loop = asyncio.get_running_loop()
        self._listening.setblocking(False)
        self._listening.listen(_BACKLOG)
        self._loop.add_reader(self._listening, self._accept)
        self._clock = self._loop.call_later(1.0, self._tick)

    def close(self) -> None:
        """Stop accepting, and close the pending connections; the listening socket stays open."""
        self._clock.cancel()
        self._loop.remove_reader(self._listening)
        for line in list(self._pending):
            self._close_connection(line)

    def _accept(self) -> None:
        """Accept the waiting connections, at most `_AT_ONCE`; each is inspected, or watched until it sends data. The
        oldest pending one is closed if there are too many, or no file is left."""
        for _ in range(_AT_ONCE):
            try:
                line, _ = self._listening.accept()
            except BlockingIOError:  # no others
                break
            except OSError:  # one that has left, or no file for it
                self._make_room(0)
                break
            line.setblocking(False)
            self._pending[line] = self._loop.time() + PATIENCE
            if not self._inspect(line):
                self._silent.add(line)
                self._loop.add_reader(line.fileno(), self._readable, line)
            self._make_room(self._most)

    def _make_room(self, most: int) -> None:
        """Close the oldest pending connection if more than `most` are pending."""
        if len(self._pending) > most:
            self._close_connection(next(iter(self._pending)))

    def _readable(self, line: socket.socket) -> None:
        """Callback when a watched connection has data or has ended: inspect it."""
        self._unwatch(line)
        self._inspect(line)

    def _inspect(self, line: socket.socket) -> bool:
        """Whether data have come, or the connection has ended. With data it is admitted (the experimenter's) or queued
        by its role; without, it is closed."""
        try:
            said = line.recv(LOOKED, socket.MSG_PEEK)
        except BlockingIOError:
            return False
        except OSError:
            said = b""
        role = self._gate.role_in(said)
        if not said:
            self._close_connection(line)
        elif role == "experimenter":
            self._admit_line(line, role)
        else:
            self._queues.add(line, role)
        return True

    def _admit_line(self, line: socket.socket, role: Role | None) -> None:
        """Admit a connection, which is then no longer pending."""
        self._forget(line)
        self._admit(line, role)

    def _close_connection(self, line: socket.socket) -> None:
        """Close a connection and remove it everywhere."""
        self._forget(line)
        self._unwatch(line)
        with contextlib.suppress(OSError):
            line.close()

    def _unwatch(self, line: socket.socket) -> None:
        """Stop watching a connection that has sent nothing, if it is watched."""
        if line in self._silent:
            self._silent.remove(line)
            self._loop.remove_reader(line.fileno())

    def _forget(self, line: socket.socket) -> None:
        """Remove a connection from the pending ones and the queues."""
        self._pending.pop(line, None)
        self._queues.remove(line)

    def _tick(self) -> None:
        """Close the connections that were pending for too long; once a second."""
        now = self._loop.time()
        for line in [line for line, until in self._pending.items() if until < now]:
            self._close_connection(line)
        self._clock = self._loop.call_later(1.0, self._tick)
