"""A standard normal confined to an interval: its mass and cumulants, exact in both tails and for every derivative.

For y = f + noise * e, e ~ N(0, 1), between two edges, z = (y - f) / noise is a standard normal truncated to (a, b),

    a = (lower - f) / noise,   b = (upper - f) / noise,   p = Phi(b) - Phi(a).

Seen as a function of f, log p is the cumulant generating function of y confined to its interval, so that every
derivative is a cumulant k_n of z:

    d log p / df = k_1 / noise,     -d2 log p / df2 = (1 - k_2) / noise^2,     d3 log p / df3 = k_3 / noise^3,

and the derivatives with respect to the edges are the densities there, phi(b) / p and phi(a) / p. These six numbers are
closed under differentiation (moving an edge changes a truncated moment by edge density times moment difference).
`truncated_normal` computes them without cancellation and its derivative rule is written in terms of them, so
`jax.grad` of any order meets no floor, no clamp and no 0/0. Reflection makes l + u >= 0 for the edges l < u; then

* narrow intervals: Gauss-Legendre sums of positive terms, relative to the density at the middle;
* l >= 0, the tail: everything from the excess hazard phi(z)/Q(z) - z (`hilbo.numerics.normal`);
* l < 0, the centre: log p = log1p(-(Q(-l) + Q(u))), so that a certain answer keeps all digits of its tiny log p.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hilbo.numerics.normal import HALF_LOG_2PI, excess_hazard
from hilbo.numerics.tracing import traced_once

__all__ = ["TruncatedNormal", "confined_normal", "truncated_normal"]

# An interval is narrow below this width, and below this product of width and distance from the middle of the bell.
_NARROW_WIDTH, _NARROW_PRODUCT = 1.0, 4.0
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)
_GONE = 40.0  # exp(-z^2 / 2) is 0 there in float64


def confined_normal(
    mean: Float[Array, ""], lower: Float[Array, ""], upper: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Log mass of N(mean, 1) between two edges, shift of the mean, and reduction of the variance by the truncation.

    Edges may be infinite. The shift (truncated mean - `mean`) is also the first derivative of the log mass in `mean`;
    the reduction (1 - variance) is minus the second.
    """
    truncated = truncated_normal(mean, lower, upper, jnp.ones_like(mean))
    return truncated.log_mass, truncated.mean, truncated.curvature


class TruncatedNormal(NamedTuple):
    """A standard normal confined to (a, b): log of its mass, edge densities over mass, and cumulants."""

    log_mass: Float[Array, ""]
    density_lower: Float[Array, ""]  # phi(a) / p
    density_upper: Float[Array, ""]  # phi(b) / p
    mean: Float[Array, ""]  # k_1
    curvature: Float[Array, ""]  # 1 - k_2, in [0, 1]
    skew: Float[Array, ""]  # k_3


@jax.custom_jvp
@traced_once
def truncated_normal(
    f: Float[Array, ""], lower: Float[Array, ""], upper: Float[Array, ""], noise: Float[Array, ""]
) -> TruncatedNormal:
    """Log mass, edge densities and cumulants of a standard normal on ((lower - f)/noise, (upper - f)/noise).

    All arguments are scalars, with lower < upper; edges may be infinite. Differentiable to any order.
    """
    a, b = _standardise(lower, f, noise), _standardise(upper, f, noise)
    mirrored = sum(a) + sum(b) < 0
    low = _Standard(*(jnp.where(mirrored, -v, u) for u, v in zip(a, b, strict=True)))
    high = _Standard(*(jnp.where(mirrored, -u, v) for u, v in zip(a, b, strict=True)))
    bounded = ~jnp.isinf(high.short)
    width = jnp.where(bounded, (upper - lower) / noise, jnp.inf)
    middle = 0.5 * ((low.short + high.short) + (low.rest + high.rest))
    product = jnp.where(bounded, width * jnp.where(bounded, middle, 0.0), jnp.inf)
    narrow = (width <= _NARROW_WIDTH) & (product <= _NARROW_PRODUCT)
    wide_width, wide_product = jnp.where(narrow, 1.0, width), jnp.where(narrow, 1.0, product)
    far_out = _Edges(jnp.abs(sum(low)), jnp.abs(sum(high)))
    excess = _Edges(*excess_hazard(jnp.stack(far_out)))  # once for both: it is most of the work
    regimes = (
        _narrow(middle, jnp.where(narrow, width, 1.0), jnp.where(narrow, product, 0.0)),
        _tail(far_out, excess, wide_width, wide_product),
        _centre(low, far_out, excess, wide_width, wide_product),
    )
    in_tail = low.short + low.rest >= 0
    conditions = narrow, ~narrow & in_tail
    reflected = TruncatedNormal(*(_choose(conditions, values) for values in zip(*regimes, strict=True)))
    return TruncatedNormal(
        reflected.log_mass,
        jnp.where(mirrored, reflected.density_upper, reflected.density_lower),
        jnp.where(mirrored, reflected.density_lower, reflected.density_upper),
        jnp.where(mirrored, -reflected.mean, reflected.mean),
        reflected.curvature,
        jnp.where(mirrored, -reflected.skew, reflected.skew),
    )


