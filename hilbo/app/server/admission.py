"""The door of a server: an experimenter is let in at once, all others when it is their turn.

A connection that is accepted is first only looked at: what has come is read without taking it. That costs a tenth of
what it costs to serve it, so that a thousand strangers who come again and again do not hold up who comes behind them.
Those who say nothing wait outside; of too many, and after `PATIENCE`, the oldest is sent away.
"""

import asyncio
import contextlib
import socket
from collections.abc import Callable
from typing import Any

from hilbo.app.server.connections import LOOKED, PATIENCE
from hilbo.app.server.round_robin import Turns
from hilbo.app.wire.security import Gate, Role

__all__ = ["Porter"]

_AT_ONCE = 64  # connections accepted at one turn
_BACKLOG = 1024  # those that wait for it in the kernel


class Porter:
    """Stands at a listening socket. `admit` is called with each connection that is let in and the role whose key came
    with it, if one did; `most` may wait outside."""

    def __init__(
        self, listening: socket.socket, gate: Gate, most: int, admit: Callable[[socket.socket, Role | None], Any]
    ):
        self._listening, self._gate, self._most, self._admit = listening, gate, most, admit
        self._outside: dict[socket.socket, float] = {}  # until when, oldest first
        self._silent: set[socket.socket] = set()
        self._turns = Turns(self._let_in)  # of those of them who have said something

    def open(self) -> None:
        """From now on, in the event loop that runs."""
        self._loop = asyncio.get_running_loop()
        self._listening.setblocking(False)
        self._listening.listen(_BACKLOG)
        self._loop.add_reader(self._listening, self._accept)
        self._clock = self._loop.call_later(1.0, self._tick)

    def close(self) -> None:
        """Nobody else comes in."""
        self._clock.cancel()
        self._loop.remove_reader(self._listening)
        for line in list(self._outside):
            self._send_away(line)

    def _accept(self) -> None:
        for _ in range(_AT_ONCE):
            try:
                line, _ = self._listening.accept()
            except BlockingIOError:  # nobody else
                break
            except OSError:  # one that has left, or no file for it
                self._make_room(0)
                break
            line.setblocking(False)
            self._outside[line] = self._loop.time() + PATIENCE
            if not self._look(line):
                self._silent.add(line)
                self._loop.add_reader(line.fileno(), self._speaks, line)
            self._make_room(self._most)

    def _make_room(self, most: int) -> None:
        if len(self._outside) > most:
            self._send_away(next(iter(self._outside)))

    def _speaks(self, line: socket.socket) -> None:
        self._unwatch(line)
        self._look(line)

    def _look(self, line: socket.socket) -> bool:
        """Whether something has come; then the connection is let in, has its turn, or is over."""
        try:
            said = line.recv(LOOKED, socket.MSG_PEEK)
        except BlockingIOError:
            return False
        except OSError:
            said = b""
        role = self._gate.role_in(said)
        if not said:
            self._send_away(line)
        elif role == "experimenter":
            self._let_in(line, role)
        else:
            self._turns.add(line, role)
        return True

    def _let_in(self, line: socket.socket, role: Role | None) -> None:
        self._forget(line)
        self._admit(line, role)

    def _send_away(self, line: socket.socket) -> None:
        self._forget(line)
        self._unwatch(line)
        with contextlib.suppress(OSError):
            line.close()

    def _unwatch(self, line: socket.socket) -> None:
        if line in self._silent:
            self._silent.remove(line)
            self._loop.remove_reader(line.fileno())

    def _forget(self, line: socket.socket) -> None:
        self._outside.pop(line, None)
        self._turns.remove(line)

    def _tick(self) -> None:
        now = self._loop.time()
        for line in [line for line, until in self._outside.items() if until < now]:
            self._send_away(line)
        self._clock = self._loop.call_later(1.0, self._tick)
