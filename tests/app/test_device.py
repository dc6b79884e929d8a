"""When the device of a live session moves and when it rests: a simulated device of its own, and the real server."""

import asyncio
import contextlib
import os
import threading
import time

import pytest
from live_server import Live, refused, until_held

from hilbo.app.hub import runner
from hilbo.app.rehearsal.rehearsal import _let_go
from hilbo.app.rigs.device_rig import DeviceRig
from hilbo.device.local.simulator import Simulator
from hilbo.hardware_bridge import DeviceError, Renderer, State
from hilbo.study.file.reading import StudyFile

PAPER = "hilbo/data/paper.toml"

WHILE = 0.3  # s for which a device is watched that must not move
SET = {"K0": -3.18, "K1": 5.58, "B1": 7.88, "alpha": 0.176}


@contextlib.contextmanager
def left_pressed(set_first=True):
    """A device whose set in force is an earlier session's, and whose handle a hand holds down; its process."""
    simulator = Simulator(finger="rest")
    try:
        if set_first:
            with Renderer.open(simulator.port, patience=10.0) as device:
                device.send(**SET)
        simulator.tell("finger hold")
        yield simulator
    finally:
        simulator.close()


def watched(live):
    """Every state that the device is seen in from now on."""
    seen, own = [], live.hub.rig._changed

    def changed(snapshot):
        seen.append(snapshot.state)
        own(snapshot)

    live.hub.rig._changed = changed
    return seen


def pressed(live):
    live.until(lambda _: live.hub.rig.snapshot.contact)


def test_a_pressed_device_rests_until_the_hand_has_left_and_again_in_a_break(tmp_path):
    with left_pressed() as simulator, Live(tmp_path, device=simulator.port) as live:
        seen = watched(live)
        live.until(lambda view: view["may"]["begin"])
        pressed(live)
        live.begin()
        view = live.until(lambda view: "handles" in view["title"])
        assert "lift it" in view["message"]
        time.sleep(WHILE)
        assert set(seen) <= {"STOPPED"}
        _let_go(simulator, live.whole)
        live.until(lambda _: live.hub.rig.snapshot.state == "RUNNING")
        live.participant.post("/api/participant/break", {})
        live.until(lambda _: live.hub.rig.snapshot.state == "STOPPED")
        del seen[:]
        time.sleep(WHILE)
        assert "RUNNING" not in seen


def test_a_hand_that_stays_puts_the_trial_aside_and_feels_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "_LEAVES", WHILE)
    with left_pressed() as simulator, Live(tmp_path, device=simulator.port) as live:
        seen = watched(live)
        pressed(live)
        live.begin()
        live.until(lambda _: live.events("note"))
        assert "The participant did not release the device" in live.events("note")[0].data["text"]
        live.until(lambda view: view["may"]["begin"])
        assert set(seen) <= {"STOPPED"} and live.hub.state.pending.presentation == 2
        _let_go(simulator, live.whole)
        live.answer(live.begin() or live.question())
        live.replays()


def test_an_emergency_stop_is_not_ended_by_a_clear_that_was_requested_before_it(tmp_path):
    """On the simulated device itself: the order waits behind another one, and the stop overtakes it."""
    study = StudyFile.load(PAPER)
    with contextlib.closing(Simulator(finger="none")) as simulator:
        rig = DeviceRig(study, lambda: Renderer.open(simulator.port, patience=10.0))
        try:
            asyncio.run(_stopped_after_a_clear(rig))
        finally:
            rig.close()


async def _stopped_after_a_clear(rig):
    await rig.estop()
    busy = threading.Event()
    rig.do(lambda _: busy.wait(10))
    cleared = asyncio.ensure_future(rig.clear())
    await asyncio.sleep(0)
    await rig.estop()
    busy.set()
    with pytest.raises(DeviceError, match="has stopped since CLEAR was requested"):
        await cleared
    assert (await asyncio.wrap_future(rig.do(lambda device: device.state()))) == State.ESTOP
    await rig.clear()
    assert (await asyncio.wrap_future(rig.do(lambda device: device.state()))) == State.STOPPED


