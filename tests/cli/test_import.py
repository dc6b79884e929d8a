"""`hilbo import` as a command: its files, its sentences, and the withdrawal of a participant from them."""

import json
import stat

import exported
import pytest
from commands import run


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The working folder, with a study file."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "study.toml").write_text(exported.STUDY)
    return tmp_path


def export_of(name, folder):
    """Write the export with this name; returns it, and its file."""
    export = next(each for each in (*exported.SAME, *exported.SAME_STIMULI) if each.name == name)
    return export, export.write(folder)[0]


def test_ids_of_a_platform_are_replaced_and_withdrawn(folder, capsys, monkeypatch):
    _, path = export_of("ids of Prolific", folder)
    code, _, said = run(capsys, monkeypatch, "import", path, "--study", "study.toml")
    assert code == 0 and "48 rows read, 48 trials of 6 participants" in said and "6 ids are changed" in said
    path.unlink()
    assert stat.S_IMODE((folder / "trials.ids.csv").stat().st_mode) == 0o600
    for name in ("trials.csv", "trials.import.json", "trials.mapping.toml"):
        assert "5f1e9c0b2d3a4f5e6a7b8c" not in (folder / name).read_text()
    assert run(capsys, monkeypatch, "participants", "delete", ".", "P002", "--yes")[0] == 0
    for name in ("trials.csv", "trials.ids.csv"):
        text = (folder / name).read_text()
        assert "P002" not in text and "P003" in text


def test_an_incomplete_mapping_is_completed_by_hand(folder, capsys, monkeypatch):
    export, path = export_of("Qualtrics", folder)
    code, _, said = run(capsys, monkeypatch, "import", path, "--study", "study.toml")
    assert code == 2 and "write in [stimuli] the parameters of each" in said and not (folder / "trials.csv").exists()
    mapping = folder / "trials.mapping.toml"
    code, _, said = run(capsys, monkeypatch, "import", path, "--study", "study.toml")
    assert code == 2 and "trials.mapping.toml: exists already" in said
    code, _, said = run(capsys, monkeypatch, "import", path, "--study", "study.toml", "--mapping", mapping)
    assert code == 2 and 'stimulus "1" has no hue; write it in [stimuli]' in said
    mapping.write_text(export.complete(mapping.read_text()))
    code, _, said = run(capsys, monkeypatch, "import", path, "--study", "study.toml", "--mapping", mapping)
    assert code == 0 and "an export of Qualtrics; 7 rows read, 48 trials" in said
    record = json.loads((folder / "trials.import.json").read_text())
    assert record["columns_personal"] == ["IPAddress", "RecipientEmail"]
    assert record["rows_left_out"] == {"without a value of a parameter, or excluded by [rows]": 1}


def test_nothing_is_overwritten(folder, capsys, monkeypatch):
    _, path = export_of("clean", folder)
    (folder / "trials.csv").write_text("mine")
    code, _, said = run(capsys, monkeypatch, "import", path, "--study", "study.toml")
    assert code == 2 and "trials.csv: exists already" in said
    assert (folder / "trials.csv").read_text() == "mine" and not (folder / "trials.import.json").exists()


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "export.csv: is empty"),
        ("participant;hue\nA;150,5\n", "no column is recognised as the parameter light"),
        ("participant,response,hue,light\nA,close,150", "export.csv:2: has 3 cells, the header has 4"),
        ('participant,response,hue,light\nA,"close" one,150,40', "export.csv:2: has a quotation mark"),
        ("participant,response,hue,light\nA,close,999,40", "export.csv:2: hue is"),
        ("participant,response,hue,light\nA,nearly,150,40", 'response "nearly": write in [responses]'),
        ("participant,response,hue,light\n,close,150,40", 'export.csv:2: participant is ""; each trial needs one'),
        ("participant;response;hue;light\nA;close;150,5;40.5", "decimal commas and points"),
    ],
)
def test_what_cannot_be_read_is_said_in_a_sentence(folder, capsys, monkeypatch, text, sentence):
    (folder / "export.csv").write_text(text)
    code, _, said = run(capsys, monkeypatch, "import", "export.csv", "--study", "study.toml")
    assert code == 2 and sentence in said and not (folder / "trials.csv").exists()


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("colums = 1", "is no mapping for hilbo import"),
        ("[columns]\nparticipant = 'x'", 'columns.participant is "x", which is not in the table'),
        ("[columns]\nparticipant = 'participant'\nresponse = 'response'", "columns.hue is missing"),
        ("[columns]\nhu = 'hue'", "columns.hu is no column of a trial table"),
    ],
)
def test_a_wrong_mapping_is_said_in_a_sentence(folder, capsys, monkeypatch, line, sentence):
    _, path = export_of("clean", folder)
    (folder / "m.toml").write_text(line)
    code, _, said = run(capsys, monkeypatch, "import", path, "--study", "study.toml", "--mapping", "m.toml")
    assert code == 2 and "m.toml: " in said and sentence in said


def test_a_list_of_earlier_ids_goes_with_its_table(folder, capsys, monkeypatch):
    _, path = export_of("ids of Prolific", folder)
    assert run(capsys, monkeypatch, "import", path, "--study", "study.toml")[0] == 0
    _, path = export_of("clean", folder)
    assert run(capsys, monkeypatch, "import", path, "--study", "study.toml", "--force")[0] == 0
    assert not (folder / "trials.ids.csv").exists()
