"""Pauses of a session: what counts as one, and where its duration is found."""

import pytest
from live import Driver

from hilbo.app.pages.log_words import sentence
from hilbo.app.pages.pace import duration
from hilbo.session.export.tables import sessions_table
from hilbo.session.log import actions
from hilbo.session.log.records import Pause


@pytest.fixture
def driver():
    """The warm-up is done, and the first trial of the optimisation is answered."""
    driver = Driver()
    driver.step()
    for doing in ("feel", "answer", "feel", "answer", "go", "feel", "answer"):
        driver.do(doing, 1)
    return driver


def ended_by(driver):
    """The event that ended the only pause, as a sentence."""
    (pause,) = driver.state.pauses
    return sentence(driver.state, driver.events[pause.seq - 1])


@pytest.mark.parametrize("cause", ["a break", "a restart", "nothing"])
def test_a_time_without_presentation_or_response_is_a_pause_whatever_its_cause(driver, cause):
    if cause == "a break":
        driver.do("pause", 0)
    driver.clock += 86_400.0
    if cause == "a break":
        driver.do("resume", 0)
    elif cause == "a restart":
        driver.log(actions.device(driver.state, "ready", driver.clock))
    driver.do("feel", 0)
    (pause,) = driver.state.pauses
    assert pause.trial == driver.state.pending.id and 86_400.0 < pause.seconds < 86_404.0
    assert ended_by(driver) == "A pause of 1 d. O2: the reference is presented."


def test_a_rendering_that_was_felt_before_a_pause_is_answered_after_it(driver):
    driver.do("feel", 0)
    driver.clock += 3_900.0
    driver.do("answer", 1)
    assert ended_by(driver).startswith("A pause of 1 h 5 min. O2 is answered: similar.")


def test_what_is_presented_for_long_or_for_less_than_a_minute_is_no_pause(driver):
    trial = driver.state.pending
    for step in range(len(driver.state.steps_of(trial))):
        driver.clock += 58.0
        driver.begin(trial, step)
        driver.clock += 600.0
        if step == 0:
            driver.log(actions.present(driver.state, trial.id, step, False, driver.clock))
    driver.do("answer", 0)
    assert driver.state.pauses == ()


def test_a_clock_that_was_set_back_gives_no_pause(driver):
    driver.clock -= 86_400.0
    driver.do("feel", 0)
    assert driver.state.pauses == ()


def test_the_table_of_sessions_has_the_pauses(driver):
    other = Driver()
    for away in (600.0, 7_200.0):
        driver.clock += away - 1.0
        driver.do("feel", 0)
        driver.do("answer", 0)
    assert [pause.seconds for pause in driver.state.pauses] == [600.0, 7_200.0]
    table = sessions_table([driver.state, other.state], driver.state.study)
    assert table["pauses"].tolist() == [2, 0] and table["longest_pause"].tolist() == [7_200.0, 0.0]
    assert driver.state.pauses[-1] == Pause(driver.state.pauses[-1].seq, 5, 7_200.0)


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.4, "0 s"), (59.0, "59 s"), (60.0, "1 min"), (3_599.0, "59 min"), (3_600.0, "1 h"), (3_900.0, "1 h 5 min"),
     (86_400.0, "1 d"), (183_600.0, "2 d 3 h"), (86_460.0, "1 d")],
)  # fmt: skip
def test_durations_in_words(seconds, words):
    assert duration(seconds) == words
