"""Memory of a sampled model: number of past samples (short memory), or of exponentials that replace them (full memory).

Imports no JAX, so that study files and devices can specify a memory without it.
"""

from typing import Literal, NamedTuple

from hilbo.errors import InputError

__all__ = ["STATES", "Memory", "Span", "span"]

Memory = Literal["short", "full"]
STATES = (8, 10, 12)
"""Supported numbers of exponentials."""


class Span(NamedTuple):
    """Memory of a model: `N` taps (short memory), or `states` exponentials (full memory)."""

    memory: Memory
    N: int
    states: int


def span(memory: Memory, N: int, states: int = 10) -> Span:
    """Check the memory of a model and return it, with the number that does not apply set to 0, to avoid recompilation.

    Raises InputError for an unknown memory, N below 1 (short), and a number of states not in `STATES` (full).
    """
    if memory not in ("short", "full"):
        raise InputError(f'memory is {memory!r}; it must be "short" (N taps) or "full" (exponentials).')
    if memory == "short" and N < 1:
        raise InputError(f"N is {N}; it must be at least 1: the number of past samples in the sum.")
    if memory == "full" and states not in STATES:
        raise InputError(f"states is {states}; it must be one of {', '.join(map(str, STATES))}.")
    return Span("short", N, 0) if memory == "short" else Span("full", 0, states)
