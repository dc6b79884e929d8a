"""Named numbers of firmware/PROTOCOL.md (states, flags, reasons), and messages that explain them to a person.

`sentence` explains a NACK with the numbers it carries: the error, and what to do about it.
"""

from enum import IntEnum, IntFlag

__all__ = [
    "ABOUT_INPUT",
    "Capability",
    "DeviceFlag",
    "HoldReason",
    "Memory",
    "NackReason",
    "SampleFlag",
    "Staging",
    "State",
    "held_because",
    "meaning",
    "sentence",
]


class Memory(IntEnum):
    """Memory of a parameter set."""

    SHORT = 0
    FULL = 1


class Staging(IntEnum):
    """Status of the idle bank, into which the next set is sent."""

    EMPTY = 0
    INCOMPLETE = 1
    WARMING = 2
    READY = 3


class State(IntEnum):
    """State of the device."""

    STOPPED = 0
    RUNNING = 1
    STOPPING = 2
    DRIVING = 3
    HOLD = 4
    ESTOP = 5


class Capability(IntFlag):
    """Capabilities of a device."""

    DRIVE = 1
    FORCE_SENSOR = 2
    PASSIVITY_CONTROLLER = 4
    SIMULATED = 8
    HOMED_AT_BOOT = 16


class DeviceFlag(IntFlag):
    """`flags` of STATUS."""

    HOMED = 1
    STOP_OPEN = 2


class SampleFlag(IntFlag):
    """Events in a tick. SATURATED and SLEWED mark a trial, HOLD and ESTOP void it."""

    CONTACT = 1
    INPUT_HELD = 2
    SATURATED = 4
    SLEWED = 8
    CONTROLLED = 16
    SWITCHING = 32
    HOLD = 64
    ESTOP = 128
    RUNNING = 256
    DRIVING = 512


class HoldReason(IntEnum):
    """Reason why the device is in HOLD, or why its state changed."""

    NONE = 0
    WATCHDOG = 1
    INPUT = 2
    VELOCITY = 3
    OVERRUN = 4
    MODEL = 5
    ENERGY = 6
    ESTOP = 7
    BOOT = 8
    SWITCH = 9
    HEAT = 10


class NackReason(IntEnum):
    """Reason why a request is refused."""

    VERSION = 1
    SCHEMA = 2
    NO_HELLO = 3
    UNKNOWN_TYPE = 4
    LENGTH = 5
    RESERVED = 6
    STATE = 7
    BOOT_ID = 8
    NOT_FINITE = 9
    K0_RANGE = 10
    K1_RANGE = 11
    B1_RANGE = 12
    ALPHA_RANGE = 13
    FORCE_LIMIT = 14
    TICK_RATE = 15
    MEMORY_LENGTH = 16
    EVEN_TAPS = 17
    STATIC_STIFFNESS = 18
    NOT_PASSIVE = 19
    STATES = 20
    NOTHING_STAGED = 21
    SET_MISMATCH = 22
    NOT_READY = 23
    BUSY = 24
    NO_SET = 25
    NO_HEARTBEAT = 26
    LINE_TOO_SLOW = 27
    NOT_CAPABLE = 28
    DRIVE_RANGE = 29
    NO_INPUT = 30
    IN_CONTACT = 31
    STALE = 32
    NOT_HOMED = 33
    STOP_OPEN = 34


ABOUT_INPUT = frozenset(NackReason(n) for n in range(9, 21)) | {NackReason.LINE_TOO_SLOW, NackReason.DRIVE_RANGE}
"""Refusals caused by the numbers sent, which the sender can correct."""

_HOLD = {
    HoldReason.NONE: "it received a stop",
    HoldReason.WATCHDOG: "no fresh heartbeat came from the host",
    HoldReason.INPUT: "too many positions were bad, or none changed while it pushed; check the encoder",
    HoldReason.VELOCITY: "it moved faster than its velocity limit",
    HoldReason.OVERRUN: "a tick was missed, or its force came out later than the device's delay",
    HoldReason.MODEL: "the model's force was not finite",
    HoldReason.ENERGY: "the passivity observer stopped it",
    HoldReason.ESTOP: "the emergency stop was pressed",
    HoldReason.BOOT: "it has just started",
    HoldReason.SWITCH: "the hardware stop is open",
    HoldReason.HEAT: "the mean force was above what the motor bears continuously",
}

