"""Patterns of column names with braces, for tables that have a column for each trial. Loads no JAX, no pandas."""

import re
from collections.abc import Iterable, Sequence

from hilbo.errors import InputError
from hilbo.study.importing.mapping import FILE

__all__ = ["STIMULUS", "TRIAL", "braces", "filled", "is_pattern", "matches", "runs_of_digits"]

TRIAL, STIMULUS = "trial", "stimulus"
_BRACES = re.compile(r"\{([^\W\d]\w*)\}")
_NUMBER = r"-?\d+(?:[.,]\d+)?"


def is_pattern(column: str, columns: Iterable[str]) -> bool:
    """Whether a column of a mapping is a pattern: it has a name in braces, and is none of the table's `columns`."""
    return column != FILE and _BRACES.search(column) is not None and column not in set(columns)


def braces(pattern: str) -> list[str]:
    """The names in braces of a pattern."""
    return _BRACES.findall(pattern)


def matches(pattern: str, names: Iterable[str], numeric: Sequence[str]) -> dict[str, dict[str, str]]:
    """The names of columns that a pattern matches, in their order: column -> name in braces -> text. `numeric`: names
    in braces that stand for numbers; others stand for any text. Raises `InputError` for a name that occurs twice."""
    parts, keys = _BRACES.split(pattern)[::2], _BRACES.findall(pattern)
    if len(set(keys)) < len(keys):
        raise InputError(f'columns: "{pattern}" has a name in braces twice; leave one out.')
    groups = [rf"(?P<{key}>{_NUMBER if key in (*numeric, TRIAL) else '.+'})" for key in keys]
    texts = [re.escape(part) for part in parts]
    whole = re.compile("".join(text + group for text, group in zip(texts, [*groups, ""], strict=True)))
    return {name: match.groupdict() for name in names if (match := whole.fullmatch(name))}


def filled(pattern: str, values: dict[str, str]) -> str:
    """A pattern with the texts of its braces filled in; names without a text stay."""
    return _BRACES.sub(lambda brace: values.get(brace[1], brace[0]), pattern)


def runs_of_digits(names: Sequence[str], key: str) -> dict[str, list[str]]:
    """Patterns that at least two of the names share, with `{key}` in place of one run of digits: pattern -> names. Each
    run of digits of a name is tried."""
    shared: dict[str, list[str]] = {}
    for name in names:
        for run in re.finditer(r"\d+", name):
            shared.setdefault(f"{name[: run.start()]}{{{key}}}{name[run.end() :]}", []).append(name)
    return {pattern: members for pattern, members in shared.items() if len(members) > 1}
