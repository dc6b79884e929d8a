"""Environment on which a compiled program depends: code, versions, processor, devices, flags and settings."""

import functools
import hashlib
import os
import platform
import sys
from importlib.metadata import version
from pathlib import Path

__all__ = ["code_digest", "surroundings"]

_COMPUTE = ("jax", "jaxlib", "equinox", "lineax", "optimistix", "jaxtyping", "numpy", "scipy")
_ELSEWHERE = ("cache", "log", "debug_info", "dump")  # settings of output paths, without influence on results


def surroundings() -> str:
    """Text that differs whenever the same code might compile to another program.

    It contains versions, processor, devices, flags of XLA and JAX in the environment, and JAX's settings. Initialises
    JAX's devices.
    """
    import jax

    settings = {
        name: value for name, value in jax.config.values.items() if not any(part in name for part in _ELSEWHERE)
    }
    flags = {name: value for name, value in os.environ.items() if name.startswith(("XLA_", "JAX_", "LIBTPU_"))}
    flags = {name: value for name, value in flags.items() if not any(part in name.lower() for part in _ELSEWHERE)}
    return "\n".join((
        f"versions {platform.python_version()} {' '.join(f'{name} {version(name)}' for name in _COMPUTE)}",
        f"processor {sys.platform} {platform.machine()} {_processor()}",
        f"devices {jax.default_backend()} {[device.device_kind for device in jax.devices()]}",
        f"flags {sorted(flags.items())}",
        f"settings {sorted(settings.items(), key=str)}",
    ))  # fmt: skip


def code_digest(package: Path) -> str:
    """SHA-256 (hex) of all Python files below the folder of a package, by relative path and content."""
    whole = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        content = path.read_bytes()
        whole.update(f"{path.relative_to(package).as_posix()} {len(content)}\n".encode() + content)
    return whole.hexdigest()


@functools.cache
def _processor() -> str:
    """Model and features of the processor from /proc/cpuinfo; where there is none, `platform.processor()`. Cached."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    said = {line.partition(":")[0].strip(): line.partition(":")[2].strip() for line in reversed(lines)}
    return " ".join(said.get(name, "") for name in ("model name", "flags", "Features", "CPU part"))
