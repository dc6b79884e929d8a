"""Messages between host and device: one frozen dataclass for each message of firmware/PROTOCOL.md.

The annotations define the layout on the wire: `protocol.schema_text` prints PROTOCOL.md's schema from them, and a test
compares it with the file, byte for byte. Names, units and meaning of the fields are explained there.
"""

import re
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple, dataclass_transform

__all__ = [
    "MESSAGES",
    "SCHEMA",
    "VERSION",
    "Abort",
    "Ack",
    "Clear",
    "Commit",
    "Drive",
    "Echo",
    "EchoReply",
    "Estop",
    "Exponential",
    "GetLimits",
    "GetSet",
    "GetStatus",
    "Heartbeat",
    "Hello",
    "HelloReply",
    "Home",
    "Limits",
    "Message",
    "Nack",
    "Notice",
    "Pulse",
    "Sample",
    "Set",
    "SetParams",
    "SetStates",
    "Start",
    "Status",
    "Stop",
    "Stream",
    "Telemetry",
    "code_of",
    "name_of",
]

VERSION = 2
SCHEMA = 0xEEF43481
"""CRC-32 of the schema block of PROTOCOL.md, by which both sides check that their layouts agree."""

U8 = Annotated[int, "u8"]
U16 = Annotated[int, "u16"]
U32 = Annotated[int, "u32"]
F32 = Annotated[float, "f32"]


@dataclass_transform(frozen_default=True, kw_only_default=True)
def _message(kind):
    """Make a class a message: a frozen, slotted dataclass with keyword-only fields."""
    return dataclass(frozen=True, slots=True, kw_only=True)(kind)


class Exponential(NamedTuple):
    """Weight p_k and loss 1 - λ_k of one of the exponentials of full memory."""

    weight: float
    loss: float


class Sample(NamedTuple):
    """Telemetry of one tick; `sensed_N` is None if it was not requested."""

    position_counts: int
    flags: int
    force_N: float
    sensed_N: float | None = None


@_message
class Hello:
    version: U16 = VERSION
    reserved: U16 = 0
    schema: U32 = SCHEMA


@_message
class SetParams:
    set_id: U16
    memory: U8
    reserved: U8 = 0
    length: U16
    tick_rate_Hz: U16
    K0_N_per_mm: F32
    K1_N_per_mm: F32
    B1_N_s_alpha_per_mm: F32
    alpha: F32
    force_limit_N: F32


@_message
class SetStates:
    set_id: U16
    first: U8
    count: U8
    states: Annotated[tuple[Exponential, ...], "n*(weight:f32 loss:f32)"]


@_message
class Commit:
    set_id: U16
    reserved: U16 = 0
    crc: U32
    boot_id: U32


@_message
class Abort:
    pass


@_message
class GetStatus:
    pass


@_message
class GetSet:
    bank: U8


@_message
class GetLimits:
    pass


@_message
class Start:
    set_id: U16
    reserved: U16 = 0
    crc: U32
    boot_id: U32
    stop: U32


@_message
class Stop:
    pass


@_message
class Estop:
    pass


@_message
class Clear:
    boot_id: U32
    stop: U32


@_message
class Stream:
    divisor: U8
    fields: U8


@_message
class Heartbeat:
    boot_id: U32
    tick: U32


@_message
class Drive:
    mode: U8
    shape: U8
    reserved: U16 = 0
    offset: F32
    amplitude: F32
    period_ticks: U32
    duration_ticks: U32
    boot_id: U32
    stop: U32


@_message
class Echo:
    data: Annotated[bytes, "n*(byte:u8)"]


@_message
class Home:
    boot_id: U32
    stop: U32
    position_mm: F32


@_message
class HelloReply:
    version: U16
    tick_rate_Hz: U16
    schema: U32
    firmware: U32
    boot_id: U32
    line_rate_baud: U32
    damping_N_s_per_m: F32
    force_limit_N: F32
    position_low_mm: F32
    position_high_mm: F32
    encoder_step_mm: F32
    slew_limit_N_per_s: F32
    velocity_limit_mm_per_s: F32
    watchdog_ticks: U16
    hold_ticks: U16
    most_taps: U16
    most_states: U8
    capabilities: U8
    tick: U32


@_message
class Limits:
    K0_low: F32
    K0_high: F32
    K1_low: F32
    K1_high: F32
    B1_low: F32
    B1_high: F32
    alpha_low: F32
    alpha_high: F32
    delay_us: U32
    continuous_force_N: F32
    heating_s: F32


@_message
class Ack:
    request: U8
    reserved: U8 = 0
    set_id: U16
    crc: U32
    stops: U32


@_message
class Nack:
    request: U8
    reason: U8
    reserved: U16 = 0
    ticks: U32
    value: F32
    limit: F32


@_message
class Status:
    tick: U32
    boot_id: U32
    state: U8
    hold_reason: U8
    staging: U8
    contact: U8
    active_id: U16
    staged_id: U16
    active_crc: U32
    staged_crc: U32
    ticks_until_ready: U32
    position_mm: F32
    force_N: F32
    energy_mJ: F32
    input_held: U16
    saturated: U16
    slewed: U16
    controlled: U16
    holds: U16
    estops: U16
    overruns: U16
    frames_dropped: U16
    stops: U32
    flags: U16
    delay_us: U16


@_message
class Set:
    bank: U8
    reserved: U8 = 0
    set_id: U16
    memory: U8
    flags: U8
    length: U16
    K0_N_per_mm: F32
    K1_N_per_mm: F32
    B1_N_s_alpha_per_mm: F32
    alpha: F32
    force_limit_N: F32
    crc: U32
    minimum_damping_N_s_per_m: F32


@_message
class Notice:
    tick: U32
    boot_id: U32
    state: U8
    reason: U8
    reserved: U16 = 0
    stops: U32


@_message
class Telemetry:
    tick: U32
    divisor: U8
    fields: U8
    lost: U16
    samples: Annotated[tuple[Sample, ...], "n*(position_counts:i16 flags:u16 force_N:f32 [sensed_N:f32])"]


@_message
class EchoReply:
    data: Annotated[bytes, "n*(byte:u8)"]


@_message
class Pulse:
    tick: U32
    boot_id: U32
    state: U8
    reason: U8
    reserved: U16 = 0
    stops: U32


Message = Any  # one of the classes above
# fmt: off
_REQUESTS = (Hello, SetParams, SetStates, Commit, Abort, GetStatus, GetSet, GetLimits, Start, Stop, Estop, Clear,
             Stream, Heartbeat, Drive, Echo, Home)
_ANSWERS = (HelloReply, Limits, Ack, Nack, Status, Set, Notice, Telemetry, EchoReply, Pulse)
# fmt: on
MESSAGES: dict[int, type] = dict(enumerate(_REQUESTS, 0x01)) | dict(enumerate(_ANSWERS, 0x41))
"""The class of each type on the wire."""
_TYPES = {kind: code for code, kind in MESSAGES.items()}


def code_of(kind: type) -> int:
    """Type byte of a message class on the wire."""
    return _TYPES[kind]


def name_of(kind: type) -> str:
    """Name of a message class in PROTOCOL.md, such as SET_PARAMS for SetParams."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", kind.__name__).upper()
