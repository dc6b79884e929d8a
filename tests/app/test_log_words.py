"""The experimenter's log and table: every event is a sentence, and what does not count says so."""

import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from live import KINDS, Driver

from hilbo.app.pages.log_words import line, sentence, table
from hilbo.session.log import actions as live

anything = st.lists(st.tuples(st.sampled_from(KINDS), st.integers(0, 1000)), max_size=40)


@given(st.sampled_from(("optimisation", "validation")), anything)
@settings(max_examples=60)
def test_every_event_is_a_sentence_now_and_later(kind, doings):
    driver = Driver(kind)
    driver.step()
    for doing in doings:
        driver.do(*doing)
    for event in driver.events:
        said = sentence(driver.state, event)
        assert re.fullmatch(r"[A-Z].*\.|Note: .*", said), said
        assert "None" not in said and "{" not in said and ":." not in said and ".." not in said
        assert line(driver.state, event)[0] == str(event.seq)
    rows = table(driver.state)["rows"]
    assert len(rows) == len(driver.state.trials)
    for row, trial in zip(rows, reversed(driver.state.trials), strict=True):
        assert (row["kind"] == "voided") == (trial.status not in ("pending", "answered"))
        assert bool(row["cells"][2]) or (row["kind"] == "" and trial.presentation == 1)


@pytest.fixture
def driver():
    """Two trials of the warm-up answered, the optimisation begun."""
    driver = Driver()
    driver.step()
    for doing in ("feel", "answer", "feel", "answer", "go"):
        driver.do(doing, 1)
    return driver


def said(driver, event):
    driver.log(event)
    return sentence(driver.state, event)


def test_words_of_what_is_done(driver):
    state, at = driver.state, 50.0
    words = [sentence(state, event) for event in driver.events]
    assert words[0] == "W1 comes next: A, as planned."
    assert "W1: stimulus A is presented." in words and "W1 is answered: similar." in words
    assert words[-2:] == ["The next part begins.", "O1 comes next."]
    steps = live.present(state, 3, 0, True, at)
    assert said(driver, steps) == "O1: the reference is presented."
    assert said(driver, live.repeat(driver.state, at)) == "O1 begins again from its first step."
    answer = live.answer(driver.state, 3, "c", {"class_a": "close"}, at, browser={"response_s": 1.25}, felt=False)
    assert said(driver, answer) == "O1 is answered after 1.2 s: close."
    again = live.repeat(driver.state, at, 3)
    assert said(driver, again) == "O1 will be repeated later."
    assert said(driver, live.void(driver.state, 3, "a cough.", at)) == "O1 is made void: a cough."
    assert said(driver, live.restore(driver.state, 3, at)) == "The answer to O1 counts again."
    assert said(driver, live.undo(driver.state, at)) == "The answer to O1 is taken back."
    assert said(driver, live.pause(driver.state, "participant", at)) == "A break, requested by the participant."
    assert said(driver, live.note(driver.state, "yawned", at)) == "Note: yawned"
    assert said(driver, live.abort(driver.state, "", at)) == "The session is ended early."


@pytest.mark.parametrize(("shortest", "mark"), [(0.32, "one question answered after only 0.32 s"), (0.5, "")])
def test_an_answer_that_came_sooner_than_a_question_can_be_read_is_marked(driver, shortest, mark):
    times = {"response_s": 1.25, "shortest_s": shortest}
    answer = live.answer(driver.state, 3, "c", {"class_a": "close"}, 50.0, browser=times, felt=False)
    more = f" {mark.capitalize()}." if mark else ""
    assert said(driver, answer) == f"O1 is answered after 1.2 s: close.{more}"
    assert [row["cells"][2] for row in table(driver.state)["rows"] if row["cells"][0] == "O1"] == [mark]


def test_words_of_a_device_that_holds(driver):
    driver.log(live.present(driver.state, 3, 0, True, 50.0))
    held = live.device(driver.state, "hold", 51.0, trial=3, reason="the force was too large")
    who = "The program that presents"  # this study has no renderer
    assert said(driver, held) == f"{who} is in hold: the force was too large. O1 is void."
    lost = live.device(driver.state, "lost", 52.0, reason="the line is gone.")
    assert said(driver, lost) == f"{who} is lost: the line is gone."
    assert said(driver, live.device(driver.state, "ready", 53.0)) == f"{who} is ready."
    assert table(driver.state)["rows"][-3]["cells"][:3] == ["O1", "", "void: device: hold (the force was too large)"]


def test_what_was_presented_twice_and_what_repeats_is_marked(driver):
    for doing in ("feel", "answer"):
        driver.do(doing, 2)
    driver.log(live.repeat(driver.state, 60.0))
    rows = table(driver.state)["rows"]
    assert (rows[0]["kind"], rows[0]["cells"][:3]) == ("now", ["O2", "", "now; presented 2 times"])
    assert (rows[1]["kind"], rows[1]["cells"][:3]) == ("", ["O1", "close", ""])
    driver.log(live.repeat(driver.state, 61.0, 3))
    assert table(driver.state)["rows"][1]["cells"][2] == "to be repeated"
    driver.do("answer", 0)
    rows = table(driver.state)["rows"]
    assert rows[0]["cells"][:3] == ["R1", "", "now; repeats O1"]
    assert (rows[1]["kind"], rows[1]["cells"][2]) == ("repeated", "presented 2 times")


def test_where_renderings_are_chosen_those_of_the_warm_up_have_their_values_too(driver):
    seen = table(driver.state)
    assert seen["head"][3:] == [
        f"{p.name} ({p.unit})" if p.unit else p.name for p in driver.state.study.space.parameters
    ]
    warm_up = seen["rows"][-1]
    assert warm_up["cells"][0] == "W1" and warm_up["cells"][3:] == list(driver.state.trials[0].renderings["a"].values())
