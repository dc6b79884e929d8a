"""Whole sessions in headless Chromium: real server, real pages, the firmware's own core as the device."""

import json
import os
import subprocess
import time

import pytest
from live_server import DATA, PATIENCE, Live

from hilbo.app.pages.slices import Maps
from hilbo.app.rehearsal import rehearsal
from hilbo.app.rehearsal.robot import Client, Participant, browser, find_browser, held
from hilbo.session.log.event_log import EventLog, read_log
from hilbo.study.config import Study
from hilbo.study.file.plan_file import Block, Planned
from hilbo.study.template import NewStudy, parameter_of, study_text

pytestmark = [
    pytest.mark.deep,
    pytest.mark.skipif(find_browser() is None, reason="needs playwright and Chromium (Debian: chromium)"),
]


@pytest.mark.parametrize(("kind", "trials"), [("optimisation", 9), ("validation", 12)])
def test_a_whole_session_by_one_command(tmp_path, kind, trials):
    (tmp_path / "base.toml").write_text(DATA.read_text(encoding="utf-8").replace("trials = 25", "trials = 9"))
    command = [*rehearsal.HILBO, "simulate", "--live", "--study", str(tmp_path / "base.toml"), "--kind", kind]
    command += ["--out", str(tmp_path / "out"), "--step-seconds", "0.3", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary["answers"] == 3 + trials
    assert summary["mishaps"] == []
    assert summary["fits_after_an_answer"] == 0
    assert {name.split("-")[0] for name in summary["screens"]} == {"participant", "experimenter"}
    assert any("800x1280" in name for name in summary["screens"])
    study = Study.load(tmp_path / "out" / "study.toml")
    _, events, dropped = read_log(summary["log"], study.file)
    assert dropped == ""
    assert sum(event.kind == "answer" for event in events) == 3 + trials
    with EventLog.resume(summary["log"], study.file) as log:
        assert log.state.screen == "done"


@pytest.mark.parametrize("by", ["program", "person"])
def test_a_whole_session_of_levels_without_a_device_by_one_command(tmp_path, by):
    named = ("texture=silk,wood,stone", "grains=0:6::integer", "gain=0.5:20:N")
    (tmp_path / "base.toml").write_text(study_text(NewStudy("s", tuple(map(parameter_of, named)), trials=9, by=by)))
    command = [*rehearsal.HILBO, "simulate", "--live", "--study", str(tmp_path / "base.toml")]
    command += ["--out", str(tmp_path / "out"), "--step-seconds", "0.3", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary["answers"] == 12 and summary["mishaps"] == []


@pytest.fixture
def pages(tmp_path, request):
    """A session in this process, the participant's page and the experimenter's; its blocks are of comparisons, or the
    fixture's parameter."""
    blocks = getattr(request, "param", None)
    with Live(tmp_path, seconds=0.1, blocks=blocks, maps=Maps) as live, browser() as program:
        links = live.place.links()
        experimenter = program.new_context().new_page()
        experimenter.goto(links["experimenter"])
        experimenter.wait_for_url("**/experimenter")
        window = program.new_context().new_page()

        def watch():
            return experimenter.evaluate("server.ask('/api/experimenter').then(r => r.json())")

        participant = Participant(
            window, links["participant"], watch, lambda _, ask: "a" if ask == "preferred" else "close"
        )
        yield live, participant, experimenter


def press(experimenter, command, reason=None):
    """A button of the experimenter's page, and Yes where it asks."""
    experimenter.wait_for_selector(f"[data-command={command}]:enabled")
    experimenter.click(f"[data-command={command}]")
    if reason is not None:
        experimenter.fill("#sure-why", reason)
        experimenter.click("#sure button[value=yes]")


def press_key(window, key):
    """A key, once the page takes one."""
    until(window, "performance.now() - laidOut > SETTLES")
    window.keyboard.press(key)


def until(window, expression):
    """Waits for what is true in a page; pages allow no waiting by a script of others."""
    end = time.monotonic() + PATIENCE
    while not window.evaluate(expression):
        assert time.monotonic() < end, expression
        window.wait_for_timeout(20)


def until_logged(live, window, count, kind="answer"):
    end = time.monotonic() + PATIENCE
    while len(live.events(kind)) < count:
        assert time.monotonic() < end
        window.wait_for_timeout(50)


def until_answered(participant, count):
    end = time.monotonic() + PATIENCE
    while participant.answered < count:
        participant.act()
        assert time.monotonic() < end, participant.phase
        time.sleep(0.02)


def until_asked(participant):
    """Waits for a question, and presses Begin meanwhile: on a busy computer the session may be interrupted, as when a
    laptop slept."""
    end = time.monotonic() + PATIENCE
    while not participant.window.is_visible("#options"):
        if participant.window.is_visible("#go"):
            participant.window.evaluate("press('begin')")
        assert time.monotonic() < end, participant.phase
        participant.window.wait_for_timeout(20)


def test_every_button_of_the_experimenter_is_an_event(pages):
    live, participant, experimenter = pages
    until_answered(participant, 1)
    press(experimenter, "pause")
    participant.window.wait_for_selector("body[data-phase=paused]")
    press(experimenter, "resume")
    experimenter.fill("#note-text", "yawned")
    experimenter.keyboard.press("Enter")
    until_asked(participant)
    press(experimenter, "repeat")
    until_asked(participant)
    press(experimenter, "undo", "slipped")
    until_answered(participant, 2)
    press(experimenter, "void", "noise")
    participant.window.wait_for_selector("#break:visible")
    participant.window.click("#break")
    participant.window.wait_for_selector("body[data-phase=paused]")
    press(experimenter, "resume")
    until_answered(participant, 3)
    press(experimenter, "pause")
    participant.window.wait_for_selector("body[data-phase=paused]")
    restorable = False
    while not restorable:  # the first void may be of the next trial, if that was being felt
        before = len(live.events("void"))
        press(experimenter, "void", "a cough")
        until_logged(live, experimenter, before + 1, "void")
        experimenter.wait_for_timeout(300)  # for the page to hear of it
        restorable = experimenter.is_visible("button.restore")
    experimenter.click("button.restore")
    experimenter.click("#sure button[value=yes]")
    until_logged(live, experimenter, 1, "restore")
    press(experimenter, "abort", "enough")
    participant.window.wait_for_selector("body[data-phase=ended]")
    kinds = {event.kind for event in live.events()}
    assert {"pause", "resume", "note", "repeat", "undo", "void", "restore", "abort"} <= kinds
    live.replays()


@pytest.mark.parametrize("way", ["key", "button"])
def test_the_emergency_stop_is_in_reach_while_something_is_asked(pages, way):
    live, participant, experimenter = pages
    until_answered(participant, 1)
    experimenter.wait_for_selector("[data-command=abort]:enabled")
    experimenter.click("[data-command=abort]")
    experimenter.wait_for_selector("#sure[open]")
    if way == "key":
        experimenter.keyboard.press("Escape")
        experimenter.keyboard.press("Escape")
    else:
        experimenter.click("#sure .stop")
    until(experimenter, "view.device.state === 'estop'")
    until(experimenter, "!document.getElementById('sure').open")
    assert live.events("abort") == []


FULL = "e.offsetParent && (e.textContent.trim() || e.querySelector('canvas'))"
EMPTY = f"""[...document.querySelectorAll("section")].filter((s) => s.offsetParent)
    .filter((s) => ![...s.children].slice(1).some((e) => {FULL})).map((s) => s.id)"""


@pytest.mark.parametrize("pages", [(Block("optimisation", 9),)], indirect=True, ids=["optimisation"])
def test_the_experimenter_sees_what_is_simulated_no_map_before_an_answer_and_no_empty_panel(pages):
    _, participant, experimenter = pages
    until(experimenter, "view && view.phase === 'hello'")
    assert experimenter.inner_text("#banners").strip() == "Simulated device: nothing moves"
    assert not experimenter.is_visible("#map-box") and not experimenter.is_visible("#trust-box")
    assert experimenter.evaluate(EMPTY) == []
    until_answered(participant, 2)
    experimenter.wait_for_selector("#map-box:visible")
    assert experimenter.locator("#map canvas").count() == 3
    assert "Hatched: infeasible" in experimenter.inner_text("#legend")
    until(experimenter, "view.means.void && view.means.void.trial === 3")  # no trial comes while the dialog is open
    press(experimenter, "void", "a cough")
    until(experimenter, "document.querySelector('tr.voided td:nth-child(3)')?.textContent.includes('void: a cough')")
    until(experimenter, "document.getElementById('log').textContent.includes('is made void: a cough.')")
    assert experimenter.evaluate(EMPTY) == []
    wide = "document.documentElement.scrollWidth - document.documentElement.clientWidth"
    for width, height in SIZES:
        experimenter.set_viewport_size({"width": width, "height": height})
        experimenter.wait_for_timeout(50)
        assert experimenter.evaluate(wide) <= 0 and experimenter.is_visible("#estop"), width


def test_a_picture_and_its_name_are_of_the_same_page(pages):
    _, participant, _ = pages
    window = participant.window
    window.wait_for_selector("#go:visible")
    with held(window):
        window.evaluate("press('begin')")
        until(window, "view.phase === 'step'")
        assert participant.phase == "hello" and window.is_visible("#go")
    assert participant.phase != "hello"


def test_a_dialog_names_its_trial_and_never_hits_another(pages):
    live, participant, experimenter = pages
    until_answered(participant, 1)
    until(experimenter, "view.means.void && view.means.void.trial === 2")
    experimenter.click("[data-command=void]")
    assert "V2" in experimenter.inner_text("#sure-text")
    until_answered(participant, 2)
    until(experimenter, "view.means.void.trial === 3")
    experimenter.fill("#sure-why", "noise")
    experimenter.keyboard.press("Enter")  # means Yes
    until(experimenter, "!document.getElementById('sure').open")
    until(experimenter, "document.getElementById('alert').textContent.includes('Meanwhile V3 has come')")
    assert [trial.status for trial in live.hub.state.trials[:2]] == ["answered", "answered"]
    experimenter.click("[data-command=undo]")
    assert "V2" in experimenter.inner_text("#sure-text")
    experimenter.click("#sure-no")
    until(experimenter, "!document.getElementById('sure').open")
    experimenter.click("[data-command=undo]")
    experimenter.fill("#sure-why", "slipped")
    experimenter.keyboard.press("Enter")
    until_logged(live, experimenter, 1, "undo")
    assert live.events("undo")[0].data == {"id": 2, "reason": "slipped"}


def test_the_experimenter_reads_a_refusal_and_keeps_a_note_that_was_not_written(pages, monkeypatch):
    live, participant, experimenter = pages
    until_answered(participant, 1)
    real = os.write

    def full(file, data):
        if file == live.log._file and b'"kind":"note"' in bytes(data):
            raise OSError(28, "No space left on device")
        return real(file, data)

    monkeypatch.setattr(os, "write", full)
    experimenter.fill("#note-text", "yawned")
    experimenter.keyboard.press("Enter")
    until(experimenter, "said.text.includes('space')")  # the refusal of the note; the server's alert may come first
    monkeypatch.setattr(os, "write", real)
    assert experimenter.input_value("#note-text") == "yawned"
    experimenter.evaluate("command('resume').then(() => { said.until += 1e6; })")  # however slow this computer is
    until(experimenter, "said.text.includes('nothing to go on to')")
    until_answered(participant, 2)  # many views later
    assert "nothing to go on to" in experimenter.inner_text("#alert")
    experimenter.click("#note button")
    until_logged(live, experimenter, 1, "note")
    until(experimenter, "document.getElementById('note-text').value === ''")
    until(experimenter, "document.getElementById('alert').hidden")


def test_a_page_of_the_experimenter_that_was_replaced_says_so_and_asks_no_more(pages):
    live, _, experimenter = pages
    Client(live.place.links()["experimenter"])  # a newer link is opened elsewhere
    until(experimenter, "document.getElementById('alert').textContent.includes('newer link')")
    asked: list[str] = []
    experimenter.on("request", lambda request: asked.append(request.url))
    experimenter.wait_for_timeout(3000)
    assert asked == []


def test_an_answer_survives_a_lost_network_and_a_closed_page(pages):
    live, participant, _ = pages
    window = participant.window
    until_answered(participant, 1)
    until_asked(participant)
    window.route("**/api/participant/answer", lambda route: route.abort())  # sent, never arrives
    trial = window.evaluate("trial")
    for _ in range(3):
        press_key(window, "1")
    until(window, "localStorage.getItem('hilbo.answer') !== null")
    window.wait_for_timeout(300)
    window.unroute_all(behavior="wait")
    window.reload()  # as closed and opened again
    until(window, "localStorage.getItem('hilbo.answer') === null")
    given = [event for event in live.events("answer") if f"tag:{event.data['id']}." in trial]
    assert len(given) == 1
    window.wait_for_selector("#options:visible, #go:visible")
    window.route("**/api/participant/answer", lambda route: (route.fetch(), route.abort()))  # arrives, answer lost
    count = len(live.events("answer"))
    until_asked(participant)
    for _ in range(3):
        press_key(window, "2")
    until_logged(live, window, count + 1)
    window.unroute_all(behavior="wait")  # a request may be on its way
    until(window, "localStorage.getItem('hilbo.answer') === null")
    assert len(live.events("answer")) == count + 1


def test_a_page_whose_signs_of_life_do_not_arrive_says_so_and_comes_back(pages):
    live, participant, experimenter = pages
    window = participant.window
    until_answered(participant, 1)
    until(experimenter, "view.participant_here")
    window.route("**/api/participant/here", lambda route: route.abort())
    window.wait_for_selector("#line:visible")
    until(experimenter, "!view.participant_here")
    until(experimenter, "view.phase === 'hello' || view.phase === 'answer'")
    window.unroute("**/api/participant/here")
    window.wait_for_selector("#line", state="hidden")
    until(experimenter, "view.participant_here")
    until_answered(participant, 2)
    assert live.hub.watchers.participant_here


def test_the_pages_load_nothing_from_elsewhere_and_names_reach_a_screen_reader(pages):
    _, participant, _ = pages
    window = participant.window
    asked: list[str] = []
    window.on("request", lambda request: asked.append(request.url))
    window.reload()
    window.wait_for_selector("#go:visible")
    assert asked
    assert all(url.startswith(("http://127.0.0.1:", "data:")) for url in asked)
    assert window.get_by_role("button", name="Begin").is_visible()
    assert window.get_attribute("#title", "aria-live") == "assertive"
    window.wait_for_timeout(400)  # a key that comes sooner after Begin came up is not meant for it
    window.keyboard.press("Space")
    window.wait_for_selector("#options:visible")
    assert window.get_by_role("group", name=window.inner_text("#title")).is_visible()


def test_a_second_window_takes_over_and_the_first_says_so(pages):
    live, participant, _ = pages
    first = participant.window
    second = first.context.new_page()
    second.goto(live.participant.address + "/participant")
    until(first, "document.body.dataset.phase === 'over'")
    assert "another window" in first.inner_text("#title")
    second.wait_for_selector("#go:visible")


SINGLES = (Block("warm-up", 24, tuple(Planned(name) for name in ("best", "mid", "worst") * 8)),)
SIZES = ((1440, 900), (1280, 800), (1024, 768), (800, 1280), (390, 844), (360, 640), (844, 390))
WATCHING = """() => {  // every change of the page, drawn or not: a busy computer draws few of them
    window.places = [];
    const look = () => {
        if (document.getElementById("options").dataset.question && document.body.dataset.trial) {
            const controls = [...document.querySelectorAll("button")].filter((b) => b.offsetParent);
            const at = controls.map((b) => b.getBoundingClientRect()).map((r) => [r.x, r.y, r.width, r.height]);
            const seen = [document.body.dataset.trial, document.body.dataset.phase, at];
            if (JSON.stringify(seen) !== JSON.stringify(window.places.at(-1))) window.places.push(seen);
        }
    };
    if (window.looking) window.looking.disconnect();
    window.looking = new MutationObserver(look);
    window.looking.observe(document.body, {attributes: true, childList: true, subtree: true});
}"""


def seen_twice(window):
    """Trial -> phases and places of controls, of trials seen in their last step and when answers are taken."""
    seen = {}
    for trial, phase, at in window.evaluate("window.places"):
        if phase in ("step", "answer"):
            seen.setdefault(trial, []).append((phase, at))
    return {trial: places for trial, places in seen.items() if {phase for phase, _ in places} == {"step", "answer"}}


@pytest.mark.parametrize("pages", [SINGLES], indirect=True, ids=["one rendering"])
def test_controls_stay_where_they_are_when_a_step_ends_and_fit_on_every_screen(pages):
    _, participant, _ = pages
    window = participant.window
    for width, height in SIZES:
        window.set_viewport_size({"width": width, "height": height})
        window.wait_for_timeout(100)
        window.evaluate(WATCHING)
        end = time.monotonic() + PATIENCE
        while not (both := seen_twice(window)):
            if participant.phase != "step":
                participant.act()
            assert time.monotonic() < end, "no question stood there while a step ended"
        places = next(iter(both.values()))
        assert len({json.dumps(at) for _, at in places}) == 1, f"{width}x{height}: {places}"
        for x, y, w, h in places[0][1]:
            assert x >= 0 and y >= 0 and x + w <= width and y + h <= height, f"{width}x{height}: {places[0]}"


@pytest.mark.parametrize("pages", [SINGLES], indirect=True, ids=["one rendering"])
def test_a_tap_at_the_moment_when_answers_come_up_is_none(pages):
    live, participant, _ = pages
    until_answered(participant, 1)
    until_logged(live, participant.window, 1)
    window = participant.window
    window.evaluate(
        "new MutationObserver(() => { const b = document.querySelector('#options button');"
        " if (b) { window.tapped = (window.tapped || 0) + 1; b.click(); } })"
        ".observe(document.getElementById('options'), {childList: true})"
    )
    until_asked(participant)
    until(window, "window.tapped > 0 && document.body.dataset.phase === 'answer'")
    assert len(live.events("answer")) == 1
    window.wait_for_timeout(400)
    window.click("#options button")
    until_logged(live, window, 2)


def test_a_key_that_a_remote_desktop_doubles_is_marked(pages):
    """Two keys of which the second comes when the next question has stood there for 310 ms."""
    live, participant, experimenter = pages
    window = participant.window
    until_answered(participant, 1)  # by a person: at a time of their own
    until_asked(participant)
    for after in (900, 310, 900):
        window.evaluate(f"laidOut = performance.now() - {after}; choose(0)")
    until_logged(live, window, 2)
    assert 0.31 <= live.events("answer")[1].data["browser"]["shortest_s"] < 0.5
    until(experimenter, "view && view.table.rows.some((row) => row.cells[2].includes('answered after only 0.31'))")
    assert "One question answered after only 0.31 s" in experimenter.inner_text("#log")


@pytest.mark.parametrize("act", ["document.getElementById('go').click()", "document.dispatchEvent(SPACE)"])
def test_a_second_tap_begins_nothing(pages, act):
    _, participant, _ = pages
    window = participant.window
    window.wait_for_selector("#go:visible")
    act = act.replace("SPACE", "new KeyboardEvent('keydown', {key: ' '})")
    window.evaluate(f"at('go').hidden = true; draw(); {act}")  # Begin comes up, and is pressed in the same moment
    window.wait_for_timeout(500)
    assert participant.phase == "hello"
    window.evaluate(act)
    until(window, "document.body.dataset.phase !== 'hello'")


def test_keys_are_shown_where_there_is_a_keyboard(tmp_path):
    with Live(tmp_path, seconds=0.1) as live, browser() as program:
        tablet = program.new_context(has_touch=True, is_mobile=True, viewport={"width": 800, "height": 1280}).new_page()
        tablet.goto(live.place.links()["participant"])
        tablet.wait_for_selector("#go:visible")
        assert not tablet.is_visible("#go kbd")
        tablet.keyboard.press("Shift")
        assert tablet.is_visible("#go kbd")


def french(window, key, code):
    """A key of a French keyboard: the character that it gives, and its place."""
    until(window, "performance.now() - laidOut > SETTLES")
    window.evaluate(f"document.dispatchEvent(new KeyboardEvent('keydown', {{key: {key!r}, code: {code!r}}}))")


@pytest.mark.parametrize("pages", [SINGLES], indirect=True, ids=["one rendering"])
def test_answers_by_the_places_of_a_french_keyboard(pages):
    live, participant, _ = pages
    until_answered(participant, 1)
    until_logged(live, participant.window, 1)
    window = participant.window
    until_asked(participant)
    for key, code in [("End", "Numpad1"), ("a", "KeyQ"), ("Dead", "Digit2")]:
        french(window, key, code)
    window.wait_for_timeout(300)
    assert len(live.events("answer")) == 1
    french(window, "é", "Digit2")
    until_logged(live, window, 2)
    assert live.events("answer")[-1].data["values"] == {"class_a": "similar"}


OLD = "delete AbortSignal.timeout; delete Array.prototype.at; delete CanvasRenderingContext2D.prototype.roundRect;"
BLOCKED = """for (const name of ["localStorage", "sessionStorage"]) Object.defineProperty(window, name, {
  get() { throw new DOMException("The operation is insecure.", "SecurityError"); },
});"""
MISSING = "delete window.AbortController;"


def test_a_session_in_a_browser_of_some_years_ago(tmp_path):
    with Live(tmp_path, seconds=0.1, blocks=SINGLES) as live, browser() as program:
        links, windows = live.place.links(), {}
        for role in ("experimenter", "participant"):
            context = program.new_context()
            context.add_init_script(OLD)
            windows[role] = context.new_page()
        windows["experimenter"].goto(links["experimenter"])
        windows["experimenter"].wait_for_url("**/experimenter")

        def watch():
            return windows["experimenter"].evaluate("server.ask('/api/experimenter').then(r => r.json())")

        participant = Participant(windows["participant"], links["participant"], watch, lambda _, ask: "close")
        until_answered(participant, 2)
        until_logged(live, windows["participant"], 2)
        assert windows["participant"].evaluate("typeof AbortSignal.timeout") == "undefined"


@pytest.mark.parametrize(
    ("script", "sentence"),
    [(BLOCKED, "lets the page store nothing"), (MISSING, "too old")],
    ids=["storage is blocked", "a part is missing"],
)
@pytest.mark.parametrize("role", ["participant", "experimenter"])
def test_a_page_that_cannot_work_says_why_and_its_link_stays_good(tmp_path, role, script, sentence):
    with Live(tmp_path, seconds=0.1) as live, browser() as program:
        link = live.place.links()[role]
        context = program.new_context()
        context.add_init_script(script)
        window = context.new_page()
        window.goto(link)
        window.wait_for_selector("[role=alert]:visible")
        assert sentence in window.inner_text("body")
        good = program.new_context().new_page()
        good.goto(link)
        good.wait_for_url(f"**/{role}")


@pytest.mark.parametrize("role", ["participant", "experimenter"])
def test_a_browser_that_cannot_read_a_script_says_so(tmp_path, role):
    with Live(tmp_path, seconds=0.1) as live, browser() as program:
        window = program.new_context().new_page()
        window.route(
            f"**/static/{role}.js", lambda route: route.fulfill(body="let = ;", content_type="text/javascript")
        )
        window.goto(live.place.links()[role])
        window.wait_for_selector("[role=alert]:visible")
        assert "too old for this page" in window.inner_text("body")
