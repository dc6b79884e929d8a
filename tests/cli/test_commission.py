"""`hilbo device home` and `commission` as a user types them, and what the other commands tell of a new device."""

import io
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from commands import run
from simulated import needs_device, own_cache  # noqa: F401

from hilbo.cli.device.commission import PHRASE
from hilbo.device.config_header import header, with_measured
from hilbo.device.messages import HelloReply, Limits
from hilbo.errors import InputError
from hilbo.hardware_bridge import Renderer
from hilbo.identification.motor import commissioning
from hilbo.identification.motor.friction import Friction, Interval

pytestmark = needs_device

CORE = Path(__file__).parents[2] / "firmware" / "core"
FAST = ["--sim", "rate=lockstep", "--sim", "finger=none"]
NEW = ["--sim", "not-homed=yes"]
SCRIPT = ["--no-hand-on-the-handle", PHRASE, "--encoder-checked", "--position", -1]
CHECK = """#include <stdio.h>
#include "hilbo_device_config.h"
int main(void)
{
    const struct hb_config *config = &HILBO_DEVICE_CONFIG;
    double damping = config->damping_N_s_per_m;
    printf("%d %.9g %lu\\n", hb_config_check(config), damping, (unsigned long)config->delay_us);
    return 0;
}
"""


@pytest.fixture
def device(capsys, monkeypatch, tmp_path):
    """A function that runs `hilbo device …` in a new folder: exit code, stdout, stderr."""
    monkeypatch.chdir(tmp_path)
    return lambda *arguments: run(capsys, monkeypatch, "device", *arguments)


@pytest.fixture
def measured(monkeypatch):
    """The measurement of damping, of some seconds, is left out."""
    friction = Friction(Interval(0.95, 0.9421, 0.96), *(Interval(0.3, 0.2, 0.4),) * 3, 0.01, 96, 24)
    monkeypatch.setattr(commissioning, "measure_damping", lambda *_: friction)


class Typed(io.StringIO):
    """What a person types on a terminal."""

    def isatty(self):
        return True


def compiled(folder):
    """hb_config_check, damping and delay of the header in a folder, from a program that a C compiler makes."""
    (folder / "check.c").write_text(CHECK)
    compiler = next(filter(shutil.which, ("cc", "gcc", "clang")))
    flags = ["-std=c11", "-Wall", "-Wextra", "-Wconversion", "-Werror", f"-I{CORE}", f"-I{folder}"]
    sources = [str(folder / "check.c"), *(str(CORE / name) for name in ("hb_config.c", "hb_math.c"))]
    subprocess.run([compiler, *flags, *sources, "-o", str(folder / "check"), "-lm"], check=True)
    return subprocess.run([folder / "check"], capture_output=True, text=True, check=True).stdout.split()


def test_hello_and_monitor_tell_whether_a_device_is_homed(device):
    code, stdout, _ = device("hello", "--json", *FAST, *NEW, "--sim", "delay=150")
    content = json.loads(stdout)
    assert code == 0 and not content["homed"] and not content["stop_open"]
    assert (content["delay_us"], content["continuous_force_N"], content["heating_s"]) == (150, 20, 10)
    stdout = device("hello", *FAST, *NEW)[1]
    for words in (
        "homed                      no; set its position with `hilbo device home`",
        "hardware stop              closed",
        "delay                      sets are checked for 0 us",
        "continuous force           20 N (root mean square over 10 s)",
    ):
        assert words in stdout
    _, stdout, stderr = device("monitor", "--seconds", 0.1, "--json", *FAST, *NEW)
    assert "not homed" in stderr and json.loads(stdout)["homed"] is False
    _, stdout, stderr = device("monitor", "--seconds", 0.1, "--json", *FAST)
    assert "not homed" not in stderr and json.loads(stdout)["homed"] is True


def test_monitor_tells_that_the_hardware_stop_is_open(device, monkeypatch):
    stream = Renderer.stream

    def opens(self, *divisor, **sensed):
        self.simulator.tell("stop open")
        return stream(self, *divisor, **sensed)

    monkeypatch.setattr(Renderer, "stream", opens)
    _, stdout, stderr = device("monitor", "--seconds", 0.1, "--json", *FAST)
    assert "the hardware stop is open" in stderr and json.loads(stdout)["stop_open"]


def test_home(device):
    code, stdout, _ = device("home", "--position", 0, *FAST, *NEW)
    assert (code, stdout) == (0, "homed: the handle is at 0 mm\n")
    assert device("home", *FAST, *NEW)[0] == 2
    code, _, stderr = device("home", "--position", 30, *FAST, *NEW)
    assert code == 2 and "HOME asks for 30, beyond the device's limit of 20.1" in stderr


