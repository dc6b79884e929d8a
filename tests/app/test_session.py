"""Live sessions through the server, its hub and a simulated device: trials, commands, windows, and their log."""

import gc
import json
import threading
import time
from types import SimpleNamespace

import pytest
from live_server import PAIRS, PATIENCE, Live, check_blinding, listen, refused

from hilbo.app.hub.opening import Wanted, opened
from hilbo.app.pages.views import choice_rows
from hilbo.session.export.tables import validation_table
from hilbo.study.file.plan_file import Block, Planned


@pytest.fixture
def live(tmp_path):
    with Live(tmp_path) as session:
        yield session


def test_a_session_of_comparisons_from_begin_to_end(tmp_path):
    with Live(tmp_path, repeats=4) as live:
        heard, own = [], live.participant._ask

        def ear(request):
            reply = own(request)
            heard.append(json.dumps(reply))
            return reply

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
            with refused(409, "answered otherwise already"):  # nobody is told yes for what is not in the log
                live.answer(view, answers={q["name"]: q["options"][1]["value"] for q in view["questions"]})
        assert live.until(lambda view: view["phase"] == "done")["progress"]["done"] == 12
        answers = live.events("answer")
        assert [event.data["id"] for event in answers] == list(range(1, 13))
        assert {event.data["client"] for event in answers} == {"me"}
        assert answers[0].data["browser"]["response_s"] == 0.0125
        live.replays()
        table = validation_table([live.replayed()])
        assert table["response_time"].tolist() == [0.0125] * 12 and "shortest_time" not in table
        check_order(live.events())
        state = live.hub.state
    listening.join(PATIENCE)
    assert any(line.startswith("event: view") for line in heard)
    check_blinding("\n".join(heard), state, "K1", "B1", "alpha")


def test_memory_is_set_aside_once_before_anything_is_felt_by_a_command_alone(tmp_path, monkeypatch):
    done = []
    monkeypatch.setattr(gc, "freeze", lambda: done.append("frozen"))
    with Live(tmp_path, warm=False) as live:  # a hub of a program of one's own
        live.hub.settle = lambda: done.append(live.hub.begun)
        live.warmed.set()
        live.begin()
        live.question()
    assert done == [False]
    hub, log = opened(
        Wanted(live.folder / "study.toml", "P02", logs=tmp_path, dry_run=True), lambda *_: None, lambda _: None
    )
    log.close()
    hub.settle()
    assert done == [False, "frozen"]


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
    with refused(409, "another trial"):  # pressed before the page had the newer view
        live.participant.post("/api/participant/break", {"trial": name})
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
    assert view["means"] == {"void": {"trial": 2, "name": "V2"}, "undo": {"trial": 1, "name": "V1"}, "skip": None}
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


def test_a_voided_answer_is_restored_from_its_row(tmp_path):
    with Live(tmp_path, seconds=0.25) as live:
        live.begin()
        live.answer()
        live.until(lambda view: view["phase"] != "answer")
        live.command("pause")  # what is being felt begins again: void means the answer
        assert live.until(lambda v: v["means"]["void"]["trial"] == 1, live.whole)
        with refused(400, "by the id of its trial"):
            live.command("restore")
        with refused(409, "no voided answer"):
            live.command("restore", trial=1)
        live.command("void", trial=1, reason="a cough")
        rows = live.whole()["table"]["rows"]
        assert [row.get("restore") for row in rows if row["cells"][0] == "V1"] == [{"trial": 1, "name": "V1"}]
        live.command("restore", trial=1)
        assert live.hub.state.trials[0].status == "answered" and live.hub.state.skipped(0) == []
        assert not any("restore" in row for row in live.whole()["table"]["rows"])
        live.replays()


def test_the_page_says_how_long_a_pause_was_while_it_lasts_and_after_it(tmp_path, monkeypatch):
    def rows(view):
        return dict(view["trial"])

    with Live(tmp_path) as live:
        live.begin()
        live.answer()
        live.command("pause")
        assert not {"Pauses", "Last activity"} & set(rows(live.whole()))
        later = SimpleNamespace(**vars(time) | {"time": lambda: time.time() + 86_400.0})
        for module in ("hub.hub", "pages.views"):
            monkeypatch.setattr(f"hilbo.app.{module}.time", later)
        assert rows(live.whole())["Last activity"].endswith(", 1 d ago")
        live.command("resume")
        seen = live.until(lambda view: "Pauses" in rows(view), live.whole)
        assert rows(seen)["Pauses"] == "1, the last of 1 d before V2" and "Last activity" not in rows(seen)
        assert any("A pause of 1 d. V2" in words for _, _, words in seen["log"])
        assert seen["whole"]["pauses"][0]["trial"] == 2
        live.replays()


