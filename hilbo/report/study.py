"""`hilbo report`: a folder of sessions as one page, in the paper's order, with figures (SVG, PNG) and tables (CSV).

Each material gets its figures 4 to 8 and tables I to IV, its limits, its people and the passivity of every optimum;
hypotheses H1 to H4 get a section each (`hilbo.report.hypotheses`). With several materials the files of each lie in a
folder of its name. result.json holds everything by number, `inference.nc` the posterior for ArviZ, `map.nc` the
population map.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pandas as pd

from hilbo.population.recipes import RECIPES
from hilbo.report import validation
from hilbo.report.checklist import checklist
from hilbo.report.comparison import comparison_section, comparison_table
from hilbo.report.dictionary import dictionary
from hilbo.report.hypotheses import Results, hypotheses
from hilbo.report.page import Pictures, heads, number, percent, rendered
from hilbo.report.participants import people_of
from hilbo.report.results import as_json, map_dataset, moved, optima_table, result, save_figures, versions
from hilbo.report.study_figures import comparison_figures, study_figures
from hilbo.report.validation import Validated, slug, validate
from hilbo.search.rendering import margin_of, set_of
from hilbo.study.analysis import Analysis, analyse, moved_by_evidence
from hilbo.study.config import Study
from hilbo.study.folder import Material, StudyFolder
from hilbo.study.heterogeneity import in_place
from hilbo.study.inference_data import groups, predictive_shares, write_groups
from hilbo.study.map_file import write_map
from hilbo.study.rule_comparison import compare

__all__ = ["convergence_table", "table_1", "tolerance_table", "write_study"]

_DIGITS = 2  # of measures of people and of ends of intervals, which a few dozen answers decide
_FEWEST = 3  # people for a comparison of rules: each is left out in turn


def write_study(
    folder: StudyFolder,
    out: Path,
    seed: int = 0,
    say=lambda text: None,
    analyses: Mapping[str, Analysis] | None = None,
    comparison: bool = True,
) -> dict[str, Any]:
    """Write the results folder of `hilbo report`; returns the content of result.json.

    `analyses`: of materials (by name) whose results are known already. `comparison`: every rule of aggregation with
    each person left out in turn, which is most of the work.
    """
    results, contents, sections = [], {}, []
    analyses = {} if analyses is None else analyses
    for material in folder.materials:
        words = f" ({material.name})" if material.name else ""

        def tell(text, words=words):
            say(f"{text}{words}")

        analysis = analyses.get(material.name) or analyse(material.study, material.cohort, seed, tell)
        validated = _validated(material, folder, tell)
        results.append(Results(material.name, analysis, validated, material.reference, material.reference_name))
        material_folder = out / slug(material.name) if len(folder.materials) > 1 else out
        material_folder.mkdir(exist_ok=True)
        comparison_content = _compared(analysis, seed, tell) if comparison else None
        tell("figures and tables")
        content, section = _write_material(material, analysis, validated, comparison_content, material_folder, seed)
        contents[material.name] = content
        sections.append(section)
    claims = hypotheses(results) if folder.study.report.hypotheses else []
    content = _content(folder, contents, claims, seed)
    (out / "result.json").write_text(as_json(content), encoding="utf-8")
    say("the page")
    page = rendered(
        "study.html",
        study=folder.study,
        content=content,
        warnings=[*content["warnings"], *content["limits"]],
        notes=folder.notes,
        sections=sections,
        people=sum(len(m.cohort.names) for m in folder.materials),
        hypotheses=claims,
    )
    (out / "report.html").write_text(page, encoding="utf-8")
    return content


def _content(folder: StudyFolder, contents, claims, seed) -> dict[str, Any]:
    return {
        "materials": contents,
        "hypotheses": [{"number": h.number, "evidence": [e._asdict() for e in h.evidence]} for h in claims],
        "study": folder.study.hash,
        "seed": seed,
        "versions": versions(),
        "warnings": [w for one in contents.values() for w in one["warnings"]],
        "limits": list(folder.limits),
    }


def _validated(material: Material, folder: StudyFolder, say) -> Validated | None:
    if material.validation is None:
        return None
    say("validation sessions")
    name = material.name if "material" in material.validation and material.name else None
    return validate(material.validation, folder.sets, material.study.responses, name)


def _compared(analysis: Analysis, seed, say) -> dict[str, Any] | None:
    """Every rule beside the study's; None where people are too few."""
    if np.sum(analysis.cohort.counts() > 0) < _FEWEST:
        return None
    say("comparing the rules of aggregation")
    return compare(analysis.study, analysis.aggregate, seed, learns=analysis.study.rule in RECIPES)


