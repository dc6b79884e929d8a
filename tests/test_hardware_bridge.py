"""The bridge against a scripted device that misbehaves in every way of the protocol's rules."""

import contextlib
import os
import socket
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from peer import Peer

from hilbo import hardware_bridge
from hilbo.device import messages, reasons
from hilbo.device.link import Link
from hilbo.device.messages import Sample
from hilbo.device.ports import SocketPort
from hilbo.device.reasons import NackReason
from hilbo.device.telemetry import TelemetryBuffer
from hilbo.errors import InputError
from hilbo.hardware_bridge import DeviceError, RefusalError, Renderer

A = {"K0": -3.18, "K1": 5.58, "B1": 7.88, "alpha": 0.176}
PATIENT = {"patience": 60.0}  # where a test is not about time


def send_and_start(device):
    device.send(**A)
    device.start()


def test_a_set_is_staged_committed_and_read_back():
    peer = Peer()
    with peer.open(**PATIENT) as device:
        confirmed = device.send(**A)
        assert (confirmed.set_id, confirmed.memory, confirmed.length) == (1, "short", 101)
        assert float(np.float32(5.58)) == confirmed.K1
        device.start()
        assert device.state() == reasons.State.RUNNING
    assert peer.state == reasons.State.STOPPED
    assert peer.done[messages.Stop] == 1


def test_a_set_that_is_in_force_is_not_sent_again():
    peer = Peer()
    with peer.open(**PATIENT) as device:
        first = device.send(**A)
        assert device.send(**A) == first
        assert peer.done[messages.SetParams] == 1
        assert device.send(**(A | {"K1": 5.5})).set_id == 2
        assert peer.done[messages.SetParams] == 2


def test_full_memory_sends_its_exponentials():
    peer = Peer()
    with peer.open(**PATIENT) as device:
        confirmed = device.send(K0=0.4, K1=1.2, B1=3.0, alpha=0.35, memory="full", states=10)
        assert (confirmed.memory, confirmed.length) == ("full", 10)
        assert peer.done[messages.SetStates] == 2
        for wrong in ({"states": 9}, {"alpha": 1.0}, {"memory": "long"}):
            with pytest.raises(InputError):
                device.send(**({"K0": 0.4, "K1": 1.2, "B1": 3.0, "alpha": 0.35, "memory": "full"} | wrong))


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"T": 2e-3}, "a set belongs to its T"),
        ({"K1": float("nan")}, "K1 is nan"),
        ({"K1": 1e300}, "K1 is 1e"),
        ({"N": 70_000}, "N (or states) is 70000"),
        ({"force_limit": float("inf")}, "force_limit is inf"),
    ],
)
def test_numbers_that_fit_no_wire_are_not_sent(wrong, words):
    peer = Peer()
    with peer.open(**PATIENT) as device:
        with pytest.raises(InputError) as error:
            device.send(**(A | wrong))
        assert words in str(error.value)
        assert peer.done[messages.SetParams] == 0


def test_a_refusal_is_one_sentence_with_its_numbers():
    peer = Peer()
    with peer.open(**PATIENT) as device:
        peer.refuse[messages.SetParams] = {"reason": NackReason.NOT_PASSIVE, "value": 1.25, "limit": 0.95}
        with pytest.raises(RefusalError, match=r"needs 1.25 N.s/m of damping and the device has 0.95") as error:
            device.send(**A)
        assert error.value.nack.reason == NackReason.NOT_PASSIVE
        peer.refuse[messages.Start] = {"reason": NackReason.STATE, "value": 4.0}
        del peer.refuse[messages.SetParams]
        device.send(**A)
        with pytest.raises(DeviceError, match="START is refused while the device is HOLD; find out why"):
            device.start()


def test_commit_waits_until_the_history_is_warm():
    peer = Peer()
    with peer.open(**PATIENT) as device:
        peer.refuse[messages.Commit] = {"reason": NackReason.NOT_READY, "ticks": 5, "times": 4}
        assert device.send(**A).set_id == 1
        assert peer.refuse == {}
        peer.refuse[messages.Commit] = {"reason": NackReason.NOT_READY, "ticks": 5}
        with pytest.raises(DeviceError, match="needs 5 more ticks"):
            device.send(**(A | {"K1": 5.0}), wait=0.1)


