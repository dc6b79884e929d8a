"""Convergence of optima over trials: the population's and each participant's optimum after the first 1, 2, ... trials.

A prefix of the trials is fitted like any cohort and searched from the same candidates; the last point is the aggregate
itself, which is not fitted again. Maps of prefixes are aggregated point by point: by the study's method, or by its
pointwise counterpart if it takes all responses at once.

The distance to the final optimum ends at 0 for any responses. So participants are also split into random halves:
what is the distance of the optimum of one half, after fewer trials, from that of the other half after all trials?
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hilbo.likelihoods import Goal, OrdinalProbit
from hilbo.numerics.host import to_device
from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import Posterior
from hilbo.population.maps import RuleMap, point_rule
from hilbo.population.pointwise import aggregate
from hilbo.population.rules.registry import RULES
from hilbo.search.apart import nrmse
from hilbo.search.candidates import search_points
from hilbo.study.config import Study
from hilbo.study.estimate.aggregate import Aggregate, fit_cohort
from hilbo.study.estimate.optimum import individual_optima, map_optimum, score

__all__ = ["Progress", "follow"]

_SPLITS = 50  # of the people into halves
_FEWEST = 4  # people who can be split
_POINTS = 1000  # candidate points of the optimum of a half
_LONGEST = 25  # points of a progress curve
_AT_A_TIME = 2  # of which so many are computed: each search keeps a core busy, and no more
_MOMENTS = (5, 15, 25)  # numbers of trials whose maps are drawn, as in the paper, and all trials


class Progress(NamedTuple):
    """Optima (unit cube) after the first `counts` trials of each participant: the population's, and the individual
    ones."""

    counts: Int[np.ndarray, " p"]
    population: Float[np.ndarray, "p d"]
    individual: Float[np.ndarray, "p M d"]
    ends: Int[np.ndarray, " M"]
    """Number of responses of each participant."""
    halves: Float[np.ndarray, "p s"]
    """NRMSE of the optimum of one half of the participants to the other half's after all trials, for every split and
    side."""
    individual_to_half: Float[np.ndarray, "p M"]
    """NRMSE of each individual optimum to that of the half without the participant; median over the splits."""
    maps: dict[int, RuleMap]
    """Number of trials -> population map with all posteriors, for the numbers of trials that figures show."""
    levels: tuple[int, ...] = ()
    """Numbers of levels per parameter, as in the kernel."""

    @property
    def splits(self) -> int:
        """Number of optima of halves, two per split; 0 if there were too few participants to split."""
        return self.halves.shape[1]

    @property
    def moments(self) -> list[int]:
        """Numbers of trials for which a map was kept."""
        return list(self.maps)

    def at(self, counts: Sequence[int]) -> Int[np.ndarray, " k"]:
        """Row index of each of these numbers of trials in `counts`; they must be in it."""
        return np.searchsorted(self.counts, counts)

    def person(self, row: int) -> dict[int, Posterior]:
        """One participant's posterior at each of the moments: number of trials -> posterior. `row`: of the cohort."""
        return {count: jax.tree.map(lambda leaf: leaf[row], map_.experts) for count, map_ in self.maps.items()}

    def to_end(self) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "p M"]]:
        """NRMSE (p,) of the population's running optimum to the final one, and (p, M) of each participant's; NaN at
        numbers of trials beyond the participant's last response."""
        population = np.asarray(nrmse(self.population, self.population[-1], self.levels))
        individual = np.asarray(nrmse(self.individual, self.individual[-1], self.levels))
        return population, np.where(self.counts[:, None] <= self.ends[None, :], individual, np.nan)


def follow(study: Study, aggregated: Aggregate, seed: int = 0, counts: Sequence[int] | None = None) -> Progress:
    """Optima of the aggregate's cohort after fewer trials, with the hyperparameters of `study`. Two numbers of trials
    are computed at a time, in threads.

    `counts`: numbers of trials below the longest session, longer ones are ignored; by default about 25, and each
    participant's last. The longest session is always added, and is not fitted again. Raises `InputError` if the
    aggregate has no individual optima.
    """
    cohort = aggregated.cohort
    ends = cohort.counts()
    longest = int(ends.max())
    asked = _counts(ends) if counts is None else np.unique([*(count for count in counts if count < longest), longest])
    candidates = search_points(study.space, seed)

    split = _splits(len(cohort.names), seed)
    points = to_device(np.asarray(candidates)[:_POINTS])

    def after(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, RuleMap | None]:
        last = count == longest
        posteriors = aggregated.posteriors if last else fit_cohort(study, cohort.first(count))
        map_ = _map_by_points(study, aggregated.map.share, posteriors)
        population = np.asarray(map_optimum(study, map_, candidates).x)
        optima = aggregated.individuals if last else individual_optima(study, posteriors, candidates)
        halves = np.asarray(points)[_tops(study, map_, points, split)]
        return population, np.asarray(optima.x), halves, map_ if last or count in _MOMENTS else None

    optima_after = [after(count) for count in asked[:1].tolist()]  # whose programs serve the others
    with ThreadPoolExecutor(_AT_A_TIME) as pool:
        optima_after += pool.map(after, asked[1:].tolist())
    population, individual, halves, maps = zip(*optima_after, strict=True)
    kept = {count: map_ for count, map_ in zip(asked.tolist(), maps, strict=True) if map_ is not None}
    levels = study.gp.kernel.levels
    optima, tops = np.stack(individual), np.stack(halves)
    return Progress(
        asked, np.stack(population), optima, ends, *_to_other_half(levels, tops, optima, split), kept, levels
    )


