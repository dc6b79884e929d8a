"""A cache of their own for the tests' simulated devices, and a line on which bytes are lost, doubled and damaged."""

import os
import random
import shutil
import time
from pathlib import Path

import pytest

from hilbo.device.ports import POLL, open_port

__all__ = ["ENVIRONMENT", "ROOT", "FaultyPort", "needs_device", "own_cache"]

ROOT = Path(__file__).parents[2]
CACHE = ROOT / ".pytest_cache" / "device"
PATHS = os.pathsep.join([str(ROOT), str(ROOT / "tests" / "support")])
ENVIRONMENT = os.environ | {"XDG_CACHE_HOME": str(CACHE), "PYTHONPATH": PATHS}

needs_device = pytest.mark.skipif(
    os.name != "posix" or not (shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")),
    reason="the simulated device needs a C compiler and pseudo-terminals",
)


@pytest.fixture(autouse=True, scope="module")
def own_cache():
    """Import it into a file to keep that file's simulated devices out of the user's cache."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(CACHE))
        yield


class FaultyPort:
    """A port that loses, flips and inserts bytes, and delivers late and twice, each at `rate` per byte or per read."""

    def __init__(self, name, rate, seed):
        self.name, self.rate, self.random = name, rate, random.Random(seed)
        self.port = open_port(name)
        self.faults = 0

    def read(self):
        data = self._damaged(self.port.read())
        if data and self.random.random() < self.rate:
            self.faults += 1
            time.sleep(self.random.uniform(0, POLL))
            data += data
        return data

    def write(self, data):
        self.port.write(self._damaged(data))

    def close(self):
        self.port.close()

    def _damaged(self, data):
        damaged = bytearray()
        for byte in data:
            kind = self.random.random() / self.rate if self.rate else 1.0
            self.faults += kind < 1
            if kind < 1 / 3:
                continue
            if kind < 2 / 3:
                byte ^= 1 << self.random.randrange(8)
            damaged.append(byte)
            if 2 / 3 <= kind < 1:
                damaged.append(self.random.randrange(256))
        return bytes(damaged)
