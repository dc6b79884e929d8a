"""Why a rendering is proposed: what its posterior and its space say of it, as the data of a proposal.

`choice` has what chose the rendering, mean and sd of the latent score, the acquisition's value, the probabilities of
the answers, the passivity margin (N.s/m) and the certificate of the fit. Nothing is fitted here. What is no finite
number (of a fit that failed, say) is left out: JSON has no word for it.
"""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import Posterior
from hilbo.search.set_facts import facts
from hilbo.study.config import Study

__all__ = ["Choice", "explained"]


class Choice(NamedTuple):
    """A rendering (d,) in physical units, and what chose it."""

    point: Float[np.ndarray, " d"]
    by: str


class _Explanation(NamedTuple):
    """What is computed at a rendering: its place in the unit cube, the latent score there, the space's facts."""

    unit: Float[Array, " d"]
    mean: Float[Array, ""]
    variance: Float[Array, ""]
    probabilities: Float[Array, " c"]
    certificate: Any
    derived: dict[str, Float[Array, ""]]
    margin: Float[Array, ""] | None


def explained(study: Study, posterior: Posterior, choice: Choice) -> dict[str, Any]:
    """`renderings` and `choice` of a proposal's data."""
    predicted: _Explanation = jax.device_get(_explanation(study, posterior, np.asarray(choice.point)))
    parameters = dict(zip(study.space.names, np.asarray(choice.point).tolist(), strict=True))
    mean, sd = float(predicted.mean), math.sqrt(predicted.variance) if predicted.variance >= 0 else math.nan
    figures = {f.name: getattr(predicted.certificate, f.name).item() for f in dataclasses.fields(predicted.certificate)}
    words = {
        "by": choice.by,
        "unit": predicted.unit.tolist(),
        "mean": mean,
        "sd": sd,
        "score": mean + study.selection.weight * sd if choice.by.startswith("ucb") else None,
        "probabilities": dict(zip(study.responses, predicted.probabilities.tolist(), strict=True)),
        "margin": None if predicted.margin is None else float(predicted.margin),
        "certificate": figures,
    }
    derived = {name: float(value) for name, value in predicted.derived.items()}
    return {"renderings": {"a": parameters | derived}, "choice": _numbers(words)}


def _numbers(words: dict[str, Any]) -> dict[str, Any]:
    """What is said, without what is no finite number."""
    kept = {key: _numbers(value) if isinstance(value, dict) else value for key, value in words.items()}
    return {key: value for key, value in kept.items() if not isinstance(value, float) or math.isfinite(value)}


@program
def _explanation(study: Study, posterior: Posterior, point: Float[Array | np.ndarray, " d"]) -> _Explanation:
    unit = study.space.to_unit(point)
    mean, variance = (moment[0] for moment in posterior.predict(unit[None, :]))
    derived, margin = facts(study.space, dict(zip(study.space.names, point, strict=True)))
    probabilities = study.gp.likelihood.class_probabilities(mean, variance)
    return _Explanation(unit, mean, variance, probabilities, posterior.certificate, derived, margin)
