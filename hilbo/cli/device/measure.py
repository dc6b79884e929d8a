"""The commands of `hilbo device` in which the device measures by itself: the line, its own damping, a material.

Results on stdout, progress on stderr; exit codes are those of `hilbo.cli.device.commands`, which registers these
commands.
"""

import sys
from pathlib import Path
from typing import Annotated

import typer

from hilbo.cli.device.options import Line, opened, takes
from hilbo.cli.terminal.console import ForceFile, JsonToo, fail, print_result, progress, seed_option
from hilbo.cli.terminal.new_file import check_free, new_file

__all__ = ["COMMANDS"]

_FOAM = (-2.89, 5.70, 5.89, 0.203, 101)  # what lies under a simulated device that characterises


@takes(line=Line)
def selftest(
    line: Line, echoes: Annotated[int, typer.Option(min=1, help="Round trips.")] = 300, as_json: JsonToo = False
) -> None:
    """Test the line (loopback, latency), the delay, and that the device releases its force when the host falls silent.

    Exit code 1 if the device has not passed.
    """
    from hilbo.identification.motor import device_tests

    with progress() as say, opened(line, finger="none") as device:
        result = device_tests.selftest(device, say, echoes)
        hold = device.device.hold_ticks
    good = (
        result.echoes == result.asked
        and result.watchdog_ticks <= result.watchdog_limit
        and result.force_after_N == 0
        and result.delay_us <= result.delay_limit_us
    )
    words = (
        f"loopback   {result.echoes} of {result.asked} came back whole\n"
        f"latency    median {result.median_ms:.2f} ms, 99 % below {result.p99_ms:.2f} ms, {result.retries} retries\n"
        f"watchdog   HOLD {result.watchdog_ticks} ticks after the last heartbeat (at most {result.watchdog_limit}),"
        f" force {abs(result.force_after_N):g} N {hold} ticks later\n"
        f"delay      at most {result.delay_us} us from a due tick to its force (sets are checked for"
        f" {result.delay_limit_us} us)"
    )
    print_result(result._asdict() | {"passed": good}, words, as_json)
    if not good:
        fail("The device has not passed; do not use it with people.", 1)


@takes(line=Line)
def measure_damping(
    line: Line, seed: Annotated[int, seed_option("of the motion")] = 0, as_json: JsonToo = False
) -> None:
    """Measure damping b and friction of the free device, with 95 % intervals. The device moves by itself."""
    from hilbo.device.handshake import shortest
    from hilbo.identification.motor import device_tests

    with progress() as say, opened(line, rate="lockstep", finger="none") as device:
        friction = device_tests.measure_damping(device, say, seed)
        reported = device.device.damping_N_s_per_m
    rows = (("damping", "N.s/m"), ("coulomb", "N"), ("mass", "kg"), ("constant", "N"))
    estimates = [(name, getattr(friction, name), unit) for name, unit in rows]
    if friction.added is not None:
        further = ("quadratic", "N.s2/m2") if friction.speed is None else ("stribeck", "N")
        estimates.append((further[0], friction.added, further[1]))
    content = {name: estimate._asdict() | {"unit": unit} for name, estimate, unit in estimates}
    words = [f"{name:9} {x.value:9.5f}  {x.lower:9.5f} to {x.upper:9.5f}  {unit}" for name, x, unit in estimates]
    falling = "" if friction.speed is None else f" (falling over {friction.speed:.3g} mm/s)"
    words.append(f"Friction law that fits the sweeps: {friction.law}{falling}.")
    words.append(f"The device reports {shortest(reported)} N.s/m; {_advice(min(friction.damping.lower, reported))}")
    if reported > friction.damping.upper:
        print("hilbo: the device reports more damping than it has; fix its configuration.", file=sys.stderr)
    rest = {
        "residual_N": friction.residual,
        "sweeps": friction.sweeps,
        "periods": friction.periods,
        "reported": reported,
        "law": friction.law,
        "stribeck_speed_mm_per_s": friction.speed,
    }
    print_result(content | rest, "\n".join(words), as_json)


def _advice(damping: float) -> str:
    """Advice on the damping (N·s/m) that studies may assume: the given one rounded down, or to measure again where it
    is not above 0."""
    if damping <= 0:
        return "it does not differ significantly from 0: measure again, with the handle free, and plan no study before."
    from hilbo.identification.motor.commissioning import rounded_down

    return f"plan studies with at most {rounded_down(damping):.4g}."


@takes(line=Line)
def characterise(
    out: Annotated[Path, typer.Argument(help="CSV file to write, for `hilbo identify`.", show_default=False)],
    line: Line,
    repeats: Annotated[int, typer.Option(min=1, help="Repeats of each test.")] = 16,
    depth: Annotated[float, typer.Option(help="Depth of the relaxation test, mm.")] = 5.0,
    load: Annotated[float, typer.Option(help="Force of the creep test, N.")] = 3.0,
    after: Annotated[float, typer.Option(help="Force of the recovery, N.")] = 0.5,
    hold: Annotated[float, typer.Option(help="Duration of each constant position or load, s.")] = 3.0,
    rest: Annotated[float, typer.Option(help="Recovery before each test, s.")] = 2.0,
    seed: Annotated[int, seed_option("of the motion")] = 0,
    force: ForceFile = False,
    as_json: JsonToo = False,
) -> None:
    """Measure relaxation and creep of a material at position 0, pressed by the device itself.

    Writes the tests to a CSV file for `hilbo identify`.
    """
    from hilbo.device.failures import DeviceError
    from hilbo.device.handshake import shortest
    from hilbo.identification.motor import device_tests

    check_free(out, force)
    with progress() as say, opened(line, rate="lockstep", material=_FOAM, noise=0.02) as device:
        damping = device.device.damping_N_s_per_m
        numbers = {"repeats": repeats, "depth": depth, "force": load, "after": after, "hold": hold, "rest": rest}
        try:
            table, ended = device_tests.characterise(device, say, **numbers, seed=seed), None
        except device_tests.CutShortError as error:
            table, ended = error.table, error
    with new_file(out, force) as path:
        table.to_csv(path, index=False)
    if ended is not None:
        raise DeviceError(f"{ended} {out} contains the {ended.repeats} complete repeats.")
    content = {"file": str(out), "samples": len(table), "repeats": repeats, "damping": damping}
    print_result(content, f"{out}: now  hilbo identify {out} --out results --damping {shortest(damping)}", as_json)


COMMANDS = {"selftest": selftest, "measure-damping": measure_damping, "characterise": characterise}
"""The commands by their names."""
