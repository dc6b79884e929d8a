"""The folder of `hilbo report`: study file, trial tables, and optional validation and sets tables.

    study.toml        the study file
    trials*.csv       one or several trial tables (or .parquet); a column `material` distinguishes materials
    validation*.csv   optional: validation tables
    sets*.csv         optional: sets tables; a set of source "sysid" is the reference of tables and figures
    truth.csv         optional, of a simulated study: the true parameters, in a row of `source` "population"
    plan.json         optional: the plan of `hilbo plan`, or several as plan-*.json, with which sessions are compared

The folder of `hilbo export` is one: its data/ contains trials, validation, sets, and sessions (for the plan) by the
names of a Psych-DS. A study of several materials names them in [materials.NAME] (which overrides the renderer or
parameters) or in the tables' column `material` alone, when they share everything. Every mistake is one sentence with
its file.
"""

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float

from hilbo.errors import InputError, warn_caller
from hilbo.study.cohort import Cohort, cohort_of
from hilbo.study.config import Study
from hilbo.study.departures import changed_files, departures
from hilbo.study.file.plan_file import read_plan
from hilbo.study.file.trial_flags import FlagCounts, flag_sentences
from hilbo.study.formats.csv_file import cell_pieces, numbers, parameter_values, read_cells
from hilbo.study.tables.flag_counts import flag_counts
from hilbo.study.tables.missing import Missing
from hilbo.study.tables.sessions import SessionRow, read_session_table
from hilbo.study.tables.trials import NothingToFitError, TrialTable, check_texts, joined, trial_table
from hilbo.study.tables.validation import check_validation, sets_of_study

__all__ = ["Material", "Reference", "StudyFolder", "read_folder"]


class Reference(NamedTuple):
    """The set that optima are compared with: system identification, or the truth of a simulated study.

    `x`: in the unit cube; `name`: in words; `low` and `high`: ends of the 95 % intervals of its parameters, where the
    identification has them for all.
    """

    x: Float[np.ndarray, " d"]
    name: str
    low: Float[np.ndarray, " d"] | None = None
    high: Float[np.ndarray, " d"] | None = None


class Material(NamedTuple):
    """The data of one material in a folder."""

    name: str
    """Empty if the study has one material without a name."""
    study: Study
    cohort: Cohort
    validation: pd.DataFrame | None
    reference: Reference | None
    flags: FlagCounts = FlagCounts()
    """Counts of trials with a flag of the device, and of those excluded for it."""
    missing: Missing = Missing()


class StudyFolder(NamedTuple):
    """The checked content of a folder. `sessions`: those of an export, None if there is no such table."""

    study: Study
    materials: list[Material]
    sets: pd.DataFrame | None
    limits: tuple[str, ...]
    """Sentences: deviations from the plan, and information that the tables lack."""
    notes: tuple[str, ...] = ()
    """Sentences: confirmation of the plan, and flags of comparisons."""
    sessions: list[SessionRow] | None = None


def read_folder(folder: Path, exclude: str | None = None) -> StudyFolder:
    """Read and check all files of a folder. `exclude`: exclusion rule that replaces the study file's; None keeps that
    one.

    Raises `InputError` for a missing or invalid file. Warns about trial tables without a response to fit, and leaves
    them out.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: is no folder; hilbo report wants one with study.toml and trials.csv.")
    study = _with_exclusion(Study.load(folder / "study.toml"), exclude)
    trials = _table_paths(folder, "trials")
    if not trials:
        raise InputError(
            f"{folder}: contains no trials.csv (nor .parquet, nor trials-*.csv, nor an export's data/); put the trial"
            " table there."
        )
    validation = [_validation(path, study) for path in _table_paths(folder, "validation")]
    truth_path = folder / "truth.csv"
    sets = _sets(_table_paths(folder, "sets"), study)
    truth = _read_truth(truth_path, study) if truth_path.exists() else None
    compared = pd.concat(validation, ignore_index=True) if validation else None
    cells = {path: list(cell_pieces(path)) for path in trials}
    names = _material_names(study, cells)
    tables = {
        folder / "validation.csv": compared,
        folder / "sets.csv": _rows_of_source(sets, "sysid"),
        truth_path: _rows_of_source(truth, "population"),
    }
    _check_materials_named(names, tables)
    materials = [_material(name, study, cells, compared, sets, truth) for name in names]
    held = read_session_table(folder)
    departs, as_planned = _departures(folder, study, materials, held)
    limits = (*departs, *changed_files(held or ()), *_missing_tables(study, materials, compared, sets))
    flags = flag_sentences(flag_counts(*validation), study.file.exclude_flags, "comparisons") if validation else []
    return StudyFolder(study, materials, sets, limits, (*as_planned, *flags), held)


def _with_exclusion(study: Study, exclude: str | None) -> Study:
    """The study with another exclusion rule, rebuilt and checked; the same study for None. Raises `InputError` for an
    invalid rule."""
    if exclude is None:
        return study
    content = {"schema": 1} | json.loads(study.file.content)
    content["study"] |= {"exclude": exclude}
    return Study.from_dict(content, study.file.source)


def _table_paths(folder: Path, stem: str) -> list[Path]:
    """Sorted paths of STEM.csv, STEM-*.csv and the same as .parquet, then those of an export's data/. Empty if there
    are none."""
    paths = [
        p
        for p in folder.iterdir()
        if p.suffix in (".csv", ".parquet") and (p.stem == stem or p.stem.startswith(f"{stem}-"))
    ]
    return sorted(paths) + sorted((folder / "data").glob(f"*_table-{stem}_data.csv"))


def _sets(paths: list[Path], study: Study) -> pd.DataFrame | None:
    """All sets tables as one DataFrame indexed by `set_id`, missing texts as ""; None without tables. Raises InputError
    for a `set_id` in two tables."""
    if not paths:
        return None
    whole = pd.concat([sets_of_study(path, study.file) for path in paths])
    again = whole.index[whole.index.duplicated()]
    if len(again):
        raise InputError(f'{paths[0].parent}: the set "{again[0]}" is in two sets tables; keep one.')
    text = whole.select_dtypes(exclude="number").columns
    return whole.fillna(dict.fromkeys(text, ""))


def _validation(path: Path, study: Study) -> pd.DataFrame:
    """Read and check one validation table. Raises InputError."""
    return check_validation(
        read_cells(path, "a validation table needs a header and a comparison"),
        study.responses,
        str(path),
        study.file.exclude_flags,
    )


def _materials_named(pieces: Iterable[pd.DataFrame]) -> list[str]:
    """Different materials in the rows of a table's pieces, in their order; [""] if it has no column `material`."""
    return list(dict.fromkeys(name for cells in pieces for name in cells.get("material", [""])))


