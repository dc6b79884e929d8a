"""Results of a study from which somebody withdraws: what was made of their answers goes, or is marked, or is listed.

A results folder is known by its list (`hilbo.study.results.listing`). Where its files name the participant, everything
in it that was computed goes; tables that were put or exported there stay, without the participant. Results that name
nobody and may hold their answers (of `hilbo validate`, or of earlier versions whose lists have no command) are marked
by a file beside them.
"""

import contextlib
import json
import os
import re
import shlex
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from hilbo.session.plan.plan import plan_hash
from hilbo.session.withdrawal.files import refusals, remove
from hilbo.session.withdrawal.names import file_names, renamed_set
from hilbo.session.withdrawal.tables import replace_file
from hilbo.study.results.listing import LIST, Listed, digest, listed, write_list

__all__ = ["MARK", "Cleared", "clear_results", "command_without", "plan_without", "results_folders"]

MARK = "MADE-BEFORE-A-WITHDRAWAL.txt"
_KEPT = re.compile(
    r"(study\.toml|(trials|validation)(-[^/]*)?\.(csv|parquet)|(sets|truth|participants)\.csv|[^/]*\.session\.jsonl)"
)
_NAMED = ("result.json", "report.html")  # where a result names its participants
_COUNT_PEOPLE = ("plan", "simulate", "power")  # commands whose --participants is a number


class Cleared(NamedTuple):
    """What became of results: files that went, files that were made, commands that make results again, and what was
    refused, file -> why."""

    removed: list[Path]
    marked: list[Path]
    commands: list[str]
    left: dict[str, str]


def results_folders(files: Iterable[Path]) -> list[Path]:
    """The results folders among whose files these are."""
    return sorted(path.parent for path in files if path.name == LIST)


def clear_results(folder: Path, participant: str, files: Collection[Path]) -> Cleared:
    """Take away, or mark, what was computed from somebody's answers; the folder's list and command say so.

    `files`: those that may be touched."""
    results, files = listed(folder), set(files)
    parts = {
        part: [path for name in names if not _is_kept(results, name) and (path := folder / name) in files]
        for part, names in _parts(results).items()
    }
    named = [part for part, paths in parts.items() if any(_names(path, participant) for path in paths)]
    if named and "" in parts and "result.json" not in results.files:
        named = list(dict.fromkeys([*named, ""]))  # what lies above several results was made of all of them
    marked = [part for part, paths in parts.items() if paths and part not in named and _may_hold(results)]
    left: dict[str, str] = {}
    removed = _removed([path for part in named for path in parts[part]], left)
    again = command_without(results.command, participant)
    stays = any(path.name != LIST and path.is_file() for path in files if folder in path.parents)
    forced = f"{again} --force" if again and stays and "--force" not in again.split() else again
    commands = {part: _command(folder / part, results, forced) for part in [*named, *marked] if parts[part]}
    marks = _write_marks({folder / part / MARK: commands[part] for part in marked}, left)
    if removed or marked or again != results.command:
        with refusals(folder / LIST, left):
            _list_again(folder, results, set(marks), again)
            _remove_empty(folder)
    given = [command for command in dict.fromkeys(commands.values()) if command]
    return Cleared(removed, marks, given, left)


def _removed(paths: Iterable[Path], left: dict[str, str]) -> list[Path]:
    """Remove files; those that went."""
    removed = []
    for path in paths:
        with refusals(path, left):
            remove(path)
            removed.append(path)
    return removed


def _write_marks(marks: Mapping[Path, str], left: dict[str, str]) -> list[Path]:
    """Write files that say how results beside them are made again; those that could be written."""
    written = []
    for path, command in marks.items():
        with refusals(path, left):
            path.write_text(_marked(command), encoding="utf-8")
            written.append(path)
    return written


def _list_again(folder: Path, results: Listed, marks: set[Path], command: str) -> None:
    """The list without what went, with the marks, so that --force replaces them too, and with the command of today."""
    files = {name: was for name, was in results.files.items() if (folder / name).is_file()}
    files |= {path.relative_to(folder).as_posix(): digest(path) for path in marks}
    write_list(folder, results._replace(files=files, command=command))


def _parts(results: Listed) -> dict[str, list[str]]:
    """The files of each result in a folder, by the nearest folder above them that has a result.json."""
    with_result = {name.rpartition("/")[0] for name in results.files if name.rpartition("/")[2] == "result.json"}
    parts: dict[str, list[str]] = {}
    for name in results.files:
        above = name.rpartition("/")[0]
        while above and above not in with_result:
            above = above.rpartition("/")[0]
        parts.setdefault(above, []).append(name)
    return parts


def _may_hold(results: Listed) -> bool:
    """Whether results that name nobody may hold anybody's answers: also where no list says what made them."""
    words = _words(results.command)
    return not words or words[1:2] == ["validate"]


