"""A device on the terminal: its state, a live trace of force and position, and keys that switch between sets.

Shown on stderr: in place on a terminal, otherwise one line a second. Keys come from the terminal, or from a pipe, so
that scripts can do what a person does.
"""

import contextlib
import itertools
import os
import select
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np
from rich import box
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from hilbo.device.parameter_sets import InForce, ParameterSet
from hilbo.device.reasons import DeviceFlag, SampleFlag, held_because, meaning
from hilbo.errors import InputError
from hilbo.hardware_bridge import DeviceError, Renderer, State

__all__ = ["feel", "trace", "watch"]

_PAINT = 0.1  # s
_SHOWN = 4.0  # s of the trace
_BARS = " ▁▂▃▄▅▆▇█"
_KEYS = "123456789"
_PIPED = 5  # pictures from one key of a pipe to the next
_REPORTED = (
    *("tick", "position_mm", "force_N", "holds", "estops", "saturated", "slewed", "overruns", "frames_dropped"),
)


def trace(values: Any, width: int) -> str:
    """A line of `width` bars, from the lowest value to the highest, 0 included; each bar is the value farthest from 0
    of its share of the values. Values that are not finite are left out; without any the line is blank."""
    values = np.asarray(values, float)
    values = values[np.isfinite(values)]
    if values.size == 0:
        return " " * width
    low, high = min(values.min(), 0.0), max(values.max(), 0.0)
    shares = [share for share in np.array_split(values, min(width, values.size)) if share.size]
    peaks = np.array([share[np.argmax(np.abs(share))] for share in shares])
    levels = np.zeros(peaks.size) if high == low else (peaks - low) / (high - low)
    return "".join(_BARS[round(level * (len(_BARS) - 1))] for level in levels).rjust(width)


class _View:
    """Content of the screen: the last status, and the last seconds of telemetry."""

    def __init__(self, device: Renderer, title: str):
        self.device, self.title = device, title
        self.words: list[str] = []
        self.start_after: int | None = None  # the device's count of stops when the pending start was requested
        keep = round(_SHOWN / device.tick_s / max(1, device.divisor))
        self.position: deque[float] = deque(maxlen=keep)
        self.force: deque[float] = deque(maxlen=keep)
        self.seen, self.largest_N, self.flags = 0, 0.0, 0
        self.set: InForce | None = device.in_force()
        self.status = device.status()

    def refresh(self) -> None:
        """Read new samples, the status and the sentences that the device sent. Raises `DeviceError`."""
        new = self.device.samples(0.0)
        self.position.extend(new.position_mm)
        self.force.extend(new.force_N)
        self.seen += new.tick.size
        if new.tick.size:
            self.largest_N = max(self.largest_N, float(np.abs(new.force_N).max()))
            self.flags |= int(np.bitwise_or.reduce(new.flags))
        self.status = self.device.status()
        self.words.extend(self.device.events())

    def line(self) -> str:
        """The status as one line."""
        s = self.status
        state = meaning(State, s.state) + (f" ({held_because(s.hold_reason)})" if s.state >= State.HOLD else "")
        faults = ("" if s.flags & DeviceFlag.HOMED else "  not homed") + (
            "  hardware stop open" if s.flags & DeviceFlag.STOP_OPEN else ""
        )
        return f"tick {s.tick}  {state}  set {s.active_id}  {s.position_mm:8.3f} mm  {s.force_N:7.3f} N{faults}"

    def panel(self, width: int) -> Group:
        """The whole picture for a terminal that is `width` characters wide."""
        width = max(20, min(width - 26, 100))
        table = Table(box=box.SIMPLE_HEAD, show_header=False, pad_edge=False)
        table.add_row("", self.line())
        if self.set is not None:
            x = self.set
            words = f"K0 {x.K0:.4g}  K1 {x.K1:.4g}  B1 {x.B1:.4g}  alpha {x.alpha:.4g}  {x.memory} {x.length}"
            table.add_row("set", f"{words}  needs {x.needs:.3f} N·s/m")
        for name, values, unit in (("force", self.force, "N"), ("position", self.position, "mm")):
            ends = f"{min(values, default=0):.2f} to {max(values, default=0):.2f} {unit}"
            table.add_row(name, f"{trace(values, width)}  {ends}")
        s, counts = self.status, self.device.counts()
        marks = ", ".join(flag.name.lower() for flag in SampleFlag(self.flags) if flag.name) or "nothing"
        table.add_row("since", f"largest force {self.largest_N:.2f} N; {marks}")
        table.add_row(
            "counts",
            f"holds {s.holds}, e-stops {s.estops}, saturated {s.saturated}, slewed {s.slewed},"
            f" overruns {s.overruns}, longest delay {s.delay_us} us, frames lost {s.frames_dropped},"
            f" samples lost {counts.dropped + counts.missing}",
        )
        return Group(Text(self.title), table, *(Text(word) for word in self.words[-4:]))

    def summary(self) -> dict[str, Any]:
        """The content for `--json`: the last status, the set, and counts."""
        status = self.status
        return {
            "state": meaning(State, status.state),
            "reason": held_because(status.hold_reason) if status.state >= State.HOLD else "",
            **{name: getattr(status, name) for name in _REPORTED},
            "samples": self.seen,
            "largest_force_N": self.largest_N,
            "set": self.set._asdict() if self.set else None,
            **self.device.condition()._asdict(),
            "counts": self.device.counts()._asdict(),
        }


