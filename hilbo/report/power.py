"""Results of `hilbo power`: all errors as CSV, a summary, a figure, and a page that states which designs are
sufficient.
"""

from pathlib import Path

import numpy as np
import pandas as pd

from hilbo.report.page import rendered
from hilbo.report.result_file import write_result
from hilbo.report.results import save_figures, versions
from hilbo.simulation.power import Plan, power_table, summarise
from hilbo.study.config import Study
from hilbo.study.file.protocols import protocol
from hilbo.study.formats.json_file import Content

__all__ = ["enough", "write_power"]

_CHANCE = 0.8  # share of studies that must be within the error to call a design enough


def enough(summary: pd.DataFrame, chance: float = _CHANCE) -> pd.DataFrame:
    """Smallest sufficient number of trials for each number of participants: columns `participants` and `trials`.

    A number of trials suffices if `reached_surely`, the lower confidence bound of the share of studies within the
    target error, is at least `chance` for it and for all larger numbers simulated. NaN if the largest number does not
    suffice. `summary`: of `simulation.power.summarise`.
    """
    longest_first = summary.sort_values("trials", ascending=False)
    holds = (longest_first["reached_surely"] >= chance).groupby(longest_first["participants"]).cummin()
    good = longest_first[holds].groupby("participants")["trials"].min()
    return good.reindex(sorted(summary["participants"].unique())).rename("trials").reset_index()


def _hours(study: Study, participants: int | float, trials: int | float) -> float | None:
    """Duration of the steps of all sessions of a design, warm-up included, h; None for an unknown number of trials.
    Answers and breaks are not included."""
    if np.isnan(trials):
        return None
    warm_up, chosen = (protocol(study.file.session, phase) for phase in ("warm-up", "optimisation"))
    return participants * (warm_up.count * warm_up.seconds + trials * chosen.seconds) / 3600


def write_power(study: Study, errors: pd.DataFrame, plan: Plan, error: float, cost: Content, folder: Path) -> Content:
    """Write errors.csv, power.csv, result.json, the figure and report.html into an existing folder; return the content
    of result.json.

    `errors`: of every simulated study; `error`: target error of the optimum (NRMSE); `cost`: further keys of
    result.json, namely `seconds` and `jobs` (run time and number of processes), `preset` (the simulated population) and
    `material` (None for a study without materials).
    """
    from hilbo.report.figures import power

    summary = summarise(errors, error)
    errors.to_csv(folder / "errors.csv", index=False)
    summary.to_csv(folder / "power.csv", index=False)
    content = {
        "error": error,
        "summary": summary.to_dict("records"),
        "enough": [row | {"hours": _hours(study, **row)} for row in enough(summary).to_dict("records")],
        "studies": plan.studies,
        "seed": plan.seed,
        "rule": study.rule,
        "inference": study.inference,
        "study": study.file.hash,
        "versions": versions(),
        "warnings": [],
    } | cost
    write_result(content, folder)
    pictures = save_figures({"power": power.power_figure(summary, error)}, folder)
    columns = ("optimum_median", "reached", "reached_low", "reached_high", "map_median")
    page = rendered(
        "power.html",
        study=study,
        content=content,
        warnings=[],
        figures=pictures,
        chance=_CHANCE,
        most=max(plan.trials),
        trials=sorted(summary["trials"].unique()),
        tables={column: power_table(summary, column).to_dict("index") for column in columns},
    )
    (folder / "report.html").write_text(page, encoding="utf-8")
    return content
