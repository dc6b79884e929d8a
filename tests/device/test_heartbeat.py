"""Heartbeats from a process of their own: while this one computes, and for no longer than it lives."""

import contextlib
import os
import socket
import struct
import subprocess
import sys
import threading
import time
from dataclasses import fields

import pytest
from peer import Peer
from simulated import ENVIRONMENT

from hilbo.device import heartbeat
from hilbo.device.frames import Receiver
from hilbo.device.heartbeat import HelperHeart, ThreadHeart, keep_beating
from hilbo.device.messages import MESSAGES, Heartbeat, Notice, Pulse, Telemetry, code_of
from hilbo.device.ports import SocketPort
from hilbo.device.protocol import encode
from hilbo.hardware_bridge import DeviceError

pytestmark = pytest.mark.skipif(os.name != "posix", reason="only POSIX shares an open line with another process")

PATIENT = {"patience": 60.0}
FRAME = b"beat\0"

# `read` of a library that is loaded as PyDLL keeps the interpreter's lock: no thread of Python runs meanwhile.
STUCK = """
import ctypes
from peer import Peer
from hilbo.hardware_bridge import Renderer
import sys
with Renderer.open(sys.argv[1], patience=60) as device:
    print("stuck", flush=True)
    ctypes.PyDLL(None).read(0, ctypes.create_string_buffer(1), 1)
    print(device.state().name, flush=True)
"""


def until(done):
    """Waits for it; as long as the test may run."""
    while not done():
        time.sleep(0.005)


def test_computing_delays_no_heartbeat():
    """A thread would not beat once while the interpreter's lock is held: the lock is held until many have come."""
    peer = Peer()
    with peer.listening() as where:
        command = [sys.executable, "-c", STUCK, where]
        host = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=ENVIRONMENT)
        assert host.stdout.readline() == "stuck\n"
        before = peer.heartbeats
        until(lambda: peer.heartbeats > before + 8)
        assert host.communicate("x")[0] == "STOPPED\n"
        assert host.returncode == 0


def test_the_heart_stops_with_a_killed_host():
    peer = Peer()
    with peer.listening() as where:
        command = [sys.executable, "-c", STUCK, where]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        with subprocess.Popen(command, **pipes, env=ENVIRONMENT) as host:
            assert host.stdout.readline() == b"stuck\n"
            host.kill()
            assert host.stderr.read() == b""  # ends when the last process ends that holds it: the helper
        until(lambda: peer.over)  # the line too is nobody's any more


def test_a_helper_that_ends_is_said_and_the_device_can_still_be_stopped():
    peer = Peer()
    with peer.open(**PATIENT) as device:
        device.link._heart.process.kill()
        until(lambda: device.link.faint)
        with pytest.raises(DeviceError, match="heartbeats have ended, because this program hung for 5 s or"):
            device.in_force()
        device.stop()
        assert device.reconnect() is True
        assert device.in_force() is None


class Helper:
    """A heart in this process: its thread, its pipes, and the other end of its line."""

    def __init__(self, grace=1e9, tick=0):
        self.line, helpers = socket.socketpair()
        self.line.settimeout(30)
        signs, self.signs = os.pipe()
        self.out, out = os.pipe()
        self.receiver = Receiver()

        def run():
            try:
                keep_beating(helpers.fileno(), 7, tick, signs, out, grace)
            except OSError:
                self.gone = True
            for number in (out, signs):
                os.close(number)
            helpers.close()

        self.gone = False
        self.thread = threading.Thread(target=run)
        self.thread.start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        with contextlib.suppress(OSError):
            os.close(self.signs)
        self.thread.join()
        self.line.close()
        os.close(self.out)

    def beat(self):
        """Boot id and tick of the next heartbeat."""
        while not (frames := self.receiver.feed(self.line.recv(100))):
            pass
        assert {frame.type for frame in frames} == {heartbeat.HEARTBEAT}
        return struct.unpack("<II", frames[-1].payload)


def test_a_host_that_hangs_has_no_heartbeats():
    with Helper(grace=0.2) as helper:
        assert helper.beat() == (7, 0)
        helper.thread.join()  # without a sign of life, though the pipe is open


