"""Results of `hilbo power`: every error as CSV, a summary, a figure, and a page that says what is enough."""

from pathlib import Path
from typing import Any

import pandas as pd

from hilbo.report.page import template
from hilbo.report.results import as_json, save_figures, versions
from hilbo.simulation.power import Plan, power_table, summarise
from hilbo.study.config import Study

__all__ = ["enough", "write_power"]

_CHANCE = 0.8  # share of studies that must be within the error to call a design enough


def enough(summary: pd.DataFrame, chance: float = _CHANCE) -> pd.DataFrame:
    """For every number of participants the fewest trials from which on at least `chance` of the studies are within the
    error, with all larger numbers simulated too; NaN if the largest does not reach it."""
    longest_first = summary.sort_values("trials", ascending=False)
    holds = (longest_first["reached"] >= chance).groupby(longest_first["participants"]).cummin()
    good = longest_first[holds].groupby("participants")["trials"].min()
    return good.reindex(sorted(summary["participants"].unique())).rename("trials").reset_index()


def write_power(
    study: Study, errors: pd.DataFrame, plan: Plan, error: float, cost: dict[str, Any], folder: Path
) -> dict[str, Any]:
    """Write the folder of `hilbo power`; returns the content of result.json.

    `cost` has `seconds`, `jobs` and `preset`: how long it took on how many cores, and who was simulated.
    """
    from hilbo.report.figures import power

    summary = summarise(errors, error)
    errors.to_csv(folder / "errors.csv", index=False)
    summary.to_csv(folder / "power.csv", index=False)
    figure = power.power_figure(summary, error)
    caption = (
        "Left: how far the population optimum is from the truth, in per cent of the search ranges: median and quartiles"
        f" over {plan.studies} simulated studies. Middle: in how many of them it is within {100 * error:g} % (bars: 95"
        " % intervals). Right: root mean square error of the map's probability of the highest answer."
    )
    pictures = save_figures({"power": (figure, "Participants and trials", caption)}, folder)
    content = {
        "error": error,
        "summary": summary.to_dict("records"),
        "enough": enough(summary).to_dict("records"),
        "studies": plan.studies,
        "seed": plan.seed,
        "rule": study.rule,
        "inference": study.inference,
        "study": study.hash,
        "versions": versions(),
        "warnings": [],
    } | cost
    (folder / "result.json").write_text(as_json(content), encoding="utf-8")
    (folder / "report.html").write_text(_page(study, summary, plan, error, cost, pictures, content), encoding="utf-8")
    return content


def _page(study, summary, plan, error, cost, pictures, content):
    ends = zip(summary["reached"], summary["reached_low"], summary["reached_high"], strict=True)
    shares = [f"{100 * share:.0f} % ({100 * low:.0f} to {100 * high:.0f})" for share, low, high in ends]
    summary = summary.assign(share=shares)
    blocks = [
        ("Error of the optimum, median in % of the search ranges", "optimum_median", lambda v: f"{100 * v:.1f}"),
        (f"Share of studies within {100 * error:g} %, with its 95 % interval", "share", str),
        ("Error of the map, median", "map_median", lambda v: f"{v:.3f}"),
    ]
    tables = []
    for caption, column, words in blocks:
        cells = power_table(summary, column)
        head = ["participants", *(f"{count} trials" for count in cells.columns)]
        tables.append(
            (caption, head, [[str(m), *map(words, row)] for m, row in zip(cells.index, cells.to_numpy(), strict=True)])
        )
    enough_trials = [
        f"{row['participants']:.0f} participants: {row['trials']:.0f} trials" if row["trials"] == row["trials"]
        else f"{row['participants']:.0f} participants: more than {max(plan.trials)} trials"
        for row in content["enough"]
    ]  # fmt: skip
    return template("power.html").render(
        title=f"{study.name}: how many participants and trials",
        lead=f"{plan.studies} studies of the simulated population “{cost['preset']}” were run and merged by the rule"
        f" {study.rule}. For at least {100 * _CHANCE:.0f} % of studies to miss the optimum by {100 * error:g} % of the"
        f" search ranges or less, it takes {'; '.join(enough_trials)}.",
        warnings=[],
        figures=pictures,
        tables=tables,
        cost=f"{cost['seconds']:.0f} s on {cost['jobs']} core{'s' if cost['jobs'] > 1 else ''}",
        study_hash=study.hash,
        seed=plan.seed,
        versions=", ".join(f"{k} {v}" for k, v in content["versions"].items()),
    )
