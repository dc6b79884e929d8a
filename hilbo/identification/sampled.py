"""Discrete-time FO-SLS, as it is rendered, as a model for fitting recorded tests.

Coordinates (three parts with separate time scales, so that the column-scaled Jacobian has a condition number of about
30 instead of 30,000):

    q = (K_inst, K_eff, log κ, logit α),  K_inst = K0 + K1/(1 + κ) = H(∞),  K_eff = H(1),  κ = K1·T^α/B1
    H(z) = K_eff + (K_inst - K_eff)·(1 + κ)·(C(z) - S) / ((1 - S)·(κ + C(z))),  S = C(1)

with C(z) = Σ_{i=0..N} c_i z^{-i} (`memory`), or (1 - 1/z)^α with full memory, where S = 0. A response is the inverse
transform of H(z)·X(z) (of X(z)/H(z) for creep) on a circle |z| = r > 1: two FFTs for any N. The circle damps
wrap-around by r^{-L} = eps^0.8, so the curves agree with the recursion to about eps^0.75.

Units: N, mm, s; B1 N·s^α/mm.
"""

from collections.abc import Sequence
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from hilbo.errors import InputError
from hilbo.identification import instrument
from hilbo.identification.fitting import MEASURED, Curve, Test
from hilbo.identification.recorded import (
    damping_radius,
    interpolated,
    position_driven,
    secant,
    transform_length,
    unit_of_force,
)
from hilbo.identification.rounding import rounding
from hilbo.identification.screening import screened, separate

__all__ = ["Sampled"]

_TAPS = 1024
_ROUNDING = 1e-9  # relative tolerance of a bound after conversion to s and Hz
_MOST = 2_000_000  # samples of a test; a fit takes 1.3 kB of memory for each, its intervals more
_LOG_KAPPA = np.log(10.0) * np.arange(-5.0, 3.1, 0.5)
_LOGIT_ALPHA = np.array([-3.5, -2.2, -1.4, -0.6, 0.0, 0.6, 1.4, 2.2, 3.5, 4.4])


