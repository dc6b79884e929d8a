"""Results of a study from which somebody withdraws: what was made of their answers goes, or is marked, or is listed.

A results folder is known by its list (`hilbo.study.results_list`). Where its files name the participant, everything in
it that was computed goes; tables that were put or exported there stay, without the participant. Results that name
nobody and may hold their answers (of `hilbo validate`) are marked by a file beside them.
"""

import json
import re
import shlex
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from hilbo.session.plan import plan_hash
from hilbo.session.withdrawn_names import names_person, renamed_set
from hilbo.session.withdrawn_tables import replace_file
from hilbo.study.results_list import LIST, Listed, listed, relist

__all__ = ["MARK", "Cleared", "clear_results", "plan_without", "results_folders"]

MARK = "MADE-BEFORE-A-WITHDRAWAL.txt"
_KEPT = re.compile(
    r"(study\.toml|(trials|validation)(-[^/]*)?\.(csv|parquet)|(sets|truth|participants)\.csv|[^/]*\.session\.jsonl)"
)
_NAMED = ("result.json", "report.html")  # where a result names its participants
_NOBODYS = ("validate",)  # commands whose results may hold answers of people whom they do not name


class Cleared(NamedTuple):
    """What became of results: files that went, files that were made, commands that make results again."""

    removed: list[Path]
    marked: list[Path]
    commands: list[str]


def results_folders(root: Path) -> list[Path]:
    """The results folders below a folder, the folder itself among them."""
    return sorted(path.parent for path in root.rglob(LIST))


def clear_results(folder: Path, participant: str) -> Cleared:
    """Take away, or mark, what was computed from somebody's answers."""
    found, cleared = listed(folder), Cleared([], [], [])
    for part, names in _parts(found).items():
        computed = [folder / name for name in names if not _is_kept(found, name)]
        _clear_part(folder / part, [path for path in computed if path.is_file()], found, participant, cleared)
    if cleared.removed:
        relist(folder, set(cleared.removed))
        _remove_empty(folder)
    return cleared


def _parts(found: Listed) -> dict[str, list[str]]:
    """The files of each result in a folder: of one, whose materials may have folders, or of several side by side."""
    if "result.json" in found.files or not any(name.endswith("/result.json") for name in found.files):
        return {"": list(found.files)}
    parts: dict[str, list[str]] = {}
    for name in found.files:
        parts.setdefault(name.rpartition("/")[0], []).append(name)
    return parts


def _clear_part(part: Path, computed: list[Path], found: Listed, participant: str, cleared: Cleared) -> None:
    if any(_text_names(path, participant) for path in computed if path.name in _NAMED or path.suffix == ".csv"):
        cleared.commands.append(_command(part, found, participant))
        for path in computed:
            path.unlink()
        cleared.removed.extend(computed)
        return
    words = shlex.split(found.command) if found.command else []
    if computed and words[1:2] and words[1] in _NOBODYS:
        mark, command = part / MARK, _command(part, found, participant)
        mark.write_text(
            "These results were made before a participant withdrew, and may hold their answers. Make them again:\n"
            f"{command}\n",
            encoding="utf-8",
        )
        cleared.marked.append(mark)
        cleared.commands.append(command)


def _is_kept(found: Listed, name: str) -> bool:
    """Whether a listed file is a table, log or study file, and no result: an export holds nothing else."""
    return "dataset_description.json" in found.files or _KEPT.fullmatch(name.rpartition("/")[2]) is not None


def _text_names(path: Path, participant: str) -> bool:
    try:
        return names_person(path.read_text(encoding="utf-8"), participant)
    except (OSError, UnicodeDecodeError):
        return False


def _remove_empty(folder: Path) -> None:
    """Folders in which nothing but the list is left go too."""
    for path in sorted((path for path in folder.rglob("*") if path.is_dir()), reverse=True):
        if not any(path.iterdir()):
            path.rmdir()
    if [path.name for path in folder.iterdir()] == [LIST]:
        (folder / LIST).unlink()
        folder.rmdir()


def _command(folder: Path, found: Listed, participant: str) -> str:
    """What makes the results again: the report of a folder that holds its own tables, else the command that was given,
    without the participant."""
    if (folder / "trials.csv").exists() and (folder / "study.toml").exists():
        return shlex.join(["hilbo", "report", str(folder), "--out", f"{folder}-report"])
    if not found.command:
        return f"{folder}: by the hilbo command that made it"
    words = []
    for word in shlex.split(found.command):
        parts = word.split(",")
        words.append(",".join(part for part in parts if part != participant) if len(parts) > 1 else word)
    return f"cd {shlex.quote(found.where)} && {shlex.join(words)}"


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
        known = msgspec.json.decode(content, type=_PlanLike)
        plan: dict[str, Any] = msgspec.json.decode(content)
    except (OSError, msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return False
    people = {name for row in known.participants for name in (row.participant, row.reissued_from)}
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
    made = path.with_name(f".{path.name}-new")
    made.write_text(json.dumps(plan, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    replace_file(path, made)
    return True


def _row_without(row: dict[str, Any], participant: str, label: str, materials: Iterable[str | None]) -> dict[str, Any]:
    """A plan's row with the label where the participant is named, and in names of sets from their map."""

    def person(values: dict[str, Any], *keys: str) -> dict[str, Any]:
        return values | {key: label for key in keys if values.get(key) == participant}

    def trial(planned: Any) -> Any:
        sides = {side: planned[side] for side in ("a", "b") if isinstance(planned, dict) and side in planned}
        made = {side: renamed_set(str(name), participant, label, materials) for side, name in sides.items() if name}
        return planned | made if made else planned

    def block(found: Any) -> Any:
        known = isinstance(found, dict) and isinstance(found.get("trials"), list)
        return found | {"trials": [trial(planned) for planned in found["trials"]]} if known else found

    row, header = person(row, "participant", "reissued_from"), row.get("header")
    if not isinstance(header, dict):
        return row
    header = person(header, "participant")
    if isinstance(sets := header.get("sets"), dict):
        header["sets"] = {renamed_set(name, participant, label, materials): values for name, values in sets.items()}
    if isinstance(blocks := header.get("blocks"), list):
        header["blocks"] = [block(found) for found in blocks]
    return row | {"header": header}
