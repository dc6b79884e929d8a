"""Damages of every kind of file that hilbo writes and reads again; also those after which all digests were made anew.

    python attacks/damages.py --count 2000 --seed 0 --state damages.json

A damage is refused in one sentence, or what is read is the same as before, or (a log's torn last line) the beginning of
it. Where digests were made anew by hand, or there are none (CSV), what is accepted must be a file that could have been
written: every rendering within its range, every answer one of the study's, no trial answered twice.
"""

import hashlib
import json
import random
import re
import sys
import tempfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[1] / "tests" / "support")]

import jax

jax.config.update("jax_enable_x64", True)

import msgspec
import numpy as np
import xarray as xr
from live import RAW, Driver

from attacks.support import HOSTILE, damaged, main, mutated, scratch
from hilbo import Study
from hilbo.app.pages.session_views import experimenter_view, participant_view
from hilbo.cli.terminal.console import results
from hilbo.errors import InputError
from hilbo.report.result_file import json_lines
from hilbo.report.results import map_dataset
from hilbo.session.choose.warm_start import read_warm_start
from hilbo.session.export import tables as log_tables
from hilbo.session.log.event_log import EventLog, read_session
from hilbo.session.plan.participants import add_person, read_people
from hilbo.session.plan.plan import make_plan, planned_header
from hilbo.session.plan.validation_sets import aggregate_best_sets
from hilbo.study.cohort import read_trials
from hilbo.study.file.plan_file import hashed, plan_in, plan_text, read_plan
from hilbo.study.formats.json_file import sealed
from hilbo.study.results.map_netcdf import write_map
from hilbo.study.results.result_json import read_result
from hilbo.study.tables.trials import write_trials
from hilbo.study.tables.validation import read_validation, sets_frame

__all__ = ["damage_case"]

PLAIN = Study.from_dict(RAW)
PEOPLE = ("P01", "P02", "P03")


class Kind(NamedTuple):
    """A kind of file: how it is read (to what can be compared), how digests are made anew, what a good one keeps."""

    path: Path
    read: Callable[[Path], Any]
    forge: Callable[[random.Random, bytes], bytes] | None
    check: Callable[[Any], None]
    sealed: bool
    """Whether a damage that leaves another good file would be seen."""


def damage_case() -> Callable[[random.Random, int], str]:
    """The attack's case; the files are made anew for each process, in a folder that goes with it."""
    kinds = _kinds(scratch("damages"))
    before = {name: (kind.path.read_bytes(), kind.read(kind.path)) for name, kind in kinds.items()}

    def case(rng: random.Random, number: int) -> str:
        name = list(kinds)[number % len(kinds)]
        kind, (content, whole) = kinds[name], before[name]
        forged = kind.forge is not None and rng.random() < 0.6
        made = kind.forge(rng, content) if forged and kind.forge else damaged(rng, content)
        if made == content:
            return f"{name}: nothing was changed"
        target = kind.path.with_name(f"damaged-{kind.path.name}")
        target.write_bytes(made)
        return f"{name}{' (digests made anew)' if forged else ''}: {_outcome(kind, target, made, whole, forged)}"

    def worded(rng: random.Random, number: int) -> str:
        outcome = case(rng, number)
        return f"THROUGH: {outcome}" if "THROUGH" in outcome else outcome

    return worded


def _outcome(kind: Kind, target: Path, made: bytes, whole: Any, forged: bool) -> str:
    try:
        content = kind.read(target)
    except InputError as error:
        good = "\n" not in str(error) and str(error).strip().endswith(".")
        return "refused" if good else f"THROUGH, no sentence: {error}"
    finally:
        if target.read_bytes() != made:
            return "THROUGH, the file was changed"  # noqa: B012 (reading may not write, whatever it said)
    if content == whole:
        return "the same"
    kind.check(content)  # raises what counts as a traceback
    if kind.sealed and not forged:
        return "the beginning" if _begins(content, whole) else "THROUGH, another content"
    return "another that could have been written"


