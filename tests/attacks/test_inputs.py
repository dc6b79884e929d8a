"""A short version of the attack on inputs: nothing gets through."""

import pytest

from attacks.inputs import input_case
from attacks.support import run


@pytest.mark.deep
def test_no_input_gets_through():
    counts = run(input_case(), 126, 1)
    assert not [outcome for outcome in counts if outcome.startswith("THROUGH")], counts
    assert sum(number for outcome, number in counts.items() if "by a command" in outcome) == 6
