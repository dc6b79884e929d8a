"""The map beside a session: of one parameter too, and never what a session fails for."""

import msgspec
import numpy as np
from live import RAW, beginning
from live_stimulus import SINGLE, LiveLevels

from hilbo import Study
from hilbo.app.pages.slices import Maps
from hilbo.session.choose.look_ahead import LiveChooser
from hilbo.session.log import actions
from hilbo.session.log.header import header_for
from hilbo.session.log.state import LiveSession

ONE = Study.from_dict(
    RAW
    | {
        "parameters": {"gain": {"low": 1e-4, "high": 1e3, "unit": "dB", "scale": "log"}},
        "selection": {"space_filling": 2, "trials": 3},
    }
)


def test_one_parameter_has_one_slice_with_the_answers_up():  # compiles a step of its own: 3 s
    state = LiveSession.start(ONE.file, header_for(ONE.file, "P01", warm=False))
    chooser = LiveChooser(state)
    maps = Maps(chooser)
    chooser.warm()
    maps.warm()
    for response in ("different", "close", "similar"):
        state = state.after(actions.propose(state, chooser, 0.0))
        for step in range(len(state.steps_of(state.pending))):
            for event in beginning(state, state.pending.id, step, 0.0):
                state = state.after(event)
        state = state.after(actions.answer(state, state.pending.id, response, {"class_a": response}, 0.0))
    assert state.screen == "done"
    content = maps.slices(state)
    (only,) = content["slices"]
    assert (only["across"], only["up"], only["held"]) == ("gain", "answer given", "")
    assert content["ranges"]["answer given"]["levels"] == ("different", "similar", "close")
    assert [trial["y"] for trial in only["trials"]] == [0.0, 1.0, 0.5]
    mean = np.array(only["mean"])
    assert mean.shape == (33, 33) and (mean == mean[0]).all()
    assert abs(only["best"][0] - mean[0].argmax() / 32) < 1 / 32 and only["best"][1] == 1.0
    assert dict(maps.trust(state))["Current optimum"].startswith("gain ")


class NoMaps:
    """Maps that cannot be made."""

    def __init__(self, chooser):
        del chooser

    def warm(self):
        raise RuntimeError("no room on the wall")


def test_a_session_goes_on_without_a_map(tmp_path):
    blocks = (msgspec.structs.replace(SINGLE[0], phase="optimisation"),)
    with LiveLevels(tmp_path, blocks=blocks, maps=NoMaps) as live, live.present():
        live.until(lambda view: "no room on the wall" in (view["alert"] or ""), live.whole)
        live.begin()
        for _ in range(3):
            live.answer()
        live.until(lambda view: view["phase"] == "done")
