"""A command loads what it uses: no JAX where nothing is computed, the mechanics alone where that is all it computes."""

import json
import subprocess
import sys

import pytest
from live import Driver
from simulated import ENVIRONMENT, ROOT, needs_device

from hilbo.session.log.event_log import EventLog
from hilbo.session.log.log_files import log_name
from hilbo.session.plan.plan import make_plan
from hilbo.study.file.plan_file import plan_text
from hilbo.study.file.reading import StudyFile

PAPER = str(ROOT / "hilbo" / "data" / "paper.toml")
PLAIN = """\
schema = 1
[study]
name = "plain"
responses = ["different", "similar", "close"]
[parameters]
u = {low = 0.0, high = 1.0}
v = {low = 0.0, high = 1.0}
[gp]
theta = 10.0
variance = 1.0
thresholds = [-0.5, 0.5]
noise = 0.5
[selection]
space_filling = 2
trials = 6
"""
A_SET = ("--K1", 5.58, "--B1", 7.88, "--alpha", 0.176)
TABLES = ["pandas", "pyarrow", "xarray"]
HEAVY = ["arviz", "equinox", "jax", "jinja2", "matplotlib", "optimistix", "scipy", "statsmodels"]
COMMANDS = """
import json, sys
from hilbo.cli.main import main

*commands, watched = json.loads(sys.argv[1])
for command in commands:
    sys.argv = ["hilbo", *command]
    try:
        main()
    except SystemExit as stopped:
        print("\\nLOADED", json.dumps([stopped.code or 0, sorted(set(watched) & set(sys.modules))]))
"""
DOCTOR = """
import itertools, pathlib, sys
from hilbo.cli.doctor import checks
from hilbo.errors import InputError

def connect(damping, delay):
    raise InputError("there is none")

print(*(check.name for check in itertools.islice(checks(pathlib.Path(sys.argv[1]), connect, pathlib.Path(), 0), 7)))
print("jax" in sys.modules)
"""


def process(code, *arguments):
    """What a process of its own says."""
    command = [sys.executable, "-c", code, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, env=ENVIRONMENT)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def loaded(commands, watched):
    """After each of some commands in one process: its exit code, and what of the watched is loaded by then."""
    words = [[str(word) for word in command] for command in commands]
    lines = process(COMMANDS, json.dumps([*words, watched]))
    return [json.loads(line.removeprefix("LOADED ")) for line in lines if line.startswith("LOADED ")]


@pytest.fixture
def folder(tmp_path):
    """A study, a plan, and the log of one session."""
    (tmp_path / "study.toml").write_text(PLAIN)
    plan = make_plan(StudyFile.load(tmp_path / "study.toml"), ["P01", "P02"])
    (tmp_path / "plan.json").write_text(plan_text(plan))
    driver = Driver()
    driver.finish()
    with EventLog.create(tmp_path / "logs" / log_name(driver.header), driver.state.study, driver.header) as log:
        for event in driver.events:
            log.append(event)
    return tmp_path


def test_the_commands_themselves_load_no_arrays_and_no_device():
    code = "import sys, hilbo.cli.main; print([n for n in sys.modules if n.startswith(('numpy', 'hilbo.device'))])"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert run.stdout == "[]\n"


def test_where_nothing_is_computed_no_jax_is_loaded(folder):
    study, logs, plan = folder / "study.toml", folder / "logs", ("--out", folder / "plan.json")
    consent = ("--consent-time", "2026-05-04T10:15", "--protocol-number", "7")
    commands = {
        ("--version",): 0,
        ("--help",): 0,
        ("passivity", "--help"): 0,
        ("participants", "add", logs / "participants.csv", "P07", *consent): 0,
        ("participants", "delete", logs, "P07", "--yes"): 0,
        ("plan", study, "--participants", 3, "--kind", "dance"): 2,
        ("plan", study, "--participants", 3, *plan): 2,
        ("plan", study, "--reissue", "P02=P09", *plan): 0,
        ("device", "ports"): 0,
    }
    assert loaded(commands, HEAVY + TABLES) == [[code, []] for code in commands.values()]
    ((code, modules),) = loaded([("export", logs, "--study", study, "--out", folder / "tables")], HEAVY + TABLES)
    assert code == 0 and set(modules) <= set(TABLES)
    assert (folder / "tables" / "trials.nc").exists()


@needs_device
def test_a_device_is_spoken_to_without_jax():
    fast = ("--sim", "rate=lockstep", "--study", PAPER)
    commands = [("device", "hello", *fast), ("device", "set", "--K0", -3.18, *A_SET, *fast)]
    assert loaded(commands, HEAVY + TABLES) == [[0, []], [0, []]]


def test_the_doctor_looks_at_all_else_before_it_loads_jax():
    names, jax = process(DOCTOR, PAPER)
    assert names == "versions disk server's port browser serial ports study device"
    assert jax == "False"


def test_where_the_mechanics_are_computed_no_more_is_loaded(folder):
    watched = [*HEAVY, *TABLES, "hilbo.ordinal_gp", "hilbo.study.config"]
    commands = [("passivity", *A_SET, "--study", PAPER), ("plan", PAPER, "--participants", 2, "--out", folder / "p")]
    assert loaded(commands, watched) == [[0, ["equinox", "jax"]], [0, ["equinox", "jax"]]]
