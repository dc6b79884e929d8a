"""Frames: golden bytes, damage of every kind, truncation anywhere, and all of it once more under sanitizers."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers_firmware import CORE, NAMES, REASONS, STATES, TYPES, Device, build, frame, library, pack, parameters

from tests.vectors import make_frames

VECTORS = Path(__file__).parents[1] / "vectors" / "frames.txt"
SANITIZE = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-g")
SET = {"K0": -3.18, "K1": 5.58, "B1": 7.88, "alpha": 0.176}


def run(driver: str, *arguments) -> str:
    program = build(drivers=(driver,))
    done = subprocess.run([program, *map(str, arguments)], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_file_is_what_its_generator_makes():
    assert VECTORS.read_text().splitlines() == make_frames.lines()


def test_golden_frames_cover_every_message():
    assert {int(line.split()[1], 16) for line in make_frames.lines()} == set(TYPES.values())


def test_golden_frames_in_c():
    assert run("test_frames.c", VECTORS).endswith(f"{len(make_frames.lines())} frames, 0 faults\n")


def test_golden_frames_and_the_helper_agree():
    for line in make_frames.lines():
        _, kind, seq, payload, encoded = line.split()
        assert frame(int(kind, 16), int(seq, 16), bytes.fromhex(payload.strip("-"))).hex() == encoded


def test_numbers_with_names_are_those_of_the_document():
    header = (CORE / "hb_messages.h").read_text()
    reasons = {int(number): name for name, number in re.findall(r"HB_NACK_(\w+) = (\d+)", header)}
    types = {int(number, 16): name for name, number in re.findall(r"HB_(\w+) = 0x([0-9a-f]{2})", header)}
    assert reasons == REASONS
    assert types == NAMES


@pytest.mark.parametrize("rate", [1e-4, 1e-3, 1e-2])
@pytest.mark.parametrize("frames", [20_000, pytest.param(1_000_000, marks=pytest.mark.deep)])
def test_a_bad_line(rate, frames):
    """No frame comes out that was not sent, and the next 0x00 starts afresh."""
    sent, hit, lost, wrong, unrecovered = map(int, run("noise.c", frames, rate, 1).split())
    print(f"rate {rate}: {hit} of {sent} hit, {lost / hit:.4f} lost for each, {wrong} accepted wrongly")
    assert sent == frames and hit > 0
    assert wrong == 0
    assert unrecovered == 0
    assert lost <= 1.1 * hit  # a frame that loses its 0x00 takes the next one with it


def conversation(boot_id: int) -> bytes:
    """From HELLO to START, then a heartbeat and a second set."""
    device = Device(boot_id)  # only to know the checksum
    identity = dict(zip(("set_id", "crc"), device.stage(SET), strict=True)) | {"boot_id": boot_id}
    hello = next(line.split()[4] for line in make_frames.lines() if line.startswith("HELLO "))
    parts = [
        bytes.fromhex(hello),
        frame("SET_PARAMS", 1, parameters(SET)),
        frame("HEARTBEAT", 0, pack("HEARTBEAT", boot_id=boot_id)),
        frame("COMMIT", 2, pack("COMMIT", **identity)),
        frame("START", 3, pack("START", **identity, stop=0)),
        frame("SET_PARAMS", 4, parameters(SET | {"K1": 5.0}, 2)),
    ]
    return b"".join(parts)


def test_a_conversation_cut_after_every_byte():
    """The device runs only what was confirmed to the last byte, falls silent in time, and hears the next host."""
    whole = conversation(boot_id=7)
    ends = [at + 1 for at, byte in enumerate(whole) if byte == 0]
    lib = library(build())
    for cut in range(len(whole) + 1):
        device = Device(7, lib, hello=False)
        device.tick(0)
        device.feed(whole[:cut])
        forces, _ = device.run(np.minimum(50 * np.arange(1, 301), 200), beating=False)
        assert np.any(forces > 0) == (cut >= ends[4])
        assert not np.any(forces[250 + 20 :])
        device.collect()
        device.feed(b"\0")
        device.hello()
        status = device.status()
        assert STATES[status["state"]] == ("HOLD" if cut >= ends[4] else "STOPPED")
        closed_late = cut + 1 in ends  # the next host's 0x00 ends the frame, which is then whole
        assert status["active_id"] == (1 if cut >= ends[3] or (closed_late and cut > ends[2]) else 0)
        assert status["frames_dropped"] == (cut not in (0, *ends) and not closed_late)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.deep) for seed in range(1, 40))])
def test_any_bytes_leave_the_device_safe(seed):
    """Random and damaged conversations: forces stay finite and within the limit, and only whole sets are felt."""
    rng = np.random.default_rng(seed)
    lib = library(build())
    whole = np.frombuffer(conversation(boot_id=7), np.uint8)
    for _ in range(60):
        device = Device(7, lib, hello=False)
        bytes_in = np.resize(whole, 3 * whole.size).copy()
        hits = rng.random(bytes_in.size) < rng.choice([1e-3, 1e-2, 1e-1])
        bytes_in[hits] = rng.integers(0, 256, hits.sum())
        x = np.cumsum(rng.integers(-30, 31, bytes_in.size)) % 3000 - 500
        for at in range(0, bytes_in.size, 12):
            device.feed(bytes_in[at : at + 12].tobytes())
            force = device.tick(int(x[at]))
            assert 0 <= force <= 30
            device.drain()
        device.feed(b"\0")
        assert device.status()["active_id"] in (0, 1, 2)


SANITIZED = [
    "test_frames.py::test_any_bytes_leave_the_device_safe",
    "test_frames.py::test_a_conversation_cut_after_every_byte",
    "test_protocol.py",
    "test_sets.py",
    "test_telemetry.py",
    "test_safety.py",
]


@pytest.mark.deep
def test_the_same_under_sanitizers():
    """The conversations again, in a Python that has gcc's address sanitizer loaded first."""
    runtime = ""
    if shutil.which("gcc"):
        asked = ["gcc", "-print-file-name=libasan.so"]
        runtime = subprocess.run(asked, capture_output=True, text=True, check=True).stdout.strip()
    if not Path(runtime).is_absolute():
        pytest.skip("there is no gcc with an address sanitizer")
    environment = os.environ | {
        "CC": "gcc", "LD_PRELOAD": runtime, "ASAN_OPTIONS": "detect_leaks=0",
        "HILBO_FIRMWARE_FLAGS": " ".join(SANITIZE),
    }  # fmt: skip
    names = [str(Path(__file__).parent / name) for name in SANITIZED]
    options = ["-q", "-s", "-n", "0", "-m", "not deep", "-p", "no:cacheprovider"]
    command = [sys.executable, "-m", "pytest", *options, *names]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, cwd=Path(__file__).parents[2])
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
