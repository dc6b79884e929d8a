"""Heartbeats that no computation delays: sent by a small process beside this one.

A Python process that imports or compiles can keep all of its threads waiting for a second or more, and a device that
hears nothing for 250 ms lets go. So a helper shares the line and writes the same frame to it every 50 ms. What the
heartbeats are for stays true: the helper ends at once when this process dies, however it dies, because its pipe ends
then; and when this process has given no sign of life for `GRACE`, because it hangs. A thread here gives those signs.

The helper is this file, run by itself: standard library only, and it knows nothing of the protocol. Where a line
cannot be shared (Windows, or a port without `fileno`) a thread of this process sends the heartbeats.
"""

import contextlib
import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

__all__ = ["BEAT", "GRACE", "HelperHeart", "ThreadHeart", "heart_for", "keep_beating"]

BEAT = 0.05  # s between heartbeats, and between signs of life
GRACE = 5.0  # s without a sign of life, after which the helper ends
_LINE_GONE = 3  # the helper's exit code then


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
    """The helper, which writes `frame` to the open file `line`; `ended` is called when it has ended by itself."""

    def __init__(self, line: int, frame: bytes, ended: Callable[[], Any]):
        command = [sys.executable, "-I", "-S", __file__, str(line), frame.hex(), str(GRACE)]
        pipe = subprocess.PIPE
        self.process = subprocess.Popen(command, stdin=pipe, stdout=pipe, bufsize=0, pass_fds=[line])
        self._ended = ended
        assert self.process.stdout is not None
        if not self.process.stdout.readline():  # it says when it has begun
            self._bury()
            raise OSError(f"{sys.executable} does not start")
        self._signs = ThreadHeart(self._sign)

    def close(self) -> None:
        """Returns after the last heartbeat."""
        self._signs.close()
        self._bury()

    def _sign(self) -> None:
        assert self.process.stdin is not None
        try:
            self.process.stdin.write(b".")
        except OSError:
            if self.process.wait() != _LINE_GONE:  # which the reading thread will find, and tell
                self._ended()
            raise

    def _bury(self) -> None:
        for pipe in (self.process.stdin, self.process.stdout):
            with contextlib.suppress(OSError):
                pipe.close()  # type: ignore[union-attr]
        self.process.wait()


def heart_for(port: Any, frame: bytes, beat: Callable[[], Any], ended: Callable[[], Any]) -> HelperHeart | ThreadHeart:
    """A beating heart for a port: the helper, or a thread that calls `beat` where the line cannot be shared.

    `ended` is called when the helper has ended by itself. Raises OSError where it cannot be started.
    """
    shared = os.name == "posix" and hasattr(port, "fileno") and sys.executable and not hasattr(sys, "frozen")
    return HelperHeart(port.fileno(), frame, ended) if shared else ThreadHeart(beat)


def keep_beating(line: int, frame: bytes, signs: int, grace: float) -> None:
    """The helper's life: `frame` to `line` every `BEAT`, until the pipe `signs` ends or has been silent for `grace` s.

    Raises OSError when the line is gone.
    """
    os.set_blocking(signs, False)
    parent, heard, due = os.getppid(), time.monotonic(), time.monotonic()
    while True:
        select.select([signs], [], [], max(0.0, due - time.monotonic()))
        with contextlib.suppress(BlockingIOError):
            while os.read(signs, 4096):
                heard = time.monotonic()
            return  # the pipe has ended
        now = time.monotonic()
        if os.getppid() != parent or now - heard > grace:  # another process may hold the pipe open
            return
        if now >= due:
            _write(line, frame)
            due = max(due + BEAT, now)


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
    line, frame, grace = int(sys.argv[1]), bytes.fromhex(sys.argv[2]), float(sys.argv[3])
    os.write(1, b"\n")
    try:
        keep_beating(line, frame, 0, grace)
    except OSError:
        sys.exit(_LINE_GONE)


if __name__ == "__main__":
    _main()
