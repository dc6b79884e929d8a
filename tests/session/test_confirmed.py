"""What a program confirms counts in place of what it was asked for, within the study's tolerance and nowhere else."""

from dataclasses import replace

import hypothesis.strategies as st
import msgspec
import numpy as np
import pytest
from hypothesis import given
from live import CHOOSER, RAW, SETS, beginning, header
from partly import partly

from hilbo import Study
from hilbo.errors import InputError
from hilbo.search.rendering import Rendering
from hilbo.session.choose.choice import Answers
from hilbo.session.export.psych_ds import psych_ds
from hilbo.session.export.tables import sets_table, trials_table, validation_table
from hilbo.session.log import actions as live
from hilbo.session.log.presented import check_confirmed, counted
from hilbo.session.log.records import RefusedError
from hilbo.session.log.state import LiveSession
from hilbo.study.file.plan_file import Block, Planned

STUDY = Study.from_dict(RAW | {"stimulus": {"tolerance": {"u": 0.01}, "within": 2.0}})
ASKED = SETS["A"]


def started():
    """A session whose first rendering is proposed."""
    first = msgspec.structs.replace(header(), study=STUDY.file.hash, blocks=(Block("optimisation", 6),))
    state = LiveSession.start(STUDY.file, first)
    return state.after(live.propose(state, CHOOSER, 1.0))


def felt(state, values=None):
    for step in range(2):
        for event in beginning(state, state.pending.id, step, 2.0, values):
            state = state.after(event)
    return state


def answered(state):
    event = live.answer(state, state.pending.id, "c", {"class_a": "close"}, 3.0)
    return state.after(event)


@given(st.floats(-0.011, 0.011), st.floats(-2e-6, 2e-6))
def test_a_value_is_taken_within_its_tolerance_and_nowhere_else(du, dv):
    values = {"u": ASKED["u"] + du, "v": ASKED["v"] + dv}
    off = {n: abs(values[n] - ASKED[n]) for n in "uv"}
    if off["u"] <= 0.01 and off["v"] <= 1e-6:
        check_confirmed(STUDY.file, ASKED, values)
        return
    with pytest.raises(RefusedError, match="was requested") as caught:
        check_confirmed(STUDY.file, ASKED, values)
    assert caught.value.code == "off"


LOGARITHMIC = RAW | {
    "parameters": RAW["parameters"] | {"f": {"low": 1.0, "high": 1000.0, "unit": "Hz", "scale": "log"}}
}


@pytest.mark.parametrize("wanted", [1.5, 900.0])
@pytest.mark.parametrize(("stated", "share"), [({"f": 0.01}, 0.01), ({}, 1e-6)])
def test_on_a_logarithmic_scale_a_share_of_the_value_may_be_off(wanted, stated, share):
    study = Study.from_dict(LOGARITHMIC | {"stimulus": {"tolerance": stated}})
    asked_for = ASKED | {"f": wanted}
    check_confirmed(study.file, asked_for, asked_for | {"f": wanted * (1 + 0.99 * share)})
    for factor in (1 + 1.01 * share, 1 - 1.01 * share):
        with pytest.raises(RefusedError, match="was requested, and the tolerance is"):
            check_confirmed(study.file, asked_for, asked_for | {"f": wanted * factor})


def test_a_tolerance_that_is_no_share_is_refused_on_a_logarithmic_scale():
    with pytest.raises(InputError, match=r"tolerance.f is 10.0; on a logarithmic scale it is a share of the value"):
        Study.from_dict(LOGARITHMIC | {"stimulus": {"tolerance": {"f": 10.0}}})


@pytest.mark.parametrize(
    "values", [None, {}, {"u": 0.1}, ASKED | {"w": 1.0}, ASKED | {"u": float("nan")}, ASKED | {"v": float("inf")}]
)
def test_what_is_no_confirmation_is_refused(values):
    with pytest.raises(RefusedError) as caught:
        check_confirmed(STUDY.file, ASKED, values)
    assert caught.value.code == "bad-answer"


