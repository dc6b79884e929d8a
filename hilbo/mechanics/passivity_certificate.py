"""Is a parameter set passive on a device? A certificate without gaps between frequencies; a motion that proves a no.

With θ = ωT a rendering needs the damping (T/2)·φ(θ), φ = Re H - cot(θ/2)·Im H, and H(1) >= 0. Let g = K1/(K1 + β),
h = 1 - g, k = K1·β/(K1 + β), and V = Re C - cot(θ/2)·Im C = S_N - 2·Σ_{j=1..N} (S_{j-1} - S_N)·cos jθ. Then

    p = (Y - φ)·A = (Y - K0)·A - B,   A = |g + h·C|² >= (g + h·S_N)² > 0,   B = k·(g·V + h·|C|²)

is a cosine polynomial of degree N, finite for every K1 from 0 to inf. Where p >= 0 everywhere, the damping (T/2)·Y is
enough. Around each of many angles Taylor's formula, with a remainder from the size of the coefficients, bounds p''
from below on the cell, and so p by a parabola. Towards the largest φ the cells shrink in proportion to their distance
from it, so that the bound is sharp to rounding. The result is an enclosure of the smallest passive damping, for even N
as well as odd.

With full memory the Nyquist frequency binds (docs/methods/mechanics.md), and b_min is closed.

A violation is shown in time. The path between samples that loses least in the device's damping is straight, and the
force is held, so that a cycle takes up the energy Σ F_n·Δx_n + b·Δx_n²/T: negative if it creates energy.

Units: damping N·s/m, ω rad/s, x mm, F N, energy mJ (N·mm). Reference: Colgate and Schenkel (1997), J. Robotic Syst. 14,
37-47.
"""

import math
from fractions import Fraction
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Complex, Float, Real

from hilbo.errors import InputError
from hilbo.mechanics.exponentials import exponentials
from hilbo.mechanics.fosls import FOSLS, series, share
from hilbo.mechanics.memory import gl_coefficients
from hilbo.numerics.host import namespace_of, on_host, scan
from hilbo.numerics.shown import concrete, shown
from hilbo.numerics.tracing import program

__all__ = ["Certificate", "Witness", "certify", "needed_damping", "witness"]

_ORDER = 8  # of Taylor's formula
_CELLS_PER_TAP = 8
_LEAST_CELLS = 48
_RINGS = 28
_ROUNDING = 16  # units in the last place of Σ |p_j|
_LONGEST_CYCLE = 4096  # samples


class Certificate(eqx.Module):
    """What `certify` knows: bounds of the margin b - b_min, the static stiffness, and where the margin is smallest."""

    lower: Float[Any, ""]  # N·s/m
    upper: Float[Any, ""]  # N·s/m
    static_stiffness: Float[Any, ""]  # H(1), N/mm
    frequency: Float[Any, ""]  # rad/s

    def __repr__(self) -> str:
        margin, stiffness = f"{shown(self.lower)} to {shown(self.upper)} N.s/m", f"{shown(self.static_stiffness)} N/mm"
        return f"Certificate(margin {margin}, smallest at {shown(self.frequency)} rad/s, H(1) {stiffness})"

    @property
    def passive(self) -> Bool[Any, "..."]:
        """Proved: enough damping at every frequency, and H(1) >= 0."""
        return (self.lower > 0) & (self.static_stiffness >= 0)

    @property
    def violated(self) -> Bool[Any, "..."]:
        """Proved: too little damping at `frequency`, or H(1) < 0."""
        return (self.upper <= 0) | (self.static_stiffness < 0)

    @property
    def status(self) -> str:
        """One word, for one set: passive, violated, or undecided where the margin is 0 to rounding."""
        return "passive" if self.passive else "violated" if self.violated else "undecided"


class Witness(eqx.Module):
    """A cycle that creates energy: `x` (mm) at its n + 1 samples, forces (N) held after the first n, energies (mJ)."""

    force: Float[np.ndarray, " n"]
    x: Float[np.ndarray, " n+1"]
    frequency: float  # rad/s; a cycle may hold several periods of it
    lost: float  # in the device's damping, >= 0
    energy: float  # taken up by device and rendering together, < 0


