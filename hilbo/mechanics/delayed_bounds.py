"""Damping needed by a delayed rendering, and the largest K1 of a device: maximum of Y (`delay`) over all frequencies.

The maximum of Y lies at the Nyquist frequency for very short delays only and has no closed form: it is searched on a
grid of frequencies, then refined by a parabola. `certify` proves it for one set at a time; `ESTIMATED` is the error of
the search.

The largest K1 is found by an exchange algorithm, from above: the frequency that needs most damping, then the K1 at
which it needs the device's damping, and so on. A fraction `SAFE` of the damping is kept in reserve.

Units: K N/mm, B1 N·s^α/mm, T and delay s, damping N·s/m.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from hilbo.mechanics.delay import clear_of_spring, larger_root
from hilbo.mechanics.fosls import pot_stiffness, share
from hilbo.mechanics.memory import GLSums, gl_coefficients, response, sums
from hilbo.mechanics.ranges import Scalar
from hilbo.mechanics.span import Span

__all__ = ["ESTIMATED", "SAFE", "delayed_damping", "delayed_largest_K1", "largest_need"]

SAFE = 1e-5
"""Fraction of b that `delayed_largest_K1` keeps in reserve: more than the error of the maximum between nodes."""
ESTIMATED = 1e-6
"""Relative error of the maximum of Y: 1e-9 with full memory, 1e-6 with short memory of 101 taps."""

_NODES_PER_TAP = 4
_LEAST_NODES = 256
_NODES_OF_FULL_MEMORY = 512
_FINER = 16  # divisor of the node spacing for the parabola at the peak
_ROUNDS = 20  # of the exchange at most; 4 to 6 are typical
_HALVINGS = 40  # of the interval of K1/(K1 + β)


class _Order(NamedTuple):
    """Order α with its memory and the sums of its coefficients."""

    alpha: Scalar
    sums: GLSums
    span: Span


class _Nodes(NamedTuple):
    """Frequencies, with the quantities there that depend on α alone.

    Real and imaginary parts separate for vectorisation.
    """

    cos: Float[Array, " n"]
    sin: Float[Array, " n"]
    real: Float[Array, " n"]  # of C
    imag: Float[Array, " n"]
    lead: Float[Array, " n"]  # cot(θ/2)·Im C, which is 2·M1 at θ = 0


class _Material(NamedTuple):
    """Parameters of a rendering except C.

    K0 + series(K1, βC) = K_eff + β·slow·g·(C - S)/(g + h·C), g = K1/(K1 + β) = 1 - h.
    """

    K_eff: Scalar
    beta: Scalar
    S: Scalar
    g: Scalar
    h: Scalar
    slow: Scalar  # K1/(K1 + β·S)


def delayed_damping(
    span: Span, K1: Scalar, B1: Scalar, alpha: Scalar, K_eff: Scalar, T: Scalar, delay: Scalar
) -> Scalar:
    """Smallest passive damping b_min (N·s/m) with a delay (s), to a relative `ESTIMATED`.

    inf where `K_eff` < 0, NaN for a `delay` above T.
    """
    lag = _lag(delay, T)
    need, _ = largest_need(span, K1, pot_stiffness(B1, alpha, T), alpha, K_eff, lag)
    return jnp.where(K_eff < 0, jnp.inf, 500 * T * need)


def _lag(delay: Scalar, T: Scalar) -> Scalar:
    """σ = delay/T; NaN for a delay above T."""
    return jnp.where(delay <= T, delay / T, jnp.nan)


def largest_need(
    span: Span, K1: Scalar, beta: Scalar, alpha: Scalar, K_eff: Scalar, lag: Scalar
) -> tuple[Scalar, Scalar]:
    """Maximum of Y (N/mm) over all frequencies, and its angle in [0, π]; `lag` is σ.

    `beta` in N/mm. First derivatives are exact, second ones are those at the fixed angle.
    """
    order = _order(span, alpha)
    rendering = _material(K1, beta, order, K_eff)
    fixed, fixed_lag, (fixed_alpha, fixed_sums) = jax.lax.stop_gradient((rendering, lag, (alpha, order.sums)))
    fixed_order = _Order(fixed_alpha, fixed_sums, span)
    angle = _peak(fixed_order, _grid(fixed_order), fixed, fixed_lag)
    # At the maximum, first derivatives of Y do not depend on the derivative of the angle.
    return _need(rendering, _at(order, angle[None]), lag)[0], angle


def delayed_largest_K1(
    span: Span, B1: Scalar, alpha: Scalar, b: Scalar, K_eff: Scalar, T: Scalar, delay: Scalar
) -> Scalar:
    """Largest K1 (N/mm) that needs at most the damping b with a delay; it needs at least b·(1 - 2·SAFE).

    inf where every K1 is passive, 0 where b is below `least_damping`. First derivatives are exact, second ones are
    those at the binding frequency.
    """
    lag = _lag(delay, T)
    Y, beta, order = b / (500 * T) * (1 - SAFE), pot_stiffness(B1, alpha, T), _order(span, alpha)
    impossible = (clear_of_spring(K_eff, lag) > Y) | (K_eff < 0)
    K1, angle, unlimited = _solved(span, ~impossible, *jax.lax.stop_gradient((beta, alpha, Y, K_eff, lag)))
    limited = ~impossible & ~unlimited
    K1, nodes = jnp.where(limited, K1, 1), _at(order, jnp.where(limited, angle, 1)[None])

    def need(K1):
        return _need(_material(K1, beta, order, K_eff), nodes, lag)[0]

    # A step of Newton's method from the solution has the solution's derivatives.
    value, slope = jax.jvp(need, (K1,), (jnp.ones_like(K1),))
    K1 = K1 - (value - Y) / jax.lax.stop_gradient(slope)
    nan_or_0 = jnp.where(jnp.isnan(lag), jnp.nan, 0)
    return nan_or_0 + jnp.where(impossible, 0, jnp.where(unlimited, jnp.inf, K1))


def _solved(span, active, beta, alpha, Y, K_eff, lag):
    """Solve for the largest K1 by exchange, from above.

    Returns K1 (N/mm; NaN if the rounds are exhausted), the binding angle, and whether every K1 is passive. If `active`
    is False nothing is searched, and every K1 counts as passive. `Y`: the damping of the device in N/mm; `lag`: of
    `_lag`.
    """
    order = _order(span, alpha)
    grid, S = _grid(order), order.sums.at_dc
    tolerance = max(SAFE / 4, 32 * float(jnp.finfo(beta.dtype).eps))

    def of(g):
        return _Material(K_eff, beta, S, g, 1 - g, g / (g + (1 - g) * S))

    def reduced(g, node):
        """The g' <= g at which the need at a frequency reaches Y, by bisection."""

        def halve(_, ends):
            middle = (ends[0] + ends[1]) / 2
            more = _need(of(middle), node, lag)[0] > Y
            return jnp.where(more, ends[0], middle), jnp.where(more, middle, ends[1])

        return jax.lax.fori_loop(0, _HALVINGS, halve, (jnp.zeros_like(g), g))[1]

    def exchange(carry):
        count, g, _, _ = carry
        angle = _peak(order, grid, of(g), lag)
        node = _at(order, angle[None])
        more = _need(of(g), node, lag)[0] > Y * (1 + tolerance)
        return count + 1, jnp.where(more, reduced(g, node), g), angle, more

    def unfinished(carry):
        return carry[3] & (carry[0] < _ROUNDS)

    start = 0, jnp.ones_like(beta), jnp.ones_like(beta), active
    _, g, angle, more = jax.lax.while_loop(unfinished, exchange, start)
    return jnp.where(more, jnp.nan, beta * g / (1 - g)), angle, g == 1


