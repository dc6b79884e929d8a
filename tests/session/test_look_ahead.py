"""What a live session shows next: the very renderings of `Session`, found before they are asked for."""

import dataclasses

import jax.numpy as jnp
import msgspec
import numpy as np
import pytest
from live import RAW, STUDY, beginning, header

from hilbo import Session, Study
from hilbo.app.pages.pace import minutes_left
from hilbo.errors import InputError
from hilbo.search.candidates import search_points
from hilbo.session.choose import choice as choosing
from hilbo.session.choose.choice import APART, Answers, all_excluded, spread_point, unanswered
from hilbo.session.choose.logged_session import LoggedSession
from hilbo.session.choose.look_ahead import LiveChooser
from hilbo.session.choose.progress import consistency, trust_of
from hilbo.session.choose.warm_start import informed, warm_point, warm_start
from hilbo.session.log import actions as live
from hilbo.session.log.event_log import EventLog, read_log
from hilbo.session.log.header import header_for
from hilbo.session.log.log_files import log_name
from hilbo.session.log.state import LiveSession
from hilbo.study.file.plan_file import Block

ANSWERS = ("similar", "different", "close", "close", "similar", "close")


def start(**changes):
    head = msgspec.structs.replace(header(), blocks=(Block("optimisation", 6),), sets={}, **changes)
    return LiveSession.start(STUDY.file, head)


def asked(state, chooser, at=0.0):
    return state.after(live.propose(state, chooser, at))


def told(state, response, at=1.0):
    return state.after(live.answer(state, state.pending.id, f"c{state.seq}", {"class_a": response}, at, felt=False))


@pytest.fixture(scope="module")
def chooser():
    return LiveChooser(start())


def test_renderings_are_those_of_a_session_and_no_fit_runs_after_an_answer(chooser):
    state, session, events = start(), Session.start(STUDY, seed=0), []
    for number, response in enumerate(ANSWERS):
        before = chooser.fits
        event = live.propose(state, chooser, 0.0)
        assert chooser.fits == before or number == 0
        events.append(event)
        state = state.after(event)
        assert state.pending.renderings["a"] == session.ask()
        ahead = chooser.lookahead(state)
        assert set(ahead) == (set(STUDY.responses) if number < 5 else set())
        choice = state.pending.data["choice"]
        assert choice["by"] == ("latin hypercube" if number < 2 else "ucb") and choice["certificate"]["converged"]
        if number >= 2:
            x = STUDY.space.to_unit(np.array(list(session.ask().values())))
            mean, variance = session.posterior().predict(x[None, :])
            np.testing.assert_allclose([choice["mean"], choice["sd"] ** 2], [mean[0], variance[0]], atol=1e-9)
            assert choice["score"] == pytest.approx(choice["mean"] + 0.7 * choice["sd"], rel=1e-12)
        session = session.tell(response)
        state = told(state, response)
    assert state.screen == "done" and session.done
    fresh, state = LiveChooser(start()), start()
    for event in events[:4]:
        state = told(state.after(event), ANSWERS[event.data["trial"] - 1])
    assert live.propose(state, fresh, 0.0).data == events[4].data | {"planned": None}


def test_what_a_program_confirmed_is_what_the_next_choice_is_made_from(chooser):
    state, asks, confirmed, by = start(), [], [], []
    for response in ANSWERS:
        state = asked(state, chooser)
        point = state.pending.renderings["a"]
        by.append(state.pending.data["choice"]["by"])
        asks.append(point)
        confirmed.append({name: value + (5e-7 if value < 0.5 else -5e-7) for name, value in point.items()})
        for event in beginning(state, state.pending.id, 1, 0.5, confirmed[-1]):
            state = state.after(event)
        chooser.lookahead(state)  # once it is known what is presented
        fits = chooser.fits
        state = told(state, response)
        if state.need is not None:
            live.propose(state, chooser, 1.0)
        assert chooser.fits == fits
        points = np.array([list(values.values()) for values in confirmed])
        answers = Answers.of(state, 0)
        np.testing.assert_array_equal(np.array(answers.points), points)
        np.testing.assert_allclose(
            np.asarray(chooser.fitted(answers).posterior.trials.x)[: len(points)],
            np.asarray(STUDY.space.to_unit(points)),
            atol=1e-12,
        )
    assert by == 2 * ["latin hypercube"] + 4 * ["ucb"]
    assert asks[0] != asks[1]  # the first is not asked again, though it was not quite what was presented


