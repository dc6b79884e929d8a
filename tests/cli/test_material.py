"""`hilbo identify` and `hilbo passivity` as a user types them."""

import json
import re
import tomllib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from commands import run
from instrument_tables import AREA, CASES, GAP, PLAIN
from material import FOAM, foam_tests

from hilbo.identification.fitting import Test
from hilbo.report.figures.mechanics import passivity_figure
from hilbo.report.passivity import passivity_result
from hilbo.study.config import Study
from hilbo.study.folder import _reference
from hilbo.study.tables.validation import sets_frame
from hilbo.viscoelastic import FOSLS

STUDY = "hilbo/data/paper.toml"
FISH = str(Path("hilbo/data/fish_muscle.csv").resolve())


def test_passivity_of_the_published_sets(capsys, monkeypatch):
    set_a = ["passivity", "--K1", 5.58, "--B1", 7.88, "--alpha", 0.176, "--study", STUDY]
    code, stdout, _ = run(capsys, monkeypatch, *set_a, "--json")
    content = json.loads(stdout)
    assert (code, content["status"]) == (0, "passive")
    assert content["minimum_damping"] == pytest.approx(0.75981, abs=1e-5)
    assert content["largest_K1"] == pytest.approx(6.867, abs=1e-3)
    assert content["binding_frequency"] == pytest.approx(500)
    code, stdout, _ = run(capsys, monkeypatch, *set_a, "--damping", 0.7)
    assert stdout.startswith("violated: the device has 0.7 N·s/m, 0.05981 less than the 0.75981")
    assert "creates" in stdout


def test_passivity_at_a_delay(capsys, monkeypatch, tmp_path):
    set_s = ["passivity", "--K1", 5.7, "--B1", 5.89, "--alpha", 0.203]
    code, stdout, _ = run(capsys, monkeypatch, *set_s, "--delay", 271e-6, "--json")
    content = json.loads(stdout)
    assert (code, content["status"], content["delay"]) == (0, "violated", 271e-6)
    assert content["minimum_damping"] == pytest.approx(1.11042, abs=1e-5) and content["witness"]["energy_per_cycle"] < 0
    study = tmp_path / "late.toml"
    study.write_text(Path(STUDY).read_text().replace("T = 0.001", "delay = 0.000271\nT = 0.001"))
    _, stdout, _ = run(capsys, monkeypatch, *set_s, "--study", study)
    assert stdout.startswith("violated at delays up to 271 µs: the device has 0.95 N·s/m, 0.1604 less than the 1.1104")
    assert len(passivity_figure(FOSLS(-2.89, 5.7, 5.89, 0.203), 0.95, 271e-6).axes) == 2
    for delay in ("nan", "-0.001", "0.002"):
        study.write_text(Path(STUDY).read_text().replace("T = 0.001", f"delay = {delay}\nT = 0.001"))
        code, _, stderr = run(capsys, monkeypatch, *set_s, "--study", study)
        assert code == 2 and "renderer.delay is" in stderr and stderr.count("\n") == 1


def test_a_set_far_from_passive_has_its_figure_too():
    figure = passivity_figure(FOSLS(-9.0, 5.58, 7.88, 0.176), 0.95)
    assert len(figure.axes[1].lines[0].get_xdata()) > 10


