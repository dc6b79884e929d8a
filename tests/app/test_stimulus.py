"""Sessions whose renderings a program presents: what it is told, what it confirms, what it may not do."""

import contextlib
import json
import threading
import urllib.request

import pytest
from live_server import DATA, PATIENCE, Live, check_blinding, listen, refused
from live_stimulus import SETS, SINGLE, ByHand, LiveStimulus, Presenter, all_answered, module

from hilbo.app.rehearsal.robot import Client
from hilbo.cli import doctor
from hilbo.errors import InputError
from hilbo.session.export.tables import trials_table
from hilbo.study.file.plan_file import Block, Planned
from hilbo.study.template import NewStudy, parameter_of, study_text

ONE = (Block("warm-up", 1, (Planned("best"),)),)


@pytest.fixture
def live(tmp_path):
    with LiveStimulus(tmp_path) as session:
        yield session


@pytest.fixture
def brief(tmp_path):
    """A session that waits a moment for a confirmation."""
    with LiveStimulus(tmp_path, within=0.5) as session:
        yield session


def voided(live, words, phase="hello"):
    """Waits until a trial is void for this reason, and nothing goes on before Begin."""
    view = live.until(lambda v: any(t["voided"] for t in v["whole"]["trials"]) and v["phase"] == phase, live.whole)
    trial = next(t for t in view["whole"]["trials"] if t["voided"])
    assert trial["voided"]["by"] == "rule" and words in trial["voided"]["reason"]
    assert any(row["kind"] == "voided" for row in view["table"]["rows"])
    assert not live.events("answer")
    return trial


def test_a_whole_session_by_the_shipped_client(tmp_path):
    with LiveStimulus(tmp_path, repeats=2) as live, live.present() as program:
        heard, own = [], live.participant._ask
        live.participant._ask = lambda request: heard.append(json.dumps(reply := own(request))) or reply
        listening = threading.Thread(target=listen, args=(live, heard))
        listening.start()
        live.begin()
        for _ in range(6):
            view = live.question()
            assert {e.data["side"] for e in live.events("sent") if e.data["id"] == number(view)} == {"a", "b"}
            live.answer(view)
        live.until(lambda view: view["phase"] == "done")
        sent, state = live.events("sent"), live.hub.state
        assert {(e.data["program"], e.data["version"], e.data["force"]) for e in sent} == {("presenter", "1.2", False)}
        tests = [order for order in program.shown if order.show == "test"]
        assert [order.values for order in tests] == [e.data["values"] for e in sent]
        shown = [(order.show, order.side) for order in program.shown[:3]]
        assert shown == [("reference", ""), ("test", "a"), ("test", "b")]
        live.replays()
    listening.join(PATIENCE)
    assert any(line.startswith("event: view") for line in heard)
    check_blinding("\n".join(heard), state, "hue", "light")


def number(view):
    return int(view["trial"]["id"].split(":")[1].split(".")[0])


def test_nothing_is_asked_before_it_was_confirmed(live):
    program = live.by_hand()
    live.begin()
    order = program.asked(live)
    assert live.until(lambda view: view["step"] is None)["questions"] is None
    answers = {"class_a": "close", "class_b": "close", "preferred": "a"}
    with refused(409, "not been felt"):
        live.participant.post("/api/participant/answer", {"trial": order["trial"], "client": "me", "answers": answers})
    program.report("presented", values=order["values"])
    live.until(lambda _: live.events("sent"))
    assert not live.events("answer")


def test_what_is_confirmed_counts_and_the_proposal_stays_in_the_log(tmp_path):
    with LiveStimulus(tmp_path, blocks=SINGLE) as live, live.present() as program:
        program.off = 0.25
        live.begin()
        for _ in range(3):
            live.answer()
        live.until(lambda view: view["phase"] == "done")
        table = trials_table([live.replayed()])
        proposed = [event.data["renderings"]["a"]["hue"] for event in live.events("propose")]
        assert table["hue"].tolist() == [hue + 0.25 for hue in proposed]
        assert proposed == [values["hue"] for values in SETS.values()]


