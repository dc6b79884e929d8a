"""Frames, good, spoilt and none at all, to the device's parser and to the host's.

    python attacks/frames.py --count 100 --seed 0 --state frames.json        # a case is 100,000 frames and more

The device is the firmware's core with AddressSanitizer and UndefinedBehaviorSanitizer under libFuzzer, from the shipped
corpus on; its harness (firmware/tests/fuzz.c) knows what no frame may do: a set in force that nobody confirmed, motion
without a host, a force beyond its limit. The host is `hilbo.device.link.Link` on a port that says the same kind of
things: no frame that comes out of it may be one that was not sent whole, and nothing may end its reading. Every fifth
of a case's frames is the host's. Needs clang.
"""

import random
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[1])]

from attacks.support import damaged, main
from hilbo.device import link
from hilbo.device.frames import Frame, encoded_frame
from hilbo.device.messages import MESSAGES

__all__ = ["Frames", "host_takes"]

FIRMWARE = Path(__file__).parents[1] / "firmware"


class Port:
    """A port on which bytes wait, and that swallows what is written."""

    name = "attack"

    def __init__(self, data: bytes):
        self._parts = [data[at : at + 4096] for at in range(0, len(data), 4096)][::-1]
        self.begun, self.over = threading.Event(), threading.Event()

    def read(self) -> bytes:
        """What comes next, once it may; nothing in the end."""
        if not self.begun.wait(0.01):
            return b""
        if self._parts:
            return self._parts.pop()
        self.over.set()
        time.sleep(0.01)
        return b""

    def write(self, data: bytes) -> None:
        """Nobody is there."""

    def close(self) -> None:
        """Nothing to close."""


class Frames:
    """`case` is one batch of frames; `folder` keeps the fuzzer, and what it learns from one case to the next."""

    def __init__(self, folder: Path, batch: int = 100_000):
        self.batch, self.ended, self._inputs = batch, 0, folder / "fuzz" / "found"
        if shutil.which("clang") is None:
            raise SystemExit("This attack needs clang with libFuzzer (on Debian: clang libclang-rt-14-dev).")
        command = ["make", "-s", "-C", FIRMWARE, "fuzzer", f"BUILD={folder}", f"FUZZED={FIRMWARE / 'core'}"]
        subprocess.run([*map(str, command)], check=True, stdout=subprocess.DEVNULL)
        self._fuzzer = folder / "fuzz" / "fuzz"

    def __call__(self, rng: random.Random, _number: int) -> str:
        """The word under which a batch counts."""
        ended = 0
        while ended < self.batch * 4 // 5:
            said = self._fuzz(rng.randrange(1, 2**31))
            count = re.search(r"(\d+) frames, \d+ ticks checked", said)
            if count is None:
                return f"THROUGH: the device\n{said[-2000:]}"
            ended += int(count[1])
        sent = self.batch // 5
        why = host_takes(rng, sent)
        if why:
            return f"THROUGH: the host, {why}"
        self.ended += ended + sent
        return "nothing got through"

    def _fuzz(self, seed: int) -> str:
        limits = [f"-seed={seed}", "-runs=2000", "-max_len=600", "-rss_limit_mb=0", "-malloc_limit_mb=512"]
        command = [str(self._fuzzer), *limits, str(self._inputs), str(FIRMWARE / "tests" / "corpus")]
        done = subprocess.run(command, cwd=self._inputs.parent, capture_output=True)
        return done.stderr.decode(errors="replace") if done.returncode == 0 else "broken"


def host_takes(rng: random.Random, count: int) -> str:
    """Frames to a host's `Link`; what got through, if anything did."""
    good, wire = set[Frame](), []
    for _ in range(count):
        frame = Frame(rng.choice([*MESSAGES, rng.randrange(256)]), rng.randrange(256), rng.randbytes(rng.randrange(65)))
        data = encoded_frame(frame)
        kind = rng.random()
        if kind < 0.5:
            good.add(frame)
            wire.append(data)
        elif kind < 0.95:
            spoilt = damaged(rng, data[:-1])
            wire.append(b"\0" + spoilt + b"\0")
            if data[:-1] in spoilt.split(b"\0"):  # whole, between others
                good.add(frame)
        else:
            wire.append(rng.randbytes(rng.randrange(300)) + b"\0")
    port, seen = Port(b"".join(wire)), []
    held = link.Link(port)
    try:
        taken = held._take
        held._take = lambda frame: (seen.append(frame), taken(frame))  # type: ignore[method-assign]
        port.begun.set()
        port.over.wait(60)
        if held.lost or not port.over.is_set():
            return f"its reading ended: {held.lost}"
        if not good <= set(seen):
            return "frames that were whole are lost"
        strangers = set(seen) - good
        return f"{len(strangers)} frames that nobody sent, such as {strangers.pop()}" if strangers else ""
    finally:
        held.close()


def prepared() -> None:
    """The command line."""
    with tempfile.TemporaryDirectory() as folder:
        frames = Frames(Path(folder))
        try:
            main(lambda: frames, __doc__.partition("\n")[0], 100)
        finally:
            print(f"{frames.ended:,} frames in this run")


if __name__ == "__main__":
    prepared()
