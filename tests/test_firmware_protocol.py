"""What each message gets: the tables of PROTOCOL.md, row by row, against the C device."""

import re
import struct
import zlib

import numpy as np
import pytest
from helpers_firmware import CAUSES, CONFIG, DOCUMENT, TYPES, Device, build, cobs, frame, library, pack, parameters

SET = {"K0": -3.18, "K1": 5.58, "B1": 7.88, "alpha": 0.176}
OTHER = {"K0": -2.5, "K1": 4.0, "B1": 6.0, "alpha": 0.2}
REQUESTS = [name for name, number in TYPES.items() if number < 0x40]


EXPONENTIALS = [
    (0.16150905, 0.9044945),
    (0.19177684, 0.52692366),
    (0.16125424, 0.23115093),
    (0.12465648, 0.0905768),
    (0.09473704, 0.033717748),
    (0.07124848, 0.012141097),
    (0.05358717, 0.0042446544),
    (0.041970227, 0.0014005903),
    (0.038842943, 0.0003679924),
    (0.06041753, 2.3818455e-05),
]
"""Weight and loss of the host's ten exponentials for alpha = 0.3 (another test makes them anew)."""


def full_set(**changed) -> dict:
    return {"K0": 0.44, "K1": 1.0, "B1": 3.0, "alpha": 0.3, "states": list(EXPONENTIALS)} | changed


@pytest.fixture
def device():
    return Device()


# Frames

STRETCHED = bytearray(frame("ECHO", 1, b"a"))
STRETCHED[0] += 1  # no zero in it: the first code reaches to the end, and now beyond


@pytest.mark.parametrize(
    "data",
    [
        bytes(STRETCHED),
        b"\x05\x01\x02\0",  # no COBS
        cobs(b"\x0a\x01abc") + b"\0",  # short
        cobs(b"\x0a\x01" + struct.pack("<I", zlib.crc32(b"\x0a\x01") ^ 1)) + b"\0",  # wrong checksum
        b"\x01" * 72 + b"\0",
        b"\xff" * 5000 + b"\0",
        cobs(b"\x10\x01" + bytes([7]) * 65 + struct.pack("<I", zlib.crc32(b"\x10\x01" + bytes([7]) * 65))) + b"\0",
    ],
)
def test_bytes_that_are_no_frame(device, data):
    assert device.exchange(data) is None
    assert device.status()["frames_dropped"] == 1


def test_empty_frames_are_ignored(device):
    assert device.exchange(b"\0\0\0") is None
    assert device.status()["frames_dropped"] == 0


@pytest.mark.parametrize("number", [0, 0x11, 0x40, TYPES["ACK"], TYPES["TELEMETRY"], 0xFF])
def test_unknown_types(device, number):
    assert device.refusal(number, b"") == "UNKNOWN_TYPE"


@pytest.mark.parametrize("name", [name for name in REQUESTS if name not in ("HEARTBEAT", "ECHO")])
def test_another_length(device, name):
    length = len(pack(name))
    for wrong in {length + 1, max(length - 1, 0), 0, 64} - ({60} if name == "SET_STATES" else {length}):
        kind, message = device.ask(name, bytes(wrong))
        assert (kind, message["reason"], message["value"]) == ("NACK", "LENGTH", wrong)
        assert message["limit"] == (60 if name == "SET_STATES" else length)


@pytest.mark.parametrize("count", [0, 3, 8])
def test_states_whose_count_does_not_fit(device, count):
    device.ask("SET_PARAMS", parameters(full_set()))
    payload = pack("SET_STATES", [(0.1, 0.1)] * 2, set_id=1, first=0, count=count)
    assert device.refusal("SET_STATES", payload) == "LENGTH"


