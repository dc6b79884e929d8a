"""The host port: the C core with a simulated finger behind a pseudo-terminal, in raw bytes and in device ticks."""

import os
import shutil
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from device_port import COMPILERS, FIRMWARE, FOAM, PATIENCE, SCHEMA, Port, State, Status, program
from device_wire import Type, encode, set_crc, set_params, set_states

from hilbo import passivity, viscoelastic
from hilbo.mechanics.exponentials import exponentials
from hilbo.viscoelastic import FOSLS

WATCHDOG, HOLD_RAMP = 250, 20  # ticks
CAUSE_WATCHDOG, CAUSE_INPUT, CAUSE_OVERRUN = 1, 2, 4
NACK_NO_HELLO, NACK_BOOT_ID = 3, 8


@pytest.mark.parametrize("compiler", COMPILERS)
def test_a_conversation(compiler):
    with Port("--boot-id", "77", "--finger", "hold", compiler=compiler) as port:
        version, rate, schema, _, boot_id, line, damping = struct.unpack_from("<HHIIIIf", port.hello().payload)
        assert (version, rate, schema, boot_id, line) == (2, 1000, SCHEMA, 77, 921600)
        assert damping == np.float32(0.95)
        port.run()
        force = port.live(1500)
        status = port.status()
        assert status.state == State.RUNNING and status.contact == 1
        assert status.force_N == np.float32(force) > 0.5
        assert (status.holds, status.input_held, status.overruns, status.frames_dropped) == (0, 0, 0, 0)
        port.expect_ack(Type.STOP)
        assert port.tick(HOLD_RAMP) == 0
        assert port.status().state == State.STOPPED


def test_the_same_options_give_the_same_forces():
    def forces(*options):
        with Port("--boot-id", "1", *options) as port:
            port.run()
            return [port.live(50) for _ in range(40)]

    first = forces("--seed", "4")
    assert forces("--seed", "4") == first and max(first) > 0.5
    assert forces("--seed", "5") != first


def wait_for_tick(port: Port, tick: int) -> Status:
    end = time.monotonic() + PATIENCE
    while (status := port.status()).tick < tick:
        assert time.monotonic() < end
    return status


def test_ticks_go_by_themselves_in_real_time():
    with Port(rate="realtime") as port:
        wait_for_tick(port, port.status().tick + 100)
        assert port.command("tick 1")[0] == "unknown"


def test_garbage_is_counted_and_changes_no_force():
    def forces(garbage):
        with Port("--boot-id", "1", "--finger", "hold") as port:
            port.run()
            forces_N = []
            for _ in range(40):
                forces_N.append(port.live(50))
                port.send(garbage.pop() + b"\0" if garbage else b"")
            return forces_N, port.status().frames_dropped

    rng = np.random.default_rng(0)
    garbage = [rng.bytes(int(size)) for size in rng.integers(1, 300, 40)]
    pieces = sum(piece != b"" for piece in b"\0".join(garbage).split(b"\0"))
    clean, none = forces([])
    dirty, counted = forces(list(garbage))
    assert dirty == clean and max(clean) > 0.5
    assert (none, counted) == (0, pieces)


@pytest.mark.parametrize("moment", [0, 1, 49, 250, 700])
def test_silence_ends_in_zero_force_within_the_watchdog(moment):
    with Port("--finger", "hold") as port:
        port.run()
        port.live(moment)
        port.heartbeat()
        assert port.live(600) > 0.5
        port.heartbeat()
        assert port.tick(WATCHDOG - 1) > 0.5
        assert port.status().state == State.RUNNING
        port.tick(1)
        status = port.status()
        assert (status.state, status.hold_reason) == (State.HOLD, CAUSE_WATCHDOG)
        assert port.tick(HOLD_RAMP) == 0
        port.heartbeat()
        assert port.tick(200) == 0  # latched


def killed(moment: int) -> None:
    with Port("--finger", "hold", "--seed", str(moment)) as port:
        script = Path(__file__).parents[1] / "support" / "killed_host.py"
        pipe = subprocess.PIPE
        host = subprocess.Popen([sys.executable, script, port.slave], stdin=pipe, stdout=pipe, text=True)
        assert host.stdin and host.stdout
        for _ in range(moment):
            question, *number = host.stdout.readline().split()
            assert question in ("bytes", "ticks"), "the host has said all before it was killed"
            if number:
                port.tick(int(number[0]))
            host.stdin.write("\n")
            host.stdin.flush()
        host.stdout.readline()
        host.kill()
        host.communicate()
        assert port.tick(WATCHDOG + HOLD_RAMP) == 0, f"after {moment} steps"
        port.reopen()
        port.hello()
        status = port.status()
        assert status.state in (State.STOPPED, State.HOLD)
        if status.state == State.HOLD:
            port.expect_ack(Type.CLEAR, port.clear())
        port.run(7)
        assert port.live(1500) > 0.5
        assert port.status().active_id == 7


