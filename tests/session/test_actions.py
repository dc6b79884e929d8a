"""The fold of a session's events: whatever is done in whatever order, nothing answered is lost and replays agree."""

import dataclasses
import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from live import CHOOSER, KINDS, SETS, STUDY, Driver, header

from hilbo.app.pages.session_views import experimenter_view, participant_view
from hilbo.errors import InputError
from hilbo.session.export.tables import presentations_table
from hilbo.session.log import actions as live
from hilbo.session.log.records import Event, Header, RefusedError
from hilbo.session.log.state import LiveSession

anything = st.lists(st.tuples(st.sampled_from(KINDS), st.integers(0, 1000)), max_size=60)


def driven(kind, doings):
    driver = Driver(kind)
    driver.step()
    for doing in doings:
        driver.do(*doing)
    return driver


@given(st.sampled_from(("optimisation", "validation")), anything, st.integers(0, 1000))
@settings(max_examples=150)
def test_any_interleaving_replays_and_resumes_to_the_same_next_trial(kind, doings, cut):
    driver = driven(kind, doings)
    assert LiveSession.fold(STUDY.file, driver.header, driver.events) == driver.state
    place = cut % (len(driver.events) + 1)
    resumed = LiveSession.fold(STUDY.file, driver.header, driver.events[:place])
    following = driver.events[place] if place < len(driver.events) else None
    if following is not None and following.kind == "propose":
        assert live.propose(resumed, CHOOSER, following.time) == following
    for event in driver.events[place:]:
        resumed = resumed.after(event)
    assert resumed == driver.state


@given(st.sampled_from(("optimisation", "validation")), anything)
@settings(max_examples=150)
def test_whatever_is_done_answers_stay_and_rules_hold(kind, doings):
    driver = driven(kind, doings)
    state = driver.state
    for trial, values in driver.accepted.items():
        assert state.trial(trial).values == values
    for block in range(2):
        assert len(state.answers(block)) <= state.quota(block)
        planned = [t.planned for t in state.answers(block)]
        assert len(set(planned)) == len(planned) or planned[0] is None
    assert sum(t.status == "pending" for t in state.trials) <= 1
    again = LiveSession.start(STUDY.file, driver.header)
    for event in driver.events:
        if event.kind == "propose":
            gone = again.excluded(event.data["block"])
            assert not any(rendering in gone for rendering in event.data["renderings"].values())
        again = again.after(event)
    keys = [(t.data["phase"], t.data["material"], t.number) for t in state.trials]
    assert len(set(keys)) == len(keys)


@given(st.sampled_from(("optimisation", "validation")), anything)
@settings(max_examples=60)
def test_every_session_comes_to_its_end_and_participants_learn_nothing(kind, doings):
    driver = driven(kind, doings)
    seen = [json.dumps(participant_view(driver.state))]
    json.dumps(experimenter_view(driver.state), default=str)
    driver.finish()
    seen.append(json.dumps(participant_view(driver.state)))
    if driver.state.aborted is None:
        assert driver.state.screen == "done"
    numbers = [repr(v) for t in driver.state.trials for r in t.renderings.values() for v in r.values()]
    for text in seen:
        assert not any(number in text for number in numbers)
        assert not any(f'"{name}"' in text for name in (*SETS, "u", "v", "optimisation", "validation"))


def to_first_answerable(kind="optimisation"):
    driver = Driver(kind)
    driver.step()
    while driver.state.screen != "trial" or driver.state.pending.block != 1:
        driver.do("go" if driver.state.screen == "ready" else "answer", 0)
    return driver


def test_an_answer_is_accepted_once():
    driver = to_first_answerable()
    trial = driver.state.pending
    with pytest.raises(RefusedError, match="not been felt") as told:
        live.answer(driver.state, trial.id, "x", {"class_a": "close"}, 1.0)
    assert told.value.code == "unfelt"
    driver.feel(trial)
    driver.log(live.answer(driver.state, trial.id, "x", {"class_a": "close"}, 1.0, browser={"time": 3.5}))
    assert live.answer(driver.state, trial.id, "x", {"class_a": "close"}, 2.0) is None
    for other in ({"class_a": "similar"}, {"class_a": "close", "preferred": "a"}, {}, None):
        with pytest.raises(RefusedError, match="answered otherwise already") as told:
            live.answer(driver.state, trial.id, "x", other, 2.0)
        assert told.value.code == "answered"
    with pytest.raises(RefusedError, match="from another page") as told:
        live.answer(driver.state, trial.id, "y", {"class_a": "similar"}, 2.0)
    assert told.value.code == "answered"
    assert driver.state.trial(trial.id).answered["browser"] == {"time": 3.5}


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"class_a": "closer"}, "class_a must be one of different, similar, close"),
        ({}, "has class_a, and nothing else"),
        ({"class_a": "close", "preferred": "a"}, "has class_a, and nothing else"),
        ("close", "has class_a, and nothing else"),
        ({"class_a": ["close"]}, "class_a must be one of"),
    ],
)
def test_what_is_no_answer_is_refused(values, sentence):
    driver = to_first_answerable()
    driver.feel(driver.state.pending)
    with pytest.raises(RefusedError, match=sentence):
        live.answer(driver.state, driver.state.pending.id, "x", values, 1.0)


