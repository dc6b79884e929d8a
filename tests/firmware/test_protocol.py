"""What each message gets: the tables of PROTOCOL.md, row by row, against the C device."""

import struct
import zlib

import numpy as np
import pytest
from helpers_firmware import DOCUMENT, TYPES, Device, cobs, frame, full_set, pack, parameters

SET = {"K0": -3.18, "K1": 5.58, "B1": 7.88, "alpha": 0.176}
OTHER = {"K0": -2.5, "K1": 4.0, "B1": 6.0, "alpha": 0.2}
REQUESTS = [name for name, number in TYPES.items() if number < 0x40]


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


@pytest.mark.parametrize("number", [0, 0x12, 0x40, TYPES["ACK"], TYPES["TELEMETRY"], 0xFF])
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
    values = {"version": 2} if name == "HELLO" else {"set_id": 1} if name != "DRIVE" else {}
    assert device.refusal(name, pack(name, reserved=1, **values)) == "RESERVED"


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("SET_PARAMS", {"set_id": 0, "length": 101}),
        ("SET_PARAMS", {"set_id": 1, "memory": 2}),
        ("GET_SET", {"bank": 2}),
        ("STREAM", {"divisor": 10, "fields": 2}),
        ("DRIVE", {"mode": 2, "boot_id": 7}),
        ("DRIVE", {"shape": 4, "boot_id": 7}),
        ("DRIVE", {"mode": 1, "shape": 3, "boot_id": 7}),
    ],
)
def test_numbers_without_a_name(device, name, values):
    assert device.refusal(name, **values) == "RESERVED"


# HELLO


def test_before_hello_only_what_is_safe():
    for name in REQUESTS:
        device = Device(hello=False)
        if name in ("HELLO", "GET_STATUS", "STOP", "ESTOP"):
            device.must(name, **({"version": 2, "schema": CRC} if name == "HELLO" else {}))
        elif name != "HEARTBEAT":
            assert device.refusal(name) == "NO_HELLO"
    assert Device(hello=False).refusal(0x77, b"") == "NO_HELLO"


CRC = zlib.crc32(DOCUMENT.split("```schema\n")[1].split("```")[0].encode())


def test_hello_compares_version_and_schema(device):
    assert device.refusal("HELLO", version=1, schema=CRC) == "VERSION"
    assert device.refusal("HELLO", version=2, schema=CRC ^ 1) == "SCHEMA"
    reply = device.must("HELLO", version=2, schema=CRC)
    assert reply["schema"] == CRC and reply["boot_id"] == 7 and reply["damping_N_s_per_m"] == np.float32(0.95)
    assert (reply["most_taps"], reply["watchdog_ticks"], reply["firmware"]) == (255, 250, 0xDEADBEEF)


def test_hello_resets_the_stream_and_nothing_else(device):
    device.go(SET)
    device.must("STREAM", divisor=1, fields=0)
    device.hello()
    device.run([50] * 20)
    device.collect()
    assert device.telemetry == [] and device.state == "RUNNING"


# Sets


@pytest.mark.parametrize("name", ["COMMIT", "START", "DRIVE", "CLEAR", "HOME"])
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
    drive = {"offset": 1.0, "duration_ticks": 100, "boot_id": 7}
    _, message = device.ask("DRIVE", **drive)
    assert (message["reason"], message["value"]) == ("STATE", 1)
    assert device.refusal("HOME", boot_id=7) == "STATE"
    device.must("CLEAR", boot_id=7)  # of a stop that has ended: nothing
    assert device.state == "RUNNING"
    device.must("STOP")
    assert device.confirm("START", staged)[1]["reason"] == "STATE"
    device.must("ESTOP")
    assert device.confirm("START", staged)[1]["reason"] == "STATE"
    assert device.refusal("DRIVE", **drive) == "STATE"
    device.must("STOP")
    assert device.state == "ESTOP"
    device.must("CLEAR", boot_id=7)
    assert device.state == "STOPPED"


