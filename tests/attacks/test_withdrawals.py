"""A short version of the attack on withdrawals: nothing stops working, and nobody stays who was not said to."""

import pytest

from attacks.support import run
from attacks.withdrawals import withdrawal_case


@pytest.mark.deep
@pytest.mark.release
def test_a_withdrawal_leaves_a_study_that_works():
    assert run(withdrawal_case(4, quick=True), 4, 0) == {"every command runs": 4}
