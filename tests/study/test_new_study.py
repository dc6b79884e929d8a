"""`hilbo init` writes files that are in order whatever they are called, or says in one sentence why not."""

import hypothesis.strategies as st
import pytest
from commands import run
from hypothesis import given, settings

from hilbo import Study
from hilbo.errors import InputError
from hilbo.population.rules.registry import RECOMMENDED
from hilbo.search.box import Constraint, Parameter
from hilbo.study.file.constraint_words import constraint_of
from hilbo.study.file.reading import StudyFile
from hilbo.study.template import NewStudy, parameter_of, study_text

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
    loaded = StudyFile.load(file)
    assert (loaded.name, loaded.space.parameters, loaded.responses) == (name, parameters, tuple(responses))
    assert loaded.selection.trials == trials and loaded.stimulus is not None


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
    with pytest.raises(InputError, match=r"write NAME=LOW:HIGH.* for example hue=140:260:deg"):
        parameter_of(text)


TWO = (Parameter("a", 0.0, 2.0, "mm"), Parameter("b c", 0.0, 2.0))
SENTENCES = {
    "a + 2*z <= 3": "names z, which is no parameter of the study; those are a, b c.",
    "a + 2*b c <= -3": '--constraint "a + 2*b c <= -3" leaves nothing of the ranges',
    "a < 1": 'is "a < 1"; write a sum of parameters and its bound, for example "a + 2*b <= 3"',
    "a a <= 1": "write a sum of parameters and its bound",
    "0 <= a >= 1": "write a sum of parameters and its bound",
    "0 <= a <= b c": "write a sum of parameters and its bound",
    "1 <= 2": "write a sum of parameters and its bound",
    "a + <= 2": "write a sum of parameters and its bound",
    "a <= 1,5": "write a sum of parameters and its bound",
    "a - a <= 1": '--constraint "a - a <= 1" has no weight but 0',
    "1e999 a <= 1": '--constraint "1e999 a <= 1".a is inf; it must be a finite number.',
    "3 <= a <= 1": '--constraint "3 <= a <= 1".least is 3.0; it must be below most = 1.0.',
}


@pytest.mark.parametrize(
    ("text", "constraint"),
    [
        ("a + 2*b c <= 3", Constraint((("a", 1.0), ("b c", 2.0)), None, 3.0)),
        ("0 <= a - .5b c + 1 <= 2e0", Constraint((("a", 1.0), ("b c", -0.5)), -1.0, 1.0)),
        ("a >= 2 b c", Constraint((("b c", 2.0), ("a", -1.0)), None, 0.0)),
        ("1<=-a+3a", Constraint((("a", 2.0),), 1.0, None)),
    ],
)
def test_a_constraint_is_in_the_file_as_it_is_written(tmp_path, text, constraint):
    (tmp_path / "study.toml").write_text(study_text(NewStudy("x", TWO, constraints=(text,))))
    assert StudyFile.load(tmp_path / "study.toml").space.constraints == (constraint,)


@pytest.mark.parametrize(("text", "sentence"), SENTENCES.items())
def test_what_is_no_constraint_is_refused_in_a_sentence(text, sentence):
    with pytest.raises(InputError) as refused:
        study_text(NewStudy("x", TWO, constraints=(text,)))
    assert sentence in str(refused.value) and "constraints." not in str(refused.value)


@given(
    weights=st.lists(st.floats(-1e6, 1e6).filter(bool), min_size=2, max_size=2),
    least=st.none() | st.floats(-1e6, 1e6),
    over=st.none() | st.floats(1e-3, 1e6),
)
def test_a_constraint_s_own_words_are_read_as_it(weights, least, over):
    """As `Constraint.words` states six digits, from numbers of as many."""
    most = None if over is None else float(f"{(least or 0.0) + over:g}")
    least = None if least is None else float(f"{least:g}")
    if (most is None and least is None) or (None not in (most, least) and not least < most):
        return
    terms = tuple(zip(("a", "b c"), (float(f"{weight:g}") for weight in weights), strict=True))
    stated = Constraint(terms, least, most)
    constraint = constraint_of(stated.words, ["a", "b c"])
    assert constraint == stated


@pytest.mark.parametrize("name", ["phase", "response", "material", "session", "mean", "set_id"])
def test_a_parameter_is_not_called_as_a_column_of_the_tables(name):
    with pytest.raises(InputError, match=f"parameters.{name}: tables have a column {name} already; call the parameter"):
        study_text(NewStudy("x", (Parameter(name, 0.0, 1.0),)))


def test_the_recommended_rule_is_the_one_that_is_written(tmp_path):
    (tmp_path / "study.toml").write_text(text := study_text(NewStudy("x", TWO)))
    assert Study.load(tmp_path / "study.toml").rule == RECOMMENDED
    beside = text.partition("replace the two lines above by these")[2].partition("[selection]")[0]
    lines = [line.removeprefix("# ") for line in beside.splitlines()[1:]]
    kept = "\n".join(line for line in text.splitlines() if line[:13] not in ("[aggregation]", 'rule = "learn'))
    (tmp_path / "paper.toml").write_text("\n".join([kept, *lines]))
    assert Study.load(tmp_path / "paper.toml").rule == "bcm"


def test_the_file_of_a_device_is_one_that_a_device_renders(tmp_path):
    (tmp_path / "study.toml").write_text(study_text(NewStudy("foam", (), device=True)))
    study = Study.load(tmp_path / "study.toml")
    assert study.space.mechanics is not None and study.file.stimulus is None and 0 < study.space.volume() < 1


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
    constrained = ("--parameter", "u=0:1", "--parameter", "v=0:1", "--constraint", "u + v <= 1", "--force")
    assert run(capsys, monkeypatch, *arguments[:2], *constrained)[0] == 0
    assert StudyFile.load(file).space.constraints == (Constraint((("u", 1.0), ("v", 1.0)), None, 1.0),)
    assert [path.name for path in tmp_path.iterdir()] == ["colour.toml"]
    code, _, err = run(capsys, monkeypatch, "init", tmp_path / "none" / "x.toml", "--parameter", "u=0:1")
    assert code == 2 and "cannot be written" in err
