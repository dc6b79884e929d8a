"""A grating in a PsychoPy window, whose contrast (%) and spatial frequency (cycles per degree) a hilbo session chooses.

    hilbo init grating.toml --parameter contrast=1:100:%:log --parameter frequency=0.5:8:c/deg:log
    hilbo session grating.toml --participant P01 --dry-run
    python example_psychopy.py LINK-OF-THE-STIMULUS

Needs PsychoPy, and hilbo_stimulus.py next to it. An order is confirmed after the flip that shows it. Escape ends.
"""

import sys

from hilbo_stimulus import Stimulus
from psychopy import core, event, monitors, visual

REFERENCE = {"contrast": 30.0, "frequency": 2.0}


def main(link):
    """Draw what the newest order asks for in every frame, until Escape."""
    monitor = monitors.Monitor("session", width=53.0, distance=60.0)  # cm; measure yours
    monitor.setSizePix((1920, 1080))
    window = visual.Window(fullscr=True, monitor=monitor, units="deg", color=0)
    grating = visual.GratingStim(window, tex="sin", mask="gauss", size=6)
    with Stimulus(link, name="example_psychopy", version="1", neutral_within_s=0.1) as stimulus:
        now = None
        while not event.getKeys(["escape"]):
            new = stimulus.next(0)
            now = new or now
            if now is not None and now.do == "present":
                values = REFERENCE if now.show == "reference" else now.values
                grating.contrast, grating.sf = values["contrast"] / 100, values["frequency"]
                grating.draw()
            window.flip()
            if new is not None and new.do == "present":
                stimulus.presented()
            elif new is not None:
                stimulus.neutral()
    window.close()
    core.quit()


if __name__ == "__main__":
    main(sys.argv[1])
