"""Hyperparameters for a study from its pilot: those of `hilbo robustness`, with jackknife confidence intervals.

The delete-one jackknife over participants: the criterion is maximised without each participant in turn, and

    SE^2 = (M - 1) / M  sum_j (theta_(j) - mean theta_(.))^2,

on the logarithms of theta and noise, and on the thresholds as they are. Intervals are the estimate ± t(M - 1) SE.
Responses of one participant depend on each other, so that participants, not responses, are left out. The intervals
contain the variation between participants; that few people give a smaller theta than many is a bias, which they do not
contain (benchmarks/pilot.py). Reference: Efron & Stein (1981), Annals of Statistics 9(3):586.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import stats

from hilbo.errors import InputError
from hilbo.ordinal_gp import OrdinalGP
from hilbo.population.rules.registry import RULES
from hilbo.study.cohort import Cohort
from hilbo.study.config import Study
from hilbo.study.robustness.optimised import FixedAndOptimised, fixed_and_optimised

__all__ = ["FEWEST", "Pilot", "check_pilot", "pilot"]

FEWEST = 3
"""Number of participants with responses that a pilot needs at least."""


class Pilot(NamedTuple):
    """Confidence intervals of the hyperparameters that a pilot of `participants` was optimised for.

    `intervals`: hyperparameter ("theta", "noise", "thresholds") -> 95 % intervals (k, 2) of its values; a threshold is
    in units of the latent function. `unfinished`: participants without whom the search did not
    converge, or had no maximum in reach.
    """

    participants: int
    intervals: dict[str, Float[np.ndarray, "k 2"]]
    unfinished: tuple[str, ...]


def pilot(
    study: Study, cohort: Cohort, both: FixedAndOptimised, say: Callable[[str], None] = lambda words: None
) -> Pilot:
    """Jackknife intervals of the hyperparameters `both.learn`. `both`: of all participants, by `fixed_and_optimised`;
    `say`: is told of each participant who is left out.

    Raises `InputError` for a method that learns its hyperparameters, for levels, and for fewer than three participants
    with responses.
    """
    check_pilot(study, cohort)
    names = _answering(cohort)
    without = []
    for i, name in enumerate(names, 1):
        say(f"without participant {i} of {len(names)}")
        without.append(fixed_and_optimised(study, cohort.of([other for other in names if other != name]), both.learn))
    unfinished = tuple(name for name, each in zip(names, without, strict=True) if not each.converged or each.runaway)
    intervals = {}
    for name in both.learn:
        scaled, back = (np.asarray, np.asarray) if name == "thresholds" else (np.log, np.exp)
        replicates = scaled(np.stack([_values(each.optimised.gp, name) for each in without]))
        intervals[name] = back(_interval(scaled(_values(both.optimised.gp, name)), replicates))
    return Pilot(len(names), intervals, unfinished)


def check_pilot(study: Study, cohort: Cohort) -> None:
    """Raise `InputError` for a study or a cohort that `pilot` cannot treat."""
    participants = len(_answering(cohort))
    if RULES[study.rule].learns:
        raise InputError(
            f'pilot: rule = "{study.rule}" learns its hyperparameters from the study and needs no [gp]; leave out'
            " --pilot, or name a rule with given hyperparameters, such as bcm."
        )
    if study.gp.kernel.levels:
        raise InputError("pilot: [gp] has no hyperparameters of parameters with levels; leave out --pilot.")
    if participants < FEWEST:
        raise InputError(
            f"pilot: {participants} participants gave responses; {FEWEST} or more are needed for intervals"
            " of the hyperparameters."
        )


def _answering(cohort: Cohort) -> list[str]:
    """Participants with responses."""
    return [name for name, count in zip(cohort.names, cohort.counts(), strict=True) if count]


def _values(gp: OrdinalGP, name: str) -> Float[np.ndarray, " k"]:
    """The values of one hyperparameter of a model."""
    of = {"theta": gp.kernel.theta, "noise": gp.likelihood.noise, "thresholds": gp.likelihood.thresholds}
    return np.atleast_1d(np.asarray(of[name], float))


def _interval(estimate: Float[np.ndarray, " k"], replicates: Float[np.ndarray, "M k"]) -> Float[np.ndarray, "k 2"]:
    """95 % jackknife intervals of an estimate, from its replicates without each of M participants."""
    count = len(replicates)
    error = np.sqrt((count - 1) / count * np.sum((replicates - replicates.mean(axis=0)) ** 2, axis=0))
    reach = stats.t.ppf(0.975, count - 1) * error
    return np.stack([estimate - reach, estimate + reach], axis=1)
