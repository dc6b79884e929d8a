"""However a conversation ends, heartbeats end with it; STOP and ESTOP wait for nobody and are tried to the last."""

import errno
import threading
import time

import pytest
from peer import Peer

from hilbo.device import messages
from hilbo.device.heartbeat import BEAT
from hilbo.hardware_bridge import DeviceError

PATIENT = {"patience": 30.0}


def until(done):
    while not done():
        time.sleep(0.005)


@pytest.fixture(params=["helper", "thread"])
def half(request, monkeypatch):
    """A renderer on a line that brings nothing any more and still takes bytes, and the device at its other end."""
    if request.param == "thread":
        monkeypatch.setattr("hilbo.device.heartbeat.sys.executable", "")
    peer = Peer()
    device = peer.open(**PATIENT)
    until(lambda: peer.heartbeats > 2)
    peer.mute()
    until(lambda: device.link.lost)
    yield peer, device
    device.close()


def silent(peer) -> bool:
    """Whether no heartbeat comes any more: one may be on its way."""
    time.sleep(2 * BEAT)
    before = peer.heartbeats
    time.sleep(3 * BEAT)
    return peer.heartbeats == before


def test_a_line_that_is_lost_one_way_hears_no_heartbeat_but_stop_and_estop(half):
    peer, device = half
    assert silent(peer)
    for ask, message in ((device.stop, messages.Stop), (device.estop, messages.Estop)):
        before = peer.done[message]
        with pytest.raises(DeviceError, match="was written all the same; no answer can come: see that the device"):
            ask()
        until(lambda message=message, before=before: peer.done[message] > before)


def test_closing_a_lost_line_still_says_stop(half):
    peer, device = half
    device.close()
    until(lambda: peer.done[messages.Stop])


def test_a_capture_that_fails_ends_the_heartbeats(capsys):
    peer, full = Peer(), threading.Event()

    def capture(data):
        if full.is_set():
            raise OSError(errno.ENOSPC, "No space left on device")

    with peer.open(**PATIENT, capture=capture) as device:
        until(lambda: peer.heartbeats > 2)
        full.set()
        with pytest.raises(DeviceError, match=r"cannot be processed.*No space left"):
            device.state()
        assert silent(peer)
        with pytest.raises(DeviceError, match="ESTOP was written"):
            device.estop()
        until(lambda: peer.done[messages.Estop])
    assert capsys.readouterr().err == ""


def test_estop_waits_for_no_other_request():
    peer = Peer()
    with peer.open(patience=0.4) as device:
        peer.swallow = 1
        asking = threading.Thread(target=device.state)
        asking.start()
        until(lambda: peer.swallow == 0)
        begun = time.monotonic()
        stopping = threading.Thread(target=device.estop)
        stopping.start()
        until(lambda: peer.done[messages.Estop])
        assert asking.is_alive(), time.monotonic() - begun  # it waits 0.4 s for its answer
        stopping.join()
        asking.join()
        assert device.link.stray == 0


def test_a_device_whose_watchdog_is_too_short_for_the_heartbeats_is_refused():
    with pytest.raises(DeviceError, match=r"lets go after 0.1 s without a heartbeat, and one comes every 0.05 s"):
        Peer(watchdog_ticks=100).open()
