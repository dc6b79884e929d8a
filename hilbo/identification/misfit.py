"""Signs of the instrument in the residuals of a fit: a filter in the force channel, an input between the rows.

Each question is one direction v in which the residuals r would change if the answer were yes. Less what the free
coordinates can make of it, v' = v - J A⁻¹ Jᵀ v, the score v'ᵀr has the variance v'ᵀ Γ v' under the noise of the fit,
and J A⁻¹ Jᵀ v moves the coordinates by A⁻¹ Jᵀ v. No further fit is needed (Rao 1948).
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hilbo.identification.fitting import Curve, Fit, Test, curve_residuals
from hilbo.identification.intervals import inverse_of_free
from hilbo.identification.residual_noise import filtered, fitted_residuals, noises
from hilbo.identification.sampled import Sampled
from hilbo.numerics.tracing import program

__all__ = ["filter_score", "is_coarse", "moved_between_rows"]

_TIMES = (0.3, 0.8, 2.0)  # time constants that are tried, samples


def filter_score(fitted: Fit) -> float:
    """How many standard deviations the residuals speak for a filter of the force; the largest of three filters."""
    model = fitted.model
    corners = jnp.asarray([1 / (2 * np.pi * tau * model.T) for tau in _TIMES])
    return float(jnp.max(_filter_scores(fitted, corners)))


@program
def _filter_scores(fit: Fit, corners: Float[Array, " f"]) -> Float[Array, " f"]:
    """The score of each corner (Hz), positive where the filter lowers the cost."""
    before = fitted_residuals(fit, fit.q)
    slopes = jax.jacfwd(lambda x: fitted_residuals(fit, x))(fit.q)
    models = noises(fit)
    inverse = inverse_of_free(fit)

    def score(corner):
        filtering = eqx.tree_at(lambda m: m.corner, fit.model, corner)
        after = [curve_residuals(filtering, c, w, fit.q) for c, w in zip(fit.curves, fit.weights, strict=True)]
        change = [a - b for a, b in zip(after, before, strict=True)]
        made = inverse @ sum(J.T @ v for J, v in zip(slopes, change, strict=True))
        left = [v - J @ made for J, v in zip(slopes, change, strict=True)]
        variance = sum(
            r @ r / r.size * filtered(v[:, None], n)[0, 0] for r, v, n in zip(before, left, models, strict=True)
        )
        return -sum(v @ r for v, r in zip(left, before, strict=True)) / jnp.sqrt(variance)

    return jax.lax.map(score, corners)


def moved_between_rows(fitted: Fit, tests: Sequence[Test]) -> Float[np.ndarray, " p"]:
    """How far the coordinates move if the input is a smooth curve between the rows in place of straight lines. (p,).

    The smooth curve is the monotone cubic of Fritsch and Carlson.
    """
    smooth = tuple(fitted.model.prepare(test, smooth=True) for test in tests)
    return np.asarray(_moved(fitted, smooth))


@program
def _moved(fit: Fit, others: tuple[Curve, ...]) -> Float[Array, " p"]:
    """A⁻¹ Jᵀ v for what other curves change of the residuals."""
    slopes = jax.jacfwd(lambda x: fitted_residuals(fit, x))(fit.q)
    pulls = jnp.zeros_like(fit.q)
    for curve, other, w, J in zip(fit.curves, others, fit.weights, slopes, strict=True):
        v = curve_residuals(fit.model, other, w, fit.q) - curve_residuals(fit.model, curve, w, fit.q)
        pulls = pulls + J.T @ v
    return -inverse_of_free(fit) @ pulls


def is_coarse(model: object, tests: Sequence[Test]) -> list[str]:
    """Kinds of the tests whose rows are further apart than the sampling time of the model."""
    if not isinstance(model, Sampled):
        return []
    return [test.kind for test in tests if np.median(np.diff(test.time)) > 1.001 * model.T]
