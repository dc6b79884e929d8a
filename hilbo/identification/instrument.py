"""What a force channel does to a recorded test: a lag against the position, and a first-order filter.

The recorded force is F_r(t) = (A F)(t - d): d is the lag (negative where the position is late), A a low-pass filter of
first order with the time constant τ. Both act on the recorded *input*, since every part is linear and
time-invariant: relaxation predicts F_r from (A x)(t - d), creep predicts x from (A⁻¹ F_r)(t + d). Between two samples
a signal is a straight line, for which both are exact:

    x(t + s)  = x + s·z·Δ (s >= 0),  x + s·Δ (s < 0),      Δ_n = x_n - x_{n-1},  |s| <= 1 sample
    A x       = x - g/(1 - e/z)·Δ,                          e = exp(-T/τ),  g = (1 - e)·τ/T
    A⁻¹ F     = F + g/((1 - g) + (g - e)/z)·Δ

Only those changes Δ enter that stand clear of the input's noise. A shift of a fraction of a sample averages two
samples, and A⁻¹ amplifies what is fast: applied to the noise they would lower or raise the residuals, and the fit would
choose lag and filter for that reason.
Units: lag in samples of T here and in coordinates, in ms under its name; corners 1/(2πτ) in Hz.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from hilbo.identification.fitting import Test

__all__ = ["LARGEST_LAG", "SLOWEST_FILTER", "FASTEST_FILTER", "can_be_timed", "clear_changes", "multiplier"]

LARGEST_LAG = 2  # samples, either way
SLOWEST_FILTER, FASTEST_FILTER = 5.0, 0.05  # time constants, samples
_CLEAR = 5.0  # standard deviations of the noise in a difference
_AROUND = 3  # rows before and after a clear change: ends of ramps, tails of filters


def can_be_timed(tests: Sequence[Test]) -> bool:
    """Whether an input changes clearly from one row to the next, so that a lag shows."""
    return any(bool(clear_changes(test.input).any()) for test in tests if test.input is not None)


def clear_changes(values: Float[np.ndarray, "R m"]) -> Bool[np.ndarray, " m"]:
    """Rows at which the mean of the repeats changes by more than its noise from the row before, and their neighbours.

    The row before the first one is 0. `values` (R, m), in any unit -> (m,).
    """
    mean = values.mean(axis=0)
    # A second difference has the variance of six samples, a first one that of two.
    noise = 1.4826 * np.median(np.abs(np.diff(mean, 2))) / np.sqrt(6)
    clear = np.abs(np.diff(mean, prepend=0.0)) > _CLEAR * np.sqrt(2) * noise
    return np.convolve(clear, np.ones(2 * _AROUND + 1), "same") > 0


def multiplier(
    kind: str, lag: Float[Array, ""], tau: Float[Array, ""] | None, z: Complex[Array, " w"]
) -> Complex[Array, " w"]:
    """What the changes are multiplied by and added to the input: `lag` and time constant `tau` in samples.

    `z` (w,): points of the plane at which the transforms are known -> (w,), without unit. `tau` None: no filter.
    """
    forward = kind == "relaxation"
    m = _shift(-lag if forward else lag, z)
    if tau is None:
        return m
    e = jnp.exp(-1 / tau)
    g = tau * (1 - e)
    if forward:
        return m - (g + g * (1 - 1 / z) * m) / (1 - e / z)
    inverse = g / ((1 - g) + (g - e) / z)
    return m + inverse * (1 + (1 - 1 / z) * m)


def _shift(s: Float[Array, ""], z: Complex[Array, " w"]) -> Complex[Array, " w"]:
    """The multiplier of an advance by s samples, a straight line from each sample to the next."""
    total, later, earlier = jnp.zeros_like(z), z, jnp.ones_like(z)
    for k in range(LARGEST_LAG):
        total = total + jnp.clip(s - k, 0, 1) * later - jnp.clip(-s - k, 0, 1) * earlier
        later, earlier = later * z, earlier / z
    return total
