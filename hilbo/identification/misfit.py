"""Diagnostics of a fit without refitting: a filter in the force channel, and the shape of the input between rows.

Each alternative defines a direction v in which the residuals r would change. After projection off the free coordinates,
v' = v - J A⁻¹ Jᵀ v, the score v'ᵀr has the variance v'ᵀ Γ v' under the noise of the fit, and the coordinates would move
by A⁻¹ Jᵀ v (score test, Rao 1948).
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hilbo.identification.fitting import Curve, Fit, Test, curve_residuals
from hilbo.identification.intervals import inverse_of_free
from hilbo.identification.residual_noise import fitted_residuals, noises, weighted_normal
from hilbo.identification.sampled import Sampled
from hilbo.numerics.tracing import program

__all__ = ["coarse_kinds", "filter_score", "moved_between_rows"]

_TIMES = (0.3, 0.8, 2.0)  # time constants tested, samples


def filter_score(fitted: Fit) -> float:
    """Score statistic (in standard deviations) for a first-order low-pass filter of the force.

    The largest of three time constants. Positive if a filter would lower the cost; nothing is refitted.
    """
    model = fitted.model
    corners = jnp.asarray([1 / (2 * np.pi * tau * model.T) for tau in _TIMES])
    return float(jnp.max(_filter_scores(fitted, corners)))


@program
def _filter_scores(fit: Fit, corners: Float[Array, " f"]) -> Float[Array, " f"]:
    """Score statistic of a force filter at each corner frequency (Hz), (f,); positive if it lowers the cost."""
    before = fitted_residuals(fit, fit.q)
    slopes = jax.jacfwd(lambda x: fitted_residuals(fit, x))(fit.q)
    models = noises(fit)
    inverse = inverse_of_free(fit)

    def score(corner):
        filtering = eqx.tree_at(lambda m: m.corner, fit.model, corner)
        after = [curve_residuals(filtering, c, w, fit.q) for c, w in zip(fit.curves, fit.weights, strict=True)]
        change = [a - b for a, b in zip(after, before, strict=True)]
        explained = inverse @ sum(J.T @ v for J, v in zip(slopes, change, strict=True))
        projected = [v - J @ explained for J, v in zip(slopes, change, strict=True)]
        variance = sum(
            r @ r / r.size * weighted_normal(v[:, None], n)[0, 0]
            for r, v, n in zip(before, projected, models, strict=True)
        )
        return -sum(v @ r for v, r in zip(projected, before, strict=True)) / jnp.sqrt(variance)

    return jax.lax.map(score, corners)


def moved_between_rows(fitted: Fit, tests: Sequence[Test]) -> Float[np.ndarray, " p"]:
    """Change of the coordinates, to first order, if the input between rows is a monotone cubic, not linear. (p,).

    The cubic is Fritsch and Carlson's.
    """
    smooth = tuple(fitted.model.prepare(test, smooth=True) for test in tests)
    return np.asarray(_moved(fitted, smooth))


@program
def _moved(fit: Fit, others: tuple[Curve, ...]) -> Float[Array, " p"]:
    """First-order change of the coordinates when each curve is replaced by its counterpart in `others`."""
    slopes = jax.jacfwd(lambda x: fitted_residuals(fit, x))(fit.q)
    pulls = jnp.zeros_like(fit.q)
    for curve, other, w, J in zip(fit.curves, others, fit.weights, slopes, strict=True):
        v = curve_residuals(fit.model, other, w, fit.q) - curve_residuals(fit.model, curve, w, fit.q)
        pulls = pulls + J.T @ v
    return -inverse_of_free(fit) @ pulls


def coarse_kinds(model: object, tests: Sequence[Test]) -> list[str]:
    """Kinds of the tests whose median time step exceeds the sampling time T of the model; empty for moduli."""
    if not isinstance(model, Sampled):
        return []
    return [test.kind for test in tests if np.median(np.diff(test.time)) > 1.001 * model.T]
