"""Choices that keep away from renderings in which the device stopped twice; nothing is fitted here.

At the end of the space-filling trials the candidate farthest from all others takes the place of such a rendering;
afterwards the highest UCB that keeps a distance of `APART` from it in the unit cube; so do choices from a map.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import Posterior
from hilbo.search.apart import differences
from hilbo.session.choose.selection import Design, point_apart
from hilbo.session.choose.warm_start import WarmStart, warm_point
from hilbo.study.config import Study

__all__ = ["APART", "is_near", "point_from_map", "point_kept_apart", "spread_point", "when_nothing_is_apart"]

APART = 0.05
"""Least distance in the unit cube from a rendering in which the device stopped twice."""
_ROOM, _FAR = 8, 9.0  # so many excluded points at least, those that are none far from the unit cube
_SPREAD = 256  # candidates
_SAME = 1e-9  # in the unit cube: one rendering


def is_near(study: Study, point: Float[np.ndarray, " d"], excluded: Float[np.ndarray, "k d"]) -> bool:
    """Whether a point is nearer than `APART` to an excluded one; all in physical units."""
    if not len(excluded):
        return False
    unit = _to_unit(study, np.concatenate([excluded, np.asarray(point)[None]]))
    return bool(np.min(np.linalg.norm(differences(study.gp.kernel.levels, unit[:-1], unit[-1]), axis=1)) < APART)


def when_nothing_is_apart(study: Study, excluded: Float[np.ndarray, "k d"]) -> Float[np.ndarray, " d"] | None:
    """What comes where nothing is `APART` from all excluded renderings, since of whole numbers and levels there are
    few: the candidate farthest from them; where they are all that there is, the first of them, whose stops are fewest.
    None where something is apart. Physical units."""
    if not len(excluded) or not all(study.space.discrete):
        return None
    candidates = np.asarray(study.space.candidates(_SPREAD, 0))
    away = differences(study.gp.kernel.levels, candidates[:, None], _to_unit(study, excluded)[None])
    nearest = np.min(np.linalg.norm(away, axis=2), axis=1)
    farthest = int(np.argmax(nearest))
    if nearest[farthest] >= APART:
        return None
    return np.asarray(study.space.to_physical(candidates[farthest])) if nearest[farthest] > _SAME else excluded[0]


def spread_point(
    study: Study, excluded: Float[np.ndarray, "k d"], others: Float[np.ndarray, "m d"], seed: int
) -> Float[np.ndarray, " d"]:
    """A space-filling point in place of an excluded one, in physical units: of the candidates that are `APART` from all
    excluded ones the farthest from all points; where every value has been asked, one that was asked least often."""
    candidates, levels = np.asarray(study.space.candidates(_SPREAD, seed)), study.gp.kernel.levels

    def distances(points: Float[np.ndarray, "k d"]) -> Float[np.ndarray, "c k"]:
        return np.linalg.norm(differences(levels, candidates[:, None], _to_unit(study, points)[None]), axis=2)

    allowed = np.all(distances(excluded) >= APART, axis=1)
    if allowed.any():
        candidates = candidates[allowed]
    away = distances(np.concatenate([others, excluded]))
    asked = np.sum(away < _SAME, axis=1)
    farthest = np.lexsort((asked, -away.min(axis=1)))[0]
    return np.asarray(study.space.to_physical(candidates[int(farthest)]))


def point_kept_apart(
    study: Study, plan: Design, posterior: Posterior, excluded: Float[np.ndarray, "k d"]
) -> Float[np.ndarray, " d"]:
    """The highest UCB at least `APART` from the excluded points, in physical units."""
    return np.asarray(_kept_apart(study, plan, posterior, _padded(study, excluded)))


def point_from_map(
    study: Study, warm: WarmStart, posterior: Posterior, excluded: Float[np.ndarray, "k d"]
) -> Float[np.ndarray, " d"]:
    """The warm start's choice at least `APART` from the excluded points, in physical units."""
    return np.asarray(_from_map(study, warm, posterior, _padded(study, excluded)))


def _padded(study: Study, excluded: Float[np.ndarray, "k d"]) -> Float[Array, "r d"]:
    """Excluded points in the unit cube, behind places far away, so that one more compiles nothing again."""
    rows = np.full((max(_ROOM, len(excluded)), study.space.dim), _FAR)
    if len(excluded):
        rows[-len(excluded) :] = _to_unit(study, excluded)
    return jnp.asarray(rows)


def _to_unit(study: Study, physical: Float[np.ndarray, "k d"]) -> Float[np.ndarray, "k d"]:
    return np.asarray(study.space.to_unit(physical))


@program
def _kept_apart(study, plan, posterior, excluded):
    return study.space.to_physical(point_apart(study, plan, posterior, excluded, APART))


@program
def _from_map(study, warm, posterior, excluded):
    return study.space.to_physical(warm_point(study, warm, posterior, excluded, APART))
