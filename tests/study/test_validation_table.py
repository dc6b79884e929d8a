"""Validation and sets tables: what they say is read, and what is wrong with them is said in one sentence."""

import pandas as pd
import pytest

from hilbo.errors import InputError
from hilbo.study.tables.parameter_sets import source_kind
from hilbo.study.tables.validation import check_validation, read_validation, sets_frame

HEAD = "participant,material,session,trial,set_a,set_b,first,class_a,class_b,preferred"
GOOD = ["P1,foam,1,1,best,mid,b,close,similar,a", "P1,foam,1,2,mid,worst,mid,2,1,tie", "P2,foam,1,1,best,i1,,,,i1"]
SETS = "set_id,source,K1,N,T"


def write(tmp_path, *rows, head=HEAD):
    path = tmp_path / "table.csv"
    path.write_text("\n".join([head, *rows]) + "\n", encoding="utf-8")
    return path


def test_names_letters_ranks_and_ties_are_read(tmp_path):
    rows = read_validation(write(tmp_path, *GOOD))
    assert list(rows["preferred"]) == ["best", "tie", "i1"] and list(rows["first"]) == ["mid", "mid", ""]
    assert list(rows["class_a"]) == ["close", "similar", ""] and list(rows["class_b"]) == ["similar", "different", ""]
    assert list(rows["trial"]) == [1, 2, 1]


def test_a_table_made_in_memory_is_the_same(tmp_path):
    rows = read_validation(write(tmp_path, *GOOD))
    table = pd.DataFrame([row.split(",") for row in GOOD], columns=HEAD.split(",")).replace("", None)
    table["trial"] = table["trial"].astype(int)
    again = check_validation(table)
    pd.testing.assert_frame_equal(rows.reset_index(drop=True), again, check_dtype=False)
    pd.testing.assert_frame_equal(check_validation(again), again)


def test_parquet_is_the_same(tmp_path):
    rows = read_validation(write(tmp_path, *GOOD))
    rows.assign(first=float("nan")).to_parquet(tmp_path / "table.parquet")
    again = read_validation(tmp_path / "table.parquet")
    assert list(again["first"]) == ["", "", ""]
    pd.testing.assert_frame_equal(again.drop(columns="first"), rows.drop(columns="first").set_axis([1, 2, 3]))


def test_what_was_voided_or_a_warm_up_is_left_out(tmp_path):
    rows = pd.DataFrame([row.split(",") for row in GOOD], columns=HEAD.split(","))
    rows = rows.assign(voided=["1", "0", ""], phase=["validation", "validation", "Warm-up"])
    assert check_validation(rows).index.tolist() == [1]
    with pytest.raises(InputError, match="has no comparison that counts"):
        check_validation(rows.assign(voided="1"))


def test_a_material_is_chosen(tmp_path):
    path = write(tmp_path, *GOOD, "P1,silicone,1,1,best,mid,a,close,close,a")
    with pytest.raises(InputError, match=r"contains 2 materials \(foam, silicone\); choose one of them"):
        read_validation(path)
    assert len(read_validation(path, material="silicone")) == 1
    with pytest.raises(InputError, match='no comparisons of material "steel"; it has foam, silicone'):
        read_validation(path, material="steel")


