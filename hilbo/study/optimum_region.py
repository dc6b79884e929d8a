"""Where the best rendering lies as far as the answers tell: a region that holds it with 95 %.

Joint draws of the map's shared function say where it is largest; the points that are most often largest, until 95 % of
the draws are among them, are the region. The points are spread evenly over the feasible set, its walls included.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hilbo.population.joint import posterior_map
from hilbo.population.maps import RuleMap
from hilbo.search.candidates import search_points
from hilbo.study.config import Study

__all__ = ["Region", "optimum_region", "region_content", "region_sentences"]

PROBABILITY = 0.95
_POINTS, _DRAWS = 800, 4000
_LOCATED = 0.25  # of the feasible set: a larger region locates nothing


class Region(NamedTuple):
    """Points of the unit cube, among even ones, one of which is the best with `PROBABILITY`."""

    points: Float[np.ndarray, "k d"]
    others: Float[np.ndarray, "m d"]
    """The points that are not in it."""
    volume: float
    """Its share of the feasible set."""

    @property
    def located(self) -> bool:
        """Whether it is small enough to say where the best rendering is."""
        return self.volume <= _LOCATED

    def holds(self, x: Float[np.ndarray, " d"], theta: Float[np.ndarray, " d"]) -> bool:
        """Whether the nearest of all points, in units of the lengths, is in the region."""
        near, far = (np.min(((p - x) ** 2) @ theta) if len(p) else np.inf for p in (self.points, self.others))
        return bool(near <= far)


def optimum_region(study: Study, map_: RuleMap, seed: int = 0) -> Region | None:
    """The region; None for maps without a joint posterior (those that are merged point by point)."""
    if map_.shared is None:
        return None
    x = search_points(study.space, seed, _POINTS)
    joint = posterior_map(map_.shared, x)
    weight = np.asarray(joint.optima(jax.random.key(seed), _DRAWS))
    order = np.argsort(-weight, kind="stable")
    count = int(np.searchsorted(np.cumsum(weight[order]), PROBABILITY)) + 1
    inside = np.zeros(len(weight), bool)
    inside[order[:count]] = True
    points = np.asarray(x)
    return Region(points[inside], points[~inside], float(inside[:_POINTS].mean()))


def region_content(study: Study, region: Region | None) -> dict[str, Any] | None:
    """For result.json, in physical units."""
    if region is None:
        return None
    physical = np.asarray(study.space.to_physical(jnp.asarray(region.points)))
    ends = zip(study.space.names, physical.min(axis=0).tolist(), physical.max(axis=0).tolist(), strict=True)
    return {
        "probability": PROBABILITY,
        "volume": region.volume,
        "located": region.located,
        "parameters": {name: [low, high] for name, low, high in ends},
    }


def region_sentences(region: Region | None) -> list[str]:
    """A warning where these answers do not locate the optimum."""
    if region is None or region.located:
        return []
    return [
        f"The best rendering is not located: with {PROBABILITY:.0%} it lies in a region that takes up"
        f" {region.volume:.0%} of what may be rendered. More people or trials would narrow it."
    ]
