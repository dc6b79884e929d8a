"""Withdrawal of a participant from a study: deletion, pseudonymisation, recomputation, and remaining files.

`delete_participant` locks the folder throughout. Everything is decided before anything is changed, and written to a
journal, which is deleted last: after an interruption the command is given again and ends as it would have, with the
same pseudonym and the same messages. Until then no other command changes anything below the folder. What is not changed
is listed: logs of other participants, which are chained, even where they name a set of this one; files that are not
hilbo's; ids that are spelled differently.
"""

import contextlib
import errno
import fnmatch
import os
import secrets
from collections.abc import Iterable, Iterator
from pathlib import Path

import msgspec

from hilbo.errors import InputError
from hilbo.session.log.log_files import in_use, keys_path
from hilbo.session.withdrawal.changes import (
    Cells,
    plan_without,
    read_table,
    sets_of,
    table_content,
    without_person,
)
from hilbo.session.withdrawal.left import ending, left_below, logs
from hilbo.session.withdrawal.results import commands_of, computed, list_again, results_folders
from hilbo.session.withdrawal.traces import Below, files_below
from hilbo.study.disk.lock import JOURNAL, LOCK, locked_folder, withdrawal_above
from hilbo.study.disk.new_file import UNFINISHED, remove_unfinished, rewrite_file, write_file
from hilbo.study.disk.new_folder import LEFTOVER, recover
from hilbo.study.file.plan_file import plan_in
from hilbo.study.formats.parsing import UNREADABLE
from hilbo.study.results.listing import LIST

__all__ = ["Withdrawal", "delete_participant"]

_PATIENCE = 60.0  # s; of a withdrawal that waits for another
_OPTIONAL = ("trials", "validation", "sets", "truth")  # a report takes none of these rather than one without rows
_HEAD = 2**12  # bytes of a table's first line


class Withdrawal(msgspec.Struct):
    """What a withdrawal does, and what it leaves. Files are paths relative to the folder in a plan of the withdrawal,
    and full paths once done."""

    participant: str
    label: str = msgspec.field(default_factory=lambda: f"withdrawn-{secrets.token_hex(3)}")
    """The pseudonym that replaces the id in files that remain."""
    removed: dict[str, int] = {}
    """File -> rows that go, or 1 for the whole file."""
    renamed: dict[str, int] = {}
    """File -> rows, or 1 for a plan, with the pseudonym."""
    commands: list[str] = []
    """What makes again the results that go."""
    left: dict[str, str] = {}
    """File that still names them, or may -> why it stays."""
    files: list[str] = []
    """Those that go as a whole,"""
    results: list[str] = []
    """and the results folders that they are in."""
    sets: dict[str, str] = {}
    """Names of their sets -> what they are called now,"""
    sets_gone: list[str] = []
    """and the sets that no other participant has compared."""

    @property
    def begun(self) -> bool:
        """Whether changes of files are planned here, so that some may have been made if this is a journal."""
        return bool(self.files or self.removed or self.renamed)


def delete_participant(folder: str | os.PathLike, participant: str, done: Withdrawal | None = None) -> Withdrawal:
    """Remove one participant from everything below a folder, and return the actions taken and the remaining ones.

    Deletes and rewrites files. Raises InputError if there are no data of the participant, one of their sessions is
    running, results are being computed, or a file could not be changed: all else is done then, and the command is to be
    given again. `done` is filled on the way, so that the caller can report the actions taken even after an error.
    """
    root, done = Path(folder), Withdrawal(participant) if done is None else done
    if not participant.strip():
        raise InputError("participants delete: give the id of the participant.")
    if not root.is_dir():
        raise InputError(f"{root}: cannot be opened (no such folder); give the folder that contains everything.")
    with locked_folder(root, _PATIENCE, in_withdrawal=True), contextlib.ExitStack() as locks:
        before = _journal(root, participant)
        done.label = before.label
        try:
            _wait_for_others(root, locks)
            planned = _planned(root, before)
            if not (planned.files or planned.removed or planned.renamed):
                done.left = left_below(root, participant)
                also = f"; inspect the files listed as LEFT ({', '.join([*done.left][:3])})" if done.left else ""
                raise InputError(
                    f'{root}: nothing of participant "{participant}" was removed{also}; check id and folder.'
                )
            _write_journal(root, planned)
        except BaseException:
            if not before.begun:
                (root / JOURNAL).unlink()
            raise
        refused = _carry_out(root, planned, done)
        done.left |= left_below(root, participant) | refused
        if refused:
            raise InputError(
                f"{next(iter(refused))}: could not be changed ({len(refused)} in all); mend that and give the command"
                f" again, or delete {root / JOURNAL} to leave it so. Until then nothing else is changed here."
            )
        (root / JOURNAL).unlink()
    return done


# Alone with the folder.


