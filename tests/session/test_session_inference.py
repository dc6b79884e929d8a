"""Sessions under the other inferences: they ask, replay bit for bit, and ask what their own posterior says."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from hilbo import Session, Study
from hilbo.acquisition import UCB
from hilbo.search.candidates import search_points

PAPER = Path("hilbo/data/paper.toml")
deep = pytest.mark.deep


def load(folder, inference):
    text = PAPER.read_text(encoding="utf-8")
    assert text.count('inference = "laplace"') == 1
    changed = folder / "study.toml"
    changed.write_text(text.replace('inference = "laplace"', f'inference = "{inference}"'), encoding="utf-8")
    return Study.load(changed)


@pytest.mark.parametrize(
    "inference", ["ep", pytest.param("ep_corrected", marks=deep), pytest.param("exact", marks=deep)]
)
def test_a_session_asks_and_replays_bit_for_bit(tmp_path, inference):
    study = load(tmp_path, inference)
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
def test_the_next_point_is_the_best_by_the_sessions_own_posterior(tmp_path, inference):
    study = load(tmp_path, inference)
    session = Session.replay(study, ["different", "similar", "close", "similar", "different"], seed=3)
    posterior = session.posterior()
    assert posterior.certificate.converged
    x = study.space.to_unit(np.array(list(session.ask().values())))[None, :]
    score = UCB(study.selection.weight)
    others = search_points(study.space, 8)  # points that the session has not looked at
    assert score(*posterior.predict(x))[0] >= jnp.max(score(*posterior.predict(others))) - 1e-6
