"""Mutated study files and tables, read in this process; every 21st through the real command in a process of its own.

    python attacks/inputs.py --count 1050 --seed 0 --state inputs.json     # 1,000 in process, 50 through commands

What is refused is refused in one sentence, with exit code 2 and no results; what is accepted is within the study's
ranges, with ids that are ids and no cell that a spreadsheet would run. No input file is changed.
"""

import csv
import io
import json
import os
import random
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT)]

import jax

jax.config.update("jax_enable_x64", True)

import pandas as pd

from attacks.support import HOSTILE, damaged, main, mutated, scratch
from hilbo.errors import InputError
from hilbo.session.plan.participants import read_people
from hilbo.statistics.paper_tables import paper_tables
from hilbo.study.cohort import cohort_of, read_trials
from hilbo.study.config import Study
from hilbo.study.folder import read_folder
from hilbo.study.formats.cell_text import is_id, runs_in_a_spreadsheet
from hilbo.study.tables.validation import read_validation, sets_frame

__all__ = ["input_case"]

REAL = 21
TOML = (ROOT / "hilbo" / "data" / "paper.toml").read_text(encoding="utf-8")
STUDY = Study.load(ROOT / "hilbo" / "data" / "paper.toml")
TABLES = ("trials.csv", "validation.csv", "sets.csv", "participants.csv")


def input_case(real: bool = True) -> Callable[[random.Random, int], str]:
    """The attack's case. `real`: every 21st by a command of its own."""
    whole = scratch("inputs")
    _make(whole)
    contents = {name: (whole / name).read_bytes() for name in ("study.toml", *TABLES)}

    def case(rng: random.Random, number: int) -> str:
        name = rng.choice(("study.toml", *TABLES))
        made, suffix = _mutated(rng, name, contents[name])
        with tempfile.TemporaryDirectory(dir=whole) as here:
            place = Path(here)
            for other, content in contents.items():
                (place / other).write_bytes(content)
            path = place / name
            path.write_bytes(made)
            if suffix == ".parquet" and (table := _as_parquet(path)) is not None:
                path = table
            before = path.read_bytes()
            through = real and number % REAL == REAL - 1
            outcome = _command(place, path) if through else _read(place, path)
            if path.read_bytes() != before:
                outcome = "THROUGH, the input was changed"
        words = f"{name}{' by a command' if through else ''}: {outcome}"
        return f"THROUGH: {words}" if "THROUGH" in outcome else words

    return case


# Ways to spoil.


def _mutated(rng: random.Random, name: str, content: bytes) -> tuple[bytes, str]:
    """The content of a file with something in it changed; and as what the table is written."""
    if rng.random() < 0.25:
        return damaged(rng, content), ""
    if name == "study.toml":
        return _toml(mutated(rng, tomllib.loads(content.decode()))).encode("utf-8", "replace"), ""
    rows = list(csv.reader(io.StringIO(content.decode())))
    for _ in range(rng.choice((1, 1, 2, 5))):
        _spoil(rng, rows)
    text = io.StringIO()
    csv.writer(text, lineterminator=rng.choice(("\n", "\n", "\r\n"))).writerows(rows)
    return text.getvalue().encode("utf-8", "replace"), ".parquet" if rng.random() < 0.15 else ""


def _spoil(rng: random.Random, rows: list[list[str]]) -> None:
    row, column = rng.randrange(len(rows)), rng.randrange(max(1, len(rows[0])))
    match rng.choice(("cell", "cell", "cell", "head", "double", "remove", "short", "long", "swap", "column")):
        case "cell":
            rows[row] = [*rows[row][:column], _text(rng), *rows[row][column + 1 :]]
        case "head":
            rows[0] = [*rows[0][:column], _text(rng), *rows[0][column + 1 :]]
        case "double":
            rows.insert(row, list(rows[row]))
        case "remove" if len(rows) > 1:
            del rows[row]
        case "short":
            rows[row] = rows[row][:column]
        case "long":
            rows[row] = [*rows[row], _text(rng)]
        case "swap":
            rows[row] = rows[row][::-1]
        case _:
            for number, cells in enumerate(rows):
                rows[number] = [cell for i, cell in enumerate(cells) if i != column]


def _text(rng: random.Random) -> str:
    value = rng.choice((*HOSTILE, "inf", "1e400", "1_000", " 1", "=cmd|' /C calc'!A1", "individual:..", "P 1", "0x10"))
    return value if isinstance(value, str) else json.dumps(value)


def _as_parquet(path: Path) -> Path | None:
    """The same table as Parquet, where it is one."""
    try:
        frame = pd.read_csv(path)
        made = path.with_suffix(".parquet")
        frame.to_parquet(made, index=False)
    except Exception:  # what pandas cannot read stays as CSV
        return None
    path.unlink()
    return made


def _toml(tree: Any, path: str = "") -> str:
    """A parsed study file as text; lists and scalars as JSON writes them, which TOML reads."""
    if not isinstance(tree, dict):
        return f"x = {json.dumps(tree)}\n"
    lines = [f"{json.dumps(k)} = {_inline(v)}" for k, v in tree.items() if not isinstance(v, dict) and v is not None]
    for key, value in tree.items():
        if isinstance(value, dict):
            name = f"{path}.{json.dumps(key)}" if path else json.dumps(key)
            lines += [f"[{name}]", _toml(value, name)]
    return "\n".join(lines) + "\n"