def test_undo_asks_the_same_rendering_again():
    driver = to_first_answerable()
    before = driver.state.pending.renderings
    driver.do("answer", 2)
    assert driver.state.pending.renderings != before
    driver.do("undo", 0)
    assert driver.state.pending.renderings == before
    assert [t.status for t in driver.state.trials[-3:]] == ["undone", "dropped", "pending"]
    with pytest.raises(RefusedError, match="is over"):
        live.answer(driver.state, driver.state.trials[-2].id, "late", {"class_a": "close"}, 1.0)


def test_a_hold_voids_what_has_begun_and_the_second_one_excludes_it():
    driver = to_first_answerable()
    point = driver.state.pending.renderings["a"]
    driver.do("hold early", 0)
    assert driver.state.pending.status == "pending" and driver.state.pending.renderings["a"] == point
    driver.do("hold", 0)
    voided = {"by": "rule", "reason": "device: hold (speed)", "sides": ["a"], "beside": []}
    assert driver.state.trials[-2].voided == voided
    assert driver.state.pending.renderings["a"] == point
    driver.do("hold", 0)
    assert driver.state.pending.renderings["a"] != point
    assert driver.state.excluded(1) == [point]


def device_stops(driver, step):
    """The pending trial is felt up to a step, in which the device holds."""
    trial = driver.state.pending
    for k in range(step + 1):
        driver.begin(trial, k)
        if k < step:
            driver.log(live.present(driver.state, trial.id, k, False, 1.0))
    driver.log(live.device(driver.state, "hold", 1.0, reason="speed"))
    driver.step()


@pytest.mark.parametrize("kind", ["optimisation", "validation"])
def test_voids_by_a_person_exclude_nothing_and_leave_the_quota(kind):
    driver = to_first_answerable(kind)
    asked = driver.state.pending
    for _ in range(3):
        driver.feel(driver.state.pending)
        driver.do("void", 0)
        assert driver.state.pending.renderings == asked.renderings
    assert driver.state.excluded(1) == [] == driver.state.put_off(1)
    driver.finish()
    assert len(driver.state.answers(1)) == 6 and driver.state.skipped(1) == []


def test_a_stop_counts_for_the_rendering_that_was_on_and_for_no_other():
    driver = to_first_answerable()
    point = driver.state.pending.renderings["a"]
    for _ in range(3):  # the reference was on
        device_stops(driver, 0)
    driver.feel(driver.state.pending)
    driver.log(live.device(driver.state, "hold", 1.0))  # nothing was on
    driver.step()
    assert driver.state.trials[-2].voided["sides"] == []
    assert driver.state.excluded(1) == [] and driver.state.pending.renderings["a"] == point
    for _ in range(2):
        device_stops(driver, 1)
    assert driver.state.excluded(1) == [point]


def test_stops_of_two_planned_trials_with_the_same_set_are_no_reason_to_leave_any_out():
    driver = to_first_answerable("validation")
    for step in (1, 3):  # in trials 0 and 1 of the plan, each time with the same set on
        device_stops(driver, step)
        driver.do("answer", 0)
    assert driver.state.put_off(1) == []
    driver.finish()
    assert sorted(t.planned for t in driver.state.answers(1)) == list(range(6))


def test_a_planned_trial_that_the_device_stopped_twice_comes_at_the_end_of_its_block():
    driver = to_first_answerable("validation")
    for _ in range(2):
        assert driver.state.pending.planned == 0
        device_stops(driver, 1)
    assert driver.state.put_off(1) == [0]
    assert experimenter_view(driver.state)["blocks"][1]["put_off"] == [{"a": "D", "b": "E", "stops": 2}]
    asked = []
    while driver.state.screen == "trial":
        asked.append(driver.state.pending.planned)
        driver.do("answer", 0)
    assert asked == [1, 2, 3, 4, 5, 0]
    assert driver.state.screen == "done" and driver.state.put_off(1) == []