_NACK = {
    NackReason.VERSION: "The device speaks version {limit:g} of the protocol; install the hilbo that belongs to it.",
    NackReason.SCHEMA: "The device means other bytes by the same version; install the hilbo that its firmware is from.",
    NackReason.NO_HELLO: "The device has had no HELLO; connect again.",
    NackReason.UNKNOWN_TYPE: "The device does not know the request {request}; its firmware and hilbo do not belong"
    " together.",
    NackReason.LENGTH: "{request} reached the device with {value:g} bytes instead of {limit:g}; its firmware and hilbo"
    " do not belong together.",
    NackReason.RESERVED: "{request} has a field that the device does not know; its firmware and hilbo do not belong"
    " together.",
    NackReason.STATE: "{request} is refused while the device is {state}; {way_out}.",
    NackReason.BOOT_ID: "The device has restarted: it is stopped and knows no set; connect again, then send the set.",
    NackReason.NOT_FINITE: "A number of the set is not finite; send finite ones.",
    NackReason.K0_RANGE: "K0 is {value:.7g} N/mm, beyond the device's limit of {limit:.7g}.",
    NackReason.K1_RANGE: "K1 is {value:.7g} N/mm, beyond the device's limit of {limit:.7g}.",
    NackReason.B1_RANGE: "B1 is {value:.7g} N.s^alpha/mm, beyond the device's limit of {limit:.7g}.",
    NackReason.ALPHA_RANGE: "alpha is {value:.7g}, beyond the device's limit of {limit:.7g}.",
    NackReason.FORCE_LIMIT: "The force limit is {value:.7g} N; the device allows above 0 and up to {limit:.7g} N.",
    NackReason.TICK_RATE: "The set is for {value:g} ticks a second, the device has {limit:g}; choose its T.",
    NackReason.MEMORY_LENGTH: "The set's memory has length {value:g}, the device takes 1 to {limit:g}.",
    NackReason.EVEN_TAPS: "N is even; the passivity bound needs an odd number of past samples, such as 101.",
    NackReason.STATIC_STIFFNESS: "The set's static stiffness H(1) is {value:.7g} N/mm; below 0 it is active on any"
    " device, raise K0.",
    NackReason.NOT_PASSIVE: "The set needs {value:.7g} N.s/m of damping and the device has {limit:.7g}; lower K1, or"
    " search with this device's damping.",
    NackReason.STATES: "The exponentials of full memory are out of range or order; use those of"
    " hilbo.mechanics.exponentials.",
    NackReason.NOTHING_STAGED: "The device has no set staged; send one first.",
    NackReason.SET_MISMATCH: "The device has another set than the one named; send it again.",
    NackReason.NOT_READY: "The staged set's history needs {ticks} more ticks, or no contact; wait, or let go.",
    NackReason.BUSY: "The device needs {ticks} more ticks for the previous request; wait.",
    NackReason.NO_SET: "The device has no active set; send one first.",
    NackReason.NO_HEARTBEAT: "The device hears no fresh heartbeat; check the line in both directions.",
    NackReason.LINE_TOO_SLOW: "The line is too slow for this telemetry; every {limit:g}th tick is the most it carries.",
    NackReason.NOT_CAPABLE: "The device cannot do {request}.",
    NackReason.NO_INPUT: "The device's encoder gives no good position; check the encoder and its cable.",
    NackReason.DRIVE_RANGE: "{request} asks for {value:.7g}, beyond the device's limit of {limit:.7g}.",
    NackReason.IN_CONTACT: "The handle is in the material; let it leave the surface, then start.",
    NackReason.STALE: "The device has stopped since {request} was requested; look at its state, then request it again.",
    NackReason.NOT_HOMED: "The device does not know where its handle is; home it first.",
    NackReason.STOP_OPEN: "The hardware stop is open; close it, then clear.",
}

_WAY_OUT = {
    State.STOPPED: "start it first",
    State.RUNNING: "stop it first",
    State.STOPPING: "wait until it has stopped",
    State.DRIVING: "stop it, or wait for the end of the drive",
    State.HOLD: "find out why, then clear it",
    State.ESTOP: "find out why, then clear it",
}


def meaning(names: type[IntEnum], number: int) -> str:
    """Name of the member of the enumeration `names` with this number; for an unknown number the enumeration and the
    number, such as "state 9"."""
    return names(number).name if number in names._value2member_map_ else f"{names.__name__.lower()} {number}"


def held_because(reason: int) -> str:
    """Clause for a `HoldReason` number: why a device is in HOLD or changed its state; "of reason N" for an unknown
    number."""
    return _HOLD[HoldReason(reason)] if reason in HoldReason._value2member_map_ else f"of reason {reason}"


def sentence(reason: int, request: str, ticks: int, value: float, limit: float) -> str:
    """Sentence that explains a NACK: its `reason` (`NackReason`), the name of the `request` in PROTOCOL.md, and the
    numbers that the NACK carries. A reason that is unknown is given by its number."""
    if reason not in NackReason._value2member_map_:
        return f"The device refuses {request} for reason {reason}, which this hilbo does not know; install a newer one."
    state = int(value) if reason == NackReason.STATE and value == value else 0
    way_out = _WAY_OUT.get(State(state), "") if state in State._value2member_map_ else "stop it first"
    words = {"request": request, "ticks": ticks, "value": value, "limit": limit}
    return _NACK[NackReason(reason)].format(**words, state=meaning(State, state), way_out=way_out)
