"""`hilbo init` writes files that are in order whatever they are called, or says in one sentence why not."""

import hypothesis.strategies as st
import pytest
from commands import run
from hypothesis import given, settings

from hilbo import Study
from hilbo.errors import InputError
from hilbo.search.box import Parameter
from hilbo.study.new_study import NewStudy, parameter_of, study_text
from hilbo.study.study_file import StudyFile

TEXTS = st.text(max_size=12)
NAMES = st.text(st.characters(exclude_categories=["C", "Z"]), max_size=12)
NUMBERS = st.floats(allow_nan=False, allow_infinity=False, min_value=-1e12, max_value=1e12)


@given(
    name=TEXTS,
    named=st.lists(st.tuples(NAMES, st.lists(NUMBERS, min_size=2, max_size=2).map(sorted), TEXTS), max_size=4),
    responses=st.lists(TEXTS, max_size=6, unique=True),
    trials=st.integers(1, 100),
)
@settings(max_examples=60)
def test_a_file_that_is_written_says_what_was_asked_for(tmp_path_factory, name, named, responses, trials):
    refused = ""
    try:
        parameters = tuple(Parameter(n, *ends, unit) for n, ends, unit in named)
        text = study_text(NewStudy(name, parameters, tuple(responses), trials))
    except InputError as error:
        refused = str(error)
    if refused:
        assert refused.endswith(".") and "\n" not in refused
        return
    file = tmp_path_factory.mktemp("new") / "study.toml"
    file.write_text(text, encoding="utf-8", newline="")
    found = StudyFile.load(file)
    assert (found.name, found.space.parameters, found.responses) == (name, parameters, tuple(responses))
    assert found.selection.trials == trials and found.stimulus is not None


@pytest.mark.parametrize(
    ("text", "parameter"),
    [
        ("hue=0:360:deg", Parameter("hue", 0.0, 360.0, "deg")),
        ("light=-1.5:2", Parameter("light", -1.5, 2.0)),
        ("rate=1e2:1e4:bit/s:log", Parameter("rate", 100.0, 10000.0, "bit/s", "log")),
        ("count=0:5::integer", Parameter("count", 0.0, 5.0, integer=True)),
    ],
)
def test_a_parameter_is_read_as_it_is_written(text, parameter):
    assert parameter_of(text) == parameter


@pytest.mark.parametrize(
    "text", ["", "hue", "hue=", "hue=1", "hue=a:b", "=0:1", "hue=0:1:u:cubic", "hue=0:1:u:log:x", "h\nue=0:1"]
)
def test_what_is_no_parameter_is_refused_with_an_example(text):
    with pytest.raises(InputError, match=r"write NAME=LOW:HIGH.* for example hue=0:360:deg"):
        parameter_of(text)


def test_the_file_of_a_device_is_one_that_a_device_renders(tmp_path):
    (tmp_path / "study.toml").write_text(study_text(NewStudy("foam", (), device=True)))
    study = Study.load(tmp_path / "study.toml")
    assert study.space.mechanics is not None and study.stimulus is None and 0 < study.space.volume() < 1


def test_the_command_writes_once(tmp_path, capsys, monkeypatch):
    file = tmp_path / "colour.toml"
    arguments = ("init", file, "--parameter", "hue=0:360:deg", "--responses", "no, yes")
    assert run(capsys, monkeypatch, *arguments)[0] == 0
    assert StudyFile.load(file).responses == ("no", "yes") and StudyFile.load(file).name == "colour"
    before = file.read_bytes()
    code, out, err = run(capsys, monkeypatch, *arguments[:2], "--parameter", "u=0:1")
    assert (code, out) == (2, "") and "exists already" in err and file.read_bytes() == before
    assert run(capsys, monkeypatch, *arguments[:2], "--parameter", "u=0:1", "--force")[0] == 0
    assert StudyFile.load(file).space.names == ("u",)
    assert [path.name for path in tmp_path.iterdir()] == ["colour.toml"]
    code, _, err = run(capsys, monkeypatch, "init", tmp_path / "none" / "x.toml", "--parameter", "u=0:1")
    assert code == 2 and "cannot be written" in err
