"""Trial tables: what is read, in which order, to the last bit; and what is refused, with the line and what to do."""

import re

import numpy as np
import pandas as pd
import pytest

from hilbo.errors import InputError, InputRemark
from hilbo.study.cohort import cohort_of, read_trials
from hilbo.study.config import Study
from hilbo.study.formats import csv_file
from hilbo.study.formats.csv_file import cell_pieces
from hilbo.study.tables.trials import trial_table, write_trials

GP = {"theta": 3.0, "variance": 1.0, "thresholds": [-0.5, 0.5], "noise": 0.5}
HEADER = "participant,trial,response,gain,delay\n"


def study(responses=("different", "similar", "close"), missing=(), **tables):
    gp = GP | {"thresholds": np.linspace(-0.5, 0.5, len(responses) - 1).tolist()}
    parameters = {"gain": {"low": 0.0, "high": 2.0, "unit": "N/mm"}, "delay": {"low": 1.0, "high": 100.0}}
    table = {"name": "any", "responses": list(responses)} | ({"missing": list(missing)} if missing else {})
    return Study.from_dict({"schema": 1, "study": table, "parameters": parameters, "gp": gp} | tables)


def written(tmp_path, text, name="t.csv"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def refusal(tmp_path, text, of=None, **options):
    """The one sentence with which a table is refused, without its folder."""
    with pytest.raises(InputError) as refused:
        read_trials(written(tmp_path, text), of or study(), **options)
    sentence = str(refused.value)
    assert "\n" not in sentence and sentence.endswith(".")
    return sentence.replace(f"{tmp_path}/", "")


NO_TABLES = {
    "t.csv": [
        (HEADER.encode("utf-16"), "is UTF-16 text; save the table as CSV with the encoding UTF-8."),
        ((HEADER + "Zo\xe9,1,close,1,2\n").encode("latin-1"), "is no UTF-8 text; save the table as CSV with"),
        (b"\x89PNG\r\n\x1a\n\x00\xff", "is no UTF-8 text; save the table as CSV with the encoding UTF-8."),
        (b"PK\x03\x04\xff\xff", "is a spreadsheet; save it as CSV, by the spreadsheet's own menu."),
        ((HEADER + '"A,1,close,1,2\n').encode(), "has a quotation mark that nothing closes; remove it, or close it."),
        (
            (HEADER.replace("gain", "Gain ") + "A,1,close,1,2\n").encode(),
            '1: column "gain" is missing (there is "Gain")',
        ),
    ],
    "t.xlsx": [(b"PK\x03\x04", "is a spreadsheet; save it as CSV, by the spreadsheet's own menu.")],
}


@pytest.mark.parametrize(("name", "content", "words"), [(n, *case) for n, cases in NO_TABLES.items() for case in cases])
def test_a_file_that_is_no_table_is_told_what_it_is(tmp_path, name, content, words):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError) as refused:
        read_trials(tmp_path / name, study())
    assert str(refused.value).replace(f"{tmp_path}/", "").removeprefix(f"{name}:").strip().startswith(words)


def test_rows_come_by_participant_and_in_the_order_of_their_trials(tmp_path):
    text = HEADER + "B,2,close,1,2\nA,10,similar,1,3\nB,1,different,1,4\nA,9,close,1,5\n"
    table = read_trials(written(tmp_path, text), study())
    assert table["participant"].tolist() == ["A", "A", "B", "B"]
    assert table["trial"].tolist() == [9, 10, 1, 2]  # as numbers: as text 10 would stand before 9
    assert table["category"].tolist() == [2, 1, 0, 2]


def test_trials_that_count_through_phases_stay_in_their_order(tmp_path):
    """Whatever the phases are called; where each phase begins with 1 one follows the other."""
    through = "phase," + HEADER + "space filling,A,1,close,1,2\nadaptive,A,2,close,1,3\n"
    assert read_trials(written(tmp_path, through), study())["trial"].tolist() == [1, 2]
    anew = through + "adaptive,A,1,close,1,4\n"
    table = read_trials(written(tmp_path, anew), study())
    assert table["phase"].tolist() == ["adaptive", "adaptive", "space filling"] and table["trial"].tolist() == [1, 2, 1]


