"""Each person in turn withdraws from a simulated study: every command still runs, the id is only where it was said.

    python attacks/withdrawals.py --count 24 --seed 0 --state withdrawals.json

The study has tables, logs of the same answers, logs of people who compared everybody's own sets, plans, an export, and
the results of every command on them. Case n takes person n out of a fresh copy.
"""

import contextlib
import io
import random
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[1])]

import pandas as pd
import xarray as xr

from attacks.support import main, scratch
from hilbo.cli import main as hilbo_main
from hilbo.cli.terminal.console import start

PEOPLE, JUDGES = 24, 2
SENTENCES = re.compile(r"Traceback|Error:")
_PICTURE = re.compile(r"base64,[A-Za-z0-9+/=\s]+")

__all__ = ["make_logs", "withdrawal_case"]


def withdrawal_case(people: int = PEOPLE, quick: bool = False) -> Callable[[random.Random, int], str]:
    """The attack's case. `quick`: without the report and the robustness check, which are most of the time."""
    start()
    folder = scratch("withdrawals")
    whole = folder / "whole"
    _make(whole, people, quick)

    def case(rng: random.Random, number: int) -> str:
        person = f"P{number % people + 1:02d}"
        copy = folder / "copy"
        shutil.copytree(whole, copy)
        try:
            return _withdraw(copy, person, quick)
        finally:
            shutil.rmtree(copy)

    return case


def _withdraw(study: Path, person: str, quick: bool) -> str:
    with contextlib.chdir(study):
        said = _run("participants", "delete", ".", person, "--yes")
        listed = {Path(line.split(": LEFT; ")[0]) for line in said.splitlines() if ": LEFT; " in line}
        if unsaid := [path for path in _naming(Path(), person) if path not in listed]:
            return f"THROUGH: {person} is still in {', '.join(map(str, unsaid))}"
        for command in _commands(quick):
            _run(*command)
        _resume_all()
        again = [path for path in _naming(Path(), person) if path not in listed]
        return f"THROUGH: {person} is back in {', '.join(map(str, again))}" if again else "every command runs"


def _commands(quick: bool) -> list[list[str]]:
    """What a lab does with the study, with results in folders called after-…"""
    given = "--study study.toml --out"
    lines = [
        f"aggregate trials.csv {given} after-map",
        f"aggregate logs {given} after-logs",
        f"validate validation.csv --sets sets.csv {given} after-validation",
        f"export logs {given} after-tables",
        f"export judges {given} after-judged",
        "plan study.toml --names Q01,Q02 --out after-plan.json",
        "plan study.toml --names J09 --kind aggregate-best --from after-map/result.json --out after-best.json",
        "plan study.toml --names V1 --kind validation --from after-map/result.json --table logs --out after-v.json",
        "plan study.toml --reissue P03=P99 --out plan.json" if Path("plan.json").read_text().count('"P03"') else "",
    ]
    if not quick:
        lines += [f"robustness trials.csv {given} after-check", "report . --no-compare --out ../after-report"]
    return [line.split() for line in lines if line]


def _run(*command: str) -> str:
    """A command in this process; what it said on stderr. Raises RuntimeError if it ends otherwise than with 0."""
    said, before = io.StringIO(), sys.argv
    sys.argv = ["hilbo", *command]
    shutil.rmtree("../after-report", ignore_errors=True)
    try:
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
            hilbo_main.main()
    except SystemExit as stopped:
        if stopped.code:
            raise RuntimeError(f"hilbo {' '.join(command)}: {said.getvalue()}") from None
    finally:
        sys.argv = before
    if SENTENCES.search(said.getvalue()):
        raise RuntimeError(f"hilbo {' '.join(command)}: {said.getvalue()}")
    return said.getvalue()


def _resume_all() -> None:
    """Everybody else's session can be gone on with."""
    from hilbo.session.log.event_log import EventLog
    from hilbo.study.config import Study

    study = Study.load("study.toml")
    for path in sorted(Path().rglob("*.session.jsonl")):
        EventLog.resume(path, study.file).close()


def _naming(root: Path, person: str) -> list[Path]:
    """The files that hold the id as a word: in their names, text, cells, or netCDF names, attributes and variables.
    Bytes are not searched, of binary files or of pictures in a page: in a megabyte of them any three letters come up by
    chance."""
    word = re.compile(rf"(?<![A-Za-z0-9]){person}(?![A-Za-z0-9])")
    paths = []
    for path in sorted(path for path in root.rglob("*") if path.is_file() and path.suffix != ".png"):
        texts = [path.name.replace("_", " ")]
        if path.suffix == ".nc":
            with xr.open_datatree(path, engine="h5netcdf") as tree:
                for node in tree.subtree:
                    texts += [node.path, str(node.attrs), str(list(node.variables))]
                    texts += [f"{v.attrs} {v.values.tolist()}" for v in node.variables.values() if v.size < 1e4]
        elif path.suffix == ".parquet":
            texts.append(pd.read_parquet(path).to_csv())
        else:
            texts.append(_PICTURE.sub("", path.read_bytes().decode("utf-8", "replace")))
        if any(word.search(text) for text in texts):
            paths.append(path)
    return paths