def test_an_even_number_of_taps_has_no_closed_form():
    content = passivity_result(FOSLS(-3.0, 5.58, 7.88, 0.176, N=100), 0.95)
    assert content["status"] in ("passive", "violated")
    assert content["largest_K1"] is None and not content["every_K1"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["passivity", "--K1", "5"], "--B1 is missing"),
        (["passivity", "--K1", "5", "--B1", "1", "--alpha", "1.5"], "alpha is 1.5"),
        (["passivity", "--K1", "-5", "--B1", "1", "--alpha", "0.5"], "K1 is -5"),
        (["passivity", "--K1", "5", "--B1", "1", "--alpha", "0.5", "--damping", "0"], "--damping is 0"),
        (["passivity", "--K1", "5", "--B1", "1", "--alpha", "0.5", "--K0", "1", "--K-eff", "1"], "leave one out"),
        (["passivity", "--K1", "5", "--B1", "1", "--alpha", "0.5", "--K0", "-9", "--memory", "full"], "0 or above"),
        (["passivity", "--K1", "5", "--B1", "1", "--alpha", "0.5", "--delay", "nan"], "delay is nan s; it must be"),
        (["identify", "nothing.csv", "--out", "out"], "nothing.csv: cannot be read"),
        (["identify", "t.csv", "--out", "out"], 't.csv:1: column "time" has no unit'),
        (["identify", "t.csv", "--out", "out", "--memory", "long"], '--memory is "long"'),
        (["identify", "t.csv", "--out", "out", "--T", "0"], "--T is 0"),
        (["identify", "t.csv", "--out", "out", "--lag", "late"], '--lag is "late"; it must be a number or "fit".'),
        (["identify", "t.csv", "--out", "out", "--corner", "low"], 'must be a number or "fit" or "none" or "auto".'),
        (
            ["identify", FISH, "--out", "out", "--longest", "0.001"],
            "no row up to 0.001 s; give a --longest above 0.0139 s",
        ),
        (["identify", FISH, "--out", "out", "--longest", "-1"], "--longest is -1.0; it must be a number above 0"),
        (["identify", FISH, "--out", "out", "--longest", "nan"], "--longest is nan; it must be a number above 0"),
    ],
)
def test_bad_input_ends_with_2_and_writes_nothing(capsys, monkeypatch, tmp_path, arguments, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "t.csv").write_text("test,time,x_mm,F_N\nrelaxation,0,0,0\n")
    code, stdout, stderr = run(capsys, monkeypatch, *arguments)
    assert (code, stdout) == (2, "")
    assert words in " ".join(stderr.split())
    assert [path.name for path in tmp_path.iterdir()] == ["t.csv"]


def test_opposite_signs_end_with_2_and_write_nothing(capsys, monkeypatch, tmp_path):
    path, out = tmp_path / "pressed.csv", tmp_path / "out"
    write([Test("creep", np.arange(9.0), np.r_[0, np.ones(8)][None], np.r_[0, np.ones(8)][None])], path)
    flipped = pd.read_csv(path)
    flipped["force_N"] *= -1
    flipped.to_csv(path, index=False)
    code, stdout, stderr = run(capsys, monkeypatch, "identify", path, "--out", out)
    assert (code, stdout, out.exists()) == (2, "", False)
    assert "pressed.csv: The creep test has position and force of opposite signs; multiply" in " ".join(stderr.split())


@pytest.mark.deep
def test_a_force_that_rises_while_held_is_refused_with_file_and_cause(capsys, monkeypatch, tmp_path):
    path, out, t = tmp_path / "rising.csv", tmp_path / "out", np.arange(300) * 0.01
    ramp = np.minimum(t / 0.03, 1)
    write([Test("relaxation", t, (ramp * (1 + 0.02 * t))[None], 5 * ramp[None])], path)
    code, stdout, stderr = run(capsys, monkeypatch, "identify", path, "--out", out)
    assert (code, stdout, out.exists()) == (2, "", False)
    assert re.search(
        r"rising.csv: The best fit has K1 = -0.055\d* N/mm, .* \(the force of the relaxation test rises from 1.003 to"
        r" 1.057 N while its position is held \(5 to 5 mm, 0.03 to 2.99 s\)\); check",
        " ".join(stderr.split()),
    )


