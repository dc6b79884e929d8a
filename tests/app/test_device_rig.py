"""The rig of a device: orders in time, a start that waits for the hand, and the flags of a trial; without a line."""

import asyncio
import contextlib
import queue
import threading

import pytest
from fake_device import FakeDevice
from hypothesis import given, settings
from hypothesis import strategies as st

from hilbo.app.rigs import device_rig
from hilbo.app.rigs.device_rig import DeviceRig
from hilbo.app.rigs.rig import Showing
from hilbo.device.reasons import DeviceFlag, HoldReason, SampleFlag, State
from hilbo.hardware_bridge import DeviceError
from hilbo.study.file.reading import StudyFile
from hilbo.study.file.trial_flags import FLAGS

STUDY = StudyFile.load("hilbo/data/paper.toml")
VALUES = {"K0": -3.18, "K1": 5.58, "B1": 7.88, "alpha": 0.176}
REFERENCE, RENDERING = Showing(1, 1, 0, "reference", None, None), Showing(1, 1, 1, "a", VALUES, None)


@pytest.fixture(autouse=True)
def _sooner(monkeypatch):
    monkeypatch.setattr(device_rig, "_POLL", 0.002)
    monkeypatch.setattr(device_rig, "_NEAR", 0.001)


@contextlib.contextmanager
def rig_of(device):
    rig = DeviceRig(STUDY, lambda: device)
    try:
        yield rig
    finally:
        rig.close()


async def until(true):
    async with asyncio.timeout(10):
        while not true():
            await asyncio.sleep(0.001)


class Gate(queue.SimpleQueue):
    """Jobs wait until they are let through, one at a time; `taken` counts them."""

    def __init__(self):
        self.permits, self.taken, self.last = threading.Semaphore(0), 0, None

    def get(self, timeout=None):
        if not self.permits.acquire(timeout=timeout):
            raise queue.Empty
        job = super().get(timeout=timeout)
        if job is not None:
            self.taken, self.last = self.taken + 1, job[1]
        return job


ORDERS = ("clear", "show", "rest")
doings = st.lists(st.sampled_from((*ORDERS, "estop", "job", "job")), max_size=25)


@given(doings)
@settings(max_examples=60, deadline=None)
def test_no_order_ends_a_stop_that_came_after_it_was_requested(doings):
    """Whatever waits before it: CLEAR and START act on what was known when they were requested, or not at all."""
    clock, requested, ended_by = [0], [], []

    class Watched(FakeDevice):
        last_stop = 0

        def estop(self):
            super().estop()
            self.last_stop = clock[0]

        def clear(self, *, stop=None):
            self._effect("clear", lambda: FakeDevice.clear(self, stop=stop))

        def start(self, *, stop=None, wait=0.0):
            self._effect("start", lambda: FakeDevice.start(self, stop=stop))

        def _effect(self, name, order):
            before = self.now
            order()
            if self.now != before:
                ended_by.append((name, requested[gate.taken - 1] > self.last_stop))

    async def held(rig):
        tasks = []
        for what in doings:
            clock[0] += 1
            if what == "estop":
                await rig.estop()
            elif what == "job" and gate.taken < len(requested):
                before = gate.taken
                gate.permits.release()
                await until(lambda before=before: gate.taken > before and gate.last.done())
            elif what in ORDERS:
                requested.append(clock[0])
                work = rig.show(RENDERING) if what == "show" else getattr(rig, what)()
                tasks.append(asyncio.ensure_future(work))
                await asyncio.sleep(0)
        for _ in requested[gate.taken :]:
            gate.permits.release()
        done = await asyncio.gather(*tasks, return_exceptions=True)
        assert [result for result in done if result is not None and not isinstance(result, DeviceError)] == []

    device = Watched()
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(device_rig.queue, "SimpleQueue", Gate)  # of this rig alone: asyncio has queues of its own
        rig = DeviceRig(STUDY, lambda: device)
    gate = rig._jobs
    try:
        asyncio.run(held(rig))
    finally:
        gate.permits.release()
        rig.close()
    assert all(in_time for _, in_time in ended_by), ended_by