def needed_damping(model: FOSLS, omega: Real[ArrayLike, "*w"]) -> Float[Array, "*w"]:
    """The damping (N·s/m) that passivity asks for at each ω in [0, π/T] (rad/s); at 0 the limit H(1)·T/2 - B_eff.

    `omega` of any shape -> the same shape.
    """
    angle = jnp.asarray(omega, model.K0.dtype) * model.T
    moving = angle > 0
    safe = jnp.where(moving, angle, 1)
    response = model.frequency_response(safe / model.T)
    # tan, not cot: at π the cotangent is 0 and the tangent only large.
    stiffness = response.real - response.imag / jnp.tan(safe / 2)
    return jnp.where(moving, 500 * model.T * stiffness, 500 * model.T * model.dc_gain() - model.effective_damping())


def certify(model: FOSLS, b: Real[ArrayLike, ""]) -> Certificate:
    """Whether the rendering is passive on a device with physical damping `b` (N·s/m); `jax.vmap` for several.

    For any N. Not differentiable: see `minimum_damping`, and `needed_damping` at the certificate's frequency.
    `b` is a scalar; so is every number of the certificate. Of a model of NumPy's numbers it is computed by NumPy.
    Raises `InputError` for a `b` below 0.
    """
    if concrete(b) and not np.all(np.asarray(b) >= 0):
        raise InputError(f"b is {shown(b)}; the damping of a device is 0 or above, in N.s/m.")
    host = model.memory == "short" and on_host(model.K0, model.K1, model.B1, model.alpha)
    return _certificate(model, np.asarray(b, model.K0.dtype)) if host else _certify(model, b)


@program
def _certify(model: FOSLS, b: Real[ArrayLike, ""]) -> Certificate:
    return _certificate(jax.lax.stop_gradient(model), jnp.asarray(b, model.K0.dtype))


def _certificate(model: FOSLS, b: Float[Any, ""]) -> Certificate:
    enclose = _full_enclosure if model.memory == "full" else _short_enclosure
    low, high, angle = enclose(model)
    scale = 500 * model.T
    return Certificate(b - scale * high, b - scale * low, model.dc_gain(), angle / model.T)


def _full_enclosure(model: FOSLS) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """As `_short_enclosure`, for full memory: the Nyquist frequency binds, and only rounding is open."""
    stiffness = model.high_frequency_gain()
    error = 4 * jnp.finfo(stiffness.dtype).eps * stiffness
    return stiffness - error, stiffness + error, jnp.asarray(jnp.pi, stiffness.dtype)


def _short_enclosure(model: FOSLS) -> tuple[Float[Any, ""], Float[Any, ""], Float[Any, ""]]:
    """Bounds of max φ over all angles, and the angle of the largest φ found."""
    A, B, least = _polynomials(model)
    xp = namespace_of(A)
    cells = 2 ** math.ceil(math.log2(_CELLS_PER_TAP * model.N + _LEAST_CELLS))
    width = math.pi / cells
    value = _on_grid(_rows(B, 1), cells)[0] / _on_grid(_rows(A, 1), cells)[0]  # φ - K0
    best = xp.argmax(value)
    peak = _climb(A, B, best.astype(A.dtype) * width, width)
    largest = xp.maximum(value[best], _ratio(A, B, peak)[0])

    rounding = _ROUNDING * xp.finfo(A.dtype).eps * (xp.sum(xp.abs(A)) * xp.abs(largest) + xp.sum(xp.abs(B)))
    p = _rows((largest + 4 * rounding) * A - B, _ORDER + 1)
    beside = xp.abs(xp.arange(cells + 1) - best) <= 1
    cell = _lowest(_on_grid(p, cells), xp.asarray(width / 2, A.dtype), p)
    ring = 2 * width * 0.5 ** xp.arange(_RINGS, dtype=A.dtype)
    centre = xp.concatenate([0.75 * ring, -0.75 * ring, xp.zeros_like(ring[:1])])
    radius = xp.concatenate([0.25 * ring, 0.25 * ring, 0.5 * ring[-1:]])
    near = _lowest(_at_angles(p, peak + centre), radius, p)
    lowest = xp.minimum(xp.min(xp.where(beside, xp.inf, cell)), xp.min(near)) - rounding
    high = largest + 4 * rounding + xp.maximum(-lowest, 0) / least
    return model.K0 + largest - 4 * rounding, model.K0 + high, peak


