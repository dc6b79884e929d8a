"""Results of validation sessions: tables II to IV, confusion, preferences, the aggregate's set against individuals'.

`validate` computes one material; `write_validation` makes the folder of `hilbo validate` with one section for each
material: result.json, the tables as CSV, the figures, and one page. `hilbo report` uses the same parts.

The page shows the widest interval of each coefficient, the safest by docs/methods/statistics.md; all kinds of
error are in the CSV tables.
"""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from hilbo.report.page import rendered
from hilbo.report.result_file import write_result
from hilbo.report.results import save_figures, versions
from hilbo.statistics.paper_tables import PaperTables, aggregate_comparisons, paper_tables, set_sources
from hilbo.statistics.preferences import rate
from hilbo.statistics.regression import Regression
from hilbo.study.config import Study
from hilbo.study.formats.csv_file import read_cells
from hilbo.study.formats.json_file import Content
from hilbo.study.tables.flag_counts import flag_counts, flag_sentences_of
from hilbo.study.tables.validation import RESPONSES, TIE, check_validation, of_material, read_validation, sets_of_study

__all__ = [
    "Validated",
    "folder_names",
    "materials_of",
    "named_warnings",
    "p_words",
    "safest",
    "validate",
    "validation_content",
    "validation_csv",
    "validation_figures",
    "validation_section",
    "write_validation",
]


class Validated(NamedTuple):
    """Statistics of the validation sessions of one material ("" if the table names none).

    `overall`: share of comparisons in which the aggregate's set is preferred to an individual's, ties excluded, with
    every kind of interval; `people`: the same by participant. Both are None without such comparisons, `overall` also if
    all are ties.
    """

    material: str
    tables: PaperTables
    overall: pd.DataFrame | None
    """Share preferring the aggregate's set to an individual's, by every kind of interval; ties left out."""
    people: pd.DataFrame | None
    """The same person by person: `name`, `wins`, `losses`, `ties`, `rate`, `low`, `high` (exact)."""
    participants: int
    comparisons: int

    def regressions(self) -> dict[str, Regression]:
        """The regressions of tables "II", "III" and "IV" by number; those that the data do not allow are missing."""
        by_number = {"II": self.tables.table_2, "III": self.tables.table_3, "IV": self.tables.table_4}
        return {number: table for number, table in by_number.items() if table is not None}


def materials_of(table: pd.DataFrame) -> list[str | None]:
    """The distinct materials of a validation or trial table, in order of appearance; [None] without a column
    `material`.
    """
    return list(pd.unique(table["material"])) if "material" in table else [None]


def validate(
    table: pd.DataFrame,
    sets: pd.DataFrame | None = None,
    responses: Sequence[str] = RESPONSES,
    material: str | None = None,
    goal: str | None = None,
) -> Validated:
    """Statistics of the comparisons of one material; `material` may be None if the table has only one.

    `sets`: the sets table, indexed by `set_id`, or None; `responses`: labels, lowest first; `goal`: the one that is
    searched for, by default the last. Raises `InputError` for an invalid table.
    """
    chosen = of_material(check_validation(table, responses), material)
    tables = paper_tables(chosen, sets, responses=responses, goal=goal)
    rows = aggregate_comparisons(chosen, *set_sources(chosen, sets))
    decided = rows[rows["preferred"] != TIE]
    won = (decided["preferred"] != "individual").to_numpy()
    overall = rate(won, decided[["participant", "set"]]) if len(won) else None
    people = pd.DataFrame([_person(name, mine) for name, mine in rows.groupby("participant", sort=False)])
    count = chosen["participant"].nunique()
    return Validated(material or "", tables, overall, people if len(people) else None, count, len(chosen))


def _person(name, rows):
    """One participant's row: name, wins of the aggregate's set, losses, ties, and win rate with its exact 95 %
    interval.

    `rows`: the participant's comparisons. With ties alone the rate is NaN and the interval 0 to 1.
    """
    wins, losses = (int((rows["preferred"] == word).sum()) for word in ("Aggregate-Best", "individual"))
    row = {"name": name, "wins": wins, "losses": losses, "ties": len(rows) - wins - losses}
    if not wins + losses:
        return row | {"rate": np.nan, "low": 0.0, "high": 1.0}
    ends = binomtest(wins, wins + losses).proportion_ci()
    return row | {"rate": wins / (wins + losses), "low": ends.low, "high": ends.high}


