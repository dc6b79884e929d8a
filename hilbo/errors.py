"""The one exception that means "the person who gave this input can fix it", and the one warning about an input."""

import sys
import warnings

__all__ = ["InputError", "InputRemark", "warn_caller"]

_INSIDE = {"hilbo", "equinox", "jaxtyping", "beartype"}  # between the user's line and the place that warns


def __dir__() -> list[str]:
    return __all__


class InputError(ValueError):
    """Bad input from outside: a study file, a table, an argument.

    The message is one sentence that says what is wrong, where it is (file and line, or the key's path), and what
    to do about it. The command line prints it as it stands and ends with exit code 2.
    """


class InputRemark(UserWarning):
    """How an input was understood where it could be understood otherwise: one sentence, with the place."""


def warn_caller(sentence: str) -> None:
    """An `InputRemark` that names the user's own line: the nearest one outside hilbo and what wraps its functions."""
    level, frame = 1, sys._getframe()
    while frame.f_back and frame.f_globals.get("__name__", "").partition(".")[0] in _INSIDE:
        level, frame = level + 1, frame.f_back
    warnings.warn(InputRemark(sentence), stacklevel=level)
