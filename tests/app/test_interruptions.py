"""What interrupts a live session: its device, a full disk, a laptop that sleeps, a break, a network that goes silently.

Whatever it is, nothing is lost, and what was being felt is felt again once somebody presses Begin.
"""

import asyncio
import os
import threading
import time
from types import SimpleNamespace

import pytest
from live import Driver, beginning
from live_server import Live, ask, refused

from hilbo.app.hub.hub import Hub
from hilbo.app.hub.interruptions import Interruptions, interrupt
from hilbo.app.rehearsal.robot import Client
from hilbo.app.rigs.rig import Snapshot
from hilbo.app.wire import security, watchers
from hilbo.session.log.event_log import LogError
from hilbo.study.file.plan_file import Block, Planned


@pytest.fixture
def live(tmp_path):
    with Live(tmp_path) as session:
        yield session


def test_a_device_that_is_gone_voids_the_trial_and_comes_back(live):
    live.begin()
    live.answer()
    live.question()
    pending = live.hub.state.pending
    live.hub.rig.device.simulator._process.kill()
    view = live.until(
        lambda v: v["device"]["state"] != "lost" and v["whole"]["trials"][pending.id - 1]["voided"], live.whole
    )
    voided = view["whole"]["trials"][pending.id - 1]["voided"]
    assert voided["by"] == "rule"
    assert "device" in voided["reason"]
    live.begin()  # nothing goes on by itself
    reply = live.answer(live.question())
    assert not reply["again"]
    assert live.hub.state.trials[pending.id].renderings == pending.renderings
    live.replays()


def test_an_emergency_stop_holds_everything_until_it_is_cleared(live):
    live.begin()
    live.question()
    live.command("estop")
    seen = live.until(lambda v: v["device"]["state"] == "estop" and v["phase"] == "trouble", live.whole)
    assert "clear" in seen["may"]
    assert live.view()["questions"] is None
    live.command("clear")
    live.answer(live.question())
    live.device_did("ready", "estop", "ready")


def test_a_full_disk_keeps_the_answer_unacknowledged_and_nothing_is_lost(live, monkeypatch):
    live.begin()
    view = live.question()
    live.until(lambda v: v["phase"] == "answer")
    real = os.write

    def full(file, data):
        if file == live.log._file:
            raise OSError(28, "No space left on device")
        return real(file, data)

    monkeypatch.setattr(os, "write", full)
    with refused(503):
        live.answer(view)
    assert "space" in live.whole()["alert"]
    monkeypatch.setattr(os, "write", real)
    assert not live.answer(view)["again"]
    assert len(live.events("answer")) == 1


def test_a_link_opened_on_a_full_disk_can_be_opened_again(live, monkeypatch):
    link = live.command("invite")["link"]
    token = link.partition("#")[2]

    def full(*_, **options):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as disk:
        disk.setattr(security, "write_file", full)
        with refused(503):
            live.participant.post("/api/join", {"token": token})
    assert live.view()["phase"]
    assert Client(link).get("/api/participant")["phase"]


def test_a_sleeping_laptop_begins_the_trial_again(tmp_path, monkeypatch):
    with Live(tmp_path, seconds=60.0) as live:  # it sleeps in the first step
        import hilbo.app.hub.interruptions as module

        live.begin()
        name = live.until(lambda v: v["phase"] == "step")["trial"]["id"]
        real = module.time.time
        monkeypatch.setattr(module.time, "time", lambda: real() + 3600)
        live.until(lambda v: v["may"]["begin"])
        live.until(lambda _: live.events("repeat"))
        assert "slept" in live.events("note")[-1].data["text"]
        with refused(409, "another trial"):  # a Begin that comes late
            live.participant.post("/api/participant/begin", {"trial": name})
        assert not live.hub.begun
        live.begin()
        assert live.hub.begun


def test_a_slow_disk_is_no_laptop_that_slept(live, monkeypatch):
    """While the disk's thread is busy the log cannot be checked; the clocks are watched all the same."""
    interruptions, looked, done = live.hub._interruptions, [], threading.Event()
    write = interruptions._write

    async def counted():
        looked.append(1)
        await write()

    monkeypatch.setattr(interruptions, "_write", counted)
    live.hub._disk.submit(done.wait)
    try:
        live.until(lambda _: len(looked) > 20, lambda: len(looked))
    finally:
        done.set()


