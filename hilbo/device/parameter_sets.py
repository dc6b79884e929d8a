"""Parameter sets of a device: conversion to messages and back, CRC, and comparison with what the device reports.

Numbers are rounded to binary32 once, for the wire; from there on they are compared bit for bit.
"""

import math
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, SupportsFloat

from hilbo.device.messages import Exponential, HelloReply, Set, SetParams, SetStates
from hilbo.device.protocol import payload_of
from hilbo.errors import InputError
from hilbo.mechanics.span import STATES

__all__ = ["InForce", "ParameterSet", "crc_of", "differences", "in_force"]

_PER_MESSAGE = 7  # exponentials
_WIRE_NAMES = {
    "length": "length",
    "K0": "K0_N_per_mm",
    "K1": "K1_N_per_mm",
    "B1": "B1_N_s_alpha_per_mm",
    "alpha": "alpha",
    "force_limit": "force_limit_N",
}


@dataclass(frozen=True)
class ParameterSet:
    """Parameter set to be rendered by a device.

    K0, K1 in N/mm, B1 in N·s^α/mm, T in s, `force_limit` in N (None: the device's own). `memory`: "short", of N
    samples, or "full", of `states` exponentials. Strings such as "5.58" are converted to numbers when the set is sent.
    """

    K0: SupportsFloat | str
    K1: SupportsFloat | str
    B1: SupportsFloat | str
    alpha: SupportsFloat | str
    N: int = 101
    T: SupportsFloat | str = 1e-3
    memory: str = "short"
    states: int = 10
    force_limit: SupportsFloat | str | None = None

    def messages(self, device: HelloReply) -> list[SetParams | SetStates]:
        """Return the messages that send this set to a device, not yet numbered (`set_id` 0): SET_PARAMS, and for full
        memory, which loads JAX, SET_STATES.

        Raises `InputError` for values that are no finite numbers or do not fit a message, another memory than "short"
        or "full", and a T that is not the device's tick.
        """
        rate = device.tick_rate_Hz
        if not abs(rate * _number("T", self.T) - 1) < 1e-9:
            raise InputError(
                f"T is {self.T} s and the device's tick {1 / rate!r} s; a set belongs to its T, choose another."
            )
        limit = device.force_limit_N if self.force_limit is None else self.force_limit
        given = {"force_limit": limit} | {name: getattr(self, name) for name in ("K0", "K1", "B1", "alpha")}
        numbers = {name: _number(name, value) for name, value in given.items()}
        if self.memory not in ("short", "full"):
            raise InputError(f'memory is "{self.memory}"; it must be "short" or "full".')
        for name, value in numbers.items():
            if not math.isfinite(value) or abs(value) > 3e38:
                raise InputError(f"{name} is {value}; it must be a finite number.")
        full = self.memory == "full"
        length = self.states if full else self.N
        if not 0 <= length < 2**16:
            raise InputError(f"N (or states) is {length}; it must be a number of samples (or exponentials).")
        wire: dict[str, Any] = {_WIRE_NAMES[name]: value for name, value in numbers.items()}
        head = SetParams(set_id=0, memory=int(full), length=length, tick_rate_Hz=rate, **wire)
        return [head, *(_states(numbers["alpha"], length) if full else [])]


class InForce(NamedTuple):
    """Active parameter set on a device, rounded to binary32; units as in `ParameterSet`.

    `length`: N of short memory, or the number of exponentials of full memory. `needs`: damping (N·s/m) it requires,
    computed by the device.
    """

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


def _number(name: str, value: SupportsFloat | str) -> float:
    """Convert a value to float. Raises `InputError`, in which `name` is the name of the value, if that fails."""
    try:
        return float(value)
    except (TypeError, ValueError):
        raise InputError(f"{name} is {value!r}; give a number.") from None


def crc_of(messages: Sequence[SetParams | SetStates]) -> int:
    """CRC-32 over the payloads of a set's messages, by which device and host identify the set."""
    return zlib.crc32(b"".join(payload_of(message) for message in messages))


def in_force(reply: Set) -> InForce | None:
    """Convert a SET message to the parameter set in it; None if the device has none."""
    if not reply.flags & 1:
        return None
    numbers = {name: getattr(reply, wire) for name, wire in _WIRE_NAMES.items()}
    memory, needs = "full" if reply.memory else "short", reply.minimum_damping_N_s_per_m
    return InForce(**numbers, memory=memory, set_id=reply.set_id, needs=needs, crc=reply.crc)


def differences(sent: Sequence[SetParams | SetStates], reply: Set) -> list[str]:
    """Names of the fields in which the device's set differs, bit for bit, from the messages `sent`; empty if none
    differs, ["no set"] if the device has no set."""
    if not reply.flags & 1:
        return ["no set"]
    names = ("set_id", "memory", *_WIRE_NAMES.values())
    differing = [name for name in names if _bits(getattr(reply, name)) != _bits(getattr(sent[0], name))]
    return differing + (["crc"] if reply.crc != crc_of(sent) else [])


def _bits(value: float | int) -> bytes | int:
    """Value for a comparison bit for bit: an integer unchanged, a float as its binary32 bytes."""
    return struct.pack("<f", value) if isinstance(value, float) else value


def _states(alpha: float, count: int) -> list[SetStates]:
    """Return the SET_STATES messages with the `count` exponentials of full memory for this alpha, seven to a message.

    Loads JAX. Raises `InputError` for a count that is not in `STATES`, or an alpha outside of (0, 1).
    """
    if count not in STATES:
        raise InputError(f"states is {count}; it must be one of {', '.join(map(str, STATES))}.")
    if not 0 < alpha < 1:
        raise InputError(f"alpha is {alpha}; it must be above 0 and below 1.")
    import jax.numpy as jnp
    import numpy as np

    from hilbo.mechanics.exponentials import exponentials

    weight, loss = (np.asarray(values, float) for values in exponentials(jnp.asarray(alpha, float), count))
    pairs = tuple(Exponential(*map(float, pair)) for pair in zip(weight, loss, strict=True))
    chunks = [(first, pairs[first : first + _PER_MESSAGE]) for first in range(0, count, _PER_MESSAGE)]
    return [SetStates(set_id=0, first=first, count=len(chunk), states=chunk) for first, chunk in chunks]