@pytest.mark.filterwarnings("ignore:.*differ in capitals", "ignore:.*rounded")
@pytest.mark.parametrize("names", [["P2", "P10", "P10b"], ["9", "010", "10", "1e3"], ["Ada", "Ben", "ada"]])
def test_the_order_of_the_rows_makes_no_difference(tmp_path, names):
    phases, trials = ("first", "second"), range(1, 4)
    rows = [f"{p},{n},{t},{'close' if t % 2 else 'similar'},1,{2 + t}\n" for n in names for p in phases for t in trials]
    orders = [np.arange(len(rows)), *(np.random.default_rng(seed).permutation(len(rows)) for seed in range(5))]
    texts = ["phase," + HEADER + "".join(rows[i] for i in order) for order in orders]
    first, *others = (read_trials(written(tmp_path, text), study()).reset_index(drop=True) for text in texts)
    assert list(dict.fromkeys(first["participant"])) == names and first["phase"].tolist()[:4] == ["first"] * 3 + [
        "second"
    ]
    for other in others:
        pd.testing.assert_frame_equal(other, first)


def test_other_columns_are_kept_as_text(tmp_path):
    table = read_trials(written(tmp_path, "note," + HEADER + "007,A,1,close,1,2\n,A,2,close,1,2\n"), study())
    assert table["note"].tolist() == ["007", ""]


@pytest.mark.filterwarnings("ignore:.*differ in capitals")
def test_participants_named_like_missing_values_or_numbers_are_people(tmp_path):
    text = HEADER + "NA,1,close,1,2\n01,1,close,1,2\n1,1,close,1,2\nnull,1,close,1,2\n"
    assert read_trials(written(tmp_path, text), study())["participant"].tolist() == ["01", "1", "NA", "null"]


def test_a_file_of_a_spreadsheet_is_read(tmp_path):
    path = tmp_path / "t.csv"
    path.write_bytes(
        ("\ufeff" + HEADER + 'Z1, 1, close, 1.0, 2\n"A-1",1.0,similar,5e-1,2\n').replace("\n", "\r\n").encode()
    )
    table = read_trials(path, study())
    assert table["participant"].tolist() == ["A-1", "Z1"]
    assert table["gain"].tolist() == [0.5, 1.0]


@pytest.mark.parametrize("name", ["t.csv", "t.parquet"])
def test_numbers_come_back_bit_for_bit(tmp_path, name):
    rng = np.random.default_rng(0)
    table = pd.DataFrame(
        {
            "participant": "A",
            "trial": np.arange(1, 501),
            "response": "close",
            "gain": 2 * rng.uniform(0, 1, 500) ** 9,
            "delay": rng.uniform(1, 100, 500),
        }
    )
    table.loc[0, ["gain", "delay"]] = [5e-324, np.nextafter(100.0, 0.0)]
    write_trials(table, tmp_path / name)
    again = read_trials(tmp_path / name, study())
    assert again["gain"].tolist() == table["gain"].tolist()
    assert again["delay"].tolist() == table["delay"].tolist()


def test_csv_and_parquet_say_the_same(tmp_path):
    text = HEADER + "A,1,close,0.1,2\nA,2,similar,1,100\n"
    read = read_trials(written(tmp_path, text), study())
    typed = pd.read_csv(written(tmp_path, text))
    typed.to_parquet(tmp_path / "t.parquet")
    columns = ["participant", "trial", "category", "gain", "delay"]
    assert read_trials(tmp_path / "t.parquet", study())[columns].to_dict("list") == read[columns].to_dict("list")


def test_warm_up_and_voided_rows_are_left_out(tmp_path):
    text = HEADER.replace("\n", ",phase,voided\n")
    text += "A,1,close,1,2,warm-up,0\nA,1,close,1,2,main,0\nA,2,close,1,2,main,yes\nA,3,close,1,2,main,\n"
    table = read_trials(written(tmp_path, text), study())
    assert table["trial"].tolist() == [1, 3]


def test_sessions_follow_each_other(tmp_path):
    text = "session," + HEADER + "s2,A,1,close,1,2\ns1,A,2,similar,1,2\ns1,A,1,different,1,2\n"
    assert read_trials(written(tmp_path, text), study())["category"].tolist() == [0, 1, 2]