def test_the_watch_goes_on_after_a_fault_and_says_so(live, monkeypatch):
    interruptions, looked = live.hub._interruptions, []

    async def broken():
        looked.append(1)
        raise RuntimeError("no such thing")

    monkeypatch.setattr("hilbo.app.hub.interruptions._LATER", 0.05)
    monkeypatch.setattr(interruptions, "_write", broken)
    view = live.until(lambda v: v["alert"], live.whole)
    assert "no such thing" in view["alert"] and "what interrupts the session" in view["alert"]
    seen = len(looked)
    live.until(lambda _: len(looked) > seen, lambda: "nobody looks any more")


def test_an_interruption_that_cannot_be_told_is_said(live, monkeypatch):
    def broken(*_):
        raise RuntimeError("no such device")

    def tell():
        live.hub._loop.call_soon_threadsafe(live.hub._interruptions.device_changed, live.hub.rig.snapshot)

    with monkeypatch.context() as patched:
        patched.setattr("hilbo.app.hub.interruptions._condition_of", broken)
        tell()
        assert "no such device" in live.until(lambda v: v["alert"], live.whole)["alert"]
        live.command("note", text="yawned")  # an event that is written takes back no fault
        assert "no such device" in live.whole()["alert"]
    tell()
    assert live.until(lambda v: v["alert"] is None, live.whole)


def test_a_rest_is_no_part_of_the_time_from_answer_to_device(tmp_path):
    one = (Planned("best", "mid"),)
    with Live(tmp_path, blocks=(Block("validation", 1, one), Block("validation", 1, one, rest=1.0))) as live:
        live.begin()
        live.answer()
        live.until(lambda view: view["phase"] == "rest")
        live.command("resume")
        live.question()
        assert live.hub.delays == []
        live.answer()
        assert live.until(lambda view: view["phase"] == "done")


SHORT_THEN_LONG = 'steps = [{show = "reference", seconds = 0.02}, {show = "a", seconds = 30}]'


def test_a_rendering_that_a_break_cut_off_is_felt_again_before_it_is_asked_about(tmp_path):
    with Live(tmp_path, blocks=(Block("warm-up", 1, (Planned("best"),)),), warm_up=SHORT_THEN_LONG) as live:
        live.begin()
        live.until(lambda view: view["step"] and view["step"]["show"] == "a")
        live.participant.post("/api/participant/break", {})
        live.until(lambda view: view["phase"] == "paused")
        live.command("resume")
        view = live.until(lambda view: view["step"] or view["questions"])
        assert view["step"]["show"] == "reference"
        live.until(lambda view: view["step"] and view["step"]["show"] == "a")
        shown = [(e.data["show"], e.data["on"]) for e in live.events("stimulus")]
        assert shown == [("reference", True), ("reference", False), ("a", True)] * 2


QUIET = 1.5  # s that a page may be silent here


class Page:
    """A participant's window without a browser: a key, a stream, and signs of life as long as it is told to."""

    def __init__(self, live):
        key = Client(live.place.link("participant"))._key
        self.live, self.headers = live, {"Authorization": f"Bearer {key}", "X-Hilbo-Page": "one"}
        self.stream = ask(live, "/api/participant/events", **self.headers)

    def post(self, name):
        ask(self.live, f"/api/participant/{name}", data=b"{}", **self.headers).close()


