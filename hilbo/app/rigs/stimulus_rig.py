"""A rig that is a program with its own link, or a person with the preparer's page: orders to it, and its reports.

    program --> hello, then reports --> this rig --> orders, one at a time, each with its own number

The response to each message is the newest order (`orders`). The program reports which order it knows and what it has
done about it; it reports again and again, which is its sign of life. All of it happens in the event loop.
docs/guides/stimulus.md has every message.
"""

import asyncio
import contextlib
import secrets
import time
from collections.abc import Callable, Mapping
from typing import Any

from hilbo.app.rigs.orders import Order, as_sent, parameters_of
from hilbo.app.rigs.rig import Loaded, MissedError, Showing, Snapshot
from hilbo.app.wire.messages import Hello, Report
from hilbo.errors import InputError
from hilbo.session.log.header_check import study_of
from hilbo.session.log.presented import check_confirmed, in_numbers
from hilbo.session.log.records import RefusedError
from hilbo.study.file.reading import StudyFile

__all__ = ["OverError", "StimulusRig"]

_TRAVEL = 0.5  # s that a message there and back may take, and a busy computer
_NOBODY = {"stimulus": "No program that presents has joined yet.", "preparer": "The preparer has not joined yet."}
_HEARD = (
    "A program that joined by this link is still heard; end that one. {name} can begin once it has been silent for"
    " {silence:g} s."
)
_WAIT = 5.0  # s that a program which joins may be kept waiting: clients wait for 10
_TURN = 0.1  # s in which the timer of a silence has its turn
_PART = 3  # a request waits for at most this fraction of the silence limit


class OverError(InputError):
    """A report that is refused though it was understood: it came late, twice, or from another run.

    `standing`: the current order as a message, where the run is the right one; else empty.
    """

    standing: Mapping[str, Any] = {}


