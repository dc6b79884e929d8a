"""Connections to the server, and how much of it each may take, so that whoever holds a key is always heard.

A connection is a stranger's until a key of a role has come in on it; then it is the role's. Strangers and each role
have numbers of connections of their own, and of too many the oldest is given up. An experimenter is heard at once,
who presents, participants and strangers by turns, each request of theirs anew. A stranger's connection ends with its
first answer. A request has `PATIENCE` s and `LARGEST` bytes, header and body, and so has all of a stranger's
connection.

uvicorn and h11 do the rest; without this, they would wait for a header for ever, and read a body of any size.
"""

import asyncio
from typing import Any, get_args

import h11
from uvicorn.protocols.http.flow_control import CLOSE_HEADER
from uvicorn.protocols.http.h11_impl import H11Protocol

from hilbo.app.server.round_robin import Turns
from hilbo.app.wire.security import Gate, Role

__all__ = ["LARGEST", "LOOKED", "PATIENCE", "Connection", "Connections"]

PATIENCE = 10.0  # s
LARGEST = 65_536  # bytes of a request
_MOST: dict[Role | None, int] = {role: 32 for role in (*get_args(Role), None)}  # a browser opens six at most
_KEPT = 120  # s that a role's idle connection stays open, so that the next press of a button needs no new one
_SEEN = 256  # bytes of the past in which the beginning of a key may be
LOOKED = 16_384  # bytes of what comes at once that are looked through for a key: all of the longest header


class Connections:
    """All open connections by role, None for strangers, the oldest first."""

    def __init__(self, gate: Gate):
        self.gate = gate
        self._open: dict[Role | None, dict[Connection, None]] = {role: {} for role in _MOST}
        self._turns = Turns(lambda connection, _: connection.hear())

    def add(self, connection: "Connection") -> None:
        """A new one, or one whose role has become another; the oldest of too many is given up."""
        mine = self._open[connection.role]
        mine[connection] = None
        if len(mine) > _MOST[connection.role]:
            oldest = next(iter(mine))
            self.remove(oldest)
            oldest.give_up()

    def remove(self, connection: "Connection") -> None:
        """It is open no more, or another's."""
        self._open[connection.role].pop(connection, None)
        self._turns.remove(connection)

    def wait(self, connection: "Connection") -> None:
        """Have it heard when its turn comes."""
        if connection.role == "experimenter":
            connection.hear()
        else:
            self._turns.add(connection, connection.role)


class Connection(H11Protocol):
    """One connection, which reads nothing new before what it has read was heard. `role` is that of the first key."""

    def __init__(self, others: Connections, role: Role | None = None, **uvicorns: Any):
        super().__init__(**uvicorns)
        self.role: Role | None = role
        self._others = others
        self._unheard = self._seen = b""
        self._size = 0
        self._limit: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:
        """Somebody comes."""
        super().connection_made(transport)
        self._others.add(self)
        self._limit_time()

    def connection_lost(self, exc: Exception | None) -> None:
        """It has ended, whoever ended it."""
        self._others.remove(self)
        self._unlimit_time()
        self._unset_keepalive_if_required()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Keep it for this connection's turn, and look whose it is."""
        self._size += len(data)
        if self._size > LARGEST:
            self.give_up()
            return
        self._unheard += data
        seen = self._seen + data[:LOOKED]
        self._seen = seen[-_SEEN:]
        role = self._others.gate.role_in(seen)
        if role not in (None, self.role):
            self._others.remove(self)
            self.role = role
            self._others.add(self)
        self.transport.pause_reading()
        self._others.wait(self)

    def hear(self) -> None:
        """What has come, as HTTP."""
        if self.transport.is_closing():
            return
        data, self._unheard = self._unheard, b""
        if data:
            self._unset_keepalive_if_required()
            self.conn.receive_data(data)
        super().handle_events()
        if self.cycle is not None:
            usual = self.server_state.default_headers
            self.cycle.default_headers = usual if self.role else [*usual, CLOSE_HEADER]
        if not self.flow.read_paused and (self.role is not None or self._begun()):
            self.transport.resume_reading()
        if self._begun():
            self._limit_time()
        elif self.role is not None:
            self._unlimit_time()

    def handle_events(self) -> None:
        """Another request may have come with the one that was answered; it waits for its turn as that one did."""
        if self._unheard or self.conn.trailing_data[0]:
            self.transport.pause_reading()
            self._others.wait(self)

    def on_response_complete(self) -> None:
        """A role's next request is counted from here."""
        if self.role is not None:
            self._size = 0
            self.timeout_keep_alive = _KEPT
        super().on_response_complete()

    def send_400_response(self, msg: str) -> None:
        """Say that this is no HTTP, if there is a way to say it; an answer that had begun is not gone on with."""
        if self.cycle is not None:
            self.cycle.disconnected = True
            self.cycle.message_event.set()
        try:
            super().send_400_response(msg)
        except h11.LocalProtocolError:
            self.give_up()

    def shutdown(self) -> None:
        """The server ends: nobody waits for the rest of a request."""
        if self._begun():
            self.give_up()
        else:
            super().shutdown()

    def give_up(self) -> None:
        """End it, whatever it is at."""
        self.transport.abort()

    def _begun(self) -> bool:
        """Whether a request has not come to its end, or not begun."""
        return self.conn.their_state in (h11.IDLE, h11.SEND_BODY)

    def _limit_time(self) -> None:
        if self._limit is None:
            self._limit = self.loop.call_later(PATIENCE, self.give_up)

    def _unlimit_time(self) -> None:
        if self._limit is not None:
            self._limit.cancel()
            self._limit = None
