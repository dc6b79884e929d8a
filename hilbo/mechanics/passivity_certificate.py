"""Passivity of a parameter set on a device: rigorous bounds over all frequencies, and a counterexample in time.

With θ = ωT a rendering needs the damping (T/2)·φ(θ), φ = Re H - cot(θ/2)·Im H, and H(1) >= 0. In the terms of
`response_polynomials`

    p = (Y - φ)·A = (Y - K0)·A - B

is a cosine polynomial of degree N, finite for every K1 from 0 to inf. Where p >= 0 everywhere, the damping (T/2)·Y is
sufficient. `cosine_polynomials` bounds p from below over all angles. The result is an enclosure of the smallest passive
damping, for even N as well as odd. A delayed force needs (T/2)·Y(θ) of `delay`, enclosed by `delayed_enclosure`.

With full memory the Nyquist frequency binds (docs/methods/mechanics.md), and b_min has a closed form.

A violation is shown in time, by a path that loses least in the device's damping. The force is constant between samples,
so that between samples the path is straight, and a cycle absorbs the energy Σ F_n·Δx_n + b·Δx_n²/T: negative if it
creates energy. A delayed force changes between the samples, and there the path has a bend.

Units: damping N·s/m, ω rad/s, x mm, F N, energy mJ (N·mm). Reference: Colgate and Schenkel (1997), J. Robotic Syst. 14,
37-47.
"""

import math
from fractions import Fraction
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Complex, Float, Real

from hilbo.errors import InputError
from hilbo.mechanics.cosine_polynomials import at_angles, cells_for, climb, least, on_grid, rounding_unit, rows
from hilbo.mechanics.delay import check_delay, larger_root
from hilbo.mechanics.delayed_enclosure import full_estimate, short_enclosure
from hilbo.mechanics.exponentials import exponentials
from hilbo.mechanics.fosls import FOSLS
from hilbo.mechanics.memory import gl_coefficients
from hilbo.mechanics.ranges import Coefficients, Number, Scalar
from hilbo.mechanics.response_polynomials import parts_of
from hilbo.numerics.host import namespace_of, on_host
from hilbo.numerics.shown import concrete, shown
from hilbo.numerics.tracing import program

__all__ = ["Certificate", "Witness", "certify", "needed_damping", "witness"]

_LONGEST_CYCLE = 4096  # samples


class Certificate(eqx.Module):
    """Bounds of the passivity margin b - b_min, static stiffness, and frequency at which the margin is smallest."""

    lower: Number  # N·s/m
    upper: Number  # N·s/m
    static_stiffness: Number  # H(1), N/mm
    frequency: Number  # rad/s

    def __repr__(self) -> str:
        margin, stiffness = f"{shown(self.lower)} to {shown(self.upper)} N.s/m", f"{shown(self.static_stiffness)} N/mm"
        return f"Certificate(margin {margin}, smallest at {shown(self.frequency)} rad/s, H(1) {stiffness})"

    @property
    def passive(self) -> Bool[Any, "..."]:
        """Whether passivity is proved: sufficient damping at every frequency, and H(1) >= 0."""
        return (self.lower > 0) & (self.static_stiffness >= 0)

    @property
    def violated(self) -> Bool[Any, "..."]:
        """Whether a violation is proved: too little damping at `frequency`, or H(1) < 0."""
        return (self.upper <= 0) | (self.static_stiffness < 0)

    @property
    def status(self) -> str:
        """Result for one set: "passive" or "violated" if proved, else "undecided": the margin is 0 within rounding."""
        return "passive" if self.passive else "violated" if self.violated else "undecided"


class Witness(eqx.Module):
    """Cycle that creates energy: `x` (mm) at its n + 1 samples, forces (N) of the first n, energies (mJ).

    Each force is constant for T from `delay` (s) after its sample, when x is `bend` (mm); x is linear in between.
    """

    force: Float[np.ndarray, " n"]
    x: Float[np.ndarray, " n+1"]
    bend: Float[np.ndarray, " n"]
    frequency: float  # rad/s; a cycle may contain several periods
    lost: float  # dissipated in the device's damping, >= 0
    energy: float  # absorbed by device and rendering together, < 0
    delay: float


