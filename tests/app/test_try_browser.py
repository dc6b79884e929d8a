"""`hilbo try` in headless Chromium, by a scripted person: a whole session, at three sizes of the window."""

import json
import subprocess

import pytest
from try_person import Person

from hilbo.app.rehearsal.rehearsal import HILBO
from hilbo.app.rehearsal.robot import browser, find_browser
from hilbo.session.log.event_log import read_session
from hilbo.study.config import Study

pytestmark = [
    pytest.mark.deep,
    pytest.mark.skipif(find_browser() is None, reason="needs playwright and Chromium (Debian: chromium)"),
]
PATIENCE = 120_000  # ms
TRIALS = 15


@pytest.fixture
def served(tmp_path):
    """The link of `hilbo try`, as a user starts it."""
    command = [*HILBO, "try", "--no-open", "--seed", "3", "--trials", str(TRIALS), "--out", str(tmp_path / "out")]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    yield next(line.split()[1] for line in process.stderr if line.startswith("page: "))
    process.terminate()
    process.communicate(timeout=60)


def ready(page):
    """Until the next trial may be answered; the force and both displacements, which are at rest."""
    page.wait_for_selector("#answers button:enabled", timeout=PATIENCE)
    return page.evaluate("[state.force, ...state.depths]")


def press(page, seconds):
    """Presses, pulls down, waits, and lets go; force and displacements before that."""
    box = page.query_selector("#blocks").bounding_box()
    x, y = box["x"] + box["width"] / 3, box["y"] + box["height"] / 3
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x, y + 150, steps=5)
    page.wait_for_timeout(1000 * seconds)
    force_and_depths = page.evaluate("[state.force, ...state.depths]")
    page.mouse.up()
    return force_and_depths


def places(page):
    """Where everything is that must not move."""
    names = ("#blocks", "#question", "#answers", "#hint", "header")
    return {name: page.query_selector(name).bounding_box() for name in names}


def fits(page):
    """Whether nothing is beyond the window's edges."""
    return page.evaluate(
        "document.documentElement.scrollHeight <= innerHeight && document.documentElement.scrollWidth <= innerWidth"
        " && [...document.querySelectorAll('main:not([hidden]) *')].every((e) => e.getBoundingClientRect().bottom"
        " <= innerHeight)"
    )


def fits_across(page):
    """Whether nothing that is visible is beyond the window's right edge, nor wider than its own box."""
    return page.evaluate(
        "document.documentElement.scrollWidth <= innerWidth && [...document.querySelectorAll('body *')].every((e) =>"
        " e.getBoundingClientRect().right <= innerWidth + 1 && (!e.clientWidth || e.scrollWidth <= e.clientWidth + 1))"
    )


def answer(page, person, by_key):
    """What the person says of the test that is presented."""
    label = person(page.evaluate("state.order.values"))
    number, done = ("different", "similar", "close").index(label), page.evaluate("state.view.progress.done")
    if by_key:
        page.keyboard.press(str(number + 1))
    else:
        page.click(f"#answers button:nth-child({number + 1})")
    while page.evaluate("state.view.progress.done") == done:
        page.wait_for_timeout(20)


@pytest.mark.parametrize(("width", "height"), [(1440, 900), (1024, 768), (390, 844)])
def test_a_whole_session(served, tmp_path, width, height):
    with browser() as program:
        page = program.new_context(viewport={"width": width, "height": height}).new_page()
        mishaps = []
        page.on("pageerror", lambda error: mishaps.append(str(error)))
        page.goto(served)
        page.wait_for_selector("#begin:enabled", timeout=PATIENCE)
        assert fits(page)
        person = Person(page.evaluate("state.facts.reference"))
        page.click("#begin")
        assert max(ready(page)) == 0
        before = places(page)
        for trial in range(TRIALS):
            force, *depths = ready(page)
            assert force == 0 and max(depths) < 0.5 and fits(page) and fits_across(page)
            if trial in (0, 9):
                force, *pressed = press(page, 1.0)
                assert force == pytest.approx(3.0, abs=1e-3) and min(pressed) > 0.3
                page.wait_for_timeout(600)
                assert all(after < down for after, down in zip(page.evaluate("state.depths"), pressed, strict=True))
            assert places(page) == before
            if trial == 4:
                page.reload()  # the same trial again, after Begin
                page.click("#begin", timeout=PATIENCE)
                ready(page)
            answer(page, person, by_key=trial % 2 == 0)
        page.wait_for_selector("#results:visible", timeout=PATIENCE)
        phone = width < 700  # where the maps are below each other
        assert fits_across(page) if phone else fits(page)
        assert "of the ranges away from the hidden reference" in page.inner_text("#verdict")
        assert [len(row.split("\t")) for row in page.inner_text("#values").splitlines()] == [4, 4, 4]
        assert page.locator("#maps canvas").count() == 3 and mishaps == []
    check_log(tmp_path / "out", person)


def check_log(out, person):
    """That it says what the answers are, and has what the person said of each test."""
    (path,) = (out / "logs").glob("*.session.jsonl")
    state = read_session(path, Study.load(out / "study.toml").file)
    assert state.header.unblinded == "try" and state.screen == "done"
    answered = state.answers(0)
    assert len(answered) == TRIALS
    assert [t.values for t in answered] == [{"class_a": person(t.presented["a"])} for t in answered]
    assert json.loads(path.read_text().splitlines()[0])["data"]["unblinded"] == "try"


def test_a_link_opens_once_and_a_page_without_one_says_so(served):
    with browser() as program:
        first, second = (program.new_context().new_page() for _ in range(2))
        first.goto(served)
        first.wait_for_selector("#begin:enabled", timeout=PATIENCE)
        second.goto(served)
        second.wait_for_selector("#title:has-text('has been used')")
        assert second.is_hidden("#begin")
        second.goto("about:blank")
        second.goto(served.partition("#")[0])
        second.wait_for_selector("#title:has-text('needs the link')")
        assert first.is_enabled("#begin")