@pytest.mark.parametrize("name", ["", "S", "day "])
def test_numbered_sessions_follow_their_numbers(tmp_path, name):
    text = "session," + HEADER + f"{name}10,A,1,similar,1,2\n{name}9,A,1,different,1,2\n"
    assert read_trials(written(tmp_path, text), study())["category"].tolist() == [0, 1]


def test_ranks_count_from_1(tmp_path):
    table = read_trials(written(tmp_path, HEADER + "A,1,3,1,2\nA,2,1.0,1,2\nA,3,similar,1,2\n"), study())
    assert table["category"].tolist() == [2, 0, 1]


def test_labels_that_read_as_integers_are_labels(tmp_path):
    numbered = study(("3", "2", "1"))  # the lowest answer is called 3
    table = read_trials(written(tmp_path, HEADER + "A,1,3,1,2\nA,2,1,1,2\n"), numbered)
    assert table["category"].tolist() == [0, 2]
    mixed = study(("none", "1", "2"))
    assert 'response is "3"; it must be one of none, 1, 2.' in refusal(tmp_path, HEADER + "A,1,3,1,2\n", of=mixed)


def test_whole_numbers_that_pandas_made_floats_are_labels_and_the_missing_one_is_named(tmp_path):
    likert = study(tuple("1234567"))
    frame = pd.DataFrame({"participant": "A", "trial": [1, 2], "response": [6.0, 7.0], "gain": 1.0, "delay": 2.0})
    assert np.asarray(cohort_of(frame, likert).trials.q)[0, :2].tolist() == [5, 6]
    with pytest.raises(InputError, match=r'row 2: response is ""; it must be one of 1, 2'):
        cohort_of(frame.assign(response=[6.0, np.nan]), likert)
    table = read_trials(written(tmp_path, HEADER + "A,1,3.0,1,2\n"), study(("3", "2", "1")))
    assert table["category"].tolist() == [0]


def test_single_precision_reaches_the_ends_of_a_range():
    """0.3 in single precision is 0.300000012, above the end of a range that ends at 0.3."""
    here = study(parameters={"gain": {"low": 0.1, "high": 0.3}, "delay": {"low": 1.0, "high": 100.0}})
    ends = np.array([0.1, 0.3], np.float32)
    frame = pd.DataFrame({"participant": "A", "trial": [1, 2], "response": "close", "gain": ends, "delay": 2.0})
    assert cohort_of(frame, here).physical[0, :2, 0].tolist() == [0.1, 0.3]


@pytest.mark.parametrize("dtype", ["float32", "Float32", "Float64", "Sparse[float64]", "Sparse[float32]"])
def test_columns_of_any_kind_of_float_are_read(dtype):
    frame = pd.DataFrame({"participant": "A", "trial": [1, 2], "response": "close", "gain": [0.1, 0.3], "delay": 2.0})
    frame["gain"] = frame["gain"].astype(dtype)
    assert cohort_of(frame, study()).physical[0, :2, 0].tolist() == [0.1, 0.3]
    if not dtype.startswith("Sparse"):
        with pytest.raises(InputError, match="row 2: gain is"):
            cohort_of(frame.assign(gain=frame["gain"].where([True, False])), study())


@pytest.mark.parametrize("pair", [("A", "a"), ("1", "01"), ("7", "7.0"), ("P1", "P01")])
def test_ids_that_may_be_one_person_are_two_with_a_warning(tmp_path, pair):
    one, other = pair
    rows = HEADER + f"{one},1,close,1,2\n{other},1,close,1,2\n"
    with pytest.warns(InputRemark, match=f'participants "{one}" and "{other}" differ in capitals, blanks'):
        assert set(read_trials(written(tmp_path, rows), study())["participant"]) == {one, other}


def test_ids_that_a_spreadsheet_rounded_are_named(tmp_path):
    with pytest.warns(InputRemark, match='participant "9.45E12" looks like a number rounded by a spreadsheet'):
        read_trials(written(tmp_path, HEADER + "9.45E12,1,close,1,2\nE12,1,close,1,2\n"), study())