def _marked(command: str) -> str:
    again = f"Make them again:\n{command}\n" if command else "Nobody else's answers are in them; delete them.\n"
    return f"These results were made before a participant withdrew, and may hold their answers. {again}"


def _is_kept(results: Listed, name: str) -> bool:
    """Whether a listed file is a table, log or study file, and no result: an export holds nothing else."""
    return "dataset_description.json" in results.files or _KEPT.fullmatch(name.rpartition("/")[2]) is not None


def _names(path: Path, participant: str) -> bool:
    """Whether a file is one in which a result names its participants, and names this one."""
    return (path.name in _NAMED or path.suffix == ".csv") and file_names(path, participant)


def _remove_empty(folder: Path) -> None:
    """Folders in which nothing but the list is left go too."""
    for place, _, _ in os.walk(folder, topdown=False):
        with contextlib.suppress(OSError):  # one that holds something
            os.rmdir(place)
    if os.listdir(folder) == [LIST]:
        remove(folder / LIST)
        folder.rmdir()


def _command(folder: Path, results: Listed, again: str) -> str:
    """What makes the results again: the report of a folder that holds its own tables, else the command that was given,
    without the participant; empty where it was about nobody else."""
    if (folder / "trials.csv").exists() and (folder / "study.toml").exists():
        out = Path(f"{folder}-report")
        return shlex.join(["hilbo", "report", str(folder), "--out", str(out), *["--force"] * out.exists()])
    if not results.command:
        return f"{folder}: by the hilbo command that made it"
    return f"cd {shlex.quote(results.where)} && {again}" if again else ""


def command_without(command: str, participant: str) -> str:
    """A command without a participant among those whom it names; empty if it names nobody else."""
    words, kept = _words(command), []
    names = {"--names"} if words[1:2] and words[1] in _COUNT_PEOPLE else {"--names", "--participants"}
    for before, word in zip(["", *words], words, strict=False):
        option, equals, value = word.partition("=") if word.startswith("--") else (before, "", word)
        people = [name.strip() for name in value.split(",")]
        if option in names and participant in people:
            left = ",".join(name for name in people if name != participant)
            if not left:
                return ""
            word = f"{option}={left}" if equals else left
        kept.append(word)
    return shlex.join(kept) if kept != words else command


def _words(command: str) -> list[str]:
    try:
        return shlex.split(command)
    except ValueError:  # a list that somebody changed
        return command.split()


class _Named(msgspec.Struct):
    participant: str
    reissued_from: str | None = None


class _PlanLike(msgspec.Struct):
    hash: str
    phase: str
    participants: list[_Named]


def plan_without(path: Path, participant: str, label: str) -> bool:
    """Put a label in the place of a participant in a plan, whose hash changes; `replaces` keeps the one that logs
    have. A session of their own sets goes. Whether there was anything to do."""
    try:
        content = path.read_bytes()
        typed = msgspec.json.decode(content, type=_PlanLike)
        plan: dict[str, Any] = msgspec.json.decode(content)
    except (OSError, msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return False
    people = {name for row in typed.participants for name in (row.participant, row.reissued_from)}
    if participant not in people:
        return False
    whole = plan["hash"] == plan_hash(plan)
    plan["participants"] = [
        _row_without(row, participant, label, plan.get("materials") or ())
        for row in plan["participants"]
        if not (row["participant"] == participant and plan.get("source") == "individual")
    ]
    plan["replaces"] = [*plan.get("replaces", []), plan["hash"]]
    plan["hash"] = plan_hash(plan) if whole else plan["hash"]
    place = path.resolve()
    new_file = place.with_name(f".{place.name}-new")
    new_file.write_text(json.dumps(plan, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    replace_file(place, new_file)
    return True


def _row_without(row: dict[str, Any], participant: str, label: str, materials: Iterable[str | None]) -> dict[str, Any]:
    """A plan's row with the label where the participant is named, and in names of sets from their map."""

    def person(values: dict[str, Any], *keys: str) -> dict[str, Any]:
        return values | {key: label for key in keys if values.get(key) == participant}

    def trial(planned: Any) -> Any:
        sides = {side: planned[side] for side in ("a", "b") if isinstance(planned, dict) and side in planned}
        new_names = {
            side: renamed_set(str(name), participant, label, materials) for side, name in sides.items() if name
        }
        return planned | new_names if new_names else planned

    def block(entry: Any) -> Any:
        has_trials = isinstance(entry, dict) and isinstance(entry.get("trials"), list)
        return entry | {"trials": [trial(planned) for planned in entry["trials"]]} if has_trials else entry

    row, header = person(row, "participant", "reissued_from"), row.get("header")
    if not isinstance(header, dict):
        return row
    header = person(header, "participant")
    if isinstance(sets := header.get("sets"), dict):
        header["sets"] = {renamed_set(name, participant, label, materials): values for name, values in sets.items()}
    if isinstance(blocks := header.get("blocks"), list):
        header["blocks"] = [block(entry) for entry in blocks]
    return row | {"header": header}
