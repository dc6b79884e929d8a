"""Simulated device for programs that close the control loop: process `hilbo-motor`, with mass, damping and a finger.

    with SimulatedMotor(finger="all") as motor:
        position, velocity = motor.sample()
        motor.command(force)                 # every period: after 15 ms without a new command its force is zero

It stands for a device's driver. The two sides share memory through a file; firmware/port/library/hilbo_motor.h has its
layout, and a program in C or C++ opens the same `file`.
"""

import ctypes
import mmap
import os
import subprocess
import tempfile
from pathlib import Path

from hilbo.device.failures import DeviceError
from hilbo.device.local.compiled import compiled
from hilbo.device.local.library import DeviceNumbers

__all__ = ["MOTOR", "SimulatedMotor", "motor_program"]

_PARTS = ("core", "port/sim", "port/host", "port/library")
_SOURCES = (
    *(f"port/sim/{name}.c" for name in ("finger", "material", "random", "world")),
    "port/host/clock.c",
    "port/library/motor.c",
)

MOTOR = DeviceNumbers(
    simulated=True,
    latency_us=50,
    delay_us=1000,
    hold_ticks=10,
    damping_N_s_per_m=0.95,
    force_limit_N=20.0,
    continuous_force_N=20.0,
    heating_s=10.0,
    position_low_mm=-5.1,
    position_high_mm=20.1,
    position_step_mm=0.001,
    slew_limit_N_per_s=500.0,
    velocity_limit_mm_per_s=1000.0,
    plausible_step_mm=2.0,
)
"""Properties of the simulated device."""


class _Shared(ctypes.Structure):
    _fields_ = (
        ("samples", ctypes.c_uint64),
        ("position_mm", ctypes.c_double),
        ("velocity_mm_per_s", ctypes.c_double),
        ("felt_N", ctypes.c_double),
        ("commands", ctypes.c_uint64),
        ("force_N", ctypes.c_double),
    )


def motor_program() -> Path:
    """Path of the program `hilbo-motor`, compiled if it is not in the cache.

    Raises `DeviceError` if it cannot be built, and on a system without POSIX.
    """
    if os.name != "posix":
        raise DeviceError("The simulated motor needs POSIX (Linux, macOS); on Windows use WSL.")
    return compiled("hilbo-motor", "the simulated motor", _PARTS, _SOURCES)


class SimulatedMotor:
    """Running simulated device, whose process ends with this one. `finger`: none, rest, ramp, hold, sine, tap or all.

    `silence_ms`: time without a command after which its force is zero; `record`: file for time (CLOCK_MONOTONIC, ns),
    force and position of each tick, written at the end. Raises `DeviceError` if its program cannot be built or does not
    start.
    """

    def __init__(self, finger: str = "all", silence_ms: float = 15.0, record: Path | None = None):
        shm = Path("/dev/shm")
        self._folder = tempfile.TemporaryDirectory(prefix="hilbo-motor-", dir=shm if shm.is_dir() else None)
        self.file = Path(self._folder.name) / "shared"
        words = [str(motor_program()), str(self.file), finger, str(silence_ms), *([str(record)] if record else [])]
        self._process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True)
        assert self._process.stdout is not None
        if self._process.stdout.readline().strip() != b"ready":
            self.close()
            raise DeviceError("The simulated motor does not start.")
        with open(self.file, "r+b") as opened:
            self._memory = mmap.mmap(opened.fileno(), ctypes.sizeof(_Shared))
        self._shared = _Shared.from_buffer(self._memory)

    def __enter__(self) -> "SimulatedMotor":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def felt_N(self) -> float:
        """Force that the simulated device outputs now, N."""
        return self._shared.felt_N

    def sample(self) -> tuple[float, float]:
        """Newest position (mm) and velocity (mm/s) of the handle."""
        return self._shared.position_mm, self._shared.velocity_mm_per_s

    def command(self, force_N: float) -> None:
        """Set the force (N, positive outwards), valid until the next command or for `silence_ms`."""
        self._shared.force_N = force_N
        self._shared.commands += 1

    def close(self) -> None:
        """End the process, by a kill after 5 s, and delete the shared file."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.close()
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()
        self._folder.cleanup()
