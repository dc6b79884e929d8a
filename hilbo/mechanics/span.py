"""How far a sampled model looks back: past samples (short memory), or exponentials that stand for all of them (full).

Loads no JAX: study files and devices name a memory where nothing is computed.
"""

from typing import Literal, NamedTuple

__all__ = ["STATES", "Memory", "Span", "span"]

Memory = Literal["short", "full"]
STATES = (8, 10, 12)
"""Numbers of exponentials to choose from."""


class Span(NamedTuple):
    """How far a model looks back: `N` taps (short memory), or `states` exponentials (full memory)."""

    memory: Memory
    N: int
    states: int


def span(memory: Memory, N: int, states: int = 10) -> Span:
    """The memory of a model, checked. The number that does not apply is 0, so that it compiles nothing anew."""
    if memory not in ("short", "full"):
        raise ValueError(f'memory is {memory!r}; it must be "short" (N taps) or "full" (exponentials).')
    if memory == "short" and N < 1:
        raise ValueError(f"N is {N}; it must be at least 1: the number of past samples in the sum.")
    if memory == "full" and states not in STATES:
        raise ValueError(f"states is {states}; it must be one of {', '.join(map(str, STATES))}.")
    return Span("short", N, 0) if memory == "short" else Span("full", 0, states)
