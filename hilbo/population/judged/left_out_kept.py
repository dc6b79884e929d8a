"""Prediction of left-out participants with hyperparameters that were learnt from all.

The same predictions as by `leave_one_out_learnt` with `again=False`, to rounding, at half the cost: of each fold's
posterior only the moments at the left-out participants' own points are computed.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hilbo.numerics.host import to_device
from hilbo.numerics.rows import rows_of
from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import Trials
from hilbo.population.judged.leave_one_out import LeftOut, newcomer_in_turn
from hilbo.population.learnt.rule import Learnt, learnt_features
from hilbo.population.newcomer import InTurn
from hilbo.population.shared.features import Pivots
from hilbo.population.shared.people_model import PeopleModel
from hilbo.population.shared.posterior import shared_moments
from hilbo.population.shared.scale_use import ScaleUse
from hilbo.population.shared.tallies import Tallies

__all__ = ["leave_one_out_kept"]

_AT_A_TIME = 2  # folds: much of their arithmetic is of one core


def leave_one_out_kept(
    learnt: Learnt,
    trials: Trials,
    groups: Sequence[Int[np.ndarray, " _"]] | None = None,
    say: Callable[[int, int], None] = lambda done, folds: None,
) -> LeftOut:
    """Predict each participant's responses without their data, with the hyperparameters of `learnt`, from all `trials`.

    **Arguments:** `trials`: stacked (M, n); `groups`: rows that are left out together, default: each participant alone;
    `say`: called with the number of folds done, and of all.
    """
    mask, q = np.asarray(trials.mask), np.asarray(trials.q)
    groups = list(np.arange(len(mask))[:, None] if groups is None else groups)

    def fold(group: Int[np.ndarray, " k"]) -> tuple[InTurn, bool]:
        others = mask.copy()
        others[group] = False
        answers, pivots = learnt_features(learnt, eqx.tree_at(lambda t: t.mask, trials, to_device(others)))
        left = rows_of(trials, group)
        in_turn, converged = _predicted(learnt.model, learnt.scale, answers, learnt.weights, pivots, left)
        return jax.tree.map(np.asarray, in_turn), bool(converged)

    folds = []
    with ThreadPoolExecutor(_AT_A_TIME) as pool:
        for done in pool.map(fold, groups):
            folds.append(done)
            say(len(folds), len(groups))
    rows = [person for group in groups for person in group]
    given = [mask[person] for person in rows]
    probabilities, log_given = (
        np.concatenate([row[answered] for row, answered in zip(np.concatenate(parts), given, strict=True)])
        for parts in zip(*(in_turn for in_turn, _ in folds), strict=True)
    )
    return LeftOut(
        np.repeat(rows, [answered.sum() for answered in given]),
        np.concatenate([q[person][mask[person]] for person in rows]).astype(int),
        probabilities,
        sum(not converged for _, converged in folds),
        log_given,
    )


@program
def _predicted(
    model: PeopleModel,
    scale: ScaleUse | None,
    answers: Tallies,
    start: Float[Array, "M n"],
    pivots: Pivots,
    left: Trials,
) -> tuple[InTurn, Bool[Array, ""]]:
    """Predictions of the stacked responses `left` (k, n) from those of the others, `answers`, and whether the fit
    converged. `start` (M, n): weights near the mode."""
    at = shared_moments(model, answers, start, pivots, left.x.reshape(-1, left.x.shape[-1]))

    def one(person):
        trials, mean, variance = person
        moments = mean, variance, model.own, at.effects
        return newcomer_in_turn(model.gp, moments, trials.x, trials.q, trials.mask, trials.context, scale)

    moments = (moment.reshape(left.mask.shape) for moment in (at.mean, at.variance))
    return jax.lax.map(one, (left, *moments)), at.converged
