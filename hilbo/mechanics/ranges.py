"""Valid ranges of model and device parameters: an error for known values, NaN for traced ones."""

import functools
import operator
from typing import Any

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Real

from hilbo.errors import InputError
from hilbo.numerics.shown import concrete, shown

__all__ = ["RANGES", "Coefficients", "Floats", "Number", "Reals", "Scalar", "check_ranges", "possible"]

Reals = Real[ArrayLike, "..."]
"""A number or an array of numbers; several broadcast against each other."""
Scalar = Float[Array, ""]
"""A floating-point number of JAX."""
Number = Float[Any, ""]
"""A floating-point number of JAX or NumPy."""
Floats = Float[Any, "..."]
"""Floating-point numbers of JAX or NumPy, elementwise."""
Coefficients = Float[Any, " n"]
"""Coefficients (n,) of a polynomial, of JAX or NumPy."""

_FROM_0 = (lambda v: v >= 0, "0 or above")
_FINITE = (lambda v: (v >= 0) & (v < np.inf), "0 or above, and finite")
RANGES = {
    "alpha": (lambda v: (v > 0) & (v <= 1), "above 0 and at most 1: the order of the fractional element"),
    "T": (lambda v: (v > 0) & (v < np.inf), "a number of seconds above 0"),
    "t": _FROM_0,
    "K0": _FROM_0,  # with full memory, where it is the static stiffness
    "K1": _FROM_0,
    "B1": _FINITE,
    "b": _FROM_0,
    "delay": _FINITE,
}
"""Name -> elementwise test of the values, and the requirement in words."""


def check_ranges(**values: Reals) -> None:
    """Raise `InputError` for the first value outside the range of its name (`RANGES`); traced values are not checked.

    NaN is outside every range. Values are numbers or arrays.
    """
    for name, value in values.items():
        allowed, words = RANGES[name]
        if concrete(value) and not np.all(fine := allowed(np.asarray(value, float))):
            wrong = np.asarray(value, float)[~fine][0] if np.ndim(value) else value
            raise InputError(f"{name} is {shown(wrong)}; it must be {words}.")


def possible(**values: Any) -> Bool[Array, "..."]:
    """Whether all values are within the ranges of their names (`RANGES`), elementwise; also for traced values."""
    return functools.reduce(operator.and_, (RANGES[name][0](value) for name, value in values.items()))
