"""A short version of the attack in attacks/frames.py."""

import random
import shutil

import pytest

from attacks.frames import Frames, host_takes
from attacks.support import run


def test_a_host_takes_no_frame_that_nobody_sent():
    assert host_takes(random.Random(1), 2000) == ""


@pytest.mark.deep
@pytest.mark.skipif(shutil.which("clang") is None, reason="there is no clang, which has libFuzzer")
def test_no_frame_gets_through(tmp_path):
    frames = Frames(tmp_path, batch=50_000)
    assert run(frames, 2, 1) == {"nothing got through": 2}
    assert frames.ended >= 100_000
