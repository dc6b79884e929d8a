"""Cortex-M images in the emulator: the same bits as on the host, the protocol over a UART, and what a tick costs."""

import re
import select
import socket
import struct
import subprocess
import time

import jax.numpy as jnp
import numpy as np
import pytest
from device_input import MACHINES, Recording, emulate, replay, rich_motion
from device_port import FOAM, PATIENCE, SCHEMA, State, Talk, image
from device_wire import Type, encode, set_params

from benchmarks.firmware import MEMORIES, measure, sizes, stack_of, state_bytes
from benchmarks.pages import DOCS
from hilbo import passivity, viscoelastic
from hilbo.mechanics.exponentials import exponentials

each_cpu = pytest.mark.parametrize("cpu", MACHINES)


def many_sets() -> bytes:
    """60 s of pressing: 24 sets of both memories, switched in contact."""
    rng = np.random.default_rng(1)
    motion = rich_motion(60_000, 2)
    recording = Recording()
    recording.hello()
    named = b""
    for index, counts in enumerate(np.split(motion, 24)):
        B1, alpha, full = float(np.exp(rng.uniform(-3, 3))), float(rng.uniform(0.02, 0.98)), index % 3 == 2
        memory, N = "full" if full else "short", int(rng.choice([1, 25, 101, 255]))
        K1 = min(float(passivity.largest_K1(B1, alpha, b=0.949, N=N, memory=memory)), 32.0) * rng.uniform(0.2, 1)
        K0 = float(viscoelastic.K0_from_effective_stiffness(K1, B1, alpha, N=N, memory=memory))
        states = [np.asarray(part) for part in exponentials(jnp.asarray(alpha), 8 + 2 * (index % 2))] if full else None
        named = recording.set(index + 1, K0, K1, B1, alpha, states=states, N=N)
        if index == 0:
            recording.send(Type.COMMIT, named)
            recording.ticks([0] * 10)
            recording.send(Type.START, named + bytes(4))
        recording.ticks(counts[:1800])
        recording.send(Type.COMMIT, named)
        recording.ticks(counts[1800:])
    recording.send(Type.GET_STATUS)
    recording.ticks([0])
    return recording.done()


def test_both_compilers_give_the_same_bits(tmp_path):
    recording = many_sets()
    said, forces = replay(recording, tmp_path, "gcc")
    again, bits = replay(recording, tmp_path, "clang")
    assert said == again
    np.testing.assert_array_equal(bits, forces)
    force = forces.view("<f4")
    assert np.isfinite(force).all() and force.max() > 3 and np.unique(forces).size > 10_000


@pytest.mark.deep
@each_cpu
def test_a_cortex_m_gives_the_same_bits(cpu, tmp_path):
    recording = many_sets()
    said, forces = replay(recording, tmp_path)
    again, bits, _, _ = emulate(recording, tmp_path, cpu)
    assert said == again
    np.testing.assert_array_equal(bits, forces)


class Emulator(Talk):
    """The device image with its UART on a socket."""

    def __init__(self, cpu: str, path):
        self.listener = socket.socket(socket.AF_UNIX)
        self.listener.bind(str(path))
        self.listener.listen()
        command = ["qemu-system-arm", "-M", MACHINES[cpu], "-display", "none", "-monitor", "none", "-icount", "shift=3"]
        command += ["-chardev", f"socket,id=line,path={path}", "-serial", "chardev:line"]
        self.process = subprocess.Popen([*command, "-kernel", image("device", cpu)])
        assert select.select([self.listener], [], [], PATIENCE)[0], "the emulator does not start"
        self.line, _ = self.listener.accept()
        super().__init__(self.line.fileno())

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.wait()
        self.line.close()
        self.listener.close()

    def wait_for_tick(self, tick: int):
        end = time.monotonic() + PATIENCE
        while (status := self.status()).tick < tick:
            assert time.monotonic() < end, f"the device stands at tick {status.tick}"
        return status


