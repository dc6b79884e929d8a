"""Checks before a session (`hilbo doctor`): the result of each and, where something is wrong, how to fix it.

Nothing is changed: a file of a few bytes is written and removed where logs will be, and the device is queried and
stopped, never started.
"""

import json
import os
import platform
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path
from typing import Any, Literal, NamedTuple

from hilbo.errors import InputError

__all__ = ["Check", "checks", "stimulus_checks"]

Level = Literal["good", "note", "bad"]
_PARTS = ("hilbo", "jax", "jaxlib", "equinox", "numpy", "starlette", "uvicorn", "pyserial")
_OPTIONAL = {"starlette": "live", "uvicorn": "live", "pyserial": "hardware"}
_BROWSERS = ("chromium", "google-chrome", "chromium-browser", "firefox", "msedge", "open")
_ROOM = 200  # MB; a session's log is below one
_SLOW = 0.5  # s for a step: a participant would notice
_JOINS = 120.0  # s that the program that presents has to join


class Check(NamedTuple):
    """A check: its name, its result as a level ("good", "note" or "bad") and in words, and how to fix it (empty where
    nothing is wrong)."""

    name: str
    level: Level
    words: str
    fix: str = ""


def _check(name: str, words: str, fix: str | Literal[False], level: Level = "bad") -> Check:
    """A check of this `level` if there is something to fix, else a good one (`fix` False or empty)."""
    return Check(name, level if fix else "good", words, fix or "")


def checks(
    study: Path | None,
    connect: Callable[[float | None, float | None], Any],
    folder: Path,
    port: int,
    begin: Callable[[], Any] = lambda: None,
) -> Iterator[Check]:
    """All checks, one after the other, each made when it is asked for. `connect(damping, delay)` opens the device, logs
    go to `folder`, `port` is that of the server; without a study its checks are left out, and with [stimulus] those of
    the device.

    The checks that need JAX come last, after `begin`, which starts it: the others do not wait for it.
    """
    yield _versions()
    yield _disk(folder)
    yield _port(port)
    yield _browser()
    yield _serial_ports()
    file = None
    if study is not None:
        check, file = _study_file(study)
        yield check
    if file is not None:
        yield from _random_effect(file)
        yield from _language(file)
    yield from _device(connect, file) if file is None or file.stimulus is None else _stimulus(file)
    begin()
    yield _precision()
    if study is not None and file is not None:
        yield from _study(study)


def _versions() -> Check:
    """Versions of Python and packages: bad if one for live sessions is missing, a note if another is."""
    versions, missing = [f"Python {platform.python_version()}"], []
    for package in _PARTS:
        try:
            versions.append(f"{package} {metadata.version(package)}")
        except metadata.PackageNotFoundError:
            missing.append(package)
    extras = sorted({_OPTIONAL[package] for package in missing if package in _OPTIONAL})
    words = ", ".join(versions) + (f"; not installed: {', '.join(missing)}" if missing else "")
    fix = f"pip install 'hilbo[{','.join(extras)}]'" if extras else ""
    return Check("versions", "bad" if "live" in extras else "note" if missing else "good", words, fix)


def _disk(folder: Path) -> Check:
    """Whether the folder of the logs, or the nearest one above it that exists, can be written, how fast, and how much
    room there is."""
    above = (folder, *folder.resolve().parents)
    place = next((path for path in above if os.path.lexists(path)), folder)  # a session makes missing folders below
    try:
        with tempfile.NamedTemporaryFile(dir=place) as file:
            begun = time.perf_counter()
            file.write(b"hilbo\n" * 100)
            file.flush()
            os.fsync(file.fileno())
            took = time.perf_counter() - begun
        free = shutil.disk_usage(place).free / 1e6
    except OSError as error:
        return Check("disk", "bad", f"{place}: {error.strerror}", "choose a folder for logs that can be written")
    words = f"{place}: {free:,.0f} MB free, log write latency (fsync) {1000 * took:.1f} ms"
    return _check("disk", words, free < _ROOM and f"make {_ROOM} MB of room, or choose another folder")


def _port(port: int) -> Check:
    """Whether the server's port on this computer is free."""
    import socket

    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError as error:
            words = f"127.0.0.1:{port}: {error.strerror}"
            return Check("server's port", "bad", words, "end the other program, or choose another --port")
    return Check("server's port", "good", f"127.0.0.1:{port} is free")


def _browser() -> Check:
    """Whether a browser is installed."""
    browser = next((path for name in _BROWSERS if (path := shutil.which(name))), None)
    if browser is None and sys.platform not in ("win32", "darwin"):
        return Check("browser", "note", "none is found here", "install one, or use a tablet with --lan")
    return Check("browser", "good", browser or "the system's")


