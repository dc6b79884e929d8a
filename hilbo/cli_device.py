"""`hilbo device`: a rendering device on a line, or a simulated one, from the command line.

Results on stdout (`--json` for machines), progress and warnings on stderr. Exit code 0: done, 1: the device or the line
failed, 2: bad usage or bad input, numbers that the device refuses included. The device is stopped at the end of every
command.
"""

import json
import os
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from hilbo.console import Force, Json, Seed, fail, progress
from hilbo.device_options import Chosen, Line, chosen_set, opened, sets_of, takes
from hilbo.device_words import decoded, said, set_words
from hilbo.errors import InputError

__all__ = ["app"]

app = typer.Typer(no_args_is_help=True, help="A rendering device: connect, send sets, feel, measure.")

_FOAM = (-2.89, 5.70, 5.89, 0.203, 101)  # what lies under a simulated device that characterises

Seconds = Annotated[float | None, typer.Option(help="End after so many seconds of the device's time.")]


@app.command()
def ports(as_json: Json = False) -> None:
    """The serial ports of this computer."""
    from hilbo.ports import list_ports

    found = list_ports()
    words = "\n".join(f"{port.name}  {port.description}" for port in found) or "There is no serial port."
    _finish([port._asdict() for port in found], words, as_json)


@app.command()
@takes(line=Line)
def hello(line: Line, as_json: Json = False) -> None:
    """Who is there: version, limits, damping, stroke, and what it can do."""
    from dataclasses import asdict

    from hilbo.reasons import Capability

    with opened(line) as device:
        about = asdict(device.device)
        found = device.in_force()
        can = [flag.name.lower() for flag in Capability(about["capabilities"]) if flag.name]
        content = about | {
            "can": can,
            "limits": device.limits(),
            "telemetry_divisor": device.divisor,
            "in_force": found and found._asdict(),
        }
    limits = ", ".join(f"{name} {low:g} to {high:g}" for name, (low, high) in content["limits"].items())
    words = "\n".join(f"{name:26} {said(name, value)}" for name, value in about.items())
    now = set_words(found) if found else "none"
    _finish(
        content,
        f"{words}\ncan                        {', '.join(can)}\nlimits  {limits}\nin force  {now}",
        as_json,
    )


@app.command("set")
@takes(chosen=Chosen, line=Line)
def set_(chosen: Chosen, line: Line, as_json: Json = False) -> None:
    """Put a set in force, and read it back bit for bit. Nothing is started."""
    wanted = chosen_set(chosen, line)
    if wanted is None:
        raise InputError("No set is given; a set has --K1, --B1 and --alpha, or --sets and --name.")
    with opened(line) as device:
        found = device.send(**wanted)
    _finish(found._asdict(), f"in force: {set_words(found)}", as_json)


@app.command()
@takes(chosen=Chosen, line=Line)
def start(chosen: Chosen, line: Line, seconds: Seconds = None, as_json: Json = False) -> None:
    """Render the set that is in force, or the one that is given, until Ctrl-C; then stop."""
    from hilbo.device_screen import watch

    wanted = chosen_set(chosen, line)
    with opened(line) as device:
        _begin(device, wanted)
        content = watch(device, seconds, "rendering; Ctrl-C stops")
    _finish(content, "", as_json)
    if content["state"] in ("HOLD", "ESTOP"):
        fail(f"The device has gone to {content['state']} by itself; find out why, then clear it.", 1)


@app.command()
@takes(line=Line)
def stop(line: Line, as_json: Json = False) -> None:
    """Force to zero, smoothly, whoever started it."""
    _at_once(line, "Stop", as_json)


@app.command()
@takes(line=Line)
def estop(line: Line, as_json: Json = False) -> None:
    """Force to zero at once, latched until `clear`."""
    _at_once(line, "Estop", as_json)


@app.command()
@takes(line=Line)
def clear(line: Line, as_json: Json = False) -> None:
    """Leave HOLD or ESTOP, once the reason is understood."""
    with opened(line) as device:
        device.clear()
        state = device.state().name
    _finish({"state": state}, f"the device is {state}", as_json)