class Sampled(eqx.Module):
    """FO-SLS sampled every `T` s, with short memory of `N` past samples or full memory.

    Full memory is the infinite sum, which `viscoelastic`'s sum of exponentials approximates to 1e-4 of the largest
    force. `lag` (s): delay of the recorded force relative to the position, negative where the position is late;
    `corner` (Hz) of a first-order low-pass filter in the force channel (`instrument`), inf for no filter. Each is a
    number or "fit", which appends a coordinate: the lag in samples, the logarithm of the corner over 1/(2πT).
    """

    N: int | Int[Array, ""] = 101
    T: float = eqx.field(static=True, default=1e-3)
    memory: Literal["short", "full"] = eqx.field(static=True, default="short")
    capacity: int = eqx.field(
        static=True, default=0
    )  # number of taps computed; models of equal capacity share one compilation

    lag: Any = 0.0  # a number, an array of `at`, or "fit"
    corner: Any = np.inf

    kinds = MEASURED

    def __check_init__(self):
        """Raise `InputError` for N below 1, T not above 0, and a lag or corner that is not "fit" or in its range."""
        if isinstance(self.N, int) and self.N < 1:
            raise InputError(f"N is {self.N}; it must be at least 1: the number of past samples.")
        if not 0 < self.T < np.inf:
            raise InputError(f"T is {self.T}; it must be a time in s above 0.")
        if any(isinstance(value, str) and value != "fit" for value in (self.lag, self.corner)):
            raise InputError(f'lag and corner are {self.lag!r} and {self.corner!r}; each must be a number or "fit".')
        if isinstance(self.lag, float) and not abs(self.lag) <= instrument.LARGEST_LAG * self.T * (1 + _ROUNDING):
            most = 1e3 * instrument.LARGEST_LAG * self.T
            raise InputError(f"The lag is {1e3 * self.lag:g} ms; it must be between -{most:g} and {most:g} ms.")
        if isinstance(self.corner, float) and not self.corner >= self._corners()[0] * (1 - _ROUNDING):
            raise InputError(f"The corner is {self.corner:g} Hz; it must be {self._corners()[0]:.3g} Hz or more.")

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the coordinates: K_inst, K_eff, kappa and alpha, then lag and corner if they are fitted."""
        fitted = [name for name in ("lag", "corner") if _is_fitted(getattr(self, name))]
        return ("K_inst", "K_eff", "kappa", "alpha", *fitted)

    def physical(self) -> tuple[tuple[bool, ...], tuple[bool, ...]]:
        """Masks of the lower and of the upper bounds that are physical limits: K_eff = 0, the highest filter corner."""
        upper = tuple(name == "corner" for name in self.labels)
        return tuple(name == "K_eff" for name in self.labels), upper

    def _corners(self) -> tuple[float, float]:
        """Lowest and highest corner frequency (Hz) of a fitted filter; a given one may be higher."""
        slowest, fastest = instrument.SLOWEST_FILTER * self.T, instrument.FASTEST_FILTER * self.T
        return 1 / (2 * np.pi * slowest), 1 / (2 * np.pi * fastest)

    def box(self, tests: Sequence[Test]) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of q: stiffness up to 50 times the largest secant, κ up to 1e4, α from 0.01 to 0.99.

        κ has the lower bound 1e-4, or 1e-6 with full memory: far below S(α) the curve no longer depends on it, and K1
        would grow as 1/κ without limit. A fitted lag is within two samples either way, a fitted filter's time constant
        from a twentieth of a sample to five. Two arrays (p,).
        """
        top = max(secant(test) for test in tests)
        ends = np.log(0.99 / 0.01)
        least = 1e-6 if self.memory == "full" else 1e-4
        lag, slow, fast = float(instrument.LARGEST_LAG), instrument.SLOWEST_FILTER, instrument.FASTEST_FILTER
        lower = np.array([1e-3 * top, 0.0, np.log(least), -ends, *self._of_fitted(-lag, -np.log(slow))])
        return lower, np.array([50 * top, 50 * top, np.log(1e4), ends, *self._of_fitted(lag, -np.log(fast))])

    def _of_fitted(self, lag: float, corner: float) -> list[float]:
        """List of the given values for those of `lag` and `corner`, in that order, that this model fits."""
        return [value for value, own in ((lag, self.lag), (corner, self.corner)) if _is_fitted(own)]

    def starts(self, tests: Sequence[Test]) -> Float[np.ndarray, "starts p"]:
        """Up to five starting points: the best non-adjacent points of a grid in (κ, α). (s, p).

        With position as input every test is linear in K_inst and K_eff, which are solved for at each grid point,
        without lag and filter.
        """
        curves = tuple(self.prepare(position_driven(test)) for test in tests)
        lower, upper = self.box(tests)
        scales = [jnp.asarray(np.ptp(test.output.mean(axis=0)) * unit_of_force(test)) for test in tests]
        grid = jnp.asarray(np.stack(np.meshgrid(_LOG_KAPPA, _LOGIT_ALPHA, indexing="ij"), axis=-1))
        plain = eqx.tree_at(lambda m: (m.lag, m.corner), self, (0.0, np.inf))
        costs, stiffness = (np.asarray(values) for values in screened(plain, curves, scales, grid))
        appended = self._of_fitted(0.0, 0.0)
        points = [np.concatenate([stiffness[index], np.asarray(grid[index]), appended]) for index in separate(costs, 5)]
        return np.clip(np.stack(points), lower, upper)

    def prepare(self, test: Test, *, smooth: bool = False) -> Curve:
        """Convert a test to a `Curve`: interpolate the inputs to the model's samples and transform them.

        Between rows the input is linear, or a monotone cubic if `smooth`; noise of an input with even rows is smoothed
        where it does not change. A creep test with the noise in its force is fitted with input and output exchanged
        (`Curve.fitted`): noise of the input passes through the model, and would bias the fitted stiffness upwards.
        Raises `InputError` for a test with too many samples for the memory.
        """
        assert test.input is not None
        elapsed = test.time - test.time[0]
        self._check_length(test.kind, float(elapsed[-1]))
        position = elapsed / self.T
        nearest = np.round(position)
        position = np.where(np.abs(position - nearest) < 1e-6, nearest, position)
        count = int(np.ceil(position[-1])) + 1
        grid = np.arange(count) * self.T
        offset = test.input[:, 0] if test.start == "equilibrium" else np.zeros(test.repeats)
        clear = instrument.clear_changes(test.input - offset[:, None])
        even = np.ptp(np.diff(position)) < 1e-6
        rows = instrument.without_noise(test.input, clear) if even else test.input
        inputs = interpolated(grid, elapsed, rows, smooth) - offset[:, None]
        length = transform_length(count)
        damping = damping_radius(length, inputs.dtype) ** -np.arange(count + instrument.LARGEST_LAG, dtype=inputs.dtype)
        changes = np.diff(inputs, axis=1, prepend=0.0)
        if not even:
            ends = np.minimum(np.searchsorted(position, np.arange(count)), position.size - 1)  # of each tick's line
            changes = changes * clear[ends]
        # Where the position is late, the last forces depend on later input, which is extrapolated linearly.
        changes = np.pad(changes, ((0, 0), (0, instrument.LARGEST_LAG)), mode="edge")
        before = np.minimum(position.astype(int), count - 2)
        regular = bool(position.size == count and np.all(position == np.arange(count)))
        return Curve(
            test.kind,
            jnp.asarray(elapsed),
            jnp.asarray(test.output),
            jnp.asarray(offset),
            jnp.asarray(np.full(test.time.size, np.ptp(test.output.mean(axis=0)))),
            jnp.asarray(np.fft.rfft(inputs * damping[:count], length)),
            jnp.asarray(before),
            jnp.asarray(position - before),
            length,
            jnp.asarray(np.fft.rfft(changes * damping, length)),
            regular,
            rounding(test.input, ~clear) if regular else None,
            rounding(test.output, ~instrument.clear_changes(test.output)) if regular else None,
            self.prepare(position_driven(test), smooth=smooth) if instrument.is_fitted_in_force(test) else None,
        )

    def _check_length(self, kind: str, seconds: float):
        """Raise `InputError` for a test (of `kind`, lasting so many `seconds`) of more than 2,000,000 samples of T."""
        if seconds > _MOST * self.T:
            raise InputError(
                f"The {kind} test lasts {seconds:g} s, which is {seconds / self.T:,.0f} samples of T = {self.T:g} s,"
                f" and at most {_MOST:,} can be fitted; fit its first part by --longest {_MOST * self.T:g}, or give a"
                " larger --T, the sampling time of a slower rendering."
            )

    def predict(self, q: Float[Array, " p"], curve: Curve, weights: Float[Array, " R"]) -> Float[Array, " m"]:
        """Response (force, or position for creep) to the weighted mean of the inputs, at the measured times.

        `q` (p,), `weights` (R,) -> (m,), in N or mm.
        """
        assert curve.spectra is not None and curve.share is not None and curve.before is not None
        H = self._transfer(q, curve.length, damping_radius(curve.length, q.dtype))
        creep = curve.kind == "creep"
        weighted = weights.astype(curve.spectra.dtype)
        spectrum = weighted @ curve.spectra
        if self._has_instrument():
            assert curve.changes is not None
            spectrum = spectrum + self._instrument_multiplier(q, curve) * (weighted @ curve.changes)
        spectrum = spectrum / H if creep else spectrum * H
        growth = damping_radius(curve.length, q.dtype) ** jnp.arange(curve.length // 2, dtype=q.dtype)
        response = jnp.fft.irfft(spectrum, curve.length)[: curve.length // 2] * growth
        rest = weights @ curve.offset
        rest = rest / q[1] if creep else rest * q[1]
        return rest + response[curve.before] * (1 - curve.share) + response[curve.before + 1] * curve.share

    def as_input_noise(
        self, q: Float[Array, " p"], curve: Curve, r: Float[Array, " m"]
    ) -> tuple[Float[Array, " m"], Float[Array, " m+1"], Float[Array, ""]]:
        """Express the residuals r (m,) of a regular curve as noise of its recorded input that passed through the model.

        Returns the input noise (m,), in the scale of r; the factor (m + 1,) by which the model multiplies its spectral
        density at πj/m, j = 0 … m; and the ratio of the input noise to the output it causes in the same sample.
        """
        creep, radius, m = curve.kind == "creep", damping_radius(curve.length, q.dtype), r.size
        H = self._transfer(q, curve.length, radius)
        growth = radius ** jnp.arange(m, dtype=q.dtype)
        spectrum = jnp.fft.rfft(r / growth, curve.length)
        source = jnp.fft.irfft(spectrum * H if creep else spectrum / H, curve.length)[:m] * growth
        gain = jnp.abs(self._transfer(q, 2 * m, 1.0)) ** 2
        return source, (1 / gain if creep else gain), (q[0] if creep else 1 / q[0])

    def _has_instrument(self) -> bool:
        """Whether the force channel has a lag or a filter, given or fitted."""
        return not (isinstance(self.lag, float) and self.lag == 0 and self._without_filter())

    def _without_filter(self) -> bool:
        """Whether the filter is neither given nor fitted."""
        return isinstance(self.corner, float) and bool(np.isinf(self.corner))

    def _instrument_multiplier(self, q: Float[Array, " p"], curve: Curve) -> Complex[Array, " {curve.length//2+1}"]:
        """Multiplier of the input's changes for lag and filter (`instrument`), at points of the upper half circle."""
        lag = q[4] if _is_fitted(self.lag) else jnp.asarray(self.lag, q.dtype) / self.T
        corner = jnp.exp(q[-1]) if _is_fitted(self.corner) else jnp.asarray(2 * np.pi * self.T * self.corner, q.dtype)
        angle = 2 * jnp.pi * jnp.arange(curve.length // 2 + 1, dtype=q.dtype) / curve.length
        z = damping_radius(curve.length, q.dtype) * jax.lax.complex(jnp.cos(angle), jnp.sin(angle))
        return instrument.multiplier(curve.kind == "relaxation", lag, None if self._without_filter() else 1 / corner, z)

    def parameters(self, q: Float[Array, " p"]) -> dict[str, Float[Array, ""]]:
        """K0, K1 (N/mm), B1 (N·s^α/mm), α, K_inst and K_eff (N/mm) by name, from `q` (p,)."""
        K_inst, K_eff, kappa, alpha = q[0], q[1], jnp.exp(q[2]), jax.nn.sigmoid(q[3])
        S = self._taps(alpha)[1]
        K1 = (K_inst - K_eff) * (1 + kappa) * (kappa + S) / (kappa * (1 - S))
        K0, B1 = K_eff - K1 * S / (kappa + S), K1 / kappa * self.T**alpha
        return {"K0": K0, "K1": K1, "B1": B1, "alpha": alpha, "K_inst": K_inst, "K_eff": K_eff}

    def natural(self, q: Float[Array, " p"]) -> Float[Array, " p"]:
        """Coordinates in the units of their labels: K_inst, K_eff (N/mm), κ, α, lag (ms) and corner (Hz).

        (p,) -> (p,).
        """
        fitted = [1e3 * self.T * q[4]] if _is_fitted(self.lag) else []
        fitted += [jnp.exp(q[-1]) / (2 * jnp.pi * self.T)] if _is_fitted(self.corner) else []
        return jnp.stack([q[0], q[1], jnp.exp(q[2]), jax.nn.sigmoid(q[3]), *fitted])

    def at(self, tests: Sequence[Test]) -> "Sampled":
        """Model with numbers as arrays and room for at least 1024 taps, so that all values share one compilation.

        The tests have no influence. With full memory only given lags and corners become arrays.
        """
        del tests
        lag, corner = self.lag, self.corner
        if self._has_instrument():
            lag = lag if _is_fitted(lag) else jnp.asarray(lag)
            corner = corner if _is_fitted(corner) or self._without_filter() else jnp.asarray(corner)
        if self.memory == "full" or self.capacity:
            return Sampled(self.N, self.T, self.memory, self.capacity, lag, corner)
        return Sampled(jnp.asarray(self.N), self.T, self.memory, max(_TAPS, int(self.N)), lag, corner)

    def coordinates(
        self, K0: float, K1: float, B1: float, alpha: float, lag: float = 0.0, corner: float = np.inf
    ) -> Float[np.ndarray, " p"]:
        """Coordinates q (p,) of a parameter set; K0 and K1 in N/mm, B1 in N·s^α/mm, lag in s, corner in Hz.

        `lag` and `corner` are used only if the model fits them.
        """
        kappa = K1 * self.T**alpha / B1
        S = float(self._taps(jnp.asarray(alpha))[1])
        ends = K0 + K1 / (1 + kappa), K0 + K1 * S / (kappa + S)
        rest = self._of_fitted(lag / self.T, np.log(2 * np.pi * self.T * corner))
        return np.array([*ends, np.log(kappa), np.log(alpha / (1 - alpha)), *rest])

    def _transfer(self, q: Float[Array, " p"], length: int, radius: float) -> Complex[Array, " {length//2+1}"]:
        """H (N/mm) at `length` points on the circle with this radius, of which the upper half, (length // 2 + 1,)."""
        kappa, alpha = jnp.exp(q[2]), jax.nn.sigmoid(q[3])
        taps, S = self._taps(alpha)
        if self.memory == "full":
            angle = 2 * jnp.pi * jnp.arange(length // 2 + 1, dtype=q.dtype) / length
            delay = jax.lax.complex(jnp.cos(angle), -jnp.sin(angle)) / radius
            C = (1 - delay) ** alpha.astype(delay.dtype)
        else:
            taps = taps[: length // 2]  # those beyond the data act through S only
            C = jnp.fft.rfft(taps * radius ** -jnp.arange(taps.size, dtype=q.dtype), length)
        K_eff, size, S, kappa = (
            value.astype(C.dtype) for value in (q[1], (q[0] - q[1]) * (1 + kappa) / (1 - S), S, kappa)
        )
        return K_eff + size * (C - S) / (kappa + C)

    def _taps(self, alpha: Float[Array, ""]) -> tuple[Float[Array, " taps"], Float[Array, ""]]:
        """Coefficients c_0 … c_N, padded with zeros, and S = C(1), without cancellation.

        With full memory the coefficients are not used: [1], and S = 0.
        """
        if self.memory == "full":
            return jnp.ones(1, alpha.dtype), jnp.zeros_like(alpha)
        i = jnp.arange(1, (self.capacity or int(self.N)) + 1, dtype=alpha.dtype)
        sums = jnp.cumprod(jnp.where(i <= self.N, 1 - alpha / i, 1))
        taps = jnp.where(i <= self.N, alpha / i, 0) * jnp.concatenate([jnp.ones(1, alpha.dtype), sums[:-1]])
        return jnp.concatenate([jnp.ones(1, alpha.dtype), -taps]), sums[-1]


def _is_fitted(value: Any) -> bool:
    """Whether a lag or corner is "fit", hence a coordinate."""
    return isinstance(value, str)