@pytest.mark.parametrize(
    ("row", "sentence"),
    [
        (",foam,1,3,best,mid,a,close,close,a", ":5: participant is empty"),
        ("P1,foam,1,0,best,mid,a,close,close,a", ':5: trial is "0"; it must be a whole number from 1'),
        ("P1,foam,1,x,best,mid,a,close,close,a", ':5: trial is "x"'),
        ("P1,foam,1,3,best,,a,close,close,a", ":5: set_b is empty"),
        ("P1,foam,1,3,best,best,a,close,close,a", ':5: set_a and set_b are both "best"'),
        ("P1,foam,1,3,a,best,a,close,close,a", ':5: set_a is "a", which has a fixed meaning'),
        ("P1,foam,1,3,best,mid,c,close,close,a", ':5: first is "c"; it must be best, mid, or empty'),
        (
            "P1,foam,1,3,best,mid,a,near,close,a",
            ':5: class_a is "near"; it must be one of different, similar, close, a',
        ),
        ("P1,foam,1,3,best,mid,a,close,4,a", ':5: class_b is "4"'),
        ("P1,foam,1,3,best,mid,a,close,close,worst", ':5: preferred is "worst"; it must be best, mid, tie, or empty'),
        ("P1,foam,1,3,best,mid,tie,close,close,a", ':5: first is "tie"'),
        ("P1,foam,1,3,best,mid,a,,,", ":5: has no response"),
        ("P1,foam,1,2,best,mid,a,close,close,a", ":5: participant P1, trial 2 is there already"),
        ("P1,foam,1,3,best,mid,a,close,close", ":5: has 9 cells, the header has 10"),
    ],
)
def test_a_bad_row_is_named(tmp_path, row, sentence):
    with pytest.raises(InputError, match=r"table\.csv") as caught:
        read_validation(write(tmp_path, *GOOD, row))
    assert f"table.csv{sentence}" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_bad_table_is_named(tmp_path):
    with pytest.raises(InputError, match='column "preferred" is missing'):
        read_validation(write(tmp_path, "P,1,a1,b1,close,close", head="participant,trial,set_a,set_b,class_a,class_b"))
    with pytest.raises(InputError, match="has no rows"):
        read_validation(write(tmp_path))
    with pytest.raises(InputError, match="cannot be read"):
        read_validation(tmp_path / "none.csv")


def test_ranks_are_refused_where_a_label_is_a_number(tmp_path):
    row = "P1,foam,1,1,best,mid,a,3,1,a"
    assert read_validation(write(tmp_path, row), responses=("0", "1", "3"))["class_a"].item() == "3"
    with pytest.raises(InputError, match='class_a is "3"; it must be one of 0, 1, 2, or empty'):
        read_validation(write(tmp_path, row), responses=("0", "1", "2"))


def test_sets_are_read(tmp_path):
    sets = sets_frame(
        write(tmp_path, "best,aggregate,5.58,101,0.001", "i1,individual:P1,4,101,0.001", head=SETS), ["K1"]
    )
    assert sets.at["best", "K1"] == 5.58 and sets.at["i1", "N"] == 101 and sets.at["i1", "T"] == 0.001


@pytest.mark.parametrize(
    ("row", "sentence"),
    [
        (",aggregate,5,101,0.001", ":3: set_id is empty"),
        ("best,aggregate,5,101,0.001", ':3: set_id "best" is there already'),
        ("x,someone,5,101,0.001", ':3: source is "someone"; it must be aggregate, sysid or individual:PARTICIPANT'),
        ("x,individual:,5,101,0.001", ':3: source is "individual:"'),
        ("x,sysid,five,101,0.001", ':3: K1 is "five"; it must be a finite number'),
        ("x,sysid,5,1.5,0.001", ':3: N is "1.5"'),
        ("x,sysid,5,101,0", ':3: T is "0"; it must be a time above 0, in s'),
        ("x,sysid,1_5,101,0.001", ':3: K1 is "1_5"; it must be a finite number'),
        ("x,sysid,5,101", ":3: has 4 cells, the header has 5"),
    ],
)
def test_a_bad_set_is_named(tmp_path, row, sentence):
    with pytest.raises(InputError) as caught:
        sets_frame(write(tmp_path, "best,aggregate,5,101,0.001", row, head=SETS), ["K1"])
    assert f"table.csv{sentence}" in str(caught.value)
    twice = SETS.replace("N", "K1", 1)
    with pytest.raises(InputError, match='column "K1" is there twice'):
        sets_frame(write(tmp_path, "best,aggregate,5,5,0.001", head=twice), ["K1"])
    with pytest.raises(InputError, match='column "B1" is missing'):
        sets_frame(write(tmp_path, "best,aggregate,5,101,0.001", head=SETS), ["K1", "B1"])


def test_sources():
    kinds = [source_kind(text) for text in ("aggregate", "sysid", "individual:P1", "individual:", "best")]
    assert kinds == ["aggregate", "sysid", "individual", None, None]
