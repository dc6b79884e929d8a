"""Ordinal probit likelihood: log p(q | f), its derivatives and class probabilities, exact in both tails.

An answer in category j says that y = f + noise * e, e ~ N(0, 1), fell between two thresholds (paper, section IV-1):

    p(q = j | f) = Phi(b) - Phi(a),   a = (t_{j-1} - f) / noise,   b = (t_j - f) / noise.

Seen as a function of f, log p is the cumulant generating function of y confined to its interval, so that every
derivative is a cumulant k_n of a standard normal z truncated to (a, b):

    d log p / df = k_1 / noise,     -d2 log p / df2 = (1 - k_2) / noise^2,     d3 log p / df3 = k_3 / noise^3,

and the derivatives with respect to the thresholds are the densities at the edges, phi(b) / p and phi(a) / p. These
six numbers are closed under differentiation (moving an edge changes a truncated moment by edge density times moment
difference). `_truncated` computes them without cancellation and its derivative rule is written in terms of them, so
`jax.grad` of any order meets no floor, no clamp and no 0/0. Reflection makes l + u >= 0 for the edges l < u; then

* narrow intervals: Gauss-Legendre sums of positive terms, relative to the density at the middle;
* l >= 0, the tail: everything from the excess hazard phi(z)/Q(z) - z (`hilbo.numerics.normal`);
* l < 0, the centre: log p = log1p(-(Q(-l) + Q(u))), so that a certain answer keeps all digits of its tiny log p.

Reference: Chu & Ghahramani (2005), JMLR 6:1019.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from hilbo.errors import InputError
from hilbo.numerics.normal import HALF_LOG_2PI, excess_hazard
from hilbo.numerics.shown import check_positive, concrete, numbers, shown
from hilbo.numerics.tracing import traced_once

__all__ = ["OrdinalProbit", "confined_normal"]


def __dir__() -> list[str]:
    return __all__


# An interval is narrow below this width, and below this product of width and distance from the middle of the bell.
_NARROW_WIDTH, _NARROW_PRODUCT = 1.0, 4.0
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)


def _rising(thresholds: np.ndarray) -> bool:
    """Whether there is one threshold at least, all are finite, and each is above the one before; for several people."""
    not_empty = thresholds.ndim > 0 and thresholds.shape[-1] > 0
    return bool(not_empty and np.all(np.isfinite(thresholds)) and np.all(np.diff(thresholds) > 0))


class OrdinalProbit(eqx.Module):
    """Ordinal probit likelihood with C = len(thresholds) + 1 categories, lowest first.

    **Arguments:**

    - `thresholds`: C - 1 increasing numbers, in units of the latent f; the outermost categories are unbounded.
    - `noise`: standard deviation c_o > 0 of the classification noise, in units of f.

    Raises `InputError` for thresholds that do not rise and a noise that is not above 0. What is traced is not checked:
    there such values give NaN, never a plausible number.
    """

    thresholds: Float[Array, " edges"]
    noise: Float[Array, ""]

    def __init__(self, thresholds: ArrayLike | Sequence[float], noise: ArrayLike):
        dtype = getattr(thresholds, "dtype", None)
        dtype = dtype if dtype is not None else jnp.result_type(float)
        self.thresholds = numbers("OrdinalProbit", "thresholds", thresholds, dtype)
        self.noise = numbers("OrdinalProbit", "noise", noise, self.thresholds.dtype)
        check_positive("OrdinalProbit", noise=self.noise)
        if concrete(self.thresholds) and not _rising(np.asarray(self.thresholds)):
            given = shown(self.thresholds)
            raise InputError(f"OrdinalProbit: thresholds is {given}; it must be a list of finite numbers that rise.")

    def __repr__(self) -> str:
        return f"OrdinalProbit(thresholds={shown(self.thresholds)}, noise={shown(self.noise)})"

    @property
    def categories(self) -> int:
        """Number C of categories."""
        return self.thresholds.shape[-1] + 1

    def log_prob(self, f: ArrayLike, q: ArrayLike) -> Float[Array, ""]:
        """log p(q | f) for one latent value `f` and one category `q` in 0..C-1.

        Differentiable to any order in `f`, the thresholds and the noise; exact in both tails.
        Both are scalars, and so is the result; `jax.vmap` for several.
        """
        f, lower, upper, noise = self._edges(f, q)
        return _truncated(f, lower, upper, noise).log_mass

    def expand(self, f: ArrayLike, q: ArrayLike) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
        """log p(q | f), its derivative in `f`, and minus its second derivative (in [0, 1 / noise^2]), at one price.

        All are scalars; `jax.vmap` for several.
        """
        f, lower, upper, noise = self._edges(f, q)
        truncated = _truncated(f, lower, upper, noise)
        return truncated.log_mass, truncated.mean / noise, truncated.curvature / noise**2

    def smoothed(
        self, mean: ArrayLike, variance: ArrayLike, q: ArrayLike
    ) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
        """log of the integral of p(q | f) over f ~ N(mean, variance), its derivative in `mean`, and the precision t of
        the Gaussian site with which that normal would get the variance that the answer gives it.

        The integral is the same likelihood with its noise grown to s, s^2 = noise^2 + variance; minus the second
        derivative in `mean` is t / (1 + variance t). With k_2 the variance of the truncated normal,
        t = (1 - k_2) / (noise^2 + variance k_2): never negative, at most 1 / noise^2.
        """
        mean, lower, upper, noise = self._edges(mean, q)
        variance = jnp.asarray(variance, mean.dtype)
        spread = jnp.sqrt(noise**2 + variance)
        truncated = _truncated(mean, lower, upper, spread)
        precision = truncated.curvature / (noise**2 + variance * (1.0 - truncated.curvature))
        return truncated.log_mass, truncated.mean / spread, precision

    def class_probabilities(self, mean: ArrayLike, variance: ArrayLike = 0.0) -> Float[Array, " categories"]:
        """Probabilities (C,) of the categories when f ~ N(mean, variance); they sum to 1 within rounding.

        Paper, section VI: the noise grows to sqrt(noise^2 + variance), and the edges stay.
        """
        mean, variance = jnp.asarray(mean), jnp.asarray(variance)
        blurred = OrdinalProbit(self.thresholds, jnp.sqrt(self.noise**2 + variance.astype(self.noise.dtype)))
        return jnp.exp(jax.vmap(lambda q: blurred.log_prob(mean, q))(jnp.arange(self.categories)))

    def _edges(
        self, f: ArrayLike, q: ArrayLike
    ) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
        """`f`, the two edges of category `q` (infinite at the ends) and the noise, in the dtype of `f`."""
        f = jnp.asarray(f, dtype=self.thresholds.dtype if isinstance(f, int | float) else None)
        ends = jnp.full((1,), jnp.inf, f.dtype)
        edges = jnp.concatenate([-ends, self.thresholds.astype(f.dtype), ends])
        return f, edges[q], edges[q + 1], self.noise.astype(f.dtype)


def confined_normal(
    mean: Float[Array, ""], lower: Float[Array, ""], upper: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """N(mean, 1) between two edges, which may be infinite: log of its mass there, and of what is left, confined, the
    mean's distance from `mean` and 1 - variance; the latter are also the first and minus the second derivative of the
    log mass in `mean`."""
    truncated = _truncated(mean, lower, upper, jnp.ones_like(mean))
    return truncated.log_mass, truncated.mean, truncated.curvature


class _Truncated(NamedTuple):
    """A standard normal confined to (a, b): log of its mass, edge densities over mass, and cumulants."""

    log_mass: Float[Array, ""]
    density_lower: Float[Array, ""]  # phi(a) / p
    density_upper: Float[Array, ""]  # phi(b) / p
    mean: Float[Array, ""]  # k_1
    curvature: Float[Array, ""]  # 1 - k_2, in [0, 1]
    skew: Float[Array, ""]  # k_3


@jax.custom_jvp
@traced_once
def _truncated(
    f: Float[Array, ""], lower: Float[Array, ""], upper: Float[Array, ""], noise: Float[Array, ""]
) -> _Truncated:
    """The truncated normal of a latent value and an interval; all arguments scalars, edges may be infinite."""
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
    reflected = _Truncated(*(_choose(conditions, values) for values in zip(*regimes, strict=True)))
    return _Truncated(
        reflected.log_mass,
        jnp.where(mirrored, reflected.density_upper, reflected.density_lower),
        jnp.where(mirrored, reflected.density_lower, reflected.density_upper),
        jnp.where(mirrored, -reflected.mean, reflected.mean),
        reflected.curvature,
        jnp.where(mirrored, -reflected.skew, reflected.skew),
    )


@_truncated.defjvp
@traced_once
def _truncated_jvp(primals: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple[_Truncated, _Truncated]:
    """Each output's derivative in terms of the outputs; derivations in docs/design.md, "Ordinal likelihood"."""
    f, lower, upper, noise = primals
    out = _truncated(f, lower, upper, noise)
    # An infinite edge has density 0 and does not move; f stands in for it so that no 0 * inf arises, at any order.
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
    d_out = _Truncated(
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
    """The first value where the first condition holds, the second where the second does, else the third."""
    return jnp.where(conditions[0], values[0], jnp.where(conditions[1], values[1], values[2]))


class _Edges(NamedTuple):
    """Something at each of the edges, whose sizes are what the tail and the centre go by."""

    low: Float[Array, ""]
    high: Float[Array, ""]


class _Standard(NamedTuple):
    """A standardised edge to twice the working precision: short is a multiple of 1/16 (or infinite), rest small."""

    short: Float[Array, ""]
    rest: Float[Array, ""]


def _standardise(edge: Float[Array, ""], f: Float[Array, ""], noise: Float[Array, ""]) -> _Standard:
    """(edge - f) / noise as a short number and its exact remainder.

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


def _narrow(middle: Float[Array, ""], width: Float[Array, ""], product: Float[Array, ""]) -> _Truncated:
    """Intervals over which the density changes by a bounded factor; `product` = width * middle."""
    steps = 0.5 * width * jnp.asarray(_NODES, middle.dtype)
    heights = jnp.asarray(_WEIGHTS, middle.dtype) * 0.5 * jnp.exp(-middle * steps - 0.5 * steps**2)
    height = jnp.sum(heights)
    share = heights / height
    offset = jnp.sum(share * steps)
    centred = steps - offset
    edge = jnp.exp(-0.125 * width**2) / (width * height)
    return _Truncated(
        jnp.log(width * height) - 0.5 * middle**2 - HALF_LOG_2PI,
        edge * jnp.exp(0.5 * product),
        edge * jnp.exp(-0.5 * product),
        middle + offset,
        1.0 - jnp.sum(share * centred**2),
        jnp.sum(share * centred**3),
    )


def _tail(edges: _Edges, excesses: _Edges, width: Float[Array, ""], product: Float[Array, ""]) -> _Truncated:
    """0 <= low: p = Q(low) (1 - R), with E = phi(high) / phi(low) and R = Q(high) / Q(low)."""
    (low, high), (excess, excess_high) = edges, excesses
    hazard = low + excess
    bounded = ~jnp.isinf(high)
    falloff = jnp.exp(-product)
    gap = jnp.where(bounded, (width + excess_high - excess) / (jnp.where(bounded, high, 1.0) + excess_high), 1.0)
    remaining = 1.0 - falloff * (1.0 - gap)  # 1 - R = 1 - E (1 - gap), gap = 1 - hazard(low) / hazard(high)
    offset = (excess * (1.0 - falloff) - low * falloff * gap) / remaining  # mean - low
    far = falloff * hazard / remaining
    return _Truncated(
        -0.5 * low**2 - HALF_LOG_2PI - jnp.log(hazard) + jnp.log(remaining),
        hazard / remaining,
        far,
        *_cumulants(low + offset, offset, far, jnp.where(bounded, width, 0.0)),
    )


def _centre(
    low: _Standard, edges: _Edges, excesses: _Edges, width: Float[Array, ""], product: Float[Array, ""]
) -> _Truncated:
    """low < 0 <= high, -low <= high: the mass outside is a sum of tails, so log p = log1p(-outside) is precise."""
    short, rest = jnp.abs(low.short), jnp.where(low.short < 0, -low.rest, low.rest)
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
    return _Truncated(log_mass, near, far, *_cumulants(mean, mean - sum(low), far, jnp.where(bounded, width, 0.0)))


def _cumulants(
    mean: Float[Array, ""], offset: Float[Array, ""], far: Float[Array, ""], width: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Mean, 1 - variance (a sum of non-negative terms) and third cumulant; `width` is 0 where `far` is."""
    curvature = mean * offset + width * far
    skew = curvature * offset - mean * (1.0 - curvature) - width * far * (width - offset)
    return mean, curvature, skew