@pytest.mark.parametrize("lie", [{"K1_N_per_mm": 5.5799}, {"crc": 1}, {"length": 99}, {"flags": 0}, {"alpha": -0.0}])
def test_a_device_with_another_set_in_force_is_found_out(lie):
    peer = Peer()
    with peer.open(**PATIENT) as device:
        peer.lie = lie
        with pytest.raises(DeviceError, match="is not the one that was sent"):
            device.send(**A)


def test_a_lost_answer_costs_a_retry_and_nothing_is_done_twice():
    peer = Peer()
    with peer.open(patience=0.2, tries=100) as device:
        peer.swallow = 2
        device.send(**A)
        assert peer.done[messages.SetParams] == 1
        assert device.link.retries >= 2


def test_three_silences_are_one_sentence():
    peer = Peer()
    device = peer.open(**PATIENT)
    device.link.patience, peer.swallow = 0.05, 10**6
    with pytest.raises(DeviceError, match="GET_STATUS has had no answer in 3 tries; check the line"):
        device.status()
    with pytest.raises(DeviceError, match="STOP has had no answer in 3 tries"):
        device.close()


def test_late_and_double_answers_are_dropped_and_counted():
    peer = Peer()
    with peer.open(patience=0.2, tries=100) as device:
        peer.double = True
        for n in range(5):
            assert device.echo(bytes([n])) == bytes([n])
        peer.double, before = False, device.link.stray
        assert before >= 4
        peer.late = True  # the first answer comes after the second try went out
        assert device.echo(b"late") == b"late"
        assert device.echo(b"now") == b"now"
        assert device.link.stray > before


def test_garbage_is_survived():
    peer = Peer()
    with peer.open(**PATIENT) as device:
        rng = np.random.default_rng(0)
        for _ in range(20):
            peer.socket.sendall(rng.bytes(200))
        peer.socket.sendall(b"\0")
        peer.say(messages.Stop(), seq=device.link._seq)  # a host's message is nothing a device says
        assert device.echo(b"x" * 64) == b"x" * 64
        assert device.link.dropped > 0


def test_heartbeats_go_out_while_a_request_waits():
    peer = Peer()
    with peer.open(**PATIENT) as device:
        peer.beats = 8  # the answer comes after as many heartbeats
        assert device.echo(b"slow") == b"slow"
        assert device.link.retries == 0


def test_no_heartbeat_before_the_boot_id_is_known():
    peer = Peer()
    peer.hello["version"] = 7
    with pytest.raises(DeviceError, match="speaks version 7"):
        peer.open(**PATIENT)
    assert peer.heartbeats == 0


@pytest.mark.parametrize(
    ("reason", "words"),
    [(NackReason.VERSION, "speaks version 3 of the protocol"), (NackReason.SCHEMA, "means other bytes")],
)
def test_another_version_is_refused_by_the_device(reason, words):
    peer = Peer()
    peer.refuse[messages.Hello] = {"reason": reason, "limit": 3.0}
    with pytest.raises(DeviceError, match=words):
        peer.open(**PATIENT)


def test_another_schema_is_refused_by_the_host():
    with pytest.raises(DeviceError, match="schema 00000001"):
        Peer(schema=1).open(**PATIENT)


def test_a_study_that_counts_on_more_damping_is_refused():
    exact = float(np.float32(0.95))  # as the device reports it: a little below 0.95
    assert exact < 0.95
    with Peer().open(damping=0.95, **PATIENT) as device:
        assert device.device.damping_N_s_per_m == exact
    with pytest.raises(InputError, match=r"assumes 0.9501 N.s/m of damping and the device has 0.95"):
        Peer().open(damping=0.9501, **PATIENT)


@pytest.mark.parametrize("kind", [messages.SetParams, messages.Commit, messages.GetSet, messages.Start])
def test_a_device_that_restarts_is_not_started_again(kind):
    peer = Peer()
    with peer.open(**PATIENT) as device:
        peer.restart_at = kind
        with pytest.raises(DeviceError, match="the device has restarted; it is stopped and knows no set"):
            send_and_start(device)
        assert peer.state == reasons.State.STOPPED
        with pytest.raises(DeviceError, match="restarted"):
            device.start()
        assert device.reconnect() is False
        assert peer.state == reasons.State.STOPPED and peer.active is None
        device.send(**A)
        device.start()
        assert peer.state == reasons.State.RUNNING


