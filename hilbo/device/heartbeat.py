"""Heartbeats that no computation delays, each with the last tick that came back: sent by a small process of their own.

The device's watchdog watches the round trip: a heartbeat feeds it as far as the tick in it is fresh. A Python process
that imports or compiles can keep all of its threads waiting for a second or more, in which it would neither send nor
hear. So a helper process shares the line: it reads everything that arrives, passes it on through a pipe, and writes a
heartbeat every 50 ms. The helper ends at once when this process dies, however it dies, because its own pipe ends then;
and when this process has given no sign of life for `GRACE`, because it hangs. A thread here gives those signs.

The helper is this file, run by itself: standard library, and the frame codec beside it. Where a line cannot be shared
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
    from frames import Frame, Receiver, closed  # type: ignore[import-not-found]
else:
    from hilbo.device.frames import Frame, Receiver, closed

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
_ALIVE, _QUIET, _LOUD = b".", b"-", b"+"  # what this process writes to the helper
_LINE_GONE = 3  # the helper's exit code then
_MOST_WAITING = 1 << 20  # bytes for a host that reads nothing; what comes after them is dropped


class Heard:
    """The newest tick of the device that has come back, from the bytes that arrive; `tick` is known at the start."""

    def __init__(self, tick: int):
        self.tick, self._receiver = tick, Receiver()

    def feed(self, data: bytes) -> None:
        """Bytes from the line."""
        for frame in self._receiver.feed(data):
            if frame.type in WITH_TICK and len(frame.payload) >= 4:
                self.newer(int.from_bytes(frame.payload[:4], "little"))

    def newer(self, tick: int) -> None:
        """A tick that came back; ticks count modulo 2^32."""
        if (tick - self.tick) % 2**32 < 2**31:
            self.tick = tick


class ThreadHeart:
    """A thread that calls `beat` every `BEAT` seconds until it raises OSError, or `close`."""

    def __init__(self, beat: Callable[[], Any]):
        self._beat, self._closing = beat, threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Returns after the last beat."""
        self._closing.set()
        if self._thread is not threading.current_thread():
            self._thread.join()

    def _run(self) -> None:
        with contextlib.suppress(OSError):
            while not self._closing.is_set():
                self._beat()
                self._closing.wait(BEAT)


class HelperHeart:
    """The helper on the open file `line`, for a start of the device and the last tick heard of it.

    As long as it lives nobody else may read the line: `read` has what arrives. `ended` is called when the helper has
    ended by itself. Raises OSError where it does not start.
    """

    def __init__(self, line: int, boot_id: int, tick: int, ended: Callable[[], Any]):
        command = [sys.executable, "-I", "-S", __file__, str(line), str(boot_id), str(tick), str(GRACE)]
        pipe = subprocess.PIPE
        self.process = subprocess.Popen(command, stdin=pipe, stdout=pipe, bufsize=0, pass_fds=[line])
        self._ended, self._drained = ended, threading.Event()
        assert self.process.stdout is not None
        if not self.process.stdout.readline():  # it says when it has begun
            self._drained.set()
            self._bury()
            raise OSError(f"{sys.executable} does not start")
        self._signs = ThreadHeart(self._sign)

    def read(self, patience: float) -> bytes | None:
        """What has arrived on the line within `patience` s; None once the helper has ended and all of it is read."""
        pipe = self.process.stdout
        assert pipe is not None
        if self._drained.is_set():
            return None
        try:
            if not select.select([pipe], [], [], patience)[0]:
                return b""
            data = os.read(pipe.fileno(), 65536)
        except (OSError, ValueError):  # closed meanwhile
            data = b""
        if not data:
            self._drained.set()
        return data or None

    def hush(self, quiet: bool) -> None:
        """No heartbeats from now on, or heartbeats again; the helper goes on reading."""
        assert self.process.stdin is not None
        with contextlib.suppress(OSError, ValueError):  # it has ended, and its heartbeats with it
            self.process.stdin.write(_QUIET if quiet else _LOUD)

    def close(self, reader: threading.Thread) -> None:
        """Returns after the last heartbeat, and once `reader`, which calls `read`, has read the rest."""
        self._signs.close()
        assert self.process.stdin is not None
        with contextlib.suppress(OSError):
            self.process.stdin.close()
        give_up = time.monotonic() + GRACE
        while reader is not threading.current_thread() and reader.is_alive() and time.monotonic() < give_up:
            if self._drained.wait(0.02):  # a reader that ends reads no more
                break
        self._drained.set()
        self._bury()

    def _sign(self) -> None:
        assert self.process.stdin is not None
        try:
            self.process.stdin.write(_ALIVE)
        except (OSError, ValueError):
            if self.process.wait() != _LINE_GONE:  # which the reading thread will find, and tell
                self._ended()
            raise OSError("the helper has ended") from None

    def _bury(self) -> None:
        for pipe in (self.process.stdin, self.process.stdout):
            with contextlib.suppress(OSError):
                pipe.close()  # type: ignore[union-attr]
        self.process.wait()


