"""The server of a session around a hub that does nothing, for tests of connections alone: no device, no disk."""

import contextlib
import socket
import threading
from pathlib import Path
from typing import Any

from hilbo.app.hub.hub import Hub
from hilbo.app.rehearsal.robot import Client
from hilbo.app.server import serve
from hilbo.app.wire.watchers import Watchers

__all__ = ["PATIENCE", "Bare", "connected", "request", "status", "until_closed", "until_words"]

PATIENCE = 10.0  # s: how long a test waits for what must come


class Nothing(Hub):
    """A hub that has no session; it says yes to every command."""

    def __init__(self):
        self.watchers, self._rig = Watchers(lambda: ""), None

    async def open(self) -> None:
        """Nothing to open."""

    async def close(self) -> None:
        """Nothing to close."""

    def publish(self) -> None:
        """No news."""

    def text(self, key: str) -> str:
        """No words but their key."""
        return key

    def view(self, role: str) -> dict[str, Any]:
        """What there is to see."""
        return {"role": role}

    async def command(self, what: str, message: Any) -> dict[str, Any]:
        """Done."""
        return {"done": what}


class Bare:
    """`with Bare(folder) as server:` - its place, and a client of each role."""

    def __init__(self, folder: Path):
        self.hub, self.folder = Nothing(), folder
        self.stop: Any = None

    def __enter__(self) -> "Bare":
        ready = threading.Event()
        self.place = serve.bound(0, keys=self.folder / "keys")
        self.port = int(self.place.hosts[0].rpartition(":")[2])

        def started(stop):
            self.stop = stop
            ready.set()

        self.thread = threading.Thread(target=serve.serve, args=(self.place, self.hub, started))
        self.thread.start()
        assert ready.wait(PATIENCE)
        links = self.place.links()
        self.participant, self.experimenter = Client(links["participant"]), Client(links["experimenter"])
        return self

    def __exit__(self, *_: Any) -> None:
        self.stop()
        self.thread.join(PATIENCE)
        assert not self.thread.is_alive()

    def stops(self, line: socket.socket | None = None) -> str:
        """An emergency stop on a connection, a new one if none is given: the words of the answer."""
        with contextlib.nullcontext(line) if line else connected(self.port) as used:
            used.sendall(request(self, "/api/experimenter/estop", self.experimenter._key, b"{}"))
            return until_words(used, b'{"done":"estop"}').decode()


def connected(port: int) -> socket.socket:
    """A connection of this computer's."""
    return socket.create_connection(("127.0.0.1", port), timeout=PATIENCE)


def request(server: Any, path: str, key: str = "", body: bytes | None = None, length: int | None = None) -> bytes:
    """A request as a program writes it; `length` is what it says of its body."""
    size = len(body or b"") if length is None else length
    head = f"{'GET' if body is None else 'POST'} {path} HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\n"
    head += f"Authorization: Bearer {key}\r\n" if key else ""
    head += f"Content-Length: {size}\r\n" if body is not None else ""
    return head.encode() + b"\r\n" + (body or b"")


def status(answer: str) -> int:
    """The status of an answer."""
    return int(answer.split()[1])


def until_words(line: socket.socket, words: bytes) -> bytes:
    """All that comes until these words have."""
    came = b""
    while words not in came:
        part = line.recv(65536)
        assert part, f"the connection ended after {came!r}"
        came += part
    return came


def until_closed(line: socket.socket) -> bytes:
    """All that comes until the other side ends the connection."""
    came = b""
    with contextlib.suppress(ConnectionError):
        while part := line.recv(65536):
            came += part
    return came
