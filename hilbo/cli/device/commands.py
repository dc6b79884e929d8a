"""The commands of `hilbo device`: a rendering device on a line, or a simulated one.

Results on stdout (`--json` for machines), progress and warnings on stderr. Exit code 0: done, 1: the device or the line
failed, 2: bad usage or bad input, including numbers that the device refuses. The device is stopped at the end of every
command.
"""

import contextlib
import json
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from hilbo.cli.device import commission, measure
from hilbo.cli.device.options import Chosen, Line, chosen_set, opened, sets_of, takes
from hilbo.cli.device.output import condition_words, decoded, said, set_words
from hilbo.cli.terminal.console import ForceFile, JsonToo, fail, print_result
from hilbo.cli.terminal.new_file import check_free, new_file
from hilbo.errors import InputError

__all__ = ["app"]


app = typer.Typer(
    no_args_is_help=True, rich_markup_mode="markdown", help="Haptic device: connect, send sets, feel, measure."
)
for name, command in (measure.COMMANDS | commission.COMMANDS).items():
    app.command(name)(command)

_LEAVES = 10.0  # s for a handle that is pressed to leave
_PIECE = 1.0  # s of a recording between two writes to its file

Seconds = Annotated[float | None, typer.Option(help="End after this device time, s.")]


@app.command()
def ports(as_json: JsonToo = False) -> None:
    """List the serial ports of this computer."""
    from hilbo.device.ports import list_ports

    serial_ports = list_ports()
    words = "\n".join(f"{port.name}  {port.description}" for port in serial_ports) or "There is no serial port."
    print_result([port._asdict() for port in serial_ports], words, as_json)


@app.command()
@takes(line=Line)
def hello(line: Line, as_json: JsonToo = False) -> None:
    """Identify the device: version, limits, damping, stroke, capabilities, and the active set."""
    from dataclasses import asdict

    from hilbo.device.reasons import Capability

    with opened(line) as device:
        about = asdict(device.device)
        in_force = device.in_force()
        condition = device.condition()
        can = [flag.name.lower() for flag in Capability(about["capabilities"]) if flag.name]
        content = about | {
            "can": can,
            **condition._asdict(),
            "limits": device.limits(),
            "telemetry_divisor": device.divisor,
            "in_force": in_force and in_force._asdict(),
        }
    limits = ", ".join(f"{name} {low:g} to {high:g}" for name, (low, high) in content["limits"].items())
    rows = [f"{name:26} {said(name, value)}" for name, value in about.items()]
    rows += [f"{'can':26} {', '.join(can)}", condition_words(condition)]
    now = set_words(in_force) if in_force else "none"
    words = "\n".join([*rows, f"limits  {limits}", f"in force  {now}"])
    print_result(content, words, as_json)


@app.command("set")
@takes(chosen=Chosen, line=Line)
def set_(chosen: Chosen, line: Line, as_json: JsonToo = False) -> None:
    """Activate a set, read it back bit for bit, and print it. Nothing is started."""
    wanted = chosen_set(chosen, line)
    if wanted is None:
        raise InputError("No set is given; a set has --K1, --B1 and --alpha, or --sets and --set.")
    with opened(line) as device:
        in_force = device.send(**wanted)
    print_result(in_force._asdict(), f"in force: {set_words(in_force)}", as_json)


@app.command()
@takes(chosen=Chosen, line=Line)
def start(chosen: Chosen, line: Line, seconds: Seconds = None, as_json: JsonToo = False) -> None:
    """Render the active set, or the given one, until Ctrl-C; then stop.

    Ends at once, with the reason and exit code 1, if the device goes to HOLD or ESTOP.
    """
    from hilbo.cli.device.screen import watch

    wanted = chosen_set(chosen, line)
    with opened(line) as device:
        _begin(device, wanted)
        content = watch(device, seconds, "rendering; Ctrl-C stops", while_free=True)
    print_result(content, "", as_json)
    if content["state"] in ("HOLD", "ESTOP"):
        words = f"The device has gone to {content['state']} by itself: {content['reason']}"
        fail(f"{words}; find out why, then clear it.", 1)


@app.command()
@takes(line=Line)
def stop(line: Line, as_json: JsonToo = False) -> None:
    """Ramp the force to zero, even if another program started it, and confirm. Needs --device."""
    _at_once(line, "Stop", as_json)


@app.command()
@takes(line=Line)
def estop(line: Line, as_json: JsonToo = False) -> None:
    """Force to zero at once, latched until `clear`. Needs --device."""
    _at_once(line, "Estop", as_json)


@app.command()
@takes(line=Line)
def clear(line: Line, as_json: JsonToo = False) -> None:
    """Leave HOLD or ESTOP, once the reason is understood, and print the state."""
    with opened(line) as device:
        device.clear()
        state = device.state().name
    print_result({"state": state}, f"the device is {state}", as_json)


@app.command()
@takes(line=Line)
def monitor(line: Line, seconds: Seconds = None, as_json: JsonToo = False) -> None:
    """Show state, force and position as they change, until Ctrl-C. Nothing is started."""
    from hilbo.cli.device.screen import watch

    with opened(line) as device:
        content = watch(device, seconds)
    print_result(content, "", as_json)


