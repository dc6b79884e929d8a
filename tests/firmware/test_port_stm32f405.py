"""The STM32F405 port in the emulator: a whole session with a finger, the hardware stop, late ticks, and what it costs.

The image is the chip's own loop (device.c) and line (uart.c) on board_emulated.c; the registers of the real board are
in test_port_stm32f405_registers.py. The second serial line is the hand of the test.
"""

import ctypes
import re
import select
import socket
import struct
import subprocess
import time
import zlib
from pathlib import Path

import numpy as np
import pytest
from device_port import FIRMWARE, PATIENCE, SCHEMA, State, image
from helpers_firmware import FLAGS, NAMES, REASONS, build, decode, frame, library, pack, unpack

from hilbo.hardware_bridge import Renderer

CAUSE_WATCHDOG, CAUSE_INPUT, CAUSE_OVERRUN, CAUSE_ESTOP, CAUSE_SWITCH = 1, 2, 4, 7, 9
SET = {"set_id": 5, "memory": 0, "length": 101, "tick_rate_Hz": 1000, "force_limit_N": 5.0}
SET |= {"K0_N_per_mm": 0.1, "K1_N_per_mm": 0.2, "B1_N_s_alpha_per_mm": 0.3, "alpha": 0.3}
HANDLE_MM = -1.0  # where the simulated handle is at the start
PRESSES = b"6"
EMULATED, REAL = "stm32f405-emulated", "stm32f405"


class Line:
    """A serial line of the emulator."""

    def __init__(self, path: Path):
        self.listener = socket.socket(socket.AF_UNIX)
        self.listener.bind(str(path))
        self.listener.listen()
        self.options = f"socket,id={path.name},path={path}"

    def accept(self) -> None:
        assert select.select([self.listener], [], [], PATIENCE)[0], "the emulator does not start"
        self.socket, _ = self.listener.accept()
        self.listener.close()

    def read(self, patience: float) -> bytes:
        return self.socket.recv(65_536) if select.select([self.socket], [], [], patience)[0] else b""