@pytest.mark.deep  # waits 7 s
def test_a_network_that_goes_silently_is_noticed_though_the_stream_stays_open(tmp_path, monkeypatch):
    monkeypatch.setattr(watchers, "_SILENT", 0.0)  # no program counts
    monkeypatch.setattr(watchers, "_QUIET", QUIET)
    with Live(tmp_path, seconds=60.0) as live:
        page = Page(live)
        with page.stream:
            live.until(lambda v: v["phase"] == "hello", live.whole)
            page.post("begin")
            live.until(lambda v: v["phase"] == "step", live.whole)
            end = time.monotonic() + 1.5 * QUIET
            while time.monotonic() < end:
                page.post("here")
                time.sleep(0.1 * QUIET)
            view = live.whole()
            assert view["participant_here"]
            assert view["phase"] == "step"
            live.until(lambda v: not v["participant_here"], live.whole)  # nothing is closed, and nothing comes any more
            live.until(lambda v: v["phase"] == "hello", live.whole)
            live.until(lambda _: live.events("repeat"), live.whole)
            live.command("pause")
            live.command("resume")  # by the experimenter, with nobody there
            live.until(lambda v: v["phase"] == "hello", live.whole)
            page.post("here")
            assert live.whole()["participant_here"]
            live.command("pause")
            live.command("resume")
            live.until(lambda v: v["phase"] == "step", live.whole)


class Disk:
    """A hub with nothing but a disk, which takes some time for an event; `full`: how many events it refuses first."""

    alert = "The disk is full."

    def __init__(self, full):
        self.full, self.written, self.begun = full, [], True
        driver = Driver()
        driver.step()
        for event in beginning(driver.state, 1, 0, 0.0):
            driver.log(event)
        self.state = driver.state
        self.runner = SimpleNamespace(restart=lambda: None, wake=lambda: None, forget=lambda: None)

    def publish(self):
        pass

    async def commit(self, make):
        return await asyncio.shield(asyncio.ensure_future(self._commit(make)))

    async def _commit(self, make):
        await asyncio.sleep(0.01)
        self.full -= 1
        if self.full >= 0:
            raise LogError("No space left on device.")
        self.written.append(make if make.__name__ == "repeat" else make(self.state, 0.0).data.get("condition"))


def test_a_trial_begins_again_though_the_reason_could_not_be_written():
    hub = Disk(full=1)
    asyncio.run(interrupt(hub, "The participant's page is closed."))
    assert [make.__name__ for make in hub.written] == ["repeat"]


@pytest.mark.parametrize("tried", [0.0, 0.005, 0.05], ids=["not yet", "under way", "in vain"])
def test_what_the_device_did_is_written_once_before_the_session_ends(tried):
    async def ended(hub):
        watch = Interruptions(hub)
        watch.device_changed(Snapshot("LOST", False, "gone"))
        watch.device_changed(Snapshot("STOPPED", False, None))
        await asyncio.sleep(tried)
        await watch.end()
        await asyncio.sleep(0.05)

    hub = Disk(full=2 if tried > 0.01 else 0)
    asyncio.run(ended(hub))
    assert hub.written == ["lost", "ready"]


def test_a_disk_that_hangs_does_not_keep_the_device_from_being_stopped(monkeypatch):
    async def ended(hub):
        hub.alert, hub.commit = None, lambda make: asyncio.get_running_loop().create_future()
        watch = Interruptions(hub)
        watch.device_changed(Snapshot("LOST", False, "gone"))
        await watch.end()

    monkeypatch.setattr("hilbo.app.hub.interruptions._LATER", 0.05)
    with pytest.raises(LogError, match=r"^The disk does not answer\. Not in the log: 1 change of the device"):
        asyncio.run(asyncio.wait_for(ended(Disk(full=0)), 10))


def test_what_the_device_did_and_cannot_be_written_is_said_at_the_end():
    """Once everything else has ended: the rig, and the threads."""
    closed = []

    async def ended():
        disk = Disk(full=9)
        hub = Hub(SimpleNamespace(before=[], state=disk.state), None, lambda *_: None, tag="tag")
        hub._loop, hub._rig = asyncio.get_running_loop(), SimpleNamespace(close=lambda: closed.append("rig"))
        hub._interruptions.hub = disk
        hub._interruptions.device_changed(Snapshot("LOST", False, "gone"))
        await asyncio.sleep(0.05)
        try:
            await hub.close()
        finally:
            closed.append(hub._disk._shutdown)

    with pytest.raises(LogError, match=r'is full. Not in the log: 1 change of the device, the last to "lost"; go on'):
        asyncio.run(ended())
    assert closed == ["rig", True]
