"""`hilbo device` as a user types it, against the simulated device."""

import contextlib
import io
import json
import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pandas as pd
import pytest
from commands import run
from simulated import ENVIRONMENT, needs_device, own_cache  # noqa: F401

from hilbo.cli.device import screen
from hilbo.cli.device.screen import trace
from hilbo.device import messages
from hilbo.device.local.simulator import Simulator
from hilbo.study.tables.parameter_sets import read_sets

pytestmark = needs_device

A = ["--K0", -3.18, "--K1", 5.58, "--B1", 7.88, "--alpha", 0.176]
HILBO = [sys.executable, "-c", "from hilbo.cli.main import main; main()", "device"]
SETS = """set_id,source,K0,K1,B1,alpha,N,T
S,sysid,-2.89,5.70,5.89,0.203,101,0.001
A,aggregate,-3.18,5.58,7.88,0.176,101,0.001
V,average,-5.01,8.44,10.28,0.282,101,0.001
"""
FAST = ["--sim", "rate=lockstep"]
STUDY = "hilbo/data/paper.toml"


@pytest.fixture
def device(capsys, monkeypatch):
    """A function that runs `hilbo device …`: exit code, stdout, stderr."""
    return lambda *arguments: run(capsys, monkeypatch, "device", *arguments)


@pytest.fixture
def sets(tmp_path):
    path = tmp_path / "sets.csv"
    path.write_text(SETS)
    return path


def test_ports(device):
    code, stdout, _ = device("ports", "--json")
    assert code == 0
    assert all({"name", "description"} == set(port) for port in json.loads(stdout))


def test_hello(device):
    code, stdout, stderr = device("hello", "--json", *FAST)
    assert "this is the simulated device; --device PORT is a real one." in stderr
    said = json.loads(stdout)
    assert (code, said["version"], said["in_force"]) == (0, 2, None)
    assert said["damping_N_s_per_m"] == pytest.approx(0.95)
    assert said["limits"]["K1"][1] == 64 and "simulated" in said["can"]
    assert "damping_N_s_per_m          0.95" in device("hello", *FAST)[1]


def test_set(device, sets):
    code, stdout, _ = device("set", *A, "--json", *FAST)
    in_force = json.loads(stdout)
    assert (code, in_force["K1"], in_force["memory"]) == (0, float(np.float32(5.58)), "short")
    code, stdout, _ = device("set", "--sets", sets, "--set", "S", *FAST)
    assert code == 0 and "K1 = 5.7 N/mm" in stdout
    code, stdout, _ = device("set", *A[2:], "--study", STUDY, "--json", *FAST)  # K0 from the study's K_eff
    assert json.loads(stdout)["needs"] == pytest.approx(0.75981, abs=1e-5)


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["set"], 2, "No set is given"),
        (["set", "--K1", "5"], 2, "--B1 is missing"),
        (["set", *A[:2], "--K1", "30", *A[4:]], 2, "damping and the device has 0.95; lower K1"),
        (["set", *A, "--N", "100"], 2, "N is even"),
        (["set", *A, "--T", "0.002"], 2, "a set belongs to its T"),
        (["set", *A, "--memory", "long"], 2, 'memory is "long"'),
        (["set", *A, "--damping", "2"], 2, "assumes 2 N.s/m of damping and the device has 0.95"),
        (["set", *A, "--device", "/dev/hilbo-nothing"], 2, "there is no such port"),
        (["set", "--sets", "sets.csv"], 2, "contains the sets S, A, V; choose one with --set"),
        (["set", "--sets", "sets.csv", "--set", "X"], 2, 'contains no set "X"'),
        (["set", "--sets", "none.csv"], 2, "none.csv: cannot be read"),
        (["start"], 1, "The device has no active set; send one first."),
        (["stop"], 2, "--device is missing"),
        (["estop", "--device", "sim"], 2, "would stop a new simulated device, and nothing that moves"),
        (["hello", "--sim", "finger"], 2, "write KEY=VALUE"),
        (["hello", "--sim", "finger=thumb"], 2, "--finger thumb makes no sense"),
        (["hello", "--baud", "0"], 2, "--baud"),
        (["hello", "--study", "study.toml"], 2, "study.toml"),
        (["decode", "none.bin"], 2, "none.bin: cannot be read"),
        (["record", "sets.csv"], 2, "exists already"),
        (["record", "no/where.csv"], 2, "cannot be written"),
        (["characterise", "t.csv", "--repeats", "0"], 2, "--repeats"),
        (["feel", "none.csv"], 2, "cannot be read"),
        (["measure-damping", "--sim", "line-rate=57600"], 1, "every 4th tick, and damping needs all of them"),
        (["characterise", "t.csv", "--rest", "nan"], 2, "must be above 0"),
        (["simulate", "--device", "/dev/null"], 2, "leave --device out"),
    ],
)
def test_bad_input_is_one_sentence(device, tmp_path, monkeypatch, arguments, code, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sets.csv").write_text(SETS)
    status, stdout, stderr = device(*arguments)
    assert (status, stdout) == (code, "")
    assert words in " ".join(stderr.split())
    assert [path.name for path in tmp_path.iterdir()] == ["sets.csv"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("set_id,K1,B1\n", 'column "alpha" is missing'),
        ("set_id,K1,B1,alpha\n", "has no rows"),
        ("set_id,K1,B1,alpha\nA,1,2,x\n", 'sets.csv:2: alpha is "x"; it must be a finite number'),
        ("set_id,K1,B1,alpha,N\nA,1,2,0.5,1.5\n", "N is"),
        ("set_id,K1,B1,alpha\nA,1,2,0.5\nA,1,2,0.5\n", "is there already"),
        ("set_id,K1,B1,alpha\nA,1,2\n", "has 3 cells, the header has 4"),
        ("set_id,K1,B1,alpha\nA,1,2,\n", 'alpha is ""'),
    ],
)
def test_a_bad_sets_table_is_one_sentence(device, sets, text, words):
    sets.write_text(text)
    code, _, stderr = device("feel", sets)
    assert code == 2 and words in stderr