def test_a_clear_after_the_rig_s_own_stop_is_carried_out():
    """The stop of a trial's end waits before it in the queue."""
    device = FakeDevice()

    async def held(rig):
        device.stopped_by(HoldReason.VELOCITY, State.HOLD)
        busy = threading.Event()
        rig.do(lambda _: busy.wait(10))
        rested = asyncio.ensure_future(rig.rest())
        await asyncio.sleep(0)
        cleared = asyncio.ensure_future(rig.clear())
        await asyncio.sleep(0)
        busy.set()
        await rested
        await cleared
        assert device.now == State.STOPPED

    with rig_of(device) as rig:
        asyncio.run(held(rig))


@pytest.mark.parametrize("counted", [False, True])
@pytest.mark.parametrize("other", [False, True])
def test_a_clear_while_the_rig_s_own_stop_is_under_way(counted, other):
    """Carried out, whether the device has counted STOP or not, and not after another's stop, whenever that is."""
    under_way, go_on = threading.Event(), threading.Event()

    class Slow(FakeDevice):
        def stop(self):
            count = super().stop() if counted else None
            under_way.set()
            assert go_on.wait(10)
            return count or super().stop()

    async def held(rig):
        rested = asyncio.ensure_future(rig.rest())
        await until(under_way.is_set)
        cleared = asyncio.ensure_future(rig.clear())
        await asyncio.sleep(0)
        if other:
            device.stopped_by(HoldReason.VELOCITY, State.HOLD)
        go_on.set()
        await rested
        with pytest.raises(DeviceError, match="STALE") if other else contextlib.nullcontext():
            await cleared
        assert device.now == (State.HOLD if other else State.STOPPED)

    device = Slow()
    device.stopped_by(HoldReason.VELOCITY, State.HOLD)
    with rig_of(device) as rig:
        asyncio.run(held(rig))


def test_a_clear_that_comes_late_is_refused_in_a_sentence():
    device = FakeDevice()

    async def held(rig):
        device.stopped_by(HoldReason.VELOCITY, State.HOLD)
        busy = threading.Event()
        rig.do(lambda _: busy.wait(10))
        cleared = asyncio.ensure_future(rig.clear())
        await asyncio.sleep(0)
        await rig.estop()
        busy.set()
        with pytest.raises(DeviceError, match="STALE"):
            await cleared
        assert device.now == State.ESTOP
        await rig.clear()
        assert device.now == State.STOPPED

    with rig_of(device) as rig:
        asyncio.run(held(rig))


def test_nothing_starts_and_no_set_goes_over_while_the_handle_is_pressed():
    device = FakeDevice(pressed=True)

    async def held(rig):
        loading = asyncio.ensure_future(rig.prepare(RENDERING))
        await asyncio.sleep(0.05)
        assert device.told == [] and not loading.done()
        device.pressed = False
        assert (await loading).facts["in_force"]["K1"] == VALUES["K1"]
        device.pressed = True
        shown = asyncio.ensure_future(rig.show(RENDERING))
        await asyncio.sleep(0.05)
        assert device.told == ["send"] and device.starts == 0 and not shown.done()
        device.pressed = False
        await shown
        assert device.told == ["send", "start"]

    with rig_of(device) as rig:
        asyncio.run(held(rig))


def test_a_start_that_is_refused_in_contact_is_tried_again():
    """The hand came back between the look and START."""

    class Pressed(FakeDevice):
        refused = 0

        def start(self, *, stop=None, wait=0.0):
            self.pressed, self.refused = self.refused < 3, self.refused + 1
            try:
                super().start(stop=stop)
            finally:
                self.pressed = False

    device = Pressed()
    with rig_of(device) as rig:
        asyncio.run(rig.show(RENDERING))
    assert device.refused == 4 and device.told[0] == "start"


