"""`hilbo import` of tables in which a cell, a name or a mapping could mean two things: it is asked, refused or said."""

import tomllib
from pathlib import Path

import exported
import pytest

from hilbo.errors import InputError
from hilbo.study.file.reading import checked
from hilbo.study.importing.export import OpenMappingError, import_files
from hilbo.study.importing.mapping import Mapping, mapping_of

HEAD = {"participant": "participant", "trial": "trial", "response": "response"}
LEVELS = {"scent": {"levels": ["none", "rose", "mint"]}}


def study_of(parameters, **tables):
    """A study with these parameters."""
    raw = tomllib.loads(exported.STUDY) | {"parameters": parameters} | tables
    return checked(raw, "", lambda file: file)


SIGNED = study_of({"tilt": {"low": -30.0, "high": 30.0}})
SIGNED_2 = study_of({"hue": {"low": -30.0, "high": 30.0}, "light": {"low": 20.0, "high": 80.0}})
SCENT = study_of(LEVELS)


def csv(folder, text, name="export.csv"):
    """A file of this text."""
    (folder / name).write_text(text, encoding="utf-8")
    return folder / name


def imported(paths, study, mapping=None):
    """The import, and what it says."""
    notes = []
    paths = [paths] if isinstance(paths, Path) else paths
    made, used = import_files(paths, study, mapping, note=notes.append)
    return made, used, " ".join([*notes, *made.sentences])


def test_values_that_look_like_missing_marks_are_values(tmp_path):
    table = "participant,trial,response,tilt\nA,1,close,-1\nA,2,close,2\nA,3,similar,-9\nA,4,similar,-99e-1\n"
    made, _, _ = imported(csv(tmp_path, table), SIGNED)
    assert list(made.table["tilt"]) == ["-1", "2", "-9", "-99e-1"]


def test_levels_that_look_like_missing_marks_are_levels(tmp_path):
    table = "participant,trial,response,scent\nA,1,close,none\nA,2,close,Mint\nA,3,similar,None\nA,4,,\n"
    made, _, _ = imported(csv(tmp_path, table), SCENT)
    assert list(made.table["scent"]) == ["none", "mint", "none"]


def test_a_sign_in_a_name_is_read_or_asked(tmp_path):
    table = "participant,hue=-10_light=30,hue=-20_light=40,hue=10_light=30\nA,close,similar,different\n"
    made, _, _ = imported(csv(tmp_path, table), SIGNED_2)
    assert list(made.table["hue"]) == ["-10", "-20", "10"] and list(made.table["light"]) == ["30", "40", "30"]
    with pytest.raises(OpenMappingError):
        imported(csv(tmp_path, table.replace("=", "")), SIGNED_2)


@pytest.mark.parametrize("stem", ["5f1e9c0b2d3a4f5e6a7b8c9d", "anna.muster_2026", "anna@example.org"])
def test_ids_from_names_of_files_are_replaced(tmp_path, stem):
    text = "trial,response,tilt\n1,close,3\n2,similar,4\n"
    made, _, _ = imported([csv(tmp_path, text, f"{stem}.csv"), csv(tmp_path, text, "P7.csv")], SIGNED)
    assert set(made.table["participant"]) == {"P001", "P002"} and made.ids[stem] == "P001"
    assert stem not in made.table.to_csv() + str(made.record)


def test_a_mapping_without_ids_replaces_those_of_a_platform(tmp_path):
    table = "participant,trial,response,tilt\n5f1e9c0b2d3a4f5e6a7b8c9d,1,close,3\n"
    columns = HEAD | {"tilt": "tilt"}
    assert list(imported(csv(tmp_path, table), SIGNED, Mapping(columns))[0].table["participant"]) == ["P001"]
    written = imported(csv(tmp_path, table), SIGNED, Mapping(columns, ids="as written"))[0]
    assert written.table["participant"][0].startswith("5f1e")


def test_parameters_of_stimuli_are_not_guessed(tmp_path):
    path = csv(tmp_path, "participant,response,stimulus\nA,close,a\nA,similar,b\n")
    with pytest.raises(OpenMappingError) as asked:
        imported(path, SCENT)
    assert asked.value.mapping.stimuli == {"a": {"scent": ""}, "b": {"scent": ""}}
    with pytest.raises(InputError, match='stimulus "a" has no scent'):
        imported(path, SCENT, asked.value.mapping)


