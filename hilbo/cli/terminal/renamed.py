"""Options that had another name: one sentence with the new one, in place of "no such option"."""

from collections.abc import Sequence

from hilbo.errors import InputError

__all__ = ["check_renamed"]

_RENAMED = {
    "aggregate": {"--participants": "--names", "--devices": "--cores"},
    "device": {"--name": "--set"},
    "identify": {"--compare": "--compare-memory", "--no-compare": "--no-compare-memory"},
    "init": {"--device": "--by device"},
    "plan": {"--trials": "--table"},
    "session": {"--gap": "--pause"},
    "simulate": {"--seconds": "--step-seconds"},
}
"""Command -> earlier name of an option -> its name."""


def check_renamed(arguments: Sequence[str]) -> None:
    """Raise `InputError` if the arguments of a command line contain the earlier name of an option of its command."""
    names = _RENAMED.get(arguments[0], {}) if arguments else {}
    for name in (text.partition("=")[0] for text in arguments[1:]):
        if name in names:
            raise InputError(f"{name} is called {names[name]} now.")