class WarmedUp(Live):
    """A warm-up of one rendering and a comparison; the warm-up comes again after an hour."""

    def make_study(self, seconds, warm_up):
        file = super().make_study(seconds, warm_up)
        path = self.folder / "study.toml"
        text = path.read_text()
        path.write_text(text.replace("[session.warm_up]", "[session]\nwarm_up_after_pause = 3600\n[session.warm_up]"))
        return type(file).load(path)


WARMED = (Block("warm-up", 1, (Planned("best"), Planned("mid"))), Block("validation", 2, PAIRS[:2]))


def go_on(live):
    """From the end of the warm-up."""
    live.until(lambda view: view["phase"] == "ready")
    live.participant.post("/api/participant/begin", {})


deep = pytest.mark.deep  # each starts two servers


@pytest.mark.parametrize("how", ["late Begin", pytest.param("break", marks=deep), pytest.param("restart", marks=deep)])
def test_after_a_long_pause_the_warm_up_comes_again(tmp_path, monkeypatch, how):
    later = SimpleNamespace(**vars(time) | {"time": lambda: time.time() + 86_400.0})

    def tomorrow():
        for module in ("hub.hub", "hub.runner"):
            monkeypatch.setattr(f"hilbo.app.{module}.time", later)

    with WarmedUp(tmp_path, blocks=WARMED) as live:
        live.begin()
        live.answer()
        go_on(live)
        live.answer()
        live.until(lambda view: view["phase"] == "step")
        if how == "break":
            live.command("pause")
    if how == "restart":
        tomorrow()
    with WarmedUp(tmp_path, blocks=WARMED) as live:
        live.until(lambda view: view["may"]["begin"] or view["phase"] == "paused")
        tomorrow()
        live.command("resume") if how == "break" else live.begin()
        live.answer()
        go_on(live)
        live.answer()
        live.until(lambda view: view["phase"] == "done")
        counted = [trial.data["phase"] for trial in live.hub.state.trials if trial.status == "answered"]
        assert counted == ["warm-up", "validation", "warm-up", "validation"]
        assert [event.data["pause_s"] > 80_000 for event in live.events("warm_up")] == [True]
        live.replays()


def test_a_trial_that_the_device_always_stops_may_be_left_out(tmp_path):
    blocks = (Block("validation", 1, (Planned("best", "mid"),)),)
    with Live(tmp_path, blocks=blocks, seconds=0.3) as live:
        with refused(409, "stopped twice"):
            live.command("skip")
        live.begin()
        for _ in range(2):
            live.until(lambda view: view["step"] and view["step"]["show"] == "a")
            live.command("estop")
            live.until(lambda view: "clear" in view["may"] and view["phase"] == "trouble", live.whole)
            live.command("clear")
        view = live.until(lambda view: "skip" in view["may"], live.whole)
        assert "1 put off to the end: stopped twice by the device" in view["trial"][0][1]
        live.command("skip", trial=view["means"]["skip"]["trial"], reason="slips")
        assert live.until(lambda view: view["phase"] == "done", live.whole)["trial"][0][1] == "0 of 1; 1 left out"
        live.replays()


@pytest.mark.parametrize(
    "choice",
    [
        {"by": "ucb"},
        {"by": "ucb", "mean": None, "sd": None, "score": None, "probabilities": None, "margin": None},
        {"by": "ucb", "mean": 0.5, "sd": 0.1, "certificate": {"converged": False, "residual": None}},
        {"by": "ucb", "probabilities": {"close": None, "similar": 0.25}, "margin": {"a": None, "b": 0.5}},
    ],
)
def test_the_page_shows_what_there_is_of_a_choice(choice):
    rows = dict(choice_rows(choice))
    assert rows["Chosen by"] == ("ucb, mean 0.500 ± 0.100" if choice.get("mean") else "ucb")
    assert rows.get("Certificate") == ("fit NOT converged" if "certificate" in choice else None)
    assert rows.get("Predicted answer") == ("similar 25 %" if choice.get("probabilities") else None)
    assert rows.get("Passivity margin") == ("b 0.5000 N·s/m" if choice.get("margin") else None)