def test_a_stated_missing_mark_wins_over_a_rank(tmp_path):
    path = csv(tmp_path, "participant,trial,response,tilt\nA,1,1,3\nA,2,2,4\nA,3,3,5\nA,4,4,6\n")
    meant = {"2": "different", "3": "similar", "4": "close"}
    made, _, said = imported(path, SIGNED, Mapping(HEAD | {"tilt": "tilt"}, missing=("1",), responses=meant))
    assert list(made.table["response"]) == ["different", "similar", "close"] and "missing responses" in said
    with pytest.raises(InputError, match='response is "1"; write in'):
        imported(path, SIGNED, Mapping(HEAD | {"tilt": "tilt"}, responses=meant))


def test_ranks_of_a_program_that_counts_from_0_are_asked_without_a_0(tmp_path):
    head = "participant,trial_type,trial_index,time_elapsed,response,tilt\n"
    rows = "".join(f"A,x,{i},9,{1 + i % 2},{i}\n" for i in range(4))
    with pytest.raises(OpenMappingError, match='response "1", "2" may count from 0 or from 1') as asked:
        imported(csv(tmp_path, head + rows), SIGNED)
    assert asked.value.mapping.responses == {"1": "", "2": ""}


def test_a_missing_label_of_the_study_is_kept_also_as_a_float(tmp_path):
    raw = tomllib.loads(exported.STUDY)
    study = study_of({"tilt": {"low": -30.0, "high": 30.0}}, study=raw["study"] | {"missing": ["-1"]})
    made, _, _ = imported(csv(tmp_path, "participant,trial,response,tilt\nA,1,close,3\nA,2,-1.0,4\n"), study)
    assert list(made.table["response"]) == ["close", "-1"]


def test_another_unit_in_a_header_is_asked(tmp_path):
    table = "participant,trial,response,Hue (rad),Light [%]\nA,1,close,3,40\n"
    with pytest.raises(OpenMappingError, match="no column is recognised as the parameter hue"):
        imported(csv(tmp_path, table), exported.study())


def test_a_dotted_name_is_what_its_last_part_says(tmp_path):
    records = '[{"participant": {"age": 31, "id": "P01"}, "response": "close", "tilt": 3}]'
    made, _, said = imported(csv(tmp_path, records, "export.json"), SIGNED)
    assert list(made.table["participant"]) == ["P01"] and "participant.age" in said


MISTAKES = {
    "header_rows = 0": "header_rows",
    'keep = ["response"]': 'keep has "response", which is a column of the trial table itself',
    "factors = {titl = 2}": "factors.titl is no parameter with numbers",
    "factors = {tilt = 0}": "factors.tilt is 0; it must be a number above 0",
    'levels = {tilt = {a = "b"}}': 'levels.tilt."a" is no level',
    "stimuli = {a = {tlit = 1}}": 'stimuli."a".tlit is no parameter',
    'responses = {x = "nearly"}': 'responses."x" is "nearly", which is no response',
    'columns = {participant = "participant", response = "response", tilt = "{file}"}': "only the participant may be",
    'columns = {participant = "participant", response = "resp{foo}", tilt = "tilt"}': '"{foo}", which is neither',
}


@pytest.mark.parametrize("line", MISTAKES)
def test_a_mistake_in_a_mapping_is_said(tmp_path, line):
    path = csv(tmp_path, "participant,response,tilt\nA,close,3\n")
    columns = 'columns = {participant = "participant", response = "response", tilt = "tilt"}\n'
    with pytest.raises(InputError) as refused:
        imported(path, SIGNED, mapping_of(tomllib.loads(line if line.startswith("columns") else columns + line), "m"))
    assert MISTAKES[line] in str(refused.value)


def test_a_factor_takes_numbers_only(tmp_path):
    path = csv(tmp_path, "participant,response,tilt\nA,close,3_0\n")
    columns = {"participant": "participant", "response": "response", "tilt": "tilt"}
    with pytest.raises(InputError, match='tilt is "3_0"; it must be a number'):
        imported(path, SIGNED, Mapping(columns, factors={"tilt": 0.5}))


