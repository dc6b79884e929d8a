"""kill -9 of the server at random moments: no acknowledged answer is lost, none is doubled, the next trial is the same.

`HILBO_KILLS=200 pytest tests/app/test_kills.py` kills so often; by default a few times, for the sake of the clock.
"""

import contextlib
import os
import sys
import time

import pytest
from killed_session import PATIENCE, Session
from live_server import DATA, until_held

from hilbo.app.rehearsal.rehearsal import example_sets, fast_study
from hilbo.device.local.simulator import Simulator
from hilbo.session.plan.plan import make_plan
from hilbo.simulation.presets import preset_of
from hilbo.study.config import Study
from hilbo.study.file.plan_file import plan_text

KILLS = int(os.environ.get("HILBO_KILLS", "8"))
pytestmark = [pytest.mark.deep, pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals and SIGKILL")]


def finished(study, folder, arguments, kills, most):
    """The log of a session that was killed so often, each time `most` s after its start, or before it was there."""
    with contextlib.closing(Session(folder, arguments)) as session:
        return _finished(session, study, kills, most)


def _finished(session, study, kills, most):
    amid = 0
    for number in range(kills):
        session.start()
        if number % 10 == 9:  # in the middle of starting
            time.sleep(session.rng.uniform(0, 1.0))
        else:
            session.until(session.ready)
            end = time.monotonic() + session.rng.uniform(0, most)
            while time.monotonic() < end and session.act() != "done":
                time.sleep(session.rng.uniform(0, 0.01))
        session.kill()
        session.check(study)
        amid += session.phase not in ("done", "ended")
    session.start()
    session.until(session.ready)
    session.until(lambda: session.act() == "done", 20 * PATIENCE)
    session.kill()
    session.check(study)
    print(
        f"{kills} kills, {amid} of them amid the session, {len(session.acknowledged)} answers acknowledged,"
        f" {session.dropped} times hung up"
    )
    return session.log(study)


def essence(events):
    """Proposals and answers, without what is measured meanwhile: times, a browser's clock, a device's samples."""
    kept = []
    for event in events:
        if event.kind in ("propose", "answer", "go_on"):
            kept.append((event.kind, {k: v for k, v in event.data.items() if k not in ("browser", "telemetry")}))
    return kept


@pytest.mark.parametrize(("phase", "share"), [("validation", 1.0), ("optimisation", 0.25)])
def test_killed_servers_lose_and_double_nothing(tmp_path, phase, share):
    text = DATA.read_text(encoding="utf-8").replace("trials = 25", "trials = 9")
    (tmp_path / "base.toml").write_text(text)
    file = fast_study(tmp_path / "base.toml", tmp_path / "study.toml", 0.05, 2)
    kills = max(2, round(share * KILLS))
    if phase == "validation":
        text = file.read_text().replace(
            "[session.validation]\n", f"[session.validation]\ncount = {max(4, kills // 2)}\n"
        )
        file.write_text(text)
    study = Study.load(file)
    arguments = [str(file), "--participant", "P01"]
    if phase == "validation":
        plan = make_plan(
            study.file, ["P01"], 0, phase, sets={"": example_sets(study, preset_of("paper"))}, source="aggregate"
        )
        (tmp_path / "plan.json").write_text(plan_text(plan))
        arguments += ["--plan", str(tmp_path / "plan.json")]
    logs = [finished(study.file, tmp_path / name, arguments, n, 0.8) for name, n in (("killed", kills), ("whole", 0))]
    assert essence(logs[0]) == essence(logs[1])


def test_a_kill_while_a_device_of_its_own_renders_loses_not_even_the_click(tmp_path):
    file = fast_study(DATA, tmp_path / "study.toml", 0.05, 2)
    study = Study.load(file)
    plan = make_plan(
        study.file, ["P01"], 0, "validation", sets={"": example_sets(study, preset_of("paper"))}, source="aggregate"
    )
    (tmp_path / "plan.json").write_text(plan_text(plan))
    with contextlib.ExitStack() as ended:
        device = ended.enter_context(contextlib.closing(Simulator(finger="none")))
        arguments = [str(file), "--participant", "P01", "--plan", str(tmp_path / "plan.json"), "--device", device.port]
        session = ended.enter_context(contextlib.closing(Session(tmp_path / "killed", arguments)))
        session.start()
        session.until(session.ready)

        def asked():
            view = session.client.get("/api/participant")
            if view["may"]["begin"]:
                session.client.post("/api/participant/begin", {})
            if view["phase"] == "answer":
                session.waiting = session.answer_to(view)  # clicked, and kept by the browser
            return session.waiting

        session.until(asked)
        session.kill()
        until_held(device.port)
        session.start()
        session.until(session.ready)
        clicked = session.waiting
        assert not session.client.post("/api/participant/answer", clicked)["again"]
        session.waiting = None
        session.experimenter.post("/api/experimenter/clear", {})
        session.until(asked)
        assert session.waiting["trial"] != clicked["trial"]
        session.kill()
    events = session.log(study.file)
    assert [e.data["condition"] for e in events if e.kind == "device"] == ["ready", "stopped", "ready"]
    assert [e.data["id"] for e in events if e.kind == "answer"] == [1]