def test_a_person_may_leave_out_what_the_device_always_stops():
    driver = to_first_answerable("validation")
    with pytest.raises(RefusedError, match="that the device has stopped twice"):
        live.skip(driver.state, "", 1.0)
    for _ in range(2):
        device_stops(driver, 1)
    for _ in range(5):
        driver.do("answer", 0)
    device_stops(driver, 3)
    assert driver.state.pending.planned == 0
    driver.log(live.skip(driver.state, "the finger slips off", 1.0))
    assert driver.state.screen == "done" and driver.state.skipped(1) == [0]
    assert [t.status for t in driver.state.trials[-2:]] == ["void", "left out"]
    assert experimenter_view(driver.state)["blocks"][1]["skipped"] == [{"a": "D", "b": "E"}]
    table = presentations_table([driver.state])
    assert table.iloc[-1][["status", "voided_by", "voided_reason"]].tolist() == [
        "left out",
        "experimenter",
        "the finger slips off",
    ]


def test_a_voided_answer_can_be_restored_until_its_place_is_filled():
    driver = to_first_answerable()
    trial = driver.state.pending.id
    driver.do("answer", 0)
    driver.do("void old", trial - 1)
    assert driver.state.trial(trial).status == "void"
    asked = driver.state.pending.renderings
    driver.do("restore", trial - 1)
    assert driver.state.trial(trial).status == "answered" and driver.state.pending.renderings != asked
    driver.do("void old", trial - 1)
    driver.finish()
    with pytest.raises(RefusedError, match="has been filled"):
        live.restore(driver.state, trial, 1.0)


def test_an_earlier_answer_to_the_same_level_does_not_fill_the_place_of_a_voided_one():
    driver = to_first_answerable()
    first = driver.state.pending
    driver.do("answer", 0)
    voided = driver.state.pending.id
    driver.state = driver.state.with_trial(voided, data=first.data)  # as where a parameter has two levels
    driver.do("answer", 0)
    driver.log(live.void(driver.state, voided, "a misclick", 1.0))
    driver.log(live.restore(driver.state, voided, 1.0))
    assert driver.state.trial(voided).status == "answered"


def test_of_two_voided_answers_to_one_rendering_one_may_be_restored():
    """The second was asked in the place of the first."""
    driver = to_first_answerable()
    voided = []
    for _ in range(2):
        voided.append(driver.state.pending.id)
        driver.do("answer", 0)
        driver.log(live.void(driver.state, voided[-1], "a cough", 1.0))
        driver.step()
    first, second = (driver.state.trial(id) for id in voided)
    assert first.renderings == second.renderings
    driver.log(live.restore(driver.state, voided[0], 1.0))
    with pytest.raises(RefusedError, match="has been filled by another one"):
        live.restore(driver.state, voided[1], 1.0)


def test_a_pause_in_mid_trial_begins_the_trial_again():
    driver = to_first_answerable("validation")
    trial = driver.state.pending
    for step in (0, 1):
        driver.begin(trial, step)
    assert driver.state.pending.felt == {"a"}
    driver.do("pause", 0)
    assert driver.state.screen == "paused" and participant_view(driver.state)["screen"] == "paused"
    driver.do("resume", 0)
    again = driver.state.pending
    assert (again.id, again.presentation, again.step, again.felt) == (trial.id, 2, None, frozenset())


def test_no_step_begins_in_a_pause():
    driver = to_first_answerable("validation")
    driver.do("pause", 0)
    with pytest.raises(RefusedError, match="no step of trial"):
        live.present(driver.state, driver.state.pending.id, 0, True, 1.0)


@pytest.mark.parametrize("steps", [1, 2, 4])
def test_a_rendering_that_was_cut_off_by_a_pause_has_not_been_felt(steps):
    driver = to_first_answerable("validation")
    trial = driver.state.pending
    for step in range(steps):
        driver.begin(trial, step)
        if step + 1 < steps:
            driver.log(live.present(driver.state, trial.id, step, False, 1.0))
    assert driver.state.pending.unfinished
    driver.do("pause", 0)
    again = driver.state.pending
    assert (again.presentation, again.step, again.felt) == (2, None, frozenset())
    driver.do("resume", 0)
    driver.feel(again)
    assert not driver.state.pending.unfinished
    driver.do("pause", 0)
    driver.do("resume", 0)
    assert driver.state.pending.presentation == 2  # felt whole: only the answer is missing


def test_an_answered_trial_can_be_repeated_and_does_not_count():
    driver = to_first_answerable()
    trial = driver.state.pending
    driver.do("answer", 0)
    driver.do("answer", 1)
    driver.do("again", trial.id - 1)
    driver.do("answer", 2)
    repeated = driver.state.pending
    assert repeated.repeats == trial.id and repeated.renderings == trial.renderings
    assert repeated.data["phase"] == "repeat"
    driver.do("answer", 0)
    driver.do("undo", 0)
    assert driver.state.trial(repeated.id).status == "undone" and driver.state.pending.repeats is None
    driver.do("answer", 0)
    assert driver.state.pending.repeats == trial.id
    driver.do("answer", 0)
    assert len(driver.state.answers(1)) == 4
    driver.finish()
    assert len(driver.state.answers(1)) == 6