def test_a_sets_table_may_leave_things_out(sets):
    sets.write_text("set_id,K1,B1,alpha,memory,note\nA,1,2,0.5,full,hello\nB,2,3,0.25,,\n")
    assert read_sets(sets) == {
        "A": {"K1": 1.0, "B1": 2.0, "alpha": 0.5, "memory": "full", "note": "hello"},
        "B": {"K1": 2.0, "B1": 3.0, "alpha": 0.25},
    }


def test_start_renders_and_stops(device):
    code, stdout, stderr = device("start", *A, "--seconds", 1.5, "--json", *FAST)
    summary = json.loads(stdout)
    assert (code, summary["state"]) == (0, "RUNNING")
    assert summary["largest_force_N"] > 0.1 and summary["holds"] == 0
    assert "in force: K0 = -3.18" in stderr


def test_a_device_that_goes_to_hold_is_a_failure(device, monkeypatch):
    from hilbo.hardware_bridge import Renderer

    begin = Renderer.start

    def start(self, **_):
        begin(self)
        self.simulator.tell("bad 5")

    monkeypatch.setattr(Renderer, "start", start)
    code, stdout, stderr = device("start", *A, "--json", *FAST)  # ends without --seconds
    assert (code, json.loads(stdout)["state"]) == (1, "HOLD")
    assert "The device has gone to HOLD by itself: too many positions were bad" in " ".join(stderr.split())


def test_monitor(device):
    code, stdout, _ = device("monitor", "--seconds", 0.2, "--json", *FAST)
    assert (code, json.loads(stdout)["state"]) == (0, "STOPPED")


def test_what_was_recorded_stays_when_the_device_is_gone_or_somebody_ends_it(device, tmp_path, monkeypatch):
    from hilbo.hardware_bridge import DeviceError, Renderer

    real = Renderer.samples
    for error, code, words in (
        (DeviceError("The line is gone."), 1, "samples until then"),
        (KeyboardInterrupt(), 0, ""),
    ):
        calls = []

        def samples(self, seconds, error=error, calls=calls):
            calls.append(seconds)
            if len(calls) > 3:
                raise error
            return real(self, seconds)

        monkeypatch.setattr(Renderer, "samples", samples)
        out = tmp_path / f"{code}.csv"
        status, _, stderr = device("record", out, *A, "--seconds", 5, *FAST)
        assert status == code and words in " ".join(stderr.split())
        ticks = pd.read_csv(out)["tick"]
        assert 2000 <= len(ticks) < 5000 and set(ticks.diff().dropna()) == {1}


