"""C header `hilbo_device_config.h` with the numbers of a device, with which a port of the firmware is built.

`header` writes a complete one from what a device reports. `with_measured` changes damping and delay in the header that
the device was built with, and keeps the rest, such as the settings of a port.
"""

import re
from dataclasses import asdict
from pathlib import Path

import numpy as np

from hilbo.device.messages import HelloReply, Limits
from hilbo.device.reasons import Capability
from hilbo.errors import InputError

__all__ = ["header", "with_measured"]

_BITS = {
    Capability.DRIVE: "HB_CAN_DRIVE",
    Capability.FORCE_SENSOR: "HB_CAN_SENSE_FORCE",
    Capability.PASSIVITY_CONTROLLER: "HB_CAN_CONTROL_PASSIVITY",
    Capability.SIMULATED: "HB_IS_SIMULATED",
    Capability.HOMED_AT_BOOT: "HB_IS_HOMED_AT_BOOT",
}

_TEMPLATE = Path(__file__).parent / "templates" / "hilbo_device_config.h"
"""With fields of `str.format`."""


def header(
    device: HelloReply, limits: Limits, damping: float, delay_us: int, about_damping: str, about_delay: str
) -> str:
    """Return the text of a complete header for a damping in N·s/m and a delay in µs; the other numbers are the device's
    own.

    `about_damping`, `about_delay`: comments on how these were measured. The damping is rounded down to binary32.
    """
    fastest = device.velocity_limit_mm_per_s
    numbers = asdict(device) | asdict(limits)
    numbers |= {"damping": _below(damping), "plausible_step_mm": 2 * fastest / device.tick_rate_Hz}
    numbers |= {"servo_speed_mm_per_s": min(50.0, fastest / 2), "delay_us": delay_us}
    words = {name: _c_float(value) if isinstance(value, float) else value for name, value in numbers.items()}
    names = [_BITS[flag] for flag in Capability(device.capabilities)]
    words |= {"capabilities": " | ".join(names) or "0", "damping": _c_float(_below(damping))}
    return _TEMPLATE.read_text(encoding="utf-8").format(**words, about_damping=about_damping, about_delay=about_delay)


def with_measured(base: str, where: str, device: HelloReply, limits: Limits, damping: float, delay_us: int) -> str:
    """Return the text of the header `base` with damping (N·s/m) and delay (µs) replaced; `where` is its file name for
    errors.

    Raises `InputError` if the header lacks one of the two, or has another value than the device reports, so that it
    belongs to another device.
    """
    reported = {"damping_N_s_per_m": device.damping_N_s_per_m, "delay_us": limits.delay_us}
    values = {"damping_N_s_per_m": _c_float(_below(damping)), "delay_us": str(delay_us)}
    for name, value in values.items():
        pattern = rf"(\.{name}\s*=\s*)([0-9.eE+-]+)[FfUuLl]*(?=\s*[,}}/])"
        places = list(re.finditer(pattern, base))
        if len(places) != 1:
            raise InputError(f"{where}: has {len(places)} lines with .{name} = NUMBER; it must have one.")
        if np.float32(places[0][2]) != np.float32(reported[name]):
            raise InputError(
                f"{where}: .{name} is {places[0][2]} and the device reports {reported[name]:.6g}; give the header that"
                " this device was built with."
            )
        base = base[: places[0].start()] + places[0][1] + value + base[places[0].end() :]
    return base


def _below(value: float) -> float:
    """Largest binary32 number that does not exceed the value."""
    nearest = np.float32(value)
    return float(nearest if nearest <= value else np.nextafter(nearest, np.float32(-np.inf)))


def _c_float(value: float) -> str:
    """Format the value, rounded to binary32, as a C literal such as 0.95F."""
    return f"{np.format_float_positional(np.float32(value), trim='0')}F"
