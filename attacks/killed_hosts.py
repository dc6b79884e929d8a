"""Hosts that are killed at random moments while a finger presses: no force, a stated number of ticks later.

    python attacks/killed_hosts.py --count 500 --seed 0 --state killed_hosts.json

The device is the firmware's own core in lockstep, so that what is asserted are its ticks: whenever it puts out a force,
its last heartbeat is less than watchdog and ramp, 270 ticks, ago. How long after the kill the last heartbeat comes is
the host's own delay, in real time; it is measured and printed, and no bound of the device's.
"""

import random
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import NamedTuple

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[1] / "tests" / "support")]

from simulated import ENVIRONMENT

from attacks.support import main
from hilbo.device.link import Link
from hilbo.device.local.simulator import Simulator
from hilbo.device.ports import open_port
from hilbo.hardware_bridge import Renderer, State

__all__ = ["BOUND", "Killed", "Killing"]

WATCHDOG = 250  # ticks
BOUND = WATCHDOG + 20  # ticks: and the ramp
_HOST = """
import sys
from hilbo.hardware_bridge import Renderer
sets = [dict(K0=-3.18, K1=5.58, B1=7.88, alpha=0.176), dict(K0=-2.89, K1=5.70, B1=5.89, alpha=0.203)]
with Renderer.open(sys.argv[1]) as device:
    device.link.patience = 30.0
    device.send(**sets[0])
    device.start()
    print("running", flush=True)
    for n in range(10**6):
        device.send(**sets[n % 2])
        device.samples(0.05)
        device.status()
"""


class Killed(NamedTuple):
    """What was seen of one: the largest age (ticks) of the last heartbeat at which there was force, that force (N),
    the force when the host died, and the time (s) from its death to its last heartbeat."""

    ticks: int
    last_N: float
    before_N: float
    delay_s: float


class Killing:
    """A device, and hosts that are killed one after the other; `seen` is what they left."""

    def __init__(self):
        self.device, self.seen = Simulator(rate="lockstep", finger="ramp"), list[Killed]()

    def __call__(self, rng: random.Random, _number: int) -> str:
        """One host; the word under which it counts."""
        left = self.killed(rng)
        self.seen.append(left)
        if left.ticks >= BOUND:
            return f"THROUGH: {left.last_N:.3g} N, {left.ticks} ticks after the last heartbeat"
        self.take_over()
        return "no force within the bound, " + ("pressed" if left.before_N > 0 else "not pressed")

    def killed(self, rng: random.Random, least_N: float = 0.0) -> Killed:
        """A host that renders, and is killed at a random moment; later, once the force is `least_N` or more."""
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        host = subprocess.Popen([sys.executable, "-c", _HOST, self.device.port], **pipes, env=ENVIRONMENT)
        assert host.stdout is not None and host.stderr is not None
        ready = threading.Thread(target=host.stdout.readline)
        ready.start()
        while ready.is_alive():
            self._keep_up()
        for _ in range(rng.randrange(500, 1100)):  # it began out of contact, and the finger takes some time to press
            self._keep_up()
        while self._tick(0)[1] < least_N:
            self._keep_up()
        time.sleep(rng.uniform(0, 0.005))
        host.kill()
        words: list[bytes] = []  # end with the helper that sends heartbeats
        silence = threading.Thread(
            target=lambda: words.append(host.stderr.read())
        )  # ends with the helper of heartbeats
        left = self._watched(silence)
        host.wait()
        assert words == [b""], words
        host.stdout.close()
        host.stderr.close()
        return left

    def _watched(self, silence: threading.Thread) -> Killed:
        """Every tick from the death of a host on, until its heartbeats have ended and force has been zero for long."""
        dead = beat = time.monotonic()
        silence.start()
        _, before_N, since = self._tick(0)
        ticks = last_N = zeros = 0
        while silence.is_alive() or zeros < 300:
            _, force_N, age = self._tick(1)
            beat = time.monotonic() if age <= since else beat
            since = age if age < WATCHDOG else since + 1  # the device counts no further
            zeros = 0 if force_N else zeros + 1
            if force_N and since >= ticks:
                ticks, last_N = since, force_N
        return Killed(ticks, last_N, before_N, beat - dead)

    def take_over(self) -> None:
        """The next host finds the device in HOLD, clears it and renders."""

        def connect():
            return Link(open_port(self.device.port), patience=30.0, ticks=self.device.ticks)

        with Renderer(connect) as device:
            assert device.notes == [
                "The device is in HOLD: no fresh heartbeat came from the host; clear it before the next start."
            ]
            assert device.in_force() is not None
            device.clear()
            device.start()
            assert device.state() == State.RUNNING

    def _tick(self, count: int) -> tuple[int, float, int]:
        """So many ticks; the tick, the force (N) and the age of the last heartbeat (ticks) after them."""
        _, now, force_N, age = self.device.ticks(count).split()
        return int(now), float(force_N), int(age)

    def _keep_up(self) -> None:
        """Five ticks, but none while the host's heartbeats are late: this computer is busy."""
        time.sleep(0.001)
        self._tick(5 if self._tick(0)[2] < 150 else 0)

    def close(self) -> None:
        """End the device."""
        self.device.close()
        delays, ticks = sorted(left.delay_s for left in self.seen), [left.ticks for left in self.seen]
        if delays:
            print(
                f"ticks from the last heartbeat to no force: {max(ticks) + 1} at most of {BOUND}; from the kill to the"
                f" last heartbeat: median {1e3 * delays[len(delays) // 2]:.1f} ms, 99 %"
                f" {1e3 * delays[int(0.99 * (len(delays) - 1))]:.1f}, largest {1e3 * delays[-1]:.1f}"
            )


if __name__ == "__main__":
    killing = Killing()
    try:
        main(lambda: killing, __doc__.partition("\n")[0], 500)
    finally:
        killing.close()