@pytest.mark.deep  # a whole session with its choices: 2 s
def test_nobody_waits_for_a_fit_though_something_else_is_presented_than_was_asked_for(tmp_path):
    with LiveStimulus(tmp_path, blocks=(Block("optimisation", 5),)) as live, live.present() as program:
        program.off = -0.25
        live.begin()
        for _ in range(5):
            view = live.question()
            live.hub.runner._ahead.result(PATIENCE)  # a person takes longer
            live.answer(view)
        live.until(lambda view: view["phase"] == "done")
        assert live.hub.runner.fits_after == 0
        proposed = [event.data for event in live.events("propose")]
        assert [data["choice"]["by"] for data in proposed] == 3 * ["latin hypercube"] + 2 * ["ucb"]
        live.replays()


def test_a_late_confirmation_voids_the_trial_and_is_refused(brief):
    program = brief.by_hand()
    brief.begin()
    late = program.asked(brief)
    trial = voided(brief, "late: nothing was confirmed within 0.5 s")
    with refused(409, "comes too late"):
        program.report("presented", order=late["order"], trial=late["trial"], values=late["values"])
    program.report("busy", order=late["order"])
    brief.begin()
    again = program.asked(brief)
    assert again["values"] == late["values"] and again["trial"] != late["trial"]
    program.report("presented", values=again["values"])
    brief.until(lambda _: brief.events("sent"))
    assert trial["voided"]["sides"] == ["a"]


def test_a_value_that_is_too_far_off_voids_the_trial(live):
    program = live.by_hand()
    live.begin()
    order = program.asked(live)
    with refused(409, "the tolerance is 0.5 deg"):
        program.report("presented", values=order["values"] | {"hue": order["values"]["hue"] + 0.51})
    voided(live, "stimulus: off: hue is confirmed as")


def test_a_program_that_fails_voids_the_trial_and_says_why(live):
    program = live.by_hand()
    live.begin()
    program.asked(live)
    program.report("failed", why="no such sample")
    voided(live, "stimulus: failed: no such sample")


def test_what_is_not_understood_or_not_of_the_order_changes_nothing(live):
    program = live.by_hand()
    live.begin()
    order = program.asked(live)
    good = {"state": "presented", "values": order["values"]}
    for words, more in {
        "There is no order 999 yet": {"order": 999},
        "and no other": {"trial": "tag:9.1"},
        "a value for hue, light": {"values": {"hue": 1.0}},
        "and for nothing else": {"values": order["values"] | {"depth": 1.0}},
        "hue is confirmed as red; it must be a number from 0 to 360 deg.": {"values": {"hue": "red", "light": 1.0}},
    }.items():
        with refused(409, words):
            program.report(**good | more)
    for words, more in {
        "`float | str`": {"values": {"hue": None, "light": 1.0}},
        "not understood": {"state": "dancing"},
        "order`": {"order": -1},
        "unknown field": {"colour": 3},
    }.items():
        with refused(400, words):
            program.report(**good | more)
    bodies = [b'{"run": NaN}', json.dumps({"run": program.run, "order": order["order"]} | good).encode()[:-1]]
    bodies.append(json.dumps({"run": program.run, "order": order["order"]} | good).replace("54.32", "1e999").encode())
    for body in bodies:
        with refused(400, "not understood"):
            raw(program, body)
    with refused(409, "send hello first"):
        program.post("/api/stimulus", {"run": "another", "order": 1, "state": "neutral"})
    assert not live.events("sent") and not live.events("missed")
    program.report(**good)
    live.until(lambda _: live.events("sent"))


def raw(program, body):
    """A report of these bytes."""
    request = urllib.request.Request(program.address + "/api/stimulus", data=body, headers=program._headers())
    return urllib.request.urlopen(request, timeout=PATIENCE)


def test_a_confirmation_that_comes_twice_counts_once(tmp_path):
    with LiveStimulus(tmp_path, felt=60.0) as live:
        program = live.by_hand()
        live.begin()
        order = program.asked(live)
        for _ in range(3):
            assert program.report("presented", values=order["values"])["order"] == order["order"]
        with refused(409, "other values before"):
            program.report("presented", values=order["values"] | {"hue": order["values"]["hue"] + 0.1})
        live.until(lambda _: live.events("sent"))
        assert len(live.events("sent")) == 1