def _polynomials(model: FOSLS) -> tuple[Float[Any, " n"], Float[Any, " n"], Float[Any, ""]]:
    """Cosine coefficients of A and B, and the least value of A."""
    beta = model.beta
    xp = namespace_of(model.alpha)
    k = series(model.K1, beta)
    g, h = xp.where(k > 0, share(model.K1, beta), 1), xp.where(k > 0, share(beta, model.K1), 0)
    one = xp.ones(1, k.dtype)
    i = xp.arange(1, model.N + 1, dtype=k.dtype)
    partial = xp.concatenate([one, xp.cumprod(1 - model.alpha / i)])  # S_0 ... S_N
    c = xp.concatenate([one, -(model.alpha / i) * partial[:-1]])
    last = partial[-1]
    square = xp.correlate(c, c, mode="full")[model.N :]
    square = xp.concatenate([square[:1], 2 * square[1:]])
    # Re C = Σ c_j cos jθ
    A = h**2 * square + 2 * g * h * c + xp.concatenate([g[None] ** 2, xp.zeros(model.N, k.dtype)])
    V = xp.concatenate([last[None], 2 * (last - partial[:-1])])
    return A, k * (g * V + h * square), (g + h * last) ** 2


def _rows(p: Float[Any, " n"], count: int) -> Float[Any, "{count} n"]:
    """p_j·(j/N)^m/m! for m < `count`: with cos, -sin, -cos, sin of jθ in turn, Taylor terms of p in units of 1/N."""
    xp = namespace_of(p)
    j = xp.arange(p.shape[0], dtype=p.dtype) / (p.shape[0] - 1)
    rows = [p]
    for m in range(1, count):
        rows.append(rows[-1] * j / m)
    return xp.stack(rows)


def _on_grid(rows: Float[Any, "m n"], cells: int) -> Float[Any, "m {cells+1}"]:
    """Taylor terms at the angles πi/cells, i = 0 … cells, as (m, i)."""
    xp = namespace_of(rows)
    turn = xp.asarray([1j**m for m in range(len(rows))], np.result_type(rows.dtype, np.complex64))
    half = xp.concatenate([2 * rows[:, :1], rows[:, 1:]], axis=1).astype(turn.dtype) * turn[:, None]
    return cells * xp.fft.irfft(half, 2 * cells, axis=1)[:, : cells + 1]


def _at_angles(rows: Float[Any, "m n"], angles: Float[Any, " i"]) -> Float[Any, "m i"]:
    """Taylor terms at any angles, as (m, i)."""
    xp = namespace_of(rows, angles)
    turned = xp.arange(rows.shape[1], dtype=angles.dtype)[:, None] * angles[None, :]
    cos, sin = rows @ xp.cos(turned), rows @ xp.sin(turned)
    return xp.stack([(cos[m], -sin[m], -cos[m], sin[m])[m % 4] for m in range(len(rows))])


def _lowest(taylor: Float[Any, "m i"], radius: Float[Any, "..."], rows: Float[Any, "m n"]) -> Float[Any, " i"]:
    """Least value that p can take within `radius` of each angle; the last of the `rows` bounds the remainder."""
    xp = namespace_of(taylor, rows)
    order, scaled = len(rows) - 1, radius * (rows.shape[1] - 1)
    term = [taylor[m] * scaled**m for m in range(order)]
    remainder = xp.sum(xp.abs(rows[order])) * scaled**order
    # Half the second derivative is never less than this, in units of the radius.
    bend = term[2] - sum(math.comb(m, 2) * xp.abs(term[m]) for m in range(3, order)) - math.comb(order, 2) * remainder
    slope = xp.abs(term[1])
    inside = 2 * bend > slope
    return term[0] - xp.where(inside, slope**2 / (4 * xp.where(inside, bend, 1)), slope - bend)


