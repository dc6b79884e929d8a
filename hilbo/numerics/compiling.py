"""XLA compiler options for CPUs: the older of its two code generators for fused loops.

It needs about 0.6 of the compile time of the newer one, at equal run time (docs/results/run_time.md). Untested versions
of jaxlib get no option. Other kinds of processors are not affected.
"""

import os
from importlib.metadata import version

__all__ = ["compiler_options", "set_flags"]

_FLAG = "xla_cpu_use_fusion_emitters"
_TRIED = (0, 10)  # the last version known to have the flag; XLA ends the process at a flag that it does not know


def compiler_options() -> dict[str, bool]:
    """Compiler options for one function, for `jax.jit(f, compiler_options=...)`; {} for an untested jaxlib."""
    return {_FLAG: False} if _flag_exists() else {}


def set_flags() -> None:
    """Add the flag to the environment variable XLA_FLAGS, which XLA reads before its first computation.

    A flag of this name that is already there stays; an untested jaxlib gets none.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if _flag_exists() and _FLAG not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --{_FLAG}=false".strip()


def _flag_exists() -> bool:
    """Whether jaxlib's version is at most the last one tested with the flag."""
    return tuple(map(int, version("jaxlib").split(".")[:2])) <= _TRIED
