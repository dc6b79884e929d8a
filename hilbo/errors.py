"""The one exception that means "the person who gave this input can fix it"."""

__all__ = ["InputError"]


class InputError(ValueError):
    """Bad input from outside: a study file, a table, an argument.

    The message is one sentence that says what is wrong, where it is (file and line, or the key's path), and what
    to do about it. The command line prints it as it stands and ends with exit code 2.
    """
