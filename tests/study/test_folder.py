"""The folder that `hilbo report` reads: materials, references, several tables; bad folders in one sentence."""

import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from commands import run

from hilbo.errors import InputError, InputRemark
from hilbo.report.validation import validate
from hilbo.statistics.paper_tables import aggregate_comparisons
from hilbo.study.analysis.analysis import analyse
from hilbo.study.folder import read_folder

STUDY = Path("hilbo/data/paper.toml").read_text()
HEAD = "participant,trial,response,K1,B1,alpha\n"
ROW = "A,1,close,5,6,0.2\n"
VALIDATION = "participant,trial,set_a,set_b,class_a,class_b,preferred\n"


def folder_with(tmp_path, **files):
    folder = tmp_path / "folder"
    folder.mkdir()
    for name, text in ({"study.toml": STUDY} | {k.replace("__", "."): v for k, v in files.items()}).items():
        (folder / name).write_text(text)
    return folder


BAD = {
    "no trials": ({}, "contains no trials.csv"),
    "the same answer twice": ({"trials__csv": HEAD + ROW, "trials-2__csv": HEAD + ROW}, "is in two trial tables"),
    "another parameter": (
        {"trials__csv": "participant,trial,response,K1,B1\nA,1,close,5,6\n"},
        'column "alpha" is missing',
    ),
    "another answer": ({"trials__csv": HEAD + "A,1,superb,5,6,0.2\n"}, 'response is "superb"'),
    "half of the materials": (
        {"trials__csv": HEAD + ROW, "trials-2__csv": "material," + HEAD + "foam,B,1,close,5,6,0.2\n"},
        "some rows name a material",
    ),
    "two truths": (
        {"trials__csv": HEAD + ROW, "truth__csv": "source,K1,B1,alpha\npopulation,5,6,0.2\npopulation,5,6,0.3\n"},
        'there are 2 sets of source "population"',
    ),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_folders_are_refused_in_one_sentence(capsys, monkeypatch, tmp_path, what):
    files, words = BAD[what]
    code, _, stderr = run(capsys, monkeypatch, "report", folder_with(tmp_path, **files), "--out", tmp_path / "out")
    assert code == 2 and words in stderr
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


def test_somebody_who_stopped_in_the_warm_up_blocks_nobody(tmp_path):
    head = HEAD.replace("\n", ",phase\n")
    folder = folder_with(
        tmp_path,
        **{"trials-A__csv": head + "A,1,close,5,6,0.2,main\n", "trials-B__csv": head + "B,1,close,5,6,0.2,warm-up\n"},
    )
    with pytest.warns(InputRemark, match=r"trials-B.csv: has no rows to fit; .* It is left out."):
        assert read_folder(folder).materials[0].cohort.names == ("A",)
    (folder / "trials-A.csv").unlink()
    with pytest.raises(InputError, match="has no rows to fit"):
        read_folder(folder)


def test_the_report_never_replaces_what_it_reads(capsys, monkeypatch, tmp_path):
    folder = folder_with(tmp_path, trials__csv=HEAD + ROW)
    for out in (folder, tmp_path):
        code, _, stderr = run(capsys, monkeypatch, "report", folder, "--out", out, "--force")
        assert code == 2 and "contains the folder that is read" in stderr
    code, _, stderr = run(capsys, monkeypatch, "report", tmp_path / "none", "--out", tmp_path / "out")
    assert code == 2 and "is no folder" in stderr
    other = folder_with(tmp_path / "folder", trials__csv=HEAD + ROW)
    code, _, stderr = run(
        capsys,
        monkeypatch,
        "validate",
        folder / "trials.csv",
        "--study",
        folder / "study.toml",
        "--out",
        other,
        "--force",
    )
    assert code == 2 and "is not a result of hilbo's" in stderr  # data without a result beside it


def test_a_trial_table_is_read_once_whatever_the_number_of_materials(tmp_path):
    trials = "material," + HEAD + "".join(f"{name},A,1,close,5,6,0.2\n" for name in "xyz")
    folder, opened = folder_with(tmp_path, trials__csv=trials), []

    def count(event, arguments):
        if event == "open" and str(arguments[0]) == str(folder / "trials.csv"):
            opened.append(event)

    sys.addaudithook(count)  # which stays, and looks for this one file
    assert len(read_folder(folder).materials) == 3 and len(opened) == 1


def test_materials_have_their_own_references(tmp_path):
    text = STUDY + "\n[materials.soft.renderer]\nK_eff = 0.3\n"
    trials = "material," + HEAD + "soft,A,1,close,5,6,0.2\nhard,A,1,different,4,6,0.2\n"
    with pytest.raises(InputError, match='material "hard" is not in the study file'):
        read_folder(folder_with(tmp_path, study__toml=text, trials__csv=trials))
    folder = tmp_path / "folder"
    (folder / "study.toml").write_text(text + "[materials.hard]\n")
    (folder / "truth.csv").write_text("source,material,K1,B1,alpha\npopulation,soft,5,6,0.2\npopulation,hard,8,6,0.2\n")
    study_folder = read_folder(folder)
    assert [m.name for m in study_folder.materials] == ["soft", "hard"] and len(study_folder.limits) == 1
    soft, hard = study_folder.materials
    assert soft.study.space.mechanics.K_eff == 0.3 and hard.study.space.mechanics.K_eff == 0.44
    np.testing.assert_allclose([m.reference.x[0] for m in (soft, hard)], [4 / 31, 7 / 31])
    strict = read_folder(folder, "trials < 5").materials[0]
    with pytest.raises(InputError, match="leaves out all 1"):
        analyse(strict.study, strict.cohort)


def test_tables_without_a_material_are_read_by_the_study_s_own_and_the_report_says_so(tmp_path):
    folder = folder_with(tmp_path, study__toml=STUDY + "\n[materials.soft]\n", trials__csv=HEAD + ROW)
    assert "name no material" in read_folder(folder).limits[0]


def test_two_validation_tables_are_read_as_one(tmp_path):
    row = "{},1,aggregate,individual:B,close,different,{}\n"
    first, second = (VALIDATION + row.format(*cells) for cells in (("A", "a"), ("B", "b")))
    folder = folder_with(tmp_path, trials__csv=HEAD + ROW, **{"validation-1__csv": first, "validation-2__csv": second})
    (material,) = read_folder(folder).materials
    validated = validate(material.validation)
    assert validated.people["wins"].tolist() == [1, 0] and validated.comparisons == 2
    twice = aggregate_comparisons(
        pd.concat([material.validation] * 2), {"aggregate": "aggregate", "individual:B": "individual:B"}
    )
    assert len(twice) == 4


def test_a_catch_trial_with_the_map_s_worst_is_no_comparison_of_its_best():
    table = pd.DataFrame({"participant": "A", "set_a": ["best", "worst"], "set_b": "own", "preferred": "own"})
    sources = {"best": "aggregate", "worst": "aggregate", "own": "individual:B"}
    assert len(aggregate_comparisons(table, sources)) == 2
    assert len(aggregate_comparisons(table, sources, {"best": "best", "worst": "worst", "own": ""})) == 1


def test_answers_over_several_tables_are_in_the_order_of_their_trials(tmp_path):
    """Whatever the files are called: Monday's before Friday's."""
    monday, friday = HEAD + "A,1,close,5,6,0.2\n", HEAD + "B,1,close,5,6,0.5\nA,2,similar,5,6,0.3\n"
    folder = folder_with(tmp_path, **{"trials-2_friday__csv": friday, "trials-monday__csv": monday})
    (material,) = read_folder(folder).materials
    assert material.cohort.names == ("A", "B")
    assert material.cohort.trials.q[0].tolist()[:2] == [2, 1]


def test_the_same_answers_with_and_without_a_session_are_the_same(tmp_path):
    second = "session," + HEAD + "1," + ROW
    folder = folder_with(tmp_path, trials__csv=HEAD + ROW, **{"trials-2__csv": second})
    with pytest.raises(InputError, match="is in two trial tables; keep one"):
        read_folder(folder)


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("validation", VALIDATION + "A,1,best,mid,close,similar,a\n"),
        ("sets", "set_id,source,K1,B1,alpha\nsysid,sysid,5,6,0.2\n"),
        ("truth", "source,K1,B1,alpha\npopulation,5,6,0.2\n"),
        ("truth", "source,material,K1,B1,alpha\npopulation,soft,5,6,0.2\npopulation,,5,6,0.2\n"),
    ],
)
def test_what_is_of_no_material_is_not_taken_for_all(tmp_path, file, text):
    trials = "material," + HEAD + "soft,A,1,close,5,6,0.2\nhard,A,1,different,4,6,0.2\n"
    folder = folder_with(tmp_path, trials__csv=trials, **{f"{file}__csv": text})
    with pytest.raises(InputError, match=f"{file}.csv: rows without a material.*this study has soft, hard"):
        read_folder(folder)
