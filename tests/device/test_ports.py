"""Lines that are none, are used, or have something else at their other end."""

import os
import socket
import sys
import time

import numpy as np
import pytest
from peer import Peer

from hilbo.device import handshake
from hilbo.device.link import Link
from hilbo.device.ports import list_ports, open_port
from hilbo.errors import InputError
from hilbo.hardware_bridge import DeviceError, Renderer

A = {"K0": -3.18, "K1": 5.58, "B1": 7.88, "alpha": 0.176}


@pytest.mark.parametrize(
    ("where", "words"),
    [
        ("/dev/hilbo-nothing", "there is no such port; plug the device in"),
        ("socket://nowhere", "is no address; write it like"),
        ("socket://127.0.0.1:99999", "no server answers"),
        ("/dev/null", "is no serial port"),
    ],
)
def test_a_port_that_is_none_is_one_sentence(where, words):
    with pytest.raises(InputError) as error:
        Renderer.open(where)
    assert words in str(error.value)


def test_a_device_behind_an_address():
    peer = Peer()
    with peer.listening() as where, Renderer.open(where, patience=60.0) as device:
        device.send(**A)
        assert device.in_force().alpha == float(np.float32(0.176))


def test_without_pyserial_there_is_one_sentence(monkeypatch):
    for module in ("serial", "serial.tools.list_ports"):
        monkeypatch.setitem(sys.modules, module, None)
    for attempt in (list_ports, lambda: open_port("/dev/ttyACM0")):
        with pytest.raises(InputError, match="Serial ports need pyserial; install it with"):
            attempt()


def test_nobody_listens_at_an_address():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        with pytest.raises(InputError, match="no server answers"):
            Renderer.open(f"socket://127.0.0.1:{free.getsockname()[1]}")


@pytest.fixture
def terminal():
    """A pseudo-terminal: the file of its other end, and its name."""
    pytest.importorskip("serial")
    master, slave = os.openpty()
    yield master, os.ttyname(slave)
    for file in (master, slave):
        os.close(file)


def test_a_port_that_is_used_is_one_sentence(terminal):
    first = open_port(terminal[1])
    with pytest.raises(InputError, match="another program uses this port"):
        Renderer.open(terminal[1])
    first.close()


def test_a_port_where_nothing_answers(terminal, monkeypatch):
    monkeypatch.setattr(handshake, "_BOOT", 0.3)
    with pytest.raises(DeviceError, match="HELLO has had no answer in 3 tries; nothing at all comes back"):
        Renderer.open(terminal[1])


def test_a_device_that_is_not_ours(terminal, monkeypatch):
    monkeypatch.setattr(handshake, "_BOOT", 0.0)
    link = Link(open_port(terminal[1]), patience=0.05)
    os.write(terminal[0], b"T=21.5\r\n\0")
    while not link.dropped:
        time.sleep(0.01)
    with pytest.raises(DeviceError, match="what comes back is not of this protocol; check the port and its baud"):
        Renderer(lambda: link)
