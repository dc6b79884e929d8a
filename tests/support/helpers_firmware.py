"""The device's C core in this process: built by the C compiler that is here, driven byte by byte and tick by tick.

Messages are read and written by the schema in PROTOCOL.md itself, so that the document judges the C code.
"""

import ctypes
import hashlib
import os
import re
import shutil
import struct
import subprocess
import tempfile
import zlib
from pathlib import Path

import numpy as np
import pytest

__all__ = [
    "CAUSES", "CONFIG", "CORE", "DOCUMENT", "EXPONENTIALS", "FIRMWARE", "FLAGS", "NAMES", "REASONS", "STATES",
    "TYPES", "Device", "build", "cobs", "compiler", "decode", "frame", "full_set", "library",
    "pack", "parameters", "schema", "unpack",
]  # fmt: skip

FIRMWARE = Path(__file__).parents[2] / "firmware"
CORE = Path(os.environ.get("HILBO_FIRMWARE_CORE", FIRMWARE / "core"))
CACHE = Path(__file__).parents[2] / ".pytest_cache" / "firmware"
STRICT = [
    "-std=c11", "-O2", "-ffp-contract=off", "-Wall", "-Wextra", "-Wconversion", "-Wsign-conversion",
    "-Wdouble-promotion", "-Wmissing-prototypes", "-Wstrict-prototypes", "-Wshadow", "-Wpedantic", "-Werror",
]  # fmt: skip
DOCUMENT = (FIRMWARE / "PROTOCOL.md").read_text(encoding="utf-8")
_SIZES = {"u8": "B", "i16": "h", "u16": "H", "u32": "I", "f32": "f"}


def schema() -> str:
    """The text that HELLO's checksum is of."""
    return DOCUMENT.split("```schema\n")[1].split("```")[0]


def _parse(schema: str) -> tuple[dict[str, int], dict[str, tuple[list, list]]]:
    types, fields = {}, {}
    for line in schema.splitlines()[1:]:
        number, name, *rest = line.split(maxsplit=2)
        head, _, repeated = "".join(rest).partition("n*(")
        types[name] = int(number, 16)
        optional = re.findall(r"\[(\w+):(\w+)\]", repeated)
        repeated = re.sub(r"\[.*?\]", "", repeated)
        pairs = [[tuple(word.split(":")) for word in part.strip(" )").split()] for part in (head, repeated)]
        fields[name] = (pairs[0], pairs[1], optional)
    return types, fields


TYPES, FIELDS = _parse(schema())
NAMES = {number: name for name, number in TYPES.items()}
_TABLE = DOCUMENT.split("| NACK reason |")[1]
REASONS = {int(number): name for number, name in re.findall(r"^\| (\d+) \| ([A-Z_0-9]+) \|", _TABLE, re.M)}
STATES = ("STOPPED", "RUNNING", "STOPPING", "DRIVING", "HOLD", "ESTOP")
CAUSES = ("NONE", "WATCHDOG", "INPUT", "VELOCITY", "OVERRUN", "MODEL", "ENERGY", "ESTOP", "BOOT", "SWITCH", "HEAT")
FLAGS = ("contact", "held", "saturated", "slewed", "controlled", "switching", "hold", "estop", "running", "driving")


def _code(pairs) -> str:
    return "<" + "".join(_SIZES[size] for _, size in pairs)


def pack(name: str, repeated=(), **values) -> bytes:
    """Payload of a message; reserved fields are 0 unless given."""
    head, tail, _ = FIELDS[name]
    assert set(values) <= {field for field, _ in head}
    payload = struct.pack(_code(head), *(values.get(field, 0) for field, _ in head))
    return payload + b"".join(struct.pack(_code(tail), *row) for row in repeated)


def unpack(name: str, payload: bytes) -> dict:
    """Fields of a message, and `repeated`, a list of tuples."""
    head, tail, optional = FIELDS[name]
    size = struct.calcsize(_code(head))
    fields = dict(zip((field for field, _ in head), struct.unpack(_code(head), payload[:size]), strict=True))
    if optional and fields["fields"] & 1:
        tail = tail + optional
    fields["repeated"] = list(struct.iter_unpack(_code(tail), payload[size:])) if tail else []
    assert tail or len(payload) == size
    return fields


