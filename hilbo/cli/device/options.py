"""Options that the commands of `hilbo device` share: which device, and which parameter set.

`takes` gives a command the options of a group and hands it their values in one record. A failure of the device or the
line is one sentence and exit code 1; bad input, including refused numbers, is exit code 2 (`cli.main`).
"""

import contextlib
import functools
import inspect
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, BinaryIO, NamedTuple

import typer

from hilbo.cli.terminal.console import fail, orderly
from hilbo.errors import InputError

__all__ = [
    "Baud",
    "Chosen",
    "Line",
    "Sim",
    "Where",
    "chosen_set",
    "opened",
    "sets_of",
    "sim_options",
    "simulator",
    "takes",
]

Where = Annotated[str, typer.Option("--device", help='"sim", a serial port, or socket://host:port.')]
Baud = Annotated[int, typer.Option(min=1, help="Baud rate of a serial port.")]
Sim = Annotated[
    list[str] | None, typer.Option("--sim", help="KEY=VALUE of the simulated device, such as finger=sine; repeat.")
]

_Path = Path | None
_Number = float | None


class Line(NamedTuple):
    """The device and its line, and the damping that it must have."""

    device: Where = "sim"
    baud: Baud = 921_600
    sim: Sim = None
    study: Annotated[
        _Path, typer.Option("--study", help="Study file (TOML), whose damping must not exceed the device's.")
    ] = None
    damping: Annotated[_Number, typer.Option(help="Damping of the device, N.s/m; by default the study's.")] = None
    patience: Annotated[_Number, typer.Option(min=0.001, help="Time limit of a reply, s.")] = None
    capture: Annotated[_Path, typer.Option(help="Write the bytes that the device sends to this file.")] = None


class Chosen(NamedTuple):
    """One parameter set, by its numbers or from a table; all None: no set."""

    K0: Annotated[_Number, typer.Option("--K0", help="N/mm; by default from --K-eff.")] = None
    K1: Annotated[_Number, typer.Option("--K1", help="N/mm.")] = None
    B1: Annotated[_Number, typer.Option("--B1", help="N.s^alpha/mm.")] = None
    alpha: Annotated[_Number, typer.Option("--alpha", help="Order.")] = None
    K_eff: Annotated[_Number, typer.Option("--K-eff", help="Effective stiffness H(1), N/mm (0.44).")] = None
    N: Annotated[int | None, typer.Option("--N", help="Past samples of short memory (101).")] = None
    T: Annotated[_Number, typer.Option("--T", help="Sampling time, s (0.001).")] = None
    memory: Annotated[str | None, typer.Option(help='"short" (N samples) or "full".')] = None
    states: Annotated[int | None, typer.Option(help="Exponentials of full memory (10).")] = None
    force_limit: Annotated[_Number, typer.Option(help="N; by default that of the device.")] = None
    sets: Annotated[_Path, typer.Option("--sets", help="Sets table (CSV) to take the set from.")] = None
    set_: Annotated[str | None, typer.Option("--set", help="Which set of the table (set_id).")] = None


def takes(**groups: type) -> Callable:
    """A decorator that adds the options of these records (name of a parameter = NamedTuple) to a command, which gets
    the records themselves. A `DeviceError` of the command ends the process with one sentence and exit code 1."""

    def decorate(command: Callable) -> Callable:
        kept = [p for p in inspect.signature(command, eval_str=True).parameters.values() if p.name not in groups]
        added = [p for group in groups.values() for p in inspect.signature(group, eval_str=True).parameters.values()]
        parameters = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in kept + added]

        @functools.wraps(command)
        def run(**given: Any) -> None:
            records = {name: kind(**{f: given.pop(f) for f in kind._fields}) for name, kind in groups.items()}  # type: ignore[attr-defined]
            from hilbo.device.failures import DeviceError

            try:
                command(**given, **records)
            except DeviceError as error:
                fail(str(error), 1)

        run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        run.__annotations__ = {p.name: p.annotation for p in parameters}
        del run.__wrapped__
        return run

    return decorate


@contextlib.contextmanager
def opened(line: Line, **simulated: Any) -> Iterator[Any]:
    """A connected `Renderer`, stopped at the end also when the process is told to terminate; the device's notes are
    printed on stderr.

    `simulated` are options of the simulated device that suit the command, where the user gives no others. Raises
    `InputError`, and `DeviceError` for a device that fails or has too little damping.
    """
    from hilbo.hardware_bridge import Renderer

    mechanics = _mechanics(line)
    with contextlib.ExitStack() as stack:
        capture = stack.enter_context(_capture(line.capture)) if line.capture else None
        stack.enter_context(orderly())
        device = stack.enter_context(
            Renderer.open(
                line.device,
                damping=mechanics.damping if mechanics is not None and line.damping is None else line.damping,
                delay=None if mechanics is None else mechanics.delay,
                baud=line.baud,
                patience=line.patience,
                capture=capture.write if capture else None,
                options=(simulated if line.device == "sim" else {}) | sim_options(line.sim),
            )
        )
        simulator = ["this is the simulated device; --device PORT is a real one."] if line.device == "sim" else []
        for note in [*simulator, *device.notes]:
            print(f"hilbo: {note}", file=sys.stderr)
        yield device


