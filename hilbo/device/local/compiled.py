"""Compilation of the firmware's C sources for this computer, to programs and shared libraries.

The sources are part of hilbo. They are compiled once with the available C compiler, into the user's cache folder; the
cache key is a hash of sources, compiler and flags, so that no stale build is used. A build that another user could have
written is not used either.
"""

import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
import zlib
from collections.abc import Sequence
from pathlib import Path

from hilbo.device.failures import DeviceError
from hilbo.programs.private import is_private

__all__ = ["compiled"]

_FLAGS = ("-std=c11", "-O2", "-ffp-contract=off", "-fno-strict-aliasing", "-D_XOPEN_SOURCE=700", "-pthread")
_SHARED = ("-shared", "-fPIC", "-fvisibility=hidden")
_COMPILERS = ("cc", "gcc", "clang")


def compiled(name: str, what: str, parts: Sequence[str], sources: Sequence[str] = (), shared: bool = False) -> Path:
    """Return the path of the program (or shared library) `name` in the cache folder; compile it if it is not there.

    `what` names it in error messages. `parts`: the folders of its headers and sources. `sources`: patterns of the C
    files, if not all of these folders. Raises `DeviceError` if it cannot be built, with what to install, or if another
    user may change the content of the cache.
    """
    root, compiler = _sources(what), _compiler(what)
    files = [path for folder in parts for path in sorted((root / folder).glob("*.[ch]"))]
    kind = _SHARED if shared else ()
    flags = [*_FLAGS, *kind, f"-DHB_FIRMWARE_HASH={_firmware_hash(root)}U", *(f"-I{folder}" for folder in parts)]
    version = subprocess.run([compiler, "--version"], capture_output=True).stdout
    digest = hashlib.sha256(repr((compiler, flags, sources)).encode() + version)
    for path in files:
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    program = _cache() / f"device-{digest.hexdigest()[:16]}" / name
    _check_private(program.parent, what)
    _check_private(program, what)
    if not program.exists():
        patterns = sources or [f"{folder}/*.c" for folder in parts]
        inputs = [path.relative_to(root).as_posix() for name in patterns for path in sorted(root.glob(name))]
        _build(program, what, [compiler, *flags, *inputs], root)
    return program


def _check_private(path: Path, what: str) -> None:
    """Raise `DeviceError` if the path exists and belongs to, or may be changed by, another user. `what`: name of the
    program, for messages, here and below."""
    if os.path.lexists(path) and not is_private(path):
        raise DeviceError(
            f"{path}: {what} is not run, since this belongs to, or may be changed by, another user; delete it, or set"
            " XDG_CACHE_HOME to another folder."
        )


def _build(program: Path, what: str, command: Sequence[str], root: Path) -> None:
    """Run the compiler `command` in a temporary folder and move the result to `program`, so that concurrent builds do
    not interfere. Raises `DeviceError` if the cache cannot be written, or the compilation fails."""
    try:
        program.parent.parent.mkdir(parents=True, exist_ok=True)
        program.parent.mkdir(mode=0o700, exist_ok=True)
        folder = Path(tempfile.mkdtemp(prefix="build-", dir=program.parent))
    except OSError as error:
        raise DeviceError(
            f"{program.parent}: {what} cannot be built there ({error.strerror}); set XDG_CACHE_HOME to another folder."
        ) from error
    try:
        made = folder / program.name
        done = subprocess.run([*command, "-o", str(made), "-lm"], cwd=root, capture_output=True, text=True)
        if done.returncode:
            first = next(iter(done.stderr.strip().splitlines()), "no reason given")
            raise DeviceError(f"{what.capitalize()} does not compile with {command[0]}: {first}")
        made.chmod(0o700)
        made.replace(program)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _sources(what: str) -> Path:
    """Find the folder of the firmware's sources, in the installation or a checkout. Raises `DeviceError` if it is
    missing."""
    here = Path(__file__).parents[2]
    for root in (here / "firmware", here.parent / "firmware"):  # installed; a checkout
        if (root / "core").is_dir():
            return root
    raise DeviceError(f"This installation of hilbo lacks the sources of {what}; install hilbo again.")


def _compiler(what: str) -> str:
    """Find the path of the first C compiler among $CC, cc, gcc and clang. Raises `DeviceError` if there is none."""
    for name in (os.environ.get("CC", ""), *_COMPILERS):
        path = shutil.which(name) if name else None
        if path:
            return path
    install = "xcode-select --install" if sys.platform == "darwin" else "on Debian: apt install gcc"
    raise DeviceError(
        f"{what.capitalize()} is built once from C, and there is no C compiler; install one ({install}), or use a"
        " device on a port."
    )


def _firmware_hash(root: Path) -> int:
    """CRC-32 of the sources of the firmware's core, as in firmware/Makefile."""
    return zlib.crc32(b"".join(path.read_bytes() for path in sorted((root / "core").glob("*.[ch]"))))


def _cache() -> Path:
    """Cache folder of hilbo, $XDG_CACHE_HOME/hilbo or ~/.cache/hilbo; it is not created."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "hilbo"