@app.command()
@takes(line=Line)
def monitor(line: Line, seconds: Seconds = None, as_json: Json = False) -> None:
    """State, force and position as they go by. Nothing is started."""
    from hilbo.device_screen import watch

    with opened(line) as device:
        content = watch(device, seconds)
    _finish(content, "", as_json)


@app.command()
@takes(chosen=Chosen, line=Line)
def record(
    out: Annotated[Path, typer.Argument(help="CSV file to write.", show_default=False)],
    chosen: Chosen,
    line: Line,
    seconds: Annotated[float, typer.Option(min=0.001, help="So many seconds of the device's time.")] = 5.0,
    render: Annotated[bool, typer.Option("--render/--no-render", help="Start the set first, and stop after.")] = True,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Telemetry to a CSV file: tick, time_s, position_mm, force_N, sensed_N, flags."""
    _check_free(out, force)
    wanted = chosen_set(chosen, line)
    with opened(line) as device:
        if render:
            _begin(device, wanted)
        device.samples(0.0)
        table = device.telemetry(seconds)
        state, counts = device.state().name, device.counts()
    _write(table, out)
    content = {"file": str(out), "samples": len(table), "state": state, "counts": counts._asdict()}
    _finish(content, f"{out}: {len(table)} samples", as_json)


@app.command()
def decode(
    capture: Annotated[Path, typer.Argument(help="Bytes of a line, as --capture writes them.", show_default=False)],
    as_json: Json = False,
) -> None:
    """Captured bytes made readable: every frame, and what is wrong with the others."""
    from dataclasses import asdict

    from hilbo.protocol import WireError, frames_in, name_of

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
    words = "\n".join(decoded(row) for row in rows)
    _finish(
        json.loads(json.dumps(rows, default=lambda value: value.hex())), words or "The file has no frames.", as_json
    )


@app.command()
@takes(line=Line)
def selftest(
    line: Line,
    echoes: Annotated[int, typer.Option(min=1, help="Round trips.")] = 300,
    as_json: Json = False,
) -> None:
    """Loopback, latency, and whether the device lets go when the host falls silent."""
    from hilbo import device_tests

    with progress() as say, opened(line, finger="none") as device:
        found = device_tests.selftest(device, say, echoes)
        hold = device.device.hold_ticks
    good = found.echoes == found.asked and found.watchdog_ticks <= found.watchdog_limit and found.force_after_N == 0
    words = (
        f"loopback   {found.echoes} of {found.asked} came back whole\n"
        f"latency    median {found.median_ms:.2f} ms, 99 % below {found.p99_ms:.2f} ms, {found.retries} retries\n"
        f"watchdog   HOLD {found.watchdog_ticks} ticks after the last heartbeat (at most {found.watchdog_limit}),"
        f" force {abs(found.force_after_N):g} N {hold} ticks later"
    )
    _finish(found._asdict() | {"passed": good}, words, as_json)
    if not good:
        fail("The device has not passed; do not use it with people.", 1)


@app.command()
@takes(line=Line)
def feel(
    sets: Annotated[Path, typer.Argument(help="Sets table (CSV), one set for each key.", show_default=False)],
    line: Line,
    seconds: Seconds = None,
    as_json: Json = False,
) -> None:
    """Switch between sets with keys, the finger on the device: 1 to 9, space, e, c, q."""
    from hilbo import device_screen

    wanted = sets_of(sets, line)
    with opened(line) as device:
        content = device_screen.feel(device, wanted, seconds)
    _finish(content, "", as_json)


@app.command("measure-damping")
@takes(line=Line)
def measure_damping(line: Line, seed: Seed = 0, as_json: Json = False) -> None:
    """Damping b and Coulomb friction of the free device, with 95 % intervals. It moves by itself."""
    from hilbo import device_tests

    with progress() as say, opened(line, rate="lockstep", finger="none") as device:
        found = device_tests.measure_damping(device, say, seed)
        reported = device.device.damping_N_s_per_m
    rows = (("damping", "N.s/m"), ("coulomb", "N"), ("mass", "kg"), ("constant", "N"))
    content = {name: getattr(found, name)._asdict() | {"unit": unit} for name, unit in rows}
    words = [
        f"{n:9} {getattr(found, n).value:9.5f}  {getattr(found, n).lower:9.5f} to {getattr(found, n).upper:9.5f}  {u}"
        for n, u in rows
    ]
    believed = found.damping.lower
    words.append(f"The device reports {reported:.4g} N.s/m; plan studies with at most {min(believed, reported):.4g}.")
    if reported > found.damping.upper:
        print("hilbo: the device reports more damping than it has; mend its configuration.", file=sys.stderr)
    rest = {"residual_N": found.residual, "sweeps": found.sweeps, "periods": found.periods, "reported": reported}
    _finish(content | rest, "\n".join(words), as_json)


@app.command()
@takes(line=Line)
def characterise(
    out: Annotated[Path, typer.Argument(help="CSV file to write, for `hilbo identify`.", show_default=False)],
    line: Line,
    repeats: Annotated[int, typer.Option(min=1, help="Repeats of each test.")] = 16,
    depth: Annotated[float, typer.Option(help="Depth of the relaxation test, mm.")] = 5.0,
    load: Annotated[float, typer.Option(help="Force of the creep test, N.")] = 3.0,
    after: Annotated[float, typer.Option(help="Force of the recovery, N.")] = 0.5,
    hold: Annotated[float, typer.Option(help="How long each is held, s.")] = 3.0,
    rest: Annotated[float, typer.Option(help="Recovery before each test, s.")] = 2.0,
    seed: Seed = 0,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Relaxation and creep of a material at position 0, pressed by the device itself."""
    from hilbo import device_tests

    _check_free(out, force)
    with progress() as say, opened(line, rate="lockstep", material=_FOAM, noise=0.02) as device:
        numbers = {"repeats": repeats, "depth": depth, "force": load, "after": after, "hold": hold, "rest": rest}
        table = device_tests.characterise(device, say, **numbers, seed=seed)
        damping = device.device.damping_N_s_per_m
    _write(table, out)
    content = {"file": str(out), "samples": len(table), "repeats": repeats, "damping": damping}
    _finish(content, f"{out}: now  hilbo identify {out} --out results --damping {damping:.6g}", as_json)


@app.command()
@takes(line=Line)
def simulate(line: Line) -> None:
    """A simulated device that stays, for other programs: prints its port, ends with Ctrl-C."""
    from hilbo.device_options import simulator

    device = simulator(line)
    try:
        print(device.port, flush=True)
        while device.alive():
            time.sleep(0.1)
    except KeyboardInterrupt:
        pass
    finally:
        device.close()


def _begin(device, wanted) -> None:
    if wanted is not None:
        print(f"in force: {set_words(device.send(**wanted))}", file=sys.stderr)
    device.start()


def _at_once(line, name, as_json) -> None:
    """A request that is obeyed before HELLO: nothing else is said first."""
    from hilbo import protocol
    from hilbo.link import Link
    from hilbo.ports import open_port

    if line.device == "sim":
        with opened(line) as device:
            getattr(device, name.lower())()
    else:
        link = Link(open_port(line.device, line.baud), patience=line.patience or 0.1)
        try:
            link.request(getattr(protocol, name)())
        finally:
            link.close()
    _finish({"done": name.lower()}, "done", as_json)


def _check_free(out: Path, force: bool) -> None:
    if out.exists() and not (force and out.is_file()):
        raise InputError(f"{out}: exists already; choose another file, or add --force to replace it.")
    if not out.resolve().parent.is_dir():
        raise InputError(f"{out}: there is no folder {out.resolve().parent}; make it, or choose another file.")


def _write(table, out: Path) -> None:
    """Whole or not at all."""
    part = out.with_name(f".{out.name}.part")
    try:
        table.to_csv(part, index=False)
        os.replace(part, out)
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror}); choose another file.") from error


def _finish(content, words, as_json) -> None:
    if as_json:
        print(json.dumps(content, indent=2, allow_nan=False, default=float))
    elif words:
        print(words)
