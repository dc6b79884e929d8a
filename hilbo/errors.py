"""The one exception that means "the person who gave this input can fix it", and the one warning about an input."""

__all__ = ["InputError", "InputRemark"]


def __dir__() -> list[str]:
    return __all__


class InputError(ValueError):
    """Bad input from outside: a study file, a table, an argument.

    The message is one sentence that says what is wrong, where it is (file and line, or the key's path), and what
    to do about it. The command line prints it as it stands and ends with exit code 2.
    """


class InputRemark(UserWarning):
    """How an input was understood where it could be understood otherwise: one sentence, with the place."""