def test_materials_are_needed_and_known(tmp_path):
    tilt = {"tilt": {"low": -30.0, "high": 30.0}}
    study = study_of(tilt, materials={name: {"parameters": tilt} for name in ("silk", "wood")})
    head = "participant,trial,response,tilt"
    with pytest.raises(InputError, match=r"columns\.material is missing"):
        imported(csv(tmp_path, f"{head}\nA,1,close,3\n"), study)
    with pytest.raises(InputError, match=r'export\.csv:3: material is "slik"; it must be one of silk, wood'):
        imported(csv(tmp_path, f"{head},material\nA,1,close,3,silk\nA,2,close,3,slik\n"), study)
    with pytest.raises(InputError, match=r"export\.csv:2: tilt is"):
        imported(csv(tmp_path, f"{head},material\nA,1,close,400,silk\n"), study)
    assert len(imported(csv(tmp_path, f"{head},material\nA,1,close,3,silk\n"), study)[0].table) == 1


def test_ids_that_may_be_one_participants_are_said_before_they_are_replaced(tmp_path):
    table = "participant,trial,response,tilt\nAnna@example.org,1,close,3\nanna@example.org,1,close,3\n"
    made, _, said = imported(csv(tmp_path, table), SIGNED)
    assert made.table["participant"].nunique() == 2 and "differ in capitals" in said


@pytest.mark.parametrize("extra", ["x,x (2),x", "response {1}", "a{1}b"])
def test_odd_names_of_columns_are_read(tmp_path, extra):
    count = extra.count(",") + 1
    table = f"participant,trial,response,tilt,{extra}\nA,1,close,3{',0' * count}\n"
    assert len(imported(csv(tmp_path, table), SIGNED)[0].table) == 1


def test_braces_in_a_name_of_the_table_are_no_pattern(tmp_path):
    made, _, _ = imported(csv(tmp_path, "participant,trial,rating {close},tilt\nA,1,close,3\n"), SIGNED)
    assert list(made.table.columns) == ["participant", "trial", "response", "tilt"]


def test_the_record_has_no_free_text_and_no_used_column_as_left_out(tmp_path):
    path = exported.SAME[-1].write(tmp_path)[0]
    assert imported(path, exported.study())[0].record["columns_left_out"] == []
    table = "participant,trial,response,tilt\nA,1,close,3\nA,2,mail anna@example.org,3\n"
    mapping = Mapping(HEAD | {"tilt": "tilt"}, missing=("mail anna@example.org",))
    made, _, _ = imported(csv(tmp_path, table), SIGNED, mapping)
    assert made.record["missing"] == {"other": 1} and "anna" not in str(made.record)
    records = '[{"anna@example.org": {"x": 1}, "participant": "P1", "response": "close", "tilt": 3}]'
    assert "anna" not in str(imported(csv(tmp_path, records, "e.json"), SIGNED)[0].record)


def test_two_files_have_header_rows_and_participants_in_common(tmp_path):
    text = (
        "ResponseId,StartDate,RecordedDate,tilt,response\nid,start,end,how tilted,how close\n"
        + ",".join(f'"{{""ImportId"": ""{name}""}}"' for name in "abcde")
        + "\nA,x,y,3,close\n"
    )
    other = text.replace("A,x,y,3,close", "B,x,y,4,similar")
    made, used, _ = imported([csv(tmp_path, text, "1.csv"), csv(tmp_path, other, "2.csv")], SIGNED)
    assert used.header_rows == 3 and list(made.table["response"]) == ["close", "similar"]
    part = "participant,response,tilt\nA,close,3\n"
    made, _, _ = imported([csv(tmp_path, part, "3.csv"), csv(tmp_path, part, "4.csv")], SIGNED)
    assert list(made.table["trial"]) == ["1", "2"]


def test_ordered_levels_and_mixtures_are_imported(tmp_path):
    levels = {"sugar": {"levels": ["low", "medium", "high"], "ordered": True}}
    made, _, _ = imported(csv(tmp_path, "participant,response,sugar\nA,close,Low\nA,similar,high\n"), study_of(levels))
    assert list(made.table["sugar"]) == ["low", "high"]
    shares = {name: {"low": 0.0, "high": 1.0} for name in "abc"}
    sum_of_1 = [{"terms": dict.fromkeys("abc", 1.0), "least": 1.0, "most": 1.0}]
    mixture = study_of(shares, constraints=sum_of_1)
    assert len(imported(csv(tmp_path, "participant,response,a,b,c\nA,close,0.2,0.3,0.5\n"), mixture)[0].table) == 1
    with pytest.raises(InputError, match=r"export\.csv:2"):
        imported(csv(tmp_path, "participant,response,a,b,c\nA,close,0.2,0.3,0.7\n"), mixture)
