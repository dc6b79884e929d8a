"""How optima come about: the population's and everybody's own after everybody's first 1, 2, ... trials.

A prefix of the trials is fitted like any cohort and searched from the same candidates; the last point is the aggregate
itself, which is fitted already. Maps of prefixes are merged point by point: by the study's rule, or by bcm where the
rule takes all answers at once.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from hilbo.ordinal_gp import Posterior
from hilbo.population.maps import RuleMap, point_rule
from hilbo.search.candidates import search_points
from hilbo.study.aggregate import Aggregate, fit_cohort, individual_optima, map_optimum
from hilbo.study.config import Study

__all__ = ["Progress", "follow", "settled"]

_SETTLED = 0.05  # NRMSE: an optimum that stays this near to its last place has settled
_LONGEST = 25  # points of a progress curve
_AT_A_TIME = 2  # of which so many are computed: each search keeps a core busy, and no more
_MOMENTS = (5, 15, 25)  # numbers of trials whose maps are drawn, as in the paper, and all trials


class Progress(NamedTuple):
    """Optima (unit cube) after the first `counts` trials of everybody: the population's, and each person's."""

    counts: Int[np.ndarray, " p"]
    population: Float[np.ndarray, "p d"]
    own: Float[np.ndarray, "p M d"]
    ends: Int[np.ndarray, " M"]
    """How many answers each person gave."""
    maps: dict[int, RuleMap]
    """The population's map, with everybody's posteriors in it, after some of `counts`: those that are drawn."""

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
        population = np.sqrt(np.mean((self.population - self.population[-1]) ** 2, axis=1))
        individual = np.sqrt(np.mean((self.own - self.own[-1]) ** 2, axis=2))
        return population, np.where(self.counts[:, None] <= self.ends[None, :], individual, np.nan)

    def settled(self, within: float) -> list[int | None]:
        """Of everybody the trial from which their own optimum stayed within this NRMSE of its final place; None where
        that cannot be said."""
        _, individual = self.to_end()
        lasts = np.searchsorted(self.counts, self.ends, side="right")
        return [settled(self.counts[:k], individual[:k, j], within) for j, k in enumerate(lasts)]


def follow(study: Study, aggregate: Aggregate, seed: int = 0, counts: Sequence[int] | None = None) -> Progress:
    """The optima of the aggregate's cohort after fewer trials, by the hyperparameters of `study`.

    `counts`: numbers of trials, ascending; by default at most 25 of them up to the longest session. The longest is
    always the last, and is not fitted again.
    """
    cohort = aggregate.cohort
    ends = cohort.counts()
    longest = int(ends.max())
    asked = _counts(ends) if counts is None else np.unique([*counts, longest])
    candidates = search_points(study.space, seed)

    def after(count: int) -> tuple[np.ndarray, np.ndarray, RuleMap | None]:
        last = count == longest
        posteriors = aggregate.posteriors if last else fit_cohort(study, cohort.first(count))
        map_ = _map_by_points(study, aggregate.map.share, posteriors)
        population = np.asarray(map_optimum(study, map_, candidates).x)
        optima = aggregate.individuals if last else individual_optima(study, posteriors, candidates)
        return population, np.asarray(optima.x), map_ if last or count in _MOMENTS else None

    found = [after(count) for count in asked[:1].tolist()]  # whose programs serve the others
    with ThreadPoolExecutor(_AT_A_TIME) as pool:
        found += pool.map(after, asked[1:].tolist())
    population, individual, maps = zip(*found, strict=True)
    kept = {count: map_ for count, map_ in zip(asked.tolist(), maps, strict=True) if map_ is not None}
    return Progress(asked, np.stack(population), np.stack(individual), ends, kept)


def settled(counts: Int[np.ndarray, " p"], errors: Float[np.ndarray, " p"], within: float = _SETTLED) -> int | None:
    """The first of `counts` from which all errors are `within`; None if only the last one is, which says nothing."""
    beyond = np.flatnonzero(errors > within)
    first = 0 if not len(beyond) else int(beyond[-1]) + 1
    return int(counts[first]) if first < len(counts) - 1 else None


def _map_by_points(study: Study, share: Float[Array, ""], posteriors: Posterior) -> RuleMap:
    """The map of these posteriors by the study's rule, or by bcm where the rule takes all answers at once."""
    rule, rule_share = point_rule(study.rule, share)
    prior = jnp.asarray(study.gp.kernel.variance)
    return RuleMap(
        rule, "by points", posteriors, None, jnp.ones_like(prior) if rule_share is None else rule_share, prior
    )


def _counts(ends: Int[np.ndarray, " M"]) -> Int[np.ndarray, " p"]:
    """Everybody's last trial, the moments, and trials evenly between them."""
    longest = int(ends.max())
    even = np.linspace(1, longest, min(longest, _LONGEST)).round().astype(int)
    return np.unique([*ends[ends > 0], *even, *(n for n in _MOMENTS if n <= longest)])
