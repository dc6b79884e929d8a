"""Counterbalanced orders: Williams designs for materials, balanced pairs for comparisons, and random assignment of
participants to materials; all from a seed.

A *Williams design* of n treatments is a set of orders in which every treatment is at every position equally often, and
follows every other equally often: n orders for even n, a Latin square of n and its mirror image, 2n, for odd n (E. J.
Williams 1949): 6 orders for three materials, 2 for two.

`orders` assigns them to participants in blocks, each a whole design in a random sequence, square by square, with the
treatments renamed at random in each block. Over complete blocks positions and ordered neighbours are balanced exactly.
For any number of participants, the counts of a treatment at the positions differ by at most one; so do those of ordered
neighbours for even n, while for odd n they may differ by two within a block, since half of it cannot balance them.
Orders: up to three treatments the counts of all n! orders differ by at most one; from four on a block has only a few of
them, which may come again in the next block while others have not been used.

All this is of the participants in the plan. The order of a participant who drops out without being replaced is missing,
and neighbours balance carry-over effects from one treatment to the next only, not to the one after it.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from jaxtyping import Int

__all__ = ["Comparison", "Side", "assigned", "block_size", "comparisons", "orders", "williams"]

Side = Literal["a", "b"]
Comparison = tuple[str, str, Side]
"""Set on side a, set on side b, the side that is felt first."""


def williams(n: int) -> Int[np.ndarray, "rows n"]:
    """Williams design of n treatments 0..n-1, an order in each row: n rows for even n (and 1), 2n for odd n, whose
    second half mirrors the first."""
    zigzag = [(k + 1) // 2 if k % 2 else (n - k // 2) % n for k in range(n)]
    square = (np.array(zigzag)[None, :] + np.arange(n)[:, None]) % n
    return square if n % 2 == 0 or n == 1 else np.concatenate([square, square[:, ::-1]])


def block_size(n: int) -> int:
    """Number of participants in a complete block; the balance is exact for its multiples."""
    return len(williams(n))


def orders(n: int, participants: int, seed: int) -> Int[np.ndarray, "participants n"]:
    """Random order of the treatments 0..n-1 for each participant, balanced by Williams designs; the same for the same
    seed."""
    rng = np.random.default_rng(np.random.SeedSequence([seed, n, 1]))
    square = williams(n)
    halves = np.split(square, len(square) // n)
    rows = []
    while len(rows) < participants:
        names = rng.permutation(n)
        for half in rng.permutation(len(halves)):
            rows += [names[halves[half][row]] for row in rng.permutation(n)]
    return np.array(rows[:participants], int).reshape(participants, n)


def assigned(people: Mapping[str, int], seed: int) -> list[str]:
    """Random assignment of participants, in their order, to groups (name -> number of participants), in permuted
    blocks; the same for the same seed.

    A block has the smallest numbers in the ratio of the groups, in random order: for 24, 8 and 8 people, three of the
    first group and one of each other. So groups grow in this ratio, also if recruitment ends early.
    """
    rng = np.random.default_rng(np.random.SeedSequence([seed, len(people), 4]))
    blocks = math.gcd(*people.values())
    block = [name for name, count in people.items() for _ in range(count // blocks)]
    return [block[i] for _ in range(blocks) for i in rng.permutation(len(block))]


def comparisons(pairs: Sequence[tuple[str, str]], repeats: int, seed: int) -> list[Comparison]:
    """Random sequence of comparisons: each pair of sets `repeats` times, in rounds of all pairs; the same for the same
    seed.

    Over every two rounds, each set of a pair is once on either side and once felt first; over every four, each side is
    felt first twice. What fewer rounds leave over is balanced between pairs, and over participants, because each
    sequence starts at a random place of this cycle. No round begins with the pair that ended the last.
    """
    rng = np.random.default_rng(np.random.SeedSequence([seed, len(pairs), repeats, 2]))
    begin = int(np.random.default_rng(np.random.SeedSequence([seed, len(pairs), repeats, 3])).integers(4))
    ways = [_ways(repeats, begin + offset, rng) for offset in rng.permutation(len(pairs))]
    planned: list[Comparison] = []
    last = -1
    for turn in range(repeats):
        order = rng.permutation(len(pairs))
        if len(pairs) > 1 and order[0] == last:
            order = np.roll(order, 1)
        last = order[-1]
        for k in order:
            swapped, first = ways[k][turn]
            a, b = pairs[k][::-1] if swapped else pairs[k]
            planned.append((a, b, first))
    return planned


def _ways(repeats, start, rng):
    """For one pair, a list with (whether its sets are swapped, side felt first) for each of the `repeats` rounds.
    `start`: where in the cycle of the four ways it begins; the two of a pair of rounds are complementary, in random
    order by `rng`."""
    cycle = [_CYCLES[start % 4][i % 4] for i in range(repeats)]
    chunks = [cycle[i : i + 2] for i in range(0, repeats, 2)]
    return list(itertools.chain.from_iterable([chunk[j] for j in rng.permutation(len(chunk))] for chunk in chunks))


_WAYS: dict[str, tuple[bool, Side]] = {"1": (False, "a"), "2": (True, "a"), "3": (False, "b"), "4": (True, "b")}
_CYCLES = [[_WAYS[c] for c in text] for text in ("1234", "3412", "2143", "4321")]