@pytest.mark.parametrize("labels", [("1.0", "1.5", "2.0"), ("0,0", "1,0", "2,0"), ("+1", "2e0", "three")])
def test_labels_that_read_as_any_number_are_labels(tmp_path, labels):
    table = pd.DataFrame({"participant": "A", "trial": [1, 2, 3], "response": labels, "gain": 1.0, "delay": 2.0})
    table.to_csv(tmp_path / "t.csv", index=False)
    assert read_trials(tmp_path / "t.csv", study(labels))["category"].tolist() == [0, 1, 2]
    assert "must be one of" in refusal(tmp_path, HEADER + "A,1,3,1,2\n", of=study(labels))


@pytest.mark.parametrize("phase", ["Warm-up", "warm up ", "WARMUP", "warm_up", "Repeat"])
def test_a_warm_up_is_one_however_it_is_written(tmp_path, phase):
    text = HEADER.replace("\n", ",phase\n") + f"A,1,close,1,2,{phase}\nA,2,close,1,2,main\n"
    assert read_trials(written(tmp_path, text), study())["trial"].tolist() == [2]


@pytest.mark.parametrize("trial", ["1e300", "9007199254740993"])
def test_a_number_of_a_trial_is_one_that_is_kept(tmp_path, trial):
    assert "it must be a whole number from 1" in refusal(tmp_path, HEADER + f"A,{trial},close,1,2\n")


@pytest.mark.parametrize("category", [[2, 0, 0], [5, 9, 0], [0.5, 0.0, 1.0]])
def test_a_column_of_one_s_own_called_category_is_no_answer(category):
    frame = pd.DataFrame({"participant": "A", "trial": [1, 2, 3], "gain": 1.0, "delay": 2.0, "category": category})
    frame["response"] = ["different", "close", "similar"]
    cohort = cohort_of(frame, study())
    assert np.asarray(cohort.trials.q)[0, :3].tolist() == [0, 2, 1]
    with pytest.raises(InputError, match='column "participant" is missing'):
        cohort_of(frame.drop(columns="participant"), study())


@pytest.mark.parametrize("column", [{"voided": [1, 0, 0]}, {"phase": ["Warm-up", "main", "main"]}])
def test_a_frame_with_right_categories_is_still_checked(column):
    frame = pd.DataFrame({"participant": "A", "trial": [1, 2, 3], "gain": 1.0, "delay": 2.0, "category": [0, 2, 1]})
    frame["response"] = ["different", "close", "similar"]
    assert cohort_of(frame.assign(**column), study()).counts().tolist() == [2]


def test_nobody_is_chosen_twice(tmp_path):
    cohort = cohort_of(read_trials(written(tmp_path, HEADER + "A,1,close,1,2\nB,1,close,1,2\n"), study()), study())
    assert cohort.of(["B"]).names == ("B",)
    with pytest.raises(InputError, match='participant "A" is named twice'):
        cohort.of(["A", "B", "A"])


def test_rows_of_other_materials_have_ranges_of_their_own(tmp_path):
    text = "material," + HEADER + "foam,A,1,close,1,2\ngel,A,1,close,7,2\n"
    assert read_trials(written(tmp_path, text), study(), "foam")["gain"].tolist() == [1.0]
    assert 'gain is "7"' in refusal(tmp_path, text, material="gel")


def test_one_material_is_chosen(tmp_path):
    text = "material," + HEADER + "foam,A,1,close,1,2\ngel,A,1,different,1,2\n"
    assert read_trials(written(tmp_path, text), study(), "gel")["category"].tolist() == [0]
    assert "2 materials (foam, gel); choose" in refusal(tmp_path, text)
    assert 'contains no material "silk"; it has foam, gel' in refusal(tmp_path, text, material="silk")
    assert 'column "material" is missing' in refusal(tmp_path, HEADER + "A,1,close,1,2\n", material="gel")


