"""Heartbeats that are independent of the load of this process, sent by a small helper process.

The device's watchdog checks the round trip: a heartbeat counts only if the device tick in it is recent. A Python
process that imports or compiles can block all of its threads for a second or more, during which it would neither send
nor receive. So a helper process shares the line: it reads everything that arrives, passes it on through a pipe, and
writes a heartbeat every 50 ms, each with the last tick received. The helper ends at once when this process dies,
because its pipe ends then; and when this process has sent no sign of life for `GRACE`, because it hangs. A thread in
this process sends those signs.

The helper is this file, run by itself: standard library, and the frame codec next to it. Where a line cannot be shared
(Windows, or a port without `fileno`) a thread of this process sends the heartbeats, and the link itself reads.
"""

import contextlib
import os
import select
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

if __name__ == "__main__":
    sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
    from frames import Frame, Receiver, encoded_frame  # type: ignore[import-not-found]
else:
    from hilbo.device.frames import Frame, Receiver, encoded_frame

__all__ = [
    "BEAT",
    "GRACE",
    "HEARTBEAT",
    "WITH_TICK",
    "Heard",
    "HelperHeart",
    "ThreadHeart",
    "heart_for",
    "keep_beating",
]

BEAT = 0.05  # s between heartbeats, and between signs of life
GRACE = 5.0  # s without a sign of life, after which the helper ends
HEARTBEAT = 0x0E
WITH_TICK = frozenset({0x45, 0x47, 0x48, 0x4A})  # STATUS, NOTICE, TELEMETRY, PULSE begin with the device's tick
_ALIVE, _QUIET, _LOUD = b".", b"-", b"+"  # bytes that this process writes to the helper
_LINE_GONE = 3  # exit code of the helper when the line is lost
_MOST_WAITING = 1 << 20  # bytes buffered for a host that does not read; later ones are dropped


class Heard:
    """Newest device tick in the bytes received; `tick` is its initial value."""

    def __init__(self, tick: int):
        self.tick, self._receiver = tick, Receiver()

    def feed(self, data: bytes) -> None:
        """Process bytes received on the line: store the newest device tick in their complete frames."""
        for frame in self._receiver.feed(data):
            if frame.type in WITH_TICK and len(frame.payload) >= 4:
                self.newer(int.from_bytes(frame.payload[:4], "little"))

    def newer(self, tick: int) -> None:
        """Store a received tick if it is newer than the stored one, modulo 2^32."""
        if (tick - self.tick) % 2**32 < 2**31:
            self.tick = tick


