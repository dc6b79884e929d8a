"""Linear constraints as people write them on a command line: `a + 2*b <= 3`, `0 <= a - b <= 1`, `a + b = 1`."""

import json
import re
from collections.abc import Sequence

from hilbo.errors import InputError
from hilbo.search.box import Constraint

__all__ = ["constraint_of"]

_NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_EXAMPLE = '"a + 2*b <= 3", "0 <= a - b <= 1" or "a + b = 1"'


def constraint_of(text: str, names: Sequence[str]) -> Constraint:
    """Parse a linear constraint on the parameters `names`, such as "a + 2*b <= 3".

    Sums of weighted parameters and numbers, compared by <= or >= once, or twice with numbers at both ends, or by =.
    Raises `InputError`.
    """
    by_length = sorted(names, key=len, reverse=True)  # of "a" and "a b" the longer one is meant
    known = "|".join(re.escape(name) for name in by_length)
    sides = re.split("(<=|>=|=)", text)
    sums = [_sum(text, side, names, known) for side in sides[::2]]
    if len(sides) not in (3, 5) or len(set(sides[1::2])) > 1 or not any(weights for weights, _ in sums):
        raise _not_understood(text)
    if sides[1] == "=":
        return _equality(text, sums)
    low, *middle, high = sums if sides[1] == "<=" else sums[::-1]
    if middle:
        weights, number = middle[0]
        if low[0] or high[0]:
            raise _not_understood(text)
        return Constraint(tuple(weights.items()), low[1] - number, high[1] - number)
    if not low[0]:
        return Constraint(tuple(high[0].items()), low[1] - high[1], None)
    both = {name: low[0].get(name, 0.0) - high[0].get(name, 0.0) for name in {**low[0], **high[0]}}
    return Constraint(tuple(both.items()), None, high[1] - low[1])


def _equality(text: str, sums: list[tuple[dict[str, float], float]]) -> Constraint:
    """The equality of two sides, each its weights and its number. Raises InputError for more than two sides."""
    if len(sums) != 2:
        raise _not_understood(text)
    left, right = sums if sums[0][0] else sums[::-1]
    both = {name: left[0].get(name, 0.0) - right[0].get(name, 0.0) for name in {**left[0], **right[0]}}
    return Constraint(tuple(both.items()), right[1] - left[1], right[1] - left[1])


def _sum(text: str, side: str, names: Sequence[str], known: str) -> tuple[dict[str, float], float]:
    """Parse one side of a constraint; returns the weight of each parameter in it, and the sum of its numbers.

    `text`: whole constraint, for messages; `known`: regular expression of the parameters' names. Raises InputError.
    """
    term = re.compile(rf"\s*([+-]?)\s*(?:(?:({_NUMBER})\s*\*?\s*)?({known})(?!\w)|({_NUMBER})(?![\w.]))\s*")
    weights: dict[str, float] = {}
    number, at = 0.0, 0
    while at < len(side) or not at:
        read = term.match(side, at)
        if read is None or (at and not read[1]):
            raise _unknown(text, names, known) or _not_understood(text)
        sign = -1.0 if read[1] == "-" else 1.0
        if read[3] is None:
            number += sign * float(read[4])
        else:
            weights[read[3]] = weights.get(read[3], 0.0) + sign * float(read[2] or 1)
        at = read.end()
    return weights, number


def _unknown(text: str, names: Sequence[str], known: str) -> InputError | None:
    """The error for a word of the constraint that is no parameter; None if there is no such word. Returned, not
    raised."""
    left = re.sub(rf"(?<!\w)(?:{_NUMBER}\s*)?(?:{known})(?!\w)|(?<![\w.]){_NUMBER}", " ", text)
    word = re.search(r"[^\W\d][\w.]*", left)
    if word is None:
        return None
    return InputError(
        f"--constraint {json.dumps(text, ensure_ascii=False)} names {word[0]}, which is no parameter of the study;"
        f" those are {', '.join(names)}."
    )


def _not_understood(text: str) -> InputError:
    """The error for a constraint that cannot be parsed. Returned, not raised."""
    return InputError(
        f"--constraint is {json.dumps(text, ensure_ascii=False)}; write a sum of parameters and its bound,"
        f" for example {_EXAMPLE}."
    )
