"""What every command does around its work: float64 and caches, a results folder that is whole or absent, progress.

A folder is written beside its final place and moved there when it is complete, so that a failure leaves nothing behind
and nothing is overwritten without `--force`. Progress goes to stderr, results with `--json` to stdout.
"""

import contextlib
import gc
import json
import math
import os
import shlex
import shutil
import signal
import sys
import time
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from hilbo.errors import InputError, InputRemark

__all__ = [
    "PARTS",
    "Force",
    "ForceFile",
    "Json",
    "JsonToo",
    "Names",
    "OneMaterial",
    "Out",
    "Preset",
    "Say",
    "cache_folder",
    "check_choice",
    "fail",
    "finish",
    "print_result",
    "progress",
    "remark",
    "results",
    "say_remarks",
    "seed_option",
    "start",
]

Out = Annotated[Path, typer.Option("--out", help="Folder for the results.")]
Names = Annotated[str | None, typer.Option("--names", help="Ids of the participants, separated by commas.")]
OneMaterial = Annotated[str | None, typer.Option("--material", help="Use only this material of the study.")]
Preset = Annotated[
    str | None,
    typer.Option(
        "--preset",
        help="Simulated population: paper, paper-individuals, or paper-01 to paper-30; by default that of [simulation]"
        " in the study file.",
    ),
]
Force = Annotated[bool, typer.Option("--force", help="Replace an existing results folder.")]
ForceFile = Annotated[bool, typer.Option("--force", help="Replace an existing file.")]
Json = Annotated[bool, typer.Option("--json", help="Print result.json on stdout.")]
JsonToo = Annotated[bool, typer.Option("--json", help="Print the output as JSON on stdout.")]

PARTS = ("video-quality", "simulated-memory-foam")
_EVERY, _SOON = 10.0, 1.0  # s, between lines of progress; before the first one with the time left


def seed_option(what: str) -> Any:
    """The option --seed of a command, for `Annotated`; its help is "Random seed" and `what`."""
    return typer.Option("--seed", min=0, max=2**31 - 1, help=f"Random seed {what}.")


def start(devices: int | None = None) -> None:
    """Load JAX with float64, and keep compiled functions in the user's cache folder from one command to the next,
    unless HILBO_KEEP_PROGRAMS=0. Sets environment variables, JAX's settings and the thresholds of garbage collection;
    to be called before JAX computes.

    `devices`: number of devices that JAX makes of the CPU.
    """
    # Matrices are small here: a second thread of OpenBLAS, which reads this once, keeps a core busy by waiting.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Programs and figures are many small objects that live until the end: looking for cycles among them finds none.
    gc.set_threshold(50_000, 20, 50)
    from hilbo.numerics.compiling import set_flags

    set_flags()
    import jax

    jax.config.update("jax_enable_x64", True)
    if devices is not None:
        jax.config.update("jax_num_cpu_devices", devices)
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ and (folder := _compiled_programs()) is not None:
        jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    if os.environ.get("HILBO_KEEP_PROGRAMS", "1") != "0":
        _keep_programs()