class Emulated:
    """The image with both its lines. Heartbeats go out by themselves while somebody listens."""

    def __init__(self, folder: Path, kernel: Path | None = None):
        self.line, self.hand = Line(folder / "line"), Line(folder / "hand")
        command = ["qemu-system-arm", "-M", "netduinoplus2", "-display", "none", "-monitor", "none"]
        for line, name in ((self.line, "line"), (self.hand, "hand")):
            command += ["-chardev", line.options, "-serial", f"chardev:{name}"]
        command += ["-icount", "shift=3", "-kernel", str(kernel or image(EMULATED, "m4"))]
        self.process = subprocess.Popen(command)
        self.line.accept()
        self.hand.accept()
        self.seq, self.rest = 0, b""
        self.boot_id = self.tick = self.told = 0
        self.notices: list[dict] = []
        self.samples: list[tuple] = []  # tick, counts, flags, bits of the force

    def __enter__(self) -> "Emulated":
        self.line.socket.sendall(b"\0")
        return self

    def __exit__(self, *_) -> None:
        self.process.kill()
        self.process.wait()
        self.line.socket.close()
        self.hand.socket.close()

    def listen(self) -> list[tuple[str, int, dict]]:
        """What comes next; telemetry and notices are kept too."""
        *frames, self.rest = (self.rest + self.line.read(0.02)).split(b"\0")
        heard = []
        for encoded in filter(None, frames):
            kind, seq, payload = decode(encoded)
            name, fields = NAMES[kind], unpack(NAMES[kind], payload)
            heard.append((name, seq, fields))
            if name == "TELEMETRY":
                self._collect(payload, fields)
            elif name == "NOTICE":
                self.notices.append(fields)
            self.tick = max(self.tick, fields.get("tick", 0))
        if self.boot_id and self.tick >= self.told + 30:
            self.line.socket.sendall(frame("HEARTBEAT", 0, pack("HEARTBEAT", boot_id=self.boot_id, tick=self.tick)))
            self.told = self.tick
        return heard

    def _collect(self, payload: bytes, fields: dict) -> None:
        assert fields["lost"] == 0 and fields["divisor"] == 1
        rows = struct.iter_unpack("<hHI", payload[8:])
        self.samples += [(fields["tick"] + i, *row) for i, row in enumerate(rows)]

    def ask(self, name: str, **values) -> tuple[str, dict]:
        self.seq = (self.seq + 1) % 256
        end = time.monotonic() + PATIENCE
        request = frame(name, self.seq, pack(name, **values))
        sent = -np.inf
        while time.monotonic() < end:
            if time.monotonic() > sent + 1.0:  # again: the line of a device that is starting loses bytes
                self.line.socket.sendall(request)
                sent = time.monotonic()
            for answer, seq, fields in self.listen():
                if seq == self.seq and answer not in ("TELEMETRY", "NOTICE", "PULSE"):
                    return answer, fields
        raise AssertionError(f"no answer to {name}")

    def acknowledged(self, name: str, **values) -> dict:
        answer, fields = self.ask(name, **values)
        assert answer == "ACK", f"{name}: {REASONS.get(fields.get('reason'))} {fields}"
        return fields

    def refused(self, name: str, **values) -> str:
        answer, fields = self.ask(name, **values)
        assert answer == "NACK", f"{name}: {fields}"
        return REASONS[fields["reason"]]

    def order(self) -> dict:
        """Boot id and the stop that the next order follows."""
        return {"boot_id": self.boot_id, "stop": self.status()["stops"]}

    def status(self) -> dict:
        return self.ask("GET_STATUS")[1]

    def hello(self) -> dict:
        answer, fields = self.ask("HELLO", version=2, schema=SCHEMA)
        assert answer == "HELLO_REPLY", fields
        self.boot_id = fields["boot_id"]
        return fields

    def wait(self, condition, what: str):
        end = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < end, f"no {what}"
            self.listen()

    def wait_ticks(self, count: int) -> None:
        until = self.status()["tick"] + count
        self.wait(lambda: self.status()["tick"] >= until, f"tick {until}")

    def wait_state(self, state: int) -> dict:
        self.wait(lambda: self.status()["state"] == state, f"state {state}")
        return self.status()

    def command(self, letter: bytes) -> None:
        self.hand.socket.sendall(letter)
        self.wait_ticks(3)

    def cost(self) -> tuple[int, ...]:
        """Ticks since the last time, mean and most of their instructions, longest delay (us), the driver's enable."""
        self.hand.socket.sendall(b"r")
        text = b""
        while not text.endswith(b"\n"):
            text += self.hand.read(PATIENCE)
        return tuple(map(int, text.split()))

    def stage(self) -> dict:
        """SET in force; what names it."""
        crc = self.acknowledged("SET_PARAMS", **SET)["crc"]
        self.wait(lambda: self.status()["staging"] == 3, "staged set that is ready")
        named = {"set_id": SET["set_id"], "crc": crc}
        self.acknowledged("COMMIT", **named, boot_id=self.boot_id)
        self.wait(lambda: self.status()["active_crc"] == crc, "set in force")
        return named

    def run(self) -> dict:
        """Homed, and RUNNING out of contact."""
        self.hello()
        self.wait_ticks(5)
        self.acknowledged("HOME", **self.order(), position_mm=HANDLE_MM)
        named = self.stage()
        self.acknowledged("STREAM", divisor=1, fields=0)
        self.wait_ticks(40)
        self.acknowledged("START", **named, **self.order())
        return named


@pytest.fixture
def device(tmp_path):
    with Emulated(tmp_path) as emulated:
        yield emulated