def safest(table: Regression) -> pd.DataFrame:
    """For each coefficient the row with the widest interval, among those with a finite standard error; the row with
    profile likelihood errors, if there is one.
    """
    rows = []
    for _, mine in table.table.groupby("term", sort=False):
        width = (mine["high"] - mine["low"]).where(np.isfinite(mine["std_error"]), -1.0)
        separated = mine["errors"] == "profile likelihood"
        rows.append(mine[separated].iloc[0] if separated.any() else mine.loc[width.idxmax()])
    return pd.DataFrame(rows)


def validation_content(validated: Validated) -> Content:
    """Statistics of one material as an entry of result.json; `aggregate_best` is missing without such comparisons."""
    tables = validated.tables
    content: Content = {
        "material": validated.material,
        "participants": validated.participants,
        "comparisons": validated.comparisons,
        "confusion": {str(name): {str(k): int(v) for k, v in row.items()} for name, row in tables.confusion.iterrows()},
        "preferences": _records(tables.preferences),
        "tables": {
            number: {"rows": _records(table.table), "answers": table.answers, "clusters": table.clusters}
            for number, table in validated.regressions().items()
        },
        "limits": list(tables.limits),
        "warnings": [w for table in validated.regressions().values() for w in table.warnings],
    }
    if validated.overall is not None and validated.people is not None:
        content["aggregate_best"] = {"overall": _records(validated.overall), "people": _records(validated.people)}
    return content


def _records(table):
    """Rows of a table as dictionaries with Python numbers."""
    return [{str(k): _plain(v) for k, v in row.items()} for row in table.to_dict("records")]


def _plain(value):
    """A NumPy scalar as a Python number; other values unchanged."""
    return value.item() if isinstance(value, np.generic) else value


def validation_csv(validated: Validated) -> dict[str, pd.DataFrame]:
    """Tables of one material by file name without .csv: confusion, preferences, table_II to table_IV and
    aggregate_best, as far as there are such.
    """
    tables = validated.tables
    files = {"confusion": _with_sets(tables.confusion), "preferences": tables.preferences}
    files |= {f"table_{number}": table.table for number, table in validated.regressions().items()}
    if validated.overall is not None and validated.people is not None:
        files |= {"aggregate_best": validated.overall, "aggregate_best_people": validated.people}
    return files


def _with_sets(confusion: pd.DataFrame) -> pd.DataFrame:
    """The confusion matrix with its index as the first column, `set`; if a response has that name, set_1, set_2 and so
    on.
    """
    names = itertools.chain(["set"], (f"set_{n}" for n in itertools.count(1)))
    free = next(name for name in names if name not in confusion.columns)
    return confusion.rename_axis(index=free, columns=None).reset_index()


def validation_figures(validated: Validated) -> dict[str, Any]:
    """Matplotlib figures of one material by name, those that its data allow: "validation" and "aggregate-best"."""
    from hilbo.report.figures import validation as plotting

    figures = {}
    if validated.tables.confusion.to_numpy().any() or not validated.tables.preferences.empty:
        figures["validation"] = plotting.validation_figure(validated.tables.confusion, validated.tables.preferences)
    if validated.overall is not None and validated.people is not None:
        figures["aggregate-best"] = plotting.aggregate_best_figure(validated.people, validated.overall)
    return figures


def validation_section(validated: Validated) -> Content:
    """Section of the page for one material: counts, limits, and rows of each regression as text. `tied`: whether the
    regression is of the model with ties.
    """
    return {
        "material": validated.material,
        "participants": validated.participants,
        "comparisons": validated.comparisons,
        "limits": validated.tables.limits,
        "regressions": {
            number: {"rows": _shown(table), "warnings": table.warnings, "tied": bool(table.table["term"].eq(TIE).any())}
            for number, table in validated.regressions().items()
        },
    }