@pytest.mark.parametrize("kind", ["optimisation", "validation"])
def test_a_repetition_of_what_does_not_count_any_more_is_not_asked(kind):
    driver = to_first_answerable(kind)
    driver.do("answer", 0)
    source = driver.state.last_answered.id
    driver.do("again", source - 1)
    assert driver.state.wanted == (source,)
    driver.do("undo", 0)
    assert driver.state.wanted == () and driver.state.pending.repeats is None
    driver.do("answer", 0)
    source = driver.state.last_answered.id
    driver.do("again", source - 1)
    driver.do("answer", 0)
    assert driver.state.pending.repeats == source  # and while it is being felt
    driver.do("void old", source - 1)
    assert driver.state.pending.repeats is None and driver.state.wanted == ()
    driver.finish()
    assert len(driver.state.answers(1)) == 6


@pytest.mark.parametrize("kind", ["optimisation", "validation"])
def test_an_answer_that_was_asked_again_since_is_not_restored(kind):
    driver = to_first_answerable(kind)
    driver.do("answer", 0)
    voided = driver.state.last_answered
    driver.do("void old", voided.id - 1)
    assert driver.state.pending.renderings == voided.renderings
    driver.do("answer", 1)
    with pytest.raises(RefusedError, match="has been filled"):
        live.restore(driver.state, voided.id, 1.0)


@pytest.mark.parametrize("answered", [True, False])
def test_a_repetition_is_not_restored_beside_the_one_in_its_place(answered):
    driver = to_first_answerable()
    driver.do("answer", 0)
    source = driver.state.last_answered.id
    driver.do("again", source - 1)
    driver.do("answer", 0)
    driver.do("answer", 0)
    repeat = driver.state.last_answered
    assert repeat.repeats == source
    pending = driver.state.pending
    driver.log(live.void(driver.state, repeat.id, "a cough", 1.0))
    if answered:
        driver.do("answer", 0)  # to what was pending meanwhile
        driver.do("answer", 0)  # to the repetition
        with pytest.raises(RefusedError, match="has been filled"):
            live.restore(driver.state, repeat.id, 1.0)
    else:
        driver.log(live.restore(driver.state, repeat.id, 1.0))
        assert driver.state.wanted == () and driver.state.pending == pending
        driver.finish()
    counted = [t for t in driver.state.trials if t.repeats == source and t.status == "answered"]
    assert len(counted) == 1


def test_of_several_voided_repetitions_of_one_trial_one_is_restored():
    driver = to_first_answerable()
    driver.do("answer", 0)
    source = driver.state.last_answered.id
    driver.do("again", source - 1)
    driver.do("answer", 0)
    for _ in range(2):  # the second in the place of the first
        driver.do("answer", 0)
        driver.do("void old", driver.state.last_answered.id - 1)
        driver.do("answer", 0)
    first, second = (t.id for t in driver.state.trials if t.repeats == source and t.status == "void")
    driver.do("restore", first - 1)
    with pytest.raises(RefusedError, match="has been filled"):
        live.restore(driver.state, second, 1.0)


def test_the_warm_up_goes_on_for_as_long_as_one_likes():
    driver = Driver()
    driver.step()
    driver.do("answer", 0)
    driver.do("answer", 0)
    assert driver.state.screen == "ready" and participant_view(driver.state)["may"]["another"]
    for _ in range(2):
        driver.do("more", 0)
        driver.do("answer", 0)
    assert not participant_view(driver.state)["may"]["another"]
    with pytest.raises(RefusedError, match="all renderings"):
        live.more(driver.state, 1.0)
    driver.do("go", 0)
    assert driver.state.pending.block == 1


def test_sides_come_in_the_order_of_the_trial():
    driver = to_first_answerable("validation")
    first, second = driver.state.pending, None
    assert [show for show, _ in driver.state.steps_of(first)] == ["reference", "a", "neutral", "b"]
    driver.do("answer", 0)
    second = driver.state.pending
    assert [show for show, _ in driver.state.steps_of(second)] == ["reference", "b", "neutral", "a"]
    assert first.sets == second.sets


def test_a_header_of_another_study_and_events_out_of_order_are_refused():
    other = Header(**{f: getattr(header(), f) for f in Header.__struct_fields__} | {"study": "0" * 16})
    with pytest.raises(InputError, match="belongs to a study of hash 0000"):
        LiveSession.start(STUDY.file, other)
    driver = Driver()
    driver.step()
    with pytest.raises(InputError, match="does not follow event 1"):
        driver.state.after(driver.events[0])
    with pytest.raises(InputError, match="does not know"):
        driver.state.after(Event(seq=2, kind="dance", time=0.0, data={}))


def test_states_are_records():
    assert dataclasses.fields(LiveSession) and Driver().state.screen == "wait"
