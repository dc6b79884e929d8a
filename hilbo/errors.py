"""The exception for invalid input that the user can correct, and the warning about ambiguous input."""

import sys
import warnings

__all__ = ["InputError", "InputRemark", "warn_caller"]

_INSIDE = {"hilbo", "equinox", "jaxtyping", "beartype"}  # packages whose frames are skipped


def __dir__() -> list[str]:
    return __all__


class InputError(ValueError):
    """Bad input from outside: a study file, a table, an argument.

    The message is one sentence with the place (file and line, or the key's path), the error, and the remedy.
    The command line prints it and ends with exit code 2.
    """


class InputRemark(UserWarning):
    """Warning about how an ambiguous input was interpreted: one sentence, with the place."""


def warn_caller(sentence: str) -> None:
    """Issue an `InputRemark` with this message, attributed to the nearest caller outside hilbo, equinox, jaxtyping and
    beartype; to the outermost frame if there is none.
    """
    level, frame = 1, sys._getframe()
    while frame.f_back and frame.f_globals.get("__name__", "").partition(".")[0] in _INSIDE:
        level, frame = level + 1, frame.f_back
    warnings.warn(InputRemark(sentence), stacklevel=level)
