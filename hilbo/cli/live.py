"""The commands of a live session: `hilbo session`, `hilbo doctor`, and `hilbo simulate --live` (`live`).

hilbo session study.toml --participant P07 --device /dev/ttyACM0
hilbo session study.toml --participant P07 --device /dev/ttyACM0 --resume
hilbo doctor study.toml --device /dev/ttyACM0
"""

import contextlib
import itertools
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

from hilbo.cli.device.options import Baud, Sim, Where, sim_options, takes
from hilbo.cli.terminal.console import JsonToo, OneMaterial, check_choice, progress, seed_option, start
from hilbo.errors import InputError

__all__ = ["doctor", "live", "need_extra", "session"]

_PORT = 8642
_EXTRA = "Live sessions need starlette, uvicorn and segno; install them with: pip install 'hilbo[live]'."


class Device(NamedTuple):
    """Options: which device, at which rate, and how it is simulated."""

    device: Where = "sim"
    baud: Baud = 921_600
    sim: Sim = None

    def open(self, damping: float | None, delay: float | None) -> Any:
        """A connected `Renderer` of a device that has at least this damping (N·s/m) and at most this delay (s). Raises
        `InputError` or `DeviceError`."""
        from hilbo.hardware_bridge import Renderer

        options = sim_options(self.sim)
        if self.device == "sim":
            options = {"finger": "none"} | options
        return Renderer.open(self.device, baud=self.baud, damping=damping, delay=delay, options=options)


class Served(NamedTuple):
    """Options: where a session is served, and where its log goes."""

    logs: Annotated[Path, typer.Option("--logs", help="Folder of the session logs.")] = Path("logs")
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="Port of the server; 0 for any free one.")] = (
        _PORT
    )
    lan: Annotated[bool, typer.Option("--lan", help="Reachable from the network, by one-time links.")] = False
    pause: Annotated[float, typer.Option("--pause", min=0.0, help="Pause between two trials, s.")] = 0.7
    browse: Annotated[bool, typer.Option("--open", help="Open the experimenter's page in this computer's browser.")] = (
        False
    )


@takes(line=Device, served=Served)
def session(
    study: Annotated[Path, typer.Argument(help="Study file (TOML).", show_default=False)],
    line: Device,
    served: Served,
    participant: Annotated[str, typer.Option(help="Pseudonym of the participant.")],
    name: Annotated[
        str | None, typer.Option("--session", help="Label of the session; by default 1, or the plan's.")
    ] = None,
    plan: Annotated[Path | None, typer.Option(help="Plan of the study, from `hilbo plan`.")] = None,
    material: OneMaterial = None,
    resume: Annotated[bool, typer.Option("--resume", help="Resume an interrupted session.")] = False,
    people: Annotated[Path | None, typer.Option(help="participants.csv; by default the one among the logs.")] = None,
    warm_start: Annotated[
        Path | None, typer.Option("--warm-start", help="map.nc of a population, as the initial map of trial selection.")
    ] = None,
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run", help="Test run without a participant; consent is not checked and the log is flagged."
        ),
    ] = False,
    seed: Annotated[
        int | None, seed_option("of the points that are chosen; by default one for each participant, or the plan's")
    ] = None,
    as_json: JsonToo = False,
) -> None:
    """Run a live session: participant's and experimenter's page, device or stimulus program, and the log.

    Prints one-time links and progress on stderr, and serves until Ctrl-C.
    """
    need_extra()
    from hilbo.app.server import serve

    with contextlib.ExitStack() as held:
        _make_logs_folder(served.logs, participant, name)
        place = serve.bound(served.port, lan=served.lan)
        held.callback(place.socket.close)
        with progress() as say:
            say("loading")
            start()
            from hilbo.app.hub.opening import Wanted, let_go, opened
            from hilbo.app.pages.session_lines import SessionLines
            from hilbo.session.log.log_files import keys_path

            wanted = Wanted(
                study, participant, name, seed, served.logs, plan, material, resume, people, warm_start, dry_run
            )
            hub, log = opened(wanted, line.open, say)
        held.callback(let_go, log, resume)
        place.gate.keep_in(keys_path(log.path))
        if hub.state.study.stimulus is not None and line.device != "sim":
            raise InputError(f"{study}: a program or a person presents, and no device is used; leave --device out.")
        hub.gap = served.pause
        _say_changes(study, hub.state.study)
        hub.observe = SessionLines(study, served.logs)
        _serve(hub, place, served, as_json)


def _say_changes(path: Path, own) -> None:
    """Print on stderr in which keys the study file at `path` differs from the one that a resumed session goes on with
    (`own`); nothing if they are the same. Raises `InputError` for an invalid file."""
    from hilbo.study.file.reading import StudyFile

    if keys := StudyFile.load(path).changes(own):
        print(f"study file:   as when the session began; now it differs in {', '.join(keys)}", file=sys.stderr)


def _serve(hub, place, served, as_json) -> None:
    """Serve an open session until it ends; new links come with a QR code."""
    from hilbo.app.server import serve

    def invite(role):
        link = place.link(role)
        return {"link": link, "qr": serve.qr_image(link)}

    hub.invite = invite
    serve.serve(place, hub, lambda _: _started(hub, place, served, as_json))