def needed_damping(
    model: FOSLS, omega: Real[ArrayLike, "*w"], *, delay: Real[ArrayLike, ""] = 0.0
) -> Float[Array, "*w"]:
    """Damping (N·s/m) needed for passivity at each ω in [0, π/T] (rad/s); may be negative.

    At ω = 0 it is the limit, which is H(1)·T/2 - B_eff without `delay`. `delay`: from a sample of the position to its
    force, s. `omega` of any shape -> the same shape. Raises `InputError` for a delay outside 0 to T.
    """
    late = check_delay(delay, model.T)
    angle = jnp.asarray(omega, model.K0.dtype) * model.T
    moving = angle > 0
    safe = jnp.where(moving, angle, 1)
    response = model.frequency_response(safe / model.T)
    # tan, not cot: at π the cotangent is 0 and the tangent only large.
    stiffness = response.real - response.imag / jnp.tan(safe / 2)
    if not late:
        return jnp.where(moving, 500 * model.T * stiffness, 500 * model.T * model.dc_gain() - model.effective_damping())
    lag, static = delay / model.T, model.dc_gain()
    turned = jnp.cos(safe) * response.real + jnp.sin(safe) * response.imag
    slow = static * (1 + 2 * lag) - model.effective_damping() / (500 * model.T)
    psi = jnp.where(moving, stiffness + 2 * lag * turned, slow)
    square = jnp.where(moving, response.real**2 + response.imag**2, static**2)
    return 500 * model.T * larger_root(psi, lag * (1 - lag) * square)


def certify(model: FOSLS, b: Real[ArrayLike, ""], *, delay: Real[ArrayLike, ""] = 0.0) -> Certificate:
    """Certify whether the rendering is passive on a device with physical damping `b` (N·s/m); `jax.vmap` for several.

    `delay`: from a sample of the position to its force, s, 0 to T. For any N. With full memory and a delay the bounds
    are an estimate to a relative 1e-6, not proved. Not differentiable: see `minimum_damping`, and `needed_damping` at
    the certificate's frequency. `b` is a scalar, as is every number of the certificate. For a model of NumPy numbers it
    is computed by NumPy. Raises `InputError` for a `b` below 0 and for a delay outside its range.
    """
    if concrete(b) and not np.all(np.asarray(b) >= 0):
        raise InputError(f"b is {shown(b)}; the damping of a device is 0 or above, in N.s/m.")
    late = check_delay(delay, model.T)
    host = model.memory == "short" and on_host(model.K0, model.K1, model.B1, model.alpha) and concrete(delay)
    dtype = model.K0.dtype
    if not late:
        return _certificate(model, np.asarray(b, dtype)) if host else _certify(model, b)
    if host:
        return _late_certificate(model, np.asarray(b, dtype), np.asarray(delay, dtype))
    return _certify_late(model, jnp.asarray(b, dtype), jnp.asarray(delay, dtype))


@program
def _certify(model: FOSLS, b: Real[ArrayLike, ""]) -> Certificate:
    """Compute the certificate without delay in JAX."""
    return _certificate(jax.lax.stop_gradient(model), jnp.asarray(b, model.K0.dtype))


@program
def _certify_late(model: FOSLS, b: Scalar, delay: Scalar) -> Certificate:
    """Compute the certificate with delay in JAX."""
    return _late_certificate(jax.lax.stop_gradient(model), b, jax.lax.stop_gradient(delay))


def _certificate(model: FOSLS, b: Number) -> Certificate:
    """Certificate without delay, in NumPy or JAX as the model's numbers."""
    enclose = _full_enclosure if model.memory == "full" else _short_enclosure
    return _with_margin(model, b, *enclose(model))


def _late_certificate(model: FOSLS, b: Number, delay: Number) -> Certificate:
    """Certificate with a delay (s), in NumPy or JAX as the model's numbers."""
    enclose = full_estimate if model.memory == "full" else short_enclosure
    return _with_margin(model, b, *enclose(model, delay / model.T))


def _with_margin(model, b, low, high, angle) -> Certificate:
    """Certificate from bounds `low`, `high` (N/mm) of max φ or Y and the angle of the maximum."""
    scale = 500 * model.T
    return Certificate(b - scale * high, b - scale * low, model.dc_gain(), angle / model.T)


def _full_enclosure(model: FOSLS) -> tuple[Scalar, Scalar, Scalar]:
    """Lower and upper bound of max φ (N/mm) for full memory: the value at the Nyquist frequency -/+ its rounding error.

    Third the angle of the maximum, π.
    """
    stiffness = model.high_frequency_gain()
    error = 4 * jnp.finfo(stiffness.dtype).eps * stiffness
    return stiffness - error, stiffness + error, jnp.asarray(jnp.pi, stiffness.dtype)


