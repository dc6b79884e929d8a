"""Credible region of the optimum: the set of points that contains the best stimulus with a probability of 95 %.

Joint draws of the map's shared function are maximised; points are added to the region in the order of how often they
were the maximum, until it contains 95 % of the draws. The points are spread evenly over the feasible set, its walls
included. Learnt hyperparameters are drawn too: fixed at their estimates, they would make the region too small.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from hilbo.kernels import Stationary, embedded
from hilbo.ordinal_gp import Trials
from hilbo.population.learnt.rule import DrawnMap, drawn_maps
from hilbo.population.maps import RuleMap
from hilbo.search.box import Parameter
from hilbo.search.rendering import Rendering
from hilbo.study.analysis.hills import Hill, hills_of
from hilbo.study.config import Study
from hilbo.study.estimate.aggregate import SayCount, silent
from hilbo.study.estimate.best_places import DRAWS, POINTS, best_places
from hilbo.study.estimate.optimum import predict_map

__all__ = ["Region", "hyperparameter_draws", "optimum_region", "region_content", "region_sentences"]

PROBABILITY = 0.95
_LOCATED = 0.25  # of the feasible set: a larger region locates nothing
_RIVAL = 0.2  # of the draws on another hill
_HYPERPARAMETERS = 16  # draws of them
_DRAWS = 16 * DRAWS  # fewer scatter over many points, and the region is too small (docs/methods/which_method_tables.md)


class Region(NamedTuple):
    """The points of the unit cube, of a finite even set, that form the 95 % credible region of the optimum."""

    points: Float[np.ndarray, "k d"]
    others: Float[np.ndarray, "m d"]
    """The points outside the region."""
    volume: float
    """Fraction of the feasible set that the region takes up."""
    hills: tuple[Hill, ...] = ()
    """Modes of the map, in the order of falling probability."""

    @property
    def located(self) -> bool:
        """Whether the region is at most a quarter of the feasible set."""
        return self.volume <= _LOCATED

    def holds(self, x: Float[np.ndarray, " d"], kernel: Stationary) -> bool:
        """Whether the point nearest to `x` (d,), by the kernel's distance, is in the region."""
        places = embedded(kernel, np.concatenate([self.points, self.others, x[None]]))
        away, count = np.sum((places[:-1] - places[-1]) ** 2, axis=1), len(self.points)
        near, far = np.min(away[:count], initial=np.inf), np.min(away[count:], initial=np.inf)
        return bool(near <= far)


def hyperparameter_draws(study: Study, trials: Trials, seed: int = 0, say: SayCount = silent) -> list[DrawnMap]:
    """Maps by drawn hyperparameters, of a study that has learnt them from stacked `trials`; otherwise none. `say`:
    progress."""
    if study.learnt is None:
        return []
    report = partial(say, "maps with drawn hyperparameters")
    return drawn_maps(study.learnt, trials, study.stated, seed, _HYPERPARAMETERS, report)


def optimum_region(
    study: Study,
    map_: RuleMap,
    drawn: Sequence[DrawnMap] = (),
    seed: int = 0,
    count: int = POINTS,
    say: SayCount = silent,
) -> Region | None:
    """Credible region of the map's optimum; None for maps without a joint posterior (those aggregated point by point).

    `drawn`: of `hyperparameter_draws`. `count`: number of even points of the feasible set; a quarter as many are added
    on its walls. `say`: progress.
    """
    if map_.shared is None:
        return None
    functions = [each.function for each in drawn] or [map_.shared]
    report = partial(say, "parts of the region of the optimum")
    places = best_places(study.space, study.goal, functions, seed, count, _DRAWS, report, quick=True)
    first, which = _distinct(np.asarray(places.points))
    points, weight = np.asarray(places.points)[first], np.bincount(which, np.asarray(places.share))
    mean, variance = (np.asarray(each)[first] for each in predict_map(map_, places.points))
    order = np.argsort(-weight, kind="stable")
    held = int(np.searchsorted(np.cumsum(weight[order]), PROBABILITY)) + 1
    inside = np.zeros(len(weight), bool)
    inside[order[:held]] = True
    hills = (
        ()
        if not study.one_optimum
        else hills_of(
            np.asarray(study.space.to_box(jnp.asarray(points))),
            np.asarray(study.goal.closeness(study.gp.likelihood, jnp.asarray(mean))),
            np.sqrt(variance),
            weight,
            study.gp.kernel,
        )
    )
    return Region(points[inside], points[~inside], float(inside[first < count].mean()), hills)


def _distinct(points: Float[np.ndarray, "m d"]) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " m"]]:
    """Index of the first copy of each distinct point (k,), and for each point which of these it equals (m,). Without
    this, copies (of levels, whole numbers and corners) would divide the draws of one point among several modes."""
    _, first, which = np.unique(points, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return first[order], rank[which.reshape(-1)]


def region_content(study: Study, region: Region | None) -> dict[str, Any] | None:
    """The region as a dict for result.json, in physical units; None for no region."""
    if region is None:
        return None
    physical = np.asarray(study.space.to_physical(jnp.asarray(region.points)))

    def of_box(x: Float[np.ndarray, " d"]) -> dict[str, Any]:
        return Rendering.at(study.space, study.space.from_box(jnp.asarray(x))).shown

    return {
        "probability": PROBABILITY,
        "volume": region.volume,
        "located": region.located,
        "parameters": {
            p.name: _extent(p, column) for p, column in zip(study.space.parameters, physical.T, strict=True)
        },
        "hills": [
            {"probability": hill.probability, "top": of_box(hill.top), "centre": of_box(hill.centre)}
            for hill in region.hills
        ],
    }


def _extent(parameter: Parameter, values: Float[np.ndarray, " k"]) -> list[float | str]:
    """Smallest and largest of a parameter's values; of levels the names of all that occur."""
    if parameter.levels:
        return [parameter.shown(value) for value in np.unique(values).tolist()]
    return [values.min().item(), values.max().item()]


def region_sentences(region: Region | None, one_optimum: bool = True) -> list[str]:
    """Warnings: the optimum is not located (region above a quarter of the space), and it may be at another mode
    (probability above 0.2). Empty for no region. Without `one_optimum` (of the study) one sentence on the region's size
    instead."""
    if region is None:
        return []
    sentences = []
    if not one_optimum:
        return [
            "The goal is between other responses, so that many stimuli are equally good: their"
            f" {PROBABILITY:.0%} credible region covers {region.volume:.0%} of the feasible region."
        ]
    if not region.located:
        sentences.append(
            f"Inconclusive: the {PROBABILITY:.0%} credible region of the optimum covers {region.volume:.0%} of the"
            " feasible region. Collect more participants or trials."
        )
    if len(region.hills) > 1 and region.hills[1].probability > _RIVAL:
        first, second = (f"{hill.probability:.0%}" for hill in region.hills[:2])
        sentences.append(
            f"The map has more than one mode: the optimum is on the most probable with {first}, on the next with"
            f" {second}. Compare their maxima in a validation before one is used."
        )
    return sentences