def _journal(root: Path, participant: str) -> Withdrawal:
    """Read the journal of an interrupted withdrawal; if there is none, write and return a new one, with the participant
    (not checked) and a new pseudonym, and nothing planned yet.

    Raises `InputError` if it cannot be read or written or is another participant's, or if a withdrawal was interrupted
    in a folder above.
    """
    path = root / JOURNAL
    if above := withdrawal_above(Path(os.path.realpath(root)).parent):
        raise InputError(f"{above}: a withdrawal was interrupted there; give its command again first.")
    try:
        before = msgspec.json.decode(path.read_bytes(), type=Withdrawal)
    except FileNotFoundError:
        before = Withdrawal(participant)
        _write_journal(root, before)
    except (OSError, *UNREADABLE) as error:
        raise InputError(f"{path}: is no journal of a withdrawal that can be read ({error}); delete it.") from error
    if before.participant != participant:
        raise InputError(
            f"{root}: the withdrawal of another participant was interrupted here; first give its command again: hilbo"
            f" participants delete {root} {before.participant} --yes."
        )
    return before


def _write_journal(root: Path, content: Withdrawal) -> None:
    """Write the journal atomically. Raises InputError if it cannot be written."""
    try:
        write_file(root / JOURNAL, msgspec.json.encode(content), replace=True)
    except OSError as error:
        raise InputError(f"{root / JOURNAL}: cannot be written ({error.strerror}); nothing was changed.") from error


def _wait_for_others(root: Path, locks: contextlib.ExitStack) -> None:
    """Lock the folders below that other commands may be changing (the locks are added to `locks`), and clear up what
    killed commands left there. Raises InputError if one is not free in time, results are being computed, or another
    withdrawal was interrupted below."""
    inside, leftovers, places = Path(os.path.realpath(root)), [root], set()
    for place, folders, names in os.walk(root):
        if Path(place) != root and JOURNAL in names:
            raise InputError(f"{place}: a withdrawal was interrupted there; give its command again first.")
        kept = [name for name in folders if not LEFTOVER.fullmatch(name)]
        if kept != folders or fnmatch.filter(names, UNFINISHED):
            leftovers.append(Path(place))
        shared = (os.path.realpath(Path(place, name)) for name in names if _is_shared(Path(place, name)))
        places |= {Path(path).parent for path in shared if Path(path).is_relative_to(inside)}
        places |= {Path(os.path.realpath(place))} if LOCK in names else set()  # a killed command's goes with ours
        folders[:] = kept
    places |= {Path(os.path.realpath(place)) for place in leftovers}
    for place in sorted(places - {inside}):
        locks.enter_context(locked_folder(place, in_withdrawal=True))
    for place in leftovers:
        remove_unfinished(place)
        if filled := recover(place):
            raise InputError(f"{filled[0]}: results are being made there; wait until they are done.")


def _is_shared(path: Path) -> bool:
    """Whether a file is one that several commands rewrite: a list of participants, or a plan. False if it cannot be
    read."""
    try:
        with path.open("rb") as file:
            return (path.suffix == ".csv" and b"consent_time" in file.readline(_HEAD)) or (
                path.suffix == ".json" and plan_in(file.read()) is not None
            )
    except OSError:  # which is reported
        return False


# The actions to take.


def _planned(root: Path, before: Withdrawal) -> Withdrawal:
    """Search the folder and plan all changes, including those of the interrupted withdrawal `before`; changes no file.

    Raises InputError if one of the participant's sessions is running.
    """
    below, person = files_below(root), before.participant
    whose, _ = logs(below.files)
    theirs = [path for path, name in whose.items() if name == person]
    if running := next((path for path in theirs if in_use(path)), None):
        raise InputError(f"{running}: is being written; end the session first.")
    made = {folder: go for folder in results_folders(below.files) if (go := computed(folder, person, below.files))}
    go = {*theirs, *_keys(below.files, person, whose), *(path for paths in made.values() for path in paths)}
    go |= {link for link, place in below.links.items() if place in {path.resolve() for path in go}}
    tables = _tables(below, go)
    sets, sets_gone = before.sets, before.sets_gone
    if not before.begun:  # else some of the tables that decide it are changed
        sets, sets_gone = sets_of(tables.values(), person, before.label)
    planned = Withdrawal(
        **{name: getattr(before, name) for name in ("participant", "label")},
        files=sorted({*before.files, *(_name(root, path) for path in go)}),
        sets=sets,
        sets_gone=sorted(sets_gone),
    )
    for path, table in tables.items():
        edited = without_person(table, person, planned.label, planned.sets, planned.sets_gone)
        rows = len(table.rows) - len(edited.kept)
        planned.removed |= {_name(root, path): rows} if rows else {}
        planned.renamed |= {_name(root, path): edited.renamed} if edited.renamed else {}
    for path in ending(below.files, ".json"):
        if path not in go and path.name != LIST and _plan(path, planned) is not None:
            planned.renamed[_name(root, path)] = 1
    planned.removed |= before.removed
    planned.renamed |= before.renamed
    changed = {root / name for name in (*planned.files, *planned.removed, *planned.renamed)}
    touched = [place for place in results_folders(below.files) if any(place in path.parents for path in changed)]
    planned.results = sorted({*before.results, *(_name(root, place) for place in touched)})
    again = (commands_of(place, person, go, below.files) for place in made if _name(root, place) not in before.results)
    planned.commands = list(dict.fromkeys([*before.commands, *(line for lines in again for line in lines)]))
    return planned