def test_a_flag_of_the_simulated_device_is_recorded_with_its_trial(tmp_path):
    with contextlib.closing(Simulator(finger="none")) as simulator, Live(tmp_path, device=simulator.port) as live:
        live.begin()
        live.answer()
        live.until(lambda view: view["phase"] == "answer" and view["trial"]["id"].startswith("tag:2."))
        simulator.tell("bad 1")  # one position, which the device replaces by the last one
        live.until(lambda _: "input_held" in (live.hub.rig.telemetry(2, 1) or {}))
        live.answer()
        first, second = (event.data["telemetry"] for event in live.events("answer"))
        assert first["samples"] > 0 and "input_held" not in first
        assert second["samples"] > second["input_held"] == 1


def test_jobs_that_follow_each_other_put_off_no_look():
    """A button that is pressed again and again must not keep the session from seeing what the device does."""
    study = StudyFile.load(PAPER)
    with contextlib.closing(Simulator(finger="rest")) as simulator:
        rig = DeviceRig(study, lambda: Renderer.open(simulator.port, patience=10.0))
        try:
            jobs = [rig.do(lambda _: time.sleep(0.005)) for _ in range(400)]
            assert not rig.snapshot.contact
            simulator.tell("finger hold")
            while not rig.snapshot.contact and not jobs[-1].done():
                time.sleep(0.005)
            assert rig.snapshot.contact and not jobs[-1].done()
        finally:
            rig.close()


def test_a_pressed_device_rests_while_something_is_still_compiled(tmp_path):
    with left_pressed() as simulator:
        with Live(tmp_path, device=simulator.port) as live:
            live.until(lambda _: live.events("propose"))
        with Live(tmp_path, device=simulator.port, warm=False) as live:  # which has its trial already
            seen = watched(live)
            live.participant.post("/api/participant/begin", {})
            pressed(live)
            time.sleep(WHILE)
            live.warmed.set()
            live.until(lambda view: "handles" in view["title"])
            assert set(seen) <= {"STOPPED"}


def test_a_stop_that_failed_is_said_and_sent_again(tmp_path, monkeypatch):
    with Live(tmp_path) as live:
        live.begin()
        live.until(lambda _: live.hub.rig.snapshot.state == "RUNNING")
        device, refused = live.hub.rig.device, []
        own = device.stop

        def stop():
            if not refused:
                refused.append("once")
                raise RuntimeError("the line hummed")
            own()

        monkeypatch.setattr(device, "stop", stop)
        live.command("pause")
        live.until(lambda view: view["alert"] == "the line hummed", live.whole)
        live.until(lambda _: live.hub.rig.snapshot.state == "STOPPED")


def felt_again(live, pending, condition):
    """The trial was void, with a device event; nothing goes on by itself, and after Begin it is asked again."""
    voided = live.until(lambda v: v["whole"]["trials"][pending.id - 1]["voided"], live.whole)["whole"]["trials"]
    assert voided[pending.id - 1]["voided"]["by"] == "rule"
    assert condition in voided[pending.id - 1]["voided"]["reason"]
    live.until(lambda v: v["device"]["state"] != "lost" and v["phase"] in ("hello", "trouble"), live.whole)
    assert live.hub.rig.snapshot.state in ("STOPPED", "HOLD")
    if "clear" in live.whole()["may"]:
        live.command("clear")
    live.begin()
    live.answer()
    assert live.hub.state.trials[pending.id].renderings == pending.renderings


def test_a_device_that_lost_its_power_voids_the_trial_and_waits_for_begin(tmp_path):
    with Live(tmp_path) as live:
        live.begin()
        live.answer()
        live.question()
        pending = live.hub.state.pending
        live.hub.rig.device.simulator.tell("restart")
        felt_again(live, pending, "restarted")
        live.device_did("ready", "lost", "ready")


def test_heartbeats_that_ended_void_the_trial_and_the_hold_can_be_cleared(tmp_path):
    with Live(tmp_path) as live:
        live.begin()
        live.question()
        pending = live.hub.state.pending
        live.hub.rig.device.link._heart.process.kill()
        felt_again(live, pending, "heartbeats")