@pytest.mark.parametrize("count", [1, 3])
def test_a_rendering_stopped_twice_is_replaced_by_a_feasible_one_apart(chooser, count):
    state = start()
    for response in ANSWERS[:count]:
        state = told(asked(state, chooser), response)
    state = asked(state, chooser)
    point = state.pending.renderings["a"]
    for again in range(2):
        for event in beginning(state, state.pending.id, 1, 0.5):
            state = state.after(event)
        state = asked(state.after(live.device(state, "hold", 1.0)), chooser)
        assert (state.pending.renderings["a"] == point) == (again == 0)
    unit = [STUDY.space.to_unit(np.array([p["u"], p["v"]])) for p in (point, state.pending.renderings["a"])]
    assert np.linalg.norm(unit[0] - unit[1]) >= APART
    assert bool(STUDY.space.feasible(unit[1]))
    state = asked(told(state, "close"), chooser)
    assert state.pending.renderings["a"] != point


def test_the_likeliest_answer_is_looked_ahead_to_first_and_no_other_once_nobody_wants_it(chooser):
    state = start()
    for response in ANSWERS[:3]:
        state = told(asked(state, chooser), response)
    state = asked(state, chooser)
    likely = state.pending.data["choice"]["probabilities"]
    order = sorted(likely, key=lambda response: -likely[response])
    assert order != list(STUDY.responses) and list(chooser.lookahead(state)) == order
    for many in range(3):
        left = iter([True] * many + [False])
        assert list(chooser.lookahead(state, lambda left=left: next(left))) == order[:many]


def test_a_warm_start_chooses_from_the_map_and_is_in_the_header():
    points = search_points(STUDY.space, 0)
    mean = 2.0 - 40.0 * ((points - np.array([0.7, 0.2])[None, :]) ** 2).sum(axis=1)
    warm = warm_start(STUDY, points, mean, 0.05 * np.ones(len(points)) + 0 * mean, "a-map")
    state = start(warm_start="=a-map")
    chooser = LiveChooser(state, {None: warm})
    state = asked(state, chooser)
    first = np.array(list(state.pending.renderings["a"].values())[:2])
    assert np.linalg.norm(first - [0.7, 0.2]) < 0.05 and state.pending.data["choice"]["by"] == "map"
    assert set(chooser.lookahead(state)) == set(STUDY.responses)
    state = asked(told(state, "different"), chooser)
    second = np.array(list(state.pending.renderings["a"].values())[:2])
    assert np.linalg.norm(second - first) > 0.05
    with pytest.raises(
        InputError, match="begun from the map whose SHA-256 begins with a-map, not without --warm-start"
    ):
        LiveChooser(state)
    mu, s = informed(STUDY, warm, Session.start(STUDY).posterior())
    np.testing.assert_allclose(mu, warm.mean, rtol=1e-12)
    np.testing.assert_allclose(s, 0.05 + 0.5, rtol=1e-12)


def test_a_value_that_the_first_design_has_twice_is_asked_twice():
    design = np.array([[1.0], [0.0], [0.0], [1.0], [1.0]])
    left = unanswered(design, ((1.0,), (0.0,)), ())
    assert [row.tolist() for row in left] == [[0.0], [1.0], [1.0]]
    assert [row.tolist() for row in unanswered(design, ((0.0,),), ((1.0,),))] == [[0.0]]


