"""Record of one FO-SLS parameter set, with its frequency response and its force or position in time.

Continuous model H(s) = K0 + K1·B1·s^α / (K1 + B1·s^α), 0 < α <= 1. Sampled every T seconds (see `memory` for C)

    β = B1·T^{-α},   H(z) = K0 + K1·β·C(z) / (K1 + β·C(z))

One history, the elongation y of the spring-pot, gives force from position or position from force. With g = K1/(K1 + β),
k = K1·β/(K1 + β) and s_n = Σ |c_i|·y_{n-i}

    F_n = K0·x_n + k·(x_n - s_n),   x_n = (F_n + k·s_n)/(K0 + k),   y_n = s_n + g·(x_n - s_n)

g and k are computed from β/K1 or K1/β, whichever is at most 1, so that a spring (K1 = 0), a spring-pot (K1 = inf) and
all cases between share one code.

Units: stiffness N/mm, B1 N·s^α/mm, T s, x mm, F N, damping N·s/m. Memory, N and T belong to a parameter set: the same α
with another N is another material. Reference: Podlubny (1999), Fractional Differential Equations, section 7.3.
"""

import math
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Complex, Float, Inexact, Real

from hilbo.errors import InputError
from hilbo.mechanics.memory import GLSums, gl_coefficients, response, sums
from hilbo.mechanics.ranges import Floats, Number, Scalar, possible
from hilbo.mechanics.recursion import BLOCK, past_of
from hilbo.mechanics.span import Memory, Span, span
from hilbo.numerics.host import namespace_of, on_host
from hilbo.numerics.mittag_leffler import mittag_leffler
from hilbo.numerics.shown import concrete, numbers, shown
from hilbo.numerics.tracing import program

__all__ = ["FOSLS", "Start", "pot_stiffness", "series", "share", "slow_damping", "slow_stiffness"]

Start = Literal["rest", "equilibrium"]
_LONGEST_RELAXATION = 1_000_000  # samples


