"""The server of a live session, its hub and a simulated device, through the JSON that pages and programs speak."""

import contextlib
import http.client
import json
import os
import random
import threading
import time
import urllib.request
from pathlib import Path

import pytest
from live_server import PATIENCE, Live, refused

from hilbo.app import watchers
from hilbo.app.hub import COMMANDS, PRESSES
from hilbo.app.robot import Client
from hilbo.live_records import Block, Planned
from hilbo.log_tables import validation_table


@pytest.fixture
def live(tmp_path):
    with Live(tmp_path) as found:
        yield found


@pytest.fixture(scope="module")
def quiet(tmp_path_factory):
    """A session in which nobody presses Begin."""
    with Live(tmp_path_factory.mktemp("quiet")) as found:
        found.until(lambda view: view["may"]["begin"])
        found.until(lambda _: found.events("sent"))
        yield found


def ask(live, path, *, data=None, **headers):
    """A bare request."""
    address = live.participant.address + path
    return urllib.request.urlopen(urllib.request.Request(address, data=data, headers=headers), timeout=PATIENCE)


PATHS = [
    *(("participant", path) for path in ("", "/events")),
    *(("participant", f"/{name}") for name in ("answer", *PRESSES)),
    *(("experimenter", path) for path in ("", "/events", "/map")),
    *(("experimenter", f"/{name}") for name in COMMANDS),
]
READS = ("", "/events", "/map")


@pytest.mark.parametrize(("role", "path"), PATHS)
def test_everything_needs_the_key_of_its_role(quiet, role, path):
    other = quiet.experimenter if role == "participant" else quiet.participant
    data = None if path in READS else b"{}"
    before = quiet.hub.state.seq
    for key in (None, "wrong", other._key):
        headers = {} if key is None else {"Authorization": f"Bearer {key}"}
        with refused(401):
            ask(quiet, f"/api/{role}{path}", data=data, **headers)
    assert quiet.hub.state.seq == before


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "example.org"},
        {"Host": "example.org:80"},
        {"Origin": "http://example.org"},
        {"Origin": "null"},
        {"Sec-Fetch-Site": "cross-site"},
    ],
)
@pytest.mark.parametrize("path", ["/", "/static/participant.js", "/participant", "/api/participant", "/api/join"])
def test_what_comes_from_elsewhere_is_refused_with_the_right_key_too(quiet, path, headers):
    with refused(403):
        ask(quiet, path, Authorization=f"Bearer {quiet.participant._key}", **headers)


def test_a_cookie_alone_does_not_change_anything(quiet):
    key = quiet.participant._key
    with refused(403):
        ask(quiet, "/api/participant/begin", data=b"{}", Cookie=f"hilbo_participant={key}")
    origin = quiet.participant.address
    with ask(quiet, "/api/participant", Cookie=f"hilbo_participant={key}", Origin=origin) as reply:
        assert "default-src 'none'" in reply.headers["Content-Security-Policy"]
        assert reply.headers["Cache-Control"] == "no-store"


def test_a_page_without_a_key_gets_nothing_but_the_way_in(quiet):
    with pytest.raises(urllib.error.HTTPError) as caught:
        ask(quiet, "/experimenter")
    with caught.value as error:
        assert "join.js" in error.read().decode()
    assert caught.value.code == 401
    with refused(401):
        quiet.participant.post("/api/join", {"token": "again"})


def test_a_link_opened_on_a_full_disk_can_be_opened_again(live):
    link = live.command("invite")["link"]
    token = link.partition("#")[2]
    (live.folder / "keys.part").mkdir()  # nothing can be written there
    with refused(503):
        live.participant.post("/api/join", {"token": token})
    assert live.view()["phase"]
    (live.folder / "keys.part").rmdir()
    assert Client(link).get("/api/participant")["phase"]


def test_what_is_not_understood_is_refused_and_harms_nothing(quiet):
    view = quiet.until(lambda view: view["trial"])
    rng, before = random.Random(0), quiet.hub.state.seq
    for number in range(200):
        with refused_somehow():
            quiet_post(quiet, "answer", malformed(rng, view["trial"]["id"], number))
    assert quiet.hub.state.seq == before
    assert quiet.view() == view


