"""Connections to the server and their limits, so that holders of a key are always served.

A connection is a stranger's until a role's key has come in on it. Strangers and each role have separate limits for
the number of connections; the oldest of too many is closed. The experimenter is served at once; stimulus programs,
preparers, participants and strangers by round robin, request by request. A stranger's connection ends with its first
response. A request has `PATIENCE` s and `LARGEST` bytes, header and body, and so has all of a stranger's connection.

uvicorn and h11 do the rest; without this, they would wait for a header for ever, and read a body of any size.
"""

import asyncio
from typing import Any, get_args

import h11
from uvicorn.protocols.http.flow_control import CLOSE_HEADER
from uvicorn.protocols.http.h11_impl import H11Protocol

from hilbo.app.server.round_robin import RoundRobin
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
        self._queues = RoundRobin(lambda connection, _: connection.process())

    def add(self, connection: "Connection") -> None:
        """Add a connection, new or with a new role; if its role has too many, the oldest is closed."""
        mine = self._open[connection.role]
        mine[connection] = None
        if len(mine) > _MOST[connection.role]:
            oldest = next(iter(mine))
            self.remove(oldest)
            oldest.abort()

    def remove(self, connection: "Connection") -> None:
        """Remove a connection that has ended, or changes its role, from its role and its queue; it is not closed."""
        self._open[connection.role].pop(connection, None)
        self._queues.remove(connection)

    def wait(self, connection: "Connection") -> None:
        """Have its data processed: at once for the experimenter, else when its queue comes to it."""
        if connection.role == "experimenter":
            connection.process()
        else:
            self._queues.add(connection, connection.role)


class Connection(H11Protocol):
    """One connection, which reads no more data before those it has were processed. `role`: that of the newest key in
    its data, None for a stranger. Its methods are called by asyncio and uvicorn."""

    def __init__(self, others: Connections, role: Role | None = None, **uvicorns: Any):
        super().__init__(**uvicorns)
        self.role: Role | None = role
        self._others = others
        self._unprocessed = self._seen = b""
        self._size = 0
        self._limit: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:
        """The connection begins: it is counted, and its timer starts."""
        super().connection_made(transport)
        self._others.add(self)
        self._start_timer()

    def connection_lost(self, exc: Exception | None) -> None:
        """The connection has ended: it is no longer counted."""
        self._others.remove(self)
        self._stop_timer()
        self._unset_keepalive_if_required()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Keep the data until the connection is served, and take on the role of a key in them; close a connection with
        more than `LARGEST` bytes in a request."""
        self._size += len(data)
        if self._size > LARGEST:
            self.abort()
            return
        self._unprocessed += data
        seen = self._seen + data[:LOOKED]
        self._seen = seen[-_SEEN:]
        role = self._others.gate.role_in(seen)
        if role not in (None, self.role):
            self._others.remove(self)
            self.role = role
            self._others.add(self)
        self.transport.pause_reading()
        self._others.wait(self)

    def process(self) -> None:
        """Process the data received so far as HTTP; called when it is the connection's turn."""
        if self.transport.is_closing():
            return
        data, self._unprocessed = self._unprocessed, b""
        if data:
            self._unset_keepalive_if_required()
            self.conn.receive_data(data)
        super().handle_events()
        if self.cycle is not None:
            usual = self.server_state.default_headers
            self.cycle.default_headers = usual if self.role else [*usual, CLOSE_HEADER]
        if not self.flow.read_paused and (self.role is not None or self._incomplete()):
            self.transport.resume_reading()
        if self._incomplete():
            self._start_timer()
        elif self.role is not None:
            self._stop_timer()

    def handle_events(self) -> None:
        """After a response: queue a further request that came with the one answered, like any other."""
        if self._unprocessed or self.conn.trailing_data[0]:
            self.transport.pause_reading()
            self._others.wait(self)

    def on_response_complete(self) -> None:
        """Reset the count of bytes for a role's next request, and keep its connection open for `_KEPT` s."""
        if self.role is not None:
            self._size = 0
            self.timeout_keep_alive = _KEPT
        super().on_response_complete()

    def send_400_response(self, msg: str) -> None:
        """Report invalid HTTP, where that is possible; a response that had begun is abandoned."""
        if self.cycle is not None:
            self.cycle.disconnected = True
            self.cycle.message_event.set()
        try:
            super().send_400_response(msg)
        except h11.LocalProtocolError:
            self.abort()

    def shutdown(self) -> None:
        """The server ends: close at once if a request is incomplete or none has begun, else after the response."""
        if self._incomplete():
            self.abort()
        else:
            super().shutdown()

    def abort(self) -> None:
        """Close the connection at once, without a response."""
        self.transport.abort()

    def _incomplete(self) -> bool:
        """Whether a request is incomplete, or none has begun."""
        return self.conn.their_state in (h11.IDLE, h11.SEND_BODY)

    def _start_timer(self) -> None:
        """Close the connection after `PATIENCE` s, unless the timer runs already or is stopped before."""
        if self._limit is None:
            self._limit = self.loop.call_later(PATIENCE, self.abort)

    def _stop_timer(self) -> None:
        """Cancel the timer of `_start_timer`, if it runs."""
        if self._limit is not None:
            self._limit.cancel()
            self._limit = None
