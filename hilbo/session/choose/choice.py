"""The next rendering of an optimisation after some answers, and its explanation; nothing is fitted here.

Space-filling points without an answer come first, then the maximum of the acquisition function; with a warm start all
points come from the map. A rendering in which the device stopped twice is excluded: among the space-filling points, the
candidate farthest from all others replaces it; afterwards, the highest UCB at least `APART` from it, also with a map.
"""

import dataclasses
import math
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import Posterior
from hilbo.search.apart import differences
from hilbo.search.rendering import Rendering
from hilbo.session.choose.ask_tell import Session
from hilbo.session.choose.selection import point_away_from
from hilbo.session.choose.step import Fitted
from hilbo.session.choose.warm_start import WarmStart, warm_point
from hilbo.session.log.state import LiveSession
from hilbo.study.config import Study

__all__ = ["APART", "Answers", "all_excluded", "explained", "next_point", "spread_point", "unanswered"]

APART = 0.05
"""Least distance in the unit cube from an excluded rendering."""
_ROOM, _FAR = 8, 9.0  # excluded points are padded to at least so many rows, with points far from the unit cube
_SPREAD = 256  # candidates for a space-filling point
_SAME = 1e-9  # in the unit cube: one rendering

Points = tuple[tuple[float, ...], ...]
"""Renderings (n, d) in physical units, in the order of the space."""


class Answers(NamedTuple):
    """What the next rendering of a block depends on, besides study and seed: the answers that count, and the excluded
    renderings.

    `points`: the renderings as presented, of which the answers have the `categories` (from 0); `proposed`: the same as
    proposed, which differ where a stimulus program confirms what it could present.
    """

    block: int
    points: Points = ()
    categories: tuple[int, ...] = ()
    proposed: Points = ()
    excluded: Points = ()

    @classmethod
    def of(cls, state: LiveSession, block: int) -> "Answers":
        """The answers of a block so far, and its excluded renderings."""
        names, answered = state.study.space.names, state.answers(block)
        categories = [state.study.responses.index(t.values["class_a"]) for t in answered if t.values is not None]
        return cls(
            block,
            _points(names, (trial.presented["a"] for trial in answered)),
            tuple(categories),
            _points(names, (trial.renderings["a"] for trial in answered)),
            _points(names, state.excluded(block)),
        )

    @classmethod
    def after_pending(cls, state: LiveSession) -> list["Answers"]:
        """For each possible response to the pending trial, lowest first, the answers including it."""
        trial, names = state.pending, state.study.space.names
        assert trial is not None
        now = cls.of(state, trial.block)
        points = now.points + _points(names, [trial.presented["a"]])
        proposed = now.proposed + _points(names, [trial.renderings["a"]])
        each = range(len(state.study.responses))
        return [now._replace(points=points, categories=(*now.categories, c), proposed=proposed) for c in each]


def _points(names: tuple[str, ...], renderings: Iterable[Mapping[str, float]]) -> Points:
    """Renderings (name -> value) as tuples of numbers in the order of `names`."""
    return tuple(tuple(values[name] for name in names) for values in renderings)


def next_point(
    session: Session, warm: WarmStart | None, answers: Answers, fitted: Fitted
) -> tuple[Float[np.ndarray, " d"], str]:
    """The next rendering (d,) in physical units, and what chose it, such as "latin hypercube", "map" or the
    acquisition.

    `session` has study and design; `warm`: a warm start or None; `fitted`: posterior after `answers`, and its point.
    """
    study, initial = session.study, session.step.initial
    excluded = _rows(study, answers.excluded)
    exhausted = all_excluded(study, excluded)
    if exhausted is not None:
        return exhausted, "stopped least often"
    if warm is not None:
        return np.asarray(_highest_of_map(study, warm, fitted.posterior, _padded(study, excluded))), "map"
    left = unanswered(initial, answers.proposed, answers.excluded)
    if left:  # in their order; one whose answer was voided comes again
        return left[0], "latin hypercube"
    if len(answers.points) < len(initial):
        others = np.concatenate([initial, _rows(study, answers.points)])
        return spread_point(study, excluded, others, session.seed), "latin hypercube"
    if len(excluded) and _distances(study, _to_unit(study, fitted.point[None]), excluded).min() < APART:
        point = _highest_apart(study, session.plan, fitted.posterior, _padded(study, excluded))
        return np.asarray(point), "ucb, apart"
    return fitted.point, study.file.selection.acquisition


def unanswered(initial: Float[np.ndarray, "k d"], proposed: Points, excluded: Points) -> list[Float[np.ndarray, " d"]]:
    """Points of the initial design without an answer that are not excluded, in their order; a point that is in the
    design twice (levels, whole numbers) needs two answers. Physical units."""
    answered, left = Counter(proposed), []
    for point in initial:
        place = tuple(point.tolist())
        if answered[place]:
            answered[place] -= 1
        elif place not in excluded:
            left.append(point)
    return left


def all_excluded(study: Study, excluded: Float[np.ndarray, "k d"]) -> Float[np.ndarray, " d"] | None:
    """For discrete spaces in which no rendering is at least `APART` from all `excluded` ones: the candidate farthest
    from them, or the first excluded one, with the fewest stops, if all are excluded. None otherwise. Physical units."""
    if not len(excluded) or not all(study.space.discrete[i] for i in study.space.free):
        return None
    candidates = study.space.candidates(_SPREAD, 0)
    nearest = _distances(study, candidates, excluded).min(axis=1)
    farthest = int(np.argmax(nearest))
    if nearest[farthest] >= APART:
        return None
    return np.asarray(study.space.to_physical(candidates[farthest])) if nearest[farthest] > _SAME else excluded[0]