def cache_folder() -> Path:
    """The folder of cached functions, one for this user and all studies; it may not exist."""
    return Path(os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")) / "hilbo"


def _compiled_programs() -> Path | None:
    """The folder in which JAX keeps compiled functions, made if there is none; None, with a remark on stderr, if
    another user may have written to it."""
    from hilbo.programs.private import private_folder

    folder = cache_folder() / "jax"
    if private_folder(folder):
        return folder
    remark(
        f"{folder}: belongs to, or may be changed by, another user; it is not used, delete it (hilbo cache --clear)."
    )
    return None


def _keep_programs() -> None:
    """Keep hilbo's traced and compiled functions in the cache folder, for this process."""
    from hilbo.numerics.tracing import keep_with
    from hilbo.programs.entries import Entries
    from hilbo.programs.keeping import Programs

    keep_with(Programs(Entries(cache_folder() / "programs", remark), Path(__file__).parents[2]))


@contextlib.contextmanager
def orderly() -> Iterator[None]:
    """Within the block SIGTERM raises `SystemExit` (143), so that it ends the command as Ctrl-C does: a device is
    stopped, and no half-written file is left."""

    def end(_number, _frame):
        raise SystemExit(143)

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextlib.contextmanager
def results(out: Path, force: bool) -> Iterator[Path]:
    """A new folder that becomes `out` when the block ends well, with a list of its files; by it, `force` later replaces
    only files that hilbo wrote. After an error nothing is left. Raises `InputError` if `out` may not be replaced."""
    from hilbo.report.figures.painter import begin_painter
    from hilbo.study.disk.new_folder import new_folder
    from hilbo.study.results.listing import list_files

    out = out.resolve()
    with orderly(), new_folder(out, lambda: _check_free(out, force)) as made:
        begin_painter()
        yield made
        list_files(made, shlex.join(["hilbo", *sys.argv[1:]]), os.getcwd())


def _check_free(out: Path, force: bool) -> None:
    """Raise `InputError` if the folder `out` may not be replaced: a file, a folder with content without `force`, and
    with it one with files that hilbo did not write or that have been changed."""
    if not out.exists():
        return
    if not out.is_dir():
        raise InputError(f"{out}: is a file; choose a folder for --out.")
    if any(out.iterdir()) and not force:
        raise InputError(f"{out}: exists already; choose another --out, or add --force to replace it.")
    from hilbo.study.disk.lock import LOCK
    from hilbo.study.results.listing import LIST, digest, listed

    ours = listed(out).files
    for path in sorted(path for path in out.rglob("*") if not path.is_dir()):
        name = path.relative_to(out).as_posix()
        if name not in ours and name not in (LIST, LOCK):
            raise InputError(f"{path}: is not a result of hilbo's; choose another --out, so that it is not lost.")
        if name in ours and digest(path) != ours[name]:
            raise InputError(f"{path}: has been changed since hilbo wrote it; choose another --out, or delete it.")


class Say:
    """Progress of a command: called with the current step and, where that is counted, how many are done, and of how
    many. `printed`: the sentences of `tell`."""

    def __init__(self, console: Any, status: Any):
        self._console, self._status, self._pace = console, status, _Pace()
        self.printed: list[str] = []

    def __call__(self, text: str, done: int | None = None, people: int | None = None) -> None:
        """Show progress: on a terminal in the changing line, else as a line if it is new, or `_EVERY` s after the
        last."""
        line, new = self._pace.line(text, done, people, time.perf_counter())
        if self._console.is_terminal:
            self._status.update(line)
        elif new:
            self._console.print(line)

    def tell(self, sentences: list[str]) -> None:
        """Print sentences that stay on a terminal too: results that are known before the others."""
        self.printed += sentences
        for sentence in sentences:
            self._console.print(sentence)


@contextlib.contextmanager
def progress(quiet: bool = False) -> Iterator[Say]:
    """Show on stderr the current step, in one changing line on a terminal, else in a line for each step, or every ten
    seconds within one; at the end, how long it took. `quiet`: print nothing, for the processes whose results are not
    written."""
    from rich.console import Console

    console, begun = Console(stderr=True, highlight=False, markup=False, soft_wrap=True), time.perf_counter()
    console.quiet = quiet
    with console.status("starting") as status:
        yield Say(console, status)
    console.print(f"done in {time.perf_counter() - begun:.1f} s")


class _Pace:
    """The text of progress for work that is counted, with an estimate of the time left."""

    def __init__(self) -> None:
        self.text, self.done, self.first, self.last_shown = "", 0, (0, 0.0), -math.inf
        self.foreseen = False  # whether a line with the time left was printed

    def line(self, text: str, done: int | None, people: int | None, now: float) -> tuple[str, bool]:
        """The line at the time `now` (s), and whether to print it where lines cannot change: a new text, or `_EVERY` s
        since the last. `done` of `people` (None: not counted, or total unknown)."""
        if done is None:
            self.text = text
            return text, True
        if text != self.text or done < self.done:  # the first report includes the compilation, and gives no pace
            again = text == self.text
            self.text, self.first, self.last_shown = text, (done, now), self.last_shown if again else -math.inf
            self.foreseen = self.foreseen and again
        self.done = done
        done_before, time_before = self.first
        line = f"{done:,} {text}" if people is None else f"{done:,} of {people:,} {text}"
        if people is not None and done_before < done < people:
            left = round((now - time_before) / (done - done_before) * (people - done))
            line += f", {left // 60}:{left % 60:02d} left"
        foreseen = line.endswith("left") and not self.foreseen and now - self.last_shown >= _SOON
        if now - self.last_shown < _EVERY and not foreseen:
            return line, False
        self.last_shown, self.foreseen = now, self.foreseen or foreseen
        return line, True


def check_choice(option: str, value: Any, allowed: Collection[Any]) -> None:
    """Raise `InputError` if an option's value is not allowed; None among the `allowed` stands for an option that was
    not given."""
    if value not in allowed:
        names = [str(name) for name in allowed if name is not None]
        listed = f"one of {', '.join(names)}" if len(names) > 2 else " or ".join(names)
        raise InputError(f'--{option} is "{value}"; it must be {listed}.')


def finish(content: dict[str, Any], out: Path, as_json: bool, printed: Collection[str] = ()) -> None:
    """End a command: print the result's warnings that were not `printed` before on stderr, then result.json on stdout
    (`as_json`) or the path of the report on stderr."""
    for warning in content.get("warnings", []):
        if warning not in printed:
            remark(warning)
    if as_json:
        with (out / "result.json").open(encoding="utf-8") as file:
            shutil.copyfileobj(file, sys.stdout)
    else:
        print(f"{out / 'report.html'}", file=sys.stderr)


def print_result(content: Any, words: str, as_json: bool) -> None:
    """Print a result on stdout, as JSON (`as_json`) or in `words`; nothing for empty words."""
    if as_json:
        print(json.dumps(content, indent=2, allow_nan=False, default=float))
    elif words:
        print(words)


def remark(sentence: str) -> None:
    """Print one sentence on stderr, after "hilbo: "."""
    print(f"hilbo: {sentence}", file=sys.stderr)


def say_remarks(show: Callable[..., None]) -> Callable[..., None]:
    """A replacement for `warnings.showwarning` that prints an `InputRemark` as one sentence on stderr, and passes all
    other warnings to `show`."""

    def said(message: Warning | str, category: type[Warning], *where: Any) -> None:
        if issubclass(category, InputRemark):
            remark(str(message))
        else:
            show(message, category, *where)

    return said


def fail(sentence: str, code: int) -> NoReturn:
    """Print one sentence on stderr, and end the process with this exit code."""
    remark(sentence)
    sys.exit(code)