class FOSLS(eqx.Module):
    """One parameter set of the FO-SLS with its memory and sampling time `T` (s).

    Short memory has `N` taps, full memory `states` exponentials. K0, K1 (N/mm), B1 (N·s^α/mm) and alpha are scalars of
    one floating dtype; use `jax.vmap` over records or over constructors for several. For NumPy inputs, `dc_gain`,
    `beta` and the passivity certificate of short memory are computed by NumPy, without compilation. K1 may be `inf`: K0
    parallel to a spring-pot. Raises InputError for K1 < 0, B1 < 0, α outside (0, 1], numbers that are not finite, for
    K0 < 0 with full memory, and for T that is not above 0; ValueError for an unknown memory or number of taps or
    exponentials. Inside `jit`, where values are unknown, invalid values set alpha to NaN, and so all results.
    """

    K0: Number
    K1: Number
    B1: Number
    alpha: Number
    N: int = eqx.field(static=True)
    T: float = eqx.field(static=True)
    memory: Memory = eqx.field(static=True)
    states: int = eqx.field(static=True)

    def __init__(
        self,
        K0: Real[ArrayLike, ""],
        K1: Real[ArrayLike, ""],
        B1: Real[ArrayLike, ""],
        alpha: Real[ArrayLike, ""],
        N: int = 101,
        T: float = 1e-3,
        *,
        memory: Memory = "short",
        states: int = 10,
    ):
        xp = np if on_host(K0, K1, B1, alpha) else jnp
        dtype = xp.result_type(1.0, K0, K1, B1, alpha)
        self.K0, self.K1, self.B1, self.alpha = (xp.asarray(value, dtype) for value in (K0, K1, B1, alpha))
        if not concrete(self.K0, self.K1, self.B1, self.alpha):
            allowed = possible(K1=self.K1, B1=self.B1, alpha=self.alpha)
            allowed = allowed & possible(K0=self.K0) if memory == "full" else allowed
            self.alpha = jnp.where(allowed, self.alpha, jnp.nan)
        self.N, self.T, self.memory, self.states = N, float(T), memory, states

    def __repr__(self) -> str:
        values = ", ".join(f"{name}={shown(getattr(self, name))}" for name in ("K0", "K1", "B1", "alpha"))
        memory = f"N={self.N}" if self.memory == "short" else f'memory="full", states={self.states}'
        return f"FOSLS({values}, {memory}, T={self.T:g})"

    def __check_init__(self):
        span(self.memory, self.N, self.states)
        if not 0 < self.T < math.inf:
            raise InputError(f"T is {self.T} s; it must be a number above 0; write for example T = 0.001.")
        if concrete(self.K0, self.K1, self.B1, self.alpha):
            _check_values(float(self.K0), float(self.K1), float(self.B1), float(self.alpha), self.memory)

    @property
    def span(self) -> Span:
        """Memory of the model, with the number of taps or exponentials."""
        return span(self.memory, self.N, self.states)

    @property
    def beta(self) -> Number:
        """β = B1·T^{-α}, N/mm. A scalar."""
        return pot_stiffness(self.B1, self.alpha, self.T)

    def frequency_response(self, omega: Real[ArrayLike, "*w"]) -> Complex[Array, "*w"]:
        """H(e^{jωT}) (N/mm) of the sampled model at angular frequencies ω (rad/s) up to π/T.

        `omega` of any shape -> complex, the same shape.
        """
        return _frequency_response(self, jnp.asarray(omega, self.K0.dtype))

    def continuous_response(self, omega: Real[ArrayLike, "*w"]) -> Complex[Array, "*w"]:
        """H(jω) (N/mm) of the continuous model with the same parameters; ω >= 0 in rad/s.

        `omega` of any shape -> complex, the same shape.
        """
        size = self.B1 * jnp.asarray(omega, self.K0.dtype) ** self.alpha
        lead = jnp.pi / 2 * self.alpha
        pot = jax.lax.complex(size * jnp.cos(lead), size * jnp.sin(lead))
        return self.K0.astype(pot.dtype) + series(self.K1, pot)

    def dc_gain(self) -> Number:
        """Static stiffness H(1), N/mm. A scalar."""
        return self.K0 + slow_stiffness(self.K1, self.beta, sums(self.alpha, self.span))

    def high_frequency_gain(self) -> Number:
        """H(-1), N/mm: the stiffness at the Nyquist frequency. A scalar."""
        return self.K0 + series(self.K1, self.beta * sums(self.alpha, self.span).at_nyquist)

    def instantaneous_stiffness(self) -> Number:
        """K0 + k, N/mm: force per step of position in the sample of the step. A scalar."""
        return self.K0 + series(self.K1, self.beta)

    def effective_damping(self) -> Number:
        """dH/ds at s = 0, N·s/m: the damping in slow motion. B1 where K1 is infinite and α = 1. A scalar."""
        return slow_damping(self.K1, self.beta, sums(self.alpha, self.span), self.T)

    def simulate(
        self, x: Real[ArrayLike, " n"], *, start: Start = "rest", unilateral: bool = False, block: int = BLOCK
    ) -> Float[Array, " n"]:
        """Force (N) that follows positions `x` (mm), one every T; differentiable in `x` and in every parameter.

        `start`: "rest" at x = 0, or "equilibrium" at x[0], constant for ever before. `unilateral`: contact can only
        push: x below 0 counts as 0 in the history, and forces below 0 as 0. `block` = 1 is the plain recursion, sample
        by sample; larger blocks give the same numbers up to rounding, faster. `x` (n,) -> (n,). Raises `InputError` for
        another shape or an unknown `start`.
        """
        return _force(self, self._series("x", x), _checked_start(start), unilateral, block)

    def simulate_force(
        self, F: Real[ArrayLike, " n"], *, start: Start = "rest", block: int = BLOCK
    ) -> Float[Array, " n"]:
        """Position (mm) that follows forces `F` (N): the inverse of `simulate`, see there.

        An equilibrium under force needs H(1) > 0; without it there is none that a material would rest in.
        `F` (n,) -> (n,).
        """
        return _position(self, self._series("F", F), _checked_start(start), block)

    def _series(self, name: str, value: Real[ArrayLike, " n"]) -> Float[Array, " n"]:
        """Samples as an array of the model's dtype.

        Raises `InputError`, with the `name` of the argument, for values that are not numeric or have another shape than
        (n,).
        """
        samples = numbers("FOSLS", name, value, self.K0.dtype)
        if samples.ndim != 1:
            raise InputError(f"FOSLS: {name} has shape {samples.shape}; give one sample every T, of shape (n,).")
        return samples

    def settling_time(self, fraction: float) -> Scalar:
        """Time (s) of the first sample at which this `fraction` of the relaxation after a step is complete.

        Use 0.9 for t90. With short memory counted sample by sample, `inf` beyond a million samples; with full memory
        the exact time t, between samples, at which E_α(-(K1/B1)·t^α) = 1 - fraction, which may be years. A scalar; NaN
        if alpha is. Raises `InputError` for a `fraction` that is not at least 0 and below 1.
        """
        if not 0 <= fraction < 1:
            raise InputError(f"fraction is {fraction}; it must be at least 0 and below 1; write 0.9 for t90.")
        find = _short_settling if self.memory == "short" else _full_settling
        return jnp.where(jnp.isnan(self.alpha), jnp.nan, find(self, jnp.asarray(fraction, self.K0.dtype)))


