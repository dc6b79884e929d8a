"""The commands as a user types them: what they write, and bad input in one sentence with exit code 2."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import typer
import xarray as xr
from commands import run

from hilbo import Study
from hilbo.cli.main import app

VIDEO = ["hilbo/data/video_quality.csv", "--study", "hilbo/data/video_quality.toml"]


HELP = """
import sys
sys.argv = ["hilbo", "--help"]
from hilbo.cli.main import main
try:
    main()
finally:
    assert "jax" not in sys.modules
"""


def test_help_answers_without_jax():
    done = subprocess.run([sys.executable, "-c", HELP], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "aggregate" in done.stdout


@pytest.mark.deep  # compiles what test_results and `make demo` compile
def test_aggregate_writes_everything(capsys, monkeypatch, tmp_path):
    out = tmp_path / "results"
    code, stdout, _ = run(capsys, monkeypatch, "aggregate", *VIDEO, "--out", out, "--names", "V01,V02,V03", "--json")
    assert code == 0
    content = json.loads(stdout)
    assert content == json.loads((out / "result.json").read_text())
    assert [p["participant"] for p in content["participants"]] == ["V01", "V02", "V03"]
    assert sum(content["optimum"]["class_probabilities"].values()) == pytest.approx(1.0, abs=1e-12)
    assert all(p["certificate"]["converged"] for p in content["participants"])
    data = xr.load_dataset(out / "map.nc", engine="h5netcdf")
    assert data["mean"].dims == ("bitrate_kbps", "height_px")
    assert data["bitrate_kbps"].attrs["units"] == "kbit/s"
    assert float(data["mean"].max()) <= content["optimum"]["mean"] + 1e-9
    page = " ".join((out / "report.html").read_text().split())
    assert page.count("data:image/png;base64,") == 5
    assert "http://" not in page and "https://" not in page
    assert len(pd.read_csv(out / "optima.csv")) == 8
    assert content["rule"] == "bcm" and 0 < content["heterogeneity"]["share"] < 1
    assert any(words.startswith("Participants differ") for words in content["warnings"])
    assert content["other_inference"]["inference"] == "ep" and 0 <= content["other_inference"]["nrmse"] < 0.5
    assert "With expectation propagation instead, the optimum would move by" in page
    before = (out / "result.json").read_bytes()
    code, _, stderr = run(capsys, monkeypatch, "aggregate", *VIDEO, "--out", out)
    assert (code, (out / "result.json").read_bytes()) == (2, before)
    assert "--force" in stderr


@pytest.mark.deep
def test_a_pilot_prints_hyperparameters_that_a_study_file_takes(capsys, monkeypatch, tmp_path):
    table = pd.read_csv(VIDEO[0], dtype=str)
    table[table["participant"].isin(["V01", "V02", "V03"])].to_csv(tmp_path / "pilot.csv", index=False)
    what = "robustness", tmp_path / "pilot.csv", *VIDEO[1:], "--out", tmp_path / "pilot", "--pilot"
    code, printed, _ = run(capsys, monkeypatch, *what)
    assert code == 0 and "estimated from 3 participants" in printed
    given, content = tomllib.loads(printed)["gp"], json.loads((tmp_path / "pilot" / "result.json").read_text())
    for name, ends in content["pilot"]["intervals"].items():
        values = np.atleast_1d(given[name])
        assert len(values) == len(ends) and all(a < value < b for value, (a, b) in zip(values, ends, strict=True))
        np.testing.assert_allclose(values, np.atleast_1d(content["learned"][name]), rtol=1e-3)
    head, rest = Path(VIDEO[2]).read_text().split("[gp]")
    (tmp_path / "study.toml").write_text(head + printed + rest[rest.index("\n[") :])
    assert float(Study.load(tmp_path / "study.toml").gp.likelihood.noise) == given["noise"]


@pytest.mark.deep
def test_robustness_writes_its_check(capsys, monkeypatch, tmp_path):
    table = pd.read_csv(VIDEO[0], dtype=str)
    table[table["participant"].isin(["V01", "V02"])].to_csv(tmp_path / "two.csv", index=False)
    out = tmp_path / "check"
    code, _, _ = run(
        capsys, monkeypatch, "robustness", tmp_path / "two.csv", *VIDEO[1:], "--out", out, "--learn", "theta,noise"
    )
    assert code == 0
    content = json.loads((out / "result.json").read_text())
    assert content["learned"]["parameters"] == ["theta", "noise"]
    assert np.isfinite(content["nrmse"])
    page = " ".join((out / "report.html").read_text().split())
    assert "robust" in page and "both by the method bcm" in page and page.count("data:image/png;base64,") == 2
    assert all((out / f"{name}.{kind}").stat().st_size for name in ("maps", "moves") for kind in ("png", "svg"))
    data = xr.load_dataset(out / "map.nc", engine="h5netcdf")
    assert data["hyperparameters"].values.tolist() == ["fixed", "by evidence"]
    assert float(abs(data["mean"][0] - data["mean"][1]).max()) > 0.01


STUDY = Path("hilbo/data/paper.toml").read_text()
BAD_STUDIES = {
    "unknown key": (STUDY.replace("[gp]", "[gp]\nlenght = 3"), "gp.lenght is not a key"),
    "wrong type": (STUDY.replace("theta = 30.0", 'theta = "long"'), 'gp.theta is "long"'),
    "thresholds out of order": (STUDY.replace("[-0.5, 0.5]", "[0.5, -0.5]"), "gp.thresholds"),
    "noise of 0": (STUDY.replace("noise = 0.5", "noise = 0"), "gp.noise is 0"),
}


@pytest.mark.parametrize("what", BAD_STUDIES)
def test_bad_studies_write_nothing(capsys, monkeypatch, tmp_path, what):
    text, words = BAD_STUDIES[what]
    (tmp_path / "study.toml").write_text(text)
    code, stdout, stderr = run(
        capsys, monkeypatch, "aggregate", VIDEO[0], "--study", tmp_path / "study.toml", "--out", tmp_path / "out"
    )
    assert (code, stdout) == (2, "")
    assert words in stderr
    assert "study.toml:" in stderr
    assert [p.name for p in tmp_path.iterdir()] == ["study.toml"]


def test_a_bad_table_writes_nothing(capsys, monkeypatch, tmp_path):
    rows = "participant,trial,response,bitrate_kbps,height_px,content\nA,1,superb,500,480,Sea\n"
    (tmp_path / "t.csv").write_text(rows)
    code, _, stderr = run(capsys, monkeypatch, "aggregate", tmp_path / "t.csv", *VIDEO[1:], "--out", tmp_path / "out")
    assert code == 2
    assert 't.csv:2: response is "superb"' in stderr
    assert [p.name for p in tmp_path.iterdir()] == ["t.csv"]


def test_unknown_rules_are_refused(capsys, monkeypatch, tmp_path):
    code, _, stderr = run(capsys, monkeypatch, "aggregate", *VIDEO, "--rule", "median", "--out", tmp_path / "out")
    assert code == 2 and '--rule is "median"; it must be one of bcm, hierarchical' in stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--live", "--force"], "--force does nothing with --live"),
        (["--live", "--participants", "3"], "--participants does nothing with --live"),
        (["--kind", "validation"], "--kind does nothing without --live"),
        (["--step-seconds", "0.1"], "--step-seconds does nothing without --live"),
    ],
)
def test_options_of_the_other_kind_of_simulation_are_refused(capsys, monkeypatch, tmp_path, options, words):
    code, _, stderr = run(capsys, monkeypatch, "simulate", *options, "--out", tmp_path / "out")
    assert code == 2 and words in stderr and not list(tmp_path.iterdir())


@pytest.mark.parametrize("arguments", [["aggregate"], ["simulate", "--preset", "nobody", "--out", "x"], ["fly"]])
def test_bad_usage_ends_with_2(capsys, monkeypatch, tmp_path, arguments):
    monkeypatch.chdir(tmp_path)
    code, _, stderr = run(capsys, monkeypatch, *arguments)
    assert code == 2
    assert stderr
    assert not list(tmp_path.iterdir())


def test_force_replaces_nothing_but_results(capsys, monkeypatch, tmp_path):
    notes = tmp_path / "out" / "notes.txt"
    notes.parent.mkdir()
    notes.write_text("mine")
    (tmp_path / "out" / "result.json").write_text("{}")
    code, _, stderr = run(capsys, monkeypatch, "aggregate", *VIDEO, "--out", notes.parent, "--force")
    assert (code, notes.read_text()) == (2, "mine")
    assert "notes.txt: is not a result of hilbo's" in stderr
    code, _, stderr = run(capsys, monkeypatch, "aggregate", *VIDEO, "--out", notes, "--force")
    assert (code, notes.read_text()) == (2, "mine")
    assert "notes.txt: is a file" in stderr


@pytest.mark.deep
def test_simulate_keeps_what_it_simulated(capsys, monkeypatch, tmp_path):
    text = STUDY.replace("trials = 25", "trials = 6")
    (tmp_path / "short.toml").write_text(text)
    out = tmp_path / "out"
    arguments = ["simulate", "--participants", "2", "--study", tmp_path / "short.toml", "--out", out]
    code, _, stderr = run(capsys, monkeypatch, *arguments)
    assert code == 0 and stderr.count("The true optimum of the simulated participants is K1 = ") == 1
    assert (out / "study.toml").read_text() == text
    assert pd.read_csv(out / "truth.csv")["source"].tolist() == ["population", "individual:P01", "individual:P02"]
    content = json.loads((out / "result.json").read_text())
    assert set(content["truth"]["nrmse"]) == {"aggregate", "mean_of_optima", "average", "hierarchical", "pooled", "ep"}
    again = ["aggregate", out / "trials.csv", "--study", out / "study.toml", "--out", tmp_path / "again", "--json"]
    code, stdout, _ = run(capsys, monkeypatch, *again)
    assert code == 0
    assert json.loads(stdout)["optimum"] == content["optimum"]  # the table holds the same bits


@pytest.mark.deep
def test_no_optima_of_people_are_sought_if_they_are_not_wanted(capsys, monkeypatch, tmp_path):
    """The results above 1,000 participants, too, which have the same optimum, and nothing by other rules or after fewer
    trials."""
    few = ["--names", "V01,V02,V03", "--json"]
    out = tmp_path / "large"
    code, stdout, stderr = run(capsys, monkeypatch, "aggregate", *VIDEO, "--out", out, "--no-individuals", *few)
    assert code == 0 and "optima after fewer trials" not in stderr
    content = json.loads(stdout)
    assert [p["participant"] for p in content["participants"]] == ["V01", "V02", "V03"]
    assert all(p["optimum"] is None and p["certificate"]["converged"] for p in content["participants"])
    assert content["mean_of_optima"] is None and content["alternatives"] == {}
    page = " ".join((out / "report.html").read_text().split())
    assert "Individual optima were not computed" in page and page.count("data:image/png;base64,") == 1
    assert "Alternative estimates" not in page
    assert len(pd.read_csv(out / "optima.csv")) == 1
    small = json.loads(run(capsys, monkeypatch, "aggregate", *VIDEO, "--out", tmp_path / "small", *few)[1])
    assert content["optimum"]["unit"] == pytest.approx(small["optimum"]["unit"], abs=1e-6)
    assert content["optimum"]["mean"] == pytest.approx(small["optimum"]["mean"], abs=1e-11)
    with (
        xr.open_dataset(out / "map.nc", engine="h5netcdf") as one,
        xr.open_dataset(tmp_path / "small" / "map.nc", engine="h5netcdf") as other,
    ):
        assert float(abs(one["mean"] - other["mean"]).max()) < 1e-11


def options(group, path=()):
    """Every option of every command: the command, the option's names, its help."""
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from options(command, (*path, name))
        else:
            yield from (((*path, name), p.opts, p.help) for p in command.params if p.param_type_name == "option")


def test_every_option_says_what_it_does():
    unsaid = [(command, names) for command, names, text in options(typer.main.get_command(app)) if not text]
    assert not unsaid


def test_help_shows_the_names_of_tables(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    assert "[simulation]" in run(capsys, monkeypatch, "power", "--help")[1]
