"""A short version of the attack on files: nothing gets through."""

import pytest

from attacks.damages import damage_case
from attacks.support import run


@pytest.mark.deep
def test_no_damage_of_a_file_gets_through():
    counts = run(damage_case(), 220, 1)
    assert not [outcome for outcome in counts if outcome.startswith("THROUGH")], counts
    assert counts.total() == 220
