"""A live session whose renderings a program presents, for tests; and programs that present: well, badly, by hand."""

import contextlib
import functools
import importlib.util
import sys
import threading
import urllib.error
from http import HTTPStatus
from pathlib import Path

from live_server import Live

from hilbo.app.rehearsal.robot import Client
from hilbo.app.rigs.stimulus_rig import StimulusRig
from hilbo.study.config import Study
from hilbo.study.file.plan_file import Block, Planned

__all__ = [
    "CLIENTS",
    "SETS",
    "SINGLE",
    "TEXT",
    "ByHand",
    "LiveLevels",
    "LiveStimulus",
    "Presenter",
    "all_answered",
    "module",
]

CLIENTS = Path(__file__).parents[2] / "clients"
SETS = {
    "best": {"hue": 123.456789, "light": 54.321987},
    "mid": {"hue": 222.333444, "light": 33.777111},
    "worst": {"hue": 301.987654, "light": 71.123456},
}
SINGLE = (Block("warm-up", 3, tuple(Planned(name) for name in SETS)),)
TEXT = """schema = 1
[study]
name = "patch"
responses = ["different", "similar", "close"]
[parameters.hue]
low = 0.0
high = 360.0
unit = "deg"
[parameters.light]
low = 20.0
high = 80.0
unit = "%"
[gp]
theta = 10.0
variance = 1.0
thresholds = [-0.5, 0.5]
noise = 0.5
[selection]
space_filling = 3
trials = 6
[stimulus]
within = {within}
silence = {silence}
tolerance = {{hue = 0.5}}
"""


def module(name):
    """A file of clients/, as its users have it: beside their program."""
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, CLIENTS / f"{name}.py")
    loaded = importlib.util.module_from_spec(spec)
    sys.modules[name] = loaded
    spec.loader.exec_module(loaded)
    return loaded


class LiveStimulus(Live):
    """`with LiveStimulus(folder) as live:` - comparisons of two parameters; a program joins with `live.join()`.

    `felt` is how long a test rendering may be felt in s, if that is another time than the other steps take.
    """

    def __init__(
        self,
        folder: Path,
        within: float = 60.0,
        silence: float = 60.0,
        more: str = "",
        felt: float | None = None,
        **others,
    ):
        self.text, self.felt = TEXT.format(within=within, silence=silence) + more, felt
        super().__init__(folder, **others)

    def make_study(self, seconds, warm_up):
        shows = {
            "warm_up": ("reference", "a"),
            "optimisation": ("reference", "a"),
            "validation": ("reference", "a", "neutral", "b"),
        }
        for name, steps in shows.items():
            felt = seconds if self.felt is None else self.felt
            listed = ", ".join(
                f'{{show = "{show}", seconds = {felt if show in ("a", "b") else seconds}}}' for show in steps
            )
            self.text += f"[session.{name}]\nsteps = [{listed}]\n"
        file = self.folder / "study.toml"
        file.write_text(self.text)
        return Study.load(file)

    def sets(self):
        return SETS

    def rig(self):
        return functools.partial(StimulusRig, self.study.file, "tag")

    def link(self):
        """A new one for the stimulus."""
        return self.place.link("stimulus")

    def by_hand(self, **said) -> "ByHand":
        """A program that has joined, and says what the test says."""
        return ByHand(self.link(), **said)

    def present(self) -> "Presenter":
        """A program that presents all it is asked for, by the client that is shipped."""
        return Presenter(self.link())


def all_answered(live):
    """The participant takes part to the end, and presses Begin whenever that is asked for."""

    def acted():
        view = live.view()
        if view["may"]["begin"]:
            live.participant.post("/api/participant/begin", {})
        elif view["questions"]:
            try:
                live.answer(view)
            except urllib.error.HTTPError as error:
                if (
                    error.code != HTTPStatus.CONFLICT
                ):  # else the trial was voided since the look, and the page looks again
                    raise
        return view

    live.until(lambda view: view["phase"] == "done", acted)
    live.replays()
    return [event.data for event in live.events("sent")]


class LiveLevels(LiveStimulus):
    """The same with a parameter of levels between the two."""

    def make_study(self, seconds, warm_up):
        table = '[parameters.texture]\nlevels = ["silk", "wood", "smooth stone"]\n'
        self.text = self.text.replace("[parameters.light]", table + "[parameters.light]")
        return super().make_study(seconds, warm_up)

    def sets(self):
        return {name: values | {"texture": float(k)} for k, (name, values) in enumerate(SETS.items())}


class ByHand(Client):
    """A program with the stimulus's key, report by report; or in the place of the preparer's page."""

    role = "stimulus"

    def __init__(self, link, name="by hand", version="7", force=False, neutral_within_s=1.0, ready=True):
        super().__init__(link)
        self.said = {"name": name, "version": version, "force": force, "neutral_within_s": neutral_within_s}
        self.hello()
        if ready:
            self.report("neutral")

    def hello(self):
        self.order = self.post(f"/api/{self.role}/hello", self.said)
        self.run = self.order["run"]
        return self.order

    def report(self, state, order=None, **more):
        """A report about the newest order that it knows, or another one; keeps what it is told."""
        number = self.order["order"] if order is None else order
        if state == "presented":
            more = {"trial": self.order.get("trial")} | more
        self.order = self.post(f"/api/{self.role}", {"run": self.run, "order": number, "state": state, **more})
        return self.order

    def until(self, live, wanted):
        """Asks until it is given an order of which `wanted(order)` is true."""
        return live.until(wanted, lambda: self.report("busy" if self.order["do"] == "present" else "neutral"))

    def asked(self, live, show="test"):
        """The next order to present this, everything before it confirmed."""

        def look():
            order = self.order
            if order["do"] != "present":
                return self.report("neutral")
            if order["show"] == show:
                return order
            return self.report("presented", **({"values": order["values"]} if order["values"] else {}))

        return live.until(lambda order: order["do"] == "present" and order["show"] == show, look)


class Presenter:
    """Presents what it is asked for, each value off by what `off` says; in a thread."""

    def __init__(self, link, off=0.0, **said):
        client = module("hilbo_stimulus")
        self.shown, self.off, self.out = [], off, client.StimulusError
        self.stimulus = client.Stimulus(link, name="presenter", version="1.2", **said)
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def _run(self):
        with contextlib.suppress(self.out):
            for order in self.stimulus:
                if order.do == "present":
                    self.shown.append(order)
                    values = order.values | ({"hue": order.values["hue"] + self.off} if order.values else {})
                    self.stimulus.presented(values or None)
                else:
                    self.stimulus.neutral()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.stimulus.close()
        self.thread.join(10)