def test_a_motor_wired_the_other_way_ends_it_after_one_nudge(device, tmp_path, monkeypatch):
    """With less energy than the bound states, both as work of the motor and as the handle's movement."""
    seen, drives, samples, drive = [], [], Renderer.samples, Renderer.drive

    def reading(self, seconds=1.0):
        seen.append(samples(self, seconds))
        return seen[-1]

    def driving(self, *way, **times):
        drives.append(way)
        return drive(self, *way, **times)

    monkeypatch.setattr(Renderer, "samples", reading)
    monkeypatch.setattr(Renderer, "drive", driving)
    code, stdout, stderr = device("commission", *SCRIPT, *NEW, "--sim", "inverted=yes")
    assert (code, stdout) == (1, "") and list(tmp_path.iterdir()) == []
    assert "the motor pushes the wrong way: 0.3 N inwards moved the handle by" in stderr
    assert "swap the motor's two wires, or change motor_sign" in stderr
    assert [way[:3] for way in drives] == [("force", "nudge", 0.3)]
    position, force = (np.concatenate([getattr(piece, name) for piece in seen]) for name in ("position_mm", "force_N"))
    work = np.cumsum(force[:-1] * np.diff(position))  # a positive command of this motor pushes inwards
    speed = (position[8:] - position[:-8]) / 8e-3 / 1e3  # m/s
    assert 0.05 < work.max() < 0.15 and 0.5 * 0.3 * np.max(speed**2) * 1e3 < 0.15


def test_a_header_that_compiles_and_that_the_core_accepts(device, tmp_path, measured):
    code, stdout, stderr = device("commission", *SCRIPT, *NEW, "--sim", "delay=150", "--json")
    content = json.loads(stdout)
    assert code == 0 and content["file"] == "hilbo_device_config.h"
    assert content["delay_us"] == {"longest": 150, "header": 200, "reported": 150}
    assert compiled(tmp_path) == ["0", f"{np.float32(0.9421):.9g}", "200"]
    assert "is configured with 0.95 N.s/m of damping but may have only 0.9421" in stderr
    assert "delay_us of 150 has less margin" in stderr
    code, _, stderr = device("commission", *SCRIPT, *NEW)
    assert code == 2 and "exists already" in stderr
    code, stdout, _ = device("commission", *SCRIPT, *NEW, "--force")
    assert code == 0 and "0.9421 in the header (the device: 0.95)" in stdout
    assert compiled(tmp_path)[2] == "50"


@pytest.mark.deep
def test_commission_with_its_own_measurement(device, tmp_path):
    code, stdout, _ = device("commission", *SCRIPT, *NEW, "--sim", "damping=0.8", "--json")
    damping = json.loads(stdout)["damping"]
    assert code == 0 and damping["lower"] <= 0.8 <= damping["upper"]
    error, written, _ = compiled(tmp_path)
    assert error == "0" and damping["lower"] - 1e-3 < float(written) <= damping["lower"]


def test_a_person_confirms_at_the_terminal(device, tmp_path, measured, monkeypatch):
    monkeypatch.setattr(sys, "stdin", Typed(f"{PHRASE}\n\n{PHRASE}\n"))
    code, _, stderr = device("commission", "--encoder-checked", *NEW)
    assert code == 0 and stderr.count(f'then type "{PHRASE}"') == 2 and "Place the handle at the surface" in stderr
    assert compiled(tmp_path)[0] == "0"


def test_a_person_pushes_the_handle(device, measured, monkeypatch):
    opened = []
    begin = Renderer.open.__func__

    def opening(kind, *where, **options):
        opened.append(begin(kind, *where, **options))
        return opened[-1]

    class Hand(Typed):
        def readline(self, *size):
            opened[0].simulator.tell("finger none")
            return super().readline(*size)

    monkeypatch.setattr(Renderer, "open", classmethod(opening))
    monkeypatch.setattr(sys, "stdin", Hand(f"{PHRASE}\n\n{PHRASE}\n"))
    code, _, stderr = device("commission", *NEW, "--sim", "finger=hold")
    assert code == 0, stderr
    assert "Now push the handle in by hand" in stderr


