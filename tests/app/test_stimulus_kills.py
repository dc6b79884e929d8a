"""kill -9 of the server, of the program that presents and of the participant's program, in turn, at random moments: no
acknowledged answer is lost, and none counts for what was not confirmed.

`HILBO_KILLS=200 pytest tests/app/test_stimulus_kills.py` kills so often; by default a few times, for the sake of the
clock.
"""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from killed_session import Session

from hilbo.app.rehearsal.robot import Client
from hilbo.session.choose.choice import Answers
from hilbo.session.log.event_log import read_log
from hilbo.session.log.state import LiveSession
from hilbo.study.file.reading import StudyFile
from hilbo.study.template import NewStudy, parameter_of, study_text

KILLS = int(os.environ.get("HILBO_KILLS", "9"))
PROGRAM = Path(__file__).parents[1] / "support" / "presents.py"
pytestmark = [pytest.mark.deep, pytest.mark.skipif(sys.platform == "win32", reason="SIGKILL")]


class Presented(Session):
    """A session whose renderings a process of its own presents."""

    program = None

    def present(self):
        """The program, as it was first started; a key that it has is in its file."""
        link = json.loads((self.folder / "first").read_text())["stimulus"]
        arguments = [sys.executable, str(PROGRAM), link, str(self.folder / "stimulus.key")]
        with open(self.folder / "program.err", "a") as words:
            self.program = subprocess.Popen(arguments, stderr=words)

    def ready(self):
        if not super().ready():
            return False
        if self.program is None:
            (self.folder / "first").write_text(self.out.read_text())
            self.present()
        return True

    def kill_program(self):
        self.program.kill()
        self.program.wait()
        self.present()

    def kill_participant(self):
        """Another one, with the same key, who knows of no answer that was not acknowledged."""
        new = Client.__new__(Client)
        new.__dict__.update(self.client.__dict__)
        self.client, self.waiting = new, None

    def end(self):
        self.kill()
        self.program.kill()
        self.program.wait()


def only_what_was_confirmed(path, study):
    """Every answer is to renderings that were confirmed in this presentation, and counts for what was."""
    header, events, _ = read_log(path, study)
    state, proposed = LiveSession.start(study, header), {}
    for event in events:
        if event.kind == "propose":
            proposed[event.data["id"]] = event.data["renderings"]["a"]
        if event.kind == "answer":
            trial = state.trial(event.data["id"])
            assert set(trial.confirmed) == trial.felt == {"a"}
            assert trial.presented["a"]["hue"] == round(proposed[trial.id]["hue"])
        state = state.after(event)
    for block in range(len(header.blocks)):
        points = Answers.of(state, block).points
        assert all(hue == round(hue) for hue, _ in points) and len(points) == state.quota(block)
    return state


def test_killed_in_turn_they_lose_nothing_and_count_nothing_that_was_not_confirmed(tmp_path):
    new = NewStudy("kills", (parameter_of("hue=0:360:deg"), parameter_of("light=20:80:%")), trials=max(9, KILLS))
    text = study_text(new).replace("seconds = 2", "seconds = 0.3")
    text = text.replace("# tolerance = {", "tolerance = {").replace('"hue" = 0.36', '"hue" = 0.51')
    file = tmp_path / "study.toml"
    file.write_text(text)
    study = StudyFile.load(file)
    session = Presented(tmp_path / "killed", [str(file), "--participant", "P01"])
    session.start()
    session.until(session.ready)
    killed = {"server": 0, "program": 0, "participant": 0}
    for number in range(KILLS):
        session.until(lambda: session.act() in ("step", "done"))  # a server that starts has nobody to lose anything of
        # One in three at a random moment, the others as soon as something is presented: a step is short.
        end = time.monotonic() + (session.rng.uniform(0, 1.0) if number % 9 < 3 else 0.0)
        while time.monotonic() < end and session.act() != "done":
            time.sleep(session.rng.uniform(0, 0.01))
        if session.phase == "done":
            break
        what = list(killed)[number % 3]
        killed[what] += 1
        if what == "server":
            session.kill()
            session.check(study)
            session.start()
            session.until(session.ready)
        else:
            getattr(session, f"kill_{what}")()
    session.until(lambda: session.act() == "done", 600.0)
    session.end()
    session.check(study)
    (path,) = (session.folder / "logs").glob("*.jsonl")
    state = only_what_was_confirmed(path, study)
    voids = sum(trial.status == "void" for trial in state.trials)
    assert voids or KILLS < 9  # otherwise nobody was killed while it presented
    print(f"killed {killed}: {len(session.acknowledged)} answers acknowledged, {voids} trials void")