class ThreadHeart:
    """Thread that calls `beat` every `BEAT` seconds until `close`, or until `beat` raises OSError."""

    def __init__(self, beat: Callable[[], Any]):
        self._beat, self._closing = beat, threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the thread, and return after its last beat (at once if called from that thread)."""
        self._closing.set()
        if self._thread is not threading.current_thread():
            self._thread.join()

    def _run(self) -> None:
        """Call `beat` every `BEAT` seconds until closed, or until it raises OSError."""
        with contextlib.suppress(OSError):
            while not self._closing.is_set():
                self._beat()
                self._closing.wait(BEAT)


class HelperHeart:
    """Helper process that reads the line and sends heartbeats for one start of the device (`boot_id`).

    `line`: file descriptor of the open line; `tick`: last tick received. While it runs, no other process may read the
    line; `read` returns what arrives. `ended` is called if the helper ends by itself. Raises OSError if it does not
    start.
    """

    def __init__(self, line: int, boot_id: int, tick: int, ended: Callable[[], Any]):
        command = [sys.executable, "-I", "-S", __file__, str(line), str(boot_id), str(tick), str(GRACE)]
        pipe = subprocess.PIPE
        self.process = subprocess.Popen(command, stdin=pipe, stdout=pipe, bufsize=0, pass_fds=[line])
        self._ended, self._drained = ended, threading.Event()
        assert self.process.stdout is not None
        if not self.process.stdout.readline():  # the helper writes a line when it has started
            self._drained.set()
            self._reap()
            raise OSError(f"{sys.executable} does not start")
        self._signs = ThreadHeart(self._sign)

    def read(self, timeout: float) -> bytes | None:
        """Return the bytes that arrived on the line within `timeout` s; empty if there are none, None once the helper
        has ended and all of its output is read."""
        pipe = self.process.stdout
        assert pipe is not None
        if self._drained.is_set():
            return None
        try:
            if not select.select([pipe], [], [], timeout)[0]:
                return b""
            data = os.read(pipe.fileno(), 65536)
        except (OSError, ValueError):  # closed meanwhile
            data = b""
        if not data:
            self._drained.set()
        return data or None

    def hush(self, quiet: bool) -> None:
        """Pause the heartbeats (`quiet`) or resume them; the helper goes on reading."""
        assert self.process.stdin is not None
        with contextlib.suppress(OSError, ValueError):  # it has ended, and its heartbeats with it
            self.process.stdin.write(_QUIET if quiet else _LOUD)

    def close(self, reader: threading.Thread) -> None:
        """End the helper process.

        Returns after its last heartbeat, and once the thread `reader`, which calls `read`, has read the rest or ended,
        for which it waits up to `GRACE`.
        """
        self._signs.close()
        assert self.process.stdin is not None
        with contextlib.suppress(OSError):
            self.process.stdin.close()
        give_up = time.monotonic() + GRACE
        while reader is not threading.current_thread() and reader.is_alive() and time.monotonic() < give_up:
            if self._drained.wait(0.02):  # a reader that ends reads no more
                break
        self._drained.set()
        self._reap()

    def _sign(self) -> None:
        """Write a sign of life to the helper.

        If the helper has ended, call `ended`, except where the line is lost, and raise OSError.
        """
        assert self.process.stdin is not None
        try:
            self.process.stdin.write(_ALIVE)
        except (OSError, ValueError):
            if self.process.wait() != _LINE_GONE:  # which the reading thread reports
                self._ended()
            raise OSError("the helper has ended") from None

    def _reap(self) -> None:
        """Close the pipes to the helper and wait for its process to end."""
        for pipe in (self.process.stdin, self.process.stdout):
            with contextlib.suppress(OSError):
                pipe.close()  # type: ignore[union-attr]
        self.process.wait()


def heart_for(
    port: Any, boot_id: int, tick: int, beat: Callable[[], Any], ended: Callable[[], Any]
) -> HelperHeart | ThreadHeart:
    """Start and return the heartbeats of a port: a helper process, or a thread that calls `beat` if the line cannot be
    shared.

    `ended` is called if the helper ends by itself. Raises OSError if the helper cannot be started.
    """
    shared = os.name == "posix" and hasattr(port, "fileno") and sys.executable and not hasattr(sys, "frozen")
    return HelperHeart(port.fileno(), boot_id, tick, ended) if shared else ThreadHeart(beat)


def keep_beating(line: int, boot_id: int, tick: int, signs: int, out: int, grace: float) -> None:
    """Main loop of the helper process: send heartbeats to `line` and copy what arrives there to `out`.

    `line`, `signs`, `out` are file descriptors, `tick` is the last tick received. Returns when the pipe `signs` ends or
    has been silent for `grace` s, or the parent process has ended. Raises OSError if the line is lost.
    """
    for number in (line, signs, out):
        os.set_blocking(number, False)
    parent, alive, due, heard, waiting = os.getppid(), time.monotonic(), time.monotonic(), Heard(tick), b""
    quiet = False
    while True:
        reading, writing = [signs, line], [out] if waiting else []
        ready = select.select(reading, writing, [], max(0.0, due - time.monotonic()))[0]
        if signs in ready:
            received = _read_signs(signs)
            if not received:
                _pass_on(out, waiting, grace)
                return
            alive, last = time.monotonic(), received.replace(_ALIVE, b"")[-1:]
            quiet = last == _QUIET if last else quiet
        if line in ready:
            data = _read_line(line)
            heard.feed(data)
            waiting += data if len(waiting) < _MOST_WAITING else b""
        waiting = _pass_on(out, waiting)
        now = time.monotonic()
        if os.getppid() != parent or now - alive > grace:  # the pipe may be open in another process
            return
        if now >= due:
            if not quiet:
                _write(line, encoded_frame(Frame(HEARTBEAT, 0, struct.pack("<II", boot_id, heard.tick))))
            due = max(due + BEAT, now)


def _read_signs(signs: int) -> bytes:
    """Read the waiting signs of life from the pipe; empty at its end, one sign if nothing is waiting."""
    with contextlib.suppress(BlockingIOError):
        return os.read(signs, 4096)
    return _ALIVE


def _read_line(line: int) -> bytes:
    """Read the bytes that are waiting on the line; empty if there are none. Raises OSError if the line has ended."""
    try:
        data = os.read(line, 65536)
    except BlockingIOError:
        return b""
    if not data:
        raise OSError("the line has ended")
    return data


def _pass_on(out: int, waiting: bytes, timeout: float = 0.0) -> bytes:
    """Write the bytes `waiting` to `out`, waiting up to `timeout` s when it is full, and return those that are still to
    be written; empty if the host has closed the pipe."""
    while waiting:
        try:
            waiting = waiting[os.write(out, waiting) :]
        except BlockingIOError:
            if not select.select([], [out], [], timeout)[1]:
                break
        except OSError:  # the host reads no more
            return b""
    return waiting


def _write(line: int, frame: bytes) -> None:
    """Write a heartbeat frame to the line; skip it if the line is full.

    The rest of a frame that is partly written is written if the line takes it within a beat. Raises OSError if the line
    is lost.
    """
    rest = frame
    while rest:
        try:
            rest = rest[os.write(line, rest) :]
        except BlockingIOError:
            if rest is frame or not select.select([], [line], [], BEAT)[1]:
                return


def _main() -> None:
    """Entry point of the helper process, with the arguments line, boot_id, tick and grace; ends with exit code 3 if the
    line is lost."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the host handles Ctrl-C: it stops the device and ends the helper
    line, boot_id, tick, grace = int(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4])
    os.write(1, b"\n")
    try:
        keep_beating(line, boot_id, tick, 0, 1, grace)
    except OSError:
        sys.exit(_LINE_GONE)


if __name__ == "__main__":
    _main()