def heart_for(
    port: Any, boot_id: int, tick: int, beat: Callable[[], Any], ended: Callable[[], Any]
) -> HelperHeart | ThreadHeart:
    """A beating heart for a port: the helper, or a thread that calls `beat` where the line cannot be shared.

    `ended` is called when the helper has ended by itself. Raises OSError where it cannot be started.
    """
    shared = os.name == "posix" and hasattr(port, "fileno") and sys.executable and not hasattr(sys, "frozen")
    return HelperHeart(port.fileno(), boot_id, tick, ended) if shared else ThreadHeart(beat)


def keep_beating(line: int, boot_id: int, tick: int, signs: int, out: int, grace: float) -> None:
    """The helper's life: heartbeats to `line` and what it brings to `out`, until the pipe `signs` ends or has been
    silent for `grace` s. Raises OSError when the line is gone."""
    for number in (line, signs, out):
        os.set_blocking(number, False)
    parent, alive, due, heard, waiting = os.getppid(), time.monotonic(), time.monotonic(), Heard(tick), b""
    quiet = False
    while True:
        reading, writing = [signs, line], [out] if waiting else []
        ready = select.select(reading, writing, [], max(0.0, due - time.monotonic()))[0]
        if signs in ready:
            came = _told(signs)
            if not came:
                _pass_on(out, waiting, grace)
                return
            alive, last = time.monotonic(), came.replace(_ALIVE, b"")[-1:]
            quiet = last == _QUIET if last else quiet
        if line in ready:
            data = _arrived(line)
            heard.feed(data)
            waiting += data if len(waiting) < _MOST_WAITING else b""
        waiting = _pass_on(out, waiting)
        now = time.monotonic()
        if os.getppid() != parent or now - alive > grace:  # another process may hold the pipe open
            return
        if now >= due:
            if not quiet:
                _write(line, closed(Frame(HEARTBEAT, 0, struct.pack("<II", boot_id, heard.tick))))
            due = max(due + BEAT, now)


def _told(signs: int) -> bytes:
    """What the host has written to its pipe, where there is something to read; empty at its end."""
    with contextlib.suppress(BlockingIOError):
        return os.read(signs, 4096)
    return _ALIVE


def _arrived(line: int) -> bytes:
    """What the line has brought. Raises OSError where it has ended."""
    try:
        data = os.read(line, 65536)
    except BlockingIOError:
        return b""
    if not data:
        raise OSError("the line has ended")
    return data


def _pass_on(out: int, waiting: bytes, patience: float = 0.0) -> bytes:
    """What `out` does not take now, nor within `patience` s of taking something."""
    while waiting:
        try:
            waiting = waiting[os.write(out, waiting) :]
        except BlockingIOError:
            if not select.select([], [out], [], patience)[1]:
                break
        except OSError:  # the host reads no more
            return b""
    return waiting


def _write(line: int, frame: bytes) -> None:
    """The frame; where the line is full, none: the next one is as good. A begun one is ended, if it can be soon."""
    rest = frame
    while rest:
        try:
            rest = rest[os.write(line, rest) :]
        except BlockingIOError:
            if rest is frame or not select.select([], [line], [], BEAT)[1]:
                return


def _main() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the host, which stops the device and ends this
    line, boot_id, tick, grace = int(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4])
    os.write(1, b"\n")
    try:
        keep_beating(line, boot_id, tick, 0, 1, grace)
    except OSError:
        sys.exit(_LINE_GONE)


if __name__ == "__main__":
    _main()