def _serial_ports() -> Check:
    """The serial ports of this computer; a note if there is none."""
    from hilbo.device.ports import list_ports

    try:
        serial_ports = list_ports()
    except InputError as error:
        return Check("serial ports", "note", "pyserial is missing", str(error))
    words = ", ".join(f"{port.name} ({port.description})" for port in serial_ports) or "none"
    return _check("serial ports", words, not serial_ports and "plug the device in", "note")


def _study_file(path: Path) -> tuple[Check, Any]:
    """The check that the study file is valid, and the file, None if it is not."""
    from hilbo.study.file.reading import StudyFile

    try:
        file = StudyFile.load(path)
    except InputError as error:
        return Check("study", "bad", str(error), "fix the study file"), None
    words = f"{file.name}, {file.selection.trials} trials, hash {file.hash}"
    return Check("study", "good", words), file


def _random_effect(file: Any) -> Iterator[Check]:
    """A note if the study names a column for its random effect that tables of sessions do not have; else nothing."""
    name = file.random_effect
    if name not in (None, "session"):
        fix = "add it to the table that hilbo export writes, and aggregate that table"
        yield Check("random effect", "note", f'tables of sessions have no column "{name}"', fix)


def _precision() -> Check:
    """The type of numbers, and the folder and size of the cache of compiled functions; a note if it is not float64 or
    the cache is empty."""
    import jax
    import jax.numpy as jnp

    cache = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    size = sum(file.stat().st_size for file in Path(cache).glob("*")) / 1e6 if cache and Path(cache).is_dir() else 0.0
    dtype = jnp.zeros(()).dtype
    kept = f"kept in {cache} ({size:.0f} MB)" if cache else "not kept"
    words = f"{dtype}, {jax.devices()[0].platform}; compiled functions are {kept}"
    fix = "" if size else "the first session compiles for a minute; run `hilbo simulate --live` once before"
    fix = fix if dtype == jnp.float64 else "sessions are meant for float64"
    return _check("precision and cache", words, fix, "note")


def _study(path: Path) -> Iterator[Check]:
    """Checks of the feasible set (not for a study with [stimulus] and without constraints) and of the time of a step;
    one failed check if the study cannot be loaded."""
    from hilbo.study.config import Study

    try:
        study = Study.load(path)
    except InputError as error:
        yield Check("feasible set", "bad", str(error), "fix the study file")
        return
    if study.space.mechanics is not None or study.space.constraints:
        yield _feasible(study)
    yield _step(study)


def _feasible(study: Any) -> Check:
    """The share of the search space that is passive and within the constraints; bad if less than 2 % is passive."""
    from hilbo.search.rendering import delay_words
    from hilbo.search.space import share_of_cube

    space, parts = study.space, []
    if space.mechanics is not None:
        parts.append(delay_words(space) or f"{100 * space.volume():.1f} % of the box can be shown passively")
    if space.constraints:
        share = share_of_cube(space)
        shown = f"{100 * share:.1f} %" if share >= 0.001 else "less than 0.1 %"
        parts.append(f"{shown} of the box is within the constraints{' as well' if parts else ''}")
    small = space.mechanics is not None and space.volume() < 0.02
    return _check("feasible set", ", ".join(parts), small and "lower K1's range, or use a device with more damping")


def _step(study: Any) -> Check:
    """Time from an answer to the next point, compiled before but not chosen in advance; a note if it is above
    `_SLOW`."""
    steps = min(study.file.selection.space_filling + 1, study.file.selection.trials - 1)
    if not steps:
        return Check("time of a step", "good", "none to measure: a session has one trial")
    from hilbo.session.choose.ask_tell import Session

    session, took = Session.start(study, seed=0), 0.0
    session.warm().join()
    for _ in range(steps):
        begun = time.perf_counter()
        session = session.tell(study.responses[0])
        took = time.perf_counter() - begun
    words = f"trial selection without look-ahead takes {1000 * took:.0f} ms"
    return _check("time of a step", words, took > _SLOW and "close other programs", "note")


def _device(connect: Callable[[float | None, float | None], Any], file: Any) -> Iterator[Check]:
    """Checks of the device: connection, loopback and, for the study `file`, its damping and delay against the device's,
    which is connected without them and closed again. One failed check if it cannot be connected."""
    from hilbo.device.failures import DeviceError

    mechanics = file.space.mechanics if file is not None else None
    try:
        device = connect(None, None)
    except (InputError, DeviceError) as error:
        yield Check("device", "bad", str(error), "connect it, or try --device sim")
        return
    with device:
        about = device.device
        yield Check("device", "good", f"{device.link.name}: {about.tick_rate_Hz} ticks a second, {device.state().name}")
        yield _loopback(device)
        if mechanics is not None:
            yield _damping(about.damping_N_s_per_m, float(mechanics.damping))
            yield _delay(device.delay, float(mechanics.delay))


