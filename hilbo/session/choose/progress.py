"""How far a session has come: for the experimenter, who may stop earlier or go on; nothing stops by itself.

`trust` looks at the answers of an optimisation through the participant's posterior:

- the probability that the current best rendering is answered with the highest category,
- how far the best rendering is expected to move with one more answer: the mean over the answers that the posterior
  predicts for the rendering that comes next, of the NRMSE (share of the search ranges) between the bests.

`consistency` looks at the repeated trials, `hilbo.app.pages.pace` at the clock. The paper's fixed number of trials
stays the default.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from hilbo.numerics.tracing import program
from hilbo.search.apart import nrmse
from hilbo.session.choose.look_ahead import Answers, LiveChooser
from hilbo.session.choose.step import Fitted
from hilbo.session.log.state import LiveSession
from hilbo.study.config import Study

__all__ = ["Consistency", "Trust", "consistency", "trust", "trust_of"]


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
    fitted: Fitted,
    upcoming: Float[np.ndarray, " d"] | None,
    following: Sequence[Fitted],
    best: Callable[[Fitted], Float[np.ndarray, " d"]],
) -> Trust:
    """From the posterior after the answers so far, the rendering that comes next (physical units), and the posteriors
    after each answer to it. `best` finds where a posterior's mean is largest. Nothing is fitted."""
    bests = np.stack([best(one) for one in (fitted, *following)])
    asked = bests[0] if upcoming is None else upcoming
    top, chances = np.asarray(_chances(study, fitted.posterior, np.stack([bests[0], asked])))
    named = dict(zip(study.space.names, bests[0].tolist(), strict=True))
    if upcoming is None:
        return Trust(named, float(top[-1]), None)
    units = np.asarray(_units(study, bests))
    moved = np.asarray(nrmse(units[1:], units[0], study.gp.kernel.levels))
    return Trust(named, float(top[-1]), float(chances @ moved))


@program
def _chances(study, posterior, physical):
    return posterior.class_probabilities(study.space.to_unit(physical))


@program
def _units(study, physical):
    return study.space.to_unit(physical)


def trust_of(state: LiveSession, block: int, chooser: LiveChooser) -> Trust | None:
    """`trust` in an optimisation block of a session, whose `chooser` knows the posteriors; None before its first
    answer."""
    answers, study = Answers.of(state, block), chooser.study(block)
    if not answers.categories:
        return None
    trial = state.pending
    # The answer to a repeat does not count, and moves nothing.
    counts = trial is not None and trial.block == block and trial.repeats is None
    upcoming = np.array([trial.presented["a"][name] for name in study.space.names]) if trial and counts else None
    following = chooser.fitted_after_each_answer(state) if counts else []
    return trust(study, chooser.fitted(answers), upcoming, following, lambda one: chooser.best(block, one))


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