def test_a_key_opens_its_own_role_in_its_own_session_and_a_browser_takes_no_link_away(live, tmp_path):
    link = live.link()
    stranger = Client(live.place.link("participant"))
    with refused(401):
        stranger.post("/api/stimulus/hello", {"name": "x", "version": "", "force": False, "neutral_within_s": 1.0})
    with refused(400, "not for a browser"):
        stranger.post("/api/join", {"token": link.partition("/#")[2]})
    program = ByHand(link)
    for path in ("/api/experimenter", "/api/participant"):
        with refused(401):
            program.get(path)
    with refused(401):
        Client.post(program, "/api/experimenter/estop", {})
    folder = tmp_path / "another"
    folder.mkdir()
    with LiveStimulus(folder) as other:
        program.address = other.participant.address
        with refused(401):
            program.report("neutral")


def test_a_flood_takes_nothing_from_others(live):
    program = live.by_hand()
    for _ in range(60):
        program.report("neutral", wait_s=0)
    live.begin()
    program.asked(live)
    assert live.whole()["device"]["state"] == "running"


def test_a_silent_program_is_lost_and_comes_back_by_hello(tmp_path):
    with LiveStimulus(tmp_path, silence=0.6, seconds=60.0) as live:
        program = live.by_hand()
        live.begin()
        order = live.until(lambda o: o["do"] == "present", lambda: program.report("neutral"))
        program.report("presented")
        live.until(lambda view: view["step"])
        live.until(lambda v: v["device"]["state"] == "lost", live.whole)
        voided(live, "device: lost (by hand has been silent for 0.6 s.)", "trouble")
        with refused(409, "send hello first"):
            program.report("presented", order=order["order"])
        program.hello()
        program.report("neutral")
        live.until(lambda v: v["device"]["state"] == "stopped", live.whole)
        live.device_did("stopped", "ready", "lost", "ready")


def test_a_program_with_the_key_of_one_that_is_heard_waits_until_that_is_silent(tmp_path):
    with LiveStimulus(tmp_path, silence=0.6) as live:
        first = live.by_hand()
        second = ByHand.__new__(ByHand)
        second.__dict__.update(first.__dict__)
        with refused(409, "A program that joined by this link is still heard; end that one. by hand can begin once"):
            second.hello()
        first.report("neutral")
        live.until(lambda v: v["device"]["state"] == "lost", live.whole)
        second.hello()
        second.report("neutral")
        with refused(409, "send hello first"):
            first.report("neutral")
        live.device_did("stopped", "ready", "lost", "ready")


def test_a_program_with_a_newer_link_takes_over_at_once(live):
    first, second = live.by_hand(), live.by_hand()
    with refused(401, "no longer part"):
        first.report("neutral")
    second.report("neutral")
    live.device_did("stopped", "ready", "lost", "ready")


def test_a_program_that_has_not_joined_yet_is_waited_for_and_is_no_fault(live):
    seen = live.until(lambda v: v["phase"] == "trouble", live.whole)
    assert (seen["device"]["state"], seen["device"]["level"], seen["alert"]) == ("waiting", "rest", None)
    assert seen["phase_words"] == "Waiting for the stimulus program: start it with its link"
    live.by_hand()
    live.until(lambda v: v["device"]["state"] == "stopped", live.whole)


def test_nobody_presents_before_the_stop_was_seen(live):
    program = live.by_hand(force=True, ready=False, neutral_within_s=10.0)
    assert program.order["do"] == "stop"
    live.participant.post("/api/participant/begin", {})
    assert live.whole()["device"]["state"] == "waiting"
    with refused(409, "is stop; there is nothing to present"):
        program.report("presented", trial="tag:1.1")
    program.report("neutral")
    live.until(lambda _: len(live.events("device")) > 1)
    ready = live.events("device")[-1].data
    assert (ready["condition"], ready["program"], ready["force"]) == ("ready", "by hand", True) and ready["stop_s"] >= 0
    program.asked(live, "reference")


