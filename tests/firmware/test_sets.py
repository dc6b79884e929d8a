"""Sets on their way into force: the rows of PROTOCOL.md about SET, COMMIT and ABORT, against the C device."""

import zlib

import numpy as np
import pytest
from helpers_firmware import EXPONENTIALS, Device, full_set, pack, parameters

SET = {"K0": -3.18, "K1": 5.58, "B1": 7.88, "alpha": 0.176}
OTHER = {"K0": -2.5, "K1": 4.0, "B1": 6.0, "alpha": 0.2}


@pytest.fixture
def device():
    return Device()


@pytest.mark.parametrize(
    ("change", "reason", "value", "limit"),
    [
        ({"K0": float("nan")}, "NOT_FINITE", 0, 0),
        ({"K1": float("inf")}, "NOT_FINITE", 0, 0),
        ({"B1": float("-inf"), "K0": 99.0}, "NOT_FINITE", 0, 0),
        ({"alpha": float("nan")}, "NOT_FINITE", 0, 0),
        ({"force_limit": float("nan")}, "NOT_FINITE", 0, 0),
        ({"K0": -20.5, "K1": 41.0}, "K0_RANGE", -20.5, -20),
        ({"K0": 40.5}, "K0_RANGE", 40.5, 40),
        ({"K1": 0.25}, "K1_RANGE", 0.25, 0.5),
        ({"K1": 41.0, "B1": 41.0}, "K1_RANGE", 41, 40),
        ({"B1": 0.0}, "B1_RANGE", 0, np.float32(5e-4)),
        ({"B1": 41.0, "alpha": 1.0}, "B1_RANGE", 41, 40),
        ({"alpha": 0.0}, "ALPHA_RANGE", 0, np.float32(0.005)),
        ({"alpha": 1.0, "force_limit": -1}, "ALPHA_RANGE", 1, np.float32(0.995)),
        ({"force_limit": 41.0, "rate": 500}, "FORCE_LIMIT", 41, 40),
        ({"force_limit": -1.0}, "FORCE_LIMIT", -1, 0),
        ({"rate": 999, "N": 0}, "TICK_RATE", 999, 1000),
        ({"N": 0}, "MEMORY_LENGTH", 0, 255),
        ({"N": 256}, "MEMORY_LENGTH", 256, 255),
        ({"N": 65535}, "MEMORY_LENGTH", 65535, 255),
        ({"N": 100}, "EVEN_TAPS", 100, 255),
        ({"K0": -3.7, "K1": 20.0}, "STATIC_STIFFNESS", None, 0),
        ({"K1": 20.0}, "NOT_PASSIVE", None, np.float32(0.95)),
        ({"states": [(0, 0)] * 13}, "MEMORY_LENGTH", 13, 12),
        ({"states": []}, "MEMORY_LENGTH", 0, 12),
    ],
)
def test_a_refused_set_leaves_nothing_staged_and_what_is_in_force(device, change, reason, value, limit):
    device.go(SET)
    device.run([50] + [100] * 10)
    before, _ = device.run([100] * 5)
    device.stage(OTHER, 2)
    kind, message = device.ask("SET_PARAMS", parameters(SET | change, 3))
    if reason == "STATIC_STIFFNESS":
        kind, message = device.ask("SET_PARAMS", parameters(SET | {"K0": -4.0}, 3))
    assert (kind, message["reason"], message["limit"]) == ("NACK", reason, limit)
    assert message["value"] == value if value is not None else message["value"] != 0
    status = device.status()
    assert (status["active_id"], status["staged_id"], status["staging"]) == (1, 0, 0)
    after, _ = device.run([100] * 5)
    assert np.all(np.diff(np.r_[before, after]) < 0) and device.state == "RUNNING"  # it goes on relaxing


def test_damping_in_a_refusal_is_that_which_is_needed(device):
    _, message = device.ask("SET_PARAMS", parameters({"K0": -5.01, "K1": 8.44, "B1": 10.28, "alpha": 0.282}))
    assert message["reason"] == "NOT_PASSIVE" and abs(message["value"] - 1.34452) < 1.1e-5


def test_full_memory(device):
    staged = device.stage(full_set())
    assert device.confirm("COMMIT", staged)[0] == "ACK"
    stored = device.must("GET_SET", bank=0)
    assert (stored["memory"], stored["length"], stored["flags"], stored["crc"]) == (1, 10, 1, staged[1])


def first_seven(rows, **changed):
    return pack("SET_STATES", rows[:7], **({"set_id": 1, "first": 0, "count": 7} | changed))


@pytest.mark.parametrize(
    ("change", "rows"),
    [
        ({"set_id": 2}, {}),
        ({"first": 1}, {}),
        ({}, {0: (-0.1, 0.5)}),
        ({}, {9: (0.0, 1e-4)}),
        ({}, {3: (0.1, 0.0)}),
        ({}, {0: (0.1, 1.5)}),
        ({}, {3: (0.1, 0.9)}),
        ({}, {3: (float("nan"), 0.01)}),
        ({}, {3: (0.1, float("nan"))}),
        ({}, {9: (0.3, 1e-4)}),
        ({}, {0: EXPONENTIALS[1], 1: EXPONENTIALS[0]}),
    ],
    ids=str,
)
def test_states_that_are_refused(device, change, rows):
    """Another set, out of order, out of range, or with sums that are not those of alpha."""
    given = full_set()["states"]
    for place, row in rows.items():
        given[place] = row
    device.ask("SET_PARAMS", parameters(full_set()))
    kind, message = device.ask("SET_STATES", first_seven(given, **change))
    if kind == "ACK":
        kind, message = device.ask("SET_STATES", pack("SET_STATES", given[7:], set_id=1, first=7, count=3))
    assert (kind, message["reason"]) == ("NACK", "STATES")
    assert device.status()["staging"] == 0