def watch(
    device: Renderer, seconds: float | None, title: str = "Ctrl-C ends", *, while_free: bool = False
) -> dict[str, Any]:
    """Show the device until Ctrl-C, or for so many `seconds` of its time (None: without end); `while_free`: only until
    it is in HOLD or ESTOP. Returns a summary."""
    view = _View(device, title)
    return _show(view, seconds, lambda: not while_free or view.status.state < State.HOLD)


def feel(device: Renderer, sets: Mapping[str, Mapping[str, Any]], seconds: float | None) -> dict[str, Any]:
    """Show the device and obey keys: 1 to 9 activate the sets, space starts and stops, e is the emergency stop, c
    clears, q ends. Returns the summary with the names of the sets felt and the messages. Ends also after `seconds` of
    the device's time. Raises `InputError` for no set, too many, or one that the device refuses, `DeviceError` if the
    line is lost."""
    if not sets or len(sets) > len(_KEYS):
        raise InputError(f"There are {len(sets)} sets; between 1 and {len(_KEYS)} can be felt, one on each key.")
    for values in sets.values():
        ParameterSet(**values).messages(device.device)  # reports errors now, and loads the modules of full memory
    names = list(sets)
    title = "  ".join(f"[{key}] {name}" for key, name in zip(_KEYS, names, strict=False))
    view = _View(device, f"{title}\nspace: start or stop   e: emergency stop   c: clear   q: end")
    felt: list[str] = []

    def obey(order: Callable[[], None]) -> None:
        try:
            order()
        except (DeviceError, InputError) as error:
            view.words.append(str(error))
            if device.link.lost:
                raise

    with _keyboard() as pressed:

        def go_on() -> bool:
            for key in pressed():
                if key == "q":
                    return False
                obey(partial(_press, device, view, key, names, sets, felt))
            if view.start_after is not None:
                obey(partial(_start_when_free, device, view))
            return True

        content = _show(view, seconds, go_on)
    return content | {"felt": felt, "words": view.words}


def _press(
    device: Renderer, view: _View, key: str, names: list[str], sets: Mapping[str, Mapping[str, Any]], felt: list[str]
) -> None:
    """Carry out a key; the name of a set that it activates is appended to `felt`. Space while stopped only requests
    the start, which `_start_when_free` carries out."""
    if key in _KEYS[: len(names)]:
        name = names[_KEYS.index(key)]
        view.set = device.send(**sets[name])
        felt.append(name)
        view.words.append(f'"{name}" is active')
    elif key == " " and view.start_after is None and device.state() == State.STOPPED:
        view.start_after = device.link.stops
        if device.status().contact:
            view.words.append("the handle is in the material; rendering starts when it leaves the surface")
    elif key == " ":
        view.start_after = None
        device.stop()
    elif key == "e":
        view.start_after = None
        device.estop()
    elif key == "c":
        device.clear()


def _start_when_free(device: Renderer, view: _View) -> None:
    """Carry out the start that was requested, unless the handle is in the material: then it stays requested."""
    stop, view.start_after = view.start_after, None
    try:
        device.start(stop=stop, wait=0.0)
    except DeviceError as error:
        if not error.in_contact:
            raise
        view.start_after = stop


def _show(view: _View, seconds: float | None, go_on: Callable[[], bool]) -> dict[str, Any]:
    """Update the view until `go_on` returns False, Ctrl-C, or `seconds` of the device's time (None: without end);
    returns its summary. In place on a terminal, else one line a second."""
    console = Console(stderr=True, highlight=False, markup=False)
    first, painted = view.status.tick, 0.0
    with contextlib.ExitStack() as stack:
        live = stack.enter_context(Live(console=console, refresh_per_second=10)) if console.is_terminal else None
        with contextlib.suppress(KeyboardInterrupt):
            while True:
                view.refresh()
                if live is not None:
                    live.update(view.panel(console.width))
                elif time.monotonic() - painted >= 1:
                    console.print(view.line())
                    painted = time.monotonic()
                over = seconds is not None and (view.status.tick - first) % 2**32 * view.device.tick_s >= seconds
                if over or not go_on():
                    break
                view.device.link.pause(_PAINT)
    if live is None:
        for word in view.words:
            console.print(word)
    return view.summary()


@contextlib.contextmanager
def _keyboard() -> Iterator[Callable[[], Iterator[str]]]:
    """A function that returns the keys pressed since the last call, without waiting; of a pipe one key at every fifth
    call, and "q" at its end. The terminal's mode is restored at the end. Raises `DeviceError` on a system without POSIX
    terminals."""
    if not sys.stdin.isatty():
        calls = itertools.count()
        yield lambda: iter("" if next(calls) % _PIPED else sys.stdin.read(1) or "q")
        return
    try:
        import termios
        import tty
    except ImportError as error:
        raise DeviceError("Keys need a POSIX terminal; use WSL, or pipe the keys in.") from error
    file = sys.stdin.fileno()
    before = termios.tcgetattr(file)
    tty.setcbreak(file)
    try:
        yield lambda: _waiting(file)
    finally:
        with contextlib.suppress(termios.error):  # a terminal that was closed has no mode
            termios.tcsetattr(file, termios.TCSADRAIN, before)


def _waiting(file: int) -> Iterator[str]:
    """The keys that were pressed in a terminal and not read yet; "q" if the terminal has been closed, so that no device
    moves without an operator."""
    while select.select([file], [], [], 0)[0]:
        try:
            data = os.read(file, 1)
        except OSError:  # as Linux reports a terminal that was closed
            data = b""
        yield data.decode(errors="replace") or "q"
        if not data:
            return