@pytest.mark.deep
def test_identify_reads_an_instruments_table_by_the_options_that_its_refusals_name(capsys, monkeypatch, tmp_path):
    path, out = tmp_path / "foam.txt", tmp_path / "out"
    path.write_bytes(CASES["RheoCompass, intervals"].data)
    arguments = ["identify", path, "--out", out, "--no-compare-memory", "--lag", 0]
    for words, options in (
        ("choose one by --block 1", ["--block", 2, "--block", 3]),
        ("give its area in mm2 by --area and its thickness in mm by --gap", ["--area", AREA, "--gap", GAP]),
        ("or give --test relaxation", ["--test", "relaxation"]),
    ):
        code, _, stderr = run(capsys, monkeypatch, *arguments)
        assert code == 2 and words in " ".join(stderr.split()) and not out.exists()
        arguments += options
    code, _, stderr = run(capsys, monkeypatch, *arguments)
    assert code == 0 and "blocks 2 and 3 of 3 were read" in " ".join(stderr.split())
    (tmp_path / "plain.csv").write_bytes(PLAIN)
    plain = ["identify", tmp_path / "plain.csv", "--out", tmp_path / "plain", "--no-compare-memory", "--lag", 0]
    assert run(capsys, monkeypatch, *plain)[0] == 0
    ours, theirs = (json.loads((folder / "result.json").read_text())["set"] for folder in (out, tmp_path / "plain"))
    assert ours == pytest.approx(theirs, rel=1e-7)


def write(tests, path):
    parts = []
    for test in tests:
        pair = (test.input, test.output) if test.kind == "relaxation" else (test.output, test.input)
        for repeat in range(test.repeats):
            columns = {"test": test.kind, "repeat": repeat, "time_s": test.time}
            parts.append(pd.DataFrame(columns | {"position_mm": pair[0][repeat], "force_N": pair[1][repeat]}))
    pd.concat(parts).to_csv(path, index=False)


@pytest.mark.deep
def test_identify_writes_everything(capsys, monkeypatch, tmp_path):
    write(foam_tests(6, noise=0.004, hold=0.5, seed=2), tmp_path / "foam.csv")
    out = tmp_path / "out"
    code, stdout, _ = run(
        capsys, monkeypatch, "identify", tmp_path / "foam.csv", "--out", out, "--damping", 0.95, "--json"
    )
    assert code == 0
    content = json.loads(stdout)
    assert content == json.loads((out / "result.json").read_text())
    for name, truth in zip(("K0", "K1", "B1", "alpha"), FOAM, strict=True):
        row = content["parameters"][name]
        assert row["status"] == "identified"
        assert row["lower"] < truth < row["upper"]
    assert [row["N"] for row in content["memory"]] == [2, 25, 101, 201, 1000, None]
    assert content["renderer"] == (out / "renderer.toml").read_text()
    text = Path(STUDY).read_text()
    before, _, rest = text.partition("[renderer]")
    study = Study.from_dict(tomllib.loads(before + content["renderer"] + rest[rest.index("[gp]") :]))
    assert study.space.mechanics.K_eff == pytest.approx(0.44325, abs=2e-3)
    sets = sets_frame(out / "sets.csv", study.space.names, study.space.parameters)
    reference = _reference(study, "", sets, None)
    for name, place, low, high in zip(study.space.names, reference.x, reference.low, reference.high, strict=True):
        row = content["parameters"][name]
        assert sets.at["sysid", name] == content["set"][name] and sets.at["sysid", f"{name}_low"] == row["lower"]
        assert low < place < high
    page = " ".join((out / "report.html").read_text().split())
    assert page.count("data:image/png;base64,") == 5
    assert "http://" not in page and "https://" not in page and "N·sᵅ/mm" in page
    curves = pd.read_csv(out / "curves.csv")
    assert np.abs(curves["mean"] - curves["fit"]).max() < 0.1


@pytest.mark.deep
def test_what_is_not_identifiable_has_words_instead_of_digits(capsys, monkeypatch, tmp_path):
    out = tmp_path / "out"
    arguments = ["identify", "hilbo/data/fish_muscle.csv", "--out", out, "--json"]
    code, stdout, stderr = run(capsys, monkeypatch, *arguments)
    assert code == 0
    content = json.loads(stdout)
    assert content["renderer"] is None
    assert content["nrmse"]["modulus"] <= 0.023
    unknown = [name for name, row in content["parameters"].items() if row["status"] != "identified"]
    assert "K_eff" in unknown and all(content["parameters"][name]["value"] is None for name in unknown)
    assert "bound of K_eff" in stderr
    assert "not identifiable" in " ".join((out / "report.html").read_text().split())
