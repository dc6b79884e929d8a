"""Somebody withdraws from a study: what of theirs goes, what becomes nobody's, what must be made again, what stays.

`delete_participant` does it to everything below a folder and says all of it. What it does not touch: a log of somebody
else, which is chained and theirs, even where it names a set of the one who withdraws; files that are not hilbo's. Both
are listed. The study goes on: every command still runs on what is left.
"""

import contextlib
import os
import secrets
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from hilbo.errors import InputError
from hilbo.session.log.event_log import read_log
from hilbo.session.log.log_files import in_use, keys_path
from hilbo.session.withdrawal.files import Below, files_below, is_closed, refusals, remove
from hilbo.session.withdrawal.names import CODED_JUDGED, CODED_OWN, file_is_called_after, file_names
from hilbo.session.withdrawal.results import clear_results, plan_without, results_folders
from hilbo.session.withdrawal.tables import (
    Cells,
    coded_own,
    named_sets,
    netcdf_without,
    read_table,
    set_names,
    sets_compared,
    sets_from,
    without_person,
    write_table,
)
from hilbo.study.disk.lock import locked_folder
from hilbo.study.results.listing import LIST, listed, relist

__all__ = ["Withdrawal", "delete_participant"]

_OPTIONAL = ("trials", "validation", "sets", "truth")  # a report takes none of these rather than one without rows
_UNREADABLE = "cannot be read; if it holds their answers, delete it"
_HEAD = 2**12  # bytes of a table's first line
_PICTURES = (".png", ".jpg", ".jpeg", ".gif")


@dataclass
class Withdrawal:
    """What a withdrawal did, and what it left."""

    participant: str
    label: str = field(default_factory=lambda: f"withdrawn-{secrets.token_hex(3)}")
    """What stands in the place of the id where something of theirs stays as nobody's."""
    removed: dict[str, int] = field(default_factory=dict)
    """File -> rows that went, or 1 for the whole file."""
    renamed: dict[str, int] = field(default_factory=dict)
    """File -> rows, or 1 for a plan, in which the label stands now."""
    marked: list[str] = field(default_factory=list)
    """Files that say of the results beside them that they were made before."""
    commands: list[str] = field(default_factory=list)
    """What makes again the results that went or are marked."""
    left: dict[str, str] = field(default_factory=dict)
    """File that still names them, or may -> why it stays."""


def delete_participant(folder: str | os.PathLike, participant: str, done: Withdrawal | None = None) -> Withdrawal:
    """Remove one participant from everything below a folder. Raises InputError if nothing of theirs is there, or one of
    their sessions is running.

    `done` is filled on the way, so that who gave it can say what was done if something unforeseen ends it."""
    if not participant.strip():
        raise InputError("participants delete: give the id of the participant.")
    root = Path(folder)
    done = Withdrawal(participant) if done is None else done
    below = _below(root)
    whose, damaged = _logs(below.files)
    theirs = [path for path, person in whose.items() if person == participant]
    for path in theirs:
        if in_use(path):
            raise InputError(f"{path}: is being written; end the session first.")
    done.left |= below.left
    with _alone_with_lists(below.files):
        _remove([*theirs, *_keys(below.files, participant, whose)], done)
        _results(below.files, done)
        _tables(below, done)
        _plans(below.files, done)
        _lists(below, done)
    after = files_below(root) if root.exists() else Below([], {}, {})  # results, of which nothing is left
    done.left |= after.left | _left(after.files, participant, whose, damaged) | done.left
    if not (done.removed or done.renamed):
        also = f"; look at what is LEFT ({', '.join([*done.left][:3])})" if done.left else ""
        raise InputError(f'{folder}: nothing of participant "{participant}" was removed{also}; check id and folder.')
    if coded := _coded(after.files):
        done.left[str(root)] = (
            f"{len(coded)} files below hold renderings from individuals' maps under codes, theirs perhaps among them;"
            f" the values stay with those who compared them: {', '.join(map(str, coded))}"
        )
    return done


