"""Simulated device: the firmware's core as a process on a pseudo-terminal of this computer.

The C sources are part of hilbo and are compiled once (`hilbo.device.local.compiled`). The process ends with this one in
every case, because the pipe from which it reads its commands ends then.
"""

import contextlib
import os
import subprocess
import threading
from pathlib import Path
from typing import Any

from hilbo.device.failures import DeviceError
from hilbo.device.local.compiled import compiled
from hilbo.errors import InputError

__all__ = ["Simulator", "built"]

_PARTS = ("core", "port/sim", "port/host")


class Simulator:
    """Running simulated device; `port` is the name of its pseudo-terminal.

    Options are those of `hilbo-device --help`, with _ for -: finger="sine", material=(-2.89, 5.7, 5.89, 0.203, 101),
    damping=0.95, sensor=False, … With `rate="lockstep"` its time passes only where the host waits for it, as fast as
    both can, independent of this computer's clock. Raises `DeviceError` if it cannot be built, `InputError` if it does
    not start.
    """

    def __init__(self, *, rate: str = "realtime", **options: Any):
        arguments = [str(built()), "--control", "--rate", rate, *_arguments(options)]
        # A separate process group: the host handles Ctrl-C, stops the device and ends it.
        self._process = subprocess.Popen(
            arguments,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )
        self.lockstep, self._telling = rate == "lockstep", threading.Lock()
        self.port = self._answer()
        if not self.port:
            words = self._ended()
            raise InputError(f"The simulated device does not start: {words}")

    def alive(self) -> bool:
        """Whether the process is still running."""
        return self._process.poll() is None

    def tell(self, command: str) -> str:
        """Send a command of `hilbo-device --help` ("restart", "finger sine", …) and return its answer, one line.

        Raises `DeviceError` if the device has ended.
        """
        assert self._process.stdin is not None
        with self._telling:
            try:
                self._process.stdin.write(command.encode() + b"\n")
                self._process.stdin.flush()
                answer = self._answer()
            except (OSError, ValueError):
                answer = ""
        if not answer:
            raise DeviceError("The simulated device has ended; open a new one.")
        return answer

    def ticks(self, count: int) -> str:
        """Run `count` ticks in lockstep, and return the device's answer. Raises `DeviceError` if the process has
        ended."""
        return self.tell(f"tick {count}")

    def close(self) -> str:
        """End the process; return its final report (ticks run, and how many were late), or "" if it was closed
        before."""
        return self._ended()

    def _answer(self) -> str:
        """Next line of the process's output, without blanks around it; empty if the output has ended."""
        assert self._process.stdout is not None
        return self._process.stdout.readline().decode().strip()

    def _ended(self) -> str:
        """Close the pipes and end the process, by a kill after 2 s; return its error output, or "" if it was closed
        before."""
        if self._process.stderr is None or self._process.stderr.closed:
            return ""
        with contextlib.suppress(OSError, ValueError):
            self._process.stdin.close()  # type: ignore[union-attr]
        try:
            self._process.wait(2)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        words = self._process.stderr.read().decode().strip()  # type: ignore[union-attr]
        self._process.stdout.close()  # type: ignore[union-attr]
        self._process.stderr.close()  # type: ignore[union-attr]
        return words


def built() -> Path:
    """Path of the simulated device's program, compiled if it is not in the cache.

    Raises `DeviceError`, with what to install, if it cannot be built or the system has no pseudo-terminals.
    """
    if os.name != "posix":
        raise DeviceError(
            "This system has no pseudo-terminals for the simulated device; use WSL, or a device on a port."
        )
    return compiled("hilbo-device", "the simulated device", _PARTS)


def _arguments(options: dict[str, Any]) -> list[str]:
    """Command-line arguments for the options. `sensor=False` becomes --no-sensor, True a flag without a value, a
    sequence numbers with commas; None and False are left out."""
    arguments = []
    for name, value in options.items():
        if name == "sensor":
            arguments += [] if value else ["--no-sensor"]
        elif value is True:
            arguments.append(f"--{name.replace('_', '-')}")
        elif value is not None and value is not False:
            text = ",".join(map(str, value)) if isinstance(value, tuple | list) else str(value)
            arguments += [f"--{name.replace('_', '-')}", text]
    return arguments