def test_a_notice_tells_of_a_restart_too():
    peer = Peer()
    with peer.open(**PATIENT) as device:
        peer.say(messages.Notice(tick=1, boot_id=555, state=0, reason=8, stops=0))
        device.status()
        assert device.events() == ["tick 1: STOPPED, it has just started"]
        with pytest.raises(DeviceError, match="restarted"):
            device.send(**A)
        device.reconnect()


def test_a_line_that_breaks_is_one_sentence_and_can_be_mended():
    peer = Peer()
    device = peer.open(**PATIENT)
    device.send(**A)
    peer.hang_up()
    with pytest.raises(DeviceError, match="the line to the device is gone"):
        device.samples(5.0)
    with pytest.raises(DeviceError, match="the line to the device is gone"):
        device.start()
    assert device.reconnect() is True  # the same boot: the set is still there
    device.start()
    device.close()
    with pytest.raises(DeviceError, match="the connection has been closed"):
        device.status()


def test_whoever_comes_second_stops_what_runs():
    peer = Peer()
    first = peer.open(**PATIENT)
    first.send(**A)
    first.start()
    first.link.close()  # as if killed: no STOP
    with peer.open(**PATIENT) as device:
        assert peer.state == reasons.State.STOPPED
        assert device.notes == ["The device was RUNNING for an earlier host; it has been stopped."]
        assert device.in_force().set_id == 1


def test_a_device_in_hold_says_why():
    peer = Peer()
    peer.state = reasons.State.ESTOP
    with peer.open(**PATIENT) as device:
        assert "The device is in ESTOP" in device.notes[0]
        device.clear()
        assert peer.done[messages.Clear] == 1


def test_a_hold_whose_force_still_sinks_is_cleared_as_soon_as_it_is_gone():
    peer = Peer()
    with peer.open(**PATIENT) as device:
        peer.refuse[messages.Clear] = {"reason": NackReason.BUSY, "ticks": 20, "times": 2}
        device.clear()
        assert peer.done[messages.Clear] == 3


def test_an_error_in_the_block_is_not_hidden_by_a_dead_line():
    peer = Peer()

    def fail():
        with peer.open(**PATIENT):
            peer.hang_up()
            raise KeyError("mine")

    with pytest.raises(KeyError):
        fail()


def test_a_slow_line_gets_the_telemetry_it_carries():
    peer = Peer()
    peer.refuse[messages.Stream] = {"reason": NackReason.LINE_TOO_SLOW, "limit": 4.0}
    with pytest.raises(RefusalError, match="every 4th tick is the most it carries"):
        peer.open(**PATIENT)
    assert peer.done[messages.Stream] == 2


def frame(tick, divisor=1, lost=0, count=3, fields=0):
    samples = tuple(Sample(100 + i, 256, 0.5, 0.25 if fields else None) for i in range(count))
    return messages.Telemetry(tick=tick, divisor=divisor, fields=fields, lost=lost, samples=samples)


def test_telemetry_arrives_in_columns():
    peer = Peer()
    with peer.open(**PATIENT) as device:
        for tick in (2**32 - 3, 0, 3):
            peer.say(frame(tick, fields=1))
        device.status()  # comes after them
        assert device.counts().samples == 9
        table = device.telemetry(0.0)
        assert list(table.columns) == ["tick", "time_s", "position_mm", "force_N", "sensed_N", "flags"]
        assert np.all(np.diff(table["tick"]) == 1)
        np.testing.assert_allclose(table["time_s"], np.arange(9) * 1e-3, atol=1e-12)
        np.testing.assert_allclose(table["position_mm"][:3], 0.0127 * np.arange(100, 103))
        assert set(table["sensed_N"]) == {0.25}
        assert device.telemetry(0).empty  # at once


def test_silence_instead_of_telemetry_is_said(monkeypatch):
    monkeypatch.setattr(hardware_bridge, "_STALLED", 2)
    with Peer().open(**PATIENT) as device, pytest.raises(DeviceError, match="no telemetry comes"):
        device.samples(0.5)