def cobs(body: bytes) -> bytes:
    """Consistent overhead byte stuffing of less than 254 bytes, by splitting at the zeros."""
    return b"".join(bytes([len(part) + 1]) + part for part in body.split(b"\0"))


def frame(name: str | int, seq: int, payload: bytes = b"") -> bytes:
    """One frame as it goes over the line."""
    body = bytes([TYPES.get(name, name), seq]) + payload
    return cobs(body + struct.pack("<I", zlib.crc32(body))) + b"\0"


def decode(encoded: bytes) -> tuple[int, int, bytes]:
    """Type, seq and payload of a frame without its 0x00; the checksum must be right."""
    body, at = b"", 0
    while at < len(encoded):
        body += encoded[at + 1 : at + encoded[at]] + b"\0"
        at += encoded[at]
    assert at == len(encoded)
    body = body[:-1]
    assert struct.unpack("<I", body[-4:])[0] == zlib.crc32(body[:-4])
    return body[0], body[1], body[2:-4]


def compiler() -> str:
    """The C compiler; without one the test is skipped."""
    path = os.environ.get("CC") or next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
    if path is None:
        pytest.skip("there is no C compiler: install gcc or clang")
    return path


def build(
    core: Path = CORE, extra: tuple[str, ...] = (), drivers: tuple[str, ...] = ("shim.c",), cc: str | None = None
) -> Path:
    """Shared library (or, with a driver that has a main, a program) of these sources, from the cache if it is there."""
    sources = [*sorted(core.glob("*.c")), *(FIRMWARE / "tests" / name for name in drivers)]
    program = "shim.c" not in drivers
    extra = (*extra, *os.environ.get("HILBO_FIRMWARE_FLAGS", "").split())
    command = [cc or compiler(), *STRICT, *extra, *([] if program else ["-shared", "-fPIC"]), f"-I{core}"]
    texts = [path.read_bytes() for path in [*sources, *sorted(core.glob("*.h")), FIRMWARE / "tests" / "shim.h"]]
    key = hashlib.sha256(b"\0".join([" ".join(command).encode(), *texts])).hexdigest()[:16]
    target = CACHE / f"{'run' if program else 'lib'}-{key}"
    if not target.exists():
        CACHE.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=CACHE) as folder:
            made = Path(folder) / "made"
            subprocess.run([*command, *map(str, sources), "-o", str(made), "-lm"], check=True)
            made.replace(target)
    return target


CONFIG = {
    "firmware": 0xDEADBEEF, "line_rate_baud": 1_000_000, "tick_rate_Hz": 1000, "watchdog_ticks": 250, "hold_ticks": 20,
    "most_taps": 255, "most_states": 12, "capabilities": 27, "damping": 0.95, "force_limit": 40.0, "low": -20.0,
    "high": 60.0, "step": 0.0127, "slew": 2000.0, "velocity": 1000.0, "plausible": 2.0,
    "K0_low": -20.0, "K0_high": 40.0, "K1_low": 0.5, "K1_high": 40.0, "B1_low": 5e-4, "B1_high": 40.0,
    "alpha_low": 0.005, "alpha_high": 0.995, "servo_stiffness": 1.0, "servo_damping": 0.02, "servo_integral": 5.0,
    "servo_speed": 100.0, "delay_us": 0, "continuous_force": 40.0, "heating": 10.0,
}  # fmt: skip
"""Numbers of a device that these tests are about, in the order of shim_init."""


def library(path: Path) -> ctypes.CDLL:
    lib = ctypes.CDLL(str(path))
    for name, result in {
        "size": ctypes.c_size_t, "device_size": ctypes.c_size_t, "transmit": ctypes.c_size_t,
        "receive_once": ctypes.c_size_t, "tick": ctypes.c_float, "flags": ctypes.c_uint32, "offset_N": ctypes.c_double,
        "warm_left": ctypes.c_uint32, "stops": ctypes.c_uint32, "now": ctypes.c_uint32,
        "tick_of_board": ctypes.c_float, "delayed_damping": ctypes.c_double,
        "power": ctypes.c_float, "power_error": ctypes.c_double,
        "sentence": ctypes.c_char_p,
    }.items():  # fmt: skip
        getattr(lib, f"shim_{name}").restype = result
    return lib