def test_a_program_that_does_not_go_neutral_when_told_is_lost(tmp_path):
    with LiveStimulus(tmp_path, seconds=0.05) as live:
        program = live.by_hand(force=True, neutral_within_s=0.01)
        live.begin()
        order = program.asked(live, "reference")
        program.report("presented")
        live.until(lambda v: v["device"]["state"] == "running", live.whole)
        live.command("pause")
        live.until(lambda v: "has not confirmed neutral" in v["device"]["words"], live.whole)
        with refused(409, "send hello"):
            program.report("presented", order=order["order"])


def test_an_emergency_stop_is_acknowledged_voids_and_holds_until_it_is_cleared(tmp_path):
    with LiveStimulus(tmp_path, felt=60.0) as live, live.present():
        live.begin()
        live.until(lambda view: view["step"] and view["step"]["show"] == "a")
        live.command("estop")
        seen = live.until(lambda v: v["device"]["state"] == "estop" and v["phase"] == "trouble", live.whole)
        assert "clear" in seen["may"] and "stopped within" in seen["device"]["words"]
        assert live.hub.state.trials[0].voided["by"] == "rule"
        assert live.view()["step"] is None and live.view()["questions"] is None
        live.command("clear")
        live.until(lambda view: view["step"])
        stopped, ready = (event.data for event in live.events("device")[-2:])
        assert (stopped["condition"], ready["condition"]) == ("estop", "ready")
        assert "stop_s" not in stopped and ready["stop_s"] >= 0  # it was known when it had been acknowledged


@pytest.mark.deep  # what was broken off is tried again after a second
def test_a_stop_while_a_confirmation_is_waited_for_ends_the_wait(tmp_path):
    with LiveStimulus(tmp_path, within=600.0) as live:  # as long as a person may take
        program = live.by_hand()
        live.begin()
        program.until(live, lambda order: order["do"] == "present")  # the first step: the trial has not begun
        stopping = threading.Thread(target=live.command, args=("estop",))
        stopping.start()
        program.until(live, lambda order: order["do"] == "stop")
        program.report("neutral")
        stopping.join(PATIENCE)
        live.command("clear")
        program.until(live, lambda order: order["do"] == "present")
        assert not live.events("missed")


def test_a_stop_that_nobody_acknowledges_is_said(live):
    live.by_hand(force=True, neutral_within_s=0.01)
    with refused(409, "use the hardware switch"):
        live.command("estop")
    live.until(lambda v: v["device"]["state"] == "lost", live.whole)


def test_parameters_change_only_while_nobody_touches(live):
    program = live.by_hand(force=True)
    live.begin()
    program.asked(live, "reference")
    program.report("presented")

    def touched():
        return program.report("presented", contact=True)

    held = live.until(lambda _: live.view()["title"].startswith("Let go"), touched)
    assert held["show"] == "reference"
    live.until(lambda order: order.get("show") == "test", lambda: program.report("presented", contact=False))


def test_pause_and_the_end_of_a_trial_are_neutral(live):
    with live.present() as program:
        live.begin()
        view = live.question()
        live.until(lambda _: program.stimulus.order.do == "neutral")
        live.answer(view)
        live.until(lambda _: program.stimulus.order.do == "present")
        live.command("pause")
        live.until(lambda v: v["device"]["state"] == "stopped", live.whole)
        assert program.stimulus.order.do == "neutral"


@pytest.fixture
def arm(tmp_path):
    """A session, a client with force that presents in it, and how often that went neutral since."""
    calls = []
    with LiveStimulus(tmp_path, seconds=5.0, silence=0.5) as live:
        said = {"force": True, "go_neutral": lambda: calls.append(1), "neutral_within_s": 0.5}
        with Presenter(live.link(), **said) as program:
            live.begin()
            live.until(lambda v: v["device"]["state"] == "running", live.whole)
            calls.clear()
            yield live, program, calls


def test_a_client_with_force_is_neutral_when_the_server_says_nothing_any_more(arm):
    live, program, calls = arm
    held = threading.Event()
    live.hub._loop.call_soon_threadsafe(held.wait, PATIENCE)
    live.until(lambda _: calls and program.stimulus.order.number == 0, lambda: None)
    assert program.stimulus.order.do == "neutral"
    held.set()
    live.until(lambda v: v["device"]["state"] == "stopped", live.whole)  # and it is back, by hello


