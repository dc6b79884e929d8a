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
import numpy as np
from jaxtyping import Float

from hilbo.ordinal_gp import fit
from hilbo.session.ask_tell import Session, physical_trials
from hilbo.session.state import LiveSession
from hilbo.study.config import Study
from hilbo.study.protocols import protocol

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
    find, categories = Session.start(study, seed).step.best, np.asarray(answers, int)
    best = find(points, categories)
    following = best if upcoming is None else upcoming
    posterior = fit(
        study.gp,
        physical_trials(study, points, categories, study.selection.trials),
        inference=study.inference,
        throw=False,
    )
    top, chances = np.asarray(_chances(study, posterior, np.stack([best, following])))
    named = dict(zip(study.space.names, best.tolist(), strict=True))
    if upcoming is None:
        return Trust(named, float(top[-1]), None)
    more = np.concatenate([points, upcoming[None]])
    bests = [best, *(find(more, np.append(categories, one)) for one in range(len(study.responses)))]
    units = np.asarray(_units(study, np.stack(bests)))
    moved = np.sqrt(np.mean((units[1:] - units[0]) ** 2, axis=1))
    return Trust(named, float(top[-1]), float(chances @ moved))


@eqx.filter_jit
def _chances(study, posterior, physical):
    return posterior.class_probabilities(study.space.to_unit(physical))


@eqx.filter_jit
def _units(study, physical):
    return study.space.to_unit(physical)


def trust_of(state: LiveSession, block: int) -> Trust | None:
    """`trust` in an optimisation block of a session; None before its first answer."""
    name = state.header.blocks[block].material
    study = state.study if name is None else state.study.material(name)
    answered = state.answers(block)
    if not answered:
        return None

    def point(trial):
        return [trial.renderings["a"][name] for name in study.space.names]

    # The answer to a repeat does not count, and moves nothing.
    asked = next((t for t in [state.pending] if t is not None and t.block == block and t.repeats is None), None)
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
