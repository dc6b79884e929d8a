"""Conversion of samples of a device that presses a material to the table of tests that `hilbo identify` reads.

A test begins with the last sample off the material. When a light load follows a heavy one, the handle's mass may carry
it off the material for some milliseconds: the material's force is then 0, and the handle's position is not that of its
surface. Those rows are left out except two at either end, the inner ones of which have force 0, so that interpolation
of the force gives 0 between them. Units: mm, N, s; positions and forces are positive into the material.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from hilbo.device.failures import DeviceError
from hilbo.device.telemetry import Samples

__all__ = ["Pressed", "pressed", "table_of"]

_NOTHING = 0.05  # mm; a test that stays shallower has had no contact
_LEAST = 5e-3  # N; least force that counts as contact
_SURE = 4.0  # standard deviations
_STAY = 5  # samples, shortest loss of contact


class Pressed(NamedTuple):
    """One test, from the last sample off the material on: position (mm) and force (N), both positive into the material.

    The position is never below 0, and the force is 0 without contact. `off` marks samples without contact after the
    first contact.
    """

    position: Float[np.ndarray, " n"]
    force: Float[np.ndarray, " n"]
    off: Bool[np.ndarray, " n"]


def pressed(seen: Samples, kind: str, sensed: bool, noise: float) -> Pressed:
    """Cut one test of a `kind`, "relaxation" or "creep", out of the samples.

    `sensed`: the force is the sensor's, with noise `noise` (N), else the motor's, which shows no loss of contact.
    Raises `DeviceError` if there was no contact at position 0.
    """
    inside = np.flatnonzero(seen.position_mm > 0)
    if inside.size == 0 or seen.position_mm.max() < _NOTHING:
        raise DeviceError(f"The {kind} test has met nothing at position 0; put the material there.")
    first = max(int(inside[0]) - 1, 0)
    position = np.maximum(seen.position_mm[first:], 0.0)
    force = -(seen.sensed_N if sensed else seen.force_N)[first:]
    off = _contact_lost(force, noise) if sensed else np.zeros(force.size, bool)
    return Pressed(position, np.where((position > 0) & ~off, force, 0.0), off)


def _contact_lost(force: Float[np.ndarray, " n"], noise: float) -> Bool[np.ndarray, " n"]:
    """Mask of the samples without contact after the first contact, in runs of `_STAY` or more.

    `force` (N) of the sensor, positive into the material; `noise`: its standard deviation (N).
    """
    smooth = np.convolve(force, np.ones(_STAY) / _STAY, "same")
    off = smooth < max(_SURE * noise / np.sqrt(_STAY), _LEAST)
    edges = np.flatnonzero(np.diff(off, prepend=True, append=False))  # starts and ends of contact
    for first, end in zip(edges[1::2], edges[2::2], strict=False):
        off[first:end] = end - first >= _STAY
    off[: edges[0]] = False
    return off


def table_of(tests: Mapping[str, Sequence[Pressed]], last: Mapping[str, float], tick: float) -> Any:
    """DataFrame of the tests: test, repeat, time_s, position_mm, force_N; the repeats of a test share their times.

    They end with the shortest repeat, or at `last`, the duration (s) by kind of test. Rows are left out for all repeats
    where any of them has lost contact (module docstring). `tick`: time (s) between samples.
    """
    import pandas as pd

    parts = []
    for kind, repeats in tests.items():
        size = min(min(repeat.position.size for repeat in repeats), round(last[kind] / tick) + 1)
        off = np.any([repeat.off[:size] for repeat in repeats], axis=0)
        no_force, kept = _interior(off), ~_interior(_interior(off))
        time = np.arange(size)[kept] * tick
        for number, repeat in enumerate(repeats, 1):
            force = np.where(no_force, 0.0, repeat.force[:size])
            columns = {"time_s": time, "position_mm": repeat.position[:size][kept], "force_N": force[kept]}
            parts.append(pd.DataFrame({"test": kind, "repeat": number} | columns))
    return pd.concat(parts, ignore_index=True)


def _interior(off: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Mask without the first and last sample of each run of True."""
    inner = off.copy()
    inner[1:] &= off[:-1]
    inner[:-1] &= off[1:]
    return inner
