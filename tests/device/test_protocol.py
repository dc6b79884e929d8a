"""The wire protocol against PROTOCOL.md, against itself, and against damage of every kind."""

import contextlib
import itertools
import math
import random
import re
import struct
import zlib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hilbo.device import frames, protocol, reasons
from hilbo.device.frames import LONGEST, Frame, Receiver, WireError, decoded_frame
from hilbo.device.messages import (
    MESSAGES,
    SCHEMA,
    Clear,
    Drive,
    Echo,
    EchoReply,
    Exponential,
    Sample,
    SetParams,
    SetStates,
    Start,
    Stop,
    Telemetry,
    code_of,
    name_of,
)
from hilbo.device.protocol import decode, encode

ROOT = Path(__file__).parents[2]
DOCUMENT = (ROOT / "firmware" / "PROTOCOL.md").read_text(encoding="utf-8")
VECTORS = ROOT / "tests" / "vectors" / "frames.txt"

NUMBERS = {
    "u8": st.integers(0, 2**8 - 1),
    "u16": st.integers(0, 2**16 - 1),
    "u32": st.integers(0, 2**32 - 1),
    "f32": st.floats(width=32),
}


@st.composite
def messages(draw):
    """Class and fields of any message that fits a payload; made in the tests, whose type checks draw random numbers."""
    kind = draw(st.sampled_from(list(MESSAGES.values())))
    words = protocol._wire(kind)
    values = {name: draw(NUMBERS[word]) for name, word in words.items() if word in NUMBERS and name != "reserved"}
    if kind in (Echo, EchoReply):
        values["data"] = draw(st.binary(max_size=64))
    if kind is SetStates:
        pair = st.builds(Exponential, NUMBERS["f32"], NUMBERS["f32"])
        values["states"] = tuple(draw(st.lists(pair, max_size=7)))
        values["count"] = len(values["states"])
    if kind is Telemetry:
        sensed = NUMBERS["f32"] if values["fields"] & 1 else st.none()
        sample = st.builds(Sample, st.integers(-(2**15), 2**15 - 1), NUMBERS["u16"], NUMBERS["f32"], sensed)
        values["samples"] = tuple(draw(st.lists(sample, max_size=4 if values["fields"] & 1 else 7)))
    return kind, values


def test_the_schema_is_the_documents():
    block = re.search(r"```schema\n(.*?)```", DOCUMENT, re.DOTALL)[1]
    assert protocol.schema_text() == block
    assert zlib.crc32(block.encode()) == SCHEMA


def test_the_numbers_with_names_are_the_documents():
    named = {
        reasons.Memory: r"`memory`: (.*?)\.",
        reasons.Staging: r"`staging`: (.*?)\.",
        reasons.State: r"`state`: (.*?)\.",
    }
    for kind, pattern in named.items():
        pairs = [word.split() for word in re.search(pattern, DOCUMENT)[1].split(", ")]
        assert {int(number): name for number, name in pairs} == {member.value: member.name for member in kind}
    tables = [
        dict(re.findall(r"^\| (\d+) \| ([A-Z0-9_]+) \|", part, re.MULTILINE))
        for part in DOCUMENT.split("NACK reason |")
    ]
    for kind, table in zip((reasons.HoldReason, reasons.NackReason), tables, strict=True):
        assert {str(member.value): member.name for member in kind} == table


@given(messages(), st.integers(0, 255))
def test_a_message_comes_back(drawn, seq):
    message = drawn[0](**drawn[1])
    frame = encode(message, seq)
    assert frame.count(0) == 1 and frame[-1] == 0 and len(frame) <= LONGEST + 1
    (received,) = Receiver().feed(frame)
    assert (received.type, received.seq) == (code_of(type(message)), seq)
    assert protocol.payload_of(decode(received)) == received.payload == protocol.payload_of(message)
    assert type(decode(received)) is type(message)