def test_where_every_value_was_asked_the_one_asked_least_comes_and_no_excluded_one():
    raw = RAW | {"parameters": {"n": {"low": 0.0, "high": 4.0, "integer": True}}}
    study, asked_for = Study.from_dict(raw), [[float(n)] for n in range(5)]
    for _ in range(8):
        asked_for.append(spread_point(study, np.array([[2.0]]), np.array(asked_for), 0).tolist())
    counts = [asked_for.count([float(n)]) for n in range(5)]
    assert counts == [3, 3, 1, 3, 3]


def test_where_every_rendering_stopped_twice_they_come_in_turn():
    raw = RAW | {"parameters": {"n": {"low": 0.0, "high": 2.0, "integer": True}}}
    study = Study.from_dict(raw)
    state = LiveSession.start(study.file, header_for(study.file, "P01", warm=False))
    chooser, stopped = LiveChooser(state), []
    while len(stopped) < 12:
        state = asked(state, chooser)
        stopped.append(state.pending.renderings["a"]["n"])
        for event in beginning(state, state.pending.id, 1, 0.5):
            state = state.after(event)
        state = state.after(live.device(state, "hold", 1.0))
    assert sorted(stopped[:6]) == [0, 0, 1, 1, 2, 2]
    assert [sorted(stopped[i : i + 3]) for i in (6, 9)] == [[0, 1, 2], [0, 1, 2]]
    state = asked(state, chooser)
    assert state.pending.data["choice"]["by"] == "stopped least often"


def test_of_many_steps_one_that_never_stopped_comes_first():
    raw = RAW | {"parameters": {"n": {"low": 0.0, "high": 40.0, "integer": True}}}
    stopped = np.arange(0.0, 41.0, 2.0)[:, None]
    (left,) = all_excluded(Study.from_dict(raw), stopped)
    assert left % 2 == 1
    everything = np.arange(41.0)[::-1, None]
    assert all_excluded(Study.from_dict(raw), everything).tolist() == [40.0]
    assert all_excluded(Study.from_dict(raw), stopped[:3]) is None


def test_a_warm_start_keeps_apart_from_one_level_and_not_from_its_neighbour():
    """Levels have no order: of 30 the next in the list is as far away as any other."""
    raw = RAW | {"parameters": {"sound": {"levels": [f"s{i}" for i in range(30)]}}}
    study = Study.from_dict(raw)
    points = jnp.linspace(0.0, 1.0, 30)[:, None]
    warm = warm_start(study, points, -jnp.abs(jnp.arange(30.0) - 4.0), jnp.full(30, 0.1))
    posterior = Session.start(study).posterior()
    assert float(warm_point(study, warm, posterior, points[3:4], APART)[0]) == float(points[4, 0])
    assert float(warm_point(study, warm, posterior, points[4:5], APART)[0]) in (
        float(points[3, 0]),
        float(points[5, 0]),
    )


def test_the_informed_posterior_is_the_committee_of_map_and_answers():
    points = search_points(STUDY.space, 0)[:50]
    mean, variance = np.linspace(-1, 1, 50), np.linspace(0.1, 0.9, 50)
    warm = warm_start(STUDY, points, points[:, 0] * 0 + mean, points[:, 0] * 0 + variance, share=0.25)
    session = Session.start(STUDY)
    for response in ANSWERS[:3]:
        session = session.tell(response)
    own_mean, own_variance = (np.asarray(v) for v in session.posterior().predict(points))
    before = variance + 0.75
    precision = 1 / before + 1 / own_variance - 1.0  # the prior's variance is 1
    mu, s = informed(STUDY, warm, session.posterior())
    np.testing.assert_allclose(s, 1 / precision, rtol=1e-9)
    np.testing.assert_allclose(mu, (mean / before + own_mean / own_variance) / precision, rtol=1e-8, atol=1e-12)


def begun(chooser):
    state = start()
    for number, response in enumerate(ANSWERS[:4]):
        state = told(asked(state, chooser), response, at=20.0 * number)
    return state