@truncated_normal.defjvp
@traced_once
def _derivatives(primals: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple[TruncatedNormal, TruncatedNormal]:
    """Derivative rule (JVP) of `truncated_normal`: its output, and the output's tangent in terms of the output.

    `primals`, `tangents`: of f, lower, upper and noise. Derivations in docs/design.md, "Ordinal likelihood".
    """
    f, lower, upper, noise = primals
    out = truncated_normal(f, lower, upper, noise)
    # An infinite edge has density 0 and does not move; f replaces it so that no 0 * inf arises, at any order.
    a = (jnp.where(jnp.isinf(lower), f, lower) - f) / noise
    b = (jnp.where(jnp.isinf(upper), f, upper) - f) / noise
    shift = tangents[0] / noise
    da = jnp.where(jnp.isinf(lower), 0.0, tangents[1] - a * tangents[3]) / noise
    db = jnp.where(jnp.isinf(upper), 0.0, tangents[2] - b * tangents[3]) / noise
    gained, lost = out.density_upper * db, out.density_lower * da
    x, y = a - out.mean, b - out.mean
    variance = 1.0 - out.curvature
    d_mass = out.mean * shift + gained - lost

    def moved(at_lower, at_upper):
        """Change of a truncated moment as its edges move; `at_*` is its excess at the edge."""
        return gained * at_upper - lost * at_lower

    def shifted(at_lower, at_upper):
        """The same when f moves, which shifts both edges by -df / noise."""
        return shift * (out.density_lower * at_lower - out.density_upper * at_upper)

    third = (x**3 - out.skew - 3.0 * variance * x, y**3 - out.skew - 3.0 * variance * y)
    d_out = TruncatedNormal(
        d_mass,
        out.density_lower * (a * (shift - da) - d_mass),
        out.density_upper * (b * (shift - db) - d_mass),
        moved(x, y) - out.curvature * shift,
        -moved(x**2 - variance, y**2 - variance) - out.skew * shift,
        moved(*third) + shifted(*third),
    )
    return out, d_out


def _choose(
    conditions: tuple[Bool[Array, ""], Bool[Array, ""]],
    values: tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]],
) -> Float[Array, ""]:
    """Value of the first regime whose condition is true, else the third."""
    return jnp.where(conditions[0], values[0], jnp.where(conditions[1], values[1], values[2]))


class _Edges(NamedTuple):
    """A quantity at the lower and the upper edge, such as their distances from 0 or the excess hazards there."""

    low: Float[Array, ""]
    high: Float[Array, ""]


class _Standard(NamedTuple):
    """A standardised edge to twice the working precision: short is a multiple of 1/16 (or infinite), rest small."""

    short: Float[Array, ""]
    rest: Float[Array, ""]