@pytest.mark.parametrize("name", ["HELLO", "SET_PARAMS", "COMMIT", "START", "DRIVE"])
def test_reserved_fields(device, name):
    values = {"version": 1} if name == "HELLO" else {"set_id": 1} if name != "DRIVE" else {}
    assert device.refusal(name, pack(name, reserved=1, **values)) == "RESERVED"


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("SET_PARAMS", {"set_id": 0, "length": 101}),
        ("SET_PARAMS", {"set_id": 1, "memory": 2}),
        ("GET_SET", {"bank": 2}),
        ("STREAM", {"divisor": 10, "fields": 2}),
        ("DRIVE", {"mode": 2, "boot_id": 7}),
        ("DRIVE", {"shape": 3, "boot_id": 7}),
    ],
)
def test_numbers_without_a_name(device, name, values):
    assert device.refusal(name, **values) == "RESERVED"


# HELLO


def test_before_hello_only_what_is_safe():
    for name in REQUESTS:
        device = Device(hello=False)
        if name in ("HELLO", "GET_STATUS", "STOP", "ESTOP"):
            device.must(name, **({"version": 1, "schema": CRC} if name == "HELLO" else {}))
        elif name != "HEARTBEAT":
            assert device.refusal(name) == "NO_HELLO"
    assert Device(hello=False).refusal(0x77, b"") == "NO_HELLO"


CRC = zlib.crc32(DOCUMENT.split("```schema\n")[1].split("```")[0].encode())


def test_hello_compares_version_and_schema(device):
    assert device.refusal("HELLO", version=2, schema=CRC) == "VERSION"
    assert device.refusal("HELLO", version=1, schema=CRC ^ 1) == "SCHEMA"
    reply = device.must("HELLO", version=1, schema=CRC)
    assert reply["schema"] == CRC and reply["boot_id"] == 7 and reply["damping_N_s_per_m"] == np.float32(0.95)
    assert (reply["most_taps"], reply["watchdog_ticks"], reply["firmware"]) == (255, 250, 0xDEADBEEF)


def test_hello_resets_the_stream_and_nothing_else(device):
    device.go(SET)
    device.must("STREAM", divisor=1, fields=0)
    device.hello()
    device.run([100] * 20)
    device.collect()
    assert device.telemetry == [] and device.state == "RUNNING"


# Sets


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
    device.run([100] * 10)
    before, _ = device.run([100] * 5)
    device.stage(OTHER, 2)
    kind, message = device.ask("SET_PARAMS", parameters(SET | change, 3))
    if reason == "STATIC_STIFFNESS":
        kind, message = device.ask("SET_PARAMS", parameters(SET | {"K0": -4.0}, 3))
    assert (kind, message["reason"], message["limit"]) == ("NACK", reason, limit)
    assert value is None or message["value"] == value
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
    found = device.must("GET_SET", bank=0)
    assert (found["memory"], found["length"], found["flags"], found["crc"]) == (1, 10, 1, staged[1])


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
    device.run([200] * 50)
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


def test_abort_forgets(device):
    staged = device.stage(SET)
    assert device.ask("ABORT") == ("ACK", {"request": 5, "reserved": 0, "set_id": 0, "crc": 0, "repeated": []})
    assert device.confirm("COMMIT", staged)[1]["reason"] == "NOTHING_STAGED"


@pytest.mark.parametrize("name", ["COMMIT", "START", "DRIVE", "CLEAR"])
def test_another_boot_id(device, name):
    staged = device.stage(SET)
    device.confirm("COMMIT", staged)
    device.beat()
    named = {"set_id": 1, "crc": staged[1]} if name in ("COMMIT", "START") else {}
    assert device.refusal(name, boot_id=8, **named) == "BOOT_ID"


def test_start(device):
    assert device.confirm("START", (1, 5))[1]["reason"] == "NO_SET"
    staged = device.stage(SET)
    device.confirm("COMMIT", staged)
    assert device.confirm("START", (1, staged[1] ^ 1))[1]["reason"] == "SET_MISMATCH"
    assert device.confirm("START", staged)[1]["reason"] == "NO_HEARTBEAT"
    device.beat()
    assert device.confirm("START", staged)[0] == "ACK"
    assert device.confirm("START", staged)[0] == "ACK"
    assert device.confirm("START", (2, 0))[1]["reason"] == "STATE"
    assert device.state == "RUNNING"