def test_states_beyond_those_announced_or_of_short_memory(device):
    rows = full_set()["states"]
    device.stage(full_set())
    assert device.refusal("SET_STATES", pack("SET_STATES", rows[:1], set_id=1, first=10, count=1)) == "STATES"
    device.ask("SET_PARAMS", parameters(full_set() | {"states": rows[:3]}))
    assert device.refusal("SET_STATES", first_seven(rows)) == "STATES"
    device.stage(SET)
    assert device.refusal("SET_STATES", first_seven(rows)) == "STATES"
    assert device.refusal("SET_STATES", first_seven(rows)) == "NOTHING_STAGED"


def test_sums_that_belong_to_another_alpha(device):
    rows = full_set()["states"]
    device.ask("SET_PARAMS", parameters(full_set(alpha=0.301)))
    assert device.ask("SET_STATES", first_seven(rows))[0] == "ACK"
    assert device.refusal("SET_STATES", pack("SET_STATES", rows[7:], set_id=1, first=7, count=3)) == "STATES"


# COMMIT, START and the rest


def test_commit_names_what_was_received(device):
    staged_id, crc = device.stage(SET)
    for wrong in ((2, crc), (1, crc ^ 1)):
        assert device.confirm("COMMIT", wrong)[1]["reason"] == "SET_MISMATCH"
    _, ack = device.confirm("COMMIT", (staged_id, crc))
    assert (ack["set_id"], ack["crc"]) == (staged_id, crc)
    assert device.confirm("COMMIT", (staged_id, crc))[0] == "ACK"  # already in force
    assert device.confirm("COMMIT", (9, crc))[1]["reason"] == "NOTHING_STAGED"
    assert device.must("GET_SET", bank=1)["flags"] == 0


def test_commit_of_an_incomplete_set(device):
    payload = parameters(full_set())
    device.ask("SET_PARAMS", payload)
    assert device.confirm("COMMIT", (1, zlib.crc32(payload)))[1]["reason"] == "STATES"
    assert device.status()["staging"] == 1


def test_commit_in_contact_waits_for_the_history(device):
    device.go(SET)
    device.run([50, 100, 150] + [200] * 50)
    staged = device.stage(OTHER, 2)
    waited = []
    for _ in range(400):
        kind, message = device.confirm("COMMIT", staged)
        if kind == "ACK":
            break
        assert message["reason"] == "NOT_READY" and device.status()["ticks_until_ready"] == message["ticks"]
        waited.append(message["ticks"])
        device.beat()
        device.tick(200)
    assert waited[-1] == 1 and waited == sorted(waited, reverse=True) and 101 < len(waited) == waited[0] < 400
    device.tick(200)
    assert device.status()["active_id"] == 2 and device.offset != 0
    kind, message = device.ask("SET_PARAMS", parameters(SET, 3))
    assert (kind, message["reason"]) == ("NACK", "BUSY") and message["ticks"] > 0


def test_the_longest_memories_are_taken(device):
    """The most that LIMITS and HELLO promise, and no refusal at the bound itself."""
    device.stage(SET | {"N": 255}, 1)
    device.stage(full_set(), 2)
    kind, message = device.ask("SET_PARAMS", parameters(full_set(states=[(0, 0)] * 12), 3))
    assert kind == "ACK", message


def test_exactly_the_device_s_damping_is_enough(device):
    device.confirm("COMMIT", device.stage(SET))
    needed = device.must("GET_SET", bank=0)["minimum_damping_N_s_per_m"]
    just = Device(damping=needed)
    assert just.confirm("COMMIT", just.stage(SET))[0] == "ACK"
    less = Device(damping=float(np.nextafter(np.float32(needed), np.float32(0))))
    assert less.refusal("SET_PARAMS", parameters(SET)) == "NOT_PASSIVE"


def test_status_names_what_is_in_force_and_what_is_staged(device):
    """From either bank, of either memory: `stage` compares each answer with what was sent."""
    first = device.go(SET, 1)
    second = device.stage(full_set(), 2)
    status = device.status()
    assert (status["active_id"], status["active_crc"]) == first
    assert (status["staged_id"], status["staged_crc"]) == second
    assert device.confirm("COMMIT", second)[0] == "ACK"
    device.tick()
    third = device.stage(full_set(K1=0.9), 3)
    status = device.status()
    assert (status["active_id"], status["active_crc"], status["staged_crc"]) == (*second, third[1])


def test_abort_forgets(device):
    staged = device.stage(SET)
    nothing = {"reserved": 0, "set_id": 0, "crc": 0, "stops": 0, "repeated": []}
    assert device.ask("ABORT") == ("ACK", {"request": 5} | nothing)
    assert device.confirm("COMMIT", staged)[1]["reason"] == "NOTHING_STAGED"