@contextlib.contextmanager
def _alone_with_lists(files: Iterable[Path]) -> Iterator[None]:
    """Nobody is added to a list of participants meanwhile, who would be lost when it is written anew. Raises InputError
    before anything is removed if another hilbo is not done with one."""
    places = sorted({path.resolve().parent for path in _ending(files, ".csv") if _is_list_of_people(path)})
    with contextlib.ExitStack() as locks:
        for place in places:
            locks.enter_context(locked_folder(place))
        yield


def _is_list_of_people(path: Path) -> bool:
    with open(path, "rb") as file:
        return b"consent_time" in file.readline(_HEAD)


def _below(root: Path) -> Below:
    below = files_below(root)
    if str(root) in below.left:
        raise InputError(f"{root}: {below.left[str(root)].partition(';')[0]}; give the folder that holds everything.")
    return below


def _results(files: list[Path], done: Withdrawal) -> None:
    """What was computed from their answers goes, or is marked."""
    for folder in results_folders(files):
        cleared = clear_results(folder, done.participant, files)
        done.removed |= dict.fromkeys(map(str, cleared.removed), 1)
        done.marked += map(str, cleared.marked)
        done.commands += cleared.commands
        done.left |= cleared.left


def _lists(below: Below, done: Withdrawal) -> None:
    """Bring the lists of results folders up to date."""
    changed = _changed(below.links, done)
    for folder in results_folders(below.files):
        with refusals(folder / LIST, done.left):
            if (folder / LIST).exists():
                relist(folder, changed)


def _changed(links: dict[Path, Path], done: Withdrawal) -> set[Path]:
    """All paths at which something changed: also links to files that did. Those to files that went go too."""
    changed = {Path(name) for name in (*done.removed, *done.renamed)}
    places = {path.resolve() for path in changed} | {links[path] for path in changed if path in links}
    for link, place in links.items():
        if os.path.islink(link) and not os.path.exists(place):
            _remove([link], done)
    return changed | {link for link, place in links.items() if place in places}


def _remove(paths: Iterable[Path], done: Withdrawal) -> None:
    for path in paths:
        with refusals(path, done.left):
            remove(path)
            done.removed[str(path)] = 1


def _logs(files: Iterable[Path]) -> tuple[dict[Path, str], list[Path]]:
    """Whose each log is, and the logs that cannot be read."""
    whose, damaged = {}, []
    for path in _ending(files, ".session.jsonl"):
        try:
            whose[path] = read_log(path)[0].participant
        except InputError:
            damaged.append(path)
    return whose, damaged


def _keys(files: Iterable[Path], participant: str, whose: dict[Path, str]) -> list[Path]:
    """The files of keys of one participant's sessions: those beside their logs, and those without a log that begin with
    the id (.ID_SESSION.keys, of earlier versions .ID-SESSION.keys), not with a longer one of somebody else."""
    beside = {keys_path(path): person for path, person in whose.items()}
    begins = (f".{participant}_", f".{participant}-")
    others = {f".{person}{mark}" for person in whose.values() for mark in "_-"}
    longer = tuple(name for name in others if name.startswith(begins) and name not in begins)

    def theirs(path: Path) -> bool:
        person = beside.get(path.with_name(path.name.removesuffix(".part")))
        if person is not None:
            return person == participant
        return path.name.startswith(begins) and not path.name.startswith(longer)

    return sorted(path for path in _ending(files, ".keys", ".keys.part") if theirs(path))


