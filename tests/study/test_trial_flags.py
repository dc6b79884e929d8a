"""Trials that a device flagged: which an analysis leaves out, and what is said of them."""

import json

import pandas as pd
import pytest
from commands import run
from studies import PLAIN

from hilbo import Study
from hilbo.errors import InputError, InputRemark
from hilbo.session.plan.plan import make_plan
from hilbo.study.file.plan_file import plan_text
from hilbo.study.file.reading import StudyFile
from hilbo.study.file.trial_flags import FLAGS, flag_sentences, flag_words
from hilbo.study.folder import read_folder
from hilbo.study.formats.csv_file import cell_pieces
from hilbo.study.tables.flag_counts import flag_counts
from hilbo.study.tables.trials import NothingToFitError, trial_table
from hilbo.study.tables.validation import check_validation, read_validation

TOML = """\
schema = 1
[study]
name = "plain"
responses = ["different", "similar", "close"]
{rule}
[parameters.u]
low = 0.0
high = 1.0
[gp]
theta = 30.0
variance = 1.0
thresholds = [-0.5, 0.5]
noise = 0.5
"""
RULE = 'exclude_flags = ["saturated", "slewed"]'
TABLE = """\
participant,trial,response,u,phase,flags,telemetry_samples
A,1,close,0.1,optimisation,,812
A,2,close,0.2,optimisation,saturated slewed,900
A,3,close,0.3,optimisation,controlled,850
A,4,close,0.4,optimisation,,
A,1,close,0.4,warm-up,saturated,800
B,1,close,0.5,optimisation,slewed looked odd,700
B,2,close,0.6,optimisation,odd,700
"""


def read(folder, text=TABLE, rule=RULE, **options):
    (folder / "study.toml").write_text(TOML.format(rule=rule))
    (folder / "trials.csv").write_text(text)
    path = folder / "trials.csv"
    return trial_table(cell_pieces(path), StudyFile.load(folder / "study.toml"), source=str(path), **options)


def trials(table):
    return list(zip(table.rows["participant"], table.rows["trial"], strict=True))


def test_flagged_trials_are_left_out_and_counted(tmp_path):
    table = read(tmp_path, others=False)
    assert trials(table) == [("A", 1), ("A", 3), ("A", 4), ("B", 2)]
    counts = table.flags
    assert counts.content() == {"recorded": 5, "flagged": {"saturated": 1, "slewed": 2, "controlled": 1}, "left_out": 2}
    assert flag_sentences(counts, ("saturated", "slewed")) == [
        "Device flags were recorded for 5 trials (saturated 1, slewed 2, controlled 1); excluded by [study]"
        " exclude_flags (saturated, slewed): 2."
    ]


def test_without_the_key_every_trial_is_fitted_and_the_digest_is_as_before(tmp_path):
    table = read(tmp_path, rule="")
    assert len(table.rows) == 6 and table.flags.left_out == 0
    (said,) = flag_sentences(table.flags, ())
    assert said.endswith("(saturated 1, slewed 2, controlled 1); no trial is excluded.")
    assert StudyFile.load(tmp_path / "study.toml").hash == "e39dc5a71740fb33"  # as before there was such a key
    empty = PLAIN | {"study": PLAIN["study"] | {"exclude_flags": []}}
    named = PLAIN | {"study": PLAIN["study"] | {"exclude_flags": ["hold"]}}
    assert Study.from_dict(empty).file.hash == Study.from_dict(PLAIN).file.hash != Study.from_dict(named).file.hash


def test_a_table_without_a_record_of_flags_is_read_and_that_is_said(tmp_path):
    table = read(tmp_path, "participant,trial,response,u\nA,1,close,0.1\n")
    assert len(table.rows) == 1
    (said,) = flag_sentences(table.flags, ("hold",))
    assert said == "No device flags were recorded for these trials; [study] exclude_flags (hold) excludes none."
    assert flag_sentences(table.flags, ()) == []


def test_whoever_has_no_other_answer_is_named(tmp_path):
    with pytest.warns(
        InputRemark, match="repeated, or excluded by `exclude_flags`, and not fitted; B has no other answer"
    ):
        read(tmp_path, "\n".join(TABLE.splitlines()[:-1]) + "\n")
    with pytest.raises(NothingToFitError, match="all are warm-up, repeated or voided, or excluded by `exclude_flags`"):
        read(tmp_path, "\n".join(line for line in TABLE.splitlines() if "slewed" in line or "part" in line) + "\n")


def test_an_unknown_flag_is_one_sentence_and_bad_usage(tmp_path, capsys, monkeypatch):
    with pytest.raises(InputError, match=r"study\.toml:5: study\.exclude_flags.*saturated, slewed, controlled"):
        read(tmp_path, rule='exclude_flags = ["odd"]')
    code, _, err = run(
        capsys,
        monkeypatch,
        "aggregate",
        tmp_path / "trials.csv",
        "--study",
        tmp_path / "study.toml",
        "--out",
        tmp_path / "o",
    )
    assert code == 2 and "exclude_flags" in err and "Traceback" not in err


