"""Comparison of all aggregation methods: comparison.json, comparison.csv, figures, and a section of the page."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from hilbo.report.digits import parameter_texts
from hilbo.report.page import Pictures, heads, percent
from hilbo.report.result_file import as_json
from hilbo.report.results import save_figures
from hilbo.study.analysis.rule_comparison import KNOWN
from hilbo.study.config import Study
from hilbo.study.estimate.aggregate import Aggregate
from hilbo.study.formats.json_file import Content

__all__ = ["Compared", "comparison_section", "comparison_table", "write_comparison"]

_COLUMNS = ("method", "negative_log_density", "negative_log_density_error", "difference", "difference_error")
_COLUMNS += ("central_95", "central_95_error", "z2", "covered", "optimum_sd")


class Compared(NamedTuple):
    """A comparison of aggregation methods: as data, as a section of the page, and its figures for `page`."""

    content: Content
    section: Content
    pictures: Pictures


def write_comparison(study: Study, aggregate: Aggregate, content: Content, folder: Path) -> Compared:
    """Write comparison.json, comparison.csv and the figures of a comparison into an existing folder; return data,
    section and figures. `content`: of `rule_comparison.compare`.
    """
    from hilbo.report.figures import population as plotting

    (folder / "comparison.json").write_text(as_json(content))
    comparison_table(content).to_csv(folder / "comparison.csv", index=False)
    best, prior = np.asarray(aggregate.optimum.x), float(aggregate.map.map_prior)
    figures = {
        "comparison": plotting.rules_figure(content),
        "reliability": plotting.reliability_figure(content),
        "coverage": plotting.coverage_figure(study, aggregate.surface, best, prior, KNOWN),
    }
    return Compared(content, comparison_section(study, content), save_figures(figures, folder))


def comparison_table(content: Content) -> pd.DataFrame:
    """The rows of comparison.csv, one for each method: measures of prediction, its optimum, and the most influential
    participant; `refused` has the reason for a method that could not be used.
    """
    rows = []
    for rule, entry in content["rules"].items():
        row = {"rule": rule} | {name: entry.get(name) for name in _COLUMNS} | entry.get("optimum", {})
        influence = entry.get("influence") or {}
        row["most_influential"] = max(influence, key=lambda name: influence[name]) if influence else None
        rows.append(row | {"refused": entry.get("refused")})
    return pd.DataFrame(rows)


def comparison_section(study: Study, content: Content) -> Content:
    """Section of the page: `words` (the recommendation), `head` and `rows` of the table, best method first, and
    `refused`: the methods that could not be used, with reasons.
    """
    rules = content["rules"]
    compared = {rule: entry for rule, entry in rules.items() if "refused" not in entry}
    order = sorted(compared, key=lambda rule: compared[rule]["negative_log_density"])
    names = list(compared[order[0]]["optimum"])
    head = [
        "method",
        "negative log density",
        "difference",
        "in central 95 % (%)",
        "mean square normal score (1: calibrated)",
    ]
    head += [f"space where sd < {percent(KNOWN)} of the prior's (%)", "sd at the optimum", *heads(study, names)]
    return {
        "words": content["recommendation"],
        "head": head,
        "rows": [[rule, *_cells(study, compared[rule])] for rule in order],
        "refused": [f"{rule}: {entry['refused']}" for rule, entry in rules.items() if "refused" in entry],
    }


def _cells(study, entry):
    """Cells of one method's row on the page, as texts; the best method has no difference."""
    best = entry["difference"] == 0.0
    difference = "" if best else f"{entry['difference']:+.3f} ± {entry['difference_error']:.3f}"
    cells = [
        f"{entry['negative_log_density']:.3f}",
        difference,
        f"{100 * entry['central_95']:.0f}",
        f"{entry['z2']:.2f}",
    ]
    cells += [f"{100 * entry['covered']:.0f}", f"{entry['optimum_sd']:.2f}"]
    return [*cells, *parameter_texts(study, entry["optimum"])]
