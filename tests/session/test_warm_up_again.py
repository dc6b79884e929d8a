"""A study that has the warm-up again after a long pause: what comes when, and that nothing is lost or doubled."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from live import KINDS, RAW, Driver, header
from msgspec import structs

from hilbo import Study
from hilbo.app.pages.log_words import sentence
from hilbo.app.pages.session_views import participant_view
from hilbo.errors import InputError
from hilbo.session.log import actions
from hilbo.session.log.records import RefusedError
from hilbo.session.log.replay import replayed
from hilbo.session.log.state import LiveSession

AGAIN = 3600.0
STUDY = Study.from_dict(RAW | {"session": {"warm_up_after_pause": AGAIN}})


class Warming(Driver):
    """A driver of that study; `away` is a pause of an hour and a half."""

    def __init__(self, kind="optimisation"):
        super().__init__(kind)
        self.header = structs.replace(header(kind), study=STUDY.file.hash)
        self.state = LiveSession.start(STUDY.file, self.header)

    def step(self):
        if self.state.warms_up_again(self.clock):
            self.log(actions.warm_up(self.state, self.clock))
        super().step()

    def do(self, kind, number):
        if kind == "away":
            self.clock += 1.5 * AGAIN
            self.step()
        else:
            super().do(kind, number)

    def phases(self):
        """Those of the trials that count, in their order of answering."""
        answered = sorted((t for t in self.state.trials if t.status == "answered"), key=lambda t: t.answered["seq"])
        return "".join(t.data["phase"][0] for t in answered)


def felt_and_answered(driver, count):
    for _ in range(count):
        driver.do("feel", 0)
        driver.do("answer", 0)


@pytest.fixture
def driver():
    """Two trials of the warm-up and two of the optimisation are answered, a third has been felt."""
    driver = Warming()
    driver.step()
    felt_and_answered(driver, 2)
    driver.do("go", 0)
    felt_and_answered(driver, 2)
    driver.do("feel", 0)
    return driver


def test_after_the_pause_the_warm_up_comes_and_then_the_rest(driver):
    chosen = driver.state.pending.renderings
    driver.do("away", 0)
    assert sentence(driver.state, driver.events[-2]) == "The warm-up comes again after 1 h 30 min."
    assert driver.state.pending.data["phase"] == "warm-up" and driver.state.trials[4].status == "dropped"
    assert participant_view(driver.state)["progress"] | {"text": ""} == {
        "done": 0,
        "of": 2,
        "warm_up": True,
        "text": "",
    }
    felt_and_answered(driver, 2)
    assert driver.state.screen == "ready" and participant_view(driver.state)["may"]["another"]
    driver.do("more", 0)
    felt_and_answered(driver, 1)
    assert driver.state.screen == "ready"
    driver.do("go", 0)
    assert driver.state.pending.renderings == chosen
    felt_and_answered(driver, 4)
    assert driver.state.screen == "done" and driver.phases() == "wwoowwwoooo"
    assert [(pause.trial, pause.seconds > AGAIN) for pause in driver.state.pauses] == [(6, True)]
    assert replayed(STUDY.file, driver.header, driver.events) == driver.state


def test_a_shorter_pause_changes_nothing_and_a_pause_of_the_warm_up_begins_it_anew(driver):
    driver.clock += AGAIN - 10.0
    driver.step()
    assert driver.state.again is None and driver.state.pending.data["phase"] == "optimisation"
    driver = Warming()
    driver.step()
    felt_and_answered(driver, 1)
    driver.do("away", 0)
    felt_and_answered(driver, 2)
    assert driver.state.screen == "ready" and driver.phases() == "www"


def test_the_warm_up_comes_once_for_a_pause_and_again_for_the_next(driver):
    driver.do("away", 0)
    driver.do("away", 0)
    felt_and_answered(driver, 2)
    driver.do("go", 0)
    felt_and_answered(driver, 1)
    driver.do("away", 0)
    felt_and_answered(driver, 2)
    assert driver.phases() == "wwoowwoww" and driver.state.screen == "ready"
    assert sum(event.kind == "warm_up" for event in driver.events) == 2


def test_a_repetition_waits_for_the_warm_up(driver):
    driver.do("answer", 0)
    driver.log(actions.repeat(driver.state, driver.clock, 3))
    driver.do("feel", 0)
    driver.do("answer", 0)
    assert driver.state.pending.repeats == 3
    driver.do("away", 0)
    felt_and_answered(driver, 3)
    assert driver.phases() == "wwoooowwr"


@pytest.mark.parametrize("doing", ["pause", "abort", "none"])
def test_no_warm_up_comes_in_a_break_after_the_end_or_in_another_study(driver, doing):
    if doing == "none":
        driver = Driver()
        driver.step()
        driver.do("feel", 0)
    driver.do(doing, 0)
    driver.clock += 2 * AGAIN
    with pytest.raises(RefusedError, match="does not come again now"):
        actions.warm_up(driver.state, driver.clock)


def test_an_event_of_a_warm_up_that_was_not_due_is_refused(driver):
    driver.do("away", 0)
    (seq,) = (event.seq for event in driver.events if event.kind == "warm_up")
    for change in ({"pause_s": 1.0}, {"block": 1}):
        events = [structs.replace(e, data=e.data | change) if e.seq == seq else e for e in driver.events]
        with pytest.raises(InputError, match=f"event {seq}"):
            replayed(STUDY.file, driver.header, events)


@given(
    st.sampled_from(("optimisation", "validation")),
    st.lists(st.tuples(st.sampled_from((*KINDS, "away", "away")), st.integers(0, 1000)), max_size=50),
)
@settings(max_examples=40)
def test_every_session_ends_with_all_its_answers_and_is_replayed(kind, doings):
    driver = Warming(kind)
    driver.step()
    for doing in doings:
        driver.do(*doing)
    driver.finish()
    state = driver.state
    assert replayed(STUDY.file, driver.header, driver.events) == state
    if state.screen == "done":
        counted = state.answers(1)
        assert len(counted) == 6
        assert kind == "optimisation" or len({trial.planned for trial in counted}) == 6


@pytest.mark.parametrize("value", [59.0, 0, -1, "1 h", True, float("inf")])
def test_a_bad_pause_is_one_sentence(value):
    with pytest.raises(InputError, match=r"session\.warm_up_after_pause.*a number of seconds, at least 60.*3600"):
        Study.from_dict(RAW | {"session": {"warm_up_after_pause": value}})


def test_studies_without_it_keep_their_hash():
    """Of logs that were begun before there was this key."""
    session = {"language": "de", "warm_up": {"count": 3}}
    assert Study.from_dict(RAW | {"session": session}).file.hash == "e7da85bfbb152d29"
    assert Study.from_dict(RAW).file.hash == "b3ff1a9802f412a1" != STUDY.file.hash
