"""Starting and ending the server of a session: address, links, QR codes, signals.

The socket is bound before anything slow happens, so that a port in use is reported at once; requests are answered once
the hub is open.
"""

import asyncio
import base64
import contextlib
import functools
import io
import socket
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from hilbo.app.wire.security import Gate, Role, lan_addresses
from hilbo.errors import InputError

__all__ = ["PORT", "Place", "bound", "qr_image", "qr_text", "serve"]

PORT = 8642
_LINGER = 3  # s for pending responses when the server ends
_FILES = 512 if sys.platform == "win32" else 1024  # requested limit of open files: select() supports no more
_SWITCH = 0.0005  # s until the busy event loop lets another thread go on: a stop passes through three of them
_RESERVED = 160  # of them for connections that are served, the device, the log


class Place:
    """Where a session is served: a bound `socket`, its `gate` (keys are kept in the file `keys`), and links.
    `addresses`: of this computer in its networks, empty for a server that only this computer reaches."""

    def __init__(self, listening: socket.socket, addresses: list[str], keys: Path | None):
        number = listening.getsockname()[1]
        self.socket = listening
        self.hosts = [f"{host}:{number}" for host in ("127.0.0.1", "localhost", *addresses)]
        self._near, self._far = self.hosts[0], self.hosts[2] if addresses else self.hosts[0]
        self.gate = Gate(self.hosts, keys)

    def link(self, role: Role) -> str:
        """A new one-time link for a role, which voids the role's earlier unused one. The experimenter's is for this
        computer, the others' for the network if the server is in one."""
        host = self._near if role == "experimenter" else self._far
        return f"http://{host}/#{self.gate.invite(role)}"

    def links(self, roles: Iterable[Role] = ("participant", "experimenter")) -> dict[str, str]:
        """Role -> a new link, for each of the roles."""
        return {role: self.link(role) for role in roles}


def bound(port: int = PORT, *, lan: bool = False, keys: Path | None = None) -> Place:
    """Bind a socket to a port that no other program uses. Only this computer reaches it, with `lan` its networks too;
    port 0 is any free one; `keys` is the file of the keys.

    Raises `InputError` if the port is in use, or there is no network.
    """
    addresses = lan_addresses() if lan else []
    if lan and not addresses:
        raise InputError("--lan: this computer is in no network; connect it to one, or leave --lan out.")
    # With the protocol named, asyncio sets TCP_NODELAY on every connection; an answer's body waited 40 ms otherwise.
    listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind(("0.0.0.0" if lan else "127.0.0.1", port))
    except (OSError, OverflowError) as error:
        listening.close()
        raise InputError(
            f"--port {port}: cannot be used ({getattr(error, 'strerror', error)}); end the other session, or choose"
            " another --port."
        ) from error
    return Place(listening, addresses, keys)


def serve(place: Place, hub: Any, started: Callable[[Callable[[], None]], Any], tried: Any = None) -> None:
    """Open the hub, call `started(stop)`, answer requests until Ctrl-C, SIGTERM or a call of `stop`, then close the hub
    and the socket. `tried`: makes the data of the page of `hilbo try` (`Tried`), for that command.

    Returns after `stop`; a signal is raised again once the hub is closed: KeyboardInterrupt, or the process ends.
    Raises what keeps the hub from opening, `InputError` or `DeviceError`, and what `started` raises, with the hub
    closed; no request has been answered then. The interval of thread switches and the limit of open files stay changed.
    """
    from hilbo.app.server.admission import Listener

    sys.setswitchinterval(_SWITCH)
    server = _server(place.gate, hub, tried)
    admission = _Admission(server)
    listener = Listener(place.socket, place.gate, max(1, _files() - _RESERVED), admission.admit)
    _open_and_close(server, hub, listener, admission, started)
    try:
        # The default of Windows has no add_reader, which the listener needs.
        with asyncio.Runner(loop_factory=asyncio.SelectorEventLoop) as runner:
            runner.run(server.serve(sockets=[]))  # the listener has it
    finally:
        place.socket.close()


def _server(gate: Gate, hub: Any, tried: Any) -> Any:
    """A uvicorn server that answers for the hub, with the connections of `connections`."""
    import uvicorn

    from hilbo.app.server.connections import Connection, Connections
    from hilbo.app.server.server import application

    config = uvicorn.Config(
        application(hub, gate, tried), log_level="error", access_log=False, lifespan="off", server_header=False,
        timeout_graceful_shutdown=_LINGER, ws="none",
        http=functools.partial(Connection, Connections(gate)),  # type: ignore[arg-type]
    )  # fmt: skip
    return uvicorn.Server(config)


def _open_and_close(
    server: Any, hub: Any, listener: Any, admission: "_Admission", started: Callable[[Callable[[], None]], Any]
) -> None:
    """Replace the server's startup and shutdown, so that the hub is opened before requests are answered and closed
    after the last. Not as ASGI's lifespan, which swallows what the hub raises."""
    listen, hang_up = server.startup, server.shutdown

    async def startup(sockets=None):
        try:
            await hub.open()
            await listen(sockets=sockets)
            listener.open()
            if not server.should_exit:
                started(stop)
        except BaseException:
            await hub.close()
            raise

    async def shutdown(sockets=None):
        listener.close()
        hub.hang_up()
        await admission.settled()  # uvicorn ends those that it knows, and waits for all
        try:
            await hang_up(sockets=sockets)
        finally:
            await hub.close()

    def stop() -> None:
        server.should_exit = True

    server.startup, server.shutdown = startup, shutdown


class _Admission:
    """Hands accepted connections to uvicorn."""

    def __init__(self, server: Any):
        self._protocol = functools.partial(
            server.config.http, config=server.config, server_state=server.server_state, app_state=dict[str, Any]()
        )
        self._tasks: set[asyncio.Task] = set()

    def admit(self, line: socket.socket, role: Role | None) -> None:
        """Start to serve a connection; the role is that of the key which came with it, or None."""
        task = asyncio.get_running_loop().create_task(self._serve(line, role))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def settled(self) -> None:
        """Wait until each admitted connection is known to uvicorn, or has ended."""
        await asyncio.gather(*self._tasks)

    async def _serve(self, line: socket.socket, role: Role | None) -> None:
        """Have uvicorn's protocol take over the connection; one that has ended is ignored."""
        with contextlib.suppress(OSError):  # it has ended meanwhile
            loop = asyncio.get_running_loop()
            await loop.connect_accepted_socket(functools.partial(self._protocol, role=role), line)


def _files() -> int:
    """How many files this process may have open, after the limit was raised to `_FILES` as far as possible."""
    try:
        import resource
    except ImportError:  # Windows has no such limit
        return _FILES
    now, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    if now == resource.RLIM_INFINITY or now >= _FILES:
        return _FILES
    wanted = _FILES if most == resource.RLIM_INFINITY else min(_FILES, most)
    resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, most))
    return wanted


def qr_image(link: str) -> str:
    """A QR code of a link as an SVG in a data: URI."""
    import segno

    file = io.BytesIO()
    segno.make(link, error="m").save(file, kind="svg", scale=4, border=3, xmldecl=False, svgns=True)
    return "data:image/svg+xml;base64," + base64.b64encode(file.getvalue()).decode()


def qr_text(link: str) -> str:
    """A QR code of a link as lines of characters, for a terminal."""
    import segno

    file = io.StringIO()
    segno.make(link, error="l").terminal(file, border=2, compact=True)
    return file.getvalue()
