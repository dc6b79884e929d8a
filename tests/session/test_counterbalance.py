"""Orders and pairs: exact balance over complete blocks, at most one apart otherwise, the same from the same seed."""

import itertools
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hilbo.session.plan.counterbalance import block_size, comparisons, orders, williams


def neighbours(rows):
    return Counter((int(a), int(b)) for row in rows for a, b in itertools.pairwise(row))


def spread(counts, possible):
    values = [counts.get(key, 0) for key in possible]
    return max(values) - min(values)


@pytest.mark.parametrize(("n", "size"), [(1, 1), (2, 2), (3, 6), (4, 4), (5, 10), (6, 6), (7, 14)])
def test_a_williams_design_balances_positions_and_neighbours(n, size):
    rows = williams(n)
    assert len(rows) == block_size(n) == size
    for position in range(n):
        assert set(Counter(rows[:, position].tolist()).values()) == {size // n}
    assert spread(neighbours(rows), list(itertools.permutations(range(n), 2)) or [0]) == 0
    assert len({tuple(row) for row in rows.tolist()}) == size


@given(st.integers(1, 6), st.integers(0, 40), st.integers(0, 10**6))
def test_orders_are_balanced_at_any_number_of_participants(n, people, seed):
    rows = orders(n, people, seed)
    assert rows.shape == (people, n) and (orders(n, people, seed) == rows).all()
    assert (np.sort(rows, axis=1) == np.arange(n)).all()
    for position in range(n):
        assert spread(Counter(rows[:, position].tolist()), range(n)) <= 1
    possible = list(itertools.permutations(range(n), 2))
    whole = people // block_size(n) * block_size(n)
    if possible:
        assert spread(neighbours(rows[:whole]), possible) == 0
        assert spread(neighbours(rows), possible) <= (1 if n % 2 == 0 else 2)
    for begin in range(0, whole, block_size(n)):
        block = rows[begin : begin + block_size(n)]
        assert len({tuple(row) for row in block.tolist()}) == block_size(n)


def test_the_papers_pairs_are_balanced():
    pairs = [("best", "mid"), ("best", "worst"), ("mid", "worst")]
    for seed in range(20):
        schedule = comparisons(pairs, 4, seed)
        assert len(schedule) == 12
        assert set(Counter(frozenset(trial[:2]) for trial in schedule).values()) == {4}
        assert Counter(name for a, b, _ in schedule for name in (a, b)) == dict.fromkeys(("best", "mid", "worst"), 8)
        assert set(Counter(schedule).values()) == {1}  # every pair in each of the four combinations of side and order
        repeated = sum(set(x[:2]) == set(y[:2]) for x, y in itertools.pairwise(schedule))
        assert repeated == 0
    assert comparisons(pairs, 4, 0) == comparisons(pairs, 4, 0) != comparisons(pairs, 4, 1)


@given(st.integers(1, 24), st.integers(1, 6), st.integers(0, 10**6))
def test_sides_and_order_are_balanced_for_any_number_of_rounds(count, repeats, seed):
    pairs = [("aggregate", f"individual:P{i}") for i in range(count)]
    schedule = comparisons(pairs, repeats, seed)
    assert set(Counter(frozenset(trial[:2]) for trial in schedule).values()) == {repeats}
    for _, name in pairs:
        own = [trial for trial in schedule if name in trial[:2]]
        left = sum(trial[0] == name for trial in own)
        early = sum((trial[2] == "a") == (trial[0] == name) for trial in own)
        for times in (left, early):
            assert abs(2 * times - repeats) <= repeats % 2
    for total in (sum(trial[0] == "aggregate" for trial in schedule), sum(trial[2] == "a" for trial in schedule)):
        assert abs(2 * total - len(schedule)) <= 4


@pytest.mark.parametrize(("count", "repeats", "trials"), [(24, 2, 48), (8, 3, 24)])
def test_the_papers_aggregate_best_sessions(count, repeats, trials):
    schedule = comparisons([("aggregate", str(i)) for i in range(count)], repeats, 0)
    assert len(schedule) == trials
    assert sum(a == "aggregate" for a, _, _ in schedule) == trials // 2
    assert sum(first == "a" for *_, first in schedule) == trials // 2


@pytest.mark.parametrize(("pairs", "repeats"), [(3, 1), (3, 2), (6, 3), (2, 3)])
def test_what_few_rounds_leave_over_is_balanced_between_people(pairs, repeats):
    """Four standard errors from a half, over 400 people."""
    names = [(f"best{i}", f"other{i}") for i in range(pairs)]
    people = [comparisons(names, repeats, seed) for seed in range(400)]
    side = np.array([np.mean([a.startswith("best") for a, _, _ in person]) for person in people])
    first = np.array([np.mean([way == "a" for _, _, way in person]) for person in people])
    felt = np.array(
        [np.mean([(a if way == "a" else b).startswith("best") for a, b, way in person]) for person in people]
    )
    for share in (side, first, felt):
        assert abs(share.mean() - 0.5) <= 4 * share.std() / 20
