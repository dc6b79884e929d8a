"""A short version of the attack in attacks/kills.py."""

import sys

import pytest
from simulated import needs_device, own_cache  # noqa: F401

from attacks.kills import Kills
from attacks.support import run

pytestmark = [pytest.mark.deep, needs_device, pytest.mark.skipif(sys.platform != "linux", reason="/proc")]


def test_kills_lose_double_and_change_nothing(tmp_path):
    kills = Kills(tmp_path, trials=15)
    try:
        counts = run(kills, 5, 1)
    finally:
        kills.close()
    assert sum(counts.values()) == 5 and not [word for word in counts if word.startswith("THROUGH")], counts