def _begins(content: Any, whole: Any) -> bool:
    """Whether a log's events are the first ones of the whole log."""
    return isinstance(content, tuple) and content[0] == whole[0] and content[1] == whole[1][: len(content[1])]


def _kinds(folder: Path) -> dict[str, Kind]:
    paper = Study.load(Path(__file__).parents[1] / "hilbo" / "data" / "paper.toml")
    nothing = lambda content: None  # noqa: E731
    kinds = {}
    for name in ("optimisation", "validation"):
        path = _log(folder / f"{name}.session.jsonl", name)
        kinds[f"log of {name}"] = Kind(path, _read_log, _forged_log, _check_log, True)
    kinds["result.json"] = Kind(
        _result(folder / "result.json", paper),
        lambda path: _planned_from(path, paper),
        _forged_result,
        lambda content: _in_range(content[1], paper),
        True,
    )
    kinds["map.nc"] = Kind(
        _map(folder / "map.nc", paper), lambda path: _warm(path, paper), _forged_map, _check_warm, True
    )
    kinds["plan"] = Kind(_plan(folder / "plan.json"), _read_plan, _forged_plan, nothing, True)
    tables = _tables(folder)
    kinds["trial table"] = Kind(tables[0], lambda path: _frame(read_trials(path, PLAIN)), _forged_csv, nothing, False)
    kinds["validation table"] = Kind(
        tables[1], lambda path: _frame(read_validation(path, PLAIN.responses)), _forged_csv, nothing, False
    )
    kinds["sets table"] = Kind(
        tables[2], lambda path: _frame(sets_frame(path, ("u", "v"))), _forged_csv, nothing, False
    )
    kinds["participants.csv"] = Kind(_people(folder / "participants.csv"), read_people, _forged_csv, nothing, False)
    kinds["list of a results folder"] = Kind(*_manifest(folder / "results"), None, nothing, True)
    return kinds


# Session logs.


def _log(path: Path, kind: str) -> Path:
    driver = Driver(kind)
    driver.header = msgspec.structs.replace(driver.header, session=kind)
    driver.state = type(driver.state).start(PLAIN.file, driver.header)
    driver.step()
    doings = ("feel", "answer", "answer", "go", "answer", "hold", "undo", "void", "again", "pause", "resume", "note")
    for number, doing in enumerate(doings * 2):
        driver.do(doing, number)
    driver.finish()
    with EventLog.create(path, PLAIN.file, driver.header) as log:
        for event in driver.events:
            log.append(event)
    return path


def _read_log(path: Path) -> Any:
    """Header and events as plain data; after everything that is made of a log."""
    state = read_session(path, PLAIN.file)
    if state.trials:
        for table in (
            log_tables.trials_table,
            log_tables.validation_table,
            log_tables.sets_table,
            log_tables.presentations_table,
        ):
            table([state])
    msgspec.json.encode(participant_view(state)), msgspec.json.encode(experimenter_view(state))
    lines = [json.loads(line) for line in path.read_bytes().split(b"\n")[: state.seq + 1]]
    return lines[0]["data"], [{key: line[key] for key in ("seq", "kind", "time", "data")} for line in lines[1:]]


def _forged_log(rng: random.Random, content: bytes) -> bytes:
    """One thing changed in a log's events or header, or events moved; numbers, chain and CRCs made anew."""
    lines = [json.loads(line) for line in content.splitlines()]
    at = rng.randrange(len(lines))
    match rng.choice(("data", "data", "data", "line", "double", "remove", "swap", "copy")):
        case "data" if lines[at]["data"]:
            lines[at]["data"] = mutated(rng, lines[at]["data"])
        case "line":
            lines[at][rng.choice(("kind", "time", "data"))] = rng.choice(HOSTILE)
        case "double":
            lines.insert(at, dict(lines[at]))
        case "remove":
            del lines[at]
        case "swap":
            other = rng.randrange(len(lines))
            lines[at], lines[other] = lines[other], lines[at]
        case _:
            lines.insert(rng.randrange(len(lines)), dict(lines[at]))
    previous, made = b"", []
    for number, line in enumerate(lines):
        chained = {"seq": number, **{key: line.get(key) for key in ("kind", "time", "data")}}
        chained["previous"] = hashlib.sha256(previous).hexdigest()[:16] if previous else ""
        text = json.dumps(chained, separators=(",", ":")).encode()[:-1]
        previous = text + b',"crc":"%08x"}\n' % zlib.crc32(text)
        made.append(previous)
    return b"".join(made)