def test_record_and_decode(device, tmp_path):
    out, capture = tmp_path / "record.csv", tmp_path / "capture.bin"
    code, _, _ = device("record", out, *A, "--seconds", 0.5, "--capture", capture, *FAST)
    table = pd.read_csv(out)
    assert code == 0 and len(table) >= 500
    assert list(table) == ["tick", "time_s", "position_mm", "force_N", "sensed_N", "flags"]
    assert device("record", out, *A, "--seconds", 0.1, "--capture", capture, *FAST)[0] == 2
    assert device("record", out, *A, "--seconds", 0.1, "--force", *FAST)[0] == 0
    assert "exists" in device("hello", "--capture", capture, *FAST)[2]
    with open(capture, "ab") as file:
        file.write(b"\0\x09??\0")  # the command may have ended within a frame
    code, stdout, _ = device("decode", capture, "--json")
    rows = json.loads(stdout)
    assert code == 0
    assert {"HELLO_REPLY", "STATUS", "SET", "ACK", "TELEMETRY", "NOTICE"} <= {row["message"] for row in rows}
    assert rows[-1] == {
        "byte": capture.stat().st_size - 4,
        "seq": None,
        "message": None,
        "wrong": "no COBS: a run ends beyond the frame, or has no length",
    }
    stdout = device("decode", capture)[1]
    assert "HELLO_REPLY" in stdout and "?  no COBS" in stdout
    assert len(stdout.splitlines()) == len(rows)


def test_selftest(device):
    code, stdout, _ = device("selftest", "--echoes", 50, "--json", *FAST, "--sim", "finger=none")
    assert (code, json.loads(stdout)["passed"]) == (0, True)


def test_feel_with_keys_from_a_pipe(device, sets, monkeypatch):
    monkeypatch.setattr(sys, "stdin", io.StringIO("1 2\n3ec q"))
    code, stdout, stderr = device("feel", sets, "--json", *FAST, "--sim", "finger=none")
    summary = json.loads(stdout)
    assert (code, summary["felt"], summary["state"]) == (0, ["S", "A"], "RUNNING")
    assert any("The set needs 1.34" in word for word in summary["words"])
    assert summary["estops"] == 1
    assert "STOPPED" in stderr


def test_feel_starts_when_the_handle_has_left_the_surface(device, sets, monkeypatch):
    """The start is asked for once, with the handle in the material."""
    monkeypatch.setattr(sys, "stdin", io.StringIO("1 111111"))
    code, stdout, _ = device("feel", sets, "--json", *FAST, "--sim", "finger=tap")
    assert (code, json.loads(stdout)["state"]) == (0, "RUNNING"), stdout


def test_feel_takes_as_many_sets_as_there_are_keys(device, sets):
    rows = "".join(f"s{n},1,2,0.5\n" for n in range(10))
    sets.write_text(f"set_id,K1,B1,alpha\n{rows}")
    code, _, stderr = device("feel", sets, *FAST)
    assert code == 2 and "There are 10 sets" in stderr


def test_measure_damping(device):
    code, stdout, stderr = device("measure-damping", "--json", "--sim", "damping=0.8")
    assert code == 0, stderr
    estimates = json.loads(stdout)
    assert estimates["damping"]["lower"] <= 0.8 <= estimates["damping"]["upper"]
    assert estimates["reported"] == pytest.approx(0.8)


def test_characterise(device, tmp_path):
    out = tmp_path / "tests.csv"
    code, stdout, _ = device("characterise", out, "--repeats", 1, "--hold", 0.4, "--rest", 0.3)
    assert code == 0 and "hilbo identify" in stdout and "--damping 0.95" in stdout
    table = pd.read_csv(out)
    assert list(table) == ["test", "repeat", "time_s", "position_mm", "force_N"]
    assert table["position_mm"].max() > 4


