"""A person presents by hand: the preparer's messages, what experimenter and participant are not told, the log."""

import contextlib
import json
import re
import threading
import urllib.error

import pytest
from live_server import PATIENCE, check_blinding, listen, refused
from live_stimulus import SETS, SINGLE, ByHand, LiveStimulus

from hilbo.app.hub.opening import Wanted, _header
from hilbo.app.pages.blind import _SAME
from hilbo.app.pages.slices import Maps
from hilbo.app.rehearsal.robot import Client, Participant, browser, find_browser, screenshots
from hilbo.cli import doctor
from hilbo.errors import InputError
from hilbo.session.log.event_log import EventLog, read_log
from hilbo.session.plan.set_codes import label_of
from hilbo.study.file.reading import StudyFile
from hilbo.study.template import NewStudy, parameter_of, study_text

BY_PERSON = 'by = "person"\n'


class Preparer(ByHand):
    role = "preparer"


@pytest.fixture
def live(tmp_path):
    with LiveStimulus(tmp_path, more=BY_PERSON, repeats=1, maps=Maps) as session:
        yield session


def played(live, preparer):
    """The whole session; what the preparer was asked for."""
    asked = []

    def acted():
        view, order = live.view(), preparer.order
        if view["may"]["begin"]:
            live.participant.post("/api/participant/begin", {})
        elif view["questions"]:
            live.answer(view)
        if order["do"] == "present":
            asked.append(order)
            values = {"values": order["values"]} if order["values"] else {}
            preparer.report("presented", **values)
            live.until(lambda _: preparer.report("busy")["order"] != order["order"])
        else:
            preparer.report("neutral")
        return view

    live.until(lambda view: view["phase"] == "done", acted)
    return asked


def test_a_session_by_hand_in_which_only_the_preparer_knows(live):
    preparer = Preparer(live.place.link("preparer"))
    experimenter, participant, own = [], [], live.participant._ask
    live.participant._ask = lambda request: participant.append(json.dumps(reply := own(request))) or reply
    listening = threading.Thread(target=listen, args=(live, participant))
    listening.start()

    def watched():
        experimenter.append(json.dumps(live.whole()))
        return preparer.report("busy" if preparer.order["do"] == "present" else "neutral")

    live.until(lambda order: order["do"] == "neutral", watched)
    asked = played(live, preparer)
    watched()
    tests = [order for order in asked if order["show"] == "test"]
    assert len(tests) == 6 and all(order["label"] == label_of(order["values"], "tag") for order in tests)
    assert len({order["label"] for order in tests}) == 3
    with refused(404):
        live.experimenter.get("/api/experimenter/map")
    seen = live.whole()
    assert {row["cells"][3] for row in seen["table"]["rows"]} <= {
        f"{a['label']} / {b['label']}" for a in tests for b in tests
    }
    assert [trial["values"] for trial in seen["whole"]["trials"]] == [t.values for t in live.hub.state.trials]
    told = "\n".join(experimenter)
    for text in (*SETS, "hue", "light", "posterior", "certificate", "renderings", 'choice"'):
        assert f'"{text}' not in told and f" {text}" not in told, text
    for values in SETS.values():
        for value in values.values():
            for text in (str(value), f"{value:.4g}"):
                assert not re.search(rf"(?<![\d.]){re.escape(text)}(?![\d.])", told)
    live.stop()
    listening.join(PATIENCE)
    check_blinding("\n".join(participant), live.hub.state, "hue", "light", *(order["label"] for order in tests))


def test_the_experimenter_is_told_what_went_wrong_without_a_value(tmp_path):
    with LiveStimulus(tmp_path, more=BY_PERSON, blocks=SINGLE) as live:
        preparer = Preparer(live.place.link("preparer"))
        live.begin()
        order = preparer.asked(live)
        with refused(409, "the tolerance is 0.5 deg"):
            preparer.report("presented", values=order["values"] | {"hue": order["values"]["hue"] + 9})
        seen = live.until(lambda v: any(row["kind"] == "voided" for row in v["table"]["rows"]), live.whole)
        told = json.dumps(seen)
        assert "off" in told and f"{order['values']['hue']:.4g}" not in told and "hue" not in told
        assert {"void", "pause"} <= set(seen["may"]) | {"void"} and set(_SAME) <= set(seen)


def test_who_knew_stands_in_the_log_and_a_study_may_say_otherwise(tmp_path):
    for says, knew in (("", ("preparer",)), ("experimenter_sees = true\n", ("preparer", "experimenter"))):
        folder = tmp_path / str(len(knew))
        folder.mkdir()
        text = study_text(NewStudy("x", (parameter_of("hue=0:360:deg"),), by="person"))
        file = folder / "study.toml"
        file.write_text(text.replace('by = "person"', f'by = "person"\n{says}'))
        study = StudyFile.load(file)
        header = _header(Wanted(file, "P01", dry_run=True), study)
        EventLog.create(folder / "log", study, header).close()
        assert read_log(folder / "log", study)[0].shown_to == knew