def test_a_client_with_force_is_neutral_when_the_server_is_gone(arm):
    live, program, calls = arm
    live.hub.rig.hang_up = lambda: None  # as if killed: nobody is told
    live.stop()
    live.until(lambda _: calls and program.stimulus.order.number == 0, lambda: None)
    assert program.stimulus.order.do == "neutral"


def test_with_force_a_client_gives_what_makes_it_neutral():
    with pytest.raises(ValueError, match="go_neutral"):
        module("hilbo_stimulus").Stimulus("http://127.0.0.1:1/#x", "a", force=True)


def test_a_link_that_is_not_the_stimulus_s_is_refused(live):
    client = module("hilbo_stimulus")
    with pytest.raises(client.StimulusError, match="not the one for the stimulus"):
        client.Stimulus(live.place.link("participant"), "a")
    with pytest.raises(client.StimulusError, match="has been used"):
        client.Stimulus(live.link() + "x", "a")


def test_a_program_that_was_killed_is_taken_back_by_its_link_and_its_trial_is_void(tmp_path):
    with LiveStimulus(tmp_path, silence=0.5, blocks=ONE) as live:
        link = live.link()
        killed = ByHand(link)
        live.begin()
        killed.asked(live)  # and nothing more is heard of it
        with Presenter(link):
            with refused(401, "no longer part of it"):
                killed.report("busy")
            assert len(all_answered(live)) == 1
        voided = [trial.voided for trial in live.replayed().trials if trial.status == "void"]
        assert len(voided) == 1 and "has been silent for 0.5 s" in str(voided)


def test_a_second_program_with_the_link_of_one_that_lives_is_refused(tmp_path):
    with LiveStimulus(tmp_path, silence=0.5, blocks=ONE) as live:
        link = live.link()
        with Presenter(link):
            live.until(lambda v: v["device"]["state"] == "stopped", live.whole)
            with refused(401, "used by a program that is still there; end that one first"):
                ByHand(link)
            assert len(all_answered(live)) == 1
        assert not any(trial.status == "void" for trial in live.replayed().trials)


def test_no_program_presents_where_a_device_does(tmp_path):
    with Live(tmp_path) as live:
        with refused(409, "a device renders"):
            live.command("invite", role="stimulus")
        program = Client(live.place.link("stimulus"))
        with refused(400, "a device renders"):
            program.post("/api/stimulus/hello", {"name": "x", "version": "", "force": False, "neutral_within_s": 1.0})


def checked(tmp_path, program):
    """What the doctor finds of a program that is given the link."""
    file = tmp_path / "study.toml"
    file.write_text(study_text(NewStudy("x", (parameter_of("hue=0:360:deg"), parameter_of("light=20:80:%")))))
    checks, links, closing = [], [], contextlib.ExitStack()

    def join(text, **_):
        links.append(text.split()[-1])
        thread = threading.Thread(target=lambda: closing.enter_context(program(links[0])))
        thread.start()
        closing.callback(thread.join)

    with pytest.MonkeyPatch.context() as patch, closing:
        patch.setattr(doctor, "print", join, raising=False)
        checks += doctor.stimulus_checks(file, 0, PATIENCE)
    return checks


def test_the_doctor_measures_renderings_and_stops(tmp_path):
    shown, stop = checked(tmp_path, Presenter)
    assert (shown.level, stop.level, stop.name) == ("good", "good", "the program's stop")
    assert stop.words.startswith("presenter 1.2, no force: 5 times, the slowest after ")


def test_the_doctor_says_what_a_program_does_not_do(tmp_path):
    (check,) = checked(tmp_path, lambda link: Presenter(link, off=5.0))
    assert check.level == "bad" and "the tolerance is" in check.words
    (check,) = doctor.stimulus_checks(tmp_path / "study.toml", 0, 0.2)
    assert check.level == "bad" and "No program that presents has joined yet" in check.words


def test_the_doctor_stops_no_program_where_a_device_renders():
    with pytest.raises(InputError, match="a device renders"):
        list(doctor.stimulus_checks(DATA, 0))