def test_states_in_which_requests_are_refused(device):
    staged = device.go(SET)
    drive = pack("DRIVE", offset=1.0, duration_ticks=100, boot_id=7)
    _, message = device.ask("DRIVE", drive)
    assert (message["reason"], message["value"]) == ("STATE", 1)
    assert device.refusal("CLEAR", boot_id=7) == "STATE"
    device.must("STOP")
    assert device.confirm("START", staged)[1]["reason"] == "STATE"
    device.must("ESTOP")
    assert device.confirm("START", staged)[1]["reason"] == "STATE"
    assert device.refusal("DRIVE", drive) == "STATE"
    device.must("STOP")
    assert device.state == "ESTOP"
    device.must("CLEAR", boot_id=7)
    assert device.state == "STOPPED"


def test_heartbeats_that_do_not_count(device):
    staged = device.stage(SET)
    device.confirm("COMMIT", staged)
    for payload in (pack("HEARTBEAT", boot_id=8), b"", pack("HEARTBEAT", boot_id=7) + b"\0"):
        assert device.exchange(frame("HEARTBEAT", 1, payload)) is None
        assert device.confirm("START", staged)[1]["reason"] == "NO_HEARTBEAT"


# Repetition


def test_the_same_request_again_gets_the_same_answer_and_is_not_done_twice(device):
    device.go(SET)
    device.run([100] * 300)
    data = frame("SET_PARAMS", 77, parameters(OTHER, 2))
    first = device.exchange(data)
    device.run([100] * 100)
    assert device.exchange(data) == first
    left = device.status()["ticks_until_ready"]
    device.run([100] * 50)
    device.exchange(frame("SET_PARAMS", 78, parameters(OTHER, 2)))  # a new one begins the history anew
    assert device.status()["ticks_until_ready"] == left + 100


def test_a_repeated_refusal_is_the_same_and_a_new_seq_is_looked_at(device):
    device.go(SET)
    device.run([100] * 50)
    staged = device.stage(OTHER, 2)
    data = frame("COMMIT", 9, pack("COMMIT", set_id=2, crc=staged[1], boot_id=7))
    refused = device.exchange(data)
    device.run([100] * 400)
    assert device.exchange(data) == refused and refused[1]["reason"] == "NOT_READY"
    assert device.confirm("COMMIT", staged)[0] == "ACK"


def test_a_clear_that_comes_late_again_clears_no_other_stop(device):
    clear = frame("CLEAR", 50, pack("CLEAR", boot_id=7))
    device.must("ESTOP")
    assert device.exchange(clear)[0] == "ACK"
    device.feed(frame("ESTOP", 51))
    device.collect()
    device.exchange(clear)  # not the last request any more: carried out, the host's own fault
    assert device.state == "STOPPED"


def test_stop_and_estop_are_obeyed_each_time_with_any_seq(device):
    staged = device.go(SET)
    estop, stop = frame("ESTOP", 3), frame("STOP", 4)
    for data, state in ((estop, "ESTOP"), (stop, "STOPPING")):
        for _ in range(2):
            assert device.exchange(data)[0] == "ACK"
            assert device.state == state
            device.run([0] * 30)
            if state == "ESTOP":
                device.must("CLEAR", boot_id=7)
            device.beat()
            device.confirm("START", staged)
            assert device.state == "RUNNING"


def test_other_bytes_with_the_same_seq_are_another_request(device):
    for model, set_id in ((SET, 1), (OTHER, 2)):
        assert device.exchange(frame("SET_PARAMS", 9, parameters(model, set_id)))[1]["set_id"] == set_id
    assert device.status()["staged_id"] == 2


def test_reading_again_reads_again(device):
    data = frame("GET_STATUS", 5)
    first = device.exchange(data)[1]["tick"]
    device.tick()
    assert device.exchange(data)[1]["tick"] == first + 1


