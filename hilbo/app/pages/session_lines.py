"""Progress of a live session on the terminal of `hilbo session`.

A terminal may stop to take output (Ctrl-S, a pipe that is full), and a write then blocks. So a thread of its own
writes, and the session never waits for it.
"""

import contextlib
import sys
import threading
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from queue import SimpleQueue

from hilbo.app.pages.log_words import sentence
from hilbo.session.log.records import Event
from hilbo.session.log.state import LiveSession

__all__ = ["SessionLines", "line_of"]

_PARTS = 4  # of a session, after each of which there is a line


class SessionLines:
    """Called with the state before an event of the log, the event, and the state after it: writes a line on stderr for
    some of them (`line_of`), from a daemon thread. Never raises, and never waits for the terminal."""

    def __init__(self, study: Path, logs: Path, write: Callable[[str], None] | None = None) -> None:
        self._write = write or (lambda line: print(line, file=sys.stderr, flush=True))
        self._export = f"hilbo export {logs} --study {study} --out tables"
        self._events: SimpleQueue[tuple[LiveSession, Event, LiveSession]] = SimpleQueue()
        threading.Thread(target=self._work, name="session lines", daemon=True).start()

    def __call__(self, before: LiveSession, event: Event, after: LiveSession) -> None:
        self._events.put((before, event, after))

    def _work(self) -> None:
        """Write lines as events come. An error, as of a terminal that is gone, loses one line."""
        while True:
            before, event, after = self._events.get()
            with contextlib.suppress(Exception):
                if words := line_of(before, event, after, self._export):
                    self._write(f"{datetime.fromtimestamp(event.time):%H:%M:%S}      {words}")


def line_of(before: LiveSession, event: Event, after: LiveSession, export: str) -> str:
    """Sentence on an event: each new condition of the device, program or preparer, the first presentation, each quarter
    of the responses, a break, and the end of the trials; "" for other events. It names no parameter.

    `export`: the command that makes tables of the logs.
    """
    if after.screen == "done" and before.screen != "done":
        return f"No trial is left. Ctrl-C ends the server; then {export}"
    match event.kind:
        case "device" | "abort" | "pause" | "resume":
            return sentence(after, event)
        case "stimulus" if before.active is None:
            return "The participant has begun."
        case "answer":
            (was, _), (now, of) = _responses(before), _responses(after)
            return f"{now} of {of} responses." if _PARTS * now // of > _PARTS * was // of else ""
    return ""


def _responses(state: LiveSession) -> tuple[int, int]:
    """Responses so far, and those of the whole session, warm-ups included."""
    blocks = range(len(state.header.blocks))
    return sum(len(state.counted(i)) for i in blocks), sum(state.quota(i) for i in blocks)