def _name(root: Path, path: Path) -> str:
    """Path relative to the folder `root`, with slashes."""
    return path.relative_to(root).as_posix()


def _keys(files: Iterable[Path], participant: str, whose: dict[Path, str]) -> list[Path]:
    """Files of browser keys of one participant's sessions. `whose`: log -> participant.

    They are those next to their logs, and those without a log whose name begins with the id (.ID_SESSION.keys, in
    earlier versions .ID-SESSION.keys) and not with a longer id of another participant.
    """
    beside = {keys_path(path): person for path, person in whose.items()}
    begins = (f".{participant}_", f".{participant}-")
    others = {f".{person}{mark}" for person in whose.values() for mark in "_-"}
    longer = tuple(name for name in others if name.startswith(begins) and name not in begins)

    def theirs(path: Path) -> bool:
        """Whether a file of keys belongs to the participant."""
        person = beside.get(path.with_name(path.name.removesuffix(".part")))
        if person is not None:
            return person == participant
        return path.name.startswith(begins) and not path.name.startswith(longer)

    return [path for path in ending(files, ".keys", ".keys.part") if theirs(path)]


def _tables(below: Below, go: set[Path]) -> dict[Path, Cells]:
    """Read the tables that stay, each once even if links lead to it: path -> cells. `go`: files that are deleted."""
    paths = [path for path in ending(below.files, ".csv", ".parquet") if path not in go]
    places = {path.resolve() for path in paths if path not in below.links}
    paths = [path for path in paths if below.links.get(path) not in places]
    return {path: table for path in paths if (table := read_table(path)) is not None}


def _plan(path: Path, planned: Withdrawal) -> str | None:
    """Text of a plan's file without the participant; None if it is no plan, does not name them, or cannot be read."""
    try:
        return plan_without(path.read_bytes(), planned.participant, planned.label)
    except OSError:  # which is reported
        return None


# Doing it.


def _carry_out(root: Path, planned: Withdrawal, done: Withdrawal) -> dict[str, str]:
    """Make the planned changes, of which some may have been made before; fill `done`. Returns path -> reason for each
    file that could not be changed."""
    refused: dict[str, str] = {}
    for name in planned.files:
        with _refusals(root / name, refused):
            _remove(root / name)
            done.removed[str(root / name)] = 1
    for name in sorted({*planned.removed, *planned.renamed}):
        with _refusals(root / name, refused):
            _rewrite(root / name, planned)
            done.removed |= {str(root / name): planned.removed[name]} if name in planned.removed else {}
            done.renamed |= {str(root / name): planned.renamed[name]} if name in planned.renamed else {}
    changed = {(root / name).resolve() for name in (*planned.removed, *planned.renamed)}
    for name in sorted(planned.results, reverse=True):  # those within others first
        with _refusals(root / name / LIST, refused):
            list_again(root / name, planned.participant, changed)
    done.commands += planned.commands
    return refused


@contextlib.contextmanager
def _refusals(path: Path, refused: dict[str, str]) -> Iterator[None]:
    """Context: catch an OSError about the file `path` and add its reason to `refused`, so that the withdrawal
    continues."""
    try:
        yield
    except OSError as error:
        why = f"could not be changed ({error.strerror or error}); if it contains their data, delete it"
        refused[str(path)] = why


def _remove(path: Path) -> None:
    """Delete a file if it exists; for a link first its target, so that a target that cannot be deleted is still
    found."""
    path.resolve().unlink(missing_ok=True)
    path.unlink(missing_ok=True)


def _rewrite(path: Path, planned: Withdrawal) -> None:
    """Rewrite a table or a plan without the participant; a file that is done already stays unchanged. Deletes an
    optional table of a report that has no rows left. Raises OSError."""
    if path.suffix == ".json":
        if (text := _plan(path, planned)) is not None:
            rewrite_file(path.resolve(), text)
        return
    if not path.exists():
        return
    if (table := read_table(path)) is None:
        raise OSError(errno.EIO, "it can no longer be read")
    edited = without_person(table, planned.participant, planned.label, planned.sets, planned.sets_gone)
    if not edited.kept and path.stem.partition("-")[0] in _OPTIONAL:
        _remove(path)
    elif len(edited.kept) < len(table.rows) or edited.renamed:
        rewrite_file(path.resolve(), table_content(path, edited))
