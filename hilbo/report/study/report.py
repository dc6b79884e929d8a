"""`hilbo report`: a folder of sessions as one page, in the paper's order, with figures (SVG, PNG, PDF) and tables
(CSV).

Each material has its figures 4 to 8 and tables I to IV, its limits, its participants and the passivity of every
optimum; hypotheses H1 to H4 have a section each (`hilbo.report.study.hypotheses`). With several materials the files of
each are in a folder of its name. result.json has all numbers, `inference.nc` the posterior for ArviZ, `map.nc` the
population map.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hilbo.report import validation
from hilbo.report.page import Pictures, rendered
from hilbo.report.participants import people_of
from hilbo.report.result_file import write_result
from hilbo.report.results import cohort_content, optima_table, save_figures, versions, write_grid
from hilbo.report.study.checklist import checklist
from hilbo.report.study.comparison import comparison_section, comparison_table
from hilbo.report.study.dictionary import dictionary
from hilbo.report.study.hypotheses import Results, hypotheses
from hilbo.report.study.key_numbers import key_numbers, key_numbers_table, key_numbers_words
from hilbo.report.study.page_tables import alternatives_rows, measures_rows, table_1_rows, tolerance_rows
from hilbo.report.study.result_tables import alternatives_table, convergence_table, table_1, tolerance_table
from hilbo.report.study.sessions import SESSIONS_HEAD, described, session_rows
from hilbo.report.study.study_figures import comparison_figures, study_figures
from hilbo.report.validation import Validated, folder_names, named_warnings, validate
from hilbo.study.analysis.analysis import Analysis, analyse, moved_by_evidence
from hilbo.study.analysis.heterogeneity import how_aggregated
from hilbo.study.estimate.aggregate import SayCount, silent
from hilbo.study.file.trial_flags import flag_sentences
from hilbo.study.folder import Material, StudyFolder
from hilbo.study.results.arviz_groups import groups, predictive_shares, write_groups
from hilbo.study.results.map_netcdf import map_dataset

__all__ = ["write_study"]


def write_study(
    folder: StudyFolder,
    out: Path,
    seed: int = 0,
    say: Callable[[str], None] = lambda text: None,
    analyses: Mapping[str, Analysis] | None = None,
    comparison: bool = True,
    people: Mapping[str, Mapping[str, str]] | None = None,
    count: SayCount = silent,
) -> dict[str, Any]:
    """Analyse a study's folder and write the results of `hilbo report` into the existing folder `out`; return the
    content of result.json.

    `say`: called with a text at each step, `count` with the progress of long ones; `analyses`: finished analyses by
    name of the material, which are not repeated; `comparison`: whether the other ones also compare the aggregation
    methods; `people`: participant -> row of participants.csv, of which only a summary is written. Raises `InputError`
    for data that cannot be analysed.
    """
    results, contents, sections = [], {}, []
    analyses = {} if analyses is None else analyses
    folders = folder_names([material.name for material in folder.materials])
    for material in folder.materials:
        words = f" ({material.name})" if material.name else ""

        def tell(text, words=words):
            say(f"{text}{words}")

        analysis = analyses.get(material.name) or analyse(
            material.study, material.cohort, seed, tell, comparison=comparison, count=count
        )
        validated = _validated(material, folder, tell)
        results.append(Results(material.name, analysis, validated, material.reference))
        material_folder = out / folders[material.name] if len(folder.materials) > 1 else out
        material_folder.mkdir(exist_ok=True)
        tell("figures and tables")
        content, section = _write_material(material, analysis, validated, material_folder, seed)
        contents[material.name] = content
        sections.append(section)
    claims = hypotheses(results) if folder.study.file.report.hypotheses else []
    content = _content(folder, contents, claims, seed)
    content["people"] = None if people is None else described(people, _everybody(folder))
    write_result(content, out)
    say("writing the page")
    page = _page(folder, content, sections, claims, comparison)
    (out / "report.html").write_text(page, encoding="utf-8")
    return content


def _page(folder: StudyFolder, content, sections, claims, compares: bool) -> str:
    """The HTML of report.html. A participant counts as excluded if no material's map includes their responses.

    `sections`, `claims`: of the materials and the hypotheses; `compares`: whether aggregation methods are compared
    where there are enough participants.
    """
    kept = {name for section in sections for name in section["participants"]}
    answered = kept.union(*(section["left_out"] for section in sections))
    return rendered(
        "study.html",
        study=folder.study,
        content=content,
        warnings=content["limits"],  # those of the materials are footnotes of their cards
        notes=folder.notes,
        sections=sections,
        people=len(kept),
        left_out=len(answered) - len(kept),
        compares=compares,
        hypotheses=claims,
        sessions=session_rows(folder.sessions or ()),
        sessions_head=SESSIONS_HEAD,
    )


def _everybody(folder: StudyFolder) -> list[str]:
    """All participants with responses, of optimisations or validations."""
    names = [name for material in folder.materials for name in material.cohort.names]
    for material in folder.materials:
        names += [] if material.validation is None else list(material.validation["participant"])
    return list(dict.fromkeys(names))


def _content(folder: StudyFolder, contents, claims, seed) -> dict[str, Any]:
    """The content of result.json, from that of the materials by name, the hypotheses (`claims`) and the seed."""
    return {
        "materials": contents,
        "hypotheses": [{"number": h.number, "evidence": [e._asdict() for e in h.evidence]} for h in claims],
        "study": folder.study.file.hash,
        "seed": seed,
        "versions": versions(),
        "warnings": named_warnings(contents),
        "limits": list(folder.limits),
    }


def _validated(material: Material, folder: StudyFolder, say) -> Validated | None:
    """Statistics of a material's validation sessions, None if it has none; calls `say`. Raises `InputError` for a bad
    table.
    """
    if material.validation is None:
        return None
    say("validation sessions")
    name = material.name if "material" in material.validation and material.name else None
    return validate(material.validation, folder.sets, material.study.responses, name, material.study.goal_label)


def _write_material(material, analysis: Analysis, validated, folder: Path, seed):
    """Write all files of one material but result.json and report.html into an existing folder: inference.nc, map.nc,
    figures and tables. Return its content for result.json, and its section of the page.
    """
    study, people = analysis.study, people_of(analysis.study, analysis.aggregate)
    reference = material.reference
    truth = reference.x if reference is not None and reference.name == "the truth" else None
    content = cohort_content(analysis.population, truth, people) | {"participants": list(people.entries())}
    data = groups(study, analysis.cohort, analysis.aggregate.posteriors, seed=seed)
    write_groups(data, folder / "inference.nc")
    write_grid(content, map_dataset(study, analysis.aggregate.surface), folder)
    tables = _tables(analysis, material, content, people)
    tables["key_numbers"] = key_numbers_table(analysis, key_numbers(analysis, validated, reference))
    shares = predictive_shares(data, len(study.responses))
    figures, hatched = study_figures(analysis, material, shares)
    pictures = save_figures(figures, folder)
    if analysis.comparison is not None:
        tables["comparison"] = comparison_table(analysis.comparison)
        pictures |= save_figures(comparison_figures(analysis.comparison), folder)
    if validated is not None:
        content["validation"] = validation.validation_content(validated)
        tables |= validation.validation_csv(validated)
        pictures |= save_figures(validation.validation_figures(validated), folder)
    tables["dictionary"] = dictionary(tables, study)
    for name, table in tables.items():
        table.to_csv(folder / f"{name}.csv", index=False)
    content |= {
        "left_out": analysis.left_out,
        "flags": material.flags.content(),
        "missing": material.missing.content(),
        "limits": list(analysis.limits),
        "optimised": _optimised(analysis),
        "tolerance": tables["tolerance"].to_dict("records"),
        "key_numbers": tables["key_numbers"].to_dict("records"),
        "comparison": analysis.comparison,
    }
    section = _section(material, analysis, validated, tables, pictures, content)
    items = checklist(analysis, content, validated is not None)
    return content, section | {"hatched": hatched, "checklist": items, "dictionary": tables["dictionary"]}


def _tables(analysis: Analysis, material: Material, content, people) -> dict[str, pd.DataFrame]:
    """Tables that every material has, by file name without .csv."""
    return {
        "optima": optima_table(content, people),
        "table_I": table_1(analysis, material.reference),
        "convergence": convergence_table(analysis),
        "tolerance": tolerance_table(analysis),
        "people": analysis.people.assign(left_out=analysis.people["participant"].map(analysis.left_out)),
        "alternatives": alternatives_table(analysis),
    }


def _optimised(analysis: Analysis) -> dict[str, Any]:
    """Hyperparameters of maximum evidence, and the shift of the optimum by them (NRMSE), for result.json."""
    gp = analysis.hyperparameters.optimised.gp
    return {
        "theta": np.asarray(gp.kernel.theta).tolist(),
        "noise": float(gp.likelihood.noise),
        "thresholds": np.asarray(gp.likelihood.thresholds).tolist(),
        "criterion": analysis.hyperparameters.criterion,
        "nrmse": moved_by_evidence(analysis),
    }


def _section(material: Material, analysis: Analysis, validated, tables, pictures: Pictures, content) -> dict[str, Any]:
    """Section of the page for one material, as values for the template; `tables`: by file name, `content`: of its part
    of result.json.
    """
    from hilbo.report.figures.study import UNKNOWN, typical_person

    labels = analysis.hyperparameters.labels
    readings = zip(labels, (analysis.fixed, analysis.optimised), strict=True)
    words = dict(zip(("fixed", "optimised"), labels, strict=True))
    return {
        "name": material.name,
        "study": analysis.study,
        "participants": analysis.cohort.names,
        "answers": int(analysis.cohort.counts().sum()),
        "limits": analysis.limits,
        "left_out": analysis.left_out,
        "flags": [
            *flag_sentences(material.flags, analysis.study.file.exclude_flags),
            *material.missing.sentences,
        ],
        "figures": pictures,
        "typical": analysis.cohort.names[typical_person(analysis)],
        "unknown": UNKNOWN,
        "how": how_aggregated(analysis.aggregate.map),
        "reference": None if material.reference is None else material.reference.name,
        "key_numbers": key_numbers_words(tables["key_numbers"]),
        "table_1": table_1_rows(analysis.study, tables["table_I"]),
        "alternatives": alternatives_rows(analysis.study, tables["alternatives"]),
        "tolerance": tolerance_rows(analysis.study, tables["tolerance"].replace({"hyperparameters": words})),
        "people": measures_rows(tables["people"].drop(columns=["categories", "left_out"])),
        "moved": content["optimised"]["nrmse"],
        "criterion": content["optimised"]["criterion"],
        "model_check": content["model_check"],
        "chances": content["optimum"]["class_probabilities"],
        "highest": content["highest_answer"],
        "without": [name for name, reading in readings if all(i is None for i, _ in reading.tolerances.values())],
        "comparison": content["comparison"] and comparison_section(analysis.study, content["comparison"]),
        "halves": analysis.progress.splits,
        "validation": None if validated is None else validation.validation_section(validated),
    }
