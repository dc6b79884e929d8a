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
    """The orders of a session, carried out by a renderer that a thread of its own ticks."""

    def __init__(self, renderer, motor):
        self.renderer, self.motor = renderer, motor
        self.presents, self.ended = False, False
        self.thread = threading.Thread(target=self.loop)
        self.thread.start()

    def loop(self):
        """A position, a tick, a force, once a millisecond and nothing else."""
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
        """Until the program ends."""
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
        """Every few milliseconds, whatever is waited for: the heartbeat, and what the session has to know."""
        self.renderer.heartbeat()
        state = self.renderer.state()
        self.stimulus.contact = bool(state.contact)
        return state

    def wait(self, seconds, is_so):
        """Whether it is the case within so many seconds."""
        end = time.monotonic() + seconds
        while not is_so(self.look()):
            if time.monotonic() > end:
                return False
            time.sleep(0.002)
        return True

    def present(self, order):
        """Render what was ordered, or say why not."""
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
        """The set is rendered when this returns."""
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
        """STOPPED, and what held is cleared: the trial that it held in is void by now."""

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
        """Nothing pushes."""
        self.presents = False
        if self.at_rest():
            self.stimulus.neutral()

    def close(self):
        """The loop takes the force down, then ends."""
        self.renderer.stop()
        time.sleep(0.05)
        self.ended = True
        self.thread.join()


def main(link):
    """Presents until Ctrl-C."""
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
