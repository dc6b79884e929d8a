"""`hilbo device home` and `hilbo device commission`: commissioning of a new device, with a person at the handle.

Prompts go to stderr. Exit codes are those of `hilbo.cli.device.commands`, which registers these commands.
"""

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from hilbo.cli.device.options import Line, opened, takes
from hilbo.cli.terminal.console import ForceFile, JsonToo, print_result, remark, seed_option
from hilbo.cli.terminal.new_file import check_free, write_new
from hilbo.errors import InputError

__all__ = ["COMMANDS", "PHRASE"]

PHRASE = "no hand is on the handle"


@takes(line=Line)
def home(
    line: Line,
    position: Annotated[float, typer.Option(help="Current position of the handle, mm; 0 is the surface.")],
    as_json: JsonToo = False,
) -> None:
    """Set the current position of a device without an absolute encoder (homing)."""
    with opened(line) as device:
        device.home(position)
        position = device.status().position_mm
    print_result({"position_mm": position}, f"homed: the handle is at {position:.6g} mm", as_json)


@takes(line=Line)
def commission(
    line: Line,
    out: Annotated[Path, typer.Option("--out", help="C header to write.")] = Path("hilbo_device_config.h"),
    base: Annotated[
        Path | None,
        typer.Option(
            "--base", help="Header that the device was built with, to be updated. Default: write a new header."
        ),
    ] = None,
    no_hand: Annotated[
        str | None, typer.Option("--no-hand-on-the-handle", help=f'For scripts: exactly "{PHRASE}".')
    ] = None,
    encoder_checked: Annotated[
        bool,
        typer.Option(
            "--encoder-checked",
            help="The encoder sign has been checked by hand (position increases into the material).",
        ),
    ] = False,
    position: Annotated[
        float | None, typer.Option("--position", help="For scripts: position of the handle at the start, mm.")
    ] = None,
    first_force: Annotated[float, typer.Option(min=0.01, help="First force of the nudges, N.")] = 0.3,
    most_force: Annotated[float, typer.Option(min=0.01, help="Largest force of the nudges, N.")] = 2.0,
    seed: Annotated[int, seed_option("of the motion")] = 0,
    force: ForceFile = False,
    as_json: JsonToo = False,
) -> None:
    """Check the signs of encoder and motor with little energy, home, measure delay and damping, write the C header.

    The device moves by itself. A person at the terminal is asked to help, or a script gives the answers as options.
    """
    from hilbo.identification.motor.commissioning import Bounds
    from hilbo.identification.motor.commissioning import commission as commissioned

    person = _person(no_hand, encoder_checked, position)
    check_free(out, force)
    text = None if base is None else _text(base)
    with opened(line, rate="lockstep", finger="none") as device:
        _check_position(device, person)
        result = commissioned(device, person, _say, Bounds(first_N=first_force, most_N=most_force), seed)
        about, condition = device.device, device.condition()
        content = _content(result, about.damping_N_s_per_m, condition.delay_us)
        written = _header(device, content, base, text)
    write_new(out, written, force)
    for note in [*result.notes, *_differences(content)]:
        remark(note)
    print_result({"file": str(out)} | content, _words(out, content), as_json)


class _Terminal:
    """A person at the terminal, who is asked on stderr and answers on stdin."""

    def __init__(self, encoder_checked: bool):
        self._encoder_checked = encoder_checked

    def encoder_checked(self) -> bool:
        """Whether the encoder's sign was checked before; if not, the person is asked to push the handle in now, which
        the caller measures."""
        if not self._encoder_checked:
            _ask("The motor is at rest. Now push the handle in by hand, towards the material, by a few mm.")
        return self._encoder_checked

    def take_hands_off(self) -> None:
        """Ask the person to take their hands off and type the phrase. Raises `InputError` for any other text."""
        _ask(f'The device will move by itself. Take your hands off, then type "{PHRASE}":')
        _check_phrase(sys.stdin.readline().strip(), "The answer")

    def place(self, moved_mm: float) -> float:
        """Ask the person to hold the handle at the surface, and return its position, 0 mm. Raises `InputError` at the
        end of the input. `moved_mm` is not needed for that."""
        _ask("The motor is at rest. Place the handle at the surface, do not move it, and press Enter.")
        if not sys.stdin.readline():
            raise InputError("The handle was not placed at the surface (end of input); commission the device again.")
        return 0.0


class _Script:
    """A script that answers for a person; `position` is where the handle was at the start, mm, or None."""

    def __init__(self, position: float | None):
        self.position = position

    def encoder_checked(self) -> bool:
        """True: a script must state that the encoder was checked."""
        return True

    def take_hands_off(self) -> None:
        """Do nothing: the phrase was given as an option."""
        return

    def place(self, moved_mm: float) -> float | None:
        """The present position of the handle, mm, after it has moved by `moved_mm` since the start; None if the
        position at the start was not given."""
        return None if self.position is None else self.position + moved_mm