@contextlib.contextmanager
def full_disk(live, monkeypatch, kind=b""):
    """Events of a kind cannot be written, as long as this lasts; gives how many tried."""
    real, tried = os.write, []

    def full(file, data):
        if file == live.log._file and b'"kind":"' + kind in bytes(data):
            tried.append(bytes(data))
            raise OSError(28, "No space left on device")
        return real(file, data)

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", full)
        yield tried


def test_a_hold_while_the_disk_is_full_voids_its_trial_as_soon_as_there_is_room(tmp_path, monkeypatch):
    with Live(tmp_path) as live:
        live.begin()
        view = live.question()
        live.until(lambda v: v["phase"] == "answer")
        with full_disk(live, monkeypatch) as tried:
            live.hub.rig.device.simulator.tell("bad 5")
            live.until(lambda v: "clear" in v["may"] and tried, live.whole)
            live.command("clear")
            live.until(lambda v: v["device"]["state"] == "stopped", live.whole)
            assert live.hub.state.trials[0].status == "pending"
        live.until(lambda v: v["whole"]["trials"][0]["status"] == "void", live.whole)
        with refused(409):
            live.answer(view)
        live.device_did("ready", "hold", "ready")
        live.answer()


def test_an_answer_that_comes_before_the_hold_can_be_written_does_not_count(tmp_path, monkeypatch):
    with Live(tmp_path) as live:
        live.begin()
        view = live.question()
        live.until(lambda v: v["phase"] == "answer")
        with full_disk(live, monkeypatch, b"device") as tried:
            live.hub.rig.device.simulator.tell("bad 5")
            live.until(lambda v: "clear" in v["may"] and tried, live.whole)
            live.answer(view)
        live.until(lambda v: v["whole"]["trials"][0]["status"] == "void", live.whole)


def test_what_is_in_force_is_in_the_log_before_it_is_felt_on_a_full_disk_too(tmp_path, monkeypatch):
    with Live(tmp_path) as live:
        with full_disk(live, monkeypatch, b"sent") as tried:
            live.begin()
            live.until(lambda _: len(tried) > 1)
        live.question()
        kinds = [(e.kind, e.data.get("side") or e.data.get("show")) for e in live.events() if e.data.get("id") == 1]
        assert kinds.index(("sent", "a")) < kinds.index(("stimulus", "a"))


def let_go_as_if_killed(rig):
    """The line is closed and heartbeats end, and nobody says stop, as when a process dies."""
    rig._ending.set()
    rig._jobs.put(None)
    rig._thread.join()
    rig.device.link.close()


def test_a_killed_server_goes_on_with_the_same_trial_on_a_device_that_held_meanwhile(tmp_path):
    with left_pressed(set_first=False) as simulator:
        simulator.tell("finger none")
        with Live(tmp_path, device=simulator.port) as live:
            live.begin()
            view = live.question()
            live.until(lambda v: v["phase"] == "answer")
            assert live.hub.rig.snapshot.state == "RUNNING"
            rig = live.hub.rig
            rig.close = lambda: let_go_as_if_killed(rig)
        until_held(simulator.port)
        with Live(tmp_path, device=simulator.port) as live:
            assert live.hub.rig.snapshot.state == "HOLD"
            live.device_did("ready", "stopped")
            assert not live.answer(view)["again"]  # which was kept by the browser
            live.command("clear")
            live.begin()
            live.answer()
            assert [t.status for t in live.hub.state.trials[:2]] == ["answered", "answered"]
            live.device_did("ready", "stopped", "ready")


def test_a_device_that_held_for_another_reason_voids_the_trial_also_at_the_start(tmp_path):
    with left_pressed(set_first=False) as simulator:
        simulator.tell("finger none")
        with Live(tmp_path, device=simulator.port) as live:
            live.begin()
            live.question()
            live.until(lambda v: v["phase"] == "answer")
            rig = live.hub.rig
            rig.close = lambda: (let_go_as_if_killed(rig), simulator.tell("bad 5"))
        until_held(simulator.port)
        with Live(tmp_path, device=simulator.port) as live:
            live.until(lambda v: v["whole"]["trials"][0]["status"] == "void", live.whole)