@pytest.fixture
def staying():
    """Options for a simulated device that stays; its time stands still while no heartbeats come."""
    simulator, over = Simulator(rate="lockstep"), threading.Event()

    def pass_time():
        while not over.wait(0.001):
            late = int(simulator.ticks(0).split()[3]) >= 150
            simulator.ticks(0 if late else 5)

    thread = threading.Thread(target=pass_time)
    thread.start()
    yield ["--device", simulator.port, "--patience", 60]
    over.set()
    thread.join()
    simulator.close()


def test_a_device_that_stays_serves_one_command_after_another(device, staying):
    assert device("set", *A, *staying)[0] == 0
    assert device("hello", *staying, "--json")[1].count('"needs"') == 1
    assert device("estop", *staying)[0] == 0
    _, stdout, stderr = device("monitor", *staying, "--seconds", 0.1, "--json")
    assert "The device is in ESTOP" in stderr and json.loads(stdout)["estops"] == 1
    assert device("clear", *staying)[:2] == (0, "the device is STOPPED\n")
    assert device("stop", *staying)[:2] == (0, "done\n")
    command = [*HILBO, "start", *map(str, staying)]
    running = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=ENVIRONMENT)
    while "tick" not in running.stderr.readline():
        pass  # where the finger presses it is asked to leave first
    assert "another program uses this port" in device("hello", *staying)[2]
    running.send_signal(signal.SIGTERM)
    assert running.wait() == 143
    running.stderr.close()
    _, stdout, _ = device("monitor", *staying, "--seconds", 0.1, "--json")
    assert (json.loads(stdout)["state"], json.loads(stdout)["holds"]) == ("STOPPED", 0)  # it was told to stop


def test_simulate_names_its_port_and_ends_with_ctrl_c(device):
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # tests in a shell's background ignore it
    stays = subprocess.Popen([*HILBO, "simulate"], stdout=subprocess.PIPE, text=True, env=ENVIRONMENT)
    signal.signal(signal.SIGINT, before)
    port = stays.stdout.readline().strip()
    assert device("hello", "--device", port, "--patience", 60)[0] == 0
    stays.send_signal(signal.SIGINT)
    assert stays.wait() == 0
    stays.stdout.close()


def test_keys_from_a_terminal(device, sets):
    """The keys of a real terminal, in cbreak mode, which is as it was afterwards."""
    termios = pytest.importorskip("termios")
    master, slave = os.openpty()
    before = termios.tcgetattr(slave)
    command = [*HILBO, "feel", str(sets), *FAST]
    feels = subprocess.Popen(command, stdin=slave, stdout=slave, stderr=slave, env=ENVIRONMENT | {"TERM": "xterm"})
    said = bytearray()

    def listen():
        with contextlib.suppress(OSError):
            while True:
                said.extend(os.read(master, 4096))

    thread = threading.Thread(target=listen, daemon=True)
    thread.start()
    try:
        for key, words in ((b"1", b"is active"), (b" ", b"RUNNING")):
            _type_until(master, key, words, said)
        os.write(master, b"q")
        assert feels.wait(60) == 0
    finally:
        feels.kill()
    assert termios.tcgetattr(slave)[3] == before[3]
    os.close(slave)
    thread.join(5)
    os.close(master)


def test_a_terminal_that_is_closed_ends_the_command():
    """Without this the device would move without an operator."""
    pytest.importorskip("termios")
    master, slave = os.openpty()
    assert list(screen._waiting(slave)) == []
    os.close(master)
    assert list(screen._waiting(slave)) == ["q"]
    os.close(slave)


def _type_until(master, key, words, said):
    deadline, typed = time.monotonic() + 60, 0.0
    while words not in said:
        assert time.monotonic() < deadline, said[-2000:]
        if b"force" in said and time.monotonic() - typed > 5:
            os.write(master, key)
            typed = time.monotonic()
        time.sleep(0.05)


def test_a_trace_shows_the_largest_excursions():
    assert trace([0, 1, 2, 4, 0], 5) == " ▂▄█ "
    assert trace([], 4) == "    "
    assert trace([0.0] * 10 + [-1.0] + [0.0] * 10, 3) == "█ █"


def test_every_message_of_a_capture_can_be_shown():
    from hilbo.cli.device.output import _field

    assert _field((messages.Exponential(0.5, 0.25),)) == "(0.5,0.25)"
    assert _field(b"\x01\xff") == "01ff"
