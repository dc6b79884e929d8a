"""The study on which attacks/schedules.py lets commands loose: list, plan, logs, tables, a map and an export."""

import os
import sys
from pathlib import Path

__all__ = ["PEOPLE", "make_ground"]

PEOPLE = tuple(f"Wxqz{number}" for number in range(1, 6))
"""Ids that no file holds by chance."""


def make_ground(folder: Path) -> None:
    """Make the study in a new folder, by hilbo's own commands."""
    import pandas as pd

    from attacks.withdrawals import make_logs
    from hilbo.simulation.folder import simulate_folder

    folder.mkdir()
    simulate_folder(folder, "paper", len(PEOPLE), 0)
    os.chdir(folder)
    table = pd.read_csv("trials.csv", dtype={"participant": str})
    table["participant"] = [PEOPLE[int(name[1:]) - 1] for name in table["participant"]]
    table.to_csv("trials.csv", index=False)
    Path("truth.csv").unlink()
    consent = ["--consent-time", "2026-05-04T10:00", "--protocol-number", "7"]
    for person in PEOPLE:
        _run("participants", "add", "participants.csv", person, *consent)
    _run("plan", "study.toml", "--names", ",".join(PEOPLE), "--out", "plan.json")
    make_logs(Path("logs"))
    _run("aggregate", "trials.csv", "--study", "study.toml", "--out", "map")
    _run("export", "logs", "--study", "study.toml", "--out", "tables")


def _run(*words: str) -> None:
    from hilbo.cli.main import main

    sys.argv = ["hilbo", *words]
    try:
        main()
    except SystemExit as stopped:
        if stopped.code:
            raise RuntimeError(f"hilbo {' '.join(words)}: {stopped.code}") from None
