"""The files below a folder that still name a participant after a withdrawal, or may, and why they stay."""

import contextlib
from collections.abc import Iterable
from pathlib import Path

from hilbo.errors import InputError
from hilbo.session.log.event_log import read_log
from hilbo.session.log.log_files import is_log
from hilbo.session.withdrawal.changes import CODED_JUDGED, Cells, Edited, named_sets, read_table, table_content
from hilbo.session.withdrawal.results import results_folders
from hilbo.session.withdrawal.traces import called_after, files_below, is_closed, read_text, spelled
from hilbo.study.results.listing import listed

__all__ = ["ending", "left_below", "logs"]

_PICTURES = (".png", ".jpg", ".jpeg", ".gif")


def ending(files: Iterable[Path], *ends: str) -> list[Path]:
    """The files whose names end in one of `ends`."""
    return [path for path in files if path.name.endswith(ends)]


def logs(files: Iterable[Path]) -> tuple[dict[Path, str], list[Path]]:
    """Find the logs among the files, also under other names: path -> participant, and the list of those that cannot be
    read."""
    whose, damaged = {}, []
    for path in (path for path in files if path.name.endswith(".session.jsonl") or is_log(path)):
        try:
            whose[path] = read_log(path)[0].participant
        except InputError:
            damaged.append(path)
    return whose, damaged


def left_below(root: Path, participant: str) -> dict[str, str]:
    """Search a folder for files that name a participant, or may: path -> reason why the file stays, as a predicate."""
    below = files_below(root)
    whose, damaged = logs(below.files)
    left = below.left | {str(path): "is a log that cannot be read; if it is theirs, delete it" for path in damaged}
    ours = {folder / name for folder in results_folders(below.files) for name in listed(folder).files}
    for path in below.files:
        why = "" if str(path) in left else _why_left(path, participant, path in ours, whose.get(path))
        left |= {str(path): why} if why else {}
    if coded := [path for path in ending(below.files, ".csv", ".parquet", ".json", ".jsonl") if _holds_coded(path)]:
        left[str(root)] = (
            f"{len(coded)} files below contain stimuli from individual maps under codes, theirs perhaps among them;"
            f" the values stay with those who compared them: {', '.join(map(str, coded))}"
        )
    return left


def _why_left(path: Path, participant: str, ours: bool, owner: str | None) -> str:
    """Reason why a file needs the user's attention, as a predicate; "" if it does not. Reads the file.

    `ours`: it is one of hilbo's results; `owner`: participant of the log that it is, None for other files.
    """
    if not ours and owner is None and called_after(path, participant):
        return "is called after them and is no file that hilbo changes; inspect it yourself"
    try:
        table = read_table(path) if path.suffix == ".parquet" else None
        if table is None and is_closed(path):
            return "" if ours else "cannot be searched; if it contains their data, delete it"
        if path.suffix.lower() in _PICTURES:
            return ""
        text, suffix = (read_text(path), path.suffix) if table is None else (_as_csv(table), ".csv")
    except OSError as error:
        return f"cannot be read ({error.strerror}); if it contains their data, delete it"
    if not (word := spelled(text, suffix, participant)):
        return ""
    if owner is not None:
        return f'is the log of {owner} and contains "{word}"; it is chained, and is not changed'
    if not spelled(text, suffix, participant, exact=True):
        return f'contains "{word}", which may be them; only rows of exactly "{participant}" go; inspect it yourself'
    return "names them and is no file that hilbo changes; inspect it yourself"


def _as_csv(table: Cells) -> str:
    """CSV text of a table."""
    return table_content(Path("table.csv"), Edited([], table, 0)).decode()


def _holds_coded(path: Path) -> bool:
    """Whether a file names individual sets under codes, as other participants compare them; False if it cannot be
    read."""
    if path.suffix == ".parquet":
        table = read_table(path)
        return table is not None and any(CODED_JUDGED.search(name) for name in named_sets(table))
    with contextlib.suppress(OSError):  # listed already
        return CODED_JUDGED.search(path.read_text(encoding="utf-8", errors="replace")) is not None
    return False