def _check_log(content: Any) -> None:
    """No trial answered twice, every answer one of the study's, every rendering within its range."""
    header, events = content
    answered = [event["data"]["id"] for event in events if event["kind"] == "answer"]
    assert len(set(answered)) == len(answered)
    for event in events:
        if event["kind"] == "answer":
            assert set(event["data"]["values"].values()) <= {*PLAIN.responses, "a", "b"}
        if event["kind"] == "propose":
            for values in event["data"]["renderings"].values():
                _in_range({"": values}, PLAIN)
    assert header["study"] == PLAIN.file.hash


def _in_range(sets: dict[str, dict[str, float]], study: Study) -> None:
    for values in sets.values():
        for p in study.space.parameters:
            slack = 1e-9 * (p.high - p.low)
            assert p.low - slack <= values[p.name] <= p.high + slack, (p.name, values)


# What an aggregation writes.


def _result(path: Path, study: Study) -> Path:
    middle = np.asarray(study.space.latin_hypercube(len(PEOPLE) + 1, 0))
    physical = np.asarray(study.space.to_physical(middle)).tolist()
    optima = [{"parameters": dict(zip(study.space.names, row, strict=True))} for row in physical]
    people = [
        {"participant": name, "trials": 25, "optimum": optimum, "certificate": {"converged": True}}
        for name, optimum in zip(PEOPLE, optima[1:], strict=True)
    ]
    about = {"study": study.file.hash, "meaning": study.file.meaning, "goal": study.goal_label, "seed": 0}
    content = {"optimum": optima[0], "participants": people, **about, "warnings": []}
    path.write_text("".join(sealed(json_lines(content))), encoding="utf-8")
    return path


def _planned_from(path: Path, study: Study) -> Any:
    """What a plan takes from a result: who is in it, and the sets."""
    result = read_result(path, study)
    return sorted(person.participant for person in result.participants), aggregate_best_sets(study, result)


def _forged_result(rng: random.Random, content: bytes) -> bytes:
    tree = json.loads(content)
    del tree["digest"]
    tree = mutated(rng, tree)
    try:
        return "".join(sealed(json_lines(tree))).encode("utf-8", "surrogatepass")
    except (AttributeError, TypeError):
        return json.dumps(tree).encode()


def _map(path: Path, study: Study) -> Path:
    def surface(x):
        x = np.asarray(x)
        return x.sum(axis=1) - 1.5, 0.1 + 0.2 * x[:, 0]

    grid = map_dataset(study, surface, 5)
    write_map(grid.assign_attrs(rule="bcm"), path)
    return path


def _warm(path: Path, study: Study) -> Any:
    warm = read_warm_start(path, study)
    return np.asarray(warm.mean).tolist(), np.asarray(warm.variance).tolist()


def _check_warm(content: Any) -> None:
    mean, variance = map(np.asarray, content)
    assert np.isfinite(mean).all() and np.abs(mean).max() < 1e3
    assert np.isfinite(variance).all() and variance.min() > 0 and variance.max() < 1e2