def forces_of_the_core(hello: dict, limits: dict, samples: np.ndarray) -> np.ndarray:
    """What the core on this machine gives at the same positions: bits. RUNNING from the first sample on."""
    low_high = [limits[f"{name}_{end}"] for name in ("K0", "K1", "B1", "alpha") for end in ("low", "high")]
    names = "damping_N_s_per_m force_limit_N position_low_mm position_high_mm encoder_step_mm slew_limit_N_per_s"
    numbers = [0, hello["line_rate_baud"], 1000, hello["watchdog_ticks"], hello["hold_ticks"], 255, 12, 1 | 16]
    numbers += [*(hello[name] for name in names.split()), hello["velocity_limit_mm_per_s"], 1.0, *low_high]
    numbers += [1.0, 0.02, 5.0, 50.0, limits["delay_us"], limits["continuous_force_N"], limits["heating_s"]]
    core = library(build())
    memory = ctypes.create_string_buffer(core.shim_size())
    assert core.shim_init(memory, (ctypes.c_double * len(numbers))(*numbers), ctypes.c_uint32(1)) == 0
    ticks = 0

    def feed(name: str, seq: int, **values) -> None:
        data = frame(name, seq, pack(name, **values))
        core.shim_receive(memory, data, ctypes.c_size_t(len(data)))

    def step(counts: int) -> int:
        nonlocal ticks
        ticks += 1
        feed("HEARTBEAT", 0, boot_id=1, tick=ticks - 1)
        force = core.shim_tick(memory, int(counts), 1, 0, ctypes.c_float(np.nan))
        return struct.unpack("<I", struct.pack("<f", force))[0]

    first = int(samples[0, 1])
    feed("HELLO", 1, version=2, schema=SCHEMA)
    feed("SET_PARAMS", 2, **SET)
    for _ in range(400):
        step(first)
    payload = pack("SET_PARAMS", **SET)
    named = {"set_id": SET["set_id"], "crc": zlib.crc32(payload), "boot_id": 1}
    feed("COMMIT", 3, **named)
    step(first)
    feed("START", 4, **named, stop=0)
    return np.array([step(counts) for counts in samples[:, 1]], np.uint32)


@pytest.mark.deep
def test_a_session_from_hello_to_estop(device):
    hello = device.hello()
    limits = device.ask("GET_LIMITS")[1]
    assert (hello["version"], hello["tick_rate_Hz"], hello["capabilities"]) == (2, 1000, 1 | 8)
    assert limits["delay_us"] == 400
    start = device.status()
    assert (start["state"], start["hold_reason"], start["flags"], start["frames_dropped"]) == (State.STOPPED, 8, 0, 0)
    named = device.stage()
    device.wait_ticks(40)
    assert device.refused("START", **named, **device.order()) == "NOT_HOMED"
    assert device.refused("HOME", **device.order(), position_mm=21.0) == "DRIVE_RANGE"
    device.acknowledged("HOME", **device.order(), position_mm=HANDLE_MM)
    homed = device.status()
    assert homed["flags"] == 1 and homed["position_mm"] == pytest.approx(HANDLE_MM, abs=0.01)
    device.acknowledged("STREAM", divisor=1, fields=0)
    device.acknowledged("START", **named, **device.order())
    assert device.refused("HOME", **device.order(), position_mm=0.0) == "STATE"
    device.command(PRESSES)
    device.wait_ticks(3000)
    assert device.status()["state"] == State.RUNNING and device.cost()[-1] == 1
    device.acknowledged("ESTOP")
    device.wait_state(State.ESTOP)
    device.wait_ticks(3)
    stopped = device.status()
    assert device.cost()[-1] == 0  # the driver is off
    assert (stopped["hold_reason"], stopped["force_N"], stopped["overruns"]) == (CAUSE_ESTOP, 0.0, 0)
    device.wait_ticks(20)

    samples = np.array(device.samples)
    assert np.all(np.diff(samples[:, 0]) == 1)  # no tick is missing
    flags = samples[:, 2]
    running = samples[(flags >> FLAGS.index("running") & 1) == 1]
    force = running[:, 3].astype("<u4").view("<f4")
    assert len(running) > 3000 and force.max() > 0.5 and (force >= 0).all()
    np.testing.assert_array_equal(running[:, 3], forces_of_the_core(hello, limits, running))
    after = samples[(flags >> FLAGS.index("estop") & 1) == 1]
    assert len(after) > 5 and not after[:, 3].any()