def test_the_experimenter_who_may_know_sees_all(tmp_path):
    with LiveStimulus(tmp_path, more=BY_PERSON + "experimenter_sees = true\n", blocks=SINGLE) as live:
        preparer = Preparer(live.place.link("preparer"))
        live.begin()
        preparer.asked(live)
        assert any("hue 123.5 deg" in words for _, words in live.whole()["trial"])


def test_one_presents_and_the_other_is_refused(live, tmp_path):
    with refused(409, "a person presents"):
        live.command("invite", role="stimulus")
    assert "link" in live.command("invite", role="preparer")
    with refused(400, "a person presents, and no program"):
        ByHand(live.link())
    preparer = Preparer(live.place.link("preparer"))
    for path in ("/api/experimenter", "/api/participant", "/api/preparer/events"):
        with pytest.raises(urllib.error.HTTPError, match=r"40[145]"):
            preparer.get(path)
    folder = tmp_path / "program"
    folder.mkdir()
    with LiveStimulus(folder) as other:
        with refused(400, "a program presents, and no person"):
            Preparer(other.place.link("preparer"))
        with refused(409, "a program presents"):
            other.command("invite", role="preparer")


@pytest.mark.parametrize(("key", "value"), [("within", "1.0"), ("silence", "1.0")])
def test_a_person_is_given_time(tmp_path, key, value):
    text = study_text(NewStudy("x", (parameter_of("hue=0:360:deg"),), by="person"))
    line = next(line for line in text.splitlines() if line.startswith(f"{key} = "))
    file = tmp_path / "study.toml"
    file.write_text(text.replace(line, f"{key} = {value}"))
    with pytest.raises(InputError, match=f"stimulus.{key} is 1 s, and a person presents; give them"):
        StudyFile.load(file)


def test_the_doctor_has_no_person_stop(tmp_path):
    file = tmp_path / "study.toml"
    file.write_text(study_text(NewStudy("x", (parameter_of("hue=0:360:deg"),), by="person")))
    with pytest.raises(InputError, match="a person presents, and no program"):
        list(doctor.stimulus_checks(file, 0))
    (check,) = (c for c in doctor._stimulus(StudyFile.load(file)) if c.name == "stimulus")
    assert check.words.startswith("a person presents, and confirms within 120 s")


@pytest.mark.deep
@pytest.mark.skipif(find_browser() is None, reason="needs playwright and Chromium (Debian: chromium)")
def test_the_preparer_s_page_from_ready_to_the_end(tmp_path):
    from playwright.sync_api import TimeoutError as TooLate

    with LiveStimulus(tmp_path, within=600.0, more=BY_PERSON, blocks=SINGLE, seconds=0.5) as live, browser() as program:
        errors = []
        page = program.new_context(viewport={"width": 1024, "height": 768}).new_page()
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(live.place.link("preparer"))
        page.wait_for_url("**/preparer")
        window = program.new_context().new_page()
        participant = Participant(window, live.place.link("participant"), live.whole, lambda *_: "similar")
        pictures = tmp_path / "pictures"
        pictures.mkdir()
        taken = set()

        def phase():
            phase_ = page.evaluate("document.body.dataset.phase")
            name = f"{phase_}-{page.evaluate('order.show || order.do')}"
            if name not in taken:
                taken.add(name)
                screenshots(page, pictures, name)
            return phase_

        def acted(but=""):
            if participant.phase != "done":
                participant.act()
            if phase() in ("ready", "present", "away", "stop") and page.evaluate("order.show") != but:
                page.wait_for_timeout(350)
                with contextlib.suppress(TooLate):  # the order changed meanwhile: look again
                    page.click("#go", timeout=1000)
            return participant.phase

        page.wait_for_selector("#go")
        assert phase() == "ready"
        live.until(lambda _: phase() == "present", lambda: acted("reference"))
        stopping = threading.Thread(target=live.command, args=("estop",))
        stopping.start()
        page.wait_for_selector("body[data-phase=stop]")
        assert phase() == "stop"
        page.wait_for_timeout(350)
        page.click("#go")
        stopping.join(PATIENCE)
        assert live.whole()["device"]["state"] == "estop"
        live.command("clear")
        live.until(lambda _: phase() == "present" and page.evaluate("order.show") == "test", lambda: acted("test"))
        page.click("#could-not")
        page.fill("#why-text", "the box is empty")
        page.wait_for_timeout(350)
        screenshots(page, pictures, "why")
        page.click("#why button")
        live.until(lambda _: live.events("missed"), lambda: None)
        assert live.events("missed")[0].data["reason"] == "failed: the box is empty"
        experimenter = program.new_context(viewport={"width": 1440, "height": 900}).new_page()
        experimenter.goto(live.place.link("experimenter"))
        experimenter.wait_for_selector("#log li")
        experimenter.screenshot(path=pictures / "experimenter.png")
        live.experimenter = Client(live.place.link("experimenter"))
        live.until(lambda phase_: phase_ == "done", acted)
        assert {"ready-neutral", "present-reference", "present-test", "stop-stop"} <= taken
        assert len(live.events("answer")) == 3 and errors == []
        confirmed = [event.data["values"] for event in live.events("sent")]
        for values, asked in zip(confirmed, SETS.values(), strict=True):
            assert abs(values["hue"] - asked["hue"]) <= 0.05 and values["light"] == round(asked["light"], 5)
        live.replays()