@given(st.floats(-0.01, 1.01), st.floats(-0.01, 1.01))
def test_what_counts_is_never_outside_the_ranges_and_nothing_else_is_changed(u, v):
    confirmed = counted(STUDY.file, {"u": u, "v": v}, {"u": u, "v": v})
    assert all(0.0 <= x <= 1.0 for x in confirmed.values())
    assert all(confirmed[n] == x for n, x in (("u", u), ("v", v)) if 0.0 <= x <= 1.0)


def test_a_rendering_is_felt_and_answered_only_after_it_was_confirmed():
    state = started()
    state = state.after(live.present(state, 1, 0, True, 2.0))  # the reference has no values
    with pytest.raises(RefusedError, match="it is not confirmed") as caught:
        live.present(state, 1, 1, True, 2.0)
    assert caught.value.code == "unconfirmed"
    with pytest.raises(RefusedError, match="not been felt"):
        live.answer(state, 1, "c", {"class_a": "close"}, 3.0)
    with pytest.raises(RefusedError, match="a confirmation has"):
        live.sent(state, 1, "a", 2.0)
    assert answered(felt(state)).trials[0].status == "answered"


def test_a_presentation_that_begins_again_is_confirmed_again():
    state = felt(started())
    state = state.after(live.repeat(state, 3.0))
    with pytest.raises(RefusedError, match="it is not confirmed"):
        live.present(state, 1, 1, True, 4.0)


def test_fits_tables_and_views_have_the_confirmed_values_and_the_log_both():
    state = started()
    asked = state.pending.renderings["a"]
    values = {"u": asked["u"] + 0.005, "v": asked["v"]}
    state = answered(felt(state, values))
    answers = Answers.of(state, 0)
    assert answers.points == (tuple(values.values()),) and answers.proposed == (tuple(asked.values()),)
    row = trials_table([state]).iloc[0]
    assert (row["u"], row["v"]) == (values["u"], values["v"])
    assert state.trials[0].sent["a"]["values"] == values and state.trials[0].renderings["a"] == asked


def test_what_is_missed_is_void_by_rule_and_counts_as_a_stop_in_its_rendering():
    state = started()
    point = state.pending.renderings["a"]
    for again in range(2):
        state = state.after(live.missed(state, state.pending.id, "a", "late: 2 s", 2.0))
        voided = state.trials[again].voided
        assert (voided["by"], voided["reason"], voided["sides"]) == ("rule", "stimulus: late: 2 s", ["a"])
        assert len(state.excluded(0)) == again
        state = state.after(live.propose(state, CHOOSER, 3.0))
        assert (state.pending.renderings["a"] == point) == (again == 0)
    with pytest.raises(RefusedError):
        live.missed(state, 1, "a", "late", 4.0)
    state = state.after(live.missed(state, state.pending.id, "reference", "late", 4.0))
    assert len(state.excluded(0)) == 1  # the reference is no rendering


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"within": 0.0}, "stimulus.within is 0.0; it must be a number of seconds from 0.1 to 600"),
        ({"silence": "long"}, "stimulus.silence"),
        ({"tolerance": {"w": 1.0}}, "stimulus.tolerance.w is of no parameter of the study, those are u, v, f"),
        ({"tolerance": {"u": -1.0}}, "stimulus.tolerance.u is -1.0; it must be a number, 0 or above"),
        ({"tolerance": {"u": float("nan")}}, "stimulus.tolerance.u"),
        ({"tolerance": 3}, "stimulus.tolerance is 3; it must be a table"),
        ({"late": 3}, "stimulus.late is not a key"),
    ],
)
def test_a_bad_table_is_refused_in_one_sentence(table, words):
    with pytest.raises(InputError) as caught:
        Study.from_dict(LOGARITHMIC | {"stimulus": table})
    assert words in str(caught.value) and "\n" not in str(caught.value)


FOSLS = RAW | {
    "parameters": {n: {"low": 0.1, "high": 0.9} for n in ("K1", "B1", "alpha")},
    "renderer": {"K_eff": 0.44, "damping": 0.95},
}