def series(K1: Floats, pot: Inexact[Any, "..."]) -> Inexact[Any, "..."]:
    """Stiffness of a spring and a spring-pot in series, K1·pot/(K1 + pot), for any K1 from 0 to inf and complex `pot`.

    N/mm; elementwise.
    """
    xp = namespace_of(K1, pot)
    stiff = (xp.abs(pot) <= K1) & (K1 > 0)
    compliance = (1 / xp.where(stiff, K1, 1)).astype(pot.dtype)
    spring, pot_of_soft = xp.where(stiff, 0, K1).astype(pot.dtype), xp.where(stiff | (pot == 0), 1, pot)
    return xp.where(stiff, pot / (1 + compliance * pot), spring / (1 + spring / pot_of_soft))


def share(K1: Floats, pot: Floats) -> Floats:
    """Elongation of the spring-pot as a fraction of the total in series with K1, K1/(K1 + pot), for K1 from 0 to inf.

    N/mm -> dimensionless; elementwise.
    """
    xp = namespace_of(K1, pot)
    stiff = (pot <= K1) & (K1 > 0)
    ratio = xp.where(stiff, 0, K1) / xp.where(stiff | (pot == 0), 1, pot)
    return xp.where(stiff, 1 / (1 + pot / xp.where(stiff, K1, 1)), ratio / (1 + ratio))


def pot_stiffness(B1: Floats, alpha: Floats, T: float | Floats) -> Floats:
    """Stiffness β = B1·T^{-α} (N/mm) of the spring-pot within the sample of a step.

    B1 in N·s^α/mm, T in s; elementwise.
    """
    return B1 * T**-alpha


def slow_stiffness(K1: Number, beta: Number, gl: GLSums) -> Number:
    """H(1) - K0, N/mm: static stiffness of spring and spring-pot in series.

    K1 and `beta` are scalars, in N/mm; `gl`: sums of the coefficients at the model's order and memory.
    """
    return series(K1, beta * gl.at_dc)


def slow_damping(K1: Number, beta: Number, gl: GLSums, T: float | Number) -> Number:
    """dH/ds at s = 0, N·s/m: T·K1²·β·M1/(K1 + β·S_N)².

    K1 and `beta` are scalars, in N/mm, T in s; `gl`: sums of the coefficients. The factor 1000 converts N·s/mm to
    N·s/m.
    """
    return 1000 * T * beta * gl.moment * share(K1, beta * gl.at_dc) ** 2


@program
def _frequency_response(model: FOSLS, omega: Float[Array, "*w"]) -> Complex[Array, "*w"]:
    """H (N/mm) at angular frequencies ω (rad/s); compiled."""
    pot = response(model.alpha, omega * model.T, model.span)
    return model.K0.astype(pot.dtype) + series(model.K1, model.beta.astype(pot.dtype) * pot)


