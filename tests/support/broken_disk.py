"""Processes that are killed at a change of the disk, and several that take turns there, all in this process.

A process here is a function in a thread of its own: at each change of the disk it may be killed, which ends it without
any of its clean-up reaching the disk, or another process goes on.
"""

import builtins
import contextlib
import errno
import io
import os
import random
import threading
import time
from collections.abc import Callable, Iterator

__all__ = ["Killed", "Process", "changes", "patched_disk", "together"]

_CHANGES = ("link", "replace", "rename", "unlink", "remove", "mkdir", "rmdir", "chmod", "ftruncate", "write")
_running: dict[int, "Process"] = {}


class Killed(BaseException):
    """SIGKILL: nothing that is done on the way out changes the disk any more."""


class Process:
    """Runs a function until it ends, or until its change number `last` (from 0), before which it is killed."""

    def __init__(self, function: Callable[[], object], last: int | None = None, turn: Callable[[], None] | None = None):
        self.changes, self.killed = 0, False
        self._function, self._last, self._turn, self._open = function, last, turn or (lambda: None), set()

    def run(self) -> bool:
        """Whether it ended by itself. Raises what the function raises."""
        _running[threading.get_ident()] = self
        try:
            self._function()
        except Killed:
            self.killed = True
        finally:
            del _running[threading.get_ident()]
            for file in self._open:  # the system closes them, and with them locks go
                os.close(file)
        return not self.killed

    def pause(self) -> None:
        """Let others go on."""
        self._turn()

    def change(self) -> None:
        """Called before each change of the disk."""
        self._turn()
        if self._last is not None and self.changes >= self._last:
            raise Killed
        self.changes += 1

    def opened(self, file: int) -> None:
        self._open.add(file)

    def closed(self, file: int) -> None:
        self._open.discard(file)


@contextlib.contextmanager
def patched_disk() -> Iterator[None]:
    """Everything that changes the disk asks the process that runs it first."""
    before = {name: getattr(os, name) for name in (*_CHANGES, "open", "close")}
    sleep, builtin, io_open = time.sleep, builtins.open, io.open

    def asking(real):
        def changing(*arguments, **options):
            if process := _running.get(threading.get_ident()):
                process.change()
            return real(*arguments, **options)

        return changing

    def opening(path, flags, *arguments, **options):
        process = _running.get(threading.get_ident())
        if process and flags & os.O_CREAT:
            process.change()
        file = before["open"](path, flags, *arguments, **options)
        if process:
            process.opened(file)
        return file

    def closing(file):
        before["close"](file)
        if process := _running.get(threading.get_ident()):
            process.closed(file)

    def writing(file, mode="r", *arguments, **options):
        process = _running.get(threading.get_ident())
        if process and set(mode) & set("wxa") and isinstance(file, str | os.PathLike):
            process.change()
            io_open(file, mode, *arguments, **options).close()
            process.change()  # killed with nothing in it yet
        return io_open(file, mode, *arguments, **options)

    def sleeping(seconds):
        process = _running.get(threading.get_ident())
        process.pause() if process else sleep(seconds)

    for name in _CHANGES:
        setattr(os, name, asking(before[name]))
    os.open, os.close, time.sleep, builtins.open, io.open = opening, closing, sleeping, writing, writing
    try:
        yield
    finally:
        for name, real in before.items():
            setattr(os, name, real)
        time.sleep, builtins.open, io.open = sleep, builtin, io_open


def changes(function: Callable[[], object]) -> int:
    """How many changes of the disk a function makes when nothing ends it."""
    process = Process(function)
    with patched_disk():
        process.run()
    return process.changes


def together(rng: random.Random, functions: list[Callable[[Callable[[], None]], None]]) -> None:
    """Run functions at once; after each step a random one goes on. Each is given what lets others go on, which it hands
    to its processes. Raises what the first that failed raised."""
    ready, alive, failures = threading.Condition(), list(range(len(functions))), []
    state = {"turn": rng.choice(alive)}

    def wait(number: int) -> None:
        with ready:
            state["turn"] = rng.choice(alive)
            ready.notify_all()
            if not ready.wait_for(lambda: state["turn"] == number, 30):
                raise TimeoutError(errno.ETIMEDOUT)

    def run(number: int) -> None:
        try:
            with ready:
                ready.wait_for(lambda: state["turn"] == number, 30)
            functions[number](lambda: wait(number))
        except BaseException as error:
            failures.append(error)
        finally:
            with ready:
                alive.remove(number)
                state["turn"] = rng.choice(alive) if alive else -1
                ready.notify_all()

    threads = [threading.Thread(target=run, args=(number,)) for number in alive]
    with patched_disk():
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    if failures:
        raise failures[0]
