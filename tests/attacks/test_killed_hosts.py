"""A short version of the attack in attacks/killed_hosts.py."""

import pytest
from simulated import needs_device, own_cache  # noqa: F401

from attacks.killed_hosts import Killing
from attacks.support import run

pytestmark = [pytest.mark.deep, needs_device]


def test_killed_hosts_leave_no_force():
    killing = Killing()
    try:
        counts = run(killing, 20, 1)
    finally:
        killing.close()
    assert sum(counts.values()) == 20 and not [word for word in counts if word.startswith("THROUGH")], counts
