"""Ask and tell: one compilation, the same points again, inside the passive set."""

import copy
import json
import pickle
import subprocess
import sys

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from live import RAW
from live import STUDY as SMALL

from hilbo import Session, Study
from hilbo.acquisition import UCB, LogEI, TopCategory
from hilbo.errors import InputError
from hilbo.session.choose.ask_tell import physical_trials

PAPER = "hilbo/data/paper.toml"
DIFFERENTIABLE = ("top_category", "log_ei")
deep = pytest.mark.deep


def answer(study, point):
    x = np.asarray(study.space.to_unit(np.array(list(point.values()))))
    distance = np.linalg.norm(x - [0.15, 0.18, 0.2])
    return "close" if distance < 0.1 else "similar" if distance < 0.3 else "different"


def run(study, seed=3, trials=None):
    session, asked = Session.start(study, seed=seed), []
    while not session.done and (trials is None or len(asked) < trials):
        asked.append(session.ask())
        session = session.tell(answer(study, asked[-1]))
    return session, asked


@eqx.filter_jit
def all_feasible(space, physical):
    return jnp.all(space.feasible(space.to_unit(physical)))


def feasible(study, points):
    """Whether they are, in physical units; said by one program for up to 26 of them."""
    return bool(all_feasible(study.space, np.resize(points, (26, study.space.dim))))


@pytest.fixture(scope="module")
def study():
    return Study.load(PAPER)


@pytest.fixture(scope="module")
def finished(study):
    return run(study)


def test_a_whole_session_compiles_once(study, finished):
    compiled = finished[0].step.compiled
    assert compiled._cache_size() == 1
    again = run(study, seed=4)[0]
    assert again.step.compiled is compiled
    again.best()
    assert compiled._cache_size() == 1


def test_warming_compiles_the_step_that_is_used():
    session = Session.start(SMALL)
    session.warm().join()
    assert session.step.compiled._cache_size() == 1
    for _ in range(3):  # the first two were given
        session = session.tell("different")
    assert session.step.compiled._cache_size() == 1


def test_replay_gives_the_same_points_bit_for_bit(study, finished):
    session, asked = finished
    responses = [study.responses[q] for q in session.answers]
    again = Session.replay(study, responses, seed=3)
    np.testing.assert_array_equal(again.points, session.points)
    halfway = Session.replay(study, responses[:12], seed=3)
    assert halfway.ask() == asked[12]


def pickled(what):
    return pickle.loads(pickle.dumps(what))


@pytest.mark.parametrize("duplicate", [pickled, copy.deepcopy, copy.copy])
def test_a_session_that_is_saved_after_every_answer_goes_on_as_one_that_is_not(duplicate):
    session, saved = Session.start(SMALL, seed=3), duplicate(Session.start(SMALL, seed=3))
    for response in ["similar", "different", "close", "close", "similar", "different"]:
        assert saved.ask() == session.ask()
        session, saved = session.tell(response), duplicate(saved.tell(response))
    assert saved.done
    assert saved.best() == session.best()
    assert saved.step.compiled is session.step.compiled  # nothing is compiled again
    for array in (saved.points, saved.answers, duplicate(Session.start(SMALL)).proposal):
        assert not array.flags.writeable


@deep  # which imports and traces all
def test_a_pickled_session_goes_on_in_another_process(tmp_path):
    session = Session.replay(SMALL, ["similar", "different", "close"], seed=3)
    (tmp_path / "session.pickle").write_bytes(pickle.dumps(session))
    code = (
        "import jax, json, pickle; jax.config.update('jax_enable_x64', True)\n"
        f"session = pickle.loads(open({str(tmp_path / 'session.pickle')!r}, 'rb').read())\n"
        "print(json.dumps([session.ask(), session.tell('close').ask()]))"
    )
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == [session.ask(), session.tell("close").ask()]