def _material_names(study: Study, tables: Mapping[Path, list[pd.DataFrame]]) -> list[str]:
    """Materials named in the tables: those of the study file first, in its order; [""] if none is named anywhere.
    Raises InputError if only some rows name one, or for a name that is not in [materials]."""
    named = [name for pieces in tables.values() for name in _materials_named(pieces)]
    first = next(iter(tables))
    ordered = [name for name in study.file.materials if name in named] + [
        n for n in dict.fromkeys(named) if n not in study.file.materials
    ]
    if "" in ordered and len(ordered) > 1:
        raise InputError(f"{first}: some rows name a material and some do not; name it in every row of every table.")
    unknown = [name for name in ordered if name and study.file.materials and name not in study.file.materials]
    if unknown:
        listed = ", ".join(study.file.materials)
        raise InputError(f'{first}: material "{unknown[0]}" is not in the study file, which has {listed}.')
    return ordered


def _rows_of_source(table: pd.DataFrame | None, source: str) -> pd.DataFrame | None:
    """Rows of a table whose `source` is this; None for no table."""
    return None if table is None else table[table["source"] == source]


def _check_materials_named(names: list[str], tables: Mapping[Path, pd.DataFrame | None]) -> None:
    """Raise InputError for a table with rows without a material, if the study has several or other rows of that table
    name one. None and empty tables pass."""
    for path, table in tables.items():
        if table is None or table.empty or ("material" not in table and len(names) == 1):
            continue
        if "material" not in table or table["material"].isna().any() or (table["material"] == "").any():
            of = f"; this study has {', '.join(names)}" if len(names) > 1 else ""
            raise InputError(f'{path}: rows without a material; name it in a column "material" in every row{of}.')


def _material(
    name: str,
    study: Study,
    tables: Mapping[Path, list[pd.DataFrame]],
    compared: pd.DataFrame | None,
    sets: pd.DataFrame | None,
    truth: pd.DataFrame | None,
) -> Material:
    """One material's data: its cohort, its comparisons (None if none), and its reference. Raises InputError."""
    material_study = study.material(name) if name in study.file.materials else study
    table = _answers(name, material_study, tables)
    _check_answers_once(table.rows, next(iter(tables)))
    if compared is not None and name and "material" in compared:
        compared = compared[compared["material"] == name]
    reference = _reference(material_study, name, sets, truth)
    validation = None if compared is None or compared.empty else compared
    cohort = cohort_of(table, material_study)
    return Material(name, material_study, cohort, validation, reference, table.flags, table.missing)


def _answers(name: str, study: Study, tables: Mapping[Path, list[pd.DataFrame]]) -> TrialTable:
    """A material's responses of all trial tables as one. A table without a response to fit is left out with a warning;
    if all are such, NothingToFitError is raised. At least one table has the material; duplicates are not
    looked for. Raises InputError for an invalid table."""
    read, empty = [], []
    for path, pieces in tables.items():
        if name in _materials_named(pieces):
            try:
                read.append(trial_table(pieces, study.file, name or None, source=str(path), others=False))
            except NothingToFitError as error:
                empty.append(error)
    if not read:
        raise empty[0]
    for error in empty:
        warn_caller(f"{error} It is left out.")
    return joined(read)


