"""A short version of the attack in attacks/kills.py."""

import sys

import pytest
from simulated import needs_device, own_cache  # noqa: F401

from attacks.kills import Kills
from attacks.support import run

pytestmark = [pytest.mark.deep, needs_device, pytest.mark.skipif(sys.platform != "linux", reason="/proc")]


@pytest.mark.parametrize("count", [5, pytest.param(20, marks=pytest.mark.release)])
def test_kills_lose_double_and_change_nothing(tmp_path, count):
    kills = Kills(tmp_path, trials=15)
    try:
        counts = run(kills, count, 1)
    finally:
        kills.close()
    assert sum(counts.values()) == count and not [word for word in counts if word.startswith("THROUGH")], counts