def _started(hub, place, served, as_json) -> None:
    """Print notes, log and links on stderr, with --json also in one line on stdout; open the experimenter's page with
    --open."""
    from hilbo.app.pages.pace import duration
    from hilbo.app.server import serve

    stimulus = hub.state.study.stimulus
    presents = () if stimulus is None else (stimulus.role,)
    links = place.links((*presents, "participant", "experimenter"))
    for note in hub.rig.notes:
        print(f"hilbo: {note}", file=sys.stderr)
    print(f"log:          {hub.log.path}" + (f"  ({hub.log.dropped})" if hub.log.dropped else ""), file=sys.stderr)
    if hub.state.active is not None:
        print(f"resumed:      {duration(time.time() - hub.state.active)} after its last activity", file=sys.stderr)
    for role, link in links.items():
        print(f"{role + ':':<13} {link}", file=sys.stderr)
    for role in ("preparer", "participant") if served.lan else ():
        if role in links:
            print(f"{role}:\n{serve.qr_text(links[role])}", file=sys.stderr)
    print(
        "Each link is for one program or browser. Ctrl-C ends the server; --resume goes on.",
        file=sys.stderr,
        flush=True,
    )
    if as_json:
        print(json.dumps(links | {"log": str(hub.log.path), "device": hub.rig.words.partition(",")[0]}), flush=True)
    if served.browse:
        import webbrowser

        webbrowser.open(links["experimenter"])


def _make_logs_folder(logs: Path, participant: str, name: str | None) -> None:
    """Make the folder of the logs. Raises `InputError` if that fails, or before it for a participant or session label
    that is not allowed."""
    from hilbo.session.log.header_check import check_label
    from hilbo.study.formats.cell_text import check_id, check_text

    check_id(participant, "--participant")
    if name is not None:
        check_label(name)
        check_text(name, "--session")
    try:
        logs.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{logs}: cannot be made ({error.strerror}); choose another --logs.") from error


def need_extra() -> None:
    """Raise `InputError` if packages that serve a session are missing."""
    import importlib.util

    if any(importlib.util.find_spec(package) is None for package in ("starlette", "uvicorn", "segno")):
        raise InputError(_EXTRA)


@takes(line=Device)
def doctor(
    line: Device,
    study: Annotated[Path | None, typer.Argument(help="Study file (TOML).", show_default=False)] = None,
    logs: Annotated[Path, typer.Option("--logs", help="Folder of the session logs.")] = Path("logs"),
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="Port of the server.")] = _PORT,
    stimulus: Annotated[
        bool, typer.Option("--stimulus", help="Test the stimulus program: presentations and stops.")
    ] = False,
    as_json: JsonToo = False,
) -> None:
    """Check that everything is ready for a session, and print the remedy for each failed check.

    Exit code 1 if something is bad.
    """
    from hilbo.cli.doctor import checks, stimulus_checks

    if stimulus and study is None:
        raise InputError("--stimulus: name the study whose renderings the program presents.")
    results = []
    marks = {"good": "ok  ", "note": "note", "bad": "BAD "}
    to_check = checks(study, line.open, logs, port, start)
    if stimulus:
        need_extra()
        assert study is not None  # looked at above
        to_check = itertools.chain(to_check, stimulus_checks(study, port))
    for check in to_check:
        results.append(check)
        fix = f"\n       -> {check.fix}" if check.fix else ""
        print(f"{marks[check.level]}  {check.name}: {check.words}{fix}", file=sys.stderr, flush=True)
    print(_verdict([check.level for check in results]), file=sys.stderr)
    if as_json:
        print(json.dumps([check._asdict() for check in results], indent=2))
    if any(check.level == "bad" for check in results):
        raise typer.Exit(1)


def _verdict(levels: Sequence[str]) -> str:
    """The last line of `hilbo doctor`: whether a session can begin, from the levels of all checks."""
    bad, notes = levels.count("bad"), levels.count("note")
    noted = f", {notes} with a note" if notes else ""
    if bad:
        return f"NOT READY: {bad} of {len(levels)} checks failed{noted}."
    return f"READY: {len(levels)} checks, none failed{noted}."


def live(
    study: Path, out: Path, preset: str | None, phase: str, seconds: float | None, seed: int, say: Any
) -> dict[str, Any]:
    """Run a whole session without people into a new folder, for `hilbo simulate --live`, and return its summary
    (`rehearse`), which is written to result.json there. Raises `InputError` if the folder is not empty, or packages or
    a browser are missing."""
    need_extra()
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out}: exists already; choose another --out.")
    start()
    from hilbo.app.rehearsal.rehearsal import rehearse
    from hilbo.app.rehearsal.robot import find_browser
    from hilbo.study.file.protocols import PHASES

    check_choice("kind", phase, PHASES[1:])
    if find_browser() is None:
        raise InputError(
            "--live needs Chromium and playwright; install them (Debian: apt install chromium; pip install"
            " 'hilbo[browser]')."
        )
    from hilbo.report.result_file import write_result

    summary = rehearse(
        study,
        out,
        preset=preset,
        phase=phase,
        seconds=seconds,
        warm_up=None if seconds is None else 3,
        seed=seed,
        say=say,
    )
    write_result(summary, out)
    return summary