@pytest.mark.deep
def test_the_hardware_stop(device):
    device.run()
    device.command(PRESSES)
    device.wait_ticks(500)
    device.command(b"o")
    status = device.status()
    assert (status["state"], status["hold_reason"], status["force_N"]) == (State.ESTOP, CAUSE_SWITCH, 0.0)
    assert status["flags"] & 2
    assert device.refused("CLEAR", **device.order()) == "STOP_OPEN"
    device.command(b"c")
    assert device.cost()[-1] == 0
    device.acknowledged("CLEAR", **device.order())
    device.wait_ticks(3)
    assert device.status()["state"] == State.STOPPED and device.cost()[-1] == 1


@pytest.mark.deep
@pytest.mark.parametrize("late", [b"l", b"m"])
def test_a_late_tick_and_a_bad_position(late, device):
    device.run()
    device.command(b"b")
    status = device.status()
    assert (status["state"], status["input_held"]) == (State.RUNNING, 1)
    assert device.cost()[3] < 400
    device.command(late)
    status = device.status()
    assert (status["state"], status["hold_reason"]) == (State.HOLD, CAUSE_OVERRUN) and status["overruns"] >= 1
    device.cost()
    device.wait_ticks(200)
    assert device.cost()[3] < 400  # one late tick does not make the next ones late


@pytest.mark.deep
def test_without_heartbeats_it_holds(device):
    device.run()
    device.boot_id = 0  # this test does not send them
    assert device.wait_state(State.HOLD)["hold_reason"] == CAUSE_WATCHDOG


@pytest.mark.deep
def test_what_a_tick_costs(device):
    """From reading the position to the force; delays with the PWM's own 50 us."""
    device.run()
    device.command(PRESSES)
    device.cost()
    device.wait_ticks(2000)
    ticks, mean, most, delay_us, _ = device.cost()
    assert ticks >= 2000 and 500 < mean < 3000 and most < 6000
    # The emulator takes 8 ns an instruction: 125 MIPS, which is 1.3 cycles an instruction at 168 MHz.
    assert 50 < delay_us < 300


@pytest.mark.deep
def test_the_host_on_a_terminal():
    """hilbo's own host homes the device, puts a set in force, and renders it under the finger."""
    command = ["qemu-system-arm", "-M", "netduinoplus2", "-display", "none", "-monitor", "none", "-icount", "shift=3"]
    command += ["-serial", "pty", "-serial", "pty", "-kernel", str(image(EMULATED, "m4"))]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as emulator:
        assert emulator.stdout
        line, hand = (re.findall(r"/dev/\S+", emulator.stdout.readline())[0] for _ in range(2))
        try:
            with Renderer.open(line) as device, open(hand, "wb", buffering=0) as keys:
                while device.status().tick < 5:  # until there has been a position
                    pass
                device.home(HANDLE_MM)
                device.send(K0=0.1, K1=0.2, B1=0.3, alpha=0.3)
                device.start()
                keys.write(PRESSES)
                table = device.telemetry(1.5)
                assert device.status().overruns == 0 and device.delay == pytest.approx(400e-6)
        finally:
            emulator.kill()
    assert len(table) >= 1500 and table["force_N"].max() > 0.2
    assert ((table["force_N"] > 0) <= (table["position_mm"] > 0)).all()


def with_numbers(folder: Path, **numbers: str) -> Path:
    """The emulated image of a device with other numbers than the template's."""
    text = (FIRMWARE / "port" / "stm32f405" / "config" / "hilbo_device_config.h").read_text(encoding="utf-8")
    for name, value in numbers.items():
        text, count = re.subn(rf"\.{name} = [^,]+,", f".{name} = {value},", text)
        assert count == 1, name
    (folder / "hilbo_device_config.h").write_text(text, encoding="utf-8")
    return make(folder, f"STM32F405_CONFIG={folder}")