def _language(file: Any) -> Iterator[Check]:
    """Whether the participants' texts are translated, and reviewed by a native speaker: a note if not; nothing for
    English."""
    from hilbo.study.file.languages import LANGUAGES, language

    session = file.session
    if session.language == "en":
        return
    name = LANGUAGES[session.language]
    if left := session.untranslated(file.responses):
        yield Check("language", "note", f"no {name} words for {', '.join(left)}", "write [session.labels]")
    elif language(session.language).reviewed:
        yield Check("language", "good", name)
    else:
        fix = "have a native speaker read both pages of a session with --dry-run"
        yield Check("language", "note", f"{name}: no native speaker has reviewed these texts", fix)


def _stimulus(file: Any) -> Iterator[Check]:
    """Notes on what a study with [stimulus] leaves out: that table, the participants' texts, the number of the ethics
    protocol."""
    table, parameters = file.stimulus, file.space.parameters
    off = ", ".join(f"{p.name} {table.tolerance_words(p)}" for p in parameters if not p.levels)
    words = f"a {table.by} presents, and confirms within {table.within:g} s"
    words += f"; tolerance of confirmed values: {off}" if off else ""
    stated = "stimulus" in json.loads(file.content)
    yield _check("stimulus", words, not stated and "add a table [stimulus]", "note")
    if file.space.mechanics is None:
        left = [key for key in ("title", "hello", "feel_reference", "feel_test") if key not in file.session.texts]
        words = f"{len(left)} speak of feeling a device: {', '.join(left)}" if left else "the study's own"
        yield _check("participants' texts", words, bool(left) and "write your own in [session.texts]", "note")
    number = file.session.protocol_number
    fix = "write [session] protocol_number, so that it is compared with that of the consent"
    yield _check("protocol number", number or "the study names none", not number and fix, "note")


def stimulus_checks(path: Path, port: int, patience: float = _JOINS) -> Iterator[Check]:
    """Have the stimulus program join (by a link printed on stderr, within `patience` s), present and stop, and yield
    how long that took, or one failed check. Raises `InputError` for a study without a program, and if the port is in
    use."""
    from hilbo.app.rigs.stimulus_check import StimulusCheck
    from hilbo.app.server import serve
    from hilbo.study.file.reading import StudyFile

    study = StudyFile.load(path)
    if study.stimulus is not None and study.stimulus.by == "person":
        raise InputError(f"{path}: a person presents, and no program; leave --stimulus out, and try a --dry-run.")
    if study.stimulus is None:
        raise InputError(f"{path}: has a [renderer] and no [stimulus], so that a device renders; leave --stimulus out.")
    place = serve.bound(port)
    check = StimulusCheck(study, patience)

    def started(stop: Callable[[], None]) -> None:
        words = f"start the program that presents, within {patience:g} s, with"
        print(f"{words} {place.link('stimulus')}", file=sys.stderr, flush=True)
        check.begin(stop)

    serve.serve(place, check, started)
    measured = check.measured
    if measured is None or measured.why:
        why = "nothing was measured" if measured is None else measured.why
        yield Check("the program's stop", "bad", why, "fix the program; docs/guides/stimulus.md has the messages")
        return
    for name, times in (("renderings", measured.presented), ("the program's stop", measured.stopped)):
        slowest = f"{len(times)} times, the slowest after {1000 * max(times):.0f} ms"
        yield Check(name, "good", f"{measured.words.rpartition(', stopped')[0]}: {slowest}")


def _loopback(device: Any) -> Check:
    """200 messages to the device and back; bad if any came back changed."""
    count, wrong = 200, 0
    begun = time.perf_counter()
    for i in range(count):
        data = bytes((i + k) % 256 for k in range(32))
        wrong += device.echo(data) != data
    took = (time.perf_counter() - begun) / count
    words = f"{count} messages there and back, {wrong} wrong, {1000 * took:.1f} ms each"
    return _check("device loopback", words, wrong > 0 and "check cable and ground")


def _damping(has: float, needs: float) -> Check:
    """Whether the device's damping (N·s/m) is at least that of the study."""
    words = f"the study assumes {needs:g} N·s/m, the device reports {has:g}"
    fix = "measure it (`hilbo device measure-damping`), then lower the study's"
    return _check("damping", words, has < needs * (1 - 1e-6) and fix)


def _delay(has: float, counted: float) -> Check:
    """Whether the study assumes at least the delay (s) for which the device checks its sets."""
    words = f"the study assumes a delay of at most {1e3 * counted:g} ms; the device checks its sets for"
    fix = f"write [renderer] delay = {has:g} and plan the study again"
    return _check("delay", f"{words} {1e3 * has:g} ms", has > counted + 1e-9 and fix)