def _write_material(material, analysis: Analysis, validated, compared, folder: Path, seed):
    """Files of one material; its content for result.json, and its section of the page."""
    study, people = analysis.study, people_of(analysis.study, analysis.aggregate)
    truth = material.reference if material.reference_name == "the truth" else None
    content = result(study, analysis.aggregate, seed, truth, people)
    data = groups(study, analysis.cohort, analysis.aggregate.posteriors, seed=seed)
    write_groups(data, folder / "inference.nc")
    grid = map_dataset(study, analysis.aggregate.surface)
    grid.attrs |= {"rule": content["rule"], "optimum": json.dumps(content["optimum"]["parameters"])}
    write_map(grid, folder / "map.nc")
    tables = {
        "optima": optima_table(content, people),
        "table_I": table_1(analysis, material.reference),
        "convergence": convergence_table(analysis),
        "tolerance": tolerance_table(analysis),
        "people": analysis.people.assign(left_out=analysis.people["participant"].map(analysis.left_out)),
        "passivity": passivity_table(analysis),
    }
    shares = predictive_shares(data, len(study.responses))
    figures, hatched = study_figures(analysis, material, shares)
    pictures = save_figures(figures, folder)
    if compared is not None:
        tables["comparison"] = comparison_table(compared)
        pictures |= save_figures(comparison_figures(compared), folder)
    if validated is not None:
        content["validation"] = validation.validation_content(validated)
        tables |= validation.validation_csv(validated)
        pictures |= save_figures(validation.validation_figures(validated), folder)
    tables["dictionary"] = dictionary(tables, study)
    for name, table in tables.items():
        table.to_csv(folder / f"{name}.csv", index=False)
    content |= {
        "left_out": analysis.left_out,
        "limits": list(analysis.limits),
        "optimised": {
            "theta": np.asarray(analysis.learned.gp.kernel.theta).tolist(),
            "noise": float(analysis.learned.gp.likelihood.noise),
            "thresholds": np.asarray(analysis.learned.gp.likelihood.thresholds).tolist(),
            "nrmse": moved_by_evidence(analysis),
        },
        "tolerance": tables["tolerance"].to_dict("records"),
        "comparison": compared,
    }
    section = _section(material, analysis, validated, tables, pictures, content)
    items = checklist(analysis, content, validated is not None)
    return content, section | {"hatched": hatched, "checklist": items, "dictionary": tables["dictionary"]}


def table_1(analysis: Analysis, reference: np.ndarray | None) -> pd.DataFrame:
    """The population optimum and the mean of the individual optima, beside the reference if there is one (paper,
    table I): `parameter`, `reference`, `aggregate`, `error_percent`, `mean_of_optima`, `sd_of_optima`, ..."""
    study, aggregate = analysis.study, analysis.aggregate
    mean, best = aggregate.mean_of_optima, aggregate.optimum.x
    individual_sets = pd.DataFrame([set_of(study.space, x) for x in np.asarray(aggregate.individuals.x)])
    ours, theirs = set_of(study.space, best), set_of(study.space, mean)
    table = pd.DataFrame(
        {"parameter": list(ours), "aggregate": list(ours.values()), "mean_of_optima": list(theirs.values())}
    )
    spread = individual_sets.std(ddof=1, numeric_only=True)  # NaN of one; levels have none
    table["sd_of_optima"] = [spread.get(name, np.nan) for name in ours]
    if reference is not None:
        table.insert(1, "reference", list(set_of(study.space, reference).values()))
        for name, x in (("error_percent", best), ("mean_error_percent", mean)):
            ways = moved(study, x, jnp.asarray(reference))["moved"]
            table[name] = [abs(ways[parameter]["percent"]) for parameter in ours]
    return table


