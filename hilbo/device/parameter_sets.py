"""A parameter set on its way to a device: its messages, their CRC, and the set as the device reports it.

Numbers are rounded to binary32 here, once; everything after that is compared bit for bit.
Units: K N/mm, B1 N·s^α/mm, T s, force N, damping N·s/m.
"""

import math
import struct
import zlib
from collections.abc import Sequence
from typing import NamedTuple, SupportsFloat

from hilbo.device.messages import Exponential, HelloReply, Set, SetParams, SetStates
from hilbo.device.protocol import payload_of
from hilbo.errors import InputError

__all__ = ["InForce", "Wanted", "crc_of", "differences", "in_force", "wanted_for"]

_PER_MESSAGE = 7  # exponentials
_SAME = (
    "set_id",
    "memory",
    "length",
    "K0_N_per_mm",
    "K1_N_per_mm",
    "B1_N_s_alpha_per_mm",
    "alpha",
    "force_limit_N",
)


class Wanted(NamedTuple):
    """What somebody wants rendered; `length` is N of short memory, or the number of exponentials of full memory."""

    K0: float
    K1: float
    B1: float
    alpha: float
    memory: str
    length: int
    tick_rate: int
    force_limit: float

    def messages(self, set_id: int) -> list[SetParams | SetStates]:
        """SET_PARAMS, and with full memory the SET_STATES that follow it. Raises `InputError`."""
        if self.memory not in ("short", "full"):
            raise InputError(f'memory is "{self.memory}", it must be "short" or "full".')
        for name in ("K0", "K1", "B1", "alpha", "force_limit"):
            value = getattr(self, name)
            if not math.isfinite(value) or abs(value) > 3e38:
                raise InputError(f"{name} is {value}, it must be a finite number.")
        if not 0 <= self.length < 2**16:
            raise InputError(f"N (or states) is {self.length}, it must be a number of samples (or exponentials).")
        head = SetParams(
            set_id=set_id,
            memory=int(self.memory == "full"),
            length=self.length,
            tick_rate_Hz=self.tick_rate,
            K0_N_per_mm=self.K0,
            K1_N_per_mm=self.K1,
            B1_N_s_alpha_per_mm=self.B1,
            alpha=self.alpha,
            force_limit_N=self.force_limit,
        )
        return [head, *(_states(set_id, self.alpha, self.length) if self.memory == "full" else [])]


class InForce(NamedTuple):
    """A set as a device has it, rounded to binary32; `needs` is the damping (N·s/m) that the device computed for it."""

    set_id: int
    K0: float
    K1: float
    B1: float
    alpha: float
    memory: str
    length: int
    force_limit: float
    needs: float
    crc: int


def wanted_for(
    device: HelloReply,
    *,
    K0: SupportsFloat,
    K1: SupportsFloat,
    B1: SupportsFloat,
    alpha: SupportsFloat,
    N: int = 101,
    T: SupportsFloat = 1e-3,
    memory: str = "short",
    states: int = 10,
    force_limit: SupportsFloat | None = None,
) -> Wanted:
    """A set in numbers for a device, whose own force limit is the default. Raises `InputError` for what cannot be sent.

    Full memory loads JAX here, so that it is there when the set has to be sent in a hurry.
    """
    rate = device.tick_rate_Hz
    if not abs(rate * float(T) - 1) < 1e-9:
        raise InputError(f"T is {T} s and the device's tick {1 / rate:g} s; a set belongs to its T, choose another.")
    limit = device.force_limit_N if force_limit is None else float(force_limit)
    length = states if memory == "full" else N
    found = Wanted(float(K0), float(K1), float(B1), float(alpha), memory, length, rate, limit)
    found.messages(1)
    return found


def crc_of(messages: Sequence[SetParams | SetStates]) -> int:
    """What device and host know a set by."""
    return zlib.crc32(b"".join(payload_of(message) for message in messages))


def in_force(found: Set) -> InForce | None:
    """The set in a SET message, None where the device has none."""
    if not found.flags & 1:
        return None
    numbers = (found.K0_N_per_mm, found.K1_N_per_mm, found.B1_N_s_alpha_per_mm, found.alpha)
    memory, needs = "full" if found.memory else "short", found.minimum_damping_N_s_per_m
    return InForce(found.set_id, *numbers, memory, found.length, found.force_limit_N, needs, found.crc)


def differences(sent: Sequence[SetParams | SetStates], found: Set) -> list[str]:
    """In what the device's set is not, bit for bit, the one that was sent."""
    wrong = [name for name in _SAME if _bits(getattr(found, name)) != _bits(getattr(sent[0], name))]
    wrong += ["crc"] if found.crc != crc_of(sent) else []
    return wrong if found.flags & 1 else ["no set"]


def _bits(value) -> bytes | int:
    return struct.pack("<f", value) if isinstance(value, float) else value


def _states(set_id, alpha, count) -> list[SetStates]:
    import jax.numpy as jnp
    import numpy as np

    from hilbo.mechanics.exponentials import STATES, exponentials

    if count not in STATES:
        raise InputError(f"states is {count}, it must be one of {', '.join(map(str, STATES))}.")
    if not 0 < alpha < 1:
        raise InputError(f"alpha is {alpha}, it must be above 0 and below 1.")
    found = np.stack([np.asarray(part, float) for part in exponentials(jnp.asarray(alpha, float), count)], 1)
    pairs = tuple(Exponential(*map(float, pair)) for pair in found)
    chunks = [(first, pairs[first : first + _PER_MESSAGE]) for first in range(0, count, _PER_MESSAGE)]
    return [SetStates(set_id=set_id, first=first, count=len(chunk), states=chunk) for first, chunk in chunks]
