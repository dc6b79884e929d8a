"""`hilbo try`: take part in a session in three minutes, with a mouse in place of a device.

hilbo try
hilbo try --trials 25 --seed 7 --out tried
"""

import contextlib
import re
import secrets
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from hilbo.cli.live import need_extra
from hilbo.cli.terminal.console import progress, seed_option, start
from hilbo.errors import InputError

__all__ = ["study_text", "tried"]

_LINE = re.compile(r"^trials = \d+$", re.MULTILINE)
_TRIALS = 20


def tried(
    study: Annotated[
        Path | None,
        typer.Argument(help="Study file of K1, B1 and alpha that a program presents; by default hilbo's own."),
    ] = None,
    trials: Annotated[int | None, typer.Option(min=15, max=25, help=f"Number of trials; {_TRIALS} by default.")] = None,
    seed: Annotated[
        int | None, seed_option("of the hidden reference and of the first blocks; random by default")
    ] = None,
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="Port of the server; 0 for any free one.")] = 0,
    out: Annotated[Path | None, typer.Option("--out", help="Folder for study and log; by default a new one.")] = None,
    browse: Annotated[bool, typer.Option("--open/--no-open", help="Open the page in this computer's browser.")] = True,
) -> None:
    """Take part yourself: compare soft blocks under the mouse, and see your own map. No device is needed.

    Serves the page until Ctrl-C.
    """
    need_extra()
    from hilbo.app.server import serve

    text = study_text(study, trials)
    if browse:
        _need_browser()
    seed = secrets.randbelow(2**31) if seed is None else seed
    with contextlib.ExitStack() as held:
        place = serve.bound(port)
        held.callback(place.socket.close)
        folder = held.enter_context(_folder(out))
        (folder / "study.toml").write_text(text, encoding="utf-8")
        with progress() as say:
            say("loading")
            start()
            hub, log, page = _opened(folder, seed, say)
        held.callback(log.close)
        serve.serve(place, hub, lambda _: _started(place, log.path, browse), page)


def _opened(folder, seed, say):
    """The hub of a session with a hidden reference that depends on the seed, its open log in the folder, and the data
    of its page (`Tried`). The folder has study.toml."""
    from hilbo.app.hub.opening import Wanted, opened
    from hilbo.app.server.tried import Tried, hidden_reference
    from hilbo.study.file.reading import StudyFile

    study = StudyFile.load(folder / "study.toml")
    reference = hidden_reference(study, seed)
    wanted = Wanted(folder / "study.toml", f"try-{seed}", seed=seed, logs=folder / "logs", reference=reference)
    hub, log = opened(wanted, lambda *_: None, say)
    hub.gap = 0.4
    return hub, log, Tried(study, reference)


def study_text(source: Path | None, trials: int | None) -> str:
    """The text of the session's study file: hilbo's own with so many `trials`, or that of the file `source`. Raises
    `InputError` for a file that `hilbo try` cannot present, or with `trials` given too."""
    from importlib.resources import files

    if source is None:
        text = (files("hilbo") / "data" / "try.toml").read_text(encoding="utf-8")
        return _LINE.sub(f"trials = {_TRIALS if trials is None else trials}", text)
    if trials is not None:
        raise InputError(f"--trials: {source} specifies the number ([selection] trials); leave the option out.")
    from hilbo.app.server.tried import check_study
    from hilbo.study.file.reading import StudyFile

    check_study(StudyFile.load(source))
    return source.read_text(encoding="utf-8-sig")


@contextlib.contextmanager
def _folder(out: Path | None) -> Iterator[Path]:
    """The folder for study and log: `out`, made if it is missing, or a new temporary one, which is deleted at the end
    unless a log in it has an answer. Raises `InputError` if `out` is not empty."""
    if out is not None:
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise InputError(f"{out}: exists already; choose another --out.")
        out.mkdir(parents=True, exist_ok=True)
        yield out
        return
    folder = Path(tempfile.mkdtemp(prefix="hilbo-try-"))
    try:
        yield folder
    finally:
        if not any('"kind":"answer"' in path.read_text("utf-8") for path in folder.glob("logs/*.jsonl")):
            shutil.rmtree(folder)


def _need_browser() -> None:
    """Raise `InputError` if this computer has no browser."""
    import webbrowser

    try:
        webbrowser.get()
    except webbrowser.Error:
        raise InputError(
            "no browser was found on this computer; add --no-open, and open the link that is printed."
        ) from None


def _started(place, log: Path, browse: bool) -> None:
    """Print the page's link, with the tokens of its two roles, and the log's path on stderr; open the page if
    `browse`."""
    links = place.links(("participant", "stimulus"))
    address, _, token = links["participant"].partition("/#")
    link = f"{address}/try#{token}.{links['stimulus'].partition('/#')[2]}"
    print(f"page: {link}\nlog:  {log}", file=sys.stderr)
    print("The link opens once. Ctrl-C ends it.", file=sys.stderr, flush=True)
    if browse:
        import webbrowser

        webbrowser.open(link)
