"""A spring and a damper against a finger, whose stiffness (N/mm) and damping (N s/mm) a hilbo session chooses.

    hilbo init spring.toml --parameter stiffness=0.1:2:N/mm --parameter damping=0.001:0.02:N.s/mm
    hilbo doctor spring.toml --stimulus              # prints a link: measures how fast this program stops
    python clients/example_spring.py LINK-OF-THE-STIMULUS

The loop stands for the one of your device: it reads a position (here of a finger that is simulated), and sets a force
(here none is set). What has to be the same in yours: `go_neutral` works whatever the loop is doing, the loop looks in
each tick at what is in force, and contact is reported as the loop detects it.
"""

import math
import sys
import threading
import time

from hilbo_stimulus import Stimulus, StimulusError

NEUTRAL, REFERENCE = (0.0, 0.0), (0.8, 0.005)


def set_motor(force):
    """Set a force in N; does nothing here: put your motor's call in its place."""


class Spring:
    """Stiffness (N/mm) and damping (N s/mm) as one tuple `set`; both 0: no force at any position."""

    def __init__(self):
        self.set, self.ended = NEUTRAL, False

    def neutral(self):
        """No force from the next tick on."""
        self.set = NEUTRAL

    def loop(self, stimulus):
        """Render the spring at 1 kHz until `ended` is set, and tell `stimulus` about contact.

        Prints to stderr when the force comes and goes.
        """
        touched, pushed, begun = False, False, time.perf_counter()
        while not self.ended:
            phase = 2 * math.pi * (time.perf_counter() - begun) / 0.6  # a finger that comes every 0.6 s
            x, v = 4 * math.sin(phase) - 2, 4 * math.cos(phase) * 2 * math.pi / 0.6  # mm, mm/s
            stiffness, damping = self.set
            set_motor(stiffness * x + damping * v if x > 0 else 0.0)
            if (x > 0) != touched:
                stimulus.contact = touched = x > 0
            if (stiffness > 0) != pushed:
                pushed = stiffness > 0
                print(f"{time.time():.3f} {'force' if pushed else 'neutral'}", file=sys.stderr, flush=True)
            time.sleep(0.001)


def main(link):
    """Present orders until Ctrl-C, with the loop in a separate thread."""
    spring = Spring()
    said = {"force": True, "go_neutral": spring.neutral, "neutral_within_s": 0.05}
    with Stimulus(link, name="example_spring", version="1", **said) as stimulus:
        looping = threading.Thread(target=spring.loop, args=(stimulus,))
        looping.start()
        try:
            for order in stimulus:
                if order.do != "present":
                    spring.neutral()
                    stimulus.neutral()
                else:
                    test = order.show == "test"
                    spring.set = (order.values["stiffness"], order.values["damping"]) if test else REFERENCE
                    stimulus.presented()
        finally:
            spring.neutral()
            spring.ended = True
            looping.join()


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit("usage: python example_spring.py LINK, the one that hilbo session prints for the stimulus")
    try:
        main(sys.argv[1])
    except StimulusError as error:
        raise SystemExit(str(error)) from None
    except KeyboardInterrupt:
        pass
