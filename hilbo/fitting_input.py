"""Checks of the input of `hilbo.fit`: shapes of model and responses, categories, and points outside the unit cube."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hilbo.errors import InputError, warn_caller
from hilbo.kernels import Kernel, Stationary
from hilbo.likelihoods import OrdinalProbit
from hilbo.trials import Trials

__all__ = ["check_answers", "check_shapes", "remark_outside"]

_ROUNDING = 1e-3  # tolerance beyond the unit cube without a remark


def check_shapes(kernel: Kernel, likelihood: OrdinalProbit, trials: Trials, start: Float[Array, "..."] | None) -> None:
    """Raise `InputError` if the shapes of kernel, likelihood, trials and `start` (one weight per row, or None) do not
    match, or if the trials are stacked. Custom kernels are not checked.
    """
    if trials.mask.ndim != 1:
        raise InputError(
            f"fit: these trials are of {len(trials.mask)} people; fit those of one, or use jax.vmap with throw=False."
        )
    if isinstance(kernel, Stationary):
        _check_kernel(kernel, trials.x.shape[-1])
    if jnp.ndim(likelihood.noise):
        raise InputError(f"fit: noise has shape {jnp.shape(likelihood.noise)}; it is a scalar.")
    if start is not None and jnp.shape(start) != trials.mask.shape:
        shape = jnp.shape(start)
        raise InputError(f"fit: start has shape {shape}; give one weight for each of {trials.capacity} rows.")


def _check_kernel(kernel: Stationary, dim: int) -> None:
    """Raise `InputError` if theta is neither a scalar nor of length `dim`, if the variance is no scalar, or if the
    number of levels is not `dim`.
    """
    if jnp.shape(kernel.theta) not in ((), (dim,)):
        raise InputError(
            f"fit: theta has shape {jnp.shape(kernel.theta)} and x {dim} parameters; give one number or {dim}."
        )
    if jnp.ndim(kernel.variance):
        raise InputError(f"fit: the kernel's variance has shape {jnp.shape(kernel.variance)}; it is a scalar.")
    if kernel.levels and len(kernel.levels) != dim:
        raise InputError(f"fit: the kernel has levels {kernel.levels} and x {dim} parameters; give {dim} of them.")


def check_answers(trials: Trials, categories: int) -> None:
    """Raise `InputError` for a point that is not finite, and for a category outside 0 to `categories` - 1.

    The values must be known, not traced. All rows are checked, those without a response too.
    """
    finite, q = np.isfinite(trials.x).all(axis=-1), np.asarray(trials.q)
    if not finite.all():
        row = int(np.argmin(finite))
        raise InputError(f"fit: x[{row}] of the trials is not finite; fix that answer or take it out.")
    if np.any(wrong := (q < 0) | (q >= categories)):
        raise InputError(
            f"fit: an answer has category {q[wrong][0]}, but the likelihood has {categories - 1} thresholds and so the"
            f" categories 0 to {categories - 1}; check the answers or the thresholds."
        )


def remark_outside(whose: str, kernel: Kernel, points: Float[np.ndarray, "n d"]) -> None:
    """Issue an `InputRemark` if any of the points (n, d) is outside the unit cube by more than 1e-3.

    Such points may be in physical units: responses there are almost independent, and predictions are the prior. Kernels
    that are not stationary are not checked; `whose` begins the warning.
    """
    if not isinstance(kernel, Stationary):
        return
    outside = np.abs(points - 0.5).max(axis=-1, initial=0.0) > 0.5 + _ROUNDING
    if outside.any():
        row = int(np.argmax(outside))
        where = ", ".join(f"{v:.4g}" for v in points[row])
        sentence = f"{whose}: x[{row}] is [{where}], outside the unit cube, in which lengths are measured"
        warn_caller(f"{sentence}; a study's space.to_unit gives such points.")
