"""Ask and tell with a log: a session in a notebook or a script, by the code of live sessions.

    with LoggedSession.open("logs", study, header_for(study.file, "P01", seed=1, warm=False)) as session:
        while (point := session.ask()) is not None:
            session.tell(felt(point))

An existing log with the same header is resumed, with exactly the same next rendering, also after the study file has
changed in what responses do not depend on.
"""

import os
import time
from pathlib import Path

from msgspec.structs import replace

from hilbo.errors import InputError
from hilbo.session.choose.look_ahead import LiveChooser
from hilbo.session.log import actions as live
from hilbo.session.log.event_log import EventLog
from hilbo.session.log.header_check import protocol_of
from hilbo.session.log.log_files import begun, check_alone, check_new, log_name
from hilbo.session.log.records import Header
from hilbo.session.log.state import LiveSession
from hilbo.study.config import Study

__all__ = ["LoggedSession"]


class LoggedSession:
    """An open session; created by `open`. `dropped`: sentence on an incomplete last line of a resumed log, or ""."""

    def __init__(self, log: EventLog, chooser: LiveChooser) -> None:
        self.log, self.chooser, self.dropped = log, chooser, log.dropped

    @classmethod
    def open(cls, folder: str | os.PathLike, study: Study, header: Header) -> "LoggedSession":
        """Begin a session in `folder`, or resume the one with this participant and label, with the study file that it
        was begun with; the log is locked until `close`.

        Raises InputError if the log was begun with another header, is in use or damaged, or another session of the
        participant is running; a log created by this call is then deleted.
        """
        path = Path(folder) / log_name(header)
        new = not begun(path)
        if new:
            check_new(path, header)
        log = EventLog.create(path, study.file, header) if new else EventLog.resume(path, study.file)
        try:
            check_alone(path, log.state.header)
        except InputError:
            log.close()
            if new:
                path.unlink()
            raise
        if not _asked_alike(log.state.header, header):
            log.close()
            raise InputError(f"{path}: was begun with another seed, plan or sets; give those, or another label.")
        return cls(log, LiveChooser(log.state))

    @property
    def state(self) -> LiveSession:
        """The state of the session so far."""
        return self.log.state

    def ask(self) -> dict[str, float] | None:
        """The rendering to present: parameter -> value in physical units; None at the end. Logs the proposal, and
        passes rests and ends of warm-ups. Comparisons have two renderings: see `state.pending.renderings`."""
        while self.state.screen in ("ready", "rest"):
            self.log.append(live.go_on(self.state, time.time()))
        if self.state.need is not None:
            self.log.append(live.propose(self.state, self.chooser, time.time()))
        return None if self.state.pending is None else self.state.pending.renderings["a"]

    def tell(self, response: str, **others: str) -> None:
        """Log the answer to the pending trial. `response` answers the first question of its phase, `others` the further
        ones of a comparison, by name: class_b, preferred.

        Raises `InputError` if nothing has been asked, and RefusedError for an answer that is not valid.
        """
        trial = self.state.pending
        if trial is None:
            raise InputError("there is no pending trial; call ask() first.")
        asks = protocol_of(self.state.study, self.state.header.blocks[trial.block]).asks
        values = {asks[0]: response} | others
        event = live.answer(self.state, trial.id, f"script-{trial.id}", values, time.time(), felt=False)
        assert event is not None  # the trial is pending
        self.log.append(event)

    def close(self) -> None:
        """Close the log, which ends its lock."""
        self.log.close()

    def __enter__(self) -> "LoggedSession":
        return self

    def __exit__(self, *_) -> None:
        self.close()


def _asked_alike(begun: Header, header: Header) -> bool:
    """Whether the header of a log is the one that is asked for. Of another version of the study file, what that
    determines is not compared: language, warm-up, and numbers of trials that are chosen."""

    def fixed(of: Header) -> Header:
        blocks = tuple(replace(block, count=0, rest=0.0) for block in of.blocks if block.phase != "warm-up")
        sets = {name: values for name, values in of.sets.items() if not name.startswith("warm-up ")}
        return replace(of, study="", study_tables={}, language="", versions={}, blocks=blocks, sets=sets)

    if begun.study == header.study:
        return replace(begun, study_tables={}) == replace(header, study_tables={})
    return fixed(begun) == fixed(header)