def test_pace_and_consistency(chooser):
    assert minutes_left(start()) == pytest.approx(6 * 1.5 * 8 / 60)
    state = begun(chooser)
    assert minutes_left(state) == pytest.approx(2 * 20 / 60)
    assert consistency(state).pairs == 0
    state = asked(state.after(live.repeat(state, 1.0, 3)), chooser)
    trust = trust_of(state, 0, chooser)
    assert trust is not None and trust.movement is None  # the answer to a repeat moves nothing
    state = told(state, "similar")
    assert consistency(state).__dict__ == {"pairs": 1, "alike": 0, "distance": 1.0}  # "similar" after "close"


def test_a_logged_session_is_a_session_and_resumes(tmp_path):
    head = msgspec.structs.replace(header(warm=1), seed=7)
    session, asked_for = Session.start(STUDY, seed=7), []
    for part in (3, 10):
        with LoggedSession.open(tmp_path, STUDY, head) as logged:
            for _ in range(part):
                point = logged.ask()
                assert logged.ask() == point
                if point is None:
                    break
                if logged.state.pending.block == 1:
                    asked_for.append(point)
                    assert point == session.ask()
                    session = session.tell(ANSWERS[len(asked_for) - 1])
                logged.tell(ANSWERS[len(asked_for) - 1])
    assert len(asked_for) == 6 and logged.state.screen == "done"
    with pytest.raises(InputError, match="begun with another seed"):
        LoggedSession.open(tmp_path, STUDY, header(warm=1))
    with LoggedSession.open(tmp_path, STUDY, head) as logged, pytest.raises(InputError, match="call ask"):
        logged.tell("close")


@pytest.mark.deep
def test_trust_in_the_best_rendering(chooser):
    state = begun(chooser)
    assert trust_of(start(), 0, chooser) is None
    trust = trust_of(asked(state, chooser), 0, chooser)
    assert trust is not None and 0 <= trust.movement < 1
    session = Session.start(STUDY)
    for response in ANSWERS[:4]:
        session = session.tell(response)
    best = np.array(list(session.best().values()))
    posterior = session.posterior()
    trust_best = np.array(list(trust.best.values()))
    means = posterior.mean(STUDY.space.to_unit(np.stack([best, trust_best])))
    np.testing.assert_allclose(means[0], means[1], atol=1e-6)
    asks = asked(state, chooser).pending.renderings["a"]
    chances = posterior.class_probabilities(STUDY.space.to_unit(np.array(list(asks.values())))[None, :])[0]
    moved = [
        np.sqrt(np.mean((np.array(list(session.tell(r).best().values())) - best) ** 2)) for r in STUDY.responses
    ]  # the box is the unit square
    assert trust.movement == pytest.approx(float(np.dot(chances, moved)), abs=1e-3)


def test_several_materials_have_studies_of_their_own():
    raw = RAW | {"materials": {"soft": {"parameters": {"u": {"low": 5.0, "high": 6.0}}}, "hard": {}}}
    study = Study.from_dict(raw)
    head = msgspec.structs.replace(
        header(),
        study=study.file.hash,
        sets={},
        blocks=tuple(Block("optimisation", 1, material=m) for m in ("soft", "hard")),
    )
    state = LiveSession.start(study.file, head)
    chooser = LiveChooser(state)
    state = asked(state, chooser)
    assert 5.0 <= state.pending.renderings["a"]["u"] <= 6.0
    state = asked(told(state, "close"), chooser)
    assert state.pending.data["material"] == "hard" and state.pending.renderings["a"]["u"] <= 1.0


def optimising(study, *materials):
    blocks = tuple(Block("optimisation", 2, material=m) for m in materials)
    return LiveSession.start(
        study.file, msgspec.structs.replace(header(), study=study.file.hash, sets={}, blocks=blocks)
    )


