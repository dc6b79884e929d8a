"""Recorded inputs for the core (firmware/port/bench/replay.h), and what host programs and images make of them."""

import re
import struct
import subprocess
from pathlib import Path
from typing import NamedTuple

import numpy as np
from device_port import SCHEMA, TICKS_PER_HEARTBEAT, image, program
from device_wire import Type, encode, set_crc, set_params, set_states

__all__ = ["ENCODER_STEP", "MACHINES", "Recording", "Section", "emulate", "replay", "rich_motion"]

ENCODER_STEP = 0.0127  # mm
MACHINES = {"m4": "mps2-an386", "m7": "mps2-an500"}
COUNTS_PER_INSTRUCTION = 25.6  # of the 25 MHz timer, where an instruction takes 2^10 ns


class Section(NamedTuple):
    """Instructions of the calls in one section: of hb_tick, and of hb_receive for a whole frame."""

    ticks: int
    least: int
    mean: int
    most: int
    frames: int
    most_of_a_frame: int


class Recording:
    """A host's bytes and the encoder's counts, in order. The boot id is 1."""

    def __init__(self):
        self.bytes = b"HBR1"
        self.seq = 0
        self.ticks_done = 0

    def section(self, name: str) -> None:
        self.bytes += struct.pack("<BB", 3, len(name)) + name.encode()

    def send(self, type: int, payload: bytes = b"") -> None:
        self.seq = (self.seq + 1) % 256
        frame = encode(type, payload, self.seq)
        self.bytes += struct.pack("<BB", 1, len(frame)) + frame

    def ticks(self, counts) -> None:
        """One tick at each of these counts, with heartbeats among them."""
        counts = np.asarray(counts, "<i2")
        while counts.size:
            room = TICKS_PER_HEARTBEAT - self.ticks_done % TICKS_PER_HEARTBEAT
            if room == TICKS_PER_HEARTBEAT:
                self.send(Type.HEARTBEAT, struct.pack("<II", 1, self.ticks_done))
            now, counts = counts[:room], counts[room:]
            self.bytes += struct.pack("<BH", 2, now.size) + now.tobytes()
            self.ticks_done += now.size

    def hello(self) -> None:
        self.send(Type.HELLO, struct.pack("<HHI", 2, 0, SCHEMA))

    def set(self, set_id: int, *parameters: float, states=None, N: int = 101) -> bytes:
        """Stages a set; the payload that COMMIT and START want. `states`: weights and losses of full memory."""
        full = states is not None
        length = len(states[0]) if full else N
        payloads = [set_params(set_id, *parameters, memory=int(full), length=length)]
        self.send(Type.SET_PARAMS, payloads[0])
        for payload in set_states(set_id, *states) if full else []:
            self.send(Type.SET_STATES, payload)
            payloads.append(payload)
        return struct.pack("<HHII", set_id, 0, set_crc(*payloads), 1)

    def done(self) -> bytes:
        return self.bytes + b"\0"


def rich_motion(ticks: int, seed: int, deepest: float = 9.0) -> np.ndarray:
    """Encoder counts of a hand that presses, holds, swings and leaves: slow and quick sines, and pauses; first at 0."""
    rng = np.random.default_rng(seed)
    t = 1e-3 * np.arange(ticks)
    x = 0.35 * np.sin(2 * np.pi * rng.uniform(0.2, 0.6) * t + rng.uniform(0, 6))
    for frequency, part in ((2.0, 0.3), (rng.uniform(3, 6), 0.15), (rng.uniform(8, 15), 0.04)):
        x += part * np.sin(2 * np.pi * frequency * t + rng.uniform(0, 6))
    x = deepest * np.clip(0.55 + x, -0.1, 0.9)  # pauses at the bottom and holds at the top
    x *= np.minimum(t / 0.3, 1)
    return np.rint(x / ENCODER_STEP).astype(np.int16)


def replay(recording: bytes, folder: Path, compiler: str | None = None) -> tuple[str, np.ndarray]:
    """What the host program says of a recording, and the bits of its forces."""
    source, target = folder / "input", folder / f"output-{compiler}"
    source.write_bytes(recording)
    command = [program("hilbo-replay", compiler), source, target]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    return run.stdout.strip(), np.fromfile(target, "<u4")


def emulate(recording: bytes, folder: Path, cpu: str) -> tuple[str, np.ndarray, dict[str, Section], int]:
    """The same from an image in the emulator, with the instructions of each section, and bytes of stack."""
    source, target = folder / "input", folder / f"output-{cpu}"
    source.write_bytes(recording)
    semihosting = f"enable=on,target=native,arg=replay,arg={source},arg={target}"
    command = ["qemu-system-arm", "-M", MACHINES[cpu], "-display", "none", "-monitor", "none", "-serial", "none"]
    command += ["-icount", "shift=10,sleep=off", "-semihosting-config", semihosting]
    run = subprocess.run([*command, "-kernel", image("replay", cpu)], capture_output=True, text=True)
    said = run.stdout + run.stderr  # the emulator's choice
    assert run.returncode == 0, said
    sections = {}
    for name, ticks, frames in re.findall(r"section (.*)\nticks (.*)\nbytes (.*)\n", said):
        count, least, mean, most = map(int, ticks.split())
        calls, _, _, longest = map(int, frames.split())
        cost = [round(value / COUNTS_PER_INSTRUCTION) for value in (least, mean, most, longest)]
        sections[name] = Section(count, *cost[:3], calls, cost[3])
    totals = re.search(r"(all .*)\nstack (\d+)", said)
    assert totals, said
    return totals[1], np.fromfile(target, "<u4"), sections, int(totals[2])
