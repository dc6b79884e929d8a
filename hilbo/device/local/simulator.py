"""A device without a device: the firmware's own core as a process on a pseudo-terminal of this computer.

The C sources travel with hilbo, and are built once (`hilbo.device.local.compiled`). The process ends with this one,
however this one ends, because the pipe that it reads its commands from ends then.
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
    """A running simulated device; `port` is the name of its pseudo-terminal.

    Options are those of `hilbo-device --help`, with _ for -: finger="sine", material=(-2.89, 5.7, 5.89, 0.203, 101),
    damping=0.95, sensor=False, … With `rate="lockstep"` its time is ours: it passes where the host waits for it, as
    fast as both can, and nothing depends on this computer's clock. Raises `DeviceError` where none can be built or
    started.
    """

    def __init__(self, *, rate: str = "realtime", **options: Any):
        arguments = [str(built()), "--control", "--rate", rate, *_arguments(options)]
        # A group of its own: Ctrl-C is for the host, which then stops the device and ends it.
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
        """Whether the process runs."""
        return self._process.poll() is None

    def tell(self, command: str) -> str:
        """One of the commands of `hilbo-device --help` ("restart", "finger sine", …); returns its answer.

        Raises `DeviceError` if the device has ended.
        """
        assert self._process.stdin is not None
        with self._telling:
            try:
                self._process.stdin.write(command.encode() + b"\n")
                self._process.stdin.flush()
            except (OSError, ValueError) as error:
                raise DeviceError("The simulated device has ended; open a new one.") from error
            return self._answer()

    def ticks(self, count: int) -> str:
        """Run so many ticks, in lockstep. Raises `DeviceError` if the process has ended."""
        answer = self.tell(f"tick {count}")
        if not answer.startswith("tick "):
            raise DeviceError("The simulated device has ended; open a new one.")
        return answer

    def close(self) -> str:
        """End the process; its last words say how many ticks it ran, and how many were late."""
        return self._ended()

    def _answer(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().decode().strip()

    def _ended(self) -> str:
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
    """The simulated device's program, built if this computer has not built it before.

    Raises `DeviceError` where it cannot be built or run, and says what to install.
    """
    if os.name != "posix":
        raise DeviceError(
            "This system has no pseudo-terminals for the simulated device; use WSL, or a device on a port."
        )
    return compiled("hilbo-device", "the simulated device", _PARTS)


def _arguments(options: dict[str, Any]) -> list[str]:
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