# The study before anybody withdraws.


def _make(folder: Path, people: int, quick: bool) -> None:
    from hilbo.cli.study import simulated_report
    from hilbo.simulation.folder import simulate_folder

    folder.mkdir()
    if quick:
        simulate_folder(folder, "paper", people, 0)
        _quick_validation(folder)
    else:
        (folder / "made").mkdir()
        simulated_report(folder / "made", 0, lambda *_: None, people)
        for name in ("study.toml", "trials.csv", "truth.csv", "sets.csv", "validation.csv"):
            shutil.move(folder / "made" / name, folder / name)
        shutil.rmtree(folder / "made")
    with contextlib.chdir(folder):
        pd.read_csv("trials.csv").to_parquet("copy.parquet", index=False)
        for number in range(1, people + 1):
            consent = ("--consent-time", "2026-05-04T10:00", "--protocol-number", "7")
            _run("participants", "add", "participants.csv", f"P{number:02d}", *consent)
        _run("plan", "study.toml", "--participants", str(people), "--out", "plan.json")
        make_logs(Path("logs"))
        _run("aggregate", "trials.csv", "--study", "study.toml", "--out", "first-map")
        _judged(Path("judges"))
        for command in _commands(quick)[1:]:
            if "--reissue" not in command:
                _run(*[word.replace("after-", "first-") for word in command])
        if Path("../first-report").exists():
            shutil.move("../first-report", "first-report")


def _quick_validation(folder: Path) -> None:
    """Sets and comparisons of a study whose map was not made."""
    import jax.numpy as jnp
    import numpy as np

    from hilbo.simulation.presets import PRESETS
    from hilbo.simulation.validation_sessions import sets_table, validation_table
    from hilbo.study.analysis.best_mid_worst import Sets
    from hilbo.study.config import Study

    study = Study.load(folder / "study.toml")
    count = pd.read_csv(folder / "trials.csv")["participant"].nunique()
    x = np.asarray(study.space.latin_hypercube(3 + count, 1))
    sets = sets_table(study, Sets(jnp.asarray(x[:3]), jnp.zeros(3), jnp.ones(3)), x[3:])
    sets.to_csv(folder / "sets.csv", index=False)
    validation_table(study, PRESETS["paper"], sets, participants=4, judges=2).to_csv(
        folder / "validation.csv", index=False
    )


class _Given:
    """Proposes the renderings of a table, in their order."""

    def __init__(self, rows: pd.DataFrame, names: tuple[str, ...]) -> None:
        self.rows, self.names = rows, names

    def choose(self, state, need):
        row = self.rows.iloc[len(state.trials)]
        return {"renderings": {"a": {name: float(row[name]) for name in self.names}}}


def make_logs(folder: Path) -> None:
    """The trial table's answers as logs of the sessions in which they were given."""
    from hilbo.session.log import actions
    from hilbo.session.log.event_log import EventLog
    from hilbo.session.log.header import header_for
    from hilbo.session.log.log_files import log_name
    from hilbo.study.config import Study

    study, table = Study.load("study.toml"), pd.read_csv("trials.csv")
    for person, rows in table.groupby("participant"):
        header, chooser = header_for(study.file, str(person), warm=False), _Given(rows, study.space.names)
        with EventLog.create(folder / log_name(header), study.file, header) as log:
            for number, response in enumerate(rows["response"], 1):
                log.append(actions.propose(log.state, chooser, float(number)))
                given = {"class_a": response}
                event = actions.answer(log.state, number, f"c{number}", given, float(number), felt=False)
                assert event is not None
                log.append(event)


def _judged(folder: Path) -> None:
    """Logs of people who compared the population's set with everybody's own."""
    from hilbo.session.choose.logged_session import LoggedSession
    from hilbo.session.log.log_files import log_name
    from hilbo.session.plan.plan import planned_header
    from hilbo.study.config import Study
    from hilbo.study.file.plan_file import read_plan

    study = Study.load("study.toml")
    names = ",".join(f"J{number:02d}" for number in range(1, JUDGES + 1))
    given = ("--kind", "aggregate-best", "--from", "first-map/result.json", "--out", "plan-best.json")
    _run("plan", "study.toml", "--names", names, *given)
    plan = read_plan("plan-best.json")
    for name in names.split(","):
        header = planned_header(plan, study.file, name)
        assert log_name(header)
        with LoggedSession.open(folder, study, header) as session:
            while session.ask() is not None:
                trial = session.state.pending
                assert trial is not None
                session.tell("a" if "b" in trial.renderings else "close")


if __name__ == "__main__":
    main(withdrawal_case, __doc__ or "", PEOPLE, every=1)
