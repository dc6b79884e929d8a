"""Progress of a session for the experimenter, who may stop earlier or continue; nothing stops by itself.

`trust` describes how well an optimisation has located the participant's best rendering, by how far that is expected to
move after one more answer: the mean over the predicted answers to the next rendering of the NRMSE (fraction of the
search ranges) between the two best renderings.

`consistency` compares repeated trials; `hilbo.app.pages.pace` is about the time. The default stays the paper's fixed
number of trials.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from hilbo.numerics.tracing import program
from hilbo.search.apart import nrmse
from hilbo.search.rendering import Rendering
from hilbo.session.choose.choice import Answers
from hilbo.session.choose.look_ahead import LiveChooser
from hilbo.session.choose.step import Fitted
from hilbo.session.log.state import LiveSession

__all__ = ["Consistency", "Trust", "consistency", "trust", "trust_of"]


@dataclass(frozen=True)
class Trust:
    """Estimate of the best rendering after the answers so far: parameter -> value in physical units, and how certain it
    is."""

    best: dict[str, float]
    movement: float | None
    """Expected movement of the best with one more answer, NRMSE; None where no rendering comes next."""


@dataclass(frozen=True)
class Consistency:
    """Agreement of repeated ratings: number of pairs, number of equal pairs, and mean distance in categories (None
    without pairs)."""

    pairs: int
    alike: int
    distance: float | None


def trust(
    chooser: LiveChooser,
    block: int,
    fitted: Fitted,
    upcoming: Float[np.ndarray, " d"] | None,
    following: Sequence[Fitted],
) -> Trust:
    """Compute `Trust` from posteriors; nothing is fitted.

    `fitted`: after the answers so far; `upcoming`: the next rendering (d,), physical units, or None; `following`: after
    each possible answer to it.
    """
    study = chooser.study(block)
    bests = np.stack([chooser.best(block, one) for one in (fitted, *following)])
    movement = None
    if upcoming is not None:
        chances = np.asarray(_chances(study, fitted.posterior, upcoming[None, :]))[0]
        units = np.asarray(_units(study, bests))
        movement = float(chances @ np.asarray(nrmse(units[1:], units[0], study.gp.kernel.levels)))
    return Trust(Rendering.of(study.space, bests[0]).values, movement)


@program
def _chances(study, posterior, physical):
    """Category probabilities (m, C) at points (m, d) in physical units."""
    return posterior.class_probabilities(study.space.to_unit(physical))


@program
def _units(study, physical):
    """Points from physical units to the unit cube."""
    return study.space.to_unit(physical)


def trust_of(state: LiveSession, block: int, chooser: LiveChooser) -> Trust | None:
    """`trust` for an optimisation block of a session; None before the first answer. Posteriors are from the chooser's
    cache, or fitted.

    `movement` is None unless a trial of this block is pending that is no repetition: the answer to any other does not
    change the best rendering.
    """
    answers, trial = Answers.of(state, block), state.pending
    if not answers.categories:
        return None
    fitted = chooser.fitted(answers)
    if trial is None or trial.block != block or trial.repeats is not None:
        return trust(chooser, block, fitted, None, [])  # the answer to a repeat does not count, and moves nothing
    upcoming = Rendering.of(chooser.study(block).space, trial.presented["a"]).point
    return trust(chooser, block, fitted, upcoming, [chooser.fitted(one) for one in Answers.after_pending(state)])


def consistency(state: LiveSession) -> Consistency:
    """Compare the answers to repeated trials with those to the trials they repeat, as far as both count."""
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