def _person(no_hand: str | None, encoder_checked: bool, position: float | None) -> Any:
    """Who answers for the person at the handle: a script if the phrase `no_hand` is given, else the terminal. Raises
    `InputError` if the phrase differs, if there is no terminal, or for options that do not fit."""
    if no_hand is not None:
        _check_phrase(no_hand, "--no-hand-on-the-handle")
        if not encoder_checked:
            raise InputError(
                "A script cannot push the handle in: check by hand that `hilbo device monitor` counts up into the"
                " material, then add --encoder-checked."
            )
        return _Script(position)
    if not sys.stdin.isatty():
        raise InputError(
            "A person must confirm that no hand is on the handle: use a terminal, or"
            f' --no-hand-on-the-handle "{PHRASE}".'
        )
    if position is not None:
        raise InputError(
            "--position is for scripts; leave it out, and place the handle at the surface when the command asks for it."
        )
    return _Terminal(encoder_checked)


def _check_phrase(given: str, what: str) -> None:
    """Raise `InputError` unless `given` is exactly the phrase; `what` names where it came from."""
    if given != PHRASE:
        raise InputError(f'{what} is "{given}"; the device moves only after exactly "{PHRASE}".')


def _check_position(device: Any, person: Any) -> None:
    """Raise `InputError` if a script gives no position for a device that is not homed."""
    if isinstance(person, _Script) and person.position is None and not device.condition().homed:
        raise InputError("The device is not homed; give the current position of its handle with --position, in mm.")


def _ask(words: str) -> None:
    """Print words for the person on stderr, after an empty line."""
    print(f"\n{words}", file=sys.stderr, flush=True)


def _say(words: str) -> None:
    """Print a line of progress on stderr; a line that changes in place would disturb what a person types."""
    print(words, file=sys.stderr, flush=True)


def _text(base: Path) -> str:
    """The text of the header to update. Raises `InputError` if it cannot be read."""
    try:
        return base.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{base}: cannot be read ({error}); give the device's last header.") from error


def _content(result: Any, damping: float, delay_us: int) -> dict[str, Any]:
    """The result for `--json`; `damping` (N·s/m) and `delay_us` are those that the device reports. Raises `DeviceError`
    if the measured damping is not significantly above 0."""
    from hilbo.device.failures import DeviceError
    from hilbo.identification.motor.commissioning import damping_for, delay_for

    measured = damping_for(result.friction)
    if measured < 1e-3:
        raise DeviceError(
            "The measured damping is not significantly above 0; make sure that the handle moves freely, then commission"
            " again."
        )
    return {
        "nudges": [nudge._asdict() for nudge in result.nudges],
        "damping": result.friction.damping._asdict() | {"header": measured, "reported": damping},
        "coulomb": result.friction.coulomb._asdict(),
        "delay_us": {
            "longest": result.longest_delay_us,
            "header": delay_for(result.longest_delay_us),
            "reported": delay_us,
        },
    }


def _header(device: Any, content: dict[str, Any], base: Path | None, text: str | None) -> str:
    """The text of the new C header: that of `base`, `text`, with the measured values, or a whole new one if `text` is
    None. Raises `DeviceError` for a delay that is longer than a tick."""
    from hilbo.device import messages
    from hilbo.device.config_header import header, with_measured
    from hilbo.device.failures import DeviceError

    damping, delay = content["damping"], content["delay_us"]
    if delay["header"] > 1e6 * device.tick_s:
        raise DeviceError(
            f"The longest delay is {delay['longest']} us, and with its margin {delay['header']} us, longer than a tick;"
            " make the firmware faster, or lower its tick rate."
        )
    about, limits = device.device, device.link.request(messages.GetLimits())
    if text is not None:
        return with_measured(text, str(base), about, limits, damping["header"], delay["header"])
    about_damping = f"measured: {damping['value']:.4g}, 95 % interval {damping['lower']:.4g} to {damping['upper']:.4g}"
    about_delay = f"measured: at most {delay['longest']} us; a quarter is added, at least 50 us"
    return header(about, limits, damping["header"], delay["header"], about_damping, about_delay)


def _differences(content: dict[str, Any]) -> list[str]:
    """Sentences for a person where the device is configured with more damping, or less delay, than was measured."""
    damping, delay, sentences = content["damping"], content["delay_us"], []
    if damping["reported"] > damping["lower"]:
        sentences.append(
            f"the device is configured with {damping['reported']:.4g} N.s/m of damping but may have only"
            f" {damping['lower']:.4g}; rebuild its firmware with the new header before a person touches it."
        )
    if delay["reported"] < delay["header"]:
        sentences.append(
            f"the device's delay_us of {delay['reported']} has less margin than the {delay['header']} of the"
            " new header."
        )
    return sentences


def _words(out: Path, content: dict[str, Any]) -> str:
    """The result as lines of text; `content`: that of `_content`."""
    damping, coulomb, delay = content["damping"], content["coulomb"], content["delay_us"]
    nudges = ", ".join(f"{n['force_N']:+.2g} N: {n['moved_mm']:+.3f} mm" for n in content["nudges"])
    return (
        f"signs      encoder and motor count and push inwards ({nudges})\n"
        f"delay      at most {delay['longest']} us, {delay['header']} in the header (the device: {delay['reported']})\n"
        f"damping    {damping['value']:.5g} ({damping['lower']:.5g} to {damping['upper']:.5g}) N.s/m,"
        f" {damping['header']:.4g} in the header (the device: {damping['reported']:.5g})\n"
        f"coulomb    {coulomb['value']:.5g} ({coulomb['lower']:.5g} to {coulomb['upper']:.5g}) N\n"
        f"{out}: build the firmware with it, then `hilbo device selftest`"
    )


COMMANDS = {"home": home, "commission": commission}
"""The commands by their names."""