@given(st.binary(max_size=64), st.integers(0, 255), st.integers(0, 255))
def test_a_frame_of_any_bytes_comes_back(payload, kind, seq):
    frame = Frame(kind, seq, payload)
    assert decoded_frame(frames.encoded_frame(frame)[:-1]) == frame


@given(st.binary(max_size=300))
def test_bytes_that_are_no_frame_are_refused(content):
    with contextlib.suppress(WireError):
        decoded_frame(content)


@given(messages(), messages())
def test_a_frame_cut_anywhere_is_lost_alone(drawn, after):
    first, second = (encode(kind(**values), seq) for seq, (kind, values) in ((1, drawn), (2, after)))
    for cut in range(len(first)):
        receiver = Receiver()
        received = receiver.feed(first[:cut] + b"\0" + second)
        assert [frame.seq for frame in received] == ([1, 2] if cut == len(first) - 1 else [2])
        assert receiver.dropped == (0 < cut < len(first) - 1)


@given(messages(), st.lists(st.integers(0, 10_000), max_size=12))
def test_bytes_may_arrive_in_any_pieces(drawn, cuts):
    whole = b"\0" + 5 * encode(drawn[0](**drawn[1]), 7)
    places = sorted({0, len(whole), *(cut % len(whole) for cut in cuts)})
    receiver = Receiver()
    received = [frame for a, b in itertools.pairwise(places) for frame in receiver.feed(whole[a:b])]
    assert len(received) == 5 and receiver.dropped == 0


@pytest.mark.parametrize("rate", [1e-3, 1e-2])
@pytest.mark.parametrize("fault", ["flip", "drop", "insert"])
@pytest.mark.parametrize("frames_sent", [2_000, pytest.param(20_000, marks=pytest.mark.deep)])
def test_damage_costs_the_frames_it_hits_and_no_more(fault, rate, frames_sent):
    rng = random.Random(f"{fault}{rate}")
    receiver, sent, hit, got = Receiver(), 0, 0, 0
    last_hit = False
    for n in range(frames_sent):
        message = Echo(data=rng.randbytes(n % 30))
        whole = encode(message, n % 256)
        damaged = bytearray()
        for byte in whole:
            struck = rng.random() < rate
            if struck and fault == "drop":
                continue
            damaged.append(byte ^ (1 << rng.randrange(8)) if struck and fault == "flip" else byte)
            if struck and fault == "insert":
                damaged.append(rng.randrange(256))
        # A frame whose 0x00 is lost takes the next one with it.
        hit += damaged != whole or last_hit
        last_hit = bytes(damaged[-1:]) != b"\0"
        sent += 1
        for frame in receiver.feed(bytes(damaged)):
            assert decode(frame).data is not None
            got += 1
    assert sent - hit <= got <= sent
    assert receiver.dropped > 0


def test_a_receiver_holds_one_frame_at_most():
    receiver = Receiver()
    for _ in range(1000):
        assert receiver.feed(b"\x05garbage") == []
    assert len(receiver._buffer) <= LONGEST + 1
    assert [frame.seq for frame in receiver.feed(b"\0" + encode(Stop(), 9))] == [9]
    assert receiver.dropped == 1


def test_a_wrong_crc_is_never_accepted():
    whole = encode(Start(set_id=7, crc=0x12345678, boot_id=9, stop=1), 3)
    for place in range(len(whole) - 1):
        for bit in range(8):
            broken = bytearray(whole)
            broken[place] ^= 1 << bit
            assert Receiver().feed(bytes(broken)) == []


