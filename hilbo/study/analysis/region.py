"""Where the best rendering lies as far as the answers tell: a region that holds it with 95 %.

Joint draws of the map's shared function say where it is largest; the points that are most often largest, until 95 % of
the draws are among them, are the region. The points are spread evenly over the feasible set, its walls included. Where
hyperparameters are learnt they are drawn too: taken as learnt, they leave the region too small.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from hilbo.kernels import Stationary, embedded
from hilbo.ordinal_gp import Trials
from hilbo.population.learnt.rule import drawn_functions
from hilbo.population.maps import RuleMap
from hilbo.search.box import Parameter
from hilbo.search.rendering import Rendering
from hilbo.study.analysis.hills import Hill, hills_of
from hilbo.study.config import Study
from hilbo.study.estimate.best_places import DRAWS, POINTS, best_places
from hilbo.study.estimate.optimum import predict_map

__all__ = ["Region", "optimum_region", "region_content", "region_sentences"]

PROBABILITY = 0.95
_LOCATED = 0.25  # of the feasible set: a larger region locates nothing
_RIVAL = 0.2  # of the draws on another hill
_HYPERPARAMETERS = 16  # draws of them
_DRAWS = 16 * DRAWS  # fewer scatter over many points, and the region is too small (docs/methods/which_method.md)


class Region(NamedTuple):
    """Points of the unit cube, among even ones, one of which is the best with `PROBABILITY`."""

    points: Float[np.ndarray, "k d"]
    others: Float[np.ndarray, "m d"]
    """The points that are not in it."""
    volume: float
    """Its share of the feasible set."""
    hills: tuple[Hill, ...] = ()
    """By falling probability."""

    @property
    def located(self) -> bool:
        """Whether it is small enough to say where the best rendering is."""
        return self.volume <= _LOCATED

    def holds(self, x: Float[np.ndarray, " d"], kernel: Stationary) -> bool:
        """Whether the nearest of all points, by the kernel's distance, is in the region."""
        places = embedded(kernel, np.concatenate([self.points, self.others, x[None]]))
        away, count = np.sum((places[:-1] - places[-1]) ** 2, axis=1), len(self.points)
        near, far = np.min(away[:count], initial=np.inf), np.min(away[count:], initial=np.inf)
        return bool(near <= far)


def optimum_region(study: Study, map_: RuleMap, trials: Trials, seed: int = 0, count: int = POINTS) -> Region | None:
    """The region, of `count` even points of the feasible set and a quarter as many on its walls; None for maps without
    a joint posterior (those that are aggregated point by point). `trials`: everybody's, stacked, of which the map is.
    """
    if map_.shared is None:
        return None
    functions = [map_.shared]
    if study.learnt is not None:
        functions = drawn_functions(study.learnt, trials, study.stated, seed, _HYPERPARAMETERS) or functions
    places = best_places(study.space, functions, seed, count, _DRAWS)
    first, which = _distinct(np.asarray(places.points))
    points, weight = np.asarray(places.points)[first], np.bincount(which, np.asarray(places.share))
    mean, variance = (np.asarray(each)[first] for each in predict_map(map_, places.points))
    order = np.argsort(-weight, kind="stable")
    held = int(np.searchsorted(np.cumsum(weight[order]), PROBABILITY)) + 1
    inside = np.zeros(len(weight), bool)
    inside[order[:held]] = True
    hills = hills_of(
        np.asarray(study.space.to_box(jnp.asarray(points))), mean, np.sqrt(variance), weight, study.gp.kernel
    )
    return Region(points[inside], points[~inside], float(inside[first < count].mean()), hills)


def _distinct(points: Float[np.ndarray, "m d"]) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " m"]]:
    """Where each of the points is for the first time, and which of these each point is. Levels and whole numbers have
    few renderings, and walls have corners: copies would each be a hill, and share its draws."""
    _, first, which = np.unique(points, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return first[order], rank[which.reshape(-1)]


def region_content(study: Study, region: Region | None) -> dict[str, Any] | None:
    """For result.json, in physical units."""
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
    """Both ends of a parameter's values; of levels all that are among them."""
    if parameter.levels:
        return [parameter.shown(value) for value in np.unique(values).tolist()]
    return [values.min().item(), values.max().item()]


def region_sentences(region: Region | None) -> list[str]:
    """A warning where these answers do not locate the optimum, and one where it may be on another hill."""
    if region is None:
        return []
    sentences = []
    if not region.located:
        sentences.append(
            f"The best rendering is not located: with {PROBABILITY:.0%} it lies in a region that takes up"
            f" {region.volume:.0%} of what may be rendered. More people or trials would narrow it."
        )
    if len(region.hills) > 1 and region.hills[1].probability > _RIVAL:
        first, second = (f"{hill.probability:.0%}" for hill in region.hills[:2])
        sentences.append(
            f"The map has more than one hill: the best rendering is on the likeliest with {first}, on the next with"
            f" {second}. Have people compare their tops before one is used."
        )
    return sentences