def simulator(line: Line) -> Any:
    """A started simulated device without a connection to it. Raises `InputError` if a real device is named."""
    from hilbo.device.local.simulator import Simulator

    if line.device != "sim":
        raise InputError("Only the simulated device can be simulated; leave --device out.")
    return Simulator(**sim_options(line.sim))


_OF_A_SET = ("K0", "K1", "B1", "alpha", "N", "T", "memory", "states", "force_limit")


def chosen_set(chosen: Chosen, line: Line) -> dict[str, Any] | None:
    """The chosen set as arguments of `Renderer.send`, or None if none is chosen. Numbers given override those of the
    table. Raises `InputError` for a set that is incomplete or not in the table, and for a table of several without a
    name."""
    given = {name: value for name in _OF_A_SET if (value := getattr(chosen, name)) is not None}
    if chosen.sets is not None:
        named_sets = sets_of(chosen.sets, line, chosen.K_eff)
        if chosen.set_ is None and len(named_sets) > 1:
            raise InputError(f"{chosen.sets}: contains the sets {', '.join(named_sets)}; choose one with --set.")
        name = next(iter(named_sets)) if chosen.set_ is None else chosen.set_
        if name not in named_sets:
            raise InputError(f'{chosen.sets}: contains no set "{name}"; it has {", ".join(named_sets)}.')
        return named_sets[name] | given
    if not given and chosen.K_eff is None:
        return None
    for name in ("K1", "B1", "alpha"):
        if name not in given:
            raise InputError(f"--{name} is missing; a set has --K1, --B1 and --alpha, or --sets and --set.")
    return _whole(given, line, chosen.K_eff)


def sets_of(path: Path, line: Line, K_eff: float | None = None) -> dict[str, dict[str, Any]]:
    """Name -> set, as arguments of `Renderer.send`, for all sets of a table. Raises `InputError`."""
    from hilbo.study.tables.parameter_sets import read_sets

    return {
        name: _whole({key: value for key, value in values.items() if key in _OF_A_SET}, line, K_eff)
        for name, values in read_sets(path).items()
    }


def _whole(given: dict[str, Any], line: Line, K_eff: float | None) -> dict[str, Any]:
    """The set completed: N, T and memory from the study or the defaults, K0 (N/mm) from the effective stiffness
    `K_eff`, by default the study's or 0.44."""
    mechanics = _mechanics(line)
    values = {} if mechanics is None else {n: getattr(mechanics, n) for n in ("N", "T", "memory", "states")}
    values = {"N": 101, "T": 1e-3, "memory": "short"} | values | given
    if "K0" not in given:
        from hilbo.cli.terminal.console import start

        start()
        from hilbo.viscoelastic import K0_from_effective_stiffness

        static = (0.44 if mechanics is None else mechanics.K_eff) if K_eff is None else K_eff
        numbers = {name: values[name] for name in ("K1", "B1", "alpha", "N", "T", "memory")}
        values["K0"] = float(K0_from_effective_stiffness(**numbers, K_eff=static))
    return values


def _mechanics(line: Line) -> Any:
    """The mechanics of the study that is given, None without one. Raises `InputError` for a study without a
    [renderer]."""
    if line.study is None:
        return None
    from hilbo.study.file.reading import StudyFile

    mechanics = StudyFile.load(line.study).space.mechanics
    if mechanics is None:
        raise InputError(f"{line.study}: has no [renderer], and a device nothing to render.")
    return mechanics


def sim_options(pairs: list[str] | None) -> dict[str, Any]:
    """Options of the simulated device by name, from texts KEY=VALUE; yes and no become booleans. Raises `InputError`
    for other text."""
    options: dict[str, Any] = {}
    for pair in pairs or ():
        name, separator, value = pair.partition("=")
        if not separator or not name:
            raise InputError(
                f'--sim is "{pair}"; write KEY=VALUE, such as finger=sine or material=-2.89,5.7,5.89,.203,101.'
            )
        options[name] = {"yes": True, "no": False}.get(value, value)
    return options


@contextlib.contextmanager
def _capture(path: Path) -> Iterator[BinaryIO]:
    """A new binary file for the bytes of the line, closed at the end. Raises `InputError` if it exists or cannot be
    written."""
    try:
        file = open(path, "xb")  # noqa: SIM115
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); choose another --capture.") from error
    with file:
        yield file