@app.command()
@takes(chosen=Chosen, line=Line)
def record(
    out: Annotated[Path, typer.Argument(help="CSV file to write.", show_default=False)],
    chosen: Chosen,
    line: Line,
    seconds: Annotated[float, typer.Option(min=0.001, help="Duration in device time, s.")] = 5.0,
    render: Annotated[bool, typer.Option("--render/--no-render", help="Start the set first, and stop after.")] = True,
    force: ForceFile = False,
    as_json: JsonToo = False,
) -> None:
    """Write telemetry to a CSV file: tick, time_s, position_mm, force_N, sensed_N, flags. Ctrl-C ends it earlier.

    If the device or the line fails, the file has the samples until then, and the exit code is 1.
    """
    from hilbo.device.failures import DeviceError

    check_free(out, force)
    wanted = chosen_set(chosen, line)
    with opened(line) as device:
        if render:
            _begin(device, wanted)
        device.samples(0.0)
        with new_file(out, force) as path:
            samples, ended = _recorded(device, seconds, path)
            if not samples:
                raise ended or KeyboardInterrupt
        if ended is not None:
            raise DeviceError(f"{ended} {out} contains the {samples} samples until then.") from ended
        state, counts = device.state().name, device.counts()
    content = {"file": str(out), "samples": samples, "state": state, "counts": counts._asdict()}
    print_result(content, f"{out}: {samples} samples", as_json)


def _recorded(device: Any, seconds: float, path: Path) -> tuple[int, Exception | None]:
    """Write samples to a CSV file as they arrive, for `seconds` of the device's time or until Ctrl-C: their number, and
    the `DeviceError` that ended it, or None."""
    from hilbo.device.failures import DeviceError

    samples, begun, ticks = 0, None, seconds / device.tick_s
    with path.open("w", encoding="utf-8", newline="") as file, contextlib.suppress(KeyboardInterrupt):
        while True:
            try:
                piece = device.samples(min(_PIECE, seconds))
            except DeviceError as error:
                return samples, error
            begun = int(piece.tick[0]) if begun is None else begun
            piece.table(device.tick_s, begun).to_csv(file, index=False, header=samples == 0)
            samples += len(piece.tick)
            if piece.tick[-1] + 1 - begun >= ticks:
                break
    return samples, None


@app.command()
def decode(
    capture: Annotated[Path, typer.Argument(help="Bytes of a line, as --capture writes them.", show_default=False)],
    as_json: JsonToo = False,
) -> None:
    """Print every frame of a file of captured bytes, and the errors of damaged ones."""
    from dataclasses import asdict

    from hilbo.device.frames import WireError
    from hilbo.device.messages import name_of
    from hilbo.device.protocol import frames_in

    try:
        data = capture.read_bytes()
    except OSError as error:
        raise InputError(f"{capture}: cannot be read ({error.strerror}).") from error
    rows: list[dict[str, Any]] = []
    for place, message, frame in frames_in(data):
        seq = None if frame is None else frame.seq
        if isinstance(message, WireError):
            rows.append({"byte": place, "seq": seq, "message": None, "wrong": str(message)})
        else:
            rows.append({"byte": place, "seq": seq, "message": name_of(type(message)), "fields": asdict(message)})
    words = "\n".join(map(decoded, rows)) or "The file has no frames."
    print_result(json.loads(json.dumps(rows, default=lambda value: value.hex())), words, as_json)


@app.command()
@takes(line=Line)
def feel(
    sets: Annotated[Path, typer.Argument(help="Sets table (CSV), one set for each key.", show_default=False)],
    line: Line,
    seconds: Seconds = None,
    as_json: JsonToo = False,
) -> None:
    """Switch between sets with keys, the finger on the device: 1 to 9, space, e, c, q."""
    from hilbo.cli.device import screen

    wanted = sets_of(sets, line)
    with opened(line) as device:
        content = screen.feel(device, wanted, seconds)
    print_result(content, "", as_json)


@app.command()
@takes(line=Line)
def simulate(line: Line) -> None:
    """Run a simulated device for other programs: prints its port, ends with Ctrl-C."""
    from hilbo.cli.device.options import simulator

    device = simulator(line)
    try:
        print(device.port, flush=True)
        while device.alive():
            time.sleep(0.1)
    except KeyboardInterrupt:
        pass
    finally:
        device.close()


def _begin(device: Any, wanted: dict[str, Any] | None) -> None:
    """Activate a set, if one is given, and start to render; a handle in the material has `_LEAVES` s to leave.
    Prints both on stderr. Raises `DeviceError`."""
    if wanted is not None:
        print(f"in force: {set_words(device.send(**wanted))}", file=sys.stderr)
    if device.status().contact:
        print("hilbo: the handle is in the material; rendering starts when it leaves the surface", file=sys.stderr)
    device.start(wait=_LEAVES)


def _at_once(line: Line, name: str, as_json: bool) -> None:
    """Send "Stop" or "Estop" as the first message of a connection, which a device obeys even before HELLO, and print
    that it is done. Raises `InputError` for "sim", which would be a new device, at rest already."""
    from hilbo.device import messages
    from hilbo.device.link import Link
    from hilbo.device.ports import open_port

    if line.device == "sim":
        raise InputError(
            f"--device is missing: `hilbo device {name.lower()}` would stop a new simulated device, and nothing that"
            " moves; name the port, such as --device /dev/ttyACM0."
        )
    link = Link(open_port(line.device, line.baud), patience=line.patience or 0.1)
    try:
        link.request(getattr(messages, name)())
    finally:
        link.close()
    print_result({"done": name.lower()}, "done", as_json)