class StimulusRig:
    """The program or person that presents a study's renderings. `changed` is called with each new snapshot; `tag` is
    the prefix of the trials' names."""

    simulated = False

    def __init__(
        self,
        study: StudyFile,
        tag: str,
        changed: Callable[[Snapshot], Any] = lambda _: None,
        notice: Callable[[str], Any] = lambda _: None,
    ):
        assert study.stimulus is not None  # no other program presents
        self._study, self._table, self._tag, self._changed = study, study.stimulus, tag, changed
        self.role = study.stimulus.role
        self.title = self.role.capitalize()
        self.notes: list[str] = []
        self.order = Order(1, "neutral")
        self.snapshot = Snapshot("WAITING", False, _NOBODY[self.role], excused=True)
        self._hello: Hello | None = None
        self._run, self._key = "", ""  # of the program that presents; no run while there is none
        self._news, self._moved = asyncio.Event(), asyncio.Event()
        self._confirmation: asyncio.Future[Loaded] | None = None  # what the present order's confirmation settles
        # The confirmation that was accepted last: number of its order, and values.
        self._accepted: tuple[int, Mapping[str, float | str] | None] | None = None
        self._since = 0.0  # when the present order was given, monotonic
        self._stop_s: float | None = None  # s that the stop took when it was measured
        self._timers: dict[str, asyncio.TimerHandle] = {}
        self._refused = ""  # last rejected report, until one is accepted
        self._ended = False

    @property
    def words(self) -> str:
        """Name, version and force of the program, and how fast it stopped, in words."""
        said = self._hello
        if self.role == "preparer":
            return "a person presents, by hand"
        if said is None:
            return "a program that has not joined yet"
        stop = "" if self._stop_s is None else f", stopped within {1000 * self._stop_s:.0f} ms"
        return f"{said.name} {said.version}, {'force' if said.force else 'no force'}{stop}"

    # Messages of the program.

    async def hello(self, hello: Hello, key: str = "") -> dict[str, Any]:
        """Accept a program that joins with a `key`, in place of any other, and return the new run, the limits, the
        parameters and the first order: a stop, whose duration is measured.

        Raises `OverError` while another program with the same key is heard: each would be back at once after the other.
        A preparer's page can always be replaced.
        """
        another = self.role == "stimulus" and key == self._key and hello.run != self._run
        if self._run and another:
            raise OverError(_HEARD.format(name=hello.name, silence=self._table.silence))
        if self._run:
            self._drop_program("Another program has taken over the presentation.")
        self._hello, self._run, self._key, self._stop_s = hello, secrets.token_urlsafe(12), key, None
        self._update(self.snapshot._replace(lost=f"{hello.name} has joined; its stop is being tested."))
        self._order("stop")
        self._restart_silence()
        limits = {"silence_s": self._table.silence, "within_s": self._table.within}
        study = {"study": self._study.name, "parameters": parameters_of(self._study)}
        return {"run": self._run, **limits, **study, **self._current_order()}

    async def free(self) -> bool:
        """Whether no program presents; waits for the present one to fall silent, at most as long as it may be silent,
        and 5 s."""
        end = time.monotonic() + min(self._table.silence + _TURN, _WAIT)
        while self._run and (left := end - time.monotonic()) > 0:
            await self._wait_for(self._moved, left)
        return not self._run

    async def report(self, report: Report) -> dict[str, Any]:
        """Apply a program's report, and return the current order as a message: at once if the program does not know it,
        else when there is a newer one, or after the report's `wait_s` (at most a third of the silence allowed).

        Raises `OverError`; one about the order is also shown to the experimenter.
        """
        if not self._run or report.run != self._run:
            raise OverError("This run is not the current one; send hello first, or end.")
        self._restart_silence()
        try:
            self._apply(report)
        except OverError as error:
            self._refused, error.standing = str(error), self._current_order()
            self._update(self.snapshot)
            raise
        wait = min(report.wait_s, self._table.silence / _PART)
        if report.order == self.order.number and wait and not self._ended:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._news.wait(), wait)
        return self._current_order()

    def _apply(self, report: Report) -> None:
        """Apply a report: contact, and the state of the current order. Raises `OverError` for an order that is not
        there yet, or a confirmation that comes too late or does not fit."""
        order = self.order
        if report.order > order.number:
            raise OverError(f"There is no order {report.order} yet; the newest is {order.number}.")
        self._update(self.snapshot._replace(contact=report.contact))
        if report.order < order.number:
            if report.state == "presented" and (self._accepted is None or self._accepted[0] < report.order):
                raise OverError(f"Order {report.order} is over, its confirmation comes too late; now it is another.")
            return
        if report.state == "presented":
            self._confirm(order, report)
        elif report.state == "neutral":
            self._neutral(order)
        elif report.state == "failed":
            self._reject(f"failed: {report.why or 'the program gives no reason'}")

    def _confirm(self, order: Order, report: Report) -> None:
        """Accept that the order's step is presented, which ends `show`; the same confirmation again changes nothing. A
        value beyond the tolerance fails `show`. Raises `OverError` for that, and for all that does not fit the
        order."""
        if order.do != "present" or order.showing is None:
            raise OverError(f"Order {order.number} is {order.do}; there is nothing to present.")
        if report.trial != order.trial:
            raise OverError(f'Order {order.number} is about trial "{order.trial}", and no other.')
        if self._accepted is not None and self._accepted[0] == order.number:
            if self._accepted[1] != report.values and report.values is not None:
                raise OverError(f"Order {order.number} was confirmed with other values before; those count.")
            return
        values: Mapping[str, Any] | None = report.values
        asked = order.showing.values
        if asked is None and values:
            raise OverError(f"Order {order.number} is to show the {order.showing.show}, which has no values.")
        try:
            if asked is not None:
                here = study_of(self._study, order.showing.material)
                values = in_numbers(here, report.values)
                check_confirmed(here, asked, values)
        except RefusedError as error:
            if error.code == "off":
                self._reject(f"off: {error}")
            raise OverError(str(error)) from None
        self._accepted, self._refused = (order.number, report.values), ""
        if self._confirmation is not None and not self._confirmation.done():
            took = time.monotonic() - self._since
            self._confirmation.set_result(Loaded({"values": values, "took_s": took, **self._program_facts()}, took))

    def _neutral(self, order: Order) -> None:
        """Record that the program presents nothing, which acknowledges a stop: the first one, after hello, makes the
        program available; the duration of each is kept. Nothing while `order` is to present."""
        self._cancel_timer("neutral")
        if order.do == "present":
            return
        if order.do == "stop" and self.snapshot.state != "ESTOP":  # the one to see that it does
            self._stop_s = time.monotonic() - self._since
            facts = self._program_facts() | {"stop_s": self._stop_s}
            self._update(Snapshot("STOPPED", self.snapshot.contact, None, facts=facts))
            self._order("neutral")
        elif self.snapshot.state == "RUNNING":
            self._update(self.snapshot._replace(state="STOPPED"))
        elif order.do == "stop" and self._stop_s is None:
            self._stop_s = time.monotonic() - self._since
            self._update(self.snapshot._replace(facts=self._program_facts() | {"stop_s": self._stop_s}))
        self._moved.set()

    def _reject(self, why: str) -> None:
        """Fail the confirmation that `show` awaits with `MissedError`, which voids the trial."""
        if self._confirmation is not None and not self._confirmation.done():
            self._confirmation.set_exception(MissedError(why))

    # What the session wants.

    async def prepare(self, showing: Showing) -> None:
        """Do nothing, and return None: a program is ordered when it is to present, and not before."""

    def telemetry(self, trial: int, presentation: int) -> None:
        """None: a program sends no telemetry."""

    async def show(self, showing: Showing) -> Loaded | None:
        """Order a step and wait for its confirmation; a program that exerts force is ordered once nothing touches it.

        None for a neutral interval and for the reference. Raises `MissedError`, and orders neutral, if the confirmation
        does not come in time or is off; `RuntimeError` if the program is lost or stopped.
        """
        self._check_present()
        if showing.show == "neutral":
            await self.blank()
            return None
        while self._has_force and self.snapshot.contact:
            await self._wait_for(self._moved)
            self._check_present()
        name = f"{self._tag}:{showing.trial}.{showing.presentation}"
        self._confirmation = asyncio.get_running_loop().create_future()
        self._order("present", showing, name)
        self._update(self.snapshot._replace(state="RUNNING"))
        try:
            confirmed = await asyncio.wait_for(self._confirmation, self._table.within)
        except TimeoutError:
            self._order("neutral")
            raise MissedError(f"late: nothing was confirmed within {self._table.within:g} s") from None
        except MissedError:
            self._order("neutral")
            raise
        finally:
            self._confirmation = None
        return None if showing.values is None else confirmed

    async def blank(self) -> None:
        """Order the neutral state, if a step is presented."""
        if self.order.do == "present":
            self._order("neutral")

    rest = blank

    async def estop(self) -> None:
        """Order a stop and wait for its acknowledgement. Raises `RuntimeError` if no program is there, or that does not
        come in time."""
        if self.snapshot.lost:
            raise RuntimeError(self.snapshot.lost)
        assert self._hello is not None
        self._update(
            self.snapshot._replace(state="ESTOP", reason="stopped by the experimenter", facts=self._program_facts())
        )
        self._stop_s = None
        self._abort_confirmation("stopped by the experimenter")
        self._order("stop")
        end = time.monotonic() + self._hello.neutral_within_s + _TRAVEL
        while self._stop_s is None:
            if time.monotonic() > end:
                what = "use the hardware switch" if self._has_force else "look at it"
                raise RuntimeError(f"it has not acknowledged the stop; {what}.")
            await self._wait_for(self._moved, end - time.monotonic())

    async def clear(self) -> None:
        """Leave an acknowledged stop; nothing without a stop. Raises `RuntimeError` before the acknowledgement, or if
        no program is there."""
        self._check_present()
        if self.snapshot.state == "ESTOP":
            if self._stop_s is None:
                raise RuntimeError("The stop has not been acknowledged; nothing goes on before that.")
            self._update(self.snapshot._replace(state="STOPPED", reason=""))
            self._order("neutral")

    def hang_up(self) -> None:
        """Order the neutral state, which ends waiting requests, and cancel all timers."""
        self._ended = True
        self._order("neutral")
        for what in list(self._timers):
            self._cancel_timer(what)

    def close(self) -> None:
        """Do nothing: a program that gets no answers goes neutral by itself."""

    # How long things may take.

    def _order(self, do: str, showing: Showing | None = None, trial: str = "") -> None:
        """Give the next order, `do` being "present", "neutral" or "stop", the first with `showing` and the trial's
        name. At the others a program with force, and at "stop" any, is dropped unless it reports neutral in time."""
        if self.order.do != "present" or do != "present":
            self._cancel_timer("neutral")
        self._replace_order(Order(self.order.number + 1, do, showing, trial))
        program = self._hello
        if program is not None and do != "present" and (program.force or do == "stop"):
            words = f"{program.name} has not confirmed neutral within {program.neutral_within_s:g} s of the order."
            self._start_timer("neutral", program.neutral_within_s + _TRAVEL, words)

    def _restart_silence(self) -> None:
        """Restart the timer that drops a silent program."""
        said = self._hello
        words = f"{said.name if said else 'The program'} has been silent for {self._table.silence:g} s."
        self._start_timer("silence", self._table.silence, words)

    def _start_timer(self, what: str, seconds: float, words: str) -> None:
        """Drop the program after `seconds`, for the reason `words`, unless the timer `what` is cancelled or restarted
        before."""
        self._cancel_timer(what)
        if not self._ended:
            self._timers[what] = asyncio.get_running_loop().call_later(seconds, self._drop_program, words)

    def _cancel_timer(self, what: str) -> None:
        """Cancel the timer `what`, if it runs."""
        timer = self._timers.pop(what, None)
        if timer is not None:
            timer.cancel()

    def _drop_program(self, words: str) -> None:
        """Drop the program, for the reason `words`: it is lost until it says hello again, `show` fails, and the order
        is neutral."""
        for what in list(self._timers):
            self._cancel_timer(what)
        self._run = ""
        self._abort_confirmation(words)
        self._replace_order(Order(self.order.number + 1, "neutral"))
        self._update(
            self.snapshot._replace(lost=words, state="LOST", contact=False, facts=self._program_facts(), excused=False)
        )

    def _abort_confirmation(self, words: str) -> None:
        """Fail the confirmation that `show` awaits with `RuntimeError`, which voids no trial."""
        if self._confirmation is not None and not self._confirmation.done():
            self._confirmation.set_exception(RuntimeError(words))

    def _replace_order(self, order: Order) -> None:
        """Make this the current order, and wake requests that wait for one."""
        self.order, self._since = order, time.monotonic()
        self._news.set()
        self._news = asyncio.Event()

    def _check_present(self) -> None:
        """Raise `RuntimeError` while no program is there."""
        if self.snapshot.lost:
            raise RuntimeError(self.snapshot.lost)

    async def _wait_for(self, event: asyncio.Event, seconds: float = 1.0) -> None:
        """Clear the event, and wait until it is set, at most `seconds`."""
        event.clear()
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(event.wait(), seconds)

    def _update(self, seen: Snapshot) -> None:
        """Set the snapshot, with rows for the experimenter, and call `changed` if it differs from the last."""
        rows = (("Contact", "yes" if seen.contact else "no"),) if self._has_force else ()
        seen = seen._replace(rows=(*rows, ("Refused", self._refused)) if self._refused else rows)
        before, self.snapshot = self.snapshot, seen
        if seen != before:
            self._moved.set()
            self._changed(seen)

    @property
    def _has_force(self) -> bool:
        """Whether the program says that it exerts force; False before one has joined."""
        return self._hello is not None and self._hello.force

    def _current_order(self) -> dict[str, Any]:
        """The current order as a message."""
        return as_sent(self.order, self._study, self._tag)

    def _program_facts(self) -> dict[str, Any]:
        """Name, version and force of the program for the log; empty before the first has joined."""
        program = self._hello
        return {} if program is None else {"program": program.name, "version": program.version, "force": program.force}