@program
def _force(model: FOSLS, x: Float[Array, " n"], start: Start, unilateral: bool, block: int) -> Float[Array, " n"]:
    """Force (N) at each position of x (mm); compiled. Arguments as in `FOSLS.simulate`."""
    beta = model.beta
    gain, stiffness = share(model.K1, beta), series(model.K1, beta)
    x = jnp.maximum(x, 0) if unilateral else x
    before = jnp.zeros_like(beta)
    if start == "equilibrium":
        before = x[0] * share(model.K1, beta * sums(model.alpha, model.span).at_dc)
    past = past_of(model.alpha, gain, share(beta, model.K1), x, before, model.span, block)
    force = model.K0 * x + stiffness * (x - past)
    return jnp.maximum(force, 0) if unilateral else force


@program
def _position(model: FOSLS, F: Float[Array, " n"], start: Start, block: int) -> Float[Array, " n"]:
    """Position (mm) at each force of F (N); compiled. Arguments as in `FOSLS.simulate_force`."""
    beta = model.beta
    gain, stiffness = share(model.K1, beta), series(model.K1, beta)
    total = model.K0 + stiffness
    before = jnp.zeros_like(beta)
    if start == "equilibrium":
        before = F[0] / model.dc_gain() * share(model.K1, beta * sums(model.alpha, model.span).at_dc)
    past = past_of(model.alpha, gain / total, 1 - gain * model.K0 / total, F, before, model.span, block)
    return (F + stiffness * past) / total


@program
def _short_settling(model: FOSLS, fraction: Scalar) -> Scalar:
    """Settling time (s) with short memory: T times the first n with s_n >= fraction·s_inf after a unit step.

    s only grows, and the force relaxes with it. inf beyond a million samples; compiled.
    """
    beta, gl = model.beta, sums(model.alpha, model.span)
    gain, feedback = share(model.K1, beta), share(beta, model.K1)
    goal = fraction * (1 - gl.at_dc) * share(model.K1, beta * gl.at_dc)
    taps = -gl_coefficients(model.alpha, model.N)[1:]

    def unfinished(carry):
        n, past, _ = carry
        return (past < goal) & (n < _LONGEST_RELAXATION)

    def step(carry):
        n, past, history = carry
        history = jnp.concatenate([(gain + feedback * past)[None], history[:-1]])
        return n + 1, taps @ history, history

    n, past, _ = jax.lax.while_loop(unfinished, step, (0, jnp.zeros_like(beta), jnp.zeros_like(taps)))
    return jnp.where(past < goal, jnp.inf, model.T * n)


@program
def _full_settling(model: FOSLS, fraction: Scalar) -> Scalar:
    """Settling time (s) with full memory: bisection of log z for E_α(-z) = 1 - fraction; compiled."""

    def halve(_, ends):
        low, high = ends
        middle = (low + high) / 2
        settled = mittag_leffler(model.alpha, jnp.exp(middle)) < 1 - fraction
        return jnp.where(settled, low, middle), jnp.where(settled, middle, high)

    widest = jnp.asarray(80, fraction.dtype)
    log_z, _ = jax.lax.fori_loop(0, 60, halve, (-widest, widest))
    return jnp.where(fraction > 0, jnp.exp((log_z + jnp.log(model.B1) - jnp.log(model.K1)) / model.alpha), 0)


def _checked_start(start: Start) -> Start:
    """Return `start` unchanged. Raises `InputError` unless it is "rest" or "equilibrium"."""
    if start not in get_args(Start):
        raise InputError(f'start is "{start}"; it must be "rest" or "equilibrium".')
    return start


def _check_values(K0: float, K1: float, B1: float, alpha: float, memory: Memory) -> None:
    """Raise `InputError` for parameter values outside their ranges, or NaN.

    K0 must be 0 or above only with full memory.
    """
    if not 0 < alpha <= 1:
        raise InputError(f"alpha is {alpha}; it must be above 0 and at most 1: the order of the fractional element.")
    for name, value, most in (("K1", K1, math.inf), ("B1", B1, math.nextafter(math.inf, 0))):
        if not 0 <= value <= most:
            raise InputError(f"{name} is {value}; it must be 0 or above.")
    if not math.isfinite(K0):
        raise InputError(f"K0 is {K0}; it must be a finite number.")
    if memory == "full" and K0 < 0:
        raise InputError(
            f"K0 is {K0}; it must be 0 or above with full memory, where it is the static stiffness; a set with a "
            'negative K0 was identified with short memory: use memory = "short" and the N it belongs to.'
        )