def _forged_map(rng: random.Random, content: bytes) -> bytes:
    """Numbers, coordinates or attributes changed, and the digest made anew."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.nc"
        path.write_bytes(content)
        with xr.open_dataset(path, engine="h5netcdf") as opened:
            grid = opened.load()
        del grid.attrs["digest"]
        name = rng.choice([*map(str, grid.variables)])
        match rng.choice(("number", "number", "all", "drop", "rename", "slice", "attribute")):
            case "number":
                values = np.array(grid[name].values, float)
                values.flat[rng.randrange(values.size)] = rng.choice((np.nan, np.inf, -1.0, 0.0, 1e308, 1e3, 5e-324))
                grid[name] = (grid[name].dims, values)
            case "all":
                grid[name] = (grid[name].dims, np.array(grid[name].values, float) * rng.choice((-1.0, 1e6, 0.0)))
            case "drop":
                grid = grid.drop_vars(name)
            case "rename":
                grid = grid.rename({name: f"{name}x"})
            case "slice":
                grid = grid.isel({rng.choice([*map(str, grid.sizes)]): rng.choice((0, slice(0, 1), slice(0, 3)))})
            case _:
                grid.attrs["study"] = "0" * 16
        write_map(grid, path)
        return path.read_bytes()


# Plans, tables, the list of a results folder.


def _plan(path: Path) -> Path:
    sets = {"aggregate": {"u": 0.5, "v": 0.25}} | {f"individual:{p}": {"u": 0.1, "v": 0.2} for p in PEOPLE}
    plan = make_plan(PLAIN.file, ["J01", "J02"], 3, "aggregate-best", sets={"": sets})
    path.write_text(plan_text(plan), encoding="utf-8")
    return path


def _read_plan(path: Path) -> Any:
    plan = read_plan(path)
    headers = [planned_header(plan, PLAIN.file, row.participant) for row in plan.participants]
    for header in headers:
        _in_range(header.sets, PLAIN)
        for block in header.blocks:
            assert all({t.a, t.b or t.a} <= set(header.sets) for t in block.trials)
    return headers


def _forged_plan(rng: random.Random, content: bytes) -> bytes:
    forged = json.dumps(mutated(rng, json.loads(content)), indent=1).encode()
    plan = plan_in(forged)
    return forged if plan is None else plan_text(hashed(plan)).encode()


def _tables(folder: Path) -> tuple[Path, Path, Path]:
    """The exported tables of the two logs."""
    sessions = [read_session(path, PLAIN.file) for path in sorted(folder.glob("*.session.jsonl"))]
    made = (log_tables.trials_table(sessions), log_tables.validation_table(sessions), log_tables.sets_table(sessions))
    paths = tuple(folder / f"{name}.csv" for name in ("trials", "validation", "sets"))
    for table, path in zip(made, paths, strict=True):
        write_trials(table, path)
    return paths[0], paths[1], paths[2]


def _frame(table: Any) -> Any:
    return table.reset_index(drop=False).fillna("").to_dict("list")


def _forged_csv(rng: random.Random, content: bytes) -> bytes:
    """One cell replaced by something hostile."""
    rows = [line.split(",") for line in content.decode().splitlines()]
    row = rng.choice(rows)
    value = rng.choice(HOSTILE)
    row[rng.randrange(len(row))] = re.sub(r"[\r\n]", " ", str(value))
    return ("\n".join(",".join(row) for row in rows) + "\n").encode()


def _people(path: Path) -> Path:
    for name in PEOPLE:
        facts = {"participant": name, "consent_time": "2026-05-04T10:00", "protocol_number": "7", "age": "31"}
        add_person(path, facts)
    return path


def _manifest(folder: Path) -> tuple[Path, Callable[[Path], Any]]:
    """The list of a results folder, and how it is read: when the folder is to be replaced."""
    with results(folder, force=False) as made:
        (made / "result.json").write_text("{}")
    listed = folder / ".hilbo.json"

    def read(path: Path) -> Any:
        content = path.read_bytes()
        kept = listed.read_bytes()
        listed.write_bytes(content)
        try:
            with results(folder, force=True) as made:
                (made / "result.json").write_text("{}")
            return "replaced"
        finally:
            listed.write_bytes(kept)

    return listed, read


if __name__ == "__main__":
    main(damage_case, __doc__ or "", 2000)
