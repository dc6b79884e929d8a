"""What XLA is told about compiling for a CPU: the older of its two code generators for fused loops.

What hilbo compiles takes it about 0.6 of the time that the newer one takes, and runs as fast
(docs/results/run_time.md). Versions of jaxlib that this has not been tried with are told nothing. Processors of other
kinds are not concerned.
"""

import os
from importlib.metadata import version

__all__ = ["compiler_options", "set_flags"]

_FLAG = "xla_cpu_use_fusion_emitters"
_TRIED = (0, 10)  # the last version known to have the flag; XLA ends the process at a flag that it does not know


def compiler_options() -> dict[str, bool]:
    """For one function: `jax.jit(f, compiler_options=compiler_options())`."""
    return {_FLAG: False} if _flag_exists() else {}


def set_flags() -> None:
    """For a whole process, which has computed nothing yet; what the environment says of it already holds."""
    flags = os.environ.get("XLA_FLAGS", "")
    if _flag_exists() and _FLAG not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --{_FLAG}=false".strip()


def _flag_exists() -> bool:
    """Whether this jaxlib is one that is known to have the flag."""
    return tuple(map(int, version("jaxlib").split(".")[:2])) <= _TRIED