@pytest.mark.parametrize(
    ("frame", "words"),
    [
        (Frame(0x33, 0, b""), "type 0x33 is not of this protocol"),
        (Frame(0x0A, 0, b"x"), "STOP has 1 bytes instead of 0"),
        (Frame(0x43, 0, b"\1\1" + bytes(10)), "ACK has a reserved field that is not 0"),
        (Frame(0x48, 0, b"\0" * 8 + b"abc"), "TELEMETRY ends in the middle"),
        (Frame(0x03, 0, b"\1\0\0\2" + b"\0" * 8), "SET_STATES ends in the middle"),
        (Frame(0x45, 0, b"\0" * 60), "STATUS has 60 bytes instead of 64"),
    ],
)
def test_a_payload_that_is_no_message_is_refused(frame, words):
    with pytest.raises(WireError, match=words):
        decode(frame)


@pytest.mark.parametrize("message", [Clear(boot_id=2**32, stop=0), Echo(data=bytes(65))])
def test_what_does_not_fit_is_refused(message):
    with pytest.raises(WireError):
        encode(message, 0)


def test_a_number_too_large_for_the_wire_is_refused():
    values = dict.fromkeys(("K0_N_per_mm", "K1_N_per_mm", "B1_N_s_alpha_per_mm", "alpha", "force_limit_N"), 1e300)
    with pytest.raises(WireError, match="SET_PARAMS cannot be packed"):
        encode(SetParams(set_id=1, memory=0, length=101, tick_rate_Hz=1000, **values), 0)


@pytest.mark.parametrize("reason", list(reasons.NackReason))
def test_every_refusal_is_one_sentence_with_its_numbers(reason):
    words = reasons.sentence(reason, "START", 17, 4.0, 3.25)
    assert words.endswith(".") and "{" not in words
    carries = {"NOT_READY": "17", "BUSY": "17", "NOT_PASSIVE": "3.25", "STATE": "HOLD", "K1_RANGE": "3.25"}
    assert carries.get(reason.name, "") in words


def test_a_refusal_that_is_not_known_yet_is_said_too():
    assert "reason 99" in reasons.sentence(99, "START", 0, math.nan, math.nan)
    assert reasons.sentence(reasons.NackReason.STATE, "START", 0, math.nan, 0.0).endswith(".")
    assert reasons.meaning(reasons.State, 77) == "state 77"


def test_every_hold_has_words():
    assert all(reasons.held_because(reason) for reason in reasons.HoldReason)
    assert reasons.held_because(99) == "of reason 99"


def test_a_capture_is_read_to_its_end():
    good = encode(Stop(), 1)
    capture = b"\0" + good + b"\x03ab\0" + encode(Echo(data=b"x"), 2) + good[:3]
    entries = list(protocol.frames_in(capture))
    assert [place for place, *_ in entries] == [1, 1 + len(good), 5 + len(good), len(capture) - 3]
    assert [type(message).__name__ for _, message, _ in entries] == ["Stop", "WireError", "Echo", "WireError"]


@pytest.mark.skipif(not VECTORS.exists(), reason="the golden frames come with the firmware")
def test_golden_frames():
    lines = [line.split() for line in VECTORS.read_text().splitlines() if line.strip() and not line.startswith("#")]
    assert len(lines) >= len(MESSAGES)
    seen = set()
    for name, kind, seq, payload, frame in lines:
        body = Frame(int(kind, 16), int(seq, 16), b"" if payload == "-" else bytes.fromhex(payload))
        assert frames.encoded_frame(body).hex() == frame.lower(), name
        (received,) = Receiver().feed(bytes.fromhex(frame))
        assert received == body, name
        if body.type in MESSAGES:
            message = decode(body)
            seen.add(name_of(type(message)))
            assert encode(message, body.seq).hex() == frame.lower(), name
    assert seen == {name_of(kind) for kind in MESSAGES.values()}


def test_floats_are_rounded_once():
    message = decode(
        Receiver().feed(
            encode(
                Drive(
                    mode=1,
                    shape=0,
                    offset=0.1,
                    amplitude=0.0,
                    period_ticks=0,
                    duration_ticks=1,
                    boot_id=1,
                    stop=0,
                ),
                0,
            )
        )[0]
    )
    assert message.offset == struct.unpack("<f", struct.pack("<f", 0.1))[0]
