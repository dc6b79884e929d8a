"""C header `hilbo_device_config.h` with the numbers of a device, with which a port of the firmware is built.

`header` writes a complete one from what a device reports. `with_measured` changes damping and delay in the header that
the device was built with, and keeps the rest, such as the settings of a port.
"""

import re
from dataclasses import asdict

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

_TEMPLATE = """\
/* The numbers of one device. `hilbo device commission` has measured its damping and its delay; the others are those
 * that the device reports. The build sets `firmware`. A port's own settings, such as HILBO_SETTINGS of the STM32F405
 * port, are no numbers of the core: copy them from the header that the device was built with. */
#ifndef HILBO_DEVICE_CONFIG_H
#define HILBO_DEVICE_CONFIG_H

#include "hb_config.h"

static const struct hb_config HILBO_DEVICE_CONFIG = {{
    .line_rate_baud = {line_rate_baud},
    .tick_rate_Hz = {tick_rate_Hz},
    .watchdog_ticks = {watchdog_ticks},
    .hold_ticks = {hold_ticks},
    .most_taps = {most_taps},
    .most_states = {most_states},
    .capabilities = {capabilities},
    .delay_us = {delay_us}, /* {about_delay} */

    .damping_N_s_per_m = {damping}, /* {about_damping} */
    .force_limit_N = {force_limit_N},
    .continuous_force_N = {continuous_force_N},
    .heating_s = {heating_s},
    .position_low_mm = {position_low_mm},
    .position_high_mm = {position_high_mm},
    .encoder_step_mm = {encoder_step_mm},
    .slew_limit_N_per_s = {slew_limit_N_per_s},
    .velocity_limit_mm_per_s = {velocity_limit_mm_per_s},
    .plausible_step_mm = {plausible_step_mm}, /* not reported: twice the velocity limit in a tick */

    .K0_N_per_mm = {{{K0_low}, {K0_high}}},
    .K1_N_per_mm = {{{K1_low}, {K1_high}}},
    .B1_N_s_alpha_per_mm = {{{B1_low}, {B1_high}}},
    .alpha = {{{alpha_low}, {alpha_high}}},

    /* Not reported: gentle gains; replace them with those of the device's last header. */
    .servo_stiffness_N_per_mm = 1.0F,
    .servo_damping_N_s_per_mm = 0.02F,
    .servo_integral_N_per_mm_s = 5.0F,
    .servo_speed_mm_per_s = {servo_speed_mm_per_s},
}};

#endif
"""


def header(
    device: HelloReply, limits: Limits, damping: float, delay_us: int, about_damping: str, about_delay: str
) -> str:
    """Complete header for a damping in N·s/m and a delay in µs; `about_…` are comments on how these were measured."""
    fastest = device.velocity_limit_mm_per_s
    numbers = asdict(device) | asdict(limits)
    numbers |= {"damping": _below(damping), "plausible_step_mm": 2 * fastest / device.tick_rate_Hz}
    numbers |= {"servo_speed_mm_per_s": min(50.0, fastest / 2), "delay_us": delay_us}
    words = {name: _c_float(value) if isinstance(value, float) else value for name, value in numbers.items()}
    names = [_BITS[flag] for flag in Capability(device.capabilities)]
    words |= {"capabilities": " | ".join(names) or "0", "damping": _c_float(_below(damping))}
    return _TEMPLATE.format(**words, about_damping=about_damping, about_delay=about_delay)


def with_measured(base: str, where: str, device: HelloReply, limits: Limits, damping: float, delay_us: int) -> str:
    """Replace damping (N·s/m) and delay (µs) in the header `base`; `where` is its file name for errors.

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
    """C literal of the value rounded to binary32."""
    return f"{np.format_float_positional(np.float32(value), trim='0')}F"
