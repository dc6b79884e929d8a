"""A device without a device: the firmware's own core as a process on a pseudo-terminal of this computer.

The C sources travel with hilbo. They are built once with the C compiler that is there, into the user's cache folder,
under a name made of sources, compiler and flags, so that nothing stale is ever run. The process ends with this one,
however this one ends, because the pipe that it reads its commands from ends then.
"""

import contextlib
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hilbo.device.failures import DeviceError
from hilbo.errors import InputError

__all__ = ["Simulator", "built"]

_PARTS = ("core", "port/sim", "port/host")
_FLAGS = ("-std=c11", "-O2", "-ffp-contract=off", "-fno-strict-aliasing", "-D_XOPEN_SOURCE=700")
_COMPILERS = ("cc", "gcc", "clang")


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
    root, compiler = _sources(), _compiler()
    files = [path for folder in _PARTS for path in sorted((root / folder).glob("*.[ch]"))]
    flags = [*_FLAGS, f"-DHB_FIRMWARE_HASH={_firmware_hash(root)}U", *(f"-I{folder}" for folder in _PARTS)]
    version = subprocess.run([compiler, "--version"], capture_output=True).stdout
    digest = hashlib.sha256(repr((compiler, flags)).encode() + version)
    for path in files:
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    program = _cache() / f"device-{digest.hexdigest()[:16]}" / "hilbo-device"
    if not program.exists():
        _build(
            program, [compiler, *flags, *(str(path.relative_to(root)) for path in files if path.suffix == ".c")], root
        )
    return program


def _build(program: Path, command: Sequence[str], root: Path) -> None:
    """Build beside the final place and move it there whole, so that two who build at once do no harm."""
    try:
        program.parent.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(prefix="build-", dir=program.parent))
    except OSError as error:
        raise DeviceError(
            f"{program.parent}: the simulated device cannot be built there ({error.strerror}); set XDG_CACHE_HOME to a"
            " folder of yours."
        ) from error
    try:
        made = folder / program.name
        done = subprocess.run([*command, "-o", str(made), "-lm"], cwd=root, capture_output=True, text=True)
        if done.returncode:
            first = next(iter(done.stderr.strip().splitlines()), "no reason given")
            raise DeviceError(f"The simulated device does not compile with {command[0]}: {first}")
        made.replace(program)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _sources() -> Path:
    here = Path(__file__).parents[1]
    for root in (here / "firmware", here.parent / "firmware"):  # installed; a checkout
        if (root / "core").is_dir():
            return root
    raise DeviceError("This installation of hilbo lacks the sources of the simulated device; install hilbo again.")


def _compiler() -> str:
    for name in (os.environ.get("CC", ""), *_COMPILERS):
        path = shutil.which(name) if name else None
        if path:
            return path
    install = "xcode-select --install" if sys.platform == "darwin" else "on Debian: apt install gcc"
    raise DeviceError(
        f"The simulated device is built once from C, and there is no C compiler; install one ({install}), or use a"
        " device on a port."
    )


def _firmware_hash(root: Path) -> int:
    """As firmware/Makefile has it: the CRC-32 of the core's sources."""
    return zlib.crc32(b"".join(path.read_bytes() for path in sorted((root / "core").glob("*.[ch]"))))


def _cache() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "hilbo"


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