def test_heartbeats_that_do_not_count(device):
    staged = device.stage(SET)
    device.confirm("COMMIT", staged)
    now = device.status()["tick"]
    for payload in (pack("HEARTBEAT", boot_id=8, tick=now), b"", pack("HEARTBEAT", boot_id=7, tick=now) + b"\0"):
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


# Orders in time


def test_a_clear_ends_the_stop_that_it_names_and_no_later_one(device):
    """However often it comes, and whatever was asked in between: what was measured began with the ESTOP's own CLEAR,
    whose answer was lost, and which the link sent again after the next ESTOP."""
    device.must("ESTOP")
    clear = frame("CLEAR", 50, device.packed("CLEAR", boot_id=7))
    assert device.exchange(clear)[0] == "ACK" and device.state == "STOPPED"
    device.status()
    assert device.exchange(clear)[0] == "ACK" and device.state == "STOPPED"
    device.must("ESTOP")
    for data in (clear, frame("CLEAR", 51, pack("CLEAR", boot_id=7, stop=device.stops - 1))):
        device.exchange(data)
        assert device.state == "ESTOP"
    _, message = device.ask("CLEAR", boot_id=7, stop=device.stops - 1)
    assert (message["reason"], message["ticks"]) == ("STALE", device.stops)


def test_each_stop_counts_once(device):
    for name in ("STOP", "ESTOP", "ESTOP", "STOP"):
        before = device.stops
        assert device.must(name)["stops"] == before + 1


@pytest.mark.parametrize("stop", ["STOP", "ESTOP"])
def test_an_order_that_was_made_before_a_stop_does_nothing_after_it(device, stop):
    staged = device.stage(SET)
    device.confirm("COMMIT", staged)
    device.beat()
    named = {"set_id": staged[0], "crc": staged[1]}
    orders = [("START", named), ("DRIVE", {"offset": 1.0, "duration_ticks": 9}), ("HOME", {}), ("CLEAR", {})]
    late = [(name, device.packed(name, boot_id=7, **values)) for name, values in orders]
    device.must(stop)  # of a device that rests already
    before = device.state
    for name, payload in late:
        assert device.refusal(name, payload) == "STALE"
        assert device.state == before


def test_start_and_drive_act_once_whatever_comes_between(device):
    staged = device.stage(SET)
    device.confirm("COMMIT", staged)
    device.beat()
    start = device.packed("START", set_id=staged[0], crc=staged[1], boot_id=7)
    assert [device.ask("START", start)[0] for _ in range(2)] == ["ACK", "ACK"]
    device.must("STOP")
    device.run([0] * 30)
    assert device.refusal("START", start) == "STALE" and device.state == "STOPPED"
    drive = device.packed("DRIVE", offset=1.0, duration_ticks=9, boot_id=7)
    stops = device.stops
    for seq in (0, 1):
        assert device.ask("DRIVE", drive)[0] == "ACK", seq
        device.status()
    device.run([0] * 40)
    assert device.state == "STOPPED" and device.stops == stops + 1
    assert device.refusal("DRIVE", drive) == "STALE" and device.state == "STOPPED"


def test_a_hold_ends_orders_too(device):
    staged = device.go(SET)
    start = device.packed("START", set_id=staged[0], crc=staged[1], boot_id=7)
    device.run([0] * 300, beating=False)
    assert device.state == "HOLD"
    device.must("CLEAR", boot_id=7)
    device.beat()
    assert device.refusal("START", start) == "STALE" and device.state == "STOPPED"


def test_what_is_read_in_between_forgets_no_answer(device):
    data = frame("SET_PARAMS", 77, parameters(OTHER, 2))
    first = device.exchange(data)
    device.run([100] * 100)
    device.status()
    left = device.status()["ticks_until_ready"]
    assert device.exchange(data) == first
    assert device.status()["ticks_until_ready"] == left  # not carried out again


def test_hello_ends_the_memory_of_answers(device):
    """Another host may begin with the same seq and bytes as the last one ended with."""
    data = frame("STREAM", 9, pack("STREAM", divisor=1, fields=0))
    device.exchange(data)
    device.hello()
    device.exchange(data)
    device.run([0] * 20)
    device.collect()
    assert device.telemetry


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
