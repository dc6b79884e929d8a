"""Orders in time: hosts whose orders and answers are lost, late and doubled, and a device that stops when it was told.

Two hosts speak to one device over lines of their own, each with what has come back to it; a hand moves the handle in
and out of the material, and somebody presses the hardware stop. The properties, of random schedules: an acknowledged
E-STOP ends no sooner than by a CLEAR that was made after it; START, DRIVE and HOME act at most once; and none of them
acts after a stop that came to the device after the order was made.
"""

import itertools

import numpy as np
import pytest
from helpers_firmware import NAMES, STATES, Device, build, decode, frame, library, pack, unpack

SET = {"K0": -3.18, "K1": 5.58, "B1": 7.88, "alpha": 0.176}
ORDERS = ("CLEAR", "START", "STOP", "ESTOP", "DRIVE", "GET_STATUS", "HOME")
STILL = {"STOPPED", "HOLD", "ESTOP", "STOPPING"}


class Host:
    """One sender: what it knows has come back over its own line, late or never."""

    def __init__(self, device: Device, staged: tuple[int, int], rng):
        self.device, self.staged, self.rng = device, staged, rng
        self.stops = self.tick = 0
        self.seq = int(rng.integers(256))
        self.line: list[tuple[int, str, int, bytes]] = []  # when it arrives, name, number of the order, bytes
        self.back: list[tuple[int, str, dict]] = []

    def make(self, name: str, number: int, now: int) -> None:
        """An order on its way: once, doubled, late, or lost; a link repeats what stays unanswered."""
        known = {"boot_id": 7, "stop": self.stops}
        values = {"CLEAR": known, "GET_STATUS": {}, "STOP": {}, "ESTOP": {}}
        values["START"] = known | {"set_id": self.staged[0], "crc": self.staged[1]}
        values["HOME"] = known | {"position_mm": float(self.rng.uniform(-5, 0.5))}
        values["DRIVE"] = known | {"offset": 1.0, "duration_ticks": int(self.rng.integers(5, 60))}
        self.seq = (self.seq + 1) % 256
        data = frame(name, self.seq, pack(name, **values[name]))
        for repeat in range(int(self.rng.choice([0, 1, 1, 2, 3]))):
            at = now + int(self.rng.choice([0, 3, 40, 200])) + 100 * repeat
            self.line.append((at, name, number, data))

    def hear(self, now: int) -> None:
        """What has come back by now; a third of all answers is lost, others are late."""
        for _, name, message in [answer for answer in self.back if answer[0] <= now]:
            if "stops" in message:
                self.stops = message["stops"]
            if name in ("PULSE", "STATUS", "NOTICE"):
                self.tick = message["tick"]
        self.back = [answer for answer in self.back if answer[0] > now]


def deliver(device: Device, hosts: list[Host], host: Host, data: bytes, now: int) -> None:
    """One frame and what comes back: to its sender, notices to every host, late or not at all."""
    device.feed(data)
    for encoded in filter(None, device.drain().split(b"\0")):
        number, _, payload = decode(encoded)
        name = NAMES[number]
        for other in hosts:
            if (other is host or name == "NOTICE") and other.rng.random() < 0.7:
                other.back.append((now + int(other.rng.choice([0, 5, 120])), name, unpack(name, payload)))


def schedule(seed: int, orders: int, lib) -> dict[str, int]:
    """So many random orders of two hosts; how often each was carried out."""
    rng = np.random.default_rng(seed)
    device = Device(lib=lib)
    staged = device.stage(SET)
    device.confirm("COMMIT", staged)
    hosts = [Host(device, staged, rng) for _ in range(2)]
    made_at, acted, done = {}, set(), dict.fromkeys(ORDERS, 0)
    stopped_at, latched_by = -1, None  # arrivals of the last stop, of the ESTOP that latches
    arrivals = itertools.count()
    counts, number, now, order = 0, 0, 0, 0
    switch_open = False

    def state():
        return STATES[lib.shim_state(device.memory)]

    while order < orders or any(host.line for host in hosts):
        now += 1
        for host in hosts:
            host.hear(now)
            if order < orders and rng.random() < 0.1:
                name = ORDERS[rng.choice(len(ORDERS), p=[0.25, 0.3, 0.05, 0.1, 0.15, 0.1, 0.05])]
                number, order = number + 1, order + 1
                made_at[number] = next(arrivals)
                host.make(name, number, now)
            for item in sorted(item for item in host.line if item[0] <= now):
                host.line.remove(item)
                _, name, which, data = item
                before, stops = state(), device.stops
                arrival = next(arrivals)
                deliver(device, hosts, host, data, now)
                after = state()
                homed = name == "HOME" and device.stops != stops
                if name in ("STOP", "ESTOP"):
                    stopped_at = arrival
                    latched_by = arrival if name == "ESTOP" else latched_by
                if before == "ESTOP" and after != "ESTOP":
                    assert name == "CLEAR" and made_at[which] > latched_by, "an E-STOP was undone by an older order"
                if homed or (before in STILL and after in ("RUNNING", "DRIVING")):
                    assert which not in acted, "an order acted twice"
                    assert made_at[which] > stopped_at, "an order outlived a later stop"
                    acted.add(which)
                    done[name] += 1
                stopped_at = arrival if homed else stopped_at
                done[name] += name == "CLEAR" and before in ("HOLD", "ESTOP") and after == "STOPPED"
            if rng.random() < 0.1:
                device.feed(frame("HEARTBEAT", 0, pack("HEARTBEAT", boot_id=7, tick=host.tick)))
                deliver(device, hosts, host, b"", now)
        held, stops = state(), device.stops
        counts = int(np.clip(counts + rng.integers(-9, 9), -400, 60))
        switch_open = rng.random() < (0.8 if switch_open else 0.002)
        lib.shim_tick_of_board(device.memory, counts, 0, int(switch_open))
        deliver(device, hosts, hosts[0], b"", now)  # notices of the tick, to both hosts
        if device.stops != stops:
            stopped_at = next(arrivals)
            latched_by = stopped_at if state() == "ESTOP" else latched_by
        assert held != "ESTOP" or state() == "ESTOP"
    return done


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.deep) for seed in range(1, 20))])
def test_no_order_outlives_a_later_stop_and_none_acts_twice(seed):
    """500 orders by default; 10,000 in all with the deep ones."""
    done = schedule(seed, 500, library(build()))
    assert done["CLEAR"] > 3 and done["START"] + done["DRIVE"] > 3  # the schedule is no row of refusals
