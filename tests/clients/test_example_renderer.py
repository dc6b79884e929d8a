"""The examples that render by themselves, with the renderer library and a simulated motor, in sessions of the real
server: a whole session, and a trial in which the program hangs for a moment."""

import contextlib
import os
import signal
import subprocess
import sys
import time

import pytest
from device_port import FIRMWARE, program
from live_stimulus import CLIENTS, LiveStimulus, all_answered
from simulated import ENVIRONMENT, needs_device, own_cache  # noqa: F401

from hilbo.device.local.motor import SimulatedMotor
from hilbo.study.file.plan_file import Block, Planned

pytestmark = [pytest.mark.deep, needs_device]
RENDERED = {
    "best": {"K1": 0.3, "B1": 0.4, "alpha": 0.25},
    "mid": {"K1": 0.4, "B1": 0.5, "alpha": 0.35},
    "worst": {"K1": 0.5, "B1": 0.3, "alpha": 0.45},
}
BLOCKS = (Block("warm-up", 3, tuple(Planned(name) for name in RENDERED)),)
PARAMETERS = "".join(
    f'[parameters.{name}]\nlow = {low}\nhigh = {high}\nunit = "{unit}"\n'
    for name, low, high, unit in (
        ("K1", 0.2, 0.6, "N/mm"),
        ("B1", 0.2, 0.6, "N.s^alpha/mm"),
        ("alpha", 0.1, 0.5, "1"),
    )
)

# Python keeps 1 kHz on a quiet computer only, which one that runs other tests beside is not.
LANGUAGES = ["c++", pytest.param("python", marks=pytest.mark.release)]


class LiveMaterial(LiveStimulus):
    """A study of K1, B1 and alpha, which a program presents."""

    def make_study(self, seconds, warm_up):
        before, _, rest = self.text.partition("[parameters.hue]")
        self.text = before + PARAMETERS + rest[rest.index("[gp]") :].replace("tolerance = {hue = 0.5}\n", "")
        return super().make_study(seconds, warm_up)

    def sets(self):
        return RENDERED


@pytest.fixture(scope="module")
def example(tmp_path_factory):
    """The commands of the two examples, without motor and link."""
    library = program("libhilbo_renderer.so")
    made = tmp_path_factory.mktemp("built") / "example_renderer"
    words = ["g++", "-std=c++11", "-Wall", "-Wextra", "-Werror", "-pedantic", "-pthread", f"-I{FIRMWARE}/port/library"]
    words += [str(CLIENTS / "example_renderer.cpp"), str(library), f"-Wl,-rpath,{library.parent}", "-o", str(made)]
    subprocess.run(words, check=True)
    return {"c++": [str(made)], "python": [sys.executable, str(CLIENTS / "example_renderer.py")]}


class Running:
    """An example, with its motor where it does not start one itself."""

    def __init__(self, command, link, folder):
        self.motor = SimulatedMotor("all") if command[0] != sys.executable else None
        words = [*command, *([str(self.motor.file)] if self.motor else []), link]
        self.err = folder / "program.err"
        with open(self.err, "w") as err:
            self.process = subprocess.Popen(words, stderr=err, env=ENVIRONMENT)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.wait()
        if self.motor:
            self.motor.close()


@pytest.mark.parametrize("language", LANGUAGES)
def test_it_renders_a_whole_session(language, example, tmp_path):
    with LiveMaterial(tmp_path, blocks=BLOCKS, silence=2.0, within=20.0) as live, contextlib.ExitStack() as stack:
        stack.enter_context(Running(example[language], live.link(), tmp_path))
        sent = all_answered(live)
    answered = [data["values"] for data in sent]
    assert all(values in answered for values in RENDERED.values())
    assert all(data["force"] and data["program"].startswith("example_renderer") for data in sent)


@pytest.mark.parametrize("language", LANGUAGES)
def test_a_trial_in_which_it_hung_is_void_and_comes_again(language, example, tmp_path):
    with LiveMaterial(tmp_path, blocks=BLOCKS, silence=5.0, within=20.0, seconds=1.5) as live:
        with Running(example[language], live.link(), tmp_path) as running:
            live.until(lambda v: v["device"]["state"] == "stopped", live.whole)
            live.begin()
            live.until(lambda _: live.events("stimulus"), lambda: None)
            os.kill(running.process.pid, signal.SIGSTOP)
            time.sleep(0.1)
            os.kill(running.process.pid, signal.SIGCONT)
            live.until(lambda _: "neutral: " in running.err.read_text(), lambda: None)
            all_answered(live)
        state = live.replayed()
    assert "a tick was missed" in running.err.read_text()
    assert sum(trial.status == "answered" for trial in state.trials) == 3
    assert any("taken over" in str(trial.voided) for trial in state.trials if trial.status == "void")