def test_a_stop_while_the_hand_is_waited_for_ends_the_wait():
    device = FakeDevice(pressed=True)

    async def held(rig):
        shown = asyncio.ensure_future(rig.show(RENDERING))
        await asyncio.sleep(0.02)
        await rig.estop()
        with pytest.raises(DeviceError, match="STALE"):
            await shown
        device.pressed = False
        await rig.clear()
        await asyncio.sleep(0.02)
        assert device.now == State.STOPPED  # no start that was requested before the stop

    with rig_of(device) as rig:
        asyncio.run(held(rig))


def test_a_hold_can_be_cleared_while_a_set_waits_for_the_hand():
    device = FakeDevice(pressed=True)

    async def held(rig):
        loading = asyncio.ensure_future(rig.prepare(RENDERING))
        await asyncio.sleep(0.02)
        device.stopped_by(HoldReason.HEAT, State.HOLD)
        async with asyncio.timeout(5):
            await rig.clear()
        assert device.now == State.STOPPED
        loading.cancel()

    with rig_of(device) as rig:
        asyncio.run(held(rig))


def test_flags_are_counted_from_the_first_step_of_the_presentation_to_the_answer():
    flag, device = SampleFlag, FakeDevice()

    async def held(rig):
        device.arrives(flag.SATURATED)  # of the trial before
        assert rig.telemetry(1, 1) is None
        await rig.show(REFERENCE)
        assert rig.telemetry(1, 1) == {"samples": 0}
        device.arrives(flag.CONTACT | flag.RUNNING, flag.SATURATED | flag.SLEWED, flag.SATURATED, flag.INPUT_HELD)
        await rig.show(RENDERING)  # which drops what was not read before it starts
        device.arrives(*[flag.CONTROLLED | flag.SWITCHING] * 2)
        counts = {"samples": 6, "saturated": 2, "slewed": 1, "controlled": 2, "input_held": 1}
        assert rig.telemetry(1, 1) == counts
        assert rig.telemetry(1, 2) is None
        device.arrives(flag.HOLD, flag.ESTOP)
        await until(lambda: not device._samples)  # taken meanwhile, as nobody asks
        assert rig.telemetry(1, 1) == counts | {"samples": 8, "hold": 1, "estop": 1}
        await rig.show(REFERENCE._replace(presentation=2))
        assert rig.telemetry(1, 2) == {"samples": 0}

    with rig_of(device) as rig:
        asyncio.run(held(rig))
    assert {name.upper() for name in FLAGS} <= set(SampleFlag.__members__)


def test_nobody_waits_for_a_job_that_comes_too_late_for_the_closed_rig():
    rig = DeviceRig(STUDY, FakeDevice)
    under_way, queued = rig.do(lambda _: rig._ending.wait(10)), rig.do(lambda device: device.told.append("late"))
    given_up = rig.do(lambda _: None)
    given_up.cancel()
    rig.close()
    late = rig.do(lambda device: device.told.append("later"))
    assert under_way.result(1)
    for job in (queued, late):
        assert isinstance(job.exception(1), DeviceError)
    assert rig.device.told == ["close"]


def test_the_hardware_stop_and_a_hot_motor_are_words():
    device = FakeDevice()
    with rig_of(device) as rig:
        device.stopped_by(HoldReason.SWITCH)
        device.flags |= DeviceFlag.STOP_OPEN
        seen = rig._look()
        assert seen.state == "ESTOP" and seen.reason == "the hardware stop is open"
        assert ("Hardware stop", "open") in seen.rows
        device.flags = DeviceFlag.HOMED
        seen = rig._look()
        assert seen.reason == "the hardware stop was open" and ("Hardware stop", "open") not in seen.rows
        device.stopped_by(HoldReason.HEAT, State.HOLD)
        assert rig._look().reason == "the mean force was above what the motor bears continuously"
        assert ("Homed", "no") not in rig._look().rows
        device.flags = DeviceFlag(0)
        assert ("Homed", "no") in rig._look().rows
