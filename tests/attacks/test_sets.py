"""A short version of the attack in attacks/sets.py."""

import pytest

from attacks.sets import Sets
from attacks.support import run


@pytest.mark.deep
def test_no_hostile_set_comes_into_force_of_either_memory():
    counts = run(Sets(), 2000, 1)
    assert not [word for word in counts if word.startswith("THROUGH")], counts
    assert min(counts[f"{memory} memory, in force"] for memory in ("short", "full")) > 100