def make(folder: Path, *assignments: str) -> Path:
    """The emulated image, built in a folder of its own."""
    image(EMULATED, "m4")  # skips without the tools
    target = folder / "m4" / f"{EMULATED}.elf"
    command = ["make", "-C", FIRMWARE, f"BUILD={folder}", *assignments, target]
    run = subprocess.run(list(map(str, command)), capture_output=True, text=True)
    assert run.returncode == 0, run.stdout + run.stderr
    return target


def sentence(folder: Path, kernel: Path) -> str:
    """What an image that refuses to start says on its line."""
    with Emulated(folder, kernel) as device:
        text, end = b"", time.monotonic() + PATIENCE
        while text.count(b"\n") < 2 and time.monotonic() < end:
            device.line.socket.sendall(b"\0")  # the emulated board waits for a byte before it starts
            text += device.line.read(0.5)
    first, second = text.decode().split("\r\n")[:2]
    assert first == second
    return first


@pytest.mark.deep
def test_a_build_that_fuses_products_and_sums_says_so(tmp_path):
    kernel = make(tmp_path, "STANDARD=-std=gnu11 -O2 -fno-strict-aliasing")
    listing = subprocess.run(["arm-none-eabi-objdump", "-d", kernel], capture_output=True, text=True, check=True).stdout
    assert listing.count("vfma") > 10
    assert "-ffp-contract=off" in sentence(tmp_path, kernel)
    ordinary = subprocess.run(["arm-none-eabi-objdump", "-d", image(EMULATED, "m4")], capture_output=True, text=True)
    assert "vfma" not in ordinary.stdout


@pytest.mark.deep
@pytest.mark.parametrize(("number", "value"), [("force_limit_N", "500.0F"), ("full_scale_N", "1.0F")])
def test_a_wrong_number_is_told_on_the_line(number, value, tmp_path):
    assert number.split("_")[0] in sentence(tmp_path, with_numbers(tmp_path, **{number: value}))


@pytest.mark.deep
def test_a_device_with_other_numbers(tmp_path):
    """Both signs turned: the position rises into the material all the same."""
    kernel = with_numbers(tmp_path, encoder_sign="-1", motor_sign="-1", delay_us="1000", force_limit_N="4.0F")
    with Emulated(tmp_path, kernel) as device:
        assert device.hello()["force_limit_N"] == 4.0 and device.ask("GET_LIMITS")[1]["delay_us"] == 1000
        device.wait_ticks(5)
        device.acknowledged("HOME", **device.order(), position_mm=HANDLE_MM)
        device.command(PRESSES)
        device.wait(lambda: abs(device.status()["position_mm"] - HANDLE_MM) > 1.5, "finger that presses")
        assert device.status()["position_mm"] > 0


@pytest.mark.deep
def test_the_image_of_the_chip(tmp_path):
    """What is flashed: it fits, its first words are the stack and the reset, and nothing of the emulator is in it."""
    kernel = image(REAL, "m4")
    run = subprocess.run(["arm-none-eabi-size", kernel], capture_output=True, text=True, check=True)
    code, data, variables = map(int, run.stdout.splitlines()[1].split()[:3])
    assert code + data < 32_000 and data + variables < 20_000
    names = subprocess.run(["arm-none-eabi-nm", kernel], capture_output=True, text=True, check=True).stdout
    assert " main" in names and " sim_" not in names and "malloc" not in names
    binary = tmp_path / "image.bin"
    subprocess.run(["arm-none-eabi-objcopy", "-O", "binary", kernel, binary], check=True)
    vectors = struct.unpack_from("<98I", binary.read_bytes())
    address = {name: int(at, 16) | 1 for at, _, name in (line.split() for line in names.splitlines())}
    assert vectors[0] == 0x20000000 + 8192 and vectors[1] == address["reset"]
    assert vectors[15] == address["systick_interrupt"] and vectors[16 + 37] == address["usart1_interrupt"]
    others = {*vectors[2:15], *vectors[16 : 16 + 37], *vectors[16 + 38 :]}
    assert others == {address["board_fault"]}