MOMENTS = np.random.default_rng(0).permutation(np.arange(1, 150))  # the conversation has about 155 steps


@pytest.mark.parametrize("moment", [3, 60, 110])
def test_a_killed_host_leaves_no_force(moment):
    killed(moment)


@pytest.mark.deep
@pytest.mark.parametrize("moment", MOMENTS[:100])
def test_a_hundred_killed_hosts_leave_no_force(moment):
    killed(int(moment))


def test_a_host_may_go_and_another_come_while_telemetry_flows():
    with Port("--finger", "hold") as port:
        port.run()
        port.expect_ack(Type.STREAM, bytes([1, 0]))
        port.tick(2000)  # nobody reads
        port.reopen()
        port.hello()
        port.unasked.clear()  # what still waited in the device came before its answer
        port.tick(100)
        port.status()
        assert port.unasked == []
        port.expect_ack(Type.STREAM, bytes([1, 0]))
        port.tick(70)
        heads = [struct.unpack_from("<IBBH", a.payload) for a in wait_for(port, Type.TELEMETRY, 10)]
        assert [tick for tick, *_ in heads] == [heads[0][0] + 7 * i for i in range(10)]
        assert len({lost for *_, lost in heads}) == 1


def test_what_the_line_does_not_take_is_lost_in_whole_frames_and_counted():
    with Port("--finger", "hold") as port:
        port.hello()
        port.expect_ack(Type.STREAM, bytes([1, 1]))
        port.tick(5000)  # nobody reads, and a terminal holds some thousand bytes
        port.status()
        port.tick(100)
        port.status()
        heads = [struct.unpack_from("<IBBH", a.payload) for a in port.unasked if a.type == Type.TELEMETRY]
        ticks, lost = np.array([head[0] for head in heads]), np.array([head[3] for head in heads])
        assert lost[-1] > 1000 and ticks[-1] > 5000
        np.testing.assert_array_equal(np.diff(ticks), 4 + np.diff(lost))


def wait_for(port: Port, type: int, count: int):
    end = time.monotonic() + PATIENCE
    while sum(a.type == type for a in port.unasked) < count:
        assert time.monotonic() < end
        port.unasked += port.listen()
    return [a for a in port.unasked if a.type == type]


@pytest.mark.parametrize("obeyed", range(5))
def test_a_restarted_device_knows_nothing_and_obeys_no_old_name(obeyed):
    payload = set_params(3, *FOAM)
    named = struct.pack("<HHII", 3, 0, set_crc(payload), 0x55)
    steps = [(Type.HELLO, struct.pack("<HHI", 2, 0, SCHEMA)), (Type.SET_PARAMS, payload)]
    steps += [(Type.COMMIT, named), (Type.START, named + bytes(4))]
    with Port("--boot-id", "0x55", "--finger", "hold") as port:
        port.boot_id = 0x55
        port.live(2)  # the finger comes, and presses when there is force to be felt
        force = 0.0
        for type, body in steps[:obeyed]:
            assert port.request(type, body).type in (Type.ACK, Type.HELLO_REPLY)
            force = port.live(2)
        force = port.live(1000)
        assert (force > 0.5) == (obeyed == 4) and (force == 0) == (obeyed < 4)
        _, new_id = port.command("restart")
        assert port.status().boot_id == int(new_id) != 0x55
        for type, body in (*steps[max(obeyed, 1) :], steps[-1]):
            assert port.request(type, body).payload[1] == NACK_NO_HELLO
            assert port.live(300) == 0
        port.hello()
        for type, body in steps[2:]:
            assert port.request(type, body).payload[1] == NACK_BOOT_ID
            assert port.live(300) == 0
        status = port.status()
        assert (status.state, status.active_id, status.staged_id) == (State.STOPPED, 0, 0)


