"""The device's C programs for the tests: built once, started as child processes, spoken to in raw bytes.

Tests that count ticks run the host port in lockstep: it ticks when told to through its stdin, so that no test depends
on the clock of the machine. Bytes written to a terminal may reach the other side later than bytes written to a pipe;
so every step ends with an answer.
"""

import fcntl
import os
import re
import select
import shutil
import struct
import subprocess
import termios
import time
import zlib
from pathlib import Path
from typing import NamedTuple

import pytest
from device_wire import Answer, Type, decode, encode, set_crc, set_params

__all__ = ["BUILD", "COMPILERS", "FIRMWARE", "FOAM", "SCHEMA", "Port", "State", "Status", "Talk", "image", "program"]

ROOT = Path(__file__).parents[2]
FIRMWARE = ROOT / "firmware"
BUILD = ROOT / "build" / "firmware"
PATIENCE = 120.0  # s: how long a test waits for an answer before it calls it missing; no test asserts a time
_BLOCK = re.search(r"```schema\n(.*?)```", (FIRMWARE / "PROTOCOL.md").read_text(encoding="utf-8"), re.S)
assert _BLOCK
SCHEMA = zlib.crc32(_BLOCK[1].encode())
FOAM = (-2.89, 5.70, 5.89, 0.203)  # K0, K1, B1, alpha: memory foam, system identification
TICKS_PER_HEARTBEAT = 50


COMPILERS = ("gcc", "clang")


def program(name: str, compiler: str | None = None) -> Path:
    """A host program, up to date, by this compiler or the first that is here. Skips without one, or without make."""
    compilers = [known for known in COMPILERS if shutil.which(known) and compiler in (None, known)]
    if not compilers or not shutil.which("make"):
        pytest.skip(f"the device's programs need make and {compiler or 'a C compiler'} (Debian: make, gcc, clang)")
    return _made(f"{compilers[0]}/{name}")


def image(name: str, cpu: str) -> Path:
    """An image for m4 or m7, up to date. Skips without cross compiler or emulator."""
    for tool, package in (("arm-none-eabi-gcc", "gcc-arm-none-eabi"), ("qemu-system-arm", "qemu-system-arm")):
        if not shutil.which(tool):
            pytest.skip(f"the Cortex-M images need {tool} (Debian: {package}, and libnewlib-arm-none-eabi)")
    return _made(f"{cpu}/{name}.elf")


def _made(target: str) -> Path:
    BUILD.mkdir(parents=True, exist_ok=True)
    with open(BUILD / ".lock", "w") as lock:  # several workers of one run ask at once
        fcntl.flock(lock, fcntl.LOCK_EX)
        run = subprocess.run(
            ["make", "-C", str(FIRMWARE), f"BUILD={BUILD}", str(BUILD / target)], capture_output=True, text=True
        )
    assert run.returncode == 0, run.stdout + run.stderr
    return BUILD / target


class State:
    """Numbers of the states."""

    STOPPED, RUNNING, STOPPING, DRIVING, HOLD, ESTOP = range(6)


class Status(NamedTuple):
    """STATUS, field by field."""

    tick: int
    boot_id: int
    state: int
    hold_reason: int
    staging: int
    contact: int
    active_id: int
    staged_id: int
    active_crc: int
    staged_crc: int
    ticks_until_ready: int
    position_mm: float
    force_N: float
    energy_mJ: float
    input_held: int
    saturated: int
    slewed: int
    controlled: int
    holds: int
    estops: int
    overruns: int
    frames_dropped: int
    stops: int
    flags: int
    delay_us: int