def test_materials_have_space_filling_points_of_their_own_that_do_not_depend_on_their_order():
    study = Study.from_dict(RAW | {"materials": {"soft": {}, "hard": {}}})
    seen = {}
    for order in (("soft", "hard"), ("hard", "soft"), ("soft",)):
        state, points = optimising(study, *order), {}
        chooser = LiveChooser(state)
        while state.screen != "done":
            state = asked(state, chooser)
            points.setdefault(state.pending.data["material"], []).append(state.pending.renderings["a"])
            state = told(state, "close")
        seen[order] = points
    assert seen["soft", "hard"] == seen["hard", "soft"]
    both = seen["soft", "hard"]
    assert not any(point in both["hard"] for point in both["soft"])
    assert seen[("soft",)]["soft"] == both["soft"]


def test_a_second_session_has_other_points(tmp_path):
    plain = Session.start(STUDY, seed=0)
    first, second = plain.ask(), plain.tell("close").ask()
    with LoggedSession.open(tmp_path, STUDY, header_for(STUDY.file, "P01", "2", 0, warm=False)) as session:
        assert session.ask() not in (first, second)


def test_a_voided_space_filling_trial_is_asked_again_and_no_other_one(chooser):
    state = start()
    for response in ANSWERS[:3]:
        state = told(asked(state, chooser), response)
    first, second, _ = (t.renderings["a"] for t in state.trials)
    for answered in (2, 3):
        here = state
        if answered == 2:
            here = here.after(live.undo(here, 1.0))
        here = asked(here.after(live.void(here, 1, "a cough", 1.0)), chooser)
        assert here.pending.renderings["a"] == first and here.pending.data["choice"]["by"] == "latin hypercube"
        here = asked(told(here, "similar"), chooser)
        assert here.pending.renderings["a"] not in (first, second)


def test_a_space_filling_point_that_is_not_shown_again_is_replaced_once(chooser):
    state = asked(start(), chooser)
    point = state.pending.renderings["a"]
    for _ in range(2):
        for event in beginning(state, state.pending.id, 1, 0.5):
            state = state.after(event)
        state = asked(state.after(live.device(state, "hold", 1.0)), chooser)
    by = []
    for response in ANSWERS[:3]:
        by.append(state.pending.data["choice"]["by"])
        state = asked(told(state, response), chooser)
    assert by == ["latin hypercube", "latin hypercube", "ucb"]
    asked_for = [t.renderings["a"] for t in state.answers(0)]
    assert point not in asked_for and asked_for[0] != asked_for[1]


def test_numbers_that_are_none_stay_out_of_a_choice_and_of_the_log(monkeypatch, tmp_path):
    def broken(study, posterior, point):
        predicted, nan = real(study, posterior, point), jnp.asarray(np.nan)
        figures = dataclasses.replace(predicted.certificate, residual=nan, condition=jnp.asarray(np.inf))
        return predicted._replace(mean=nan, variance=jnp.asarray(-1e-18), certificate=figures)

    real = choosing._prediction
    monkeypatch.setattr(choosing, "_prediction", broken)
    event = live.propose(start(), LiveChooser(start()), 0.0)
    choice = event.data["choice"]
    assert not {"mean", "sd"} & set(choice)
    assert not {"residual", "condition"} & set(choice["certificate"]) and choice["certificate"]["converged"]
    head = start().header
    with EventLog.create(tmp_path / log_name(head), STUDY.file, head) as log:
        log.append(event)
        alive = log.state
    header_, events, _ = read_log(tmp_path / log_name(head), STUDY.file)
    assert LiveSession.fold(STUDY.file, header_, events) == alive


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_rendering_that_is_no_number_is_refused_where_it_is_proposed(value):
    class Broken:
        def choose(self, state, need):
            return {"renderings": {"a": {"u": 0.5, "v": float(value)}}, "choice": {"by": "ucb"}}

    with pytest.raises(InputError, match=r"v is (nan|inf)"):
        live.propose(start(), Broken(), 0.0)
