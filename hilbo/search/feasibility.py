"""Feasible parameter sets: passivity on the device and effective damping, and the K1 that they allow given B1 and α.

A parameter set is passive for K1 up to `passivity.largest_K1`, without delay and at the device's delay. With a range of
effective damping B_eff there is a lowest K1 too: B_eff = 1000·T·β·M1·(K1/(K1 + β·S))² rises with K1 from 0 to
1000·T·β·M1, so that the range is an interval of K1: with r² = B_eff/(1000·T·β·M1), its ends are K1 = β·S·r/(1 - r),
infinite for r >= 1.

The search keeps the margin `SEARCH_MARGIN` to the device's damping, so that a device that checks passivity again in
float32 never refuses a proposal.
"""

import functools
import math
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Real

from hilbo import passivity, viscoelastic
from hilbo.mechanics.delay import least_damping
from hilbo.mechanics.fosls import pot_stiffness
from hilbo.mechanics.memory import sums
from hilbo.mechanics.span import Span, span
from hilbo.search.box import Constraint, Mechanics, Parameter
from hilbo.search.linear import MARGIN

__all__ = [
    "SEARCH_MARGIN",
    "K0_of",
    "K1_interval",
    "K1_range",
    "allowed",
    "balanced",
    "keeps",
    "largest_K1",
    "minimum_damping",
    "passive",
]

SEARCH_MARGIN = 1e-3
"""The search uses the damping b·(1 - SEARCH_MARGIN)."""
# The search puts points on the boundary; rounding, which differs from one compilation to the next, must not refuse
# them.
_ROUNDING = 64
_SUM_ROUNDING = 8  # units of eps
_EQUAL = 1e-9
_Batch = Float[Array, "*batch"]
_Physical = Mapping[str, Real[ArrayLike, "..."]]


def allowed(m: Mechanics, physical: _Physical) -> Bool[Array, "..."]:
    """Whether parameter sets are passive with the search margin, and within the range of effective damping, if any.

    `physical`: parameter -> values in its unit, of one shape; so is the result.
    """
    if m.effective_damping is None:
        return passive(m, physical)
    low, high = m.effective_damping
    damping = viscoelastic.effective_damping(*_model_parameters(physical), m.N, m.T, memory=m.memory, states=m.states)
    slack = 4 * _slack(physical)
    return passive(m, physical) & (low * (1 - slack) <= damping) & (damping <= high * (1 + slack))


def passive(m: Mechanics, physical: _Physical) -> Bool[Array, "..."]:
    """Whether parameter sets are passive with the search margin (`SEARCH_MARGIN`), to rounding.

    With a delay, the damping must also be at least `delay.least_damping`, below which no K1 is feasible.
    """
    b = m.damping * (1 - SEARCH_MARGIN)
    enough = minimum_damping(m, physical) <= b * (1 + _slack(physical))
    return enough if m.delay == 0 else enough & (least_damping(m.K_eff, m.T, m.delay) <= b)


def _slack(physical: _Physical) -> float:
    """Relative tolerance for rounding: a multiple of eps of the parameters' dtype."""
    return _ROUNDING * float(jnp.finfo(jnp.result_type(1.0, *_model_parameters(physical))).eps)


def minimum_damping(m: Mechanics, physical: _Physical) -> Float[Array, "..."]:
    """Smallest device damping (N·s/m) for which parameter sets are passive at delays from 0 to the study's; no margin.

    `physical`: parameter -> values in its unit, of one shape; so is the result. The needed damping first falls with the
    delay and then rises, so the larger value at both ends is sufficient.
    """
    place = *_model_parameters(physical), m.K_eff, m.N, m.T
    prompt = passivity.minimum_damping(*place, memory=m.memory)
    if m.delay == 0:
        return prompt
    return jnp.maximum(prompt, passivity.minimum_damping(*place, memory=m.memory, delay=m.delay))


def K0_of(m: Mechanics, physical: _Physical) -> Float[Array, "..."]:
    """K0 (N/mm) of parameter sets, so that their static stiffness is `m.K_eff`; of the shape of the values."""
    K1, B1, alpha = _model_parameters(physical)
    return viscoelastic.K0_from_effective_stiffness(K1, B1, alpha, m.K_eff, m.N, m.T, memory=m.memory)


def largest_K1(m: Mechanics, B1: _Batch, alpha: _Batch) -> _Batch:
    """Largest K1 (N/mm) that is passive with the search margin, without delay and at the study's delay.

    inf if every K1 is passive, 0 if none is.
    """
    place = B1, alpha, m.damping * (1 - SEARCH_MARGIN), m.K_eff, m.N, m.T
    prompt = passivity.largest_K1(*place, memory=m.memory)
    if m.delay == 0:
        return prompt
    return jnp.minimum(prompt, passivity.largest_K1(*place, memory=m.memory, delay=m.delay))