class Device:
    """One device. `ask` sends a request and returns the answer; notices and telemetry gather beside."""

    def __init__(self, boot_id: int = 7, lib: ctypes.CDLL | None = None, hello: bool = True, **changed):
        assert set(changed) <= set(CONFIG)
        if "force_limit" in changed:
            changed = {"continuous_force": changed["force_limit"]} | changed
        if "capabilities" in changed and changed["capabilities"] < 32:
            changed["capabilities"] |= 24  # simulated, homed at boot
        self.lib = library(build()) if lib is None else lib
        self.memory = ctypes.create_string_buffer(self.lib.shim_size())
        self.config = CONFIG | changed
        self.notices, self.telemetry, self.pulses, self.seq = [], [], [], 0
        self.hello_said = hello
        self.boot(boot_id)
        if hello:
            self.hello()

    def boot(self, boot_id: int) -> None:
        """Switch on, or on again."""
        numbers = (ctypes.c_double * len(CONFIG))(*self.config.values())
        self.boot_id = boot_id
        self.error = self.lib.shim_init(self.memory, numbers, ctypes.c_uint32(boot_id))

    def feed(self, data: bytes) -> None:
        self.lib.shim_receive(self.memory, data, ctypes.c_size_t(len(data)))

    def drain(self) -> bytes:
        room = ctypes.create_string_buffer(4096)
        size = self.lib.shim_transmit(self.memory, room, ctypes.c_size_t(4096))
        return room.raw[:size]

    def collect(self) -> list[tuple[str, int, dict]]:
        """Answers that are out; notices and telemetry go to their lists."""
        answers = []
        for encoded in filter(None, self.drain().split(b"\0")):
            number, seq, payload = decode(encoded)
            name = NAMES[number]
            message = unpack(name, payload) if name != "ECHO_REPLY" else {"payload": payload}
            if name in ("NOTICE", "TELEMETRY", "PULSE"):
                {"NOTICE": self.notices, "TELEMETRY": self.telemetry, "PULSE": self.pulses}[name].append(message)
            else:
                answers.append((name, seq, message))
        return answers

    def exchange(self, data: bytes) -> tuple[str, dict] | None:
        """What answers these bytes; a NACK's reason by name."""
        self.collect()
        self.feed(data)
        answers = self.collect()
        if not answers:
            return None
        ((name, _, message),) = answers
        if name == "NACK":
            message["reason"] = REASONS[message["reason"]]
        return name, message

    def ask(self, name: str | int, payload: bytes | None = None, repeated=(), **values) -> tuple[str, dict]:
        self.seq = (self.seq + 1) % 256
        if name in ("START", "DRIVE", "HOME") and self.hello_said and self.lib.shim_now(self.memory) == 0:
            self.tick()  # nothing moves before a position is known
        payload = self.packed(name, repeated, **values) if payload is None else payload
        answer = self.exchange(frame(name, self.seq, payload))
        assert answer is not None, f"no answer to {name}"
        return answer

    def packed(self, name: str, repeated=(), **values) -> bytes:
        """Payload of a request by a host that has heard of every stop and every tick."""
        known = {"stop": self.stops, "tick": self.lib.shim_now(self.memory)}
        fields = {field for field, _ in FIELDS[name][0]} if isinstance(name, str) else set()
        return pack(name, repeated, **({key: known[key] for key in known if key in fields} | values))

    @property
    def stops(self) -> int:
        """How many stops the device has counted."""
        return self.lib.shim_stops(self.memory)

    def must(self, name: str, **values) -> dict:
        """The answer, which is no NACK."""
        kind, message = self.ask(name, **values)
        assert kind != "NACK", f"{name} was refused: {message}"
        return message

    def refusal(self, name: str | int, payload: bytes | None = None, **values) -> str:
        kind, message = self.ask(name, payload, **values)
        assert kind == "NACK", f"{name} was not refused but {message}"
        assert message["request"] == TYPES.get(name, name)
        return message["reason"]

    def hello(self) -> dict:
        return self.must("HELLO", version=2, schema=zlib.crc32(schema().encode()))

    def status(self) -> dict:
        return self.must("GET_STATUS")

    @property
    def state(self) -> str:
        return STATES[self.status()["state"]]

    def beat(self) -> None:
        self.feed(frame("HEARTBEAT", 0, self.packed("HEARTBEAT", boot_id=self.boot_id)))

    def stage(self, model: dict, set_id: int = 1) -> tuple[int, int]:
        """SET_PARAMS and its SET_STATES; the id and the checksum that name the set."""
        self.crc = 0
        states = model.get("states", [])
        payloads = [("SET_PARAMS", parameters(model, set_id))]
        for first in range(0, len(states), 7):
            part = states[first : first + 7]
            payloads.append(("SET_STATES", pack("SET_STATES", part, set_id=set_id, first=first, count=len(part))))
        for name, payload in payloads:
            kind, message = self.ask(name, payload)
            assert kind == "ACK", message
            self.crc = zlib.crc32(payload, self.crc)
            assert (message["set_id"], message["crc"]) == (set_id, self.crc)
        return set_id, self.crc

    def confirm(self, name: str, staged: tuple[int, int]) -> tuple[str, dict]:
        return self.ask(name, set_id=staged[0], crc=staged[1], boot_id=self.boot_id)

    def go(self, model: dict, set_id: int = 1) -> tuple[int, int]:
        """Stage, commit and start, out of contact."""
        staged = self.stage(model, set_id)
        self.beat()
        for name in ("COMMIT", "START"):
            kind, message = self.confirm(name, staged)
            assert kind == "ACK", message
        return staged

    def tick(self, counts: int = 0, valid: bool = True, overrun: bool = False, sensed: float = 0.0) -> float:
        return self.lib.shim_tick(self.memory, counts, int(valid), int(overrun), ctypes.c_float(sensed))

    @property
    def flags(self) -> set[str]:
        """Those of the last tick."""
        bits = self.lib.shim_flags(self.memory)
        return {name for bit, name in enumerate(FLAGS) if bits >> bit & 1}

    @property
    def offset(self) -> float:
        return self.lib.shim_offset_N(self.memory)

    def run(self, counts, beating: bool = True) -> tuple[np.ndarray, np.ndarray]:
        """Forces and flags of many ticks at once."""
        counts = np.ascontiguousarray(counts, np.int32)
        forces, flags = np.empty(counts.size, np.float32), np.empty(counts.size, np.uint16)
        self.lib.shim_run(
            self.memory, counts.ctypes.data_as(ctypes.c_void_p), ctypes.c_size_t(counts.size), int(beating),
            forces.ctypes.data_as(ctypes.c_void_p), flags.ctypes.data_as(ctypes.c_void_p),
        )  # fmt: skip
        return forces, flags


