"""`hilbo import`: exports of many programs give the clean table, or one sentence; nothing of a person comes along."""

import json
import os
import tomllib
import warnings

import exported
import numpy as np
import pandas as pd
import pytest
from export_mutations import CHANGES, written

from hilbo.errors import InputError
from hilbo.study.cohort import cohort_of, read_trials
from hilbo.study.config import Study
from hilbo.study.importing.export import OpenMappingError, import_files
from hilbo.study.importing.mapping import mapping_of, mapping_text, read_mapping
from hilbo.study.tables.trials import trial_table

STUDY = exported.study()
CLEAN = {export.name: exported.clean for export in exported.SAME} | {
    export.name: exported._same_stimuli for export in exported.SAME_STIMULI
}


def numbers_of(table: pd.DataFrame) -> list[np.ndarray]:
    """What a fit takes of a trial table: participants by number, categories, parameters, in order."""
    rows = trial_table([table.astype(str)], STUDY, source="DataFrame", note=lambda sentence: None).rows
    person, _ = pd.factorize(rows["participant"])
    return [person, rows["category"].to_numpy(), rows["hue"].to_numpy(float), rows["light"].to_numpy(float)]


def imported(export, folder, notes):
    """Import an export; where the import asks, with the completed mapping."""
    paths = export.write(folder)
    try:
        made = import_files(paths, STUDY, note=notes.append)
        assert export.complete is None, "nothing was asked"
        return made
    except OpenMappingError as error:
        if export.complete is None:
            raise
        notes.append(str(error))
        file = folder / "mapping.toml"
        file.write_text(export.complete(mapping_text(error.mapping)))
        return import_files(paths, STUDY, read_mapping(file), note=notes.append)


@pytest.mark.parametrize("export", [*exported.SAME, *exported.SAME_STIMULI], ids=lambda export: export.name)
def test_an_export_gives_the_clean_table(export, tmp_path):
    notes = []
    made, mapping = imported(export, tmp_path, notes)
    for got, clean in zip(numbers_of(made.table), numbers_of(CLEAN[export.name]()), strict=True):
        np.testing.assert_array_equal(got, clean)
    assert mapping_of(tomllib.loads(mapping_text(mapping)), "") == mapping
    for text in (made.table.to_csv(), json.dumps(made.record)):
        assert not [secret for secret in exported.SECRETS if secret in text]


def test_there_are_forty():
    assert len(exported.SAME) + len(exported.SAME_STIMULI) >= 40


# Random changes.


def outcome(path, text_of_mapping=None):
    """Numbers of an import and all that it says, without counts that any table has; the sentence if it is refused."""
    notes = []
    try:
        made, _ = import_files([path], STUDY, note=notes.append)
        return numbers_of(made.table), made.table, sorted(notes + made.sentences)
    except InputError as error:
        return None, None, [str(error)]


def is_as_before(numbers, table, clean):
    """Whether all answers are those of the clean table; ids may have other names, rows another order."""
    return all(map(np.array_equal, numbers, numbers_of(clean)))


def check_mutation(seed, folder):
    """A change gives the clean table, or says so: by an error, or by a sentence that the clean table does not have."""
    rng = np.random.default_rng(seed)
    clean = exported.clean(int(rng.integers(1000)))
    frame = clean.astype(str).astype(object)
    chosen = [str(name) for name in rng.choice([*CHANGES], rng.choice([1, 1, 2]), replace=False)]
    for name in chosen:
        if (
            len(frame)
            and {"participant", "trial", "response", "hue", "light"} <= {*frame.columns}
            and frame.columns.is_unique
        ):
            try:
                frame = CHANGES[name](frame, rng)
            except (ValueError, IndexError):
                break  # the cells are changed already
    done = written(frame, folder / f"{seed}.csv", rng)
    numbers, table, said = outcome(folder / f"{seed}.csv")
    if numbers is None or is_as_before(numbers, table, clean):
        return
    clean.to_csv(folder / "clean.csv", index=False)
    usual = [sentence for sentence in outcome(folder / "clean.csv")[2]]
    words = [s for s in said if s not in usual and "is read with" not in s and "is read as" not in s]
    if f"{len(clean)} rows read" in " ".join(words):  # a number of participants is not enough
        words = [sentence for sentence in words if "rows read" not in sentence]
    assert words, f"seed {seed}: {chosen}, {done}: other numbers without a word"
    return words


@pytest.mark.parametrize("seed", range(20))
def test_a_random_change_is_never_silent(seed, tmp_path):
    check_mutation(seed, tmp_path)


@pytest.mark.deep
def test_a_thousand_random_changes_are_never_silent(tmp_path):
    """The seeds begin at HILBO_SEED."""
    first = int(os.environ.get("HILBO_SEED", "0"))
    for seed in range(first, first + 1000):
        check_mutation(seed, tmp_path)


# DataFrames.


def frame_of(**changes):
    """The clean table as a DataFrame, with changed columns."""
    return exported.clean().assign(**changes)


def test_an_ordered_categorical_that_contradicts_the_study_is_remarked():
    study = Study.from_dict(tomllib.loads(exported.STUDY))
    response = frame_of()["response"]
    for order, warned in ((["close", "similar", "different"], True), (["different", "similar", "close"], False)):
        frame = frame_of(response=pd.Categorical(response, order, ordered=True))
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            cohort_of(frame, study)
        assert any("the study's order different < similar < close is used" in str(w.message) for w in caught) == warned


def test_columns_with_several_levels_are_refused():
    frame = exported.clean()
    frame.columns = pd.MultiIndex.from_product([["a"], frame.columns])
    with pytest.raises(InputError, match="the columns have 2 levels"):
        cohort_of(frame, Study.from_dict(tomllib.loads(exported.STUDY)))


def test_a_mapping_in_python(tmp_path):
    path = tmp_path / "export.csv"
    exported._renamed(**exported._HEADERS)(exported.clean()).to_csv(path, index=False)
    columns = {"participant": "Subject ID", "trial": "Trial Nr.", "response": "Rating"}
    mapping = {"columns": columns | {"hue": "Hue (deg)", "light": "Light [%]"}}
    study = Study.from_dict(tomllib.loads(exported.STUDY))
    rows = read_trials(path, study, mapping=mapping)
    np.testing.assert_array_equal(rows["hue"], exported.clean()["hue"])
