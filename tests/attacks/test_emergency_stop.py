"""A short version of the attack in attacks/emergency_stop.py. No test asserts a time; but nobody waits for ever."""

import pytest
from simulated import needs_device, own_cache  # noqa: F401

from attacks.emergency_stop import besieged
from attacks.support import run

pytestmark = [pytest.mark.deep, needs_device]


def test_a_besieged_stop_is_acknowledged_and_nothing_is_printed():
    with besieged(200) as siege:
        counts = run(siege.press, 20, 1)
    assert sum(counts.values()) == 20 and not [word for word in counts if word.startswith("THROUGH")], counts