def convergence_table(analysis: Analysis) -> pd.DataFrame:
    """After each number of trials: NRMSE of the population's running optimum to its last, and of the individuals'
    (median, quartiles, of those who gave as many answers), both also to the optimum of a half of the people who are not
    among them, and answers in the highest category so far (paper, figures 5 and 7b)."""
    study, counts = analysis.study, analysis.progress.counts
    population_errors, individual_errors = analysis.progress.to_end()
    top = np.asarray((analysis.cohort.trials.q == len(study.responses) - 1) & analysis.cohort.trials.mask)
    so_far = np.cumsum(top, axis=1)[:, counts - 1]
    table = pd.DataFrame({"trials": counts, "population": population_errors})
    if analysis.progress.splits:
        table["halves"] = np.median(analysis.progress.halves, axis=1)
        table["individuals_to_half"] = np.nanmedian(
            np.where(np.isnan(individual_errors), np.nan, analysis.progress.individual_to_half), axis=1
        )
    for name, values in (("individuals", individual_errors.T), ("top_answers", so_far)):
        table[[f"{name}_low", f"{name}_median", f"{name}_high"]] = np.nanpercentile(values, [25, 50, 75], axis=0).T
    return table


def tolerance_table(analysis: Analysis) -> pd.DataFrame:
    """Tolerance intervals under fixed and under optimised hyperparameters, with the bootstrap over people of their
    ends; empty where the highest answer is not the likeliest at the optimum (paper, section VII)."""
    rows = []
    for name, reading in (("fixed", analysis.fixed), ("optimised", analysis.optimised)):
        for parameter, (interval, ends) in reading.tolerances.items():
            row: dict[str, Any] = {"hyperparameters": name, "parameter": parameter}
            if interval is not None:
                row |= {
                    "low": interval.low,
                    "high": interval.high,
                    "low_end": interval.low_end,
                    "high_end": interval.high_end,
                }
            if ends is not None:
                row |= {
                    "low_from": ends.low[0],
                    "low_to": ends.low[1],
                    "high_from": ends.high[0],
                    "high_to": ends.high[1],
                }
            rows.append(row | {"draws_without": 1.0 if ends is None else ends.lost})
    columns = ["hyperparameters", "parameter", "low", "high", "low_end", "high_end"]
    return pd.DataFrame(rows, columns=[*columns, "low_from", "low_to", "high_from", "high_to", "draws_without"])


def passivity_table(analysis: Analysis) -> pd.DataFrame:
    """Everything that could be rendered as an optimum: parameters, score, probability of the highest answer, and how
    far from the passive boundary (N.s/m; negative is not passive)."""
    study, aggregate = analysis.study, analysis.aggregate
    claims: dict[str, tuple[Any, Any]] = {"population": (aggregate.optimum.x, aggregate.optimum)}
    claims |= {f"population, {name}": (other.x, other) for name, other in aggregate.alternatives.items()}
    claims["population, optimised hyperparameters"] = (
        analysis.optimised.aggregate.optimum.x,
        analysis.optimised.aggregate.optimum,
    )
    claims["mean of the individual optima"] = (aggregate.mean_of_optima, None)
    if analysis.sets is not None:
        claims |= {name: (analysis.sets.x[i], None) for i, name in enumerate(("best", "mid", "worst"))}
    rows = []
    for name, (x, optimum) in claims.items():
        row = {"optimum": name} | set_of(study.space, x)
        row |= (
            {}
            if optimum is None
            else {"f": float(optimum.mean), "sd": float(optimum.sd), "p_top": float(optimum.class_probabilities[-1])}
        )
        rows.append(row | {"passivity_margin": margin_of(study.space, x)})
    return pd.DataFrame(rows)