def spread_point(
    study: Study, excluded: Float[np.ndarray, "k d"], others: Float[np.ndarray, "m d"], seed: int
) -> Float[np.ndarray, " d"]:
    """A space-filling point (d,) in place of an excluded one: among candidates at least `APART` from all `excluded` (if
    there are any) the farthest from these and the `others`; if all candidates have been proposed, one of the least
    often proposed. Points in physical units."""
    candidates = study.space.candidates(_SPREAD, seed)
    allowed = np.all(_distances(study, candidates, excluded) >= APART, axis=1)
    if allowed.any():
        candidates = candidates[allowed]
    away = _distances(study, candidates, np.concatenate([others, excluded]))
    farthest = np.lexsort((np.sum(away < _SAME, axis=1), -away.min(axis=1)))[0]
    return np.asarray(study.space.to_physical(candidates[int(farthest)]))


def _distances(
    study: Study, units: Float[np.ndarray, "c d"], physical: Float[np.ndarray, "k d"]
) -> Float[np.ndarray, "c k"]:
    """Distances in the unit cube between points `units` of the unit cube and points `physical` in physical units."""
    away = differences(study.gp.kernel.levels, units[:, None], _to_unit(study, physical)[None])
    return np.linalg.norm(away, axis=2)


def _rows(study: Study, points: Points) -> Float[np.ndarray, "n d"]:
    """Points in physical units as an array, which has d columns even if there are no points."""
    return np.array(points, float).reshape(-1, study.space.dim)


def _to_unit(study: Study, physical: Float[np.ndarray, "k d"]) -> Float[np.ndarray, "k d"]:
    """Points from physical units to the unit cube, as a NumPy array."""
    return np.asarray(study.space.to_unit(physical))


def _padded(study: Study, excluded: Float[np.ndarray, "k d"]) -> Float[Array, "r d"]:
    """The points `excluded` (k, d), in physical units, as the last rows of an array (r, d) in the unit cube. Rows far
    outside the cube fill it up to `_ROOM` rows, so that one more point needs no compilation; more points are not filled
    up."""
    rows = np.full((max(_ROOM, len(excluded)), study.space.dim), _FAR)
    if len(excluded):
        rows[-len(excluded) :] = _to_unit(study, excluded)
    return jnp.asarray(rows)


@program
def _highest_apart(study, plan, posterior, excluded):
    """Point (d,) of the highest UCB at least `APART` from the excluded points (r, d), which are in the unit cube; the
    result is in physical units."""
    return study.space.to_physical(point_away_from(study, plan, posterior, excluded, APART))


@program
def _highest_of_map(study, warm, posterior, excluded):
    """Candidate (d,) of the warm start with the highest UCB at least `APART` from the excluded points (r, d), which are
    in the unit cube; the result is in physical units."""
    return study.space.to_physical(warm_point(study, warm, posterior, excluded, APART))


class _Prediction(NamedTuple):
    """Prediction of the latent score at a rendering, and the certificate (convergence diagnostics) of the fit behind
    it."""

    unit: Float[Array, " d"]
    mean: Float[Array, ""]
    variance: Float[Array, ""]
    closeness: Float[Array, ""]
    """Of the mean to the goal."""
    probabilities: Float[Array, " c"]
    certificate: Any


@program
def _prediction(study: Study, posterior: Posterior, point: Float[Array | np.ndarray, " d"]) -> _Prediction:
    """Predict the latent score and the category probabilities at a point (d,) in physical units."""
    unit = study.space.to_unit(point)
    mean, variance = (moment[0] for moment in posterior.predict(unit[None, :]))
    probabilities = study.gp.likelihood.class_probabilities(mean, variance)
    closeness = study.goal.closeness(study.gp.likelihood, mean)
    return _Prediction(unit, mean, variance, closeness, probabilities, posterior.certificate)


def explained(study: Study, posterior: Posterior, point: Float[np.ndarray, " d"], by: str) -> dict[str, Any]:
    """Data of a proposal of the rendering `point` (d,) in physical units, chosen by `by`: `renderings` and `choice`.

    `choice` explains it: `by`, the point in the unit cube, mean and sd of the latent score, the value of the
    acquisition (UCB only), category probabilities, passivity margin (N·s/m), and the fit's convergence diagnostics.
    Numbers that are not finite are left out, since JSON has none.
    """
    rendering = Rendering.of(study.space, point)
    predicted: _Prediction = jax.device_get(_prediction(study, posterior, np.asarray(point)))
    mean, sd = float(predicted.mean), math.sqrt(predicted.variance) if predicted.variance >= 0 else math.nan
    certificate = predicted.certificate
    choice = {
        "by": by,
        "unit": predicted.unit.tolist(),
        "mean": mean,
        "sd": sd,
        "score": float(predicted.closeness) + study.file.selection.weight * sd if by.startswith("ucb") else None,
        "probabilities": dict(zip(study.responses, predicted.probabilities.tolist(), strict=True)),
        "margin": rendering.margin,
        "certificate": {f.name: getattr(certificate, f.name).item() for f in dataclasses.fields(certificate)},
    }
    return {"renderings": {"a": rendering.parameters}, "choice": _finite(choice)}


def _finite(values: dict[str, Any]) -> dict[str, Any]:
    """Copy without NaN and infinite floats, also in nested dicts; all other values are kept."""
    kept = {key: _finite(value) if isinstance(value, dict) else value for key, value in values.items()}
    return {key: value for key, value in kept.items() if not isinstance(value, float) or math.isfinite(value)}