def _standardise(edge: Float[Array, ""], f: Float[Array, ""], noise: Float[Array, ""]) -> _Standard:
    """(edge - f) / noise as a short number and its exact remainder; an infinite edge gives itself and 0.

    In the far tail p ~ exp(-z^2 / 2) turns a relative rounding error e of z into e * z^2 of p; the short number has an
    exact square, and the remainder enters to first order.
    """
    finite = ~jnp.isinf(edge)
    edge_ = jnp.where(finite, edge, f)
    difference = edge_ - f
    back = difference - edge_
    lost = (edge_ - (difference - back)) + (-f - back)  # Knuth's two-sum
    short = jnp.round(difference / noise * 16.0) / 16.0
    splitter = 2.0 ** ((jnp.finfo(f.dtype).nmant + 2) // 2) + 1.0
    scaled = noise * splitter
    head = scaled - (scaled - noise)  # Veltkamp's split: short * head is exact
    rest = (((difference - short * head) - short * (noise - head)) + lost) / noise
    return _Standard(jnp.where(finite, short, edge), jnp.where(finite, rest, 0.0))


def _narrow(middle: Float[Array, ""], width: Float[Array, ""], product: Float[Array, ""]) -> TruncatedNormal:
    """The truncated normal of a narrow interval, over which the density changes by a bounded factor.

    `middle` and `width` of the standardised interval; `product` = width * middle.
    """
    steps = 0.5 * width * jnp.asarray(_NODES, middle.dtype)
    heights = jnp.asarray(_WEIGHTS, middle.dtype) * 0.5 * jnp.exp(-middle * steps - 0.5 * steps**2)
    height = jnp.sum(heights)
    share = heights / height
    offset = jnp.sum(share * steps)
    centred = steps - offset
    edge = jnp.exp(-0.125 * width**2) / (width * height)
    return TruncatedNormal(
        jnp.log(width * height) - 0.5 * middle**2 - HALF_LOG_2PI,
        edge * jnp.exp(0.5 * product),
        edge * jnp.exp(-0.5 * product),
        middle + offset,
        1.0 - jnp.sum(share * centred**2),
        jnp.sum(share * centred**3),
    )


def _tail(edges: _Edges, excesses: _Edges, width: Float[Array, ""], product: Float[Array, ""]) -> TruncatedNormal:
    """The truncated normal for 0 <= low: p = Q(low) (1 - R), E = phi(high) / phi(low), R = Q(high) / Q(low).

    `edges`: low and high; `excesses`: the excess hazards there; `width` = high - low; `product` = width * middle, which
    is -log E.
    """
    (low, high), (excess, excess_high) = edges, excesses
    hazard = low + excess
    bounded = ~jnp.isinf(high)
    falloff = jnp.exp(-product)
    gap = jnp.where(bounded, (width + excess_high - excess) / (jnp.where(bounded, high, 1.0) + excess_high), 1.0)
    remaining = 1.0 - falloff * (1.0 - gap)  # 1 - R = 1 - E (1 - gap), gap = 1 - hazard(low) / hazard(high)
    offset = (excess * (1.0 - falloff) - low * falloff * gap) / remaining  # mean - low
    far = falloff * hazard / remaining
    return TruncatedNormal(
        -0.5 * low**2 - HALF_LOG_2PI - jnp.log(hazard) + jnp.log(remaining),
        hazard / remaining,
        far,
        *_cumulants(low + offset, offset, far, jnp.where(bounded, width, 0.0)),
    )


def _centre(
    low: _Standard, edges: _Edges, excesses: _Edges, width: Float[Array, ""], product: Float[Array, ""]
) -> TruncatedNormal:
    """The truncated normal for low < 0 <= high and -low <= high: log p = log1p(-outside), outside = Q(-low) + Q(high).

    `edges`: |low| and high; `excesses`: the excess hazards there; `width` = high - low; `product` = width * middle.
    """
    short, rest = jnp.abs(low.short), jnp.where(low.short < 0, -low.rest, low.rest)
    rest = jnp.where(short < _GONE, rest, 0.0)  # farther out the density is 0, and the second factor would be infinite
    density = jnp.exp(-0.5 * short**2) * jnp.exp(-rest * (short + 0.5 * rest) - HALF_LOG_2PI)
    bounded = ~jnp.isinf(edges.high)
    hazard = edges.low + excesses.low
    hazard_high = jnp.where(bounded, edges.high, 1.0) + excesses.high
    falloff = jnp.exp(-product)  # density(high) / density(low): relative, so that neither underflows before its time
    outside = density / hazard * (1.0 + falloff * hazard / hazard_high)
    near = density / (1.0 - outside)
    far = falloff * near
    mean = near * -jnp.expm1(-product)  # not low + (mean - low): a certain answer keeps the digits of its small slope
    log_mass = jnp.where(outside > 0.25, jnp.log(1.0 - outside), jnp.log1p(-outside))  # XLA's log1p errs near -0.4
    return TruncatedNormal(log_mass, near, far, *_cumulants(mean, mean - sum(low), far, jnp.where(bounded, width, 0.0)))


def _cumulants(
    mean: Float[Array, ""], offset: Float[Array, ""], far: Float[Array, ""], width: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Mean, 1 - variance (a sum of non-negative terms) and third cumulant of a truncated normal.

    `offset`: mean - low; `far`: density at the upper edge over the mass; `width` = high - low, 0 if high is infinite.
    """
    curvature = mean * offset + width * far
    skew = curvature * offset - mean * (1.0 - curvature) - width * far * (width - offset)
    return mean, curvature, skew
