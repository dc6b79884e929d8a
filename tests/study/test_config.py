"""The study file: what is read from a good one, and the one sentence that a bad one gets."""

import hashlib
import tomllib

import numpy as np
import pytest

from hilbo.errors import InputError
from hilbo.study.config import Study
from hilbo.study.file.schema import Selection

GOOD = """\
schema = 1
[study]
name = "memory foam"
responses = ["different", "similar", "close"]
[parameters.K1]
low = 1.0
high = 32.0
unit = "N/mm"
scale = "linear"
[parameters.B1]
low = 0.001
high = 32.0
unit = "N.s^alpha/mm"
[parameters.alpha]
low = 0.01
high = 0.99
unit = ""
[renderer]
model = "fosls"
memory = "short"
N = 101
T = 0.001
K_eff = 0.44
damping = 0.95
[gp]
theta = 30.0
variance = 1.0
thresholds = [-0.5, 0.5]
noise = 0.5
inference = "laplace"
[selection]
space_filling = 5
trials = 25
acquisition = "ucb"
weight = 0.7
[aggregation]
rule = "bcm"
[materials.gel.renderer]
K_eff = 0.2
[materials.gel.parameters.K1]
high = 16
"""
PLAIN = """\
schema = 1
[study]
name = "video"
responses = ["bad", "good"]
[parameters.bitrate]
low = 100
high = 20_000
scale = "log"
[gp]
theta = 10
variance = 1
thresholds = [0]
noise = 1
"""


