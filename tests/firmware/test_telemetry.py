"""What the device says and can do: echo, telemetry, drives, limits, notices, its config, against the C device."""

import re

import numpy as np
import pytest
from helpers_firmware import CAUSES, CONFIG, DOCUMENT, NAMES, Device, build, decode, frame, library

SET = {"K0": -3.18, "K1": 5.58, "B1": 7.88, "alpha": 0.176}


@pytest.fixture
def device():
    return Device()


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
    assert [message["tick"] for message in device.telemetry] == [2, 10]
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
        ({"shape": 1, "offset": -30.0, "amplitude": 11.0, "period_ticks": 10}, "DRIVE_RANGE", -41, -40),
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


def test_a_stream_that_does_not_fit_is_told_what_does():
    device = Device(line_rate_baud=9600)
    _, message = device.ask("STREAM", divisor=2, fields=0)
    assert (message["reason"], message["value"], message["limit"]) == ("LINE_TOO_SLOW", 2, 14)


def test_drive_needs_a_heartbeat(device):
    kind, message = device.ask("DRIVE", offset=1.0, duration_ticks=100, boot_id=7)
    assert (kind, message["reason"]) == ("NACK", "NO_HEARTBEAT")
    assert (message["value"], message["limit"]) == (0.0, 0.0)  # of numbers that are right nothing is said


def test_limits_are_those_of_the_config(device):
    limits = device.must("GET_LIMITS")
    for name in ("K0", "K1", "B1", "alpha"):
        assert limits[f"{name}_low"] == np.float32(CONFIG[f"{name}_low"])
        assert limits[f"{name}_high"] == np.float32(CONFIG[f"{name}_high"])


def test_notices_and_pulses_have_the_seq_of_nobody_s_request(device):
    device.drain()
    device.seq = 9
    device.feed(frame("ESTOP", 9))
    device.beat()
    told = [decode(part) for part in device.drain().split(b"\0") if part]
    assert [(NAMES[kind], seq) for kind, seq, _ in told] == [("NOTICE", 0), ("ACK", 9), ("PULSE", 0)]


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
        ({"capabilities": 32}, "capabilities"),
        ({"line_rate_baud": 1199}, "line_rate_baud"),
        ({"damping": 0.0}, "damping"),
        ({"damping": float("nan")}, "damping"),
        ({"force_limit": 101.0}, "force limit"),
        ({"slew": float("inf")}, "slew"),
        ({"slew": 39.0}, "slew"),
        ({"velocity": 12.0}, "velocity"),
        ({"damping": 1001.0}, "damping"),
        ({"low": 0.0}, "stroke"),
        ({"delay_us": 1001}, "delay_us"),
        ({"continuous_force": 40.5}, "continuous_force_N"),
        ({"heating": 0.0}, "heating_s"),
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
    sentences = [lib.shim_sentence(error) for error in range(14)]
    assert len(set(sentences)) == 14 and lib.shim_sentence(99) == lib.shim_sentence(14)


def test_a_real_device_has_a_delay_and_every_start_has_an_id():
    lib = library(build())
    real = Device(hello=False)
    real.config["capabilities"] = 3
    real.boot(7)
    assert b"delay_us" in lib.shim_sentence(real.error)
    device = Device(hello=False, boot_id=0)
    assert b"boot id" in lib.shim_sentence(device.error)