BAD = {
    "unknown response": (
        "A,1,superb,1,2",
        't.csv:2: response is "superb"; it must be one of different, similar, close',
    ),
    "rank 0": ("A,1,0,1,2", "or a rank from 1 to 3"),
    "rank between": ("A,1,1.5,1,2", 'response is "1.5"'),
    "other case": ("A,1,Close,1,2", 'response is "Close"'),
    "no response": ("A,1,,1,2", 'response is ""'),
    "NaN": ("A,1,close,nan,2", 't.csv:2: gain is "nan"; it must be a number from 0 to 2 N/mm'),
    "infinite": ("A,1,close,inf,2", 'gain is "inf"'),
    "no number": ("A,1,close,,2", 'gain is ""'),
    "text": ("A,1,close,high,2", 'gain is "high"'),
    "decimal comma": ('A,1,close,"1,5",2', 'gain is "1,5"'),
    "below": ("A,1,close,1,0.99", 't.csv:2: delay is "0.99"; it must be a number from 1 to 100'),
    "above": ("A,1,close,2.0000000000000004,2", 'gain is "2.0000000000000004"'),
    "trial 0": ("A,0,close,1,2", 't.csv:2: trial is "0"; it must be a whole number from 1'),
    "half a trial": ("A,1.5,close,1,2", 'trial is "1.5"'),
    "no participant": (",1,close,1,2", "t.csv:2: participant is empty"),
    "second line": ("A,1,close,1,2\nA,2,near,1,2", 't.csv:3: response is "near"'),
    "twice": (
        "A,1,close,1,2\nB,1,close,1,2\nA,1,similar,1,3",
        "t.csv:4: participant A, trial 1 is in line 2 already",
    ),
    "twice, spelt otherwise": ("A,1,close,1,2\nA,1.0,similar,1,3", "t.csv:3: participant A, trial 1 is in line 2"),
    "underscore": ("A,1,close,1_5,2", 'gain is "1_5"'),
    "one cell more": ("A,1,close,1,2,3", "t.csv:2: has 6 cells, the header has 5; fix that line"),
    "one cell less": ("A,1,close,1,2\nA,2,close,1", "t.csv:3: has 4 cells, the header has 5"),
    "an open quote": ('A,1,close,1,"2', "t.csv: has a quotation mark that nothing closes"),
}


@pytest.mark.parametrize("what", BAD)
def test_a_bad_row_is_refused_in_one_sentence(tmp_path, what):
    rows, words = BAD[what]
    assert words in refusal(tmp_path, HEADER + rows + "\n")


def test_a_bad_line_counts_from_the_top_of_the_file_past_blank_ones_and_long_cells(tmp_path):
    text = "note," + HEADER + '"two\nlines",A,1,close,1,2\n\nx,A,2,near,1,2\n'
    assert 't.csv:5: response is "near"' in refusal(tmp_path, text)


@pytest.mark.parametrize("missing", ["participant", "trial", "response", "gain", "delay"])
def test_a_missing_column_is_named(tmp_path, missing):
    text = HEADER.replace(missing, "other") + "A,1,close,1,2\n"
    assert f't.csv:1: column "{missing}" is missing' in refusal(tmp_path, text)


def test_a_column_twice_is_refused(tmp_path):
    assert 't.csv:1: column "gain" is there twice' in refusal(
        tmp_path, HEADER.replace("\n", ",gain\n") + "A,1,close,1,2,1\n"
    )


def test_rows_of_commas_are_nobodys(tmp_path):
    assert len(read_trials(written(tmp_path, HEADER + ",,,,\nA,1,close,1,2\n\n,,,,\n"), study())) == 1


def test_warm_up_alone_is_refused(tmp_path):
    text = HEADER.replace("\n", ",phase\n") + "A,1,close,1,2,warm-up\n"
    assert "no rows to fit" in refusal(tmp_path, text)


def test_who_has_no_answer_that_counts_is_named(tmp_path):
    """And nobody is where everybody has one."""
    text = HEADER.replace("\n", ",phase,voided\n") + "A,1,close,1,2,main,0\nA,2,close,1,2,main,1\n"
    assert len(read_trials(written(tmp_path, text), study())) == 1
    text += "B,1,close,1,2,main,1\nC,1,close,1,2,warm-up,0\nC,1,close,1,2,repeat,0\n"
    with pytest.warns(InputRemark) as remarks:
        table = read_trials(written(tmp_path, text), study())
    (said,) = (str(remark.message).replace(f"{tmp_path}/", "") for remark in remarks)
    assert said.startswith(
        "t.csv: 4 answers are voided, warm-up or repeated, and not fitted; B, C have no other answer"
    )
    assert set(table["participant"]) == {"A"}
    text += "".join(f"Z{i},1,close,1,2,main,1\n" for i in range(7))
    with pytest.warns(InputRemark, match=r"11 answers .*; B, C, Z0, Z1, Z2, Z3 and 3 more have no other answer"):
        read_trials(written(tmp_path, text), study())