def _order(span: Span, alpha: Scalar) -> _Order:
    """Order α with its memory and the sums of its coefficients."""
    return _Order(alpha, sums(alpha, span), span)


def _material(K1, beta, order: _Order, K_eff) -> _Material:
    """Parameters of a rendering; K1 = 0 or β = 0 is the spring K_eff alone."""
    S = order.sums.at_dc
    # A spring alone: β = 0, for any K1.
    beta = jnp.where(K1 > 0, beta, 0)
    alone = beta == 0
    g, h = jnp.where(alone, 1, share(K1, beta)), jnp.where(alone, 0, share(beta, K1))
    return _Material(K_eff, beta, S, g, h, share(K1, beta * S))


def _need(m: _Material, nodes: _Nodes, lag: Scalar) -> Float[Array, " n"]:
    """Y (N/mm) at each frequency; `lag` is σ."""
    square = (m.g + m.h * nodes.real) ** 2 + (m.h * nodes.imag) ** 2
    size = m.beta * m.g / square
    # (C - S)·conj(g + h·C); the imaginary part is (g + h·S)·Im C, and g/slow = g + h·S.
    along = (nodes.real - m.S) * (m.g + m.h * nodes.real) + m.h * nodes.imag**2
    real, imaginary = m.K_eff + size * m.slow * along, size * m.g * nodes.imag
    psi = real - size * m.g * nodes.lead + 2 * lag * (nodes.cos * real + nodes.sin * imaginary)
    return larger_root(psi, lag * (1 - lag) * (real**2 + imaginary**2))


