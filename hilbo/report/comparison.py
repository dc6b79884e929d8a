"""comparison.json, comparison.csv and figures: what `hilbo aggregate --compare` adds to a results folder."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hilbo.report.participants import as_json
from hilbo.report.results import save_figures
from hilbo.study.aggregate import Aggregate
from hilbo.study.config import Study
from hilbo.study.rule_comparison import KNOWN, compare

__all__ = ["comparison_table", "write_comparison"]

_COLUMNS = ("method", "negative_log_density", "negative_log_density_error", "central_95", "central_95_error", "z2")


def write_comparison(study: Study, aggregate: Aggregate, folder: Path, seed: int = 0) -> dict[str, Any]:
    """Write the comparison of all rules; returns the content of comparison.json."""
    from hilbo.report.figures import population as plotting

    content = compare(study, aggregate, seed)
    (folder / "comparison.json").write_text(as_json(content))
    comparison_table(content).to_csv(folder / "comparison.csv", index=False)
    best, prior = np.asarray(aggregate.optimum.x), float(aggregate.map.map_prior)
    figures = {
        "comparison": plotting.rules_figure(content),
        "reliability": plotting.reliability_figure(content),
        "coverage": plotting.coverage_figure(study, aggregate.surface, best, prior, KNOWN),
    }
    save_figures(figures, folder)
    return content


def comparison_table(content: dict[str, Any]) -> pd.DataFrame:
    """A row for each rule."""
    rows = []
    for rule, entry in content["rules"].items():
        row = {"rule": rule} | {name: entry.get(name) for name in _COLUMNS}
        row |= {"covered": entry.get("covered"), "optimum_sd": entry.get("optimum_sd")} | entry.get("optimum", {})
        influence = entry.get("influence") or {}
        row["most_influential"] = max(influence, key=lambda name: influence[name]) if influence else None
        rows.append(row | {"refused": entry.get("refused")})
    return pd.DataFrame(rows)