class Talk:
    """A conversation over an open file: requests and their answers, and what comes unasked."""

    def __init__(self, file: int):
        self.file = file
        self.seq = 0
        self.rest = b""
        self.joined_late = False
        self.unasked: list[Answer] = []
        self.boot_id = self.stops = self.heard = 0

    def send(self, data: bytes) -> None:
        while data:
            data = data[os.write(self.file, data) :]

    def request(self, type: int, payload: bytes = b"") -> Answer:
        """The answer with this request's seq; notices, telemetry and older answers are kept in `unasked`."""
        self.seq = (self.seq + 1) % 256
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            self.send(encode(type, payload, self.seq))  # again, too, where a full line has swallowed the answer
            while answers := self.listen():
                mine = [
                    a for a in answers if a.seq == self.seq and a.type not in (Type.NOTICE, Type.TELEMETRY, Type.PULSE)
                ]
                self.unasked += [a for a in answers if a not in mine]
                if mine:
                    return mine[0]
        raise AssertionError(f"no answer to request {type:#x}")

    def listen(self, patience: float = 1.0) -> list[Answer]:
        """The next frames that come, within about `patience` s; none if the line is silent."""
        answers: list[Answer] = []
        while not answers and select.select([self.file], [], [], patience)[0]:
            answers = self._read()
        return answers

    def _read(self) -> list[Answer]:
        *frames, self.rest = (self.rest + os.read(self.file, 65536)).split(b"\0")
        if frames and self.joined_late:
            del frames[0]  # begun before this host listened, or empty
            self.joined_late = False
        return [decode(frame) for frame in frames if frame]

    def expect_ack(self, type: int, payload: bytes = b"") -> int:
        """Sends a request that must be acknowledged; the CRC in the ACK."""
        answer = self.request(type, payload)
        assert (answer.type, answer.payload[0]) == (Type.ACK, type), f"{type:#x} got {answer}"
        return struct.unpack_from("<I", answer.payload, 4)[0]

    def hello(self) -> Answer:
        answer = self.request(Type.HELLO, struct.pack("<HHI", 2, 0, SCHEMA))
        assert answer.type == Type.HELLO_REPLY, answer
        (self.boot_id,) = struct.unpack_from("<I", answer.payload, 12)
        return answer

    def status(self) -> Status:
        answer = self.request(Type.GET_STATUS)
        assert answer.type == Type.STATUS
        status = Status(*struct.unpack("<IIBBBBHHIIIfff8HIHH", answer.payload))
        self.heard, self.stops = status.tick, status.stops
        return status

    def heartbeat(self) -> None:
        """A heartbeat with a fresh tick that has arrived."""
        self.status()
        self.send(encode(Type.HEARTBEAT, struct.pack("<II", self.boot_id, self.heard)))
        self.request(Type.ECHO)

    def named(self, set_id: int, crc: int) -> bytes:
        """Payload of COMMIT."""
        return struct.pack("<HHII", set_id, 0, crc, self.boot_id)

    def start(self, set_id: int, crc: int) -> bytes:
        """Payload of START, after the stops that STATUS told last."""
        return self.named(set_id, crc) + struct.pack("<I", self.stops)

    def clear(self) -> bytes:
        """Payload of CLEAR, of the stop that STATUS told last."""
        return struct.pack("<II", self.boot_id, self.stops)


class Port(Talk):
    """hilbo-device as a child process, in lockstep unless told otherwise."""

    def __init__(self, *options: str, rate: str = "lockstep", compiler: str | None = None):
        command = [program("hilbo-device", compiler), "--rate", rate, "--control", *options]
        self.finger = options[options.index("--finger") + 1] if "--finger" in options else "all"
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        assert self.process.stdout
        self.slave = self.process.stdout.readline().decode().strip()
        super().__init__(self._open())

    def _open(self) -> int:
        file = os.open(self.slave, os.O_RDWR | os.O_NOCTTY)
        termios.tcflush(file, termios.TCIFLUSH)
        return file

    def __enter__(self) -> "Port":
        return self

    def __exit__(self, *_) -> None:
        os.close(self.file)
        self.process.kill()
        self.process.communicate()

    def reopen(self) -> None:
        """Another host on the same line."""
        os.close(self.file)
        self.file, self.rest, self.joined_late = self._open(), b"", True
        self.send(b"\0" + encode(Type.GET_STATUS))  # the first frame may be half of one, and is dropped

    def command(self, text: str) -> list[str]:
        """A line for the port's stdin, and the words of its answer."""
        assert self.process.stdin and self.process.stdout
        self.process.stdin.write(text.encode() + b"\n")
        self.process.stdin.flush()
        return self.process.stdout.readline().decode().split()

    def tick(self, count: int) -> float:
        """`count` ticks without a heartbeat; the last force (N)."""
        word, _, force, _ = self.command(f"tick {count}")
        assert word == "tick"
        return float(force)

    def live(self, count: int) -> float:
        """`count` ticks with a heartbeat as often as the protocol wants one; the last force (N)."""
        force = 0.0
        for done in range(0, count, TICKS_PER_HEARTBEAT):
            self.heartbeat()
            force = self.tick(min(TICKS_PER_HEARTBEAT, count - done))
        return force

    def let_go(self) -> None:
        """The finger leaves the surface, and then begins again."""
        if self.status().contact:
            self.command("finger ramp")
            while self.status().contact:
                self.live(50)
            self.command(f"finger {self.finger}")

    def run(self, set_id: int = 1, parameters: tuple[float, ...] = FOAM) -> int:
        """HELLO, one set in force, and START; the set's CRC."""
        self.hello()
        payload = set_params(set_id, *parameters)
        crc = self.expect_ack(Type.SET_PARAMS, payload)
        assert crc == set_crc(payload)
        self.let_go()
        self.expect_ack(Type.COMMIT, self.named(set_id, crc))
        self.live(2)
        self.expect_ack(Type.START, self.start(set_id, crc))
        return crc