def test_the_end_of_the_pipe_is_the_end_of_the_heartbeats_and_what_has_come_is_passed_on():
    with Helper() as helper:
        helper.beat()
        helper.line.sendall(b"the last words")
        assert os.read(helper.out, 100) == b"the last words"
        os.close(helper.signs)
        helper.thread.join()
        assert os.read(helper.out, 100) == b""


def test_another_parent_is_the_end_of_the_heartbeats(monkeypatch):
    """A copy of the pipe in a forked process would keep it open."""
    with Helper() as helper:
        monkeypatch.setattr(os, "getppid", lambda: -1)
        helper.thread.join()


def test_a_heartbeat_has_the_newest_tick_that_came_back():
    """Of every message that begins with one; a damaged frame and an older tick count for nothing."""
    with Helper(tick=5) as helper:
        known = {"boot_id": 7, "state": 1, "reason": 0, "stops": 0}
        spoilt = bytearray(encode(Pulse(tick=900, **known), 0))
        spoilt[5] ^= 1
        for data, tick in (
            (encode(Pulse(tick=60, **known), 0), 60),
            (encode(Notice(tick=70, **known), 0), 70),
            (encode(Telemetry(tick=80, divisor=1, fields=0, lost=0, samples=()), 0), 80),
            (bytes(spoilt), 80),
            (encode(Pulse(tick=75, **known), 0), 80),
            (encode(Pulse(tick=2**31 + 60, **known), 0), 2**31 + 60),
            (encode(Pulse(tick=3, **known), 0), 3),  # after 2^32 - 1
        ):
            helper.line.sendall(data)
            assert os.read(helper.out, 1000) == data
            helper.beat()
            assert helper.beat() == (7, tick)


def test_a_hushed_helper_reads_on_and_beats_no_more():
    with Helper() as helper:
        helper.beat()
        os.write(helper.signs, b".-.")
        time.sleep(2 * heartbeat.BEAT)
        helper.line.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            helper.receiver.feed(helper.line.recv(1000))
        time.sleep(4 * heartbeat.BEAT)
        with pytest.raises(BlockingIOError):
            helper.line.recv(1000)
        helper.line.sendall(b"heard")
        helper.line.setblocking(True)
        assert os.read(helper.out, 100) == b"heard"
        os.write(helper.signs, b"+")
        helper.beat()


def test_the_helper_knows_the_types_of_the_protocol():
    assert code_of(Heartbeat) == heartbeat.HEARTBEAT
    first = {code for code, kind in MESSAGES.items() if fields(kind) and fields(kind)[0].name == "tick"}
    assert first == heartbeat.WITH_TICK


def test_a_line_that_takes_nothing_is_waited_for():
    line, heard = os.pipe()
    os.set_blocking(heard, False)
    for size in (1000, 1):
        with contextlib.suppress(BlockingIOError):
            while True:
                os.write(heard, b"x" * size)
    heartbeat._write(heard, FRAME)
    assert FRAME not in os.read(line, 10**6)
    heartbeat._write(heard, FRAME)
    assert os.read(line, 100) == FRAME


def test_a_line_that_is_gone_ends_the_helper_and_is_no_fainting():
    ours, theirs = socket.socketpair()
    fainted = []
    heart = HelperHeart(ours.fileno(), 7, 0, lambda: fainted.append(True))
    assert theirs.recv(100)
    theirs.close()
    until(lambda: heart.read(1.0) is None)
    heart._signs._thread.join()
    assert heart.process.returncode == 3 and fainted == []
    heart.close(threading.current_thread())
    ours.close()


def test_without_an_interpreter_there_is_one_sentence(monkeypatch):
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(DeviceError, match="The process that sends heartbeats cannot be started: /bin/false does not"):
        Peer().open(**PATIENT)


def test_a_port_that_cannot_be_shared_beats_from_a_thread(monkeypatch):
    monkeypatch.delattr(SocketPort, "fileno")
    peer = Peer()
    with peer.open(**PATIENT) as device:
        heart = device.link._heart
        assert isinstance(heart, ThreadHeart)
        before = peer.heartbeats
        until(lambda: peer.heartbeats > before + 3)
        peer.hang_up()
        heart._thread.join()
        device.reconnect()