def _check_answers_once(table: pd.DataFrame, path: Path) -> None:
    """Raise InputError if a response occurs twice in the joined tables. Rows are compared by those of participant,
    session, phase and trial that no row lacks."""
    known = table.notna().all()
    key = [column for column in ("participant", "session", "phase", "trial") if column in table and known[column]]
    again = table.duplicated(key)
    if again.any():
        row = table[again].iloc[0]
        raise InputError(
            f"{path.parent}: participant {row['participant']}, trial {row['trial']} is in two trial tables; keep one."
        )


def _read_truth(path: Path, study: Study) -> pd.DataFrame:
    """Read truth.csv: `source`, the parameters as numbers (levels by index), and `material` if there is one. Raises
    InputError."""
    cells = read_cells(path, "a table of truth needs a header and a row")
    check_texts(cells, str(path), study.space.names)
    missing = [name for name in ("source", *study.space.names) if name not in cells]
    if missing:
        raise InputError(f'{path}:1: column "{missing[0]}" is missing.')
    values = {
        p.name: parameter_values(cells, p, str(path))
        if p.levels
        else numbers(cells, p.name, str(path), "a finite number", np.isfinite)
        for p in study.space.parameters
    }
    return pd.DataFrame(values).assign(
        source=cells["source"], **({"material": cells["material"]} if "material" in cells else {})
    )


def _reference(study: Study, name: str, sets: pd.DataFrame | None, truth: pd.DataFrame | None) -> Reference | None:
    """Reference of a material: the sets table's system identification, otherwise the simulation's truth. None if
    neither has exactly one row with finite numbers. Raises InputError for several rows of one material."""
    names = list(study.space.names)
    for table, source, words in ((sets, "sysid", "system identification"), (truth, "population", "the truth")):
        rows = _rows_of_source(table, source)
        if rows is None:
            continue
        rows = rows[rows["material"] == name] if name and "material" in rows else rows
        if len(rows) == 1 and np.isfinite(rows[names].to_numpy(float)).all():
            ends = [_end(study, rows, end) for end in ("low", "high")]
            return Reference(np.asarray(study.space.to_unit(rows[names].to_numpy(float)[0])), words, *ends)
        if len(rows) > 1:
            raise InputError(
                f'there are {len(rows)} sets of source "{source}" for material "{name}"; keep one, or add a'
                ' column "material".'
            )
    return None


def _end(study: Study, row: pd.DataFrame, end: str) -> Float[np.ndarray, " d"] | None:
    """Lower or upper ends of the intervals of a reference's parameters (columns PARAMETER_low, PARAMETER_high), in the
    unit cube; None if one of them is missing or, on a logarithmic scale, not positive. Raises InputError for an end on
    the wrong side of its value."""
    columns = [f"{name}_{end}" for name in study.space.names]
    if not set(columns) <= set(row) or not np.isfinite(row[columns].to_numpy(float)).all():
        return None
    ends, values = row[columns].to_numpy(float)[0], row[list(study.space.names)].to_numpy(float)[0]
    wrong = ends > values if end == "low" else ends < values
    if wrong.any():
        name = study.space.names[int(wrong.argmax())]
        raise InputError(f'the set of source "sysid" has a {name}_{end} on the wrong side of its {name}; correct it.')
    if any(p.scale == "log" and value <= 0 for p, value in zip(study.space.parameters, ends, strict=True)):
        return None
    return np.asarray(study.space.to_unit(ends))


def _departures(
    folder: Path, study: Study, materials: list[Material], held: list[SessionRow] | None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Compare the sessions with the plans in plan.json or plan-*.json; returns (sentences on deviations, sentences that
    confirm a plan); both are empty without a plan. Responses excluded for their flags are counted too. `held`:
    the sessions, None if not known. Raises InputError for a plan that cannot be read or is of another study."""
    plans = {path: read_plan(path) for path in sorted([*folder.glob("plan.json"), *folder.glob("plan-*.json")])}
    for path, plan in plans.items():
        if plan.meaning != study.file.meanings(plan.materials):
            raise InputError(f"{path}: is the plan of another study ({plan.study}); remove it from the folder.")
    counts: dict[str, dict[str, int]] = {}
    for material in materials:
        answers = Counter(dict(zip(material.cohort.names, material.cohort.counts().tolist(), strict=True)))
        for name, count in (answers + Counter(material.flags.excluded)).items():
            counts.setdefault(name, {})[material.name] = count
    return departures(list(plans.values()), counts, held, study.file.hash)


def _missing_tables(
    study: Study, materials: list[Material], compared: pd.DataFrame | None, sets: pd.DataFrame | None
) -> tuple[str, ...]:
    """Sentences about materials, validation and sets that the folder's tables do not have."""
    sentences = []
    if study.file.materials and materials[0].name == "":
        sentences.append("The tables name no material; they are read by the study's own, and none of [materials].")
    if compared is None:
        sentences.append("There is no validation table: the map is not validated.")
    for material in materials:
        if compared is not None and material.validation is None:
            sentences.append(f"No validation session compared renderings of {material.name}.")
    if sets is None and compared is not None:
        sentences.append("There is no sets table: sets are known by their names in the validation table only.")
    return tuple(sentences)
