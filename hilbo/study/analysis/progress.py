"""How optima come about: the population's and everybody's own after everybody's first 1, 2, ... trials.

A prefix of the trials is fitted like any cohort and searched from the same candidates; the last point is the aggregate
itself, which is fitted already. Maps of prefixes are aggregated point by point: by the study's rule, or by bcm
where the rule takes all answers at once.

The way to one's own last place ends at 0 whatever the answers. So people are also split into random halves, which share
nobody: how far is the optimum of one half, after fewer trials, from that of the other half after all?
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

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
from hilbo.study.estimate.optimum import individual_optima, map_optimum

__all__ = ["Progress", "follow"]

_SPLITS = 50  # of the people into halves
_FEWEST = 4  # people who can be split
_POINTS = 1000  # at which the optimum of a half is sought
_LONGEST = 25  # points of a progress curve
_AT_A_TIME = 2  # of which so many are computed: each search keeps a core busy, and no more
_MOMENTS = (5, 15, 25)  # numbers of trials whose maps are drawn, as in the paper, and all trials


class Progress(NamedTuple):
    """Optima (unit cube) after the first `counts` trials of everybody: the population's, and each person's."""

    counts: Int[np.ndarray, " p"]
    population: Float[np.ndarray, "p d"]
    individual: Float[np.ndarray, "p M d"]
    ends: Int[np.ndarray, " M"]
    """How many answers each person gave."""
    halves: Float[np.ndarray, "p s"]
    """NRMSE of the optimum of one half of the people to the other half's after all trials, for every split and side."""
    individual_to_half: Float[np.ndarray, "p M"]
    """The same of each person's own optimum, to the half without that person; median over the splits."""
    maps: dict[int, RuleMap]
    """The population's map, with everybody's posteriors in it, after some of `counts`: those that are drawn."""
    levels: tuple[int, ...] = ()
    """As the kernel has them."""

    @property
    def splits(self) -> int:
        """How many optima of halves there are; 0 where people were too few to be split."""
        return self.halves.shape[1]

    @property
    def moments(self) -> list[int]:
        """The numbers of trials after which there is a map."""
        return list(self.maps)

    def at(self, counts: Sequence[int]) -> Int[np.ndarray, " k"]:
        """Rows of these numbers of trials."""
        return np.searchsorted(self.counts, counts)

    def person(self, row: int) -> dict[int, Posterior]:
        """One participant's posterior at each of the moments."""
        return {count: jax.tree.map(lambda leaf: leaf[row], map_.experts) for count, map_ in self.maps.items()}

    def to_end(self) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "p M"]]:
        """NRMSE of the population's and of everybody's running optimum to the final one; a person's is NaN beyond their
        last answer, where it cannot move."""
        population = np.asarray(nrmse(self.population, self.population[-1], self.levels))
        individual = np.asarray(nrmse(self.individual, self.individual[-1], self.levels))
        return population, np.where(self.counts[:, None] <= self.ends[None, :], individual, np.nan)


def follow(study: Study, aggregated: Aggregate, seed: int = 0, counts: Sequence[int] | None = None) -> Progress:
    """The optima of the aggregate's cohort after fewer trials, by the hyperparameters of `study`.

    `counts`: numbers of trials, ascending; by default at most 25 of them up to the longest session. The longest is
    always the last, and is not fitted again.
    """
    cohort = aggregated.cohort
    ends = cohort.counts()
    longest = int(ends.max())
    asked = _counts(ends) if counts is None else np.unique([*counts, longest])
    candidates = search_points(study.space, seed)

    split = _splits(len(cohort.names), seed)
    points = to_device(np.asarray(candidates)[:_POINTS])

    def after(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, RuleMap | None]:
        last = count == longest
        posteriors = aggregated.posteriors if last else fit_cohort(study, cohort.first(count))
        map_ = _map_by_points(study, aggregated.map.share, posteriors)
        population = np.asarray(map_optimum(study, map_, candidates).x)
        optima = aggregated.individuals if last else individual_optima(study, posteriors, candidates)
        halves = np.asarray(points)[_tops(map_, points, split)]
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
    """Who is in the first half, of every split; no split where a half would be one person."""
    if people < _FEWEST:
        return np.zeros((0, people), bool)
    rng = np.random.default_rng(seed)
    order = np.stack([rng.permutation(people) for _ in range(_SPLITS)])
    return order < people // 2


def _tops(map_: RuleMap, points: Float[Array, "m d"], split: Bool[np.ndarray, "s M"]) -> Int[np.ndarray, "s 2"]:
    """Of both halves of every split, the row of the point where the half's map is highest."""
    if not len(split):
        return np.zeros((0, 2), int)
    sides = np.stack([split, ~split], axis=1).reshape(-1, split.shape[1])
    return np.asarray(_highest(map_, points, to_device(sides))).reshape(-1, 2)


@program
def _highest(map_: RuleMap, points: Float[Array, "m d"], sides: Bool[Array, "k M"]) -> Int[Array, " k"]:
    """For each choice of people, the row of the point where their map is highest."""
    means, explained = jax.lax.map(lambda person: person.predict_explained(points), map_.experts)

    share = map_.share if RULES[map_.rule].learns_share else None

    def one(chosen: Bool[Array, " M"]) -> Int[Array, ""]:
        mean, _ = aggregate(map_.rule, means, explained, map_.prior, share=share, mask=chosen)
        return jnp.argmax(mean)

    return jax.lax.map(one, sides)


def _to_other_half(
    levels: tuple[int, ...],
    tops: Float[np.ndarray, "p s 2 d"],
    individual: Float[np.ndarray, "p M d"],
    split: Bool[np.ndarray, "s M"],
) -> tuple[Float[np.ndarray, "p s2"], Float[np.ndarray, "p M"]]:
    """NRMSE to where the other half's optimum is after all trials: of each half's optimum, and of each person's own."""
    if not len(split):
        return np.zeros((len(tops), 0)), np.full(individual.shape[:2], np.nan)
    last = tops[-1, :, ::-1]  # of a half, the other half's
    halves = np.asarray(nrmse(tops, last, levels)).reshape(len(tops), -1)
    others = np.where(split[:, :, None], last[:, :1], last[:, 1:])  # of each person, the half without that person
    person = np.asarray(nrmse(individual[:, None], others, levels))
    return halves, np.median(person, axis=1)


def _map_by_points(study: Study, share: Float[Array, ""], posteriors: Posterior) -> RuleMap:
    """The map of these posteriors by the study's rule, or by bcm where the rule takes all answers at once."""
    rule, rule_share = point_rule(study.rule, share)
    prior = jnp.asarray(study.gp.kernel.variance)
    return RuleMap(
        rule, "by points", posteriors, None, to_device(1.0, prior.dtype) if rule_share is None else rule_share, prior
    )


def _counts(ends: Int[np.ndarray, " M"]) -> Int[np.ndarray, " p"]:
    """Everybody's last trial, the moments, and trials evenly between them."""
    longest = int(ends.max())
    even = np.linspace(1, longest, min(longest, _LONGEST)).round().astype(int)
    return np.unique([*ends[ends > 0], *even, *(n for n in _MOMENTS if n <= longest)])