def _splits(people: int, seed: int) -> Bool[np.ndarray, "s M"]:
    """Membership of the first half in each of 50 random splits, (s, M); s = 0 for fewer than four participants."""
    if people < _FEWEST:
        return np.zeros((0, people), bool)
    rng = np.random.default_rng(seed)
    order = np.stack([rng.permutation(people) for _ in range(_SPLITS)])
    return order < people // 2


def _tops(
    study: Study, map_: RuleMap, points: Float[Array, "m d"], split: Bool[np.ndarray, "s M"]
) -> Int[np.ndarray, "s 2"]:
    """Row of the point where the map of each half is highest, (s, 2), the first half first."""
    if not len(split):
        return np.zeros((0, 2), int)
    sides = np.stack([split, ~split], axis=1).reshape(-1, split.shape[1])
    return np.asarray(_highest(study.goal, study.gp.likelihood, map_, points, to_device(sides))).reshape(-1, 2)


@program
def _highest(
    goal: Goal, likelihood: OrdinalProbit, map_: RuleMap, points: Float[Array, "m d"], sides: Bool[Array, "k M"]
) -> Int[Array, " k"]:
    """Row of the point where the map of each subset of participants is highest by `score`. `sides` (k, M):
    membership."""
    means, explained = jax.lax.map(lambda person: person.predict_explained(points), map_.experts)

    share = map_.share if RULES[map_.rule].learns_share else None

    def one(chosen: Bool[Array, " M"]) -> Int[Array, ""]:
        moments = aggregate(map_.rule, means, explained, map_.prior, share=share, mask=chosen)
        return jnp.argmax(score(goal, likelihood, *moments, map_.apart))

    return jax.lax.map(one, sides)


def _to_other_half(
    levels: tuple[int, ...],
    tops: Float[np.ndarray, "p s 2 d"],
    individual: Float[np.ndarray, "p M d"],
    split: Bool[np.ndarray, "s M"],
) -> tuple[Float[np.ndarray, "p s2"], Float[np.ndarray, "p M"]]:
    """NRMSE to the other half's optimum after all trials: of each half's optimum (p, 2 s), and of each participant's
    own, as the median over splits (p, M); NaN without splits."""
    if not len(split):
        return np.zeros((len(tops), 0)), np.full(individual.shape[:2], np.nan)
    last = tops[-1, :, ::-1]  # of a half, the other half's
    halves = np.asarray(nrmse(tops, last, levels)).reshape(len(tops), -1)
    others = np.where(split[:, :, None], last[:, :1], last[:, 1:])  # of each person, the half without that person
    person = np.asarray(nrmse(individual[:, None], others, levels))
    return halves, np.median(person, axis=1)


def _map_by_points(study: Study, share: Float[Array, ""], posteriors: Posterior) -> RuleMap:
    """Map of these posteriors by the study's method, or by its pointwise counterpart if it takes all responses at
    once."""
    rule, rule_share = point_rule(study.rule, share)
    prior = jnp.asarray(study.gp.kernel.variance)
    return RuleMap(
        rule, "by points", posteriors, None, to_device(1.0, prior.dtype) if rule_share is None else rule_share, prior
    )


def _counts(ends: Int[np.ndarray, " M"]) -> Int[np.ndarray, " p"]:
    """Sorted numbers of trials: each participant's last, 5, 15 and 25, and up to 25 evenly spaced ones. `ends`:
    responses per participant."""
    longest = int(ends.max())
    even = np.linspace(1, longest, min(longest, _LONGEST)).round().astype(int)
    return np.unique([*ends[ends > 0], *even, *(n for n in _MOMENTS if n <= longest)])