def parameters(model: dict, set_id: int = 1) -> bytes:
    """Payload of SET_PARAMS for {K0, K1, B1, alpha} with N or states."""
    states = model.get("states", [])
    return pack(
        "SET_PARAMS", set_id=set_id, memory=int("states" in model),
        length=len(states) if "states" in model else model.get("N", 101),
        tick_rate_Hz=model.get("rate", 1000), K0_N_per_mm=model["K0"], K1_N_per_mm=model["K1"],
        B1_N_s_alpha_per_mm=model["B1"], alpha=model["alpha"], force_limit_N=model.get("force_limit", 30.0),
    )  # fmt: skip


EXPONENTIALS = [
    (0.16150905, 0.9044945),
    (0.19177684, 0.52692366),
    (0.16125424, 0.23115093),
    (0.12465648, 0.0905768),
    (0.09473704, 0.033717748),
    (0.07124848, 0.012141097),
    (0.05358717, 0.0042446544),
    (0.041970227, 0.0014005903),
    (0.038842943, 0.0003679924),
    (0.06041753, 2.3818455e-05),
]
"""Weight and loss of the host's ten exponentials for alpha = 0.3 (another test makes them anew)."""


def full_set(**changed) -> dict:
    return {"K0": 0.44, "K1": 1.0, "B1": 3.0, "alpha": 0.3, "states": list(EXPONENTIALS)} | changed
