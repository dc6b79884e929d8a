"""Sessions under the other inferences: they ask, replay bit for bit, and ask what their own posterior says."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from live import RAW

from hilbo import Session, Study
from hilbo.acquisition import UCB
from hilbo.search.candidates import search_points

PAPER = Path("hilbo/data/paper.toml")
deep = pytest.mark.deep


def load(file, inference):
    raw = json.loads(Study.load(file).file.content) | {"schema": 1}
    return Study.from_dict(raw | {"gp": raw["gp"] | {"inference": inference}})


def small(inference):
    return Study.from_dict(RAW | {"gp": RAW["gp"] | {"inference": inference}})


RESPONSES = ["different", "similar", "close"]  # the last point by the acquisition


def test_a_small_session_asks_and_replays_bit_for_bit():
    study = small("ep")
    session = Session.replay(study, RESPONSES)
    assert Session.replay(study, RESPONSES).ask() == session.ask()
    fitted = session.step.fitted(session.points, session.answers)
    np.testing.assert_array_equal(fitted.point, session.proposal)
    assert fitted.posterior.certificate.converged


@deep
@pytest.mark.parametrize("inference", ["ep", "ep_corrected", "exact"])
def test_the_step_hands_out_the_posterior_that_a_fit_gives(inference):
    session = Session.replay(small(inference), RESPONSES)
    fitted = session.step.fitted(session.points, session.answers)
    np.testing.assert_array_equal(fitted.point, session.proposal)
    for ours, one in zip(jax.tree.leaves(fitted.posterior), jax.tree.leaves(session.posterior()), strict=True):
        np.testing.assert_allclose(ours, one, rtol=1e-8, atol=1e-10)


@deep
@pytest.mark.parametrize("inference", ["ep", "ep_corrected", "exact"])
def test_a_session_asks_and_replays_bit_for_bit(inference):
    study = load(PAPER, inference)
    session, responses = Session.start(study, seed=3), []
    for trial in range(7):  # the last two by the acquisition
        point = session.ask()
        responses.append(study.responses[trial % 3])
        session = session.tell(responses[-1])
    again = Session.replay(study, responses, seed=3)
    np.testing.assert_array_equal(again.points, session.points)
    assert again.ask() == session.ask() != point


@deep
@pytest.mark.parametrize("inference", ["ep", "ep_corrected", "exact"])
def test_the_next_point_is_the_best_by_the_sessions_own_posterior(inference):
    study = load(PAPER, inference)
    session = Session.replay(study, ["different", "similar", "close", "similar", "different"], seed=3)
    posterior = session.posterior()
    assert posterior.certificate.converged
    x = study.space.to_unit(np.array(list(session.ask().values())))[None, :]
    score = UCB(study.file.selection.weight)
    others = search_points(study.space, 8)  # points that the session has not looked at
    assert score(*posterior.predict(x))[0] >= jnp.max(score(*posterior.predict(others))) - 1e-6