def _ratio(
    A: Float[Any, " n"], B: Float[Any, " n"], angle: Float[Any, ""]
) -> tuple[Float[Any, ""], Float[Any, ""], Float[Any, ""]]:
    """B/A, with the slope and bend of (B/A)·A - B for the number B/A, per 1/N."""
    a, b = (_at_angles(_rows(p, 3), angle[None])[:, 0] for p in (A, B))
    value = b[0] / a[0]
    return value, value * a[1] - b[1], 2 * (value * a[2] - b[2])


def _climb(A: Float[Any, " n"], B: Float[Any, " n"], start: Float[Any, ""], width: float) -> Float[Any, ""]:
    """The angle of the largest B/A within a cell's width of `start`: Newton, kept inside."""
    N = A.shape[0] - 1
    xp = namespace_of(A)
    low, high = xp.maximum(start - width, 0), xp.minimum(start + width, xp.pi)

    def step(angle, _):
        _, slope, bend = _ratio(A, B, angle)
        curved = bend > 0
        return xp.where(curved, xp.clip(angle - slope / xp.where(curved, bend, 1) / N, low, high), angle)

    angle = scan(step, start, xp.arange(8))
    return xp.where(_ratio(A, B, angle)[0] > _ratio(A, B, start)[0], angle, start)


def witness(model: FOSLS, b: float) -> Witness | None:
    """A motion that creates energy with a rendering that `certify` calls violated for lack of damping; None for others.

    x has amplitude 1 mm. For full memory too. A set that is violated by H(1) < 0 alone needs no cycle: drawn slowly
    from x = 0 to x it gives back ½·|H(1)|·x².
    """
    certificate = certify(model, b)
    if not bool(certificate.upper <= 0):
        return None
    angle = float(certificate.frequency) * model.T
    turns = Fraction(angle / (2 * math.pi)).limit_denominator(_LONGEST_CYCLE)
    n = turns.denominator
    y = np.exp(2j * np.pi * turns.numerator / n * np.arange(n))
    # Driven by the pot's elongation y, which may start anywhere: x and F follow from it without a transient.
    pot = float(model.beta) * _fractional(model, y)
    compliance = 0.0 if math.isinf(model.K1) else 1 / float(model.K1)
    x = y + compliance * pot
    force = float(model.K0) * x + pot
    scale = np.exp(-1j * np.angle(x[0])) / np.abs(x[0])
    x, force = (x * scale).real, (force * scale).real
    x = np.append(x, x[0])
    lost = b / 1000 / model.T * np.sum(np.diff(x) ** 2)
    return Witness(force, x, 2 * math.pi * float(turns) / model.T, lost, lost + np.sum(force * np.diff(x)))


def _fractional(model: FOSLS, y: Complex[np.ndarray, " n"]) -> Complex[np.ndarray, " n"]:
    """Σ c_i y_{n-i} of a periodic y, by the taps or the exponentials themselves."""
    if model.memory == "short":
        c = np.asarray(gl_coefficients(model.alpha, model.N))
        return sum((c[i] * np.roll(y, i) for i in range(len(c))), np.zeros_like(y))
    weight, loss = (np.asarray(value)[:, None] for value in exponentials(model.alpha, model.states))
    # m_n = loss·Σ_{i>=1} λ^{i-1} y_{n-i}, over one period and its repetitions.
    n = len(y)
    powers = (1 - loss) ** np.arange(n)
    mean = sum(powers[:, [i]] * np.roll(y, i + 1)[None, :] for i in range(n)) * loss / (1 - (1 - loss) ** n)
    return y - np.sum(weight * mean, axis=0)
