"""How far a session has come: for the experimenter, who may stop earlier or go on; nothing stops by itself.

`trust` looks at the answers of an optimisation through the participant's posterior:

- the probability that the current best rendering is answered with the highest category,
- how far the best rendering is expected to move with one more answer: the mean over the answers that the posterior
  predicts for the rendering that comes next, of the NRMSE (share of the search ranges) between the bests.

`consistency` looks at the repeated trials, `minutes_left` at the clock. The paper's fixed number of trials stays the
default.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hilbo.config import Study
from hilbo.live_state import LiveSession
from hilbo.ordinal_gp import Trials, fit
from hilbo.session import best_point, physical_trials, search_points
from hilbo.trial_protocols import protocol

__all__ = ["Consistency", "Trust", "consistency", "minutes_left", "trust", "trust_of"]


@dataclass(frozen=True)
class Trust:
    """What the answers so far say of the best rendering (physical units)."""

    best: dict[str, float]
    top: float
    """Probability that the best rendering is answered with the highest category."""
    movement: float | None
    """Expected movement of the best with one more answer, NRMSE; None where no rendering comes next."""


@dataclass(frozen=True)
class Consistency:
    """Answers to renderings that were felt twice: how many pairs, how many alike, mean distance in categories."""

    pairs: int
    alike: int
    distance: float | None


def trust(
    study: Study,
    points: Float[np.ndarray, "n d"],
    answers: Sequence[int],
    upcoming: Float[np.ndarray, " d"] | None,
    seed: int,
) -> Trust:
    """From the answered renderings (physical units), their categories, and the rendering that comes next."""
    capacity = study.selection.trials + 1
    data = physical_trials(study, points, np.asarray(answers, int), capacity)
    candidates = search_points(study.space, seed)
    following = points[-1] if upcoming is None else upcoming
    best, top, movement = _trust(study, data, study.space.to_unit(following), candidates)
    physical = np.asarray(study.space.to_physical(best)).tolist()
    named = dict(zip(study.space.names, physical, strict=True))
    return Trust(named, float(top), None if upcoming is None else float(movement))


@eqx.filter_jit
def _trust(study, data: Trials, following: Float[Array, " d"], candidates):
    def after(category):
        """The best rendering after one more answer, none if it is -1; and class probabilities there and at the next."""
        more = data.append(following, jnp.maximum(category, 0))
        given = jax.tree.map(lambda before, after: jnp.where(category < 0, before, after), data, more)
        posterior = fit(study.gp, given, inference=study.inference, throw=False)
        best = best_point(study, posterior, candidates).x
        return best, posterior.class_probabilities(jnp.stack([best, following]))

    # One loop for both, because compiling a fit and a search takes longer than all of them.
    bests, probabilities = jax.lax.map(after, jnp.arange(-1, len(study.responses), dtype=data.q.dtype))
    moved = jnp.sqrt(jnp.mean((bests[1:] - bests[:1]) ** 2, axis=1))
    return bests[0], probabilities[0, 0, -1], jnp.sum(probabilities[0, 1] * moved)


def trust_of(state: LiveSession, block: int) -> Trust | None:
    """`trust` in an optimisation block of a session; None before its first answer."""
    name = state.header.blocks[block].material
    study = state.study if name is None else state.study.material(name)
    answered = state.answers(block)
    if not answered:
        return None

    def point(trial):
        return [trial.renderings["a"][name] for name in study.space.names]

    asked = state.pending if state.pending is not None and state.pending.block == block else None
    upcoming = None if asked is None else np.array(point(asked))
    answers = [study.responses.index(trial.values["class_a"]) for trial in answered if trial.values is not None]
    return trust(study, np.array([point(trial) for trial in answered]), answers, upcoming, state.header.seed)


def consistency(state: LiveSession) -> Consistency:
    """Of the repeated trials of a session against the trials they repeat."""
    ranks = {label: i for i, label in enumerate(state.study.responses)}
    distances = []
    for trial in state.trials:
        if trial.repeats is None or trial.status != "answered" or trial.values is None:
            continue
        source = state.trial(trial.repeats)
        if source.status == "answered" and source.values is not None:
            both = (trial.values, source.values)
            distances += [
                abs(ranks[both[0][ask]] - ranks[both[1][ask]]) for ask in ("class_a", "class_b") if ask in both[0]
            ]
    alike = sum(d == 0 for d in distances)
    return Consistency(len(distances), alike, float(np.mean(distances)) if distances else None)


def minutes_left(state: LiveSession) -> float:
    """Minutes to the end, rests included: the trials left at this participant's median pace, or, before the third
    answer, at the protocol's seconds and half as many for the answer."""
    times = sorted(t.answered["time"] for t in state.trials if t.answered is not None)
    gaps = np.diff(times)
    total = 0.0
    for i, block in enumerate(state.header.blocks):
        left = 0 if state.full(i) else state.quota(i) - len(state.answers(i)) - len(state.skipped(i))
        pace = 1.5 * protocol(state.study.session, block.phase).seconds if len(gaps) < 2 else float(np.median(gaps))
        total += left * pace + (block.rest if left and state.gate(i) == "rest" else 0.0)
    return total / 60.0