def test_lost_samples_are_counted():
    buffer = TelemetryBuffer(0.0127)
    for message in (frame(0), frame(3), frame(9, lost=65_535), frame(12, lost=1), frame(12, count=0)):
        buffer.add(message)
    assert buffer.counts() == (12, 65_535 + 2, 3, 0)
    assert list(buffer.take().tick) == [0, 1, 2, 3, 4, 5, 9, 10, 11, 12, 13, 14]
    assert np.isnan(buffer.take().sensed_N).all()


def test_telemetry_that_nobody_asked_for_is_given_up_and_counted(monkeypatch):
    monkeypatch.setattr("hilbo.device.telemetry._MOST", 3)
    buffer = TelemetryBuffer(0.0127)
    for tick in range(0, 15, 3):
        buffer.add(frame(tick))
    assert buffer.over_half_full and buffer.counts().unread == 6
    assert list(buffer.take().tick) == list(range(6, 15))


def test_a_long_call_for_samples_has_all_of_them(monkeypatch):
    monkeypatch.setattr("hilbo.device.telemetry._MOST", 20)
    with Renderer.open("sim", options={"rate": "lockstep", "finger": "none"}) as device:
        device.samples(0.0)
        ticks = device.samples(1.0).tick  # 250 messages
        assert len(ticks) >= 1000 and np.all(np.diff(ticks) == 1) and device.counts().unread == 0


@pytest.mark.parametrize("damping", [float("nan"), -0.1, float("inf")])
def test_a_damping_that_is_none_is_refused(damping):
    with pytest.raises(InputError, match=r"give a number from 0, in N\.s/m"):
        Peer().open(damping=damping, **PATIENT)


def test_times_and_numbers_that_are_none_are_refused():
    with Renderer.open("sim", options={"rate": "lockstep", "finger": "none"}) as device:
        for seconds in (float("nan"), float("inf"), -1.0, 1e8):
            with pytest.raises(InputError, match="The drive's duration is"):
                device.drive("position", "hold", 1.0, duration=seconds)
        with pytest.raises(InputError, match="The time is nan s"):
            device.samples(float("nan"))
        with pytest.raises(InputError, match="K1 is '5,58'; give a number"):
            device.send(**A | {"K1": "5,58"})


def test_the_interpreter_ends_although_a_device_is_open():
    """A program that forgets to close its device ends, and with it the heartbeats."""
    code = "from peer import Peer; device = Peer().open(patience=60.0); print(device.state().name)"
    root = Path(__file__).parents[1]
    paths = os.pathsep.join([str(root), str(root / "tests" / "support")])
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, env=os.environ | {"PYTHONPATH": paths}
    )
    assert (run.returncode, run.stdout) == (0, "STOPPED\n"), run.stderr


def test_a_device_with_more_delay_than_the_study_counts_on_is_refused(monkeypatch):
    peer = Peer()
    monkeypatch.setattr(
        peer, "_get_limits", lambda message, made=peer._get_limits: replace(made(message), delay_us=376)
    )
    connect = partial(peer.connect, patience=30.0)
    with pytest.raises(InputError, match=r"at most 0 s and the device checks its sets for 0.000376 s; plan the study"):
        Renderer(connect, delay=0.0)
    with Renderer(connect, delay=376e-6) as device:
        assert device.delay == pytest.approx(376e-6)


@pytest.mark.parametrize("lost", [False, True])
def test_a_start_without_an_answer_is_followed_by_a_stop(lost):
    """Whether its tries are over, or the line brings nothing any more before an answer came."""
    peer = Peer()
    device = Renderer(partial(peer.connect, patience=30.0 if lost else 0.05))
    peer.pulses, peer.swallow = False, 10**9
    if lost:
        peer.socket.shutdown(socket.SHUT_WR)
    with pytest.raises(DeviceError):
        device.link.request(messages.Start(set_id=1, crc=0, boot_id=device.device.boot_id, stop=0))
    while not peer.done[messages.Stop]:
        time.sleep(0.005)
    with contextlib.suppress(DeviceError):
        device.close()


def test_a_line_that_cannot_be_written_is_given_back():
    ours, theirs = socket.socketpair()
    port = SocketPort(ours, "peer")
    ours.shutdown(socket.SHUT_WR)
    with pytest.raises(DeviceError):
        Link(port)
    assert ours.fileno() == -1
    theirs.close()