# Echo, buffers, telemetry


def test_echo(device):
    for payload in (b"", bytes(64), bytes(range(64))):
        assert device.ask("ECHO", payload) == ("ECHO_REPLY", {"payload": payload})


def test_answers_that_do_not_fit_are_dropped_whole(device):
    device.drain()
    for seq in range(10):
        device.feed(frame("ECHO", seq, bytes([seq + 1]) * 64))
    answers = device.collect()
    assert [seq for _, seq, _ in answers] == list(range(7))  # 7 x 72 of 512 bytes
    assert device.must("GET_STATUS")["frames_dropped"] == 0


def test_hb_receive_returns_after_each_frame_that_it_carried_out(device):
    data = frame("ECHO", 1, b"a") + b"\0" + frame("ECHO", 2, b"b")
    taken = device.lib.shim_receive_once(device.memory, data, len(data))
    assert taken == len(frame("ECHO", 1, b"a"))


def test_telemetry(device):
    device.go(SET)
    device.must("STREAM", divisor=2, fields=1)
    sensed = [float(i) for i in range(20)]
    forces = [device.tick(10 * i, sensed=sensed[i]) for i in range(20)]
    device.collect()
    assert [message["tick"] for message in device.telemetry] == [1, 9]
    rows = [row for message in device.telemetry for row in message["repeated"]]
    assert [row[0] for row in rows] == [20 * i for i in range(8)]
    assert [row[2] for row in rows] == forces[:16:2] and [row[3] for row in rows] == sensed[:16:2]
    assert [row[1] & 1 for row in rows] == [0] + [1] * 7
    device.must("STREAM", divisor=0, fields=0)
    device.telemetry.clear()
    device.run([0] * 50)
    device.collect()
    assert device.telemetry == []


def test_telemetry_leaves_room_for_answers_and_counts_what_is_lost(device):
    device.must("STREAM", divisor=1, fields=0)
    device.drain()
    device.run(range(1000))
    device.feed(frame("ECHO", 1, bytes(64)))
    (answer,) = device.collect()
    assert answer[0] == "ECHO_REPLY"
    assert len(device.telemetry) == 5 and not any(message["lost"] for message in device.telemetry)
    device.run(range(14))
    device.collect()
    assert device.telemetry[-1]["lost"] == 1000 // 7 * 7 - 35


def test_the_table_of_line_rates():
    """Each printed rate carries its divisor, and one baud less does not."""
    rows = re.findall(r"^\| (\d)[^|]*\|[^|]*\|[^|]*\|[^|]*\| ([\d,/ ]+) \|$", DOCUMENT, re.M)
    assert [int(fields) for fields, _ in rows] == [0, 1]
    for fields, rates in rows:
        for divisor, rate in zip((1, 2, 4, 10, 20), rates.replace(",", "").split(" / "), strict=True):
            asked = {"divisor": divisor, "fields": int(fields)}
            Device(line_rate_baud=int(rate)).must("STREAM", **asked)
            _, message = Device(line_rate_baud=int(rate) - 1).ask("STREAM", **asked)
            assert (message["reason"], message["limit"]) == ("LINE_TOO_SLOW", divisor + 1)


def test_what_a_device_cannot_do_is_refused():
    device = Device(capabilities=0)
    assert device.refusal("STREAM", divisor=10, fields=1) == "NOT_CAPABLE"
    assert device.refusal("DRIVE", duration_ticks=10, boot_id=7) == "NOT_CAPABLE"