def _tables(below: Below, done: Withdrawal) -> None:
    """Their rows of every table; names of their sets that others have compared become nobody's."""
    paths = _ending(below.files, ".csv", ".parquet")
    places = {path.resolve() for path in paths if path not in below.links}  # a link to one of these is the same table
    paths = [path for path in paths if below.links.get(path) not in places]
    tables = {path: table for path in paths if (table := read_table(path)) is not None}
    done.left |= {str(path): _UNREADABLE for path in paths if path.suffix == ".parquet" and path not in tables}
    names, gone_sets = _sets(tables.values(), done.participant, done.label)
    for path, table in tables.items():
        edited = without_person(table, done.participant, done.label, names, gone_sets)
        rows_removed = len(table.rows) - len(edited.kept)
        if not (rows_removed or edited.renamed):
            continue
        with refusals(path, done.left):
            if edited.table.rows or path.stem.partition("-")[0] not in _OPTIONAL:
                write_table(path, edited)
            else:
                remove(path)
            done.removed |= {str(path): rows_removed} if rows_removed else {}
            done.renamed |= {str(path): edited.renamed} if edited.renamed else {}
    for path in _ending(below.files, ".nc"):
        with refusals(path, done.left):
            rows_removed = netcdf_without(path, done.participant)
            if rows_removed is None:
                done.left[str(path)] = _UNREADABLE
            elif rows_removed:
                done.removed[str(path)] = rows_removed


def _sets(tables: Iterable[Cells], participant: str, label: str) -> tuple[dict[str, str], set[str]]:
    """Names of their sets, and what they are called afterwards; and the sets that nobody else has compared."""
    tables = list(tables)
    compared = {name for table in tables for name in sets_compared(table, participant)}
    names = {old: new for table in tables for old, new in set_names(table, participant, label).items()}
    theirs = {name for table in tables for name in sets_from(table, participant)}
    coded = {name for table in tables for name in coded_own(table, participant)} - compared
    same = {name.rpartition(" ")[0] for name in coded}  # the roles of their map that they have not yet compared
    theirs |= {
        n for table in tables for n in named_sets(table) if CODED_OWN.fullmatch(n) and n.rpartition(" ")[0] in same
    }
    return names, (theirs | set(names)) - compared


def _plans(files: Iterable[Path], done: Withdrawal) -> None:
    for path in _ending(files, ".json"):
        with refusals(path, done.left):
            if path.name != LIST and plan_without(path, done.participant, done.label):
                done.renamed[str(path)] = 1


def _coded(files: Iterable[Path]) -> list[Path]:
    """The files with renderings of individuals' maps that others compare under codes."""

    def holds(path: Path) -> bool:
        if path.suffix in (".csv", ".parquet"):
            table = read_table(path)
            return table is not None and any(CODED_JUDGED.search(name) for name in named_sets(table))
        with contextlib.suppress(OSError):  # listed already
            return CODED_JUDGED.search(path.read_text(encoding="utf-8", errors="replace")) is not None
        return False

    return [path for path in _ending(files, ".csv", ".parquet", ".json", ".jsonl") if holds(path)]


def _ending(files: Iterable[Path], *ends: str) -> list[Path]:
    return [path for path in files if path.name.endswith(ends)]


def _left(files: list[Path], participant: str, whose: dict[Path, str], damaged: Iterable[Path]) -> dict[str, str]:
    """The files that still name somebody, and why they stay."""
    left = {str(path): "is a log that cannot be read; if it is theirs, delete it" for path in damaged if path in files}
    ours = {folder / name for folder in results_folders(files) for name in listed(folder).files}
    for path in (path for path in files if str(path) not in left):
        if path in whose:
            named = file_names(path, participant)
            why = f"is the log of {whose[path]} and names a set of theirs; it is chained, and stays as it is"
            left |= {str(path): why} if named else {}
        elif why := _why_left(path, participant, path in ours):
            left[str(path)] = why
    return left


def _why_left(path: Path, participant: str, ours: bool) -> str:
    """Why a file that is no log is to be looked at; empty if it is not. `ours`: a file of results."""
    if not ours and file_is_called_after(path, participant):
        return "is called after them and is no file that hilbo changes; look at it yourself"
    try:
        closed = is_closed(path)
    except OSError as error:
        return f"cannot be read ({error.strerror}); if it holds anything of theirs, delete it"
    if closed:
        return "" if ours else "cannot be searched; if it holds anything of theirs, delete it"
    if path.suffix.lower() not in _PICTURES and file_names(path, participant):
        return "names them and is no file that hilbo changes; look at it yourself"
    return ""
