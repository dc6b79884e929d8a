"""Runs of the renderer library, written down call by call, and the same again on the device's core by itself."""

import ctypes
import struct
import zlib
from typing import Any, NamedTuple

import numpy as np
from helpers_firmware import NAMES, build, decode, frame, library, pack, schema, unpack

from hilbo.device.local.library import DeviceNumbers, Fate, HostRenderer, HostState
from hilbo.device.local.motor import MOTOR
from hilbo.device.reasons import State

__all__ = ["SOFT", "Core", "Recorded", "Row", "float_bits", "held_for", "replayed", "running"]

_NAN = float("nan")
SOFT = {"K0": 0.1, "K1": 0.6, "B1": 0.5, "alpha": 0.3}


class Row(NamedTuple):
    """A call: "set", "start", "clear", "stop", "beat", or a tick with what came of it."""

    kind: str
    position_mm: float = 0.0
    force_N: float = 0.0
    missed: int = 0
    early: int = 0
    late_us: int = 0
    state: int = 0
    fate: int = 0
    parameters: Any = None


class Recorded:
    """A renderer in simulated time, whose calls are in `rows`."""

    def __init__(self, numbers: DeviceNumbers):
        self.renderer, self.rows, self.time_s = HostRenderer(numbers), [], 0.0
        self.period_s = 1 / numbers.tick_rate_Hz
        self._missed = self._early = 0

    @property
    def state(self) -> HostState:
        return self.renderer.state()

    def tick(self, position_mm: float, velocity: float = _NAN, after_s: float | None = None) -> float:
        """One call of tick, a period after the last one or `after_s`."""
        self.time_s += self.period_s if after_s is None else after_s
        force = self.renderer.tick(position_mm, velocity, self.time_s)
        now = self.state
        missed, early = now.missed - self._missed, now.early - self._early
        self.rows.append(Row("tick", position_mm, force, missed, early, now.late_us, now.state, now.set))
        self._missed, self._early = now.missed, now.early
        return force

    def set(self, **parameters: Any) -> None:
        self.rows.append(Row("set", parameters=parameters))
        self.renderer.set(**parameters)

    def order(self, kind: str) -> None:
        """beat, start, clear or stop."""
        self.rows.append(Row(kind))
        if kind in ("start", "clear"):
            getattr(self.renderer, kind)(self.state.stops)
        else:
            (self.renderer.heartbeat if kind == "beat" else self.renderer.stop)()

    def follow(self, positions: Any) -> list[float]:
        """Ticks at these positions, with heartbeats."""
        forces = []
        for k, position in enumerate(positions):
            if k % 50 == 0:
                self.order("beat")
            forces.append(self.tick(float(position)))
        return forces

    def go(self, **parameters: Any) -> None:
        """Render, from out of contact."""
        self.set(**parameters)
        self.follow([-1.0] * 200)
        assert self.state.set == Fate.IN_FORCE
        self.order("start")