def test_a_voided_flag_is_yes_or_no(tmp_path):
    text = HEADER.replace("\n", ",voided\n") + "A,1,close,1,2,maybe\n"
    assert 't.csv:2: voided is "maybe"; write 1 or 0' in refusal(tmp_path, text)


def test_unblinded_answers_are_not_read_beside_others(tmp_path):
    head = HEADER.replace("\n", ",unblinded,voided\n")
    text = head + "A,1,close,1,2,,0\nB,1,close,1,2,try,0\n"
    assert refusal(tmp_path, text, others=False).startswith("t.csv:3: is an unblinded response, as of hilbo try, among")
    for kept in (head + "B,1,close,1,2,try,0\nB,2,close,1,2,try,0\n", text.replace("try,0", "try,1")):
        assert len(read_trials(written(tmp_path, kept), study(), note=str)) == kept.count(",0\n")
    assert len(read_trials(written(tmp_path, text), study(stimulus={"unblinded": True}))) == 2


@pytest.mark.parametrize(("text", "words"), [("", "is empty"), (HEADER, "has no rows")])
def test_an_empty_table_is_refused(tmp_path, text, words):
    assert words in refusal(tmp_path, text)


def test_what_cannot_be_read_is_refused(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        read_trials(tmp_path / "nowhere.csv", study())
    with pytest.raises(InputError, match="cannot be read"):
        read_trials(tmp_path, study())
    (tmp_path / "t.parquet").write_bytes(b"no parquet")
    with pytest.raises(InputError, match=r"t\.parquet: is not a table"):
        read_trials(tmp_path / "t.parquet", study())
    (tmp_path / "latin.csv").write_bytes(HEADER.encode() + "Zoë,1,close,1,2\n".encode("latin-1"))
    with pytest.raises(InputError, match=r"latin\.csv: is no UTF-8 text"):
        read_trials(tmp_path / "latin.csv", study())


def many(count):
    return "".join(f"P{i // 5},{i % 5 + 1},close,1,{2 + i % 7}\n" for i in range(count))


@pytest.mark.parametrize("name", ["t.csv", "t.parquet"])
def test_pieces_make_the_same_table(tmp_path, monkeypatch, name):
    path = written(tmp_path, HEADER + many(53), name)
    if name.endswith("parquet"):
        pd.read_csv(written(tmp_path, HEADER + many(53))).to_parquet(path)
    whole, told = read_trials(path, study()), []
    monkeypatch.setattr(csv_file, "_PIECE", 10)
    pd.testing.assert_frame_equal(read_trials(path, study(), say=told.append), whole)
    assert told[-1] == 53 and told == sorted(told) and len(told) > 4


def test_a_damaged_row_far_down_is_found_with_its_line(tmp_path, monkeypatch):
    monkeypatch.setattr(csv_file, "_PIECE", 10)
    text = HEADER + many(53)
    assert 't.csv:41: response is "near"' in refusal(tmp_path, text.replace("P7,5,close", "P7,5,near"))
    assert "t.csv:41: has 4 cells" in refusal(tmp_path, text.replace("P7,5,close,1", "P7,5,close"))
    again = refusal(tmp_path, text.replace("P9,1,", "P0,2,"))  # two pieces apart
    assert "t.csv:47: participant P0, trial 2 is in line 3 already" in again


def test_other_columns_may_be_left_out(tmp_path):
    table = read_trials(written(tmp_path, "note," + HEADER + "007,A,1,close,1,2\n"), study(), others=False)
    assert set(table.columns) == {"participant", "trial", "gain", "delay", "category"}


def test_a_parquet_file_has_rows_and_no_lines(tmp_path):
    good = pd.read_csv(written(tmp_path, HEADER + many(20)))

    def refused(frame):
        frame.to_parquet(tmp_path / "t.parquet")
        with pytest.raises(InputError) as error:
            read_trials(tmp_path / "t.parquet", study())
        return str(error.value)

    assert 't.parquet: row 7: gain is "9.0"; it must be' in refused(good.assign(gain=[1.0] * 6 + [9.0] * 14))
    twice = refused(pd.concat([good, good.iloc[[3]]]))
    assert "t.parquet: row 21: participant P0, trial 4 is in row 4 already" in twice
    assert 't.parquet: column "gain" is missing' in refused(good.drop(columns="gain"))
    mixed = good.astype({"gain": object})
    mixed.loc[2, "gain"] = None
    assert 't.parquet: row 3: gain is ""' in refused(mixed).replace('"nan"', '""')


def test_a_table_with_semicolons_has_decimal_commas_and_it_is_said(tmp_path):
    text = HEADER.replace(",", ";").replace("\n", ";note\n") + "A;1;close;1,25;2,5;so, so\nA;2;similar;0;1e2;3,4\n"
    with pytest.warns(InputRemark, match=r"t\.csv: is read with semicolons between its cells; 1,5 is one") as remarks:
        table = read_trials(written(tmp_path, text), study())
    assert remarks[0].filename == __file__  # the user's own line
    assert table[["gain", "delay"]].to_numpy().tolist() == [[1.25, 2.5], [0.0, 100.0]]
    assert table["note"].tolist() == ["so, so", "3,4"]  # other columns are as they are


def test_tabs_and_decimal_points_are_read_too(tmp_path):
    text = HEADER.replace(",", "\t") + "A\t1\tclose\t1.25\t2.5\n"
    with pytest.warns(InputRemark, match="with tabs"):
        assert read_trials(written(tmp_path, text), study())["gain"].tolist() == [1.25]


@pytest.mark.filterwarnings("ignore::hilbo.errors.InputRemark")
@pytest.mark.parametrize(
    ("cells", "words"),
    [
        ("1,25;2\nA;2;close;1.5;2", r't.csv:3: gain has decimal commas and decimal points \("1,25" and "1.5"\); write'),
        ("1.250,5;2", "gain is .*; it must be a number"),
        ("1,2,3;2", "gain is .*; it must be a number"),
    ],
)
def test_numbers_written_in_two_ways_are_refused(tmp_path, cells, words):
    with pytest.raises(InputError, match=words):
        read_trials(written(tmp_path, HEADER.replace(",", ";") + f"A;1;close;{cells}\n"), study())


@pytest.mark.filterwarnings("ignore::hilbo.errors.InputRemark")
def test_every_number_of_a_table_may_have_a_decimal_comma(tmp_path):
    text = "voided;note;" + HEADER.replace(",", ";") + '0,0; "-0,5";A;1,0;3,0;1,5;2\n1,0;-3;A;2;close;1;2\n'
    table = read_trials(written(tmp_path, text), study())
    assert table["note"].tolist() == ["-0,5"] and table["trial"].tolist() == [1] and table["category"].tolist() == [2]


def test_what_is_quoted_in_the_header_parts_no_cells(tmp_path):
    text = '"note (a; b; c; d; e; f)",' + HEADER + "x,A,1,close,1.5,2\n"
    assert read_trials(written(tmp_path, text), study())["gain"].tolist() == [1.5]


def test_a_line_that_only_spreadsheets_read_is_named(tmp_path):
    sentence = refusal(tmp_path, "sep=;\n" + HEADER + "A,1,close,1,2\n")
    assert sentence == 't.csv:1: is "sep=;", which only spreadsheets read; delete that line.'


def test_a_decimal_comma_in_a_table_with_commas_gets_a_hint(tmp_path):
    assert refusal(tmp_path, HEADER + 'A,1,close,"1,5",2\n').endswith("; write 1.5 for one and a half.")


@pytest.mark.filterwarnings("ignore::hilbo.errors.InputRemark")
def test_labels_with_commas_stay_labels_where_commas_are_decimal(tmp_path):
    text = HEADER.replace(",", ";") + "A;1;0,5;1;2\nA;2;1.5;1;2\n"
    table = read_trials(written(tmp_path, text), study(("0,5", "1.5", "2")))
    assert table["category"].tolist() == [0, 1]


EDITS = {
    "other units": (lambda t: t.assign(gain=t["gain"] * 1000), 'gain is "1000.0"'),
    "twice the same": (lambda t: pd.concat([t, t]), "row 4: participant A, trial 1 is in row 1 already"),
    "two materials": (lambda t: t.assign(material=["foam", "foam", "gel"]), "contains 2 materials (foam, gel)"),
    "a number that is missing": (lambda t: t.assign(gain=[1.0, np.nan, 1.0]), 'gain is ""'),
    "a participant who is missing": (lambda t: t.assign(participant=["A", None, "B"]), "participant is empty"),
    "cells that are lists": (lambda t: t.assign(session=[[1], [2], [3]], gain=9.0), 'gain is "9.0"'),
}


@pytest.mark.parametrize("edit", EDITS)
def test_a_table_that_was_read_and_then_changed_is_checked_again(tmp_path, edit):
    table = read_trials(written(tmp_path, HEADER + "A,1,close,1,2\nA,2,similar,1,2\nB,1,different,1,2\n"), study())
    change, words = EDITS[edit]
    with pytest.raises(InputError, match=re.escape(words)):
        cohort_of(change(table), study())


def test_a_category_that_was_recoded_without_its_response_is_refused(tmp_path):
    table = read_trials(written(tmp_path, HEADER + "A,1,close,1,2\nA,2,similar,1,2\n"), study())
    with pytest.raises(InputError, match='category is 0, but response "similar" is category 1; change the response'):
        cohort_of(table.assign(category=[2, 0]), study())
    both = table.assign(category=[2, 0], response=["close", "different"])
    for recoded in (both, both.astype({"category": float}), both.drop(columns="category")):
        assert np.asarray(cohort_of(recoded, study()).trials.q)[0, :2].tolist() == [2, 0]


def test_rows_that_were_read_and_then_turned_round_come_in_order_again(tmp_path):
    table = read_trials(written(tmp_path, HEADER + "A,1,close,1,2\nA,2,similar,1,2\nB,1,different,1,2\n"), study())
    whole, turned = cohort_of(table, study()), cohort_of(table[::-1], study())
    assert whole.names == turned.names == ("A", "B")
    np.testing.assert_array_equal(turned.trials.q, whole.trials.q)
    assert cohort_of(table[table["participant"] == "B"], study()).names == ("B",)


def test_names_of_columns_may_be_numbers_and_cells_numpy_s():
    frame = pd.DataFrame({"participant": "A", "trial": [1, 2], "response": "close", "delay": 2.0, 5: "x"})
    frame["gain"] = pd.Series([np.float64(1.25), np.float64(2.0)], dtype=object)
    assert cohort_of(frame, study()).physical[0, :2, 0].tolist() == [1.25, 2.0]


def test_categories_alone_are_answers_and_are_checked():
    frame = pd.DataFrame({"participant": "A", "trial": [2, 1], "gain": 1.0, "delay": 2.0, "category": [2, 0]})
    assert np.asarray(cohort_of(frame, study()).trials.q)[0, :2].tolist() == [0, 2]
    mistakes = (({"gain": 9.0}, 'gain is "9.0"'), ({"category": [3, 0]}, 'column "response" is missing'))
    for wrong, words in mistakes:
        with pytest.raises(InputError, match=re.escape(words)):
            cohort_of(frame.assign(**wrong), study())


MISSING = ("NA", "-1", "don't know", "")


def test_missing_responses_are_counted_and_not_fitted(tmp_path):
    """By label and participant, in any phase that would be fitted; without the key they are refused."""
    of = study(missing=MISSING)
    rows = [("A", "close"), ("A", " NA "), ("A", "similar"), ("B", "-1"), ("B", "close"), ("B", "NA"), ("B", "")]
    lines = "".join(f"{name},{i},{cell},1,2\n" for i, (name, cell) in enumerate(rows, 1))
    path = written(tmp_path, HEADER + lines)
    with pytest.warns(InputRemark, match=r'4 of 7 responses are missing \("NA" 2, "-1" 1, "" 1\) and not fitted'):
        table = trial_table(cell_pieces(path), of.file, source="t.csv")
    assert table.rows["response"].tolist() == ["close", "similar", "close"] and (table.rows["category"] >= 0).all()
    assert table.missing.content() == {
        "labels": {"NA": 2, "-1": 1, "": 1},
        "participants": {"A": 1, "B": 3},
        "rows": 7,
    }
    assert 'response is "NA"' in refusal(tmp_path, HEADER + "A,1,NA,1,2\n")
    assert "all are warm-up, repeated or voided, or missing" in refusal(tmp_path, HEADER + "A,1,NA,1,2\n", of=of)


def test_a_response_is_not_missing():
    with pytest.raises(InputError, match=r'study\.missing has "Close ", which is a response too'):
        study(missing=("Close ",))