@pytest.mark.deep
@each_cpu
def test_a_conversation_over_the_uart(cpu, tmp_path):
    with Emulator(cpu, tmp_path / "line") as device:
        device.send(b"\0")
        version, rate, schema, _, boot_id = struct.unpack_from("<HHIII", device.hello().payload)
        assert (version, rate, schema) == (2, 1000, SCHEMA) and boot_id != 0
        start = device.status()
        assert (start.boot_id, start.state, start.frames_dropped) == (boot_id, State.STOPPED, 0)
        device.send(b"no frame, and longer than any frame may be: " + 64 * b"?" + b"\0")
        crc = device.expect_ack(Type.SET_PARAMS, set_params(9, *FOAM))
        device.expect_ack(Type.COMMIT, device.named(9, crc))
        device.wait_for_tick(start.tick + 5)
        # In one piece, so that the heartbeat is fresh whatever this machine does in between.
        device.seq = 201
        beat = encode(Type.HEARTBEAT, struct.pack("<II", boot_id, device.heard))
        device.send(beat + encode(Type.START, device.start(9, crc), 201))
        status = device.wait_for_tick(device.status().tick + 400)
        assert (status.active_id, status.active_crc, status.frames_dropped) == (9, crc, 1)
        assert (status.state, status.hold_reason, status.overruns) == (State.HOLD, 1, 0)  # nobody sent heartbeats
        assert status.force_N == 0
        starts = [a for a in device.unasked if a.seq == 201]
        assert [a.type for a in starts] == [Type.ACK]
        tick = struct.unpack_from("<IIBB", next(a for a in device.unasked if notice(a) == (State.HOLD, 1)).payload)[0]
        began = struct.unpack_from("<I", next(a for a in device.unasked if notice(a)[0] == State.RUNNING).payload)[0]
        assert tick - began <= 251


def notice(answer) -> tuple[int, int]:
    """State and reason, of a NOTICE."""
    return struct.unpack_from("<BB", answer.payload, 8) if answer.type == Type.NOTICE else (-1, -1)


@pytest.mark.deep
@each_cpu
def test_what_a_tick_costs(cpu, tmp_path):
    measured = measure(cpu, tmp_path)
    cost = measured.sections
    plain = cost["short memory, N = 101"]
    assert 1000 < plain.mean < 2500
    for name, N, states in MEMORIES:
        # The cost depends neither on the force nor on the time since contact.
        assert cost[name].ticks == 3050 and cost[name].most - cost[name].least <= 0.2 * cost[name].most + 400
        assert measured.rounding[name] < 1e-5
        assert measured.memory[name] < (1e-4 if states else 0.2)
        assert (cost[name].mean < plain.mean) == (N < 101)
    # What a scene does not need is skipped: no contact costs as little as no set.
    idle = cost["no contact, forgotten"]
    calls = {"ticks": idle.ticks, "frames": idle.frames, "most_of_a_frame": idle.most_of_a_frame}
    assert idle == cost["running, no contact"]._replace(**calls)
    assert idle.mean < 0.6 * plain.mean and idle.mean < cost["stopped, no set"].mean + 150
    staged = cost["contact, another set of N = 101 staged"].mean
    assert plain.mean < staged < 2 * plain.mean
    assert cost["contact, the tick of the swap"].most < 1.05 * staged
    assert max(section.most_of_a_frame for section in cost.values()) < 20_000
    assert measured.stack < 2048


@pytest.mark.deep
def test_the_table_of_costs_is_that_of_this_core(tmp_path):
    text = (DOCS / "device" / "firmware.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| (?:contact, )?(.*?) \| ([\d,]+) \|", text, re.M))
    for name, cost in measure("m4", tmp_path).sections.items():
        written = int(rows[name.removeprefix("contact, ")].replace(",", ""))
        counted = cost.mean if cost.ticks else cost.most_of_a_frame
        assert abs(written - counted) < 0.05 * counted, f"{name}: make the table anew, benchmarks/firmware.py --write"


@pytest.mark.deep
@each_cpu
def test_what_the_core_needs_of_memory(cpu, tmp_path):
    image("replay", cpu)
    code, variables = sizes(cpu)
    assert code < 20_000 and variables == 0  # no variable outside the caller's state
    assert state_bytes(cpu, tmp_path) < 10_000
    stack = stack_of(cpu, tmp_path)
    assert 0 < stack["hb_transmit"] < stack["hb_tick"] < 512 and stack["hb_receive"] < 1024