def test_faults_are_those_of_the_protocol():
    with Port("--finger", "hold") as port:
        port.run()
        assert port.live(800) > 0.5
        port.command("bad 2")
        assert port.live(50) > 0.5
        assert port.status().input_held == 2
        port.command("bad 3")
        port.live(50)
        status = port.status()
        assert (status.state, status.hold_reason, status.input_held) == (State.HOLD, CAUSE_INPUT, 5)
    with Port("--finger", "hold") as port:
        port.run()
        port.command("late 1")
        port.live(50)
        status = port.status()
        assert (status.state, status.hold_reason, status.overruns) == (State.HOLD, CAUSE_OVERRUN, 1)


@pytest.mark.parametrize("strict", [False, True])
def test_a_busy_laptop_is_no_fault_of_the_device_unless_asked(strict):
    with Port(*["--strict"] * strict, rate="realtime") as port:
        before = port.status()
        port.process.send_signal(signal.SIGSTOP)
        time.sleep(0.05)
        port.process.send_signal(signal.SIGCONT)
        status = wait_for_tick(port, before.tick + 5)
        assert (status.overruns > before.overruns) == strict


def ends(process) -> int:
    return process.wait(PATIENCE)


def test_it_ends_cleanly(tmp_path):
    link = tmp_path / "device"
    with Port("--link", str(link), rate="realtime") as port:
        assert os.readlink(link) == port.slave
        port.process.terminate()
        assert ends(port.process) == 0 and not link.is_symlink()
    with Port(rate="realtime") as port:
        port.process.stdin.close()  # what the death of its parent does
        assert ends(port.process) == 0
        port.process.stdin = None
    kept = tmp_path / "file"
    kept.write_text("mine")
    run = subprocess.run([program("hilbo-device"), "--link", kept], capture_output=True, text=True)
    assert run.returncode == 1 and kept.read_text() == "mine" and run.stderr.count("\n") == 1