def malformed(rng, trial, number):
    """A message that is none: bytes, wrong types, unknown keys, wrong names, endless or deep ones."""
    good = {"trial": trial, "client": "c", "answers": {"class_a": "close"}, "response_ms": 1.0}
    kinds = [
        lambda: rng.randbytes(rng.randrange(1, 200)),
        lambda: json.dumps(good | {"extra": 1}).encode(),
        lambda: json.dumps({k: v for k, v in good.items() if k != rng.choice(list(good)[:3])}).encode()[:-1],
        lambda: json.dumps(good | {rng.choice(list(good)): rng.choice([None, 3, [], {}, "", True])}).encode(),
        lambda: json.dumps(
            good | {"trial": rng.choice(["", "tag:1", "x:1.1", "tag:999.1", "tag:-1.1", "tag:1.99"])}
        ).encode(),
        lambda: json.dumps(good | {"answers": {"class_a": "best"}}).encode(),
        lambda: json.dumps(good | {"client": "c" * 65}).encode(),
        lambda: b"[" * 20_000,
        lambda: json.dumps(good | {"clicked": "x" * 20_000}).encode(),
        lambda: json.dumps(good | {"response_ms": rng.choice([-1, 1e300])}).encode(),
        lambda: b'{"trial": "\xff\xfe"}',
        lambda: b"null",
    ]
    return kinds[number % len(kinds)]()


def quiet_post(live, name, data):
    ask(live, f"/api/participant/{name}", data=data, Authorization=f"Bearer {live.participant._key}")


class refused_somehow:  # noqa: N801  (read as a word)
    def __enter__(self):
        return self

    def __exit__(self, kind, error, trace):
        assert isinstance(error, urllib.error.HTTPError), error
        with error:
            assert error.code in (400, 409), error
            assert json.loads(error.read())["error"]
        return True


def test_a_session_of_comparisons_from_begin_to_end(tmp_path):
    with Live(tmp_path, repeats=4) as live:
        heard, own = [], live.participant._ask

        def ear(request):
            found = own(request)
            heard.append(json.dumps(found))
            return found

        live.participant._ask = ear
        listening = threading.Thread(target=listen, args=(live, heard))
        listening.start()
        live.begin()
        for _ in range(12):
            view = live.question()
            assert [question["name"] for question in view["questions"]] == ["class_a", "class_b", "preferred"]
            first = live.answer(view)
            assert first["accepted"] == view["trial"]["id"]
            assert not first["again"]
            assert live.answer(view)["again"]  # sent again: accepted once
            with refused(409):
                live.answer(view, client="somebody-else")
        assert live.until(lambda view: view["phase"] == "done")["progress"]["done"] == 12
        answers = live.events("answer")
        assert [event.data["id"] for event in answers] == list(range(1, 13))
        assert {event.data["client"] for event in answers} == {"me"}
        assert answers[0].data["browser"]["response_s"] == 0.0125
        live.replays()
        assert validation_table([live.replayed()])["response_time"].tolist() == [0.0125] * 12
        check_order(live.events())
        state = live.hub.state
    listening.join(PATIENCE)
    assert any(line.startswith("event: view") for line in heard)
    check_blinding("\n".join(heard), state)


def listen(live, heard):
    """Everything that comes as server-sent events, until the server ends; and the page itself."""
    key = {"Authorization": f"Bearer {live.participant._key}"}
    with (
        ask(live, "/api/participant/events?page=ear", **key) as stream,
        contextlib.suppress(OSError, http.client.HTTPException),
    ):
        for kind in ("html", "js"):
            with ask(live, f"/static/participant.{kind}") as page:
                heard.append(page.read().decode())
        for line in stream:
            heard.append(line.decode())


def check_blinding(heard, state):
    """Nothing of what a participant must not know is in what their browser was told."""
    words = ["best", "mid", "worst", "mean", "margin", "certificate", "K1", "B1", "alpha", "renderings", "choice"]
    for word in [*words, "passiv", "probabilit", "aggregate", "individual", "validation"]:
        assert word not in heard, word
    for values in [values for trial in state.trials for values in trial.renderings.values()]:
        for value in values.values():
            assert f"{value:.4g}" not in heard
            assert str(value) not in heard


