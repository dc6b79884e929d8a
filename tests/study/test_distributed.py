"""Several devices and processes: the same results, and nobody left waiting when one of them stops."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from studies import population_answers

from hilbo.errors import InputError
from hilbo.study.estimate import distributed
from hilbo.study.tables.trials import write_trials

ROOT = Path(__file__).parents[2]
STUDY_FILE = """
schema = 1
[study]
name = "plain"
responses = ["bad", "fair", "good"]
[parameters.gain]
low = 1.0
high = 9.0
scale = "log"
[parameters.delay]
low = 0.0
high = 5.0
[gp]
theta = 5.0
variance = 1.3
thresholds = [-0.5, 0.5]
noise = 0.5
[selection]
trials = 6
space_filling = 2
"""
MAIN = "from hilbo.cli.main import main; main()"
DIES = """
import os, signal
import hilbo.study.analysis.cohort_results
hilbo.study.analysis.cohort_results.analyse_cohort = lambda *args, **more: os.kill(os.getpid(), signal.SIGKILL)
"""
FAILS = """
import hilbo.study.analysis.cohort_results
def fail(*args, **more):
    raise MemoryError("no room")
hilbo.study.analysis.cohort_results.analyse_cohort = fail
"""


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ((False, "here:1", None, None), "need --distributed"),
        ((True, "here", 2, 0), '--coordinator is "here"; it must be HOST:PORT'),
        ((True, "here:1", 2, 2), "--process-id is 2; it must be from 0 to 1"),
    ],
)
def test_wrong_options_are_refused(options, words):
    with pytest.raises(InputError, match=words), distributed.crew(*options):
        pass


def test_one_process_agrees_with_itself_and_passes_bad_input_on():
    with distributed.crew(False) as team:
        assert (team.rank, team.count, team.writes) == (0, 1, True)
        with team.agreement() as agree:
            agree(distributed.digest("study", 1, np.arange(3)))
        with pytest.raises(InputError, match="no such table"), team.agreement():
            raise InputError("no such table.")


def test_a_digest_knows_numbers_texts_and_their_places():
    parts = [
        ("a", np.arange(3)),
        ("b", np.arange(3)),
        ("a", np.arange(4)),
        (np.arange(3), "a"),
        ("a", np.zeros(3, int)),
    ]
    assert len({distributed.digest(*part) for part in parts}) == len(parts)
    assert distributed.digest("a", np.arange(3)) == distributed.digest("a", np.arange(3))


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "study.toml").write_text(STUDY_FILE)
    table = population_answers(13)
    table["response"] = np.array(["bad", "fair", "good"])[table.pop("category")]
    write_trials(table, tmp_path / "trials.csv")
    return tmp_path


def start(folder, out, *options, code=MAIN, trials="trials.csv", flags=""):
    """A process of `hilbo aggregate`, not yet waited for."""
    environment = os.environ | {
        "PYTHONPATH": str(ROOT),
        "XDG_CACHE_HOME": str(folder / "cache"),
        "JAX_PLATFORMS": "cpu",
    }
    environment |= {"XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {flags}"}
    command = ["aggregate", folder / trials, "--study", folder / "study.toml", "--out", folder / out, *options]
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, command)], env=environment, text=True, stderr=subprocess.PIPE
    )


def together(folder, out, count, codes=None, trials=None):
    """Exit codes and last words of so many processes that know of each other."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    crew = [
        start(
            folder,
            out,
            *("--distributed", "--coordinator", f"localhost:{port}", "--processes", count, "--process-id", rank),
            code=codes[rank] if codes else MAIN,
            trials=trials[rank] if trials else "trials.csv",
        )
        for rank in range(count)
    ]
    try:
        return [(process.communicate(timeout=900)[1], process.returncode) for process in crew]
    finally:
        for process in crew:
            process.kill()


def result(folder, out):
    content = json.loads((folder / out / "result.json").read_text())
    return content, xr.load_dataset(folder / out / "map.nc", engine="h5netcdf")


def assert_same(one, other):
    """The same people, the same map to 1e-12 of its scale, the same optima to what a search resolves."""
    (content, grid), (content_, grid_) = one, other
    for name in ("mean", "variance"):
        scale = float(abs(grid[name]).max())
        np.testing.assert_allclose(grid_[name], grid[name], rtol=0, atol=1e-12 * scale)
    for person, person_ in zip(content["participants"], content_["participants"], strict=True):
        assert person["participant"] == person_["participant"] and person["trials"] == person_["trials"]
        np.testing.assert_allclose(person_["optimum"]["unit"], person["optimum"]["unit"], atol=1e-7)
    np.testing.assert_allclose(content_["optimum"]["unit"], content["optimum"]["unit"], atol=1e-9)
    assert abs(content_["optimum"]["mean"] - content["optimum"]["mean"]) < 1e-12


@pytest.mark.deep
@pytest.mark.release
def test_two_and_four_processes_and_four_devices_give_the_map_of_one(folder):
    process = start(folder, "one", "--cores", 1, "--individuals", "--distributed", flags="")
    assert process.communicate(timeout=900) and process.returncode == 2  # nobody to be distributed with
    assert together(folder, "one", 1)[0][1] == 0
    expected = result(folder, "one")
    for count in (2, 4):
        ended = together(folder, f"p{count}", count)
        assert [code for _, code in ended] == [0] * count, ended
        assert_same(expected, result(folder, f"p{count}"))
        assert "report.html" in ended[0][0] and "report.html" not in ended[1][0]  # one process writes and reports
    process = start(folder, "d4", flags="--xla_force_host_platform_device_count=4")
    words = process.communicate(timeout=900)[1]
    assert process.returncode == 0, words
    assert_same(expected, result(folder, "d4"))


@pytest.mark.deep
def test_bad_input_of_one_process_stops_all(folder):
    text = (folder / "trials.csv").read_text().splitlines()
    (folder / "damaged.csv").write_text("\n".join([*text[:-1], text[-1].replace(text[-1].split(",")[0], "first")]))
    (first, code), (second, code_) = together(folder, "out", 2, trials=["trials.csv", "damaged.csv"])
    assert (code, code_) == (2, 2), (first, second)
    assert "process 1 of 2 refused its input" in first
    assert "damaged.csv:" in second and 'is "first"' in second
    (folder / "fewer.csv").write_text("\n".join(text[:-1]))
    ended = together(folder, "out", 2, trials=["trials.csv", "fewer.csv"])
    assert [code for _, code in ended] == [2, 2], ended
    assert "read different data" in ended[0][0]
    assert not (folder / "out").exists()


@pytest.mark.deep
@pytest.mark.parametrize(("broken", "rank"), [(DIES, 1), (FAILS, 1), (FAILS, 0)])
def test_no_process_waits_for_ever_for_one_that_died(folder, broken, rank):
    codes = [MAIN, MAIN]
    codes[rank] = broken + MAIN
    ended = together(folder, "out", 2, codes=codes)
    assert all(code != 0 for _, code in ended), ended
    if broken == FAILS:
        assert f"process {rank} of 2: MemoryError: no room" in ended[rank][0]
    assert not (folder / "out").exists()