def drive(port: Port, mode: int, shape: int, offset: float, amplitude: float, period: int, duration: int):
    """Ticks, positions (mm) and sensed forces (N) of a DRIVE, from telemetry of every tick."""
    port.hello()
    port.tick(1)
    port.expect_ack(Type.STREAM, bytes([1, 1]))
    port.heartbeat()
    body = struct.pack("<BBHffIIII", mode, shape, 0, offset, amplitude, period, duration, port.boot_id, port.stops)
    port.expect_ack(Type.DRIVE, body)
    for _ in range(duration // 25 + 2):
        port.heartbeat()
        port.tick(25)
    port.expect_ack(Type.STREAM, bytes([0, 0]))
    rows = []
    for answer in (a for a in port.unasked if a.type == Type.TELEMETRY):
        tick, _, _, lost = struct.unpack_from("<IBBH", answer.payload)
        assert lost == 0
        rows += [(tick + i, *s) for i, s in enumerate(struct.iter_unpack("<hHff", answer.payload[8:]))]
    return np.array(rows).T


def test_a_relaxation_test_measures_the_material():
    with Port("--finger", "none", "--start", "0", "--material", "-2.89,5.7,5.89,0.203,101") as port:
        tick, counts, _, _, sensed = drive(port, 1, 0, 5.0, 0.0, 0, 1500)
        assert port.status().holds == 0
    np.testing.assert_array_equal(np.diff(tick), 1)
    x = 0.0127 * counts
    expected = np.asarray(FOSLS(*FOAM).simulate(np.maximum(x, 0)))
    # The encoder's half step times twice the stiffness at once, through which every past rounding comes in.
    np.testing.assert_allclose(-sensed, np.maximum(expected, 0), rtol=0, atol=0.05)
    assert abs(x[1000:1400] - 5).max() < 0.05 and sensed.min() < -3


def test_a_creep_test_measures_the_material():
    with Port("--finger", "none", "--start", "0", "--material", "-2.89,5.7,5.89,0.203,101") as port:
        _, counts, _, force, sensed = drive(port, 0, 2, 3.0, 0.5, 1000, 2000)
    x = 0.0127 * counts
    np.testing.assert_allclose(-sensed[900:1000], 3.0, atol=0.06)  # friction keeps up to 0.02 N
    np.testing.assert_allclose(force[900:1000], -3.0)
    np.testing.assert_allclose(x[980], 3.0 / 0.44325, rtol=0.02)
    assert 0.2 < x[1980] < 2


def passive_sets(count: int):
    """Memory and parameters of sets that a search proposes, every other one on its passive boundary."""
    rng = np.random.default_rng(0)
    B1, alpha = np.exp(rng.uniform(np.log(0.001), np.log(32), count)), rng.uniform(0.01, 0.99, count)
    share = np.where(np.arange(count) % 2, rng.random(count), 1.0)
    for memory in ("short", "full"):
        most = np.asarray(passivity.largest_K1(B1, alpha, b=0.95 * (1 - 1e-3), memory=memory))
        K1 = np.maximum(share * np.minimum(most, 32), 0.01)
        K0 = np.asarray(viscoelastic.K0_from_effective_stiffness(K1, B1, alpha, memory=memory))
        keep = np.arange(count) % 2 == (memory == "full")
        yield from ((memory, values) for values in np.stack([K0, K1, B1, alpha], 1)[keep].tolist())


def conversation(memory: str, parameters: list[float]) -> list[bytes]:
    """The frames of HELLO, one set, COMMIT and START, for boot id 1."""
    payloads = [set_params(1, *parameters)]
    if memory == "full":
        weight, loss = (np.asarray(part).tolist() for part in exponentials(jnp.asarray(parameters[3]), 10))
        payloads = [set_params(1, *parameters, memory=1, length=10), *set_states(1, weight, loss)]
    named = struct.pack("<HHII", 1, 0, set_crc(*payloads), 1)
    messages = [(Type.HELLO, struct.pack("<HHI", 2, 0, SCHEMA)), (Type.SET_PARAMS, payloads[0])]
    messages += [(Type.SET_STATES, payload) for payload in payloads[1:]]
    messages += [(Type.COMMIT, named), (Type.ECHO, b""), (Type.START, named + bytes(4))]
    return [encode(type, payload, seq) for seq, (type, payload) in enumerate(messages)]


SAFEGUARDS = ("input_held", "saturated", "slewed", "controlled", "holds", "estops", "overruns")
COUNTED = ("state", "nacks", *SAFEGUARDS, "force", "depth", "speed", "contact")  # what hilbo-press prints


def press(sets, ticks: int) -> dict[str, np.ndarray]:
    """What the device counted while the simulated finger pressed each set."""
    lines = [f"{seed} {ticks} {' '.join(f.hex() for f in conversation(*one))}" for seed, one in enumerate(sets)]
    run = subprocess.run([program("hilbo-press")], input="\n".join(lines), capture_output=True, text=True, check=True)
    table = np.array([line.split() for line in run.stdout.splitlines()], float)
    assert table.shape == (len(lines), len(COUNTED))
    return dict(zip(COUNTED, table.T, strict=True))


def none_acts(sets, ticks: int) -> None:
    counted = press(sets, ticks)
    assert (counted["state"] == State.RUNNING).all()
    for name in ("nacks", *SAFEGUARDS):
        assert not counted[name].any(), f"{name}: {counted[name].max()} at {np.argmax(counted[name])}"
    assert (counted["contact"] > ticks / 10).all() and (counted["depth"] > 1).all() and (counted["force"] > 0.3).all()


def test_no_safeguard_acts_on_passive_sets_under_a_finger():
    none_acts(list(passive_sets(20)), 6000)


@pytest.mark.deep
def test_no_safeguard_acts_on_a_thousand_passive_sets():
    none_acts(list(passive_sets(1000)), 10000)


def test_a_press_that_a_safeguard_stops_is_seen():
    sets = [("short", [0.44, 5.0, 5.0, 0.5])]  # not passive
    assert press(sets, 2000)["nacks"] >= 1
    none_of_it = press([("short", list(FOAM))], 30)
    assert none_of_it["state"] == State.RUNNING and not none_of_it["contact"]


@pytest.mark.deep
def test_everything_builds_without_a_word_and_is_clean(tmp_path):
    make = ["make", "--no-print-directory", "-C", FIRMWARE, f"BUILD={tmp_path}"]
    if not shutil.which("make"):
        pytest.skip("the device's programs need make (Debian: make)")
    said = subprocess.run([*make, "-j2"], capture_output=True, text=True)
    assert said.returncode == 0 and said.stderr == ""
    for folder in (*filter(shutil.which, COMPILERS), *(["m4", "m7"] if shutil.which("arm-none-eabi-gcc") else [])):
        names = (
            ["device.elf", "replay.elf"] if folder.startswith("m") else ["hilbo-device", "hilbo-replay", "hilbo-press"]
        )
        assert all((tmp_path / folder / name).exists() for name in names)
    if not shutil.which("cppcheck"):
        pytest.skip("the static analysis needs cppcheck (Debian: cppcheck)")
    check = subprocess.run([*make, "check"], capture_output=True, text=True)
    assert check.returncode == 0, check.stderr