def K1_range(m: Mechanics, B1: _Batch, alpha: _Batch) -> tuple[_Batch, _Batch]:
    """Lowest and highest K1 (N/mm) within the range of effective damping; inf for a damping that no K1 reaches.

    `m` must have a range of effective damping.
    """
    assert m.effective_damping is not None
    memory = span(m.memory, m.N, m.states)
    low, high = (viscoelastic.elementwise(_K1_of, memory, end, B1, alpha, m.T) for end in m.effective_damping)
    return low, high


def keeps(constraint: Constraint, physical: _Physical) -> Bool[Array, "..."]:
    """Whether parameter sets satisfy a linear constraint, to the rounding of its sum.

    `physical`: parameter -> values in its unit, of one shape; so is the result.
    """
    parts = [weight * jnp.asarray(physical[name]) for name, weight in constraint.terms]
    total, size = functools.reduce(jnp.add, parts), functools.reduce(jnp.add, map(jnp.abs, parts))
    slack = _SUM_ROUNDING * jnp.finfo(total.dtype).eps * size
    low = -jnp.inf if constraint.least is None else constraint.least
    high = jnp.inf if constraint.most is None else constraint.most
    return (total >= low - slack) & (total <= high + slack)


def balanced(constraint: Constraint, scale: float, physical: _Physical) -> Bool[Array, "..."]:
    """Whether parameter sets satisfy a linear equality, to 1e-9 of its `scale` (64 eps in single precision).

    `scale`: largest sum of the absolute terms within the ranges; `physical`: parameter -> values in its unit, of one
    shape; so is the result.
    """
    assert constraint.least is not None
    total = functools.reduce(jnp.add, (weight * jnp.asarray(physical[name]) for name, weight in constraint.terms))
    slack = max(_EQUAL, _ROUNDING * float(jnp.finfo(total.dtype).eps))
    return jnp.abs(total - constraint.least) <= slack * scale


def K1_interval(
    m: Mechanics, K1: Parameter, constraints: tuple[Constraint, ...], physical: Mapping[str, _Batch]
) -> tuple[_Batch, _Batch]:
    """Lowest and highest K1 on [0, 1] that effective damping and constraints allow; passivity is left out.

    `physical`: the other parameters -> values in their units; the results have their shape. Each constraint must
    involve K1. The interval is empty if the lowest is above the highest.
    """
    low, high = jnp.zeros_like(physical["B1"]), jnp.ones_like(physical["B1"])
    ends = [] if m.effective_damping is None else [K1_range(m, physical["B1"], physical["alpha"])]
    for first, last in (*ends, *(_within(constraint, K1, physical) for constraint in constraints)):
        low = jnp.maximum(low, K1.to_unit(jnp.clip(first, K1.low, K1.high)))
        high = jnp.minimum(high, K1.to_unit(jnp.clip(last, K1.low, K1.high)))
    return low, high


def _within(constraint: Constraint, K1: Parameter, physical: Mapping[str, _Batch]) -> tuple[_Batch, _Batch]:
    """Lowest and highest K1 (N/mm) allowed by a constraint on it, narrowed by a margin for rounding at both ends.

    `physical`: the other parameters -> values in their units. An end that is not limited is infinite.
    """
    terms, none = dict(constraint.terms), jnp.zeros_like(physical["B1"])
    weight, margin = terms.pop("K1"), MARGIN * (K1.high - K1.low)
    others = functools.reduce(jnp.add, (each * physical[name] for name, each in terms.items()), none)
    least, most = (
        none + math.copysign(math.inf, side) if end is None else (end - others) / weight
        for side, end in ((-weight, constraint.least), (weight, constraint.most))
    )
    return jnp.minimum(least, most) + margin, jnp.maximum(least, most) - margin


def _K1_of(
    span: Span, damping: Float[Array, ""], B1: Float[Array, ""], alpha: Float[Array, ""], T: Float[Array, ""]
) -> Float[Array, ""]:
    """K1 (N/mm) with this effective `damping` (N·s/m); inf if no K1 reaches it, 0 for a damping of 0."""
    beta, kernel_sums = pot_stiffness(B1, alpha, T), sums(alpha, span)
    square = damping / (1000 * T * beta * kernel_sums.moment)
    possible = (square > 0) & (square < 1)
    share = jnp.sqrt(jnp.where(possible, square, 0.25))
    K1 = beta * kernel_sums.at_dc * share / (1 - share)
    return jnp.where(possible, K1, jnp.where(square > 0, jnp.inf, 0))


def _model_parameters(physical: _Physical) -> tuple[Any, Any, Any]:
    """K1, B1 and alpha of a mapping, as a tuple."""
    return physical["K1"], physical["B1"], physical["alpha"]
