"""A line to a simulated device whose delay can be changed while it is used, and that sees what the device really does.

Nothing is lost: what is written comes out later, in order. The relay reads the device's telemetry on its own side, so
that a test knows the device's ticks, however late its host hears of them.
"""

import contextlib
import os
import socket
import termios
import threading
import time
import tty
from collections import deque

from hilbo.device import messages, protocol
from hilbo.device.frames import Receiver, WireError, decoded_frame

__all__ = ["SlowLine"]


class SlowLine:
    """`with SlowLine(pty) as line:` - `line.where` is the address for a host; `line.delay` is in s, each way.

    Until `deaf_until` (monotonic, s) what either side sends is lost, as by a board that starts. `lose` is a class of
    requests that never arrive; a host writes whole frames.
    """

    def __init__(self, pty: str):
        self.delay, self.deaf_until = 0.0, 0.0
        self.lose: type | None = None
        self.samples: list[tuple[int, float, int]] = []  # tick, force (N), flags
        self._file = os.open(pty, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self._file, termios.TCSANOW)
        self._server = socket.create_server(("127.0.0.1", 0))
        self.where = f"socket://127.0.0.1:{self._server.getsockname()[1]}"
        self._receiver = Receiver()
        self._over = threading.Event()

    def __enter__(self) -> "SlowLine":
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_) -> None:
        self._over.set()
        with contextlib.suppress(OSError):
            self._server.shutdown(socket.SHUT_RDWR)  # ends an accept
        self._server.close()
        self._thread.join()
        os.close(self._file)

    @property
    def tick(self) -> int:
        """The newest tick that the device has told."""
        return self.samples[-1][0] if self.samples else 0

    def after(self, tick: int) -> list[tuple[int, float, int]]:
        """The samples after a tick."""
        return [sample for sample in self.samples if sample[0] > tick]

    def _serve(self) -> None:
        try:
            host, _ = self._server.accept()
        except OSError:  # nobody came
            return
        host.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        host.settimeout(0.002)
        os.set_blocking(self._file, False)
        ways: tuple[deque, deque] = deque(), deque()
        with host, contextlib.suppress(OSError):
            while not self._over.is_set():
                now = time.monotonic()
                with contextlib.suppress(TimeoutError):
                    data = host.recv(4096)
                    if not data:
                        return
                    ways[0].append((now + self.delay, self._kept(data)))
                with contextlib.suppress(BlockingIOError):
                    data = os.read(self._file, 4096)
                    self._see(data)
                    ways[1].append((now + self.delay, data))
                self._pass_on(ways, host)

    def _pass_on(self, ways, host) -> None:
        for way, send in zip(ways, (lambda data: os.write(self._file, data), host.sendall), strict=True):
            while way and way[0][0] <= time.monotonic():
                _, data = way.popleft()
                if time.monotonic() >= self.deaf_until:
                    send(data)

    def _kept(self, data: bytes) -> bytes:
        """The bytes of a host without the requests that are lost."""
        if self.lose is None:
            return data
        frames = [part for part in data.split(b"\0") if part]
        return b"".join(part + b"\0" for part in frames if decoded_frame(part).type != messages.code_of(self.lose))

    def _see(self, data: bytes) -> None:
        for frame in self._receiver.feed(data):
            with contextlib.suppress(WireError):
                message = protocol.decode(frame)
                if isinstance(message, messages.Telemetry):
                    self.samples += [
                        (message.tick + i * message.divisor, sample.force_N, sample.flags)
                        for i, sample in enumerate(message.samples)
                    ]
