"""Digits of numbers on pages: as many as the uncertainty allows, which has two significant ones.

Files have every digit.
"""

import math
from collections.abc import Mapping

import numpy as np

from hilbo.search.rendering import K0_range
from hilbo.study.config import Study

__all__ = ["decimals", "parameter_text", "parameter_texts", "rounded"]

_SHARE = 0.02  # of a search range: taken as the uncertainty of a parameter of which none is known


def decimals(spread: float) -> int:
    """Number of decimals with which an uncertainty `spread`, above 0, has two significant digits; 0 from 10 on."""
    return max(0, 1 - math.floor(math.log10(spread)))


def rounded(value: float, spread: float) -> str:
    """A number as text with the `decimals` of its uncertainty `spread`; four significant digits where that is 0 or
    not finite. "–" for NaN.
    """
    if np.isnan(value):
        return "–"
    if spread > 0 and np.isfinite(spread):
        return f"{value:.{decimals(spread)}f}"
    return np.format_float_positional(value, precision=4, unique=False, fractional=False, trim="-")


def parameter_text(study: Study, name: str, value: float | str, spread: float = math.nan) -> str:
    """A value of a parameter (or of K0) in its unit as text, without the unit: levels by name, whole numbers whole,
    others with the digits of their uncertainty `spread`; without one, 2 % of the range is taken. "–" for NaN.
    """
    if isinstance(value, str):
        return value
    parameter = next((p for p in study.space.parameters if p.name == name), None)
    if parameter is not None and parameter.discrete:
        return "–" if np.isnan(value) else np.format_float_positional(float(f"{value:.12g}"), trim="-")
    if np.isfinite(spread) and spread > 0:
        log = parameter is not None and parameter.scale == "log" and value > 0
        return rounded(value, min(spread, value) if log else spread)  # two digits of the value at least
    if parameter is None:
        return rounded(value, _SHARE * K0_range(study.space))
    if parameter.scale == "log":
        return rounded(value, _SHARE * math.log(parameter.high / parameter.low) * value)
    return rounded(value, _SHARE * (parameter.high - parameter.low))


def parameter_texts(study: Study, parameters: Mapping[str, float | str]) -> list[str]:
    """The texts of a stimulus's parameters (name -> value), as of `parameter_text`."""
    return [parameter_text(study, name, value) for name, value in parameters.items()]