def _inline(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(k)} = {_inline(v)}" for k, v in value.items() if v is not None) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(_inline(v) for v in value if v is not None) + "]"
    return json.dumps(value)


# What reads them.


def _read(place: Path, path: Path) -> str:
    try:
        _use(place, path)
    except InputError as error:
        good = str(error).strip().endswith(".") and "\n" not in str(error).strip()
        return "refused" if good else f"THROUGH, no sentence: {error!r}"
    return "accepted"


def _use(place: Path, path: Path) -> None:
    """Everything that is made of a file before the fits; raises AssertionError for what should not have passed."""
    study = Study.load(place / "study.toml")
    match path.stem:
        case "study":
            for name in study.file.materials or ("",):
                space = (study.material(name) if name else study).space
                assert space.names
        case "trials":
            table = read_trials(path, study)
            cohort_of(table, study)
            for p in study.space.parameters:
                assert table[p.name].between(p.low, p.high).all()
            _check_cells(table)
        case "validation":
            table = read_validation(path, study.responses)
            paper_tables(table, sets_frame(place / "sets.csv", study.space.names), responses=study.responses)
            _check_cells(table)
        case "sets":
            table = sets_frame(path, study.space.names)
            assert table[list(study.space.names)].notna().all().all()
            _check_cells(table.reset_index())
        case _:
            assert all(name.strip() for name in read_people(path))  # of earlier versions, whose ids had other rules
    read_folder(place)


def _check_cells(table: pd.DataFrame) -> None:
    if "participant" in table:
        assert all(is_id(name) for name in table["participant"])
    for column in table.columns:
        assert not any(isinstance(cell, str) and runs_in_a_spreadsheet(cell) for cell in table[column])


def _command(place: Path, path: Path) -> str:
    """The command that reads this file, as a user types it."""
    given, out = ("--study", "study.toml", "--out", "results"), place / "results"
    command = {
        "study": ("plan", "study.toml", "--participants", "2", "--out", "results"),
        "trials": ("aggregate", path.name, *given, "--no-individuals"),
        "validation": ("validate", path.name, "--sets", "sets.csv", *given),
        "sets": ("validate", "validation.csv", "--sets", path.name, *given),
        "participants": (
            *("participants", "add", path.name, "P99", "--consent-time", "2026-05-04", "--protocol-number", "7"),
        ),
    }[path.stem]
    before = path.read_bytes()
    run = subprocess.run(
        [sys.executable, "-c", "from hilbo.cli.main import main; main()", *command],
        cwd=place,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=600,
    )
    if "Traceback" in run.stderr or run.returncode not in (0, 2):
        return f"THROUGH, exit code {run.returncode}: {run.stderr}"
    if run.returncode == 0:
        if path.stem == "participants":
            path.write_bytes(before)  # as for a change
        return "accepted"
    words = [line for line in run.stderr.splitlines() if line.startswith("hilbo: ")]
    return "refused" if len(words) == 1 and not out.exists() else f"THROUGH, no sentence or a result: {run.stderr}"


def _make(folder: Path) -> None:
    """A small study: three people's answers, comparisons of four sets, a list of participants."""
    rng = random.Random(0)
    unit = STUDY.space.latin_hypercube(30, 0)
    rows = [dict(zip(STUDY.space.names, row, strict=True)) for row in STUDY.space.to_physical(unit).tolist()]
    (folder / "study.toml").write_text(TOML, encoding="utf-8")
    trials = [
        {
            "participant": f"P{i // 8 + 1:02d}",
            "trial": i % 8 + 1,
            "session": "1",
            "response": rng.choice(STUDY.responses),
        }
        | rows[i]
        for i in range(24)
    ]
    pd.DataFrame(trials).to_csv(folder / "trials.csv", index=False)
    names = {"best": "aggregate", "mid": "aggregate", "worst": "aggregate", "own-s1": "individual:s1"}
    sets = [{"set_id": n, "source": s} | rows[24 + i] for i, (n, s) in enumerate(names.items())]
    pd.DataFrame(sets).to_csv(folder / "sets.csv", index=False)
    pairs = [("best", "mid"), ("best", "worst"), ("mid", "worst"), ("best", "own-s1")]
    compared = []
    for i in range(32):
        a, b = pairs[i % 4]
        answers = {"class_a": rng.choice(STUDY.responses), "class_b": rng.choice(STUDY.responses)}
        compared.append(
            {"participant": f"V{i // 8 + 1}", "trial": i % 8 + 1, "set_a": a, "set_b": b, "first": "a"}
            | answers
            | {"preferred": rng.choice((a, b))}
        )
    pd.DataFrame(compared).to_csv(folder / "validation.csv", index=False)
    people = [{"participant": f"P0{i}", "consent_time": "2026-05-04T10:00", "protocol_number": "7"} for i in (1, 2, 3)]
    pd.DataFrame(people).to_csv(folder / "participants.csv", index=False)


if __name__ == "__main__":
    main(input_case, __doc__ or "", 1050)