def _short_enclosure(model: FOSLS) -> tuple[Number, Number, Number]:
    """Lower and upper bound of max φ (N/mm) over all angles, and the angle of the maximum found; for short memory."""
    A, B, least_A, *_ = parts_of(model)
    xp = namespace_of(A)
    cells = cells_for(model.N)
    width = math.pi / cells
    value = on_grid(rows(B, 1), cells)[0] / on_grid(rows(A, 1), cells)[0]  # φ - K0
    best = xp.argmax(value)
    peak = climb(partial(_ratio, A, B), model.N, best.astype(A.dtype) * width, width)
    largest = xp.maximum(value[best], _ratio(A, B, peak)[0])

    rounding = rounding_unit(A) * (xp.sum(xp.abs(A)) * xp.abs(largest) + xp.sum(xp.abs(B)))
    lowest = least((largest + 4 * rounding) * A - B, cells, best, peak) - rounding
    high = largest + 4 * rounding + xp.maximum(-lowest, 0) / least_A
    return model.K0 + largest - 4 * rounding, model.K0 + high, peak


def _ratio(A: Coefficients, B: Coefficients, angle: Number) -> tuple[Number, Number, Number]:
    """B/A at an angle, and slope and second derivative of value·A - B for this value, per 1/N; for `climb`."""
    a, b = (at_angles(rows(p, 3), angle[None])[:, 0] for p in (A, B))
    value = b[0] / a[0]
    return value, value * a[1] - b[1], 2 * (value * a[2] - b[2])


def witness(model: FOSLS, b: float, *, delay: float = 0.0) -> Witness | None:
    """Construct a motion that creates energy with a rendering whose damping `b` (N·s/m) `certify` proves too low.

    None if the damping is not proved too low, also for a set that only violates H(1) >= 0: that needs no cycle, since
    pulled slowly from x = 0 to x it releases ½·|H(1)|·x². `delay` in s; x has amplitude 1 mm. For full memory too.
    Raises `InputError` as `certify`.
    """
    certificate = certify(model, b, delay=delay)
    if not bool(certificate.upper <= 0):
        return None
    angle = float(certificate.frequency) * model.T
    turns = Fraction(angle / (2 * math.pi)).limit_denominator(_LONGEST_CYCLE)
    n = turns.denominator
    y = np.exp(2j * np.pi * turns.numerator / n * np.arange(n))
    # Driven by the spring-pot's elongation y: x and F follow from it without a transient.
    pot = float(model.beta) * _fractional(model, y)
    compliance = 0.0 if math.isinf(model.K1) else 1 / float(model.K1)
    x = y + compliance * pot
    force = float(model.K0) * x + pot
    scale = np.exp(-1j * np.angle(x[0])) / np.abs(x[0])
    x, force = (x * scale).real, (force * scale).real
    x = np.append(x, x[0])
    frequency = 2 * math.pi * float(turns) / model.T
    if delay:
        return _late_witness(model, b, delay, force, x, frequency, b - float(certificate.upper))
    lost = b / 1000 / model.T * np.sum(np.diff(x) ** 2)
    return Witness(force, x, x[:-1], frequency, lost, lost + np.sum(force * np.diff(x)), delay)


def _late_witness(model, b, delay, force, x, frequency, needed) -> Witness:
    """Witness with a delay: the cycle whose bends lose least in the damping `needed` (N·s/m) by the set.

    With less damping, such as `b`, the same cycle creates even more energy. `force` (n,) N, `x` (n + 1,) mm.
    """
    before = np.roll(force, 1)
    mean, change = np.diff(x) / model.T, (force - before) / (2 * needed / 1000)  # mm/s
    rest = model.T - delay
    first, second = mean + rest / model.T * change, mean - delay / model.T * change
    lost = b / 1000 * np.sum(delay * first**2 + rest * second**2)
    energy = lost + np.sum(before * delay * first + force * rest * second)
    return Witness(force, x, x[:-1] + delay * first, frequency, lost, energy, delay)


def _fractional(model: FOSLS, y: Complex[np.ndarray, " n"]) -> Complex[np.ndarray, " n"]:
    """Σ c_i y_{n-i} of one period y (n,) of a periodic signal, by the taps or the exponentials of the model."""
    if model.memory == "short":
        c = np.asarray(gl_coefficients(model.alpha, model.N))
        return sum((c[i] * np.roll(y, i) for i in range(len(c))), np.zeros_like(y))
    weight, loss = (np.asarray(value)[:, None] for value in exponentials(model.alpha, model.states))
    # m_n = loss·Σ_{i>=1} λ^{i-1} y_{n-i}, over one period and its repetitions.
    n = len(y)
    powers = (1 - loss) ** np.arange(n)
    mean = sum(powers[:, [i]] * np.roll(y, i + 1)[None, :] for i in range(n)) * loss / (1 - (1 - loss) ** n)
    return y - np.sum(weight * mean, axis=0)