@deep  # which imports and traces all
def test_replay_in_another_process_gives_the_same_points_bit_for_bit():
    responses = ["similar", "different", "close", "close", "similar"]
    code = (
        "import jax, json, sys; jax.config.update('jax_enable_x64', True)\n"
        "from hilbo import Session, Study\n"
        f"s = Session.replay(Study.from_dict({RAW!r}), {responses!r}, seed=3)\n"
        "print(json.dumps(s.ask()))"
    )
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == Session.replay(SMALL, responses, seed=3).ask()


def test_every_point_is_feasible_and_the_session_ends(study, finished):
    session, asked = finished
    assert len(asked) == study.file.selection.trials
    assert feasible(study, session.points)
    with pytest.raises(InputError, match="all 25 trials"):
        session.ask()
    for at in (None, asked[0]):
        with pytest.raises(InputError, match="all 25 trials"):
            session.tell(study.responses[0], at=at)


def test_the_best_point_is_feasible_and_better_than_every_asked_one(study, finished):
    session = finished[0]
    best = np.array(list(session.best().values()))
    assert feasible(study, best)
    means = np.asarray(session.posterior().mean(study.space.to_unit(np.vstack([best, session.points]))))
    assert means[0] >= means[1:].max() - 1e-6


def test_the_best_point_is_the_means_whatever_chooses_trials():
    """Not the acquisition's, and as near to earlier trials as it likes to be."""
    changed = RAW["selection"] | {"acquisition": "log_ei", "minimum_distance": 0.2}
    session = Session.replay(SMALL, ["similar", "close", "different", "close"])
    best = Session.start(Study.from_dict(RAW | {"selection": changed})).step.best(session.posterior())
    assert best.tolist() == pytest.approx(list(session.best().values()), rel=1e-4)


def test_states_are_immutable(study):
    session = Session.start(study, seed=3)
    following = session.tell("close")
    assert len(session.answers) == 0
    assert len(following.answers) == 1


def test_an_unknown_answer_is_refused(study):
    with pytest.raises(InputError, match='"closer" is no answer'):
        Session.start(study).tell("closer")


def test_padding_is_only_padding(study, finished):
    session = finished[0]
    trials = physical_trials(study, session.points[:7], session.answers[:7], 25)
    np.testing.assert_array_equal(trials.x[:7], physical_trials(study, session.points, session.answers, 25).x[:7])
    np.testing.assert_allclose(trials.x[:7], study.space.to_unit(session.points[:7]), rtol=0, atol=4e-16)
    assert int(trials.mask.sum()) == 7


@pytest.mark.parametrize("kind", ["thompson", *(pytest.param(k, marks=deep) for k in DIFFERENTIABLE)])
def test_other_acquisitions_choose_feasible_points(study, kind):
    raw = json.loads(study.file.content) | {"schema": 1}
    raw["selection"] = {"acquisition": kind, "trials": 7}
    session, asked = run(Study.from_dict(raw))
    assert len(asked) == 7
    assert feasible(study, session.points)


@pytest.mark.parametrize("kind", [DIFFERENTIABLE[0], *(pytest.param(k, marks=deep) for k in DIFFERENTIABLE[1:])])
def test_other_acquisitions_choose_the_best_by_their_score(kind):
    small = Study.from_dict(RAW | {"selection": RAW["selection"] | {"acquisition": kind}})
    session = Session.replay(small, ["similar", "close", "different"])
    posterior = session.posterior()
    score = {
        "top_category": TopCategory(small.gp.likelihood.thresholds[-1], small.gp.likelihood.noise),
        "log_ei": LogEI(posterior.mean(session.trials.x[:3]).max()),
    }[kind]
    chosen = np.asarray(small.space.to_unit(np.array([list(session.ask().values())])))
    x = jnp.asarray(np.concatenate([chosen, small.space.candidates(500, 5)]))
    scores = np.asarray(eqx.filter_jit(score)(*posterior.predict(x)))
    assert scores[0] >= scores[1:].max() - 1e-9