def _shown(table):
    """Rows of a regression for the page, as texts: term, estimate, standard error, statistic, degrees of freedom, p
    value, interval, kind of error; "–" for values that are not known.
    """
    rows = []
    for _, row in safest(table).iterrows():
        sure = np.isfinite(row["std_error"])
        rows.append([
            row["term"],
            f"{row['estimate']:.4f}" if np.isfinite(row["estimate"]) else ("+∞" if row["estimate"] > 0 else "−∞"),
            f"{row['std_error']:.4f}" if sure else "–",
            f"{row['statistic']:.2f}" if sure else "–",
            f"{row['degrees_of_freedom']:.0f}" if np.isfinite(row["degrees_of_freedom"]) else "–",
            p_words(row["p_value"]),
            f"{_end(row['low'])} to {_end(row['high'])}",
            row["errors"],
        ])  # fmt: skip
    return rows


def _end(value):
    """An interval end as text with two decimals; "∞" or "−∞" if it is not finite."""
    return f"{value:.2f}" if np.isfinite(value) else ("∞" if value > 0 else "−∞")


def p_words(p: float) -> str:
    """A p value as text with three decimals, "< 0.001" below that, and "–" if it is not finite."""
    return "–" if not np.isfinite(p) else "< 0.001" if p < 0.001 else f"{p:.3f}"


def write_validation(
    study: Study,
    path: Path,
    sets: Path | None,
    material: str | None,
    folder: Path,
    seed: int = 0,
    say=lambda text: None,
) -> Content:
    """Write the results of `hilbo validate` into an existing folder; return the content of result.json.

    With several materials the tables and figures of each go to a separate folder within it. `path`, `sets`: files of
    the validation table and of the sets table, or None; `material`: the only one to analyse, None: all; `seed`: only
    recorded; `say`: called with a text at each step. Raises `InputError` for invalid tables.
    """
    say("reading")
    table = _read(path, study, material)
    sets_by_id = None if sets is None else sets_of_study(sets, study.file)
    contents, sections = [], []
    names = materials_of(table)
    folders = folder_names(names)
    for name in names:
        say(f"validation sessions{'' if name is None else f' of {name}'}")
        validated = validate(table, sets_by_id, study.responses, name, study.goal_label)
        material_folder = folder if len(names) == 1 else folder / folders[name]
        material_folder.mkdir(exist_ok=True)
        for file, frame in validation_csv(validated).items():
            frame.to_csv(material_folder / f"{file}.csv", index=False)
        pictures = save_figures(validation_figures(validated), material_folder)
        contents.append(validation_content(validated))
        sections.append(validation_section(validated) | {"figures": pictures})
    flags = flag_sentences_of(flag_counts(table), study.file.exclude_flags, "comparisons")
    content = {"materials": contents, "study": study.file.hash, "seed": seed, "versions": versions()}
    content["warnings"] = [*flags, *named_warnings(dict(zip(names, contents, strict=True)))]
    write_result(content, folder)
    page = rendered("validation.html", study=study, content=content, warnings=flags, sections=sections)
    (folder / "report.html").write_text(page, encoding="utf-8")
    return content


def _read(path: Path, study: Study, material: str | None) -> pd.DataFrame:
    """Read and check the comparisons of one material, or of all if `material` is None; excluded flags are left out.

    Raises `InputError` for a file that cannot be read or an invalid table.
    """
    if material is not None:
        return read_validation(path, study.responses, material, study.file.exclude_flags)
    cells = read_cells(path, "a validation table needs a header and a comparison")
    return check_validation(cells, study.responses, str(path), study.file.exclude_flags)


def named_warnings(contents: Mapping[Any, Mapping[str, Any]]) -> list[str]:
    """The warnings of the contents of result.json by material, in one list; with several materials each begins with the
    name of its own.
    """
    several = len(contents) > 1
    return [f"{name}: {text}" if several else text for name, one in contents.items() for text in one["warnings"]]


def folder_names(names: Sequence[str | None]) -> dict[str | None, str]:
    """Folder names for materials, all different: lower case, with signs as hyphens; equal ones get a number from 2 on.

    The result's keys are the `names`.
    """
    folders: dict[str | None, str] = {}
    for name in names:
        plain = _slug(str(name))
        numbered = itertools.chain([plain], (f"{plain}-{n}" for n in itertools.count(2)))
        folders[name] = next(folder for folder in numbered if folder not in folders.values())
    return folders


def _slug(name: str) -> str:
    """A name as part of a file name: lower case, letters and digits, separated by single hyphens; "material" if nothing
    is left.
    """
    kept = "".join(c if c.isalnum() else "-" for c in name.lower())
    return "-".join(word for word in kept.split("-") if word) or "material"
