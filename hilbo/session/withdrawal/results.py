"""Results of a study that a withdrawal affects: files that were computed with the participant's answers, and the
commands that compute them again.

A results folder is recognised by its list (`hilbo.study.results.listing`). Tables that were put or exported there are
not computed: they stay, without the participant.
"""

import contextlib
import os
import re
import shlex
from collections.abc import Iterable
from pathlib import Path

from hilbo.session.withdrawal.changes import command_without
from hilbo.session.withdrawal.traces import read_text, spelled
from hilbo.study.results.listing import LIST, digest, listed, write_list

__all__ = ["commands_of", "computed", "list_again", "results_folders"]

_DATA = re.compile(
    r"(study\.toml|plan[^/]*\.json|(trials|validation)(-[^/]*)?\.(csv|parquet)|(sets|truth|participants)\.csv"
    r"|[^/]*\.session\.jsonl)"
)
_EXPORT = "dataset_description.json"
_TEXTS = (".json", ".html", ".csv")  # in which results name participants


def results_folders(files: Iterable[Path]) -> list[Path]:
    """The results folders among whose files these are."""
    return [path.parent for path in files if path.name == LIST]


def computed(folder: Path, participant: str, files: Iterable[Path]) -> list[Path]:
    """Files in a results folder that were computed with a participant's answers, as far as can be known; else empty.

    All computed files count if any of the results, or the command that made them, names the participant, or if the
    command is `hilbo validate` or not recorded.
    """
    results, there = listed(folder), set(files)
    ours = [(name, folder / name) for name in results.files if folder / name in there]
    computed = [path for name, path in ours if not _is_data(name, _EXPORT in results.files)]
    may_hold = not results.command or " validate " in f"{results.command} "
    named = command_without(results.command, participant) != results.command
    if computed and (may_hold or named or any(_names_participant(path, participant) for _, path in ours)):
        return computed
    return []


def _is_data(name: str, exported: bool) -> bool:
    """Whether a file of results is data, not computed: a table, log, plan or study file; of an export (`exported`) all
    but netCDF."""
    return not name.endswith(".nc") if exported else _DATA.fullmatch(name.rpartition("/")[2]) is not None


def _names_participant(path: Path, participant: str) -> bool:
    """Whether a text file of results names the participant, by exactly this id; True if it cannot be read."""
    try:
        return path.suffix in _TEXTS and bool(spelled(read_text(path), path.suffix, participant, exact=True))
    except OSError:
        return True


def commands_of(folder: Path, participant: str, go: set[Path], files: Iterable[Path]) -> list[str]:
    """Shell commands that compute the results in `folder` again: `hilbo report` for each folder in them that keeps
    tables of its own, else the recorded command without the participant in --names and --participants; empty if those
    name no other participant. A sentence in their place if no command is recorded.

    `go`: files that will be deleted, and so count as no tables; `files`: all files.
    """
    results, stay = listed(folder), [path for path in files if folder in path.parents and path not in go]
    own = [path.parent for path in stay if path.name == "trials.csv" and path.with_name("study.toml") in stay]
    if own and _EXPORT not in results.files:
        outs = {place: Path(f"{place}-report") for place in own}
        return [
            shlex.join(["hilbo", "report", str(place), "--out", str(out), *["--force"] * out.exists()])
            for place, out in outs.items()
        ]
    if not results.command:
        return [f"{folder}: by the hilbo command that made it"]
    again = command_without(results.command, participant)
    force = " --force" * (any(path.name != LIST for path in stay) and "--force" not in again.split())
    return [f"cd {shlex.quote(results.where)} && {again}{force}"] if again else []


def list_again(folder: Path, participant: str, changed: set[Path]) -> None:
    """Rewrite the list of a results folder without deleted files, with new digests for `changed` ones (real paths), and
    the command without the participant. Deletes empty folders below, and the list and the folder if no file is left."""
    known = listed(folder)
    files = {name: was for name, was in known.files.items() if (folder / name).is_file()}
    files = {
        name: digest(folder / name) if (folder / name).resolve() in changed else was for name, was in files.items()
    }
    for place, _, _ in os.walk(folder, topdown=False):
        with contextlib.suppress(OSError):  # it is not empty
            os.rmdir(place)
    if files:
        write_list(folder, known._replace(files=files, command=command_without(known.command, participant)))
    elif (folder / LIST).exists():
        (folder / LIST).unlink()
        with contextlib.suppress(OSError):
            folder.rmdir()
