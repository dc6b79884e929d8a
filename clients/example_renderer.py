"""A viscoelastic material that this program renders itself at 1 kHz, with the safety chain of hilbo's device, and whose
K1, B1 and alpha a hilbo session chooses. docs/device/host-port.md has what a real device needs.

    hilbo init material.toml --parameter K1=0.2:0.6:N/mm --parameter B1=0.2:0.6:N.s^alpha/mm --parameter alpha=0.1:0.5:1
    hilbo doctor material.toml --stimulus            # prints a link: measures how fast this program stops
    python clients/example_renderer.py LINK-OF-THE-STIMULUS

The device is simulated (mass, damping, a finger), as a process of its own. Python keeps 1 kHz on a quiet computer, and
each tick that comes too late is a HOLD, which voids a trial: for people, write the loop in C++ (example_renderer.cpp).
It needs hilbo installed, for its renderer library.
"""

import contextlib
import os
import sys
import threading
import time

from hilbo_stimulus import Stimulus, StimulusError

from hilbo.device.failures import DeviceError
from hilbo.device.local.library import Fate, HostRenderer, K0_of
from hilbo.device.local.motor import MOTOR, SimulatedMotor
from hilbo.device.reasons import State
from hilbo.errors import InputError

K_EFF = 0.1  # N/mm, static stiffness of every set: K0 follows from it
REFERENCE = {"K1": 0.4, "B1": 0.4, "alpha": 0.3}


class Rendering:
    """The orders of a session, carried out by a renderer that is ticked by a separate thread, started here."""

    def __init__(self, renderer, motor):
        self.renderer, self.motor = renderer, motor
        self.presents, self.ended = False, False
        self.thread = threading.Thread(target=self.loop)
        self.thread.start()

    def loop(self):
        """Once a millisecond, until `ended` is set: read a position, tick the renderer, command the force."""
        due = time.perf_counter()
        while not self.ended:
            due += 0.001
            now = time.perf_counter()
            if now < due:
                time.sleep(due - now)
            elif now > due + 0.02:
                due = now  # it was stopped: do not catch up
            position, velocity = self.motor.sample()
            self.motor.command(self.renderer.tick(position, velocity, time.perf_counter()))

    def run(self, stimulus):
        """Carry out the orders of `stimulus`; ends only by its exceptions.

        If the device stops by itself during a trial, this is reported to the session, which voids the trial.
        """
        self.stimulus = stimulus
        while True:
            order = stimulus.next(0.01)
            state = self.look()
            if self.presents and state.state in (State.HOLD, State.ESTOP):  # in the middle of a trial
                self.presents = False
                stimulus.begin_again(self.renderer.why())
            elif order is not None and order.do == "present":
                self.present(order)
            elif order is not None:
                self.rest()

    def look(self):
        """Send the heartbeat, report contact to the session, and return the renderer's state.

        To be called every few milliseconds, also while waiting.
        """
        self.renderer.heartbeat()
        state = self.renderer.state()
        self.stimulus.contact = bool(state.contact)
        return state

    def wait(self, seconds, is_so):
        """Wait until `is_so(state)` is true, for at most `seconds`; whether it became true."""
        end = time.monotonic() + seconds
        while not is_so(self.look()):
            if time.monotonic() > end:
                return False
            time.sleep(0.002)
        return True

    def present(self, order):
        """Put an order's set (or the reference) in force and confirm it; if that fails, stop and report the reason."""
        values = order.values if order.show == "test" else REFERENCE
        try:
            self.put_in_force(values, order.within_s - 0.1)
        except (DeviceError, InputError) as error:
            self.renderer.stop()
            self.stimulus.failed(str(error))
        else:
            self.presents = True
            self.stimulus.presented()

    def put_in_force(self, values, seconds):
        """Stop, load the set, and start; the set is rendered when this returns.

        Raises `DeviceError` if the device is not at rest or the handle stays in the material for `seconds`, and
        `InputError` if the set is refused.
        """
        self.presents = False
        if not self.at_rest():
            raise DeviceError(self.renderer.why())
        self.renderer.set(K0=K0_of(K_eff=K_EFF, **values), **values, force_limit=15.0)
        decided = self.wait(seconds, lambda state: state.set != Fate.WAITING and not state.contact)
        state = self.renderer.state()
        if state.set == Fate.REFUSED:
            raise InputError(self.renderer.sentence())
        if not decided:
            raise DeviceError("The handle is in the material.")
        self.renderer.start(state.stops)

    def at_rest(self):
        """Stop the renderer and clear a HOLD or ESTOP; whether it is STOPPED within 0.2 s."""

        def stopped(state):
            if state.state in (State.HOLD, State.ESTOP):
                try:
                    self.renderer.clear(state.stops)
                except DeviceError:
                    return False  # its force has not come down yet
            return state.state == State.STOPPED

        self.renderer.stop()
        return self.wait(0.2, stopped)

    def rest(self):
        """Stop the renderer and confirm "neutral"; nothing is confirmed if it does not come to rest."""
        self.presents = False
        if self.at_rest():
            self.stimulus.neutral()

    def close(self):
        """Stop the renderer, let the loop take the force down for 50 ms, then end its thread."""
        self.renderer.stop()
        time.sleep(0.05)
        self.ended = True
        self.thread.join()


def main(link):
    """Present orders until Ctrl-C, at real-time priority where the system allows it."""
    sys.setswitchinterval(0.0002)  # the loop waits so long for the other threads
    with contextlib.suppress(AttributeError, PermissionError):  # where that is allowed, all go before other programs
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))
    with SimulatedMotor() as motor, HostRenderer(MOTOR) as renderer:
        rendering = Rendering(renderer, motor)
        said = {"force": True, "go_neutral": renderer.stop, "neutral_within_s": 0.05}
        try:
            with Stimulus(link, name="example_renderer", version="1", **said) as stimulus:
                rendering.run(stimulus)
        finally:
            rendering.close()


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit("usage: python example_renderer.py LINK, the one that hilbo session prints for the stimulus")
    try:
        main(sys.argv[1])
    except (StimulusError, DeviceError) as error:
        raise SystemExit(str(error)) from None
    except KeyboardInterrupt:
        pass
