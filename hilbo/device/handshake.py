"""Start of a connection: check protocol version, watchdog, damping and delay of a device, and take it over at rest.

A device that still moves for an earlier host is stopped first.
"""

import math
import struct
import time
from typing import SupportsFloat

from hilbo.device.failures import DeviceError
from hilbo.device.heartbeat import BEAT
from hilbo.device.link import Link
from hilbo.device.messages import SCHEMA, VERSION, GetLimits, GetStatus, Hello, HelloReply, Stop
from hilbo.device.reasons import State, held_because, meaning
from hilbo.errors import InputError

__all__ = ["greet", "shortest", "take_over"]

_BOOT = 3.0  # s that a board may take to start when its port is opened
_STOPPING = 2.0  # s
_BEATS = 4  # heartbeats that must fit into the device's watchdog, since each carries the tick of an earlier answer


def greet(link: Link, damping: SupportsFloat | None, delay: SupportsFloat | None = None) -> HelloReply:
    """Send HELLO, repeatedly for up to 3 s while a board starts up, check the reply and return it.

    `damping` (N·s/m) and `delay` (s) are the values that a study assumes; None is not checked. Raises `InputError` for
    one that is negative or not finite, and for a device with less damping or more delay; `DeviceError` if there is no
    answer, and for a device with another protocol version or too short a watchdog.
    """
    give_up = time.monotonic() + _BOOT
    while True:
        try:
            device = link.request(Hello())
            break
        except DeviceError as error:
            if error.nack is not None or link.lost or time.monotonic() > give_up:
                raise
    if (device.version, device.schema) != (VERSION, SCHEMA):
        raise DeviceError(
            f"{link.name}: the device speaks version {device.version} of the protocol, schema {device.schema:08x}, and"
            f" this hilbo version {VERSION}, schema {SCHEMA:08x}; install the one that belongs to it."
        )
    silence = device.watchdog_ticks / device.tick_rate_Hz
    if silence < _BEATS * BEAT:
        raise DeviceError(
            f"{link.name}: the device lets go after {silence:g} s without a heartbeat, and one comes every {BEAT:g} s;"
            f" set its watchdog_ticks to {_BEATS * BEAT:g} s at least."
        )
    if damping is not None and not 0.0 <= float(damping) < math.inf:  # NaN neither
        raise InputError(f"The damping that the study assumes is {damping}; give a number from 0, in N.s/m.")
    if damping is not None and _f32(float(damping)) > device.damping_N_s_per_m:
        raise InputError(
            f"{link.name}: the study assumes {shortest(float(damping))} N.s/m of damping and the device has"
            f" {shortest(device.damping_N_s_per_m)}; plan the study with the device's damping."
        )
    if delay is not None:
        _check_delay(link, float(delay))
    return device


def _check_delay(link: Link, delay: float) -> None:
    """Ask the device for its delay. Raises `InputError` if it exceeds the `delay` (s) that the study assumes, or if
    that is negative or not finite.

    The device refuses sets that are not passive at its own delay, so a study that assumes less would propose such sets.
    """
    if not 0.0 <= delay < math.inf:
        raise InputError(f"The delay that the study assumes is {delay}; give a number from 0, in s.")
    own = link.request(GetLimits()).delay_us
    if own > round(delay * 1e6):
        raise InputError(
            f"{link.name}: the study assumes a delay of at most {delay:g} s and the device checks its sets for"
            f" {own * 1e-6:g} s; plan the study with [renderer] delay = {own * 1e-6:g}."
        )


def take_over(link: Link, device: HelloReply) -> list[str]:
    """Stop the device if it still moves, reset `link.restarted` and start the heartbeats.

    Returns sentences for the user: that the device was stopped, or that it is in HOLD or ESTOP. Raises `DeviceError` if
    it does not stop within 2 s.
    """
    notes = []
    status = link.request(GetStatus())
    if status.state in (State.RUNNING, State.DRIVING, State.STOPPING):
        notes.append(f"The device was {meaning(State, status.state)} for an earlier host; it has been stopped.")
        link.request(Stop())
        give_up = link.now() + _STOPPING
        while status.state in (State.RUNNING, State.DRIVING, State.STOPPING):
            if link.now() > give_up:
                raise DeviceError(f"{link.name}: the device does not stop; switch off its motor.")
            link.pause(0.01)
            status = link.request(GetStatus())
    if status.state in (State.HOLD, State.ESTOP):
        why = held_because(status.hold_reason)
        notes.append(f"The device is in {meaning(State, status.state)}: {why}; clear it before the next start.")
    link.restarted = False
    link.beat(device.boot_id)
    return notes


def shortest(value: float) -> str:
    """Format a value as the shortest decimal that rounds to the same binary32 number."""
    import numpy as np  # slow to import, and not needed by all commands

    return np.format_float_positional(np.float32(value), trim="-")


def _f32(value: float) -> float:
    """Value rounded to binary32."""
    return struct.unpack("<f", struct.pack("<f", value))[0]
