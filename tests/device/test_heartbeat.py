"""Heartbeats from a process of their own: while this one computes, and for no longer than it lives."""

import contextlib
import os
import subprocess
import sys
import threading
import time

import pytest
from peer import Peer
from simulated import ENVIRONMENT

from hilbo.device import heartbeat
from hilbo.device.heartbeat import HelperHeart, ThreadHeart, keep_beating
from hilbo.device.ports import SocketPort
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


def beats(grace):
    """A heart in this process: its thread, the end of its pipe, and what it has written."""
    line, heard = os.pipe()
    signs, ours = os.pipe()
    thread = threading.Thread(target=keep_beating, args=(heard, FRAME, signs, grace))
    thread.start()
    return thread, ours, line


def test_a_host_that_hangs_has_no_heartbeats():
    thread, ours, line = beats(0.2)
    thread.join()  # without a sign of life, though the pipe is open
    assert os.read(line, 100).startswith(FRAME)
    os.close(ours)


def test_the_end_of_the_pipe_is_the_end_of_the_heartbeats():
    thread, ours, line = beats(1e9)
    assert os.read(line, 100).startswith(FRAME)
    assert os.read(line, 100).startswith(FRAME)
    os.close(ours)
    thread.join()


def test_another_parent_is_the_end_of_the_heartbeats(monkeypatch):
    """A copy of the pipe in a forked process would keep it open."""
    thread, ours, _ = beats(1e9)
    monkeypatch.setattr(os, "getppid", lambda: -1)
    thread.join()
    os.close(ours)


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
    line, heard = os.pipe()
    fainted = []
    heart = HelperHeart(heard, FRAME, lambda: fainted.append(True))
    assert os.read(line, 100).startswith(FRAME)
    os.close(line)
    heart._signs._thread.join()
    assert heart.process.returncode == 3 and fainted == []
    heart.close()


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
