"""One reader of CSV files: what one table refuses, every table refuses in the same words; what one takes, all take."""

import pandas as pd
import pytest
from live import STUDY

from hilbo.errors import InputError
from hilbo.identification.material_tables import read_material
from hilbo.session.plan.participants import read_people
from hilbo.session.withdrawal.withdrawal import delete_participant
from hilbo.study.cohort import read_trials
from hilbo.study.tables.parameter_sets import read_sets
from hilbo.study.tables.validation import read_validation

TABLES = {
    "trials": (
        lambda path: read_trials(path, STUDY)["u"].tolist(),
        "participant,trial,response,u,v,note",
        ["P1,1,close,0.25,0.5,good", "P1,2,close,0.5,0.5,"],
        [0.25, 0.5],
    ),
    "validation": (
        lambda path: read_validation(path)["preferred"].tolist(),
        "participant,trial,set_a,set_b,class_a,class_b,preferred,note",
        ["P1,1,best,mid,,,a,good", "P1,2,best,mid,,,b,"],
        ["best", "mid"],
    ),
    "sets": (lambda path: list(read_sets(path, ("u",))), "set_id,u,note", ["best,0.5,good", "mid,1,"], ["best", "mid"]),
    "people": (
        lambda path: list(read_people(path)),
        "participant,consent_time,protocol_number,note",
        ["P1,2026-05-04,7,good", "P2,2026-05-04,7,"],
        ["P1", "P2"],
    ),
    "material": (
        lambda path: read_material(path).tests[0].output.tolist(),
        "time_s,position_mm,force_N,test,note",
        ["0,1,1,relaxation,good", *(f"{k},1,0.5,relaxation," for k in range(1, 8))],
        [[1.0, *[0.5] * 7]],
    ),
}
REFUSED = {
    "utf-16": (lambda text: text.encode("utf-16"), "{path}: is UTF-16 text; save the table as CSV with the encoding"),
    "latin-1": (
        lambda text: text.replace("good", "é").encode("latin-1"),
        "{path}: is no UTF-8 text; save the",
    ),
    "an open quote": (lambda text: f'{text}"x'.encode(), "{path}: has a quotation mark that nothing closes"),
    "a spreadsheet": (lambda text: b"PK\x03\x04\xff", "{path}: is a spreadsheet; save it as CSV, by"),
    "a spreadsheet's first line": (lambda text: b"sep=;\n" + text.encode(), '{path}:1: is "sep=;", which only'),
    "nothing": (lambda text: b"\n\n", "{path}: is empty; "),
    "a column twice": (
        lambda text: text.replace("note", "more,more ").encode(),
        '{path}:1: column "more" is',
    ),
    "a long row": (
        lambda text: text.replace(",good", ',"a\nb",,').encode(),
        "{path}:2: has {longer} cells, the",
    ),
}
TAKEN = {("material", case) for case in ("utf-16", "latin-1", "a spreadsheet's first line")}  # instruments write these
ACCEPTED = {
    "as it is": lambda text: text.encode(),
    "semicolons and a mark of the byte order": lambda text: text.replace(",", ";").encode("utf-8-sig"),
    "tabs": lambda text: text.replace(",", "\t").encode(),
    "blanks": lambda text: text.replace(",", ", ").replace("note", "note ").encode(),
    "empty lines and rows": lambda text: f"\n{text.replace(chr(10), chr(10) * 2)},,,\n".encode(),
    "line ends of Windows": lambda text: text.replace("\n", "\r\n").encode(),
}


@pytest.mark.parametrize("table", TABLES)
@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_table_is_refused_by_all_readers_in_the_same_words(tmp_path, table, case):
    read, header, rows, values = TABLES[table]
    path, (broken, sentence) = tmp_path / "t.csv", REFUSED[case]
    path.write_bytes(broken("\n".join([header, *rows, ""])))
    if (table, case) in TAKEN:
        assert read(path) == values
        return
    with pytest.raises(InputError) as refused:
        read(path)
    assert str(refused.value).startswith(sentence.format(path=path, longer=header.count(",") + 3))


@pytest.mark.filterwarnings("ignore::hilbo.errors.InputRemark")
@pytest.mark.parametrize("table", TABLES)
@pytest.mark.parametrize("case", ACCEPTED)
def test_what_spreadsheets_write_is_taken_by_all_readers(tmp_path, table, case):
    read, header, rows, values = TABLES[table]
    path = tmp_path / "t.csv"
    path.write_bytes(ACCEPTED[case]("\n".join([header, *rows, ""])))
    assert read(path) == values


def test_a_withdrawal_finds_the_rows_of_every_table_that_is_taken(tmp_path):
    path = tmp_path / "trials.csv"
    path.write_text("\n,,\nparticipant,trial,response\nP1,1,close\nP2,1,close\n")
    delete_participant(tmp_path, "P1")
    assert path.read_text() == "participant,trial,response\nP2,1,close\n"


def wide(path, columns):
    names = ["participant", "trial", "response", "u", "v", *(f"c{i}" for i in range(columns))]
    row = ["P01", "1", "close", "0.5", "0.5", *("x" for _ in range(columns))]
    path.write_text(f"{','.join(names)}\n{','.join(row)}\n")
    return path


def test_more_columns_than_a_spreadsheet_has_are_refused(tmp_path):
    with pytest.raises(InputError, match=":1: has 100005 columns; a table has 16384 at most, leave out unneeded"):
        read_trials(wide(tmp_path / "wide.csv", 100_000), STUDY)


def test_a_table_of_many_columns_is_made_at_once(tmp_path, monkeypatch):
    """A column that is added to a frame costs as much as there are columns: 3,000 of them took half a minute."""
    whole, put = pd.DataFrame.__setitem__, []
    monkeypatch.setattr(pd.DataFrame, "__setitem__", lambda *given: (put.append(given[1]), whole(*given)))
    counts = []
    for columns in (5, 50):
        read_trials(wide(tmp_path / "wide.csv", columns), STUDY)
        counts.append(len(put))
        put.clear()
    assert counts[0] == counts[1]


@pytest.mark.parametrize("count", ["0", "2.5", "-1", "9" * 400])
def test_a_number_of_taps_is_a_whole_number_of_at_most_nine_digits(tmp_path, count):
    path = tmp_path / "sets.csv"
    path.write_text(f"set_id,u,N\nbest,0.5,{count}\n")
    with pytest.raises(InputError, match=f'sets.csv:2: N is "{count}"; it must be a whole number'):
        read_sets(path, ("u",))
