"""Tables of a study's page as texts: units in the heads, digits by the uncertainty."""

from typing import Any

import numpy as np
import pandas as pd

from hilbo.report.digits import parameter_text, rounded
from hilbo.report.page import estimate_words, heads
from hilbo.study.config import Study
from hilbo.study.tables.parameter_sets import ROLES

__all__ = ["alternatives_rows", "measures_rows", "table_1_rows", "tolerance_rows"]

_DIGITS = 2  # significant, of measures of participants, which a few dozen responses decide


def alternatives_rows(study: Study, table: pd.DataFrame) -> dict[str, Any]:
    """Head and rows (texts) of the page's table of all optima, without empty columns. `table`: of
    `alternatives_table`.
    """
    forms: dict[str, tuple[str, Any]] = {
        "mean": ("latent score", "{:.2f}".format),
        "sd": ("sd", "{:.2f}".format),
        "p_top": (f'P("{study.goal_label}") (%)', lambda share: f"{100 * share:.0f}"),
        "passivity_margin": ("passivity margin (N·s/m)", "{:+.2f}".format),
    }
    shown = table.dropna(axis=1, how="all").drop(columns="optimum")
    parameters = [name for name in shown if name not in forms]
    names = dict(zip(parameters, heads(study, parameters), strict=True)) | {k: head for k, (head, _) in forms.items()}

    def text(name: str, value: float | str) -> str:
        """A cell of the column `name`."""
        if pd.isna(value):
            return ""
        return forms[name][1](value) if name in forms else parameter_text(study, name, value)

    rows = [
        [_estimate(label, study.rule), *(text(name, value) for name, value in row.items())]
        for label, row in zip(table["optimum"], shown.to_dict("records"), strict=True)
    ]
    return {"head": ["", *(names[name] for name in shown)], "rows": rows}


def _estimate(label: str, rule: str) -> str:
    """Name on the page for the `label` of a row of `alternatives_table`; `rule`: the study's aggregation method."""
    if label in ROLES:
        return f"{label} of the sets to compare"
    name = "aggregate" if label == "population" else label.removeprefix("population, ")
    return name if " " in name else estimate_words(name, rule)


def table_1_rows(study: Study, table: pd.DataFrame) -> tuple[list[str], list[list[str]]]:
    """Columns and cells (texts) of `result_tables.table_1`: the column `parameter` gets units, the mean of the optima
    the digits of its standard deviation.
    """
    rows = []
    for head, row in zip(heads(study, table["parameter"]), table.to_dict("records"), strict=True):
        name, sd, cells = row["parameter"], row["sd_of_optima"], [head]
        for column in list(table.columns)[1:]:
            if column.endswith("percent"):
                cells.append(f"{row[column]:.1f}")
            else:
                spread = sd if column in ("mean_of_optima", "sd_of_optima") else np.nan
                is_sd = column == "sd_of_optima"
                cells.append(rounded(row[column], sd) if is_sd else parameter_text(study, name, row[column], spread))
        rows.append(cells)
    return list(map(str, table.columns)), rows


def tolerance_rows(study: Study, table: pd.DataFrame) -> list[list[str]]:
    """Rows (texts) of the page's table of tolerance intervals: each end with its reason and its bootstrap interval, and
    the per cent of resamples without an interval; dashes for missing items. `table`: of `tolerance_table`.
    """
    rows = []
    for head, row in zip(heads(study, table["parameter"]), table.to_dict("records"), strict=True):
        name = row["parameter"]
        resampled = np.isfinite(row["draws_without"])  # not of one person
        cells = [row["hyperparameters"], head]
        for end in ("low", "high"):
            if not np.isfinite(row[end]):
                cells += ["–", "–"]
                continue
            sides = [row[f"{end}_{side}"] for side in ("from", "to")]
            spread = sides[1] - sides[0]
            cells.append(f"{parameter_text(study, name, row[end], spread)} ({row[f'{end}_end']})")
            cells.append(" to ".join(parameter_text(study, name, x, spread) for x in sides) if resampled else "–")
        rows.append([*cells, f"{100 * row['draws_without']:.0f}" if resampled else "–"])
    return rows


def measures_rows(table: pd.DataFrame) -> tuple[list[str], list[list[str]]]:
    """Columns and cells (texts) of the table of the participants' measures: value and limits of each with the digits of
    its interval.
    """
    rows = []
    for row in table.to_dict("records"):
        cells = []
        for name, value in row.items():
            measure = str(name).removesuffix("_low").removesuffix("_high")
            if not isinstance(value, float):
                cells.append("–" if value is None else str(value))
            elif np.isinf(value):
                cells.append("∞" if value > 0 else "−∞")
            elif f"{measure}_low" in row:
                cells.append(rounded(value, row[f"{measure}_high"] - row[f"{measure}_low"]))
            else:
                cells.append("–" if np.isnan(value) else f"{value:.{_DIGITS}g}")
        rows.append(cells)
    return list(map(str, table.columns)), rows