@deep
def test_a_smallest_distance_keeps_trials_apart(study):
    raw = json.loads(study.file.content) | {"schema": 1}
    raw["selection"] = {"minimum_distance": 0.2, "trials": 12}
    session, _ = run(Study.from_dict(raw))
    x = np.asarray(study.space.to_unit(session.points))
    for n in range(5, 12):  # the space-filling trials come as they are
        assert np.linalg.norm(x[:n] - x[n], axis=1).min() >= 0.2 - 1e-12


def liked_everywhere(kind, distance, count):
    """A study with a smallest distance, and the points of a session in which all are close."""
    changed = RAW["selection"] | {"acquisition": kind, "minimum_distance": distance}
    small = Study.from_dict(RAW | {"selection": changed})
    return small, np.asarray(small.space.to_unit(Session.replay(small, ["close"] * count).points))


@pytest.mark.parametrize("kind", ["ucb", pytest.param("thompson", marks=deep)])
def test_where_no_point_keeps_the_distance_the_farthest_is_asked(kind):
    """After the first trial nothing is 0.9 away any more: each is as far from the others as a point can be."""
    small, x = liked_everywhere(kind, 0.9, 5)
    everywhere = np.asarray(small.space.candidates(2000, 1))
    for n in range(small.file.selection.space_filling, 5):
        gaps = np.linalg.norm(everywhere[:, None, :] - x[None, :n], axis=2).min(axis=1)
        assert np.linalg.norm(x[:n] - x[n], axis=1).min() > min(0.9, gaps.max()) - 0.06


@pytest.mark.parametrize("kind", [pytest.param("ucb", marks=deep), "thompson"])
def test_a_distance_is_kept(kind):
    """Answers that pull to one place do not bring trials nearer to each other."""
    small, x = liked_everywhere(kind, 0.15, 6)
    for n in range(small.file.selection.space_filling, 6):
        assert np.linalg.norm(x[:n] - x[n], axis=1).min() >= 0.15 - 1e-9


def test_the_study_is_a_pytree_of_its_model_alone(study):
    assert len(eqx.filter(study, eqx.is_array).gp.likelihood.thresholds) == 2


def test_a_small_hill_is_found_beside_a_wide_plateau(study, finished):
    """Where nothing is known UCB is 0.7; nodes of the lattice beside this hill are lower, its top is higher."""
    x = np.stack(
        [
            [0.238, 0.096, 0.005, 0.438, 0.081, 0.078, 0.075, 0.148, 0.000, 0.079],
            [0.693, 0.571, 0.178, 0.878, 0.283, 0.560, 0.558, 0.545, 0.647, 0.471],
            [0.457, 0.205, 0.990, 0.046, 0.508, 0.169, 0.163, 0.239, 0.170, 0.077],
        ],
        axis=1,
    )
    answers = np.array([0, 2, 0, 0, 0, 2, 1, 0, 0, 0])
    fitted = Session.start(study).step.fitted(np.asarray(study.space.to_physical(x)), answers)
    chosen = study.space.to_unit(fitted.point)
    hill = jnp.array([0.181, 0.666, 0.110])
    at_choice, at_hill = UCB(0.7)(*fitted.posterior.predict(jnp.stack([chosen, hill])))
    assert study.space.feasible(hill) and at_hill > 0.701
    assert at_choice > at_hill


def test_what_was_presented_may_be_in_single_precision():
    """0.3 is 0.300000012 then, above a range that ends at 0.3."""
    ranges = {name: {"low": 0.1, "high": 0.3} for name in SMALL.space.names}
    session = Session.start(Study.from_dict(RAW | {"parameters": ranges}), seed=0)
    told = session.tell(SMALL.responses[0], at=dict.fromkeys(ranges, np.float32(0.3)))
    assert told.points[0].tolist() == [0.3] * len(ranges)
