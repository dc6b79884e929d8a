"""Condition of a device besides its state and sets: homing, hardware stop, delay and continuous force."""

from typing import NamedTuple

from hilbo.device.messages import Limits, Status
from hilbo.device.reasons import DeviceFlag

__all__ = ["Condition", "condition_of"]


class Condition(NamedTuple):
    """Condition of a device.

    `delay_us` is the delay for which sets are checked, `longest_delay_us` the longest since the device's start, both
    from a due tick to its force, µs. `continuous_force_N` is the root mean square force over about `heating_s` that the
    motor tolerates.
    """

    homed: bool
    stop_open: bool
    delay_us: int
    longest_delay_us: int
    continuous_force_N: float
    heating_s: float


def condition_of(status: Status, limits: Limits) -> Condition:
    """Build a `Condition` from a STATUS and a LIMITS message."""
    return Condition(
        bool(status.flags & DeviceFlag.HOMED),
        bool(status.flags & DeviceFlag.STOP_OPEN),
        limits.delay_us,
        status.delay_us,
        limits.continuous_force_N,
        limits.heating_s,
    )
