"""Tail of the normal distribution, to rounding accuracy: the special function on which the likelihood is built.

With phi the density and Q the upper tail, the hazard phi(z) / Q(z) is z plus an excess that falls from 0.8 at 0 to 1/z.
The excess is a smooth function of (z - 4) / (z + 4) on [-1, 1]; its Chebyshev series gives tails, Mills ratios and
truncated moments for every z >= 0 without cancellation, in float64 and float32. Reference: Shepherd & Laframboise
(1981), Math. Comp. 36:249, who expand exp(x^2) erfc(x) in the same way.
"""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

__all__ = ["HALF_LOG_2PI", "excess_hazard"]

HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)
# Chebyshev coefficients in t = (z - 4) / (z + 4) of (z + 1) * (phi(z) / Q(z) - z), from 40-digit arithmetic
# (tests/numerics/test_normal.py computes them again).
_EXCESS_HAZARD = (
    1.0168805564426282,
    0.06385599300140679,
    -0.11509035595355087,
    0.038934029049955285,
    -0.003347370576381033,
    -0.0017736338770155734,
    0.00054076040973986,
    3.902404417582679e-05,
    -4.402617067828808e-05,
    2.7612076544288964e-06,
    2.8674097969311685e-06,
    -4.995282519092665e-07,
    -1.5806245994487862e-07,
    4.938482308086009e-08,
    7.114472972821824e-09,
    -3.943344498242817e-09,
    -2.0992695898584107e-10,
    2.7542478232219564e-10,
    -3.29156814387016e-12,
    -1.716164405777426e-11,
    1.201559505276977e-12,
    9.424312178713976e-13,
    -1.279271190378952e-13,
    -4.29654024129139e-14,
    1.0402939865135318e-14,
    1.2728811508716543e-15,
    -7.396596377340524e-16,
    2.530671679501365e-17,
    4.8478954579590156e-17,
    -8.222875764646372e-18,
)


def excess_hazard(z: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Excess hazard phi(z) / Q(z) - z for z >= 0, with a relative error of a few eps; 0 at infinity."""
    t = 1.0 - 8.0 / (z + 4.0)
    last, previous = jnp.zeros_like(t), jnp.zeros_like(t)
    for coefficient in _EXCESS_HAZARD[:0:-1]:
        last, previous = coefficient + 2.0 * t * last - previous, last
    return (_EXCESS_HAZARD[0] + t * last - previous) / (z + 1.0)