class Core:
    """The device's core, as the shim of the firmware's tests has it."""

    def __init__(self, numbers: DeviceNumbers):
        self.lib, self.numbers, self.seq = library(build()), numbers, 0
        self.lib.shim_tick_of_board.restype = ctypes.c_float
        self.memory = ctypes.create_string_buffer(self.lib.shim_size())
        ranges = [end for name in ("K0_N_per_mm", "K1_N_per_mm", "B1_N_s_alpha_per_mm", "alpha")
                  for end in getattr(numbers, name)]  # fmt: skip
        capabilities = 16 + 8 * numbers.simulated + 4 * numbers.passivity_controller
        n = numbers
        values = [
            0, 1_000_000, n.tick_rate_Hz, n.watchdog_ticks, n.hold_ticks, 255, 12, capabilities, n.damping_N_s_per_m,
            n.force_limit_N, n.position_low_mm, n.position_high_mm, n.position_step_mm, n.slew_limit_N_per_s,
            n.velocity_limit_mm_per_s, n.plausible_step_mm, *ranges, 0, 0, 0, 0, n.delay_us, n.continuous_force_N,
            n.heating_s,
        ]  # fmt: skip
        assert self.lib.shim_init(self.memory, (ctypes.c_double * len(values))(*values), ctypes.c_uint32(1)) == 0
        self.ask("HELLO", version=2, schema=zlib.crc32(schema().encode()))

    def send(self, name: str, payload: bytes) -> list[tuple[str, dict]]:
        """What answers, without notices."""
        self.seq = (self.seq + 1) % 256
        self._drain()
        data = frame(name, self.seq, payload)
        self.lib.shim_receive(self.memory, data, ctypes.c_size_t(len(data)))
        answers = [decode(encoded) for encoded in filter(None, self._drain().split(b"\0"))]
        return [(NAMES[kind], unpack(NAMES[kind], found)) for kind, _, found in answers if NAMES[kind] != "NOTICE"]

    def ask(self, name: str, repeated: Any = (), **fields: Any) -> dict:
        ((kind, answer),) = self.send(name, pack(name, repeated, **fields))
        assert kind != "NACK", answer
        return answer

    def status(self) -> dict:
        return self.ask("GET_STATUS")

    def set(self, set_id: int, parameters: dict) -> None:
        given = {"N": 101, "exponentials": (), "force_limit": self.numbers.force_limit_N} | parameters
        states = list(given["exponentials"])
        head = {
            "set_id": set_id, "memory": int(bool(states)), "length": len(states) or given["N"],
            "tick_rate_Hz": self.numbers.tick_rate_Hz, "K0_N_per_mm": given["K0"], "K1_N_per_mm": given["K1"],
            "B1_N_s_alpha_per_mm": given["B1"], "alpha": given["alpha"], "force_limit_N": given["force_limit"],
        }  # fmt: skip
        self.ask("SET_PARAMS", **head)
        for first in range(0, len(states), 7):
            part = states[first : first + 7]
            self.ask("SET_STATES", part, set_id=set_id, first=first, count=len(part))

    def order(self, kind: str) -> None:
        status = self.status()
        start = {"set_id": status["active_id"], "crc": status["active_crc"], "boot_id": 1, "stop": status["stops"]}
        if kind == "beat":
            self.send("HEARTBEAT", pack("HEARTBEAT", boot_id=1, tick=status["tick"]))
        elif kind == "start":
            self.ask("START", **start)
        elif kind == "clear":
            self.ask("CLEAR", boot_id=1, stop=status["stops"])
        else:
            self.ask("STOP")

    def commit(self) -> None:
        status = self.status()
        self.ask("COMMIT", set_id=status["staged_id"], crc=status["staged_crc"], boot_id=1)

    def tick(self, row: Row) -> float:
        """With the ticks that were missed before it."""
        tick = self.lib.shim_tick
        for _ in range(min(row.missed, self.numbers.hold_ticks)):
            tick(self.memory, 0, 0, 1, ctypes.c_float(0))
        if not abs(row.position_mm) < 1e6:
            return tick(self.memory, 0, 0, 0, ctypes.c_float(0))
        steps = row.position_mm / float(np.float32(self.numbers.position_step_mm))
        counts = int(np.copysign(np.floor(abs(steps) + 0.5), steps))
        return self.lib.shim_tick_of_board(self.memory, counts, self.numbers.latency_us + row.late_us, 0)

    def _drain(self) -> bytes:
        room = ctypes.create_string_buffer(4096)
        size = self.lib.shim_transmit(self.memory, room, ctypes.c_size_t(4096))
        return room.raw[:size]


def replayed(rows: list[Row], numbers: DeviceNumbers) -> list[float]:
    """The forces of the core by itself at the same calls. It may have no other state than the library had."""
    core, forces, set_id, fate = Core(numbers), [], 0, Fate.NONE
    for row in rows:
        if row.kind == "set":
            set_id, fate = set_id + 1, Fate.WAITING
            core.set(set_id, row.parameters)
        elif row.kind != "tick":
            core.order(row.kind)
        else:
            forces.append(forces[-1] if row.early else core.tick(row))
            if (fate, row.fate) == (Fate.WAITING, Fate.IN_FORCE):
                core.commit()
                fate = Fate.IN_FORCE
    assert core.status()["state"] == rows[-1].state
    return forces


def float_bits(forces: Any) -> list[bytes]:
    """Of binary32, so that -0 is not 0."""
    return [struct.pack("<f", force) for force in forces]


def running(numbers=MOTOR, model=SOFT, at_mm=2.0, ticks=100):
    """A renderer in contact."""
    run = Recorded(numbers)
    run.go(**model)
    run.follow(np.linspace(-1, at_mm, 100))
    run.follow([at_mm] * ticks)
    assert run.state.state == State.RUNNING and run.state.force_N > 0.3
    return run


def held_for(run, cause):
    """Whether it is in HOLD, and why."""
    now = run.state
    return (now.state, now.cause) == (State.HOLD, cause)
