"""The next rendering of an optimisation after some answers, and why it is proposed; nothing is fitted here.

Space-filling points without an answer come first, then the highest acquisition; with a warm start all come from the
map. A rendering in which the device stopped twice is excluded: the candidate farthest from all others replaces it among
the space-filling points, afterwards the highest UCB that keeps a distance of `APART` from it, as choices from a map do.
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
    proposed, which differ where a program confirms what it could present.
    """

    block: int
    points: Points = ()
    categories: tuple[int, ...] = ()
    proposed: Points = ()
    excluded: Points = ()

    @classmethod
    def of(cls, state: LiveSession, block: int) -> "Answers":
        """The answers of a block so far."""
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
        """With each answer that the pending trial may get, in the order of the categories."""
        trial, names = state.pending, state.study.space.names
        assert trial is not None
        now = cls.of(state, trial.block)
        points = now.points + _points(names, [trial.presented["a"]])
        proposed = now.proposed + _points(names, [trial.renderings["a"]])
        each = range(len(state.study.responses))
        return [now._replace(points=points, categories=(*now.categories, c), proposed=proposed) for c in each]


def _points(names: tuple[str, ...], renderings: Iterable[Mapping[str, float]]) -> Points:
    return tuple(tuple(values[name] for name in names) for values in renderings)


def next_point(
    session: Session, warm: WarmStart | None, answers: Answers, fitted: Fitted
) -> tuple[Float[np.ndarray, " d"], str]:
    """The next rendering (d,) in physical units, and what chose it. `session` has study and design, `fitted` the
    posterior of the answers."""
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
    """Points of the initial design without an answer, but for the excluded ones; of levels and whole numbers the design
    may hold one twice."""
    answered, left = Counter(proposed), []
    for point in initial:
        place = tuple(point.tolist())
        if answered[place]:
            answered[place] -= 1
        elif place not in excluded:
            left.append(point)
    return left


def all_excluded(study: Study, excluded: Float[np.ndarray, "k d"]) -> Float[np.ndarray, " d"] | None:
    """Where no rendering is `APART` from all excluded ones, since levels and whole numbers have few: the candidate
    farthest from them; if that is excluded too, the first of them, whose stops are fewest. None elsewhere. Physical
    units."""
    if not len(excluded) or not all(study.space.discrete):
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
    """A space-filling point in place of an excluded one, in physical units: of the candidates that are `APART` from all
    excluded ones the farthest from all points; where all values have been proposed, one of the least often proposed."""
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
    """Between points of the unit cube and renderings in physical units, in the unit cube."""
    away = differences(study.gp.kernel.levels, units[:, None], _to_unit(study, physical)[None])
    return np.linalg.norm(away, axis=2)


def _rows(study: Study, points: Points) -> Float[np.ndarray, "n d"]:
    return np.array(points, float).reshape(-1, study.space.dim)


def _to_unit(study: Study, physical: Float[np.ndarray, "k d"]) -> Float[np.ndarray, "k d"]:
    return np.asarray(study.space.to_unit(physical))


def _padded(study: Study, excluded: Float[np.ndarray, "k d"]) -> Float[Array, "r d"]:
    """Excluded points in the unit cube, behind points far away, so that one more compiles nothing again."""
    rows = np.full((max(_ROOM, len(excluded)), study.space.dim), _FAR)
    if len(excluded):
        rows[-len(excluded) :] = _to_unit(study, excluded)
    return jnp.asarray(rows)


@program
def _highest_apart(study, plan, posterior, excluded):
    return study.space.to_physical(point_away_from(study, plan, posterior, excluded, APART))


@program
def _highest_of_map(study, warm, posterior, excluded):
    return study.space.to_physical(warm_point(study, warm, posterior, excluded, APART))


class _Prediction(NamedTuple):
    """The latent score at a rendering, and the certificate of the fit that predicts it."""

    unit: Float[Array, " d"]
    mean: Float[Array, ""]
    variance: Float[Array, ""]
    probabilities: Float[Array, " c"]
    certificate: Any


@program
def _prediction(study: Study, posterior: Posterior, point: Float[Array | np.ndarray, " d"]) -> _Prediction:
    unit = study.space.to_unit(point)
    mean, variance = (moment[0] for moment in posterior.predict(unit[None, :]))
    probabilities = study.gp.likelihood.class_probabilities(mean, variance)
    return _Prediction(unit, mean, variance, probabilities, posterior.certificate)


def explained(study: Study, posterior: Posterior, point: Float[np.ndarray, " d"], by: str) -> dict[str, Any]:
    """The data of a proposal of a rendering (d,) in physical units: `renderings`, and `choice`, which has what chose
    it, mean and sd of the latent score, the acquisition's value, the probabilities of the answers, the passivity margin
    (N·s/m) and the certificate of the fit. Numbers that are not finite, as those of a failed fit, are left out: JSON
    has none."""
    rendering = Rendering.of(study.space, point)
    predicted: _Prediction = jax.device_get(_prediction(study, posterior, np.asarray(point)))
    mean, sd = float(predicted.mean), math.sqrt(predicted.variance) if predicted.variance >= 0 else math.nan
    certificate = predicted.certificate
    choice = {
        "by": by,
        "unit": predicted.unit.tolist(),
        "mean": mean,
        "sd": sd,
        "score": mean + study.file.selection.weight * sd if by.startswith("ucb") else None,
        "probabilities": dict(zip(study.responses, predicted.probabilities.tolist(), strict=True)),
        "margin": rendering.margin,
        "certificate": {f.name: getattr(certificate, f.name).item() for f in dataclasses.fields(certificate)},
    }
    return {"renderings": {"a": rendering.parameters}, "choice": _finite(choice)}


def _finite(values: dict[str, Any]) -> dict[str, Any]:
    """Without the numbers that are not finite."""
    kept = {key: _finite(value) if isinstance(value, dict) else value for key, value in values.items()}
    return {key: value for key, value in kept.items() if not isinstance(value, float) or math.isfinite(value)}