def check_order(events):
    """What a trial needs comes in its order: proposed, in force, shown, answered; and in force before it is shown."""
    for number in range(1, 13):
        kinds = [(e.kind, e.data.get("side") or e.data.get("show")) for e in events if e.data.get("id") == number]
        assert kinds[0] == ("propose", None)
        assert kinds[-1] == ("answer", None)
        for side in ("a", "b"):
            assert kinds.index(("sent", side)) < kinds.index(("stimulus", side))


def test_the_sets_that_were_shown_are_those_of_the_trial(live):
    live.begin()
    live.answer()
    trial = live.hub.state.trials[0]
    for side, sent in trial.sent.items():
        for name in ("K0", "K1", "B1", "alpha"):
            assert sent["in_force"][name] == pytest.approx(trial.renderings[side][name], rel=1e-6)


def test_every_command_is_an_event_and_replayed(live):
    live.begin()
    live.answer()
    live.question()
    live.command("pause")
    assert live.view()["phase"] == "paused"
    with refused(409):
        live.command("pause")
    with refused(409):
        live.participant.post("/api/participant/more", {})
    live.command("resume")
    live.command("note", text="  yawned ")
    with refused(400):
        live.command("note", text=" ")
    name = live.question()["trial"]["id"]
    live.command("repeat")
    again = live.until(lambda view: view["questions"] and view["trial"]["id"] != name)
    with refused(409):
        live.answer(again | {"trial": {"id": name}})
    live.command("undo", reason="slipped")
    live.command("void", reason="noise") if live.hub.state.pending and live.hub.state.pending.step is not None else None
    live.answer(live.question())
    live.command("void", reason="door slammed")
    live.participant.post("/api/participant/break", {})
    assert live.hub.state.paused == "participant"
    live.command("resume")
    live.command("abort", reason="fire alarm")
    assert live.until(lambda view: view["phase"] == "ended")
    with refused(409):
        live.command("undo")
    kinds = [event.kind for event in live.events()]
    assert {"pause", "resume", "note", "repeat", "undo", "void", "abort"} <= set(kinds)
    live.replays()
    assert live.hub.state.notes[0][1] == "yawned"


def test_void_and_undo_mean_the_trial_that_their_sender_saw(live):
    live.begin()
    live.answer()
    view = live.until(lambda v: v["means"]["void"] and v["means"]["void"]["trial"] == 2, live.whole)
    assert view["means"] == {"void": {"trial": 2, "name": "V2"}, "undo": {"trial": 1, "name": "V1"}}
    live.answer()
    live.until(lambda v: v["means"]["undo"]["trial"] == 2 and v["means"]["void"]["trial"] == 3, live.whole)
    before = live.hub.state.trials[:2]
    for what, trial, now in (("void", 2, "V3"), ("undo", 1, "V2"), ("void", 99, "V3")):
        with refused(409, f"Meanwhile {now} has come"):
            live.command(what, trial=trial, reason="noise")
    assert live.hub.state.trials[:2] == before
    with refused(400):
        live.command("void", trial="2")
    live.command("undo", trial=2, reason="slipped")
    assert live.hub.state.trials[1].status == "undone"
    assert live.events("undo")[0].data == {"id": 2, "reason": "slipped"}
    again = live.until(lambda v: v["means"]["void"]["trial"] > 3, live.whole)["means"]["void"]["trial"]
    live.command("void", trial=again, reason="noise")
    assert live.hub.state.trials[again - 1].status == "void"


def test_the_server_ends_and_goes_on_with_the_same_trial(tmp_path):
    with Live(tmp_path) as live:
        live.begin()
        view = live.question()
        sent = live.message(view)
        live.participant.post("/api/participant/answer", sent)
        live.until(lambda v: v["trial"] and v["trial"]["id"] != view["trial"]["id"])
        live.question()
        before = live.hub.state.pending.renderings
    with Live(tmp_path) as live:
        assert live.participant.post("/api/participant/answer", sent)["again"]
        assert live.hub.state.pending.renderings == before
        assert len(live.events("answer")) == 1


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
    found = live.answer(live.question())
    assert not found["again"]
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
    assert [e.data["condition"] for e in live.events("device")][-2:] == ["estop", "ready"]


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


