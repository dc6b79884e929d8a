"""The README's study without a device, from `hilbo init` to `hilbo aggregate`, by the commands that stand there; with
each language's example as what presents. A program is the participant, and steps are short."""

import contextlib
import json
import os
import re
import shlex
import subprocess
import sys
import time
import urllib.error
from pathlib import Path

import pytest
from client_programs import of_languages, sources
from live_server import PATIENCE

from hilbo.app.rehearsal.robot import Client

pytestmark = pytest.mark.deep
ROOT = Path(__file__).parents[2]
HILBO = [sys.executable, "-c", "import sys; from hilbo.cli.main import main; sys.argv[0] = 'hilbo'; main()"]
_COLD = 900  # s that a command may take which compiles everything, where nothing is kept yet
SECONDS = float(os.environ.get("HILBO_STEP", "0.2"))  # of a step; the README's study has 2


def commands():
    """Those of the README's section, without the words behind #."""
    section = (ROOT / "README.md").read_text().partition("## A study without our device")[2]
    lines = section.split("```")[1].strip().splitlines()
    return [shlex.split(re.sub(r"  #.*", "", line)) for line in lines]


def taken_part(links, hub):
    """A participant to the end, who likes a hue of 140; the number of answers."""
    person, count = Client(links["participant"]), 0
    watch = Client(links["experimenter"])
    while True:
        assert hub.poll() is None
        view = person.get("/api/participant")
        if view["may"]["begin"]:
            person.post("/api/participant/begin", {})
        elif view["questions"]:
            whole = watch.get("/api/experimenter")["whole"]
            pending = [t for t in whole["trials"] if t["id"] == whole["pending"] and t["presented"].get("a")]
            if not pending:  # on a busy computer the trial may be void by now
                continue
            far = abs(pending[0]["presented"]["a"]["hue"] - 140) / 360
            label = "close" if far < 0.1 else "similar" if far < 0.3 else "different"
            answers = {question["name"]: label for question in view["questions"]}
            message = {"trial": view["trial"]["id"], "client": "c", "answers": answers}
            with contextlib.suppress(urllib.error.HTTPError):  # or by now
                person.post("/api/participant/answer", message)
                count += 1
        elif view["phase"] == "done":
            return count
        time.sleep(0.01)


@pytest.mark.parametrize("language", of_languages(release=("c++", "matlab", "c#")))
def test_from_init_to_an_optimum_by_the_commands_of_the_readme(language, tmp_path):
    init, doctor, add, session, example, aggregate = commands()
    assert example[:2] == ["python", "clients/example_patch.py"]
    example = language.build("example_patch", sources(tmp_path / "clients"))
    begun = time.monotonic()

    def hilbo(command):
        done = subprocess.run([*HILBO, *command[1:]], cwd=tmp_path, capture_output=True, text=True, timeout=_COLD)
        assert done.returncode == 0, done.stderr
        return done

    hilbo(init)
    file = tmp_path / init[2]
    file.write_text(file.read_text().replace("seconds = 2", f"seconds = {SECONDS}"))
    hilbo(doctor)
    (tmp_path / "logs").mkdir()
    hilbo(add)
    with open(tmp_path / "words", "w") as words:
        command = [*HILBO, *session[1:], "--json", "--port", "0"]
        hub = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=words, text=True)
        try:
            links = json.loads(hub.stdout.readline())
            program = subprocess.Popen([*example, links["stimulus"]], stdout=subprocess.DEVNULL)
            count = taken_part(links, hub)
        finally:
            hub.terminate()
            with contextlib.suppress(NameError):
                program.kill()
                program.wait()
            hub.communicate(timeout=PATIENCE)
    hilbo(aggregate)
    result = json.loads((tmp_path / "results" / "result.json").read_text())
    minutes = (time.monotonic() - begun) / 60
    print(f"{language.name}: 6 commands, {count} answers, {minutes:.1f} min with steps of {SECONDS:g} s")
    assert count == 28 and result["participants"][0]["trials"] == 25
    assert abs(result["optimum"]["parameters"]["hue"] - 140) < 60
