"""The client of each language, by its two examples, in sessions of the real server: a whole session, and neutral within
the stated time when the server is killed, or stopped so that it is silent."""

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from urllib.parse import urlsplit

import pytest
from client_programs import each_language, hung, sources
from cut_line import CutLine
from killed_session import PATIENCE, Session
from live_stimulus import CLIENTS, SETS, SINGLE, LiveLevels, LiveStimulus, all_answered

from hilbo.study.config import Study
from hilbo.study.template import NewStudy, parameter_of, study_text

pytestmark = [pytest.mark.deep, pytest.mark.skipif(sys.platform == "win32", reason="SIGKILL")]
SILENCE, OWN = 1.0, 0.05  # s: the study's, and what the examples state
FORCE = re.compile(r"^(\d+\.\d+) (force|neutral)$", re.MULTILINE)


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    return sources(tmp_path_factory.mktemp("built") / "clients")


class Running:
    """An example with a link; what it says, in the files `out` and `err`."""

    def __init__(self, command, folder):
        self.out, self.err = folder / "program.out", folder / "program.err"
        with open(self.out, "w") as out, open(self.err, "w") as err:
            self.process = subprocess.Popen(command, stdout=out, stderr=err)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.wait()

    def force(self):
        """When its loop set a force, or none: (s since 1970, whether there was one)."""
        return [(float(at), what == "force") for at, what in FORCE.findall(self.err.read_text())]


@each_language
def test_the_example_presents_a_whole_session_and_confirms_what_was_asked_for(language, built, tmp_path):
    command = language.build("example_patch", built)
    with LiveStimulus(tmp_path, blocks=SINGLE) as live, Running([*command, live.link()], tmp_path) as program:
        sent = all_answered(live)
    assert [data["values"] for data in sent] == list(SETS.values())
    assert all(data["program"].startswith("example_patch") and not data["force"] for data in sent)
    assert all(word in program.out.read_text() for word in ("Reference", "Test"))


@pytest.mark.parametrize("language", each_language.args[1][1:])  # the example in Python refuses other parameters
def test_the_example_confirms_a_level_that_it_does_not_know(language, built, tmp_path):
    command = language.build("example_patch", built)
    with LiveLevels(tmp_path, blocks=SINGLE) as live, Running([*command, live.link()], tmp_path):
        sent = all_answered(live)
    assert [data["values"] for data in sent] == list(live.sets().values())


@each_language
def test_an_example_that_was_killed_while_it_presented_goes_on_by_the_same_link(language, built, tmp_path):
    command = language.build("example_patch", built)
    with LiveStimulus(tmp_path, silence=1.0, seconds=1.5, blocks=SINGLE) as live:
        command = [*command, live.link()]
        with Running(command, tmp_path):
            live.until(lambda v: v["device"]["state"] == "stopped", live.whole)
            live.begin()
            live.until(lambda _: live.events("stimulus"), lambda: None)
        with Running(command, tmp_path):
            all_answered(live)
        state = live.replayed()
    assert sum(trial.status == "answered" for trial in state.trials) == 3
    assert any("has been silent" in str(trial.voided) for trial in state.trials if trial.status == "void")


# MATLAB's tcpclient does not say that its connection is closed: that client waits as long as for a silent server.
@pytest.mark.parametrize("language", [language for language in each_language.args[1] if language.id != "matlab"])
def test_after_a_broken_line_it_takes_its_own_place_at_once(language, built, tmp_path):
    """A program that does not say which run it was would wait until that one has been silent for 20 s."""
    command = language.build("example_patch", built)
    with LiveStimulus(tmp_path, silence=20.0, blocks=SINGLE) as live:
        port = urlsplit(live.link()).port
        with CutLine(port) as line, Running([*command, live.link().replace(str(port), str(line.port))], tmp_path):
            live.until(lambda v: v["device"]["state"] == "stopped", live.whole)
            line.cut()
            all_answered(live)
        lost = [event.data.get("reason") or "" for event in live.events("device")]
    assert any("taken over" in reason for reason in lost) and not any("silent" in reason for reason in lost)


@each_language
def test_the_example_says_in_a_sentence_why_it_cannot_join(language, built, tmp_path):
    command = language.build("example_patch", built)
    with LiveStimulus(tmp_path, blocks=SINGLE) as live, Running([*command, live.link() + "x"], tmp_path) as program:
        assert program.process.wait(PATIENCE) == 1
    words = [
        line for line in program.err.read_text().splitlines() if "const execution_exception" not in line
    ]  # Octave's
    assert len(words) == 1 and words[0].startswith("This link has been used, or is not of this session")


_UNITY = """namespace UnityEngine {
  public class Material { public Color color; }
  public class Renderer { public bool enabled; public Material material; }
  public struct Color { public static Color HSVToRGB(float h, float s, float v) { return new Color(); } }
  public class MonoBehaviour { public T GetComponent<T>() { return default(T); } }
  public static class Debug { public static void LogWarning(object words) {} }
}
"""


@pytest.mark.skipif(shutil.which("mcs") is None, reason="mcs is missing")
def test_the_example_for_unity_uses_what_the_client_has(tmp_path):
    """Unity is not here to run it: the names of Unity that it uses are declared, and nothing more."""
    (tmp_path / "Unity.cs").write_text(_UNITY)
    files = [str(CLIENTS / "ExampleUnity.cs"), str(CLIENTS / "HilboStimulus.cs"), str(tmp_path / "Unity.cs")]
    options = ["-target:library", "-warnaserror", "-langversion:6", f"-out:{tmp_path / 'unity.dll'}"]
    subprocess.run(["mcs", *options, *files], check=True)


@pytest.fixture
def session(tmp_path):
    """`hilbo session` as a process, with a study of a spring."""
    new = NewStudy("spring", (parameter_of("stiffness=0.1:2:N/mm"), parameter_of("damping=0.001:0.02:N.s/mm")))
    file = tmp_path / "study.toml"
    file.write_text(study_text(new).replace("seconds = 2", "seconds = 5"))
    assert Study.load(file).file.stimulus.silence == SILENCE
    running = Session(tmp_path / "session", [str(file), "--participant", "P01"])
    running.start()
    running.until(running.ready)
    yield running
    with contextlib.suppress(ProcessLookupError):
        running.kill()


@each_language
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "silent"])
def test_with_force_it_is_neutral_within_the_stated_time_after_the_server(language, how, session, tmp_path):
    """Whatever its own loop is doing, which hangs where there is a thread beside it."""
    folder = hung(language, tmp_path / "clients") if language.hangs else sources(tmp_path / "clients")
    link = json.loads(session.out.read_text())["stimulus"]
    with Running([*language.build("example_spring", folder), link], tmp_path) as program:
        session.until(lambda: session.act() == "step" and program.force() and program.force()[-1][1])
        at = time.time()
        os.kill(session.process.pid, how)
        session.until(lambda: not program.force()[-1][1])
        assert program.process.poll() is None
    gone = program.force()[-1][0] - at
    print(f"{language.name}: neutral {1000 * gone:.0f} ms after {how.name}")
    assert -0.001 < gone < SILENCE + 0.05 + OWN