def test_a_sleeping_laptop_begins_the_trial_again(tmp_path, monkeypatch):
    with Live(tmp_path, seconds=60.0) as live:  # it sleeps in the first step
        import hilbo.app.interruptions as module

        live.begin()
        live.until(lambda v: v["phase"] == "step")
        real = module.time.time
        monkeypatch.setattr(module.time, "time", lambda: real() + 3600)
        live.until(lambda v: v["may"]["begin"])
        assert "slept" in live.events("note")[-1].data["text"]
        assert live.events("repeat")


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


def test_the_newest_window_of_a_participant_is_the_one_that_counts(live):
    live.begin()
    first, second = live.hub.watchers.add("participant", "one"), live.hub.watchers.add("participant", "two")
    assert first.ended
    assert "another window" in first.why
    assert not second.ended
    live.hub.watchers.remove(second)
    assert live.question()


def test_another_one_and_begin_at_the_end_of_the_warm_up(tmp_path):
    blocks = (
        Block("warm-up", 1, (Planned("best"), Planned("mid"))),
        Block("validation", 1, (Planned("best", "mid"),)),
    )
    with Live(tmp_path, blocks=blocks) as live:
        live.begin()
        live.answer()
        view = live.until(lambda v: v["phase"] == "ready")
        assert view["may"] == {"begin": True, "more": True, "break": True}
        live.participant.post("/api/participant/more", {})
        live.answer(live.question())
        assert not live.until(lambda v: v["phase"] == "ready")["may"]["more"]
        live.participant.post("/api/participant/begin", {})
        live.answer(live.question())
        assert live.until(lambda v: v["phase"] == "done")


def test_the_documents_name_every_address():
    text = (Path(__file__).parents[1] / "docs" / "live.md").read_text(encoding="utf-8")
    for name in (*PRESSES, *COMMANDS, "answer", "events", "join"):
        assert f"`{name}`" in text or f"/{name}" in text, name


class Page:
    """A participant's window without a browser: a cookie, a stream, and signs of life as long as it is told to."""

    def __init__(self, live):
        self.live, self.origin = live, live.participant.address
        token = live.place.link("participant").partition("/#")[2]
        request = urllib.request.Request(self.origin + "/api/join", data=json.dumps({"token": token}).encode())
        with urllib.request.urlopen(request, timeout=PATIENCE) as reply:
            self.cookie = reply.headers["Set-Cookie"].partition(";")[0]
        self.stream = ask(live, "/api/participant/events?page=one", Cookie=self.cookie)

    def post(self, name):
        headers = {"Cookie": self.cookie, "Origin": self.origin, "X-Hilbo-Page": "one"}
        ask(self.live, f"/api/participant/{name}", data=b"{}", **headers).close()


def test_a_network_that_goes_silently_is_noticed_though_the_stream_stays_open(tmp_path, monkeypatch):
    monkeypatch.setattr(watchers, "_SILENT", 0.0)  # no program counts
    with Live(tmp_path, seconds=60.0) as live:
        page = Page(live)
        live.until(lambda v: v["phase"] == "hello", live.whole)
        page.post("begin")
        live.until(lambda v: v["phase"] == "step", live.whole)
        end = time.monotonic() + 5.0  # longer than a page may be silent
        while time.monotonic() < end:
            page.post("here")
            time.sleep(0.5)
        view = live.whole()
        assert view["participant_here"]
        assert view["phase"] == "step"
        live.until(lambda v: not v["participant_here"], live.whole)  # nothing is closed, and nothing comes any more
        live.until(lambda v: v["phase"] == "hello", live.whole)
        assert live.events("repeat")
        live.command("pause")
        live.command("resume")  # by the experimenter, with nobody there
        live.until(lambda v: v["phase"] == "hello", live.whole)
        page.post("here")
        assert live.whole()["participant_here"]
        live.command("pause")
        live.command("resume")
        live.until(lambda v: v["phase"] == "step", live.whole)
        page.stream.close()