@pytest.fixture
def load(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def write_and_load(text):
        (tmp_path / "study.toml").write_bytes(text if isinstance(text, bytes) else text.encode())
        return Study.load("study.toml")

    return write_and_load


def test_a_study_file_becomes_a_record(load):
    study = load(GOOD)
    assert (study.file.name, study.responses) == ("memory foam", ("different", "similar", "close"))
    assert study.space.names == ("K1", "B1", "alpha")
    assert (study.space.parameters[1].low, study.space.parameters[1].unit) == (0.001, "N.s^alpha/mm")
    mechanics = study.space.mechanics
    assert (mechanics.memory, mechanics.N, mechanics.T, mechanics.K_eff) == ("short", 101, 0.001, 0.44)
    assert (mechanics.damping, mechanics.effective_damping) == (0.95, None)
    np.testing.assert_array_equal(study.gp.kernel.theta, 30.0)
    np.testing.assert_array_equal(study.gp.likelihood.thresholds, [-0.5, 0.5])
    assert study.file.selection == Selection(5, 25, "ucb", 0.7, None)
    assert (study.inference, study.rule, study.file.source) == ("laplace", "bcm", "study.toml")


def test_what_is_left_out_has_the_defaults_of_the_paper(load):
    study = load(PLAIN)
    assert study.space.mechanics is None
    assert study.space.parameters[0].scale == "log"
    assert study.file.selection == load(GOOD).file.selection
    assert (study.inference, study.rule, study.file.materials) == ("laplace", "bcm", ())


def test_theta_may_be_given_for_each_parameter(load):
    study = load(GOOD.replace("theta = 30.0", "theta = [10, 20, 30]"))
    np.testing.assert_array_equal(study.gp.kernel.theta, [10, 20, 30])


def test_a_dict_and_a_file_give_the_same_study(load):
    assert Study.from_dict(tomllib.loads(GOOD)).file.hash == load(GOOD).file.hash
    assert load(b"\xef\xbb\xbf" + GOOD.encode()).file.hash == load(GOOD).file.hash


def test_the_hash_knows_content_and_not_its_spelling(load):
    study = load(GOOD)
    assert study.file.hash == hashlib.sha256(study.file.content.encode()).hexdigest()[:16]
    assert "minimum_distance" not in study.file.content  # so that a key added one day changes no hash of today
    same = GOOD.replace("theta = 30.0", "theta = 30  # fixed").replace('inference = "laplace"\n', "")
    assert load(same).file.hash == study.file.hash
    for old, new in (("noise = 0.5", "noise = 0.6"), ("low = 0.01", "low = 0.02"), ("K_eff = 0.2", "K_eff = 0.3")):
        assert load(GOOD.replace(old, new)).file.hash != study.file.hash
    first, second = "[parameters.B1]\nlow = 0.001\nhigh = 32.0\n", "[parameters.alpha]\nlow = 0.01\nhigh = 0.99\n"
    plain = GOOD[: GOOD.index("[parameters.B1]")] + "{}" + GOOD[GOOD.index("[renderer]") :]
    assert load(plain.format(first + second)).file.hash != load(plain.format(second + first)).file.hash


def test_a_material_overrides_renderer_and_parameters(load):
    study = load(GOOD)
    assert study.file.materials == ("gel",)
    gel = study.material("gel")
    assert gel.space.mechanics.K_eff == 0.2
    assert gel.space.parameters[0].high == 16
    assert gel.space.parameters[1:] == study.space.parameters[1:]
    assert (gel.file.materials, gel.file.source) == ((), "study.toml")
    assert gel.file.hash != study.file.hash
    with pytest.raises(InputError, match=r"study.toml: materials.foam is not in the study, its materials: gel\."):
        study.material("foam")


BAD = [  # text of the good file, what stands there instead, the whole sentence or its start
    ("noise = 0.5", "nose = 0.5", "29: gp.nose is not a key of a study file; known here are theta, "),
    ("[aggregation]", "[agregation]", "36: agregation is not a key of a study file; known here are schema, "),
    ("low = 0.001", "lowest = 0.001", "11: parameters.B1.lowest is not a key of a study file; "),
    ("noise = 0.5\n", "", "25: gp.noise is missing; add it; "),
    ('unit = "N/mm"\nscale', "length = 1\nscale", "8: parameters.K1.length is not a key"),
    ("theta = 30.0", "length = 0.3\ntheta = 30.0", "26: gp.length and theta are equivalent"),
    (
        "theta = 30.0",
        "length = [0.3, 0.3]",
        "26: gp.length has 2 numbers; it must be one number or 3, one per parameter.",
    ),
    ("theta = 30.0", "length = 0", "26: gp.length is 0; it must be a number from 0.001 to 1000"),
    ("theta = 30.0", "length = 1e-200", "26: gp.length is 1e-200; it must be a number from 0.001 to 1000"),
    (
        "theta = 30.0",
        "length = [1e200, 1, 1]",
        "26: gp.length is [1e+200, 1, 1]; it must be a number from 0.001 to 1000",
    ),
    ("low = 0.001\n", "", "10: parameters.B1.low is missing; add it."),
    ("schema = 1\n", "", " schema is missing; add it."),
    ("schema = 1", "schema = 2", "1: schema is 2; it must be 1: this hilbo reads no other."),
    (
        "noise = 0.5",
        "noise = 0",
        "29: gp.noise is 0; it must be a number above 0; write for example noise = 0.5.",
    ),
    ("noise = 0.5", "noise = nan", "29: gp.noise is NaN; it must be a number above 0; "),
    ("noise = 0.5", "noise = inf", "29: gp.noise is Infinity; it must be a number above 0; "),
    ("noise = 0.5", 'noise = "0.5"', '29: gp.noise is "0.5"; it must be a number above 0; '),
    ("noise = 0.5", "noise = true", "29: gp.noise is true; it must be a number above 0; "),
    ("variance = 1.0", "variance = -1", "27: gp.variance is -1; it must be a number above 0; "),
    ("theta = 30.0", "theta = 0", "26: gp.theta is 0; it must be a number above 0, or a list of one for each "),
    ("theta = 30.0", "theta = [1, 0, 1]", "26: gp.theta is [1, 0, 1]; it must be a number above 0, or a list "),
    ("theta = 30.0", "theta = [1, 2]", "26: gp.theta has 2 numbers; it must be one number or 3, one per parameter."),
    (
        "[-0.5, 0.5]",
        "[0.5, -0.5]",
        "28: gp.thresholds is [0.5, -0.5]; it must rise from each number to the next.",
    ),
    ("[-0.5, 0.5]", "[0.5, 0.5]", "28: gp.thresholds is [0.5, 0.5]; it must rise "),
    ("[-0.5, 0.5]", "[-0.5, inf]", "28: gp.thresholds is [-0.5, Infinity]; it must be a list of rising numbers; "),
    (
        "[-0.5, 0.5]",
        "[0.5]",
        "28: gp.thresholds is [0.5]; it must have one number fewer than the 3 responses.",
    ),
    ('inference = "laplace"', 'inference = "vb"', '30: gp.inference is "vb"; it must be "laplace", "ep", "ep_correct'),
    ('"similar", ', '"close", ', '4: study.responses is ["different", "close", "close"]; it must not have one label '),
    ('"similar", ', '"Close", ', '4: study.responses has "Close" and "close", which differ in capitals or blanks only'),
    ('["different", "similar", "close"]', '["close"]', '4: study.responses is ["close"]; it must be a list of two '),
    ('"memory foam"', '""', '3: study.name is ""; it must be a text; write for example name = "memory foam".'),
    ("high = 0.99", "high = 0.01", "15: parameters.alpha.low is 0.01; it must be below high = 0.01."),
    ("high = 0.99", "high = inf", "16: parameters.alpha.high is Infinity; it must be a finite number."),
    ("high = 0.99", "high = 1", "16: parameters.alpha.high is 1.0; it must be below 1 for the FO-SLS."),
    ("low = 0.001", "low = 0", "11: parameters.B1.low is 0.0; it must be above 0 for the FO-SLS."),
    ('scale = "linear"', 'scale = "cubic"', '9: parameters.K1.scale is "cubic"; it must be "linear" or "log"; '),
    (
        'low = 1.0\nhigh = 32.0\nunit = "N/mm"\nscale = "linear"',
        'low = 0\nhigh = 1\nscale = "log"',
        '6: parameters.K1.low is 0.0; it must be above 0 on a scale = "log".',
    ),
    ('unit = "N/mm"', "unit = 3", '8: parameters.K1.unit is 3; it must be a text; write for example unit = "N/mm".'),
    (
        'unit = "N/mm"',
        'unit = "N/m"',
        '8: parameters.K1.unit is "N/m"; it must be "N/mm" where there is a [renderer].',
    ),
    (
        "[parameters.alpha]",
        "[parameters.order]",
        " parameters.alpha is missing, the renderer's model needs K1, B1 and ",
    ),
    ("N = 101", "N = 100", "21: renderer.N is 100; it must be odd and at least 1; write for example N = 101."),
    ("N = 101", "N = 101.5", "21: renderer.N is 101.5; it must be an odd whole number, 1 or above; "),
    ("T = 0.001", "T = 0", "22: renderer.T is 0; it must be a number above 0; "),
    ("K_eff = 0.44", "K_eff = -1", "23: renderer.K_eff is -1; it must be a number, 0 or above; "),
    ('memory = "short"', 'memory = "long"', '20: renderer.memory is "long"; it must be "short" or "full"; '),
    ('memory = "short"', 'memory = "full"\nstates = 9', "21: renderer.states is 9; it must be one of 8, 10, 12."),
    ("damping = 0.95\n", "", "18: renderer.damping is missing; add it."),
    ("damping = 0.95", "damping = 0.1", "24: renderer.damping is 0.1 N.s/m, with which no K1 from 1.0 N/mm up is "),
    (
        "damping = 0.95",
        "damping = 0.95\neffective_damping = [80, 10]",
        "25: renderer.effective_damping is [80.0, 10.0]; it must be a lower end, 0 or above, and a higher one; ",
    ),
    ("damping = 0.95", "damping = 0.95\neffective_damping = 10", "25: renderer.effective_damping is 10; it must be a "),
    ("trials = 25", "trials = 2.5", "33: selection.trials is 2.5; it must be a whole number, 1 or above; "),
    ("trials = 25", "trials = 4", "32: selection.space_filling is 5; it must be at most trials = 4."),
    ('"ucb"', '"best"', '34: selection.acquisition is "best"; it must be one of "ucb", '),
    ("weight = 0.7", "weight = -1", "35: selection.weight is -1; it must be a number, 0 or above; "),
    (
        'rule = "bcm"',
        'rule = "rbcm"',
        '37: aggregation.rule is "rbcm", which was withdrawn: it won no comparison;',
    ),
    ('rule = "bcm"', 'rule = ["bcm"]', '37: aggregation.rule is ["bcm"]; it must be one of "bcm", '),
    ('rule = "bcm"', 'rule = "mean"', '37: aggregation.rule is "mean"; it must be one of "bcm", '),
    ("[aggregation]\n", "[aggregation]\n[aggregation]\n", "37: is not valid TOML (Cannot declare ('aggregation',) "),
    ("high = 0.99", "high = ", "16: is not valid TOML (Invalid value), fix that line."),
    ("high = 16", "high = 0.5", "40: materials.gel.parameters.K1.low is 1.0; it must be below high = 0.5."),
    ("high = 16", 'high = "16"', '41: materials.gel.parameters.K1.high is "16"; it must be a finite number.'),
    ("high = 16", "top = 16", "41: materials.gel.parameters.K1.top is not a key of a study file; "),
    ("high = 0.99", "high = " + "9" * 5000, "16: has a number of too many digits; write it shorter."),
    (
        "trials = 25",
        "trials = " + "9" * 400,
        "33: selection.trials is an integer of more than 64 bits; write ",
    ),
    ('"memory foam"', "[" * 2000 + "]" * 2000, " nests lists or tables too deep to be read; flatten them."),
    ('"memory foam"', "[" * 200 + "]" * 200, "3: study.name nests lists or tables more than 20 deep; flatten them."),
    ("high = 16", f"high{'.a' * 5000} = 1", "40: materials.gel.parameters.K1.high.a.a.a.a.a"),
    ('"memory foam"', "[" + "1, " * 5000 + "]", "3: study.name is [1, 1, 1, "),
    ("low = 1.0\nhigh = 32.0", "low = -1e308\nhigh = 1e308", "5: parameters.K1 runs from -1e+308 to 1e+308, so that "),
    ("[materials.gel.renderer]", "[materials.gel.gp]", "38: materials.gel.gp is not a key of a study file; known "),
]


@pytest.mark.parametrize(("old", "new", "sentence"), BAD, ids=[sentence[:60] for _, _, sentence in BAD])
def test_a_bad_file_gets_one_sentence_with_its_place(load, old, new, sentence):
    assert GOOD.count(old) >= 1
    with pytest.raises(InputError) as caught:
        load(GOOD.replace(old, new, 1))
    message = str(caught.value)
    assert message.startswith(f"study.toml:{sentence}"), message
    assert message.endswith(".") and "\n" not in message and len(message) < 500


def test_all_that_is_missing_stands_in_one_sentence():
    with pytest.raises(InputError) as caught:
        Study.from_dict({"schema": 1, "study": {"name": "a"}, "parameters": {"u": {"low": 0}}, "gp": {"theta": 1.0}})
    assert str(caught.value) == (
        "study.responses is missing and so are parameters.u.high, gp.variance, gp.thresholds, gp.noise; add them;"
        ' rule = "learnt-2" in [aggregation] learns what [gp] does not state.'
    )


@pytest.mark.parametrize("length", ["0.25", "[0.25, 0.25, 0.5]"])
def test_a_length_is_a_theta_written_otherwise(load, length):
    study = load(GOOD.replace("theta = 30.0", f"length = {length}"))
    theta = {"0.25": 8.0, "[0.25, 0.25, 0.5]": [8.0, 8.0, 2.0]}[length]
    np.testing.assert_array_equal(study.gp.kernel.theta, theta)
    assert study.file.hash == load(GOOD.replace("theta = 30.0", f"theta = {theta}")).file.hash


def test_tables_may_hold_numpys_numbers():
    raw = tomllib.loads(GOOD)
    raw["gp"] |= {"thresholds": np.array([-0.5, 0.5]), "noise": np.float64(0.5), "theta": np.float32(30)}
    raw["selection"]["trials"] = np.int64(25)
    assert Study.from_dict(raw).file.hash == Study.from_dict(tomllib.loads(GOOD)).file.hash


def test_a_table_must_be_a_table():
    raw = tomllib.loads(PLAIN)
    with pytest.raises(InputError, match=r"^gp is 3; it must be a table; write it as \[gp\]\.$"):
        Study.from_dict(raw | {"gp": 3})
    with pytest.raises(InputError, match=r"^here: parameters is empty"):
        Study.from_dict(raw | {"parameters": {}}, source="here")


def test_a_file_that_cannot_be_read_is_said_so(load, tmp_path):
    with pytest.raises(InputError, match=r"^absent.toml: cannot be read \(No such file or directory\), check the path"):
        Study.load("absent.toml")
    with pytest.raises(InputError, match=r"cannot be read \(Is a directory\)"):
        Study.load(tmp_path)
    with pytest.raises(InputError, match=r"^study.toml: is not UTF-8 text, save it as UTF-8\.$"):
        load(b"\xff\xfe")
    with pytest.raises(InputError, match=r"^study.toml:1: is not valid TOML \(.*at end of document"):
        load(b'schema = """')