def test_a_program_renders_the_fosls_where_the_study_says_so():
    assert Study.from_dict(FOSLS).file.stimulus is None and Study.from_dict(RAW).file.stimulus is not None
    study = Study.from_dict(FOSLS | {"stimulus": {}})
    assert study.file.stimulus.role == "stimulus" and study.file.meaning != Study.from_dict(FOSLS).file.meaning
    with pytest.raises(InputError, match="a person cannot render a force by hand"):
        Study.from_dict(FOSLS | {"stimulus": {"by": "person"}})


def test_K0_is_sent_need_not_be_confirmed_and_counts_as_sent():
    study = Study.from_dict(FOSLS | {"stimulus": {"tolerance": {"K1": 0.01}}})
    asked = Rendering.at(study.space, np.array([0.4, 0.6, 0.3])).parameters
    assert list(asked) == ["K1", "B1", "alpha", "K0"]
    own = {name: asked[name] for name in study.space.names}
    for values in (asked, own, asked | {"K0": asked["K0"] * (1 + 6e-8)}):
        check_confirmed(study.file, asked, values)
        assert counted(study.file, asked, values) == asked
    assert counted(study.file, asked, own | {"K1": asked["K1"] + 0.005}) == asked | {"K1": asked["K1"] + 0.005}
    for wrong in (asked["K0"] * 1.001, float("nan")):
        with pytest.raises(RefusedError, match="K0 is confirmed as"):
            check_confirmed(study.file, asked, asked | {"K0": wrong})
    with pytest.raises(RefusedError, match="K0 is confirmed as"):
        check_confirmed(study.file, own, asked)


def compared(study, off):
    """A session of one comparison, whose sides are confirmed a little off."""
    block = Block("validation", 1, (Planned("D", "E"),))
    first = msgspec.structs.replace(header(), study=study.file.hash, blocks=(block,))
    state = LiveSession.start(study.file, first)
    state = state.after(live.propose(state, CHOOSER, 1.0))
    for step, (show, _) in enumerate(state.steps_of(state.pending)):
        values = SETS[{"a": "D", "b": "E"}.get(show, "D")]
        values = values | {"u": values["u"] + off.get(show, 0.0)}
        for event in beginning(state, 1, step, 2.0, values):
            state = state.after(event)
    values = {"class_a": "close", "class_b": "similar", "preferred": "a"}
    return state.after(live.answer(state, 1, "c", values, 3.0))


def test_the_table_of_comparisons_has_what_was_confirmed_of_either_side(tmp_path):
    state = compared(STUDY, {"a": 0.004, "b": -0.006})
    (row,) = validation_table([state]).to_dict("records")
    assert row["presented_a_u"] == SETS["D"]["u"] + 0.004 and row["presented_b_u"] == SETS["E"]["u"] - 0.006
    assert row["presented_a_v"] == SETS["D"]["v"] and row["presented_b_v"] == SETS["E"]["v"]
    assert sets_table([state]).set_index("set_id").at["D", "u"] == SETS["D"]["u"]  # as it was planned
    psych_ds([state], tmp_path, STUDY.file)
    sidecar = (tmp_path / "data" / "study-plain_table-validation_data.json").read_text()
    assert "value confirmed as presented on side b" in sidecar


def test_confirmed_values_take_the_place_of_no_other_column():
    raw = RAW | {"parameters": {n: RAW["parameters"]["u"] for n in ("set", "class", "presented_a_set")}}
    raw |= {"stimulus": {"within": 2.0}}
    study = Study.from_dict(raw)
    trial = compared(STUDY, {}).trials[0]
    columns = [f"presented_{side}_{name}" for side in "ab" for name in study.space.names]
    values = {side: dict(zip(study.space.names, (0.1, 0.2, 0.3), strict=True)) for side in "ab"}
    trial = replace(trial, data=trial.data | {"renderings": values}, confirmed={})
    state = partly(LiveSession, study=study.file, header=header("validation"), trials=[trial])
    table = validation_table([state])
    assert [name for name in table if name.startswith("presented_")] == columns
    assert table["set_a"].tolist() == ["D"] and table["class_b"].tolist() == ["similar"]