def test_comparisons_with_a_flag_are_left_out_too():
    rows = {"participant": "A", "trial": [1, 2, 3], "set_a": "x", "set_b": "y", "class_a": "", "class_b": ""}
    table = pd.DataFrame(
        rows | {"preferred": "a", "flags": ["", "hold", "slewed"], "telemetry_samples": ["9", "9", "9"]}
    )
    kept = check_validation(table, exclude_flags=("slewed",))
    assert kept["trial"].tolist() == [1, 2]
    assert flag_counts(kept).content() == {"recorded": 3, "flagged": {"slewed": 1, "hold": 1}, "left_out": 1}
    assert len(check_validation(table)) == 3
    with pytest.raises(InputError, match="excluded by `exclude_flags`"):
        check_validation(table[1:], exclude_flags=("slewed", "hold"))


@pytest.mark.deep
def test_the_page_of_comparisons_says_which_are_left_out(tmp_path, capsys, monkeypatch):
    read(tmp_path)
    rows = "".join(
        f"P{i},{n},best,worst,close,{('similar', 'different')[n % 2]},{'ab'[n % 3 == 0]},{'slewed' if n == 4 else ''}\n"
        for i in range(4)
        for n in range(1, 5)
    )
    (tmp_path / "v.csv").write_text(f"participant,trial,set_a,set_b,class_a,class_b,preferred,flags\n{rows}")
    where = ("--study", tmp_path / "study.toml", "--out", tmp_path / "out", "--json")
    code, stdout, err = run(capsys, monkeypatch, "validate", tmp_path / "v.csv", *where)
    assert code == 0, err
    said = "Device flags were recorded for 4 comparisons (slewed 4); excluded by [study] exclude_flags"
    assert said in json.loads(stdout)["warnings"][0] and said in (tmp_path / "out" / "report.html").read_text()


def test_a_folder_counts_its_tables_together(tmp_path):
    read(tmp_path)
    (tmp_path / "trials-2.csv").write_text(TABLE.replace("\nA,", "\nC,").replace("\nB,", "\nD,"))
    rows = "A,1,x,y,close,similar,a,slewed\nA,2,x,y,close,similar,a,\n"
    (tmp_path / "validation.csv").write_text(f"participant,trial,set_a,set_b,class_a,class_b,preferred,flags\n{rows}")
    folder = read_folder(tmp_path)
    assert folder.materials[0].flags.content()["left_out"] == 4 and folder.materials[0].flags.recorded == 10
    assert folder.materials[0].cohort.counts().tolist() == [3, 1, 3, 1]
    assert any("recorded for 1 comparisons (slewed 1); excluded by" in note for note in folder.notes)
    assert len(folder.materials[0].validation) == 1
    assert folder.materials[0].flags.excluded == {"A": 1, "B": 1, "C": 1, "D": 1}


def test_excluded_trials_were_held_as_planned(tmp_path):
    """They do not make a plan of two trials each look unfinished."""
    text = (
        "participant,trial,response,u,flags\nA,1,close,0.1,\nA,2,close,0.2,slewed\nB,1,close,0.1,\nB,2,similar,0.3,\n"
    )
    read(tmp_path, text, rule=RULE)
    with (tmp_path / "study.toml").open("a") as file:
        file.write("[selection]\ntrials = 2\nspace_filling = 1\n")
    plan = make_plan(StudyFile.load(tmp_path / "study.toml"), ["A", "B"])
    (tmp_path / "plan.json").write_text(plan_text(plan))
    assert not any("number of answers" in limit for limit in read_folder(tmp_path).limits)


def test_a_material_s_comparisons_are_counted_alone(tmp_path):
    rows = "A,foam,1,x,y,close,similar,a,slewed\nA, gel ,1,x,y,close,similar,a,\nA,gel,2,x,y,close,similar,a,hold\n"
    path = tmp_path / "validation.csv"
    path.write_text(f"participant,material,trial,set_a,set_b,class_a,class_b,preferred,flags\n{rows}")
    table = read_validation(path, material="gel", exclude_flags=("slewed",))
    assert len(table) == 2 and flag_counts(table).content() == {"recorded": 1, "flagged": {"hold": 1}, "left_out": 0}


def test_the_cell_of_some_flags():
    assert flag_words(["slewed", "saturated"]) == "saturated slewed" and flag_words([]) == ""
    assert flag_words(FLAGS) == " ".join(FLAGS)


def test_a_table_of_warm_up_trials_alone_is_one_sentence(tmp_path):
    """No row is fitted, and the columns of the device are those of no rows."""
    with pytest.raises(NothingToFitError, match="all are warm-up"):
        read(tmp_path, "participant,trial,response,u,phase,telemetry_samples\nA,1,close,0.4,warm-up,800\n")