@pytest.mark.parametrize(
    ("change", "reason", "value", "limit"),
    [
        ({"offset": float("nan")}, "NOT_FINITE", 0, 0),
        ({"amplitude": float("inf")}, "NOT_FINITE", 0, 0),
        ({"offset": 41.0}, "DRIVE_RANGE", 41, 40),
        ({"offset": -41.0}, "DRIVE_RANGE", -41, -40),
        ({"mode": 1, "offset": 61.0}, "DRIVE_RANGE", 61, 60),
        ({"mode": 1, "offset": -21.0}, "DRIVE_RANGE", -21, -20),
        ({"shape": 1, "offset": 30.0, "amplitude": 11.0, "period_ticks": 10}, "DRIVE_RANGE", 41, 40),
        ({"shape": 1, "offset": 3e38, "amplitude": 3e38, "period_ticks": 10}, "DRIVE_RANGE", float("inf"), 40),
        ({"shape": 2, "amplitude": -41.0, "period_ticks": 10}, "DRIVE_RANGE", -41, -40),
        ({"shape": 1, "period_ticks": 3}, "DRIVE_RANGE", 3, 4),
        ({"shape": 2, "period_ticks": 120001}, "DRIVE_RANGE", 120001, 120000),
        ({"duration_ticks": 0}, "DRIVE_RANGE", 0, 1),
        ({"duration_ticks": 120001}, "DRIVE_RANGE", 120001, 120000),
    ],
)
def test_drive_out_of_range(device, change, reason, value, limit):
    device.beat()
    asked = {"offset": 1.0, "duration_ticks": 100, "boot_id": 7} | change
    kind, message = device.ask("DRIVE", **asked)
    assert (kind, message["reason"], message["value"], message["limit"]) == ("NACK", reason, value, limit)
    assert device.state == "STOPPED"


def test_drive_needs_a_heartbeat(device):
    assert device.refusal("DRIVE", offset=1.0, duration_ticks=100, boot_id=7) == "NO_HEARTBEAT"


def test_limits_are_those_of_the_config(device):
    found = device.must("GET_LIMITS")
    for name in ("K0", "K1", "B1", "alpha"):
        assert found[f"{name}_low"] == np.float32(CONFIG[f"{name}_low"])
        assert found[f"{name}_high"] == np.float32(CONFIG[f"{name}_high"])


def test_a_notice_tells_of_the_start_and_of_every_change_of_state(device):
    device.go(SET)
    device.must("STOP")
    device.run([0] * 30)
    device.must("ESTOP")
    device.collect()
    told = [(notice["state"], CAUSES[notice["reason"]]) for notice in device.notices]
    assert told == [(0, "BOOT"), (1, "NONE"), (2, "NONE"), (0, "NONE"), (5, "ESTOP")]


# The config


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"tick_rate_Hz": 99}, "tick_rate_Hz"),
        ({"watchdog_ticks": 0}, "watchdog_ticks"),
        ({"hold_ticks": 1001}, "hold_ticks"),
        ({"most_taps": 256}, "HB_MAX_TAPS"),
        ({"most_states": 13}, "HB_MAX_STATES"),
        ({"capabilities": 16}, "capabilities"),
        ({"line_rate_baud": 1199}, "line_rate_baud"),
        ({"damping": 0.0}, "damping"),
        ({"damping": float("nan")}, "damping"),
        ({"force_limit": 1001.0}, "force limit"),
        ({"slew": float("inf")}, "slew"),
        ({"low": 1.0}, "stroke"),
        ({"high": 417.0}, "stroke"),
        ({"step": 0.2}, "stroke"),
        ({"plausible": 1.0}, "plausible_step_mm"),
        ({"K1_low": 0.0}, "K1"),
        ({"alpha_high": 1.0}, "alpha"),
        ({"K0_low": 41.0}, "low <= high"),
        ({"servo_stiffness": -1.0}, "servo"),
        ({"servo_speed": 1001.0}, "servo"),
    ],
)
def test_a_config_that_is_refused(change, word):
    device = Device(hello=False, **change)
    sentence = device.lib.shim_sentence(device.error).decode()
    assert device.error != 0 and word in sentence and sentence.endswith(".")


def test_every_error_has_a_sentence_of_its_own():
    lib = library(build())
    sentences = [lib.shim_sentence(error) for error in range(10)]
    assert len(set(sentences)) == 10 and lib.shim_sentence(99) == lib.shim_sentence(10)