def _angle_of(span: Span, t: Float[Array, "*a"]) -> Float[Array, "*a"]:
    """Angle in [0, π] of the grid parameter t in [0, 1]: uniform for short memory, denser near 0 for full memory."""
    return math.pi * (t if span.memory == "short" else t**3)


def _count(span: Span) -> int:
    """Number of grid intervals from 0 to π."""
    if span.memory == "full":
        return _NODES_OF_FULL_MEMORY
    return max(_LEAST_NODES, 2 ** math.ceil(math.log2(_NODES_PER_TAP * (span.N + 1))))


def _grid(order: _Order) -> _Nodes:
    """Nodes from 0 to π, uniform in the grid parameter."""
    span, count = order.span, _count(order.span)
    angle = _angle_of(span, jnp.arange(count + 1, dtype=order.alpha.dtype) / count)
    if span.memory == "full":
        return _at(order, angle)
    return _nodes(order, angle, jnp.fft.rfft(gl_coefficients(order.alpha, span.N), 2 * count))


def _at(order: _Order, angle: Float[Array, " n"]) -> _Nodes:
    """Nodes at arbitrary angles."""
    return _nodes(order, angle, response(order.alpha, angle, order.span))


def _nodes(order: _Order, angle: Float[Array, " n"], C: Complex[Array, " n"]) -> _Nodes:
    """Nodes from angles and the values of C there."""
    moving = angle > 0
    lead = jnp.where(moving, C.imag / jnp.tan(jnp.where(moving, angle, 1) / 2), 2 * order.sums.moment)
    return _Nodes(jnp.cos(angle), jnp.sin(angle), C.real, C.imag, lead)


def _peak(order: _Order, grid: _Nodes, m: _Material, lag: Scalar) -> Scalar:
    """Angle of the maximum of Y: by parabolas through neighbouring nodes of the `grid`, then through closer points."""
    Y, count = _need(m, grid, lag), grid.real.shape[0] - 1
    # Y is even about both ends.
    below, above = jnp.concatenate([Y[1:2], Y[:-1]]), jnp.concatenate([Y[1:], Y[-2:-1]])
    top, shift = _vertex(below, Y, above)
    best = jnp.argmax(top)
    t, step = (best.astype(Y.dtype) + shift[best]) / count, 1 / (_FINER * count)
    near = jnp.abs(t + step * jnp.arange(-1.0, 2.0, dtype=t.dtype))
    _, shift = _vertex(*_need(m, _at(order, _angle_of(order.span, near)), lag))
    return _angle_of(order.span, jnp.clip(t + shift * step, 0, 1))


def _vertex(
    below: Float[Array, "*a"], middle: Float[Array, "*a"], above: Float[Array, "*a"]
) -> tuple[Float[Array, "*a"], Float[Array, "*a"]]:
    """Vertex of the parabola through three equidistant values: its height, and its offset from the middle in steps.

    The middle value and 0 if the vertex is a minimum or more than half a step away.
    """
    bend, slope = 2 * middle - below - above, (above - below) / 2
    inside = 2 * jnp.abs(slope) <= bend
    shift = jnp.where(inside, slope / jnp.where(inside & (bend > 0), bend, 1), 0)
    return middle + slope * shift / 2, shift