def _section(material: Material, analysis: Analysis, validated, tables, pictures: Pictures, content) -> dict[str, Any]:
    """What the page says of one material."""
    from hilbo.report.figures.study import UNKNOWN, typical_person

    readings = {"fixed": analysis.fixed, "optimised": analysis.optimised}
    return {
        "name": material.name,
        "study": analysis.study,
        "participants": analysis.cohort.names,
        "answers": int(analysis.cohort.counts().sum()),
        "limits": analysis.limits,
        "left_out": analysis.left_out,
        "figures": pictures,
        "typical": analysis.cohort.names[typical_person(analysis)],
        "unknown": UNKNOWN,
        "how": in_place(analysis.aggregate.map),
        "reference": None if material.reference is None else material.reference_name,
        "table_1": _with_units(analysis.study, tables["table_I"]),
        "alternatives": _alternatives(analysis.study, tables["passivity"]),
        "tolerance": _tolerances(tables["tolerance"]),
        "people": _shown(tables["people"].drop(columns=["categories", "left_out"]), digits=_DIGITS),
        "moved": content["optimised"]["nrmse"],
        "model_check": content["model_check"],
        "without": [
            name for name, reading in readings.items() if all(i is None for i, _ in reading.tolerances.values())
        ],
        "comparison": content["comparison"] and comparison_section(analysis.study, content["comparison"]),
        "halves": analysis.progress.splits,
        "validation": None if validated is None else validation.validation_section(validated),
    }


def _alternatives(study: Study, table: pd.DataFrame) -> dict[str, Any]:
    """Head and rows of the table of all optima on the page: no column without a number in it."""
    forms: dict[str, tuple[str, Any]] = {
        "f": ("f", "{:.2f}".format),
        "sd": ("sd", "{:.2f}".format),
        "p_top": (f'P("{study.responses[-1]}")', percent),
        "passivity_margin": ("passivity margin (N·s/m)", "{:+.3f}".format),
    }
    shown = table.dropna(axis=1, how="all").drop(columns="optimum")
    parameters = [name for name in shown if name not in forms]
    names = dict(zip(parameters, heads(study, parameters), strict=True)) | {k: head for k, (head, _) in forms.items()}
    rows = [
        [label, *("" if pd.isna(value) else forms.get(name, ("", number))[1](value) for name, value in row.items())]
        for label, row in zip(table["optimum"], shown.to_dict("records"), strict=True)
    ]
    return {"head": ["", *(names[name] for name in shown)], "rows": rows}


def _with_units(study: Study, table: pd.DataFrame) -> tuple[list[str], list[list[str]]]:
    """A table whose first column names parameters, these with their units."""
    return _shown(table.assign(parameter=heads(study, table["parameter"])))


def _shown(table: pd.DataFrame, digits: int = 4) -> tuple[list[str], list[list[str]]]:
    """Columns and cells of a table on the page, numbers with so many digits."""
    return list(map(str, table.columns)), [
        [_cell(value, digits) for value in row] for row in table.itertuples(index=False)
    ]


def _tolerances(table):
    """The tolerance intervals as they are read: each end with what it is, and with its interval."""
    rows = []
    for row in table.to_dict("records"):
        ends = [
            [
                f"{_cell(row[end])} ({row[f'{end}_end']})",
                " to ".join(_cell(row[f"{end}_{side}"], _DIGITS) for side in ("from", "to")),
            ]
            if np.isfinite(row[end])
            else ["–", "–"]
            for end in ("low", "high")
        ]
        rows.append(
            [row["hyperparameters"], row["parameter"], *ends[0], *ends[1], f"{100 * row['draws_without']:.0f} %"]
        )
    return rows


def _cell(value, digits=4):
    if value is None or (isinstance(value, float | np.floating) and not np.isfinite(value)):
        return "–" if value is None or np.isnan(value) else ("∞" if value > 0 else "−∞")
    if isinstance(value, float | np.floating):
        return np.format_float_positional(value, precision=digits, unique=False, fractional=False, trim="-")
    return str(value)
