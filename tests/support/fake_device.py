"""A device of protocol 2 in Python, in the place of `Renderer`: states, the count of stops, contact, flags of samples.

Every order is carried out by the rules of firmware/PROTOCOL.md that a session depends on, without a line in between.
"""

from dataclasses import asdict, fields
from types import SimpleNamespace

import numpy as np

from hilbo.device.messages import Nack, Status
from hilbo.device.reasons import DeviceFlag, HoldReason, NackReason, State
from hilbo.hardware_bridge import Capability, DeviceError, Renderer

__all__ = ["FakeDevice"]


class FakeDevice(Renderer):
    """`pressed`: a hand presses the handle. `told`: what was carried out, in its order; `starts`: how often START was
    sent. `arrives(flags)`: samples of the telemetry; `notices`: sentences that it sends unasked."""

    notes = ()
    simulator = None
    can = Capability.SIMULATED
    link = None
    device = SimpleNamespace(damping_N_s_per_m=1.0)

    def __init__(self, pressed=False):
        self.pressed, self.told, self.starts = pressed, [], 0
        self.now, self.why, self.flags = State.STOPPED, HoldReason.BOOT, DeviceFlag.HOMED
        self.link = SimpleNamespace(name="fake", stops=0, restarted=False, faint=False)
        self._samples, self.notices = [], []

    def arrives(self, *flags):
        self._samples += flags

    def samples(self, seconds):
        taken, self._samples = self._samples, []
        return SimpleNamespace(flags=np.array(taken, np.int64))

    def status(self):
        seen = dict.fromkeys((field.name for field in fields(Status)), 0)
        seen |= {"state": self.now, "hold_reason": self.why, "contact": int(self.pressed), "flags": self.flags}
        seen |= {"stops": self.link.stops, "position_mm": float(self.pressed), "force_N": 0.0, "energy_mJ": 0.0}
        return Status(**seen)

    def send(self, wanted):
        self.told.append("send")
        return SimpleNamespace(_asdict=lambda: asdict(wanted))

    def start(self, *, stop=None, wait=0.0):
        self.starts, self._samples = self.starts + 1, []
        self._check_time(stop)
        if self.now == State.RUNNING:
            return
        if self.now != State.STOPPED:
            self._refuse(NackReason.STATE)
        if self.pressed:
            self._refuse(NackReason.IN_CONTACT)
        self.now = State.RUNNING
        self.told.append("start")

    def stop(self):
        self.link.stops += 1
        if self.now == State.RUNNING:
            self.now = State.STOPPED
        self.told.append("stop")
        return self.link.stops

    def estop(self):
        self.stopped_by(HoldReason.ESTOP)
        self.told.append("estop")

    def stopped_by(self, why, state=State.ESTOP):
        """It holds, or is stopped, unasked."""
        self.link.stops += 1
        self.now, self.why = state, why

    def clear(self, *, stop=None):
        self._check_time(stop)
        if self.flags & DeviceFlag.STOP_OPEN:
            self._refuse(NackReason.STOP_OPEN)
        if self.now in (State.HOLD, State.ESTOP):
            self.now = State.STOPPED
            self.told.append("clear")

    def events(self):
        sent, self.notices = self.notices, []
        return sent

    def close(self):
        self.told.append("close")

    def _check_time(self, stop):
        if stop is not None and stop != self.link.stops:
            self._refuse(NackReason.STALE)

    def _refuse(self, reason):
        nack = Nack(request=0, reason=reason, reserved=0, ticks=0, value=0.0, limit=0.0)
        raise DeviceError(f"refused: {reason.name}", nack)