@pytest.mark.parametrize(
    ("typed", "options", "words"),
    [
        (None, [], "A person must confirm that no hand is on the handle"),
        (
            None,
            ["--no-hand-on-the-handle", "yes"],
            '--no-hand-on-the-handle is "yes"; the device moves only after exactly',
        ),
        (None, ["--no-hand-on-the-handle", PHRASE], "then add --encoder-checked"),
        (None, SCRIPT[:3], "give the current position of its handle with --position"),
        (None, [*SCRIPT, "--out", "no/where.h"], "cannot be written"),
        (None, [*SCRIPT, "--base", "none.h"], "none.h: cannot be read"),
        ("ok\n", ["--encoder-checked"], 'The answer is "ok"; the device moves only after exactly'),
        ("", ["--encoder-checked"], 'The answer is ""'),
        (f"{PHRASE}\n", ["--encoder-checked"], "The handle was not placed at the surface"),
        ("", ["--position", 0], "--position is for scripts"),
    ],
)
def test_nothing_moves_before_somebody_has_confirmed(device, tmp_path, monkeypatch, typed, options, words):
    drives, drive = [], Renderer.drive
    monkeypatch.setattr(Renderer, "drive", lambda self, *way, **times: (drives.append(way), drive(self, *way, **times)))
    monkeypatch.setattr(sys, "stdin", io.StringIO() if typed is None else Typed(typed))
    code, stdout, stderr = device("commission", *options, *NEW)
    assert (code, stdout) == (2, "") and words in " ".join(stderr.split())
    assert list(tmp_path.iterdir()) == [] and (drives == [] or "placed" in words)


@pytest.mark.parametrize(
    ("friction", "delay", "words"),
    [
        (Interval(0.01, -0.01, 0.03), 0, "is not significantly above 0"),
        (Interval(0.95, 0.94, 0.96), 950, "with its margin 1190 us, longer than a tick"),
    ],
)
def test_numbers_that_no_header_may_have_are_one_sentence(device, tmp_path, monkeypatch, friction, delay, words):
    rest = (Interval(0.3, 0.2, 0.4),) * 3
    monkeypatch.setattr(commissioning, "measure_damping", lambda *_: Friction(friction, *rest, 0.01, 96, 24))
    code, _, stderr = device("commission", *SCRIPT, *NEW, "--sim", f"delay={delay}")
    assert code == 1 and words in " ".join(stderr.split()) and list(tmp_path.iterdir()) == []


BASE = """/* of a board */
static const struct hb_config HILBO_DEVICE_CONFIG = {
    .delay_us = 400,
    .damping_N_s_per_m = 0.3F, /* a guess */
    .encoder_step_mm = 80.0F / 8192.0F,
};
static const struct settings HILBO_SETTINGS = {.motor_sign = 1};
"""


def test_the_header_of_a_board_keeps_what_commissioning_does_not_measure(device, tmp_path, measured):
    (tmp_path / "board.h").write_text(BASE)
    simulated = ["--sim", "delay=400", "--sim", "damping=0.3"]
    assert device("commission", *SCRIPT, *NEW, *simulated, "--base", "board.h")[0] == 0
    expected = BASE.replace("400", "500").replace("0.3F", "0.9421F")
    assert (tmp_path / "hilbo_device_config.h").read_text() == expected


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("0.3F", "0.4F"), ".damping_N_s_per_m is 0.4 and the device reports 0.3"),
        ((".delay_us = 400,", ""), "has 0 lines with .delay_us = NUMBER"),
        (("400", "4 * 100"), "has 0 lines with .delay_us = NUMBER"),
    ],
)
def test_the_header_of_another_device_is_refused(change, words):
    about, limits = described(damping_N_s_per_m=0.3), limited(delay_us=400)
    with pytest.raises(InputError) as error:
        with_measured(BASE.replace(*change), "board.h", about, limits, 0.9, 500)
    assert words in str(error.value)


def described(**numbers):
    """A device, as HELLO tells it."""
    floats = {name: 1.0 for name in HelloReply.__slots__ if "_mm" in name or "_N" in name}
    whole = {name: 1 for name in HelloReply.__slots__ if name not in floats}
    return HelloReply(**(whole | floats | {"velocity_limit_mm_per_s": 500.0, "tick_rate_Hz": 1000} | numbers))


def limited(**numbers):
    return Limits(**({name: 1.0 for name in Limits.__slots__} | {"delay_us": 400} | numbers))


def test_numbers_of_a_header_are_those_of_binary32_and_damping_is_never_rounded_up():
    text = header(described(encoder_step_mm=float(np.float32(0.0127)), capabilities=0), limited(), 0.1, 400, "", "")
    assert ".encoder_step_mm = 0.0127F" in text and ".capabilities = 0," in text
    written = float(text.split(".damping_N_s_per_m = ")[1].split("F")[0])
    assert np.float32(written) <= 0.1 < np.nextafter(np.float32(written), np.float32(1))
