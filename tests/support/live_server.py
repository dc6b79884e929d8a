"""A live session for tests: the real server in a thread, on a simulated device, with planned trials of short steps."""

import asyncio
import contextlib
import functools
import http.client
import io
import threading
import time
import urllib.error
import urllib.request
from pathlib import Path

import pytest
import uvicorn.server

from hilbo.app.hub import interruptions, runner
from hilbo.app.hub.hub import Hub
from hilbo.app.rehearsal.rehearsal import example_sets, fast_study
from hilbo.app.rehearsal.robot import Client
from hilbo.app.rigs import device_rig
from hilbo.app.rigs.device_rig import DeviceRig
from hilbo.app.server import serve
from hilbo.device import messages
from hilbo.device.link import Link
from hilbo.device.ports import BAUD, open_port
from hilbo.errors import InputError
from hilbo.hardware_bridge import Renderer, State
from hilbo.session.choose.look_ahead import LiveChooser
from hilbo.session.log.event_log import EventLog, read_log
from hilbo.session.log.records import Header
from hilbo.session.log.state import LiveSession
from hilbo.simulation.presets import preset_of
from hilbo.study.config import Study
from hilbo.study.file.plan_file import Block, Planned

__all__ = ["DATA", "PATIENCE", "Live", "ask", "check_blinding", "listen", "refused", "study_of", "until_held"]

DATA = Path(__file__).parents[2] / "hilbo" / "data" / "paper.toml"
PATIENCE = 120.0  # s: how long a test waits for what must come; no test asserts a time


class _Hasty:
    """asyncio for uvicorn, which looks every 0.1 s whether it is to end and then waits as long: a tenth of that."""

    def __getattr__(self, name):
        return getattr(asyncio, name)

    async def sleep(self, seconds):
        await asyncio.sleep(seconds / 10)


SOONER = (
    (uvicorn.server, "asyncio", _Hasty()),
    (device_rig, "_POLL", 0.03),
    (device_rig, "_RETRY", 0.1),
    (runner, "_LATER", 0.1),
    (interruptions, "_LATER", 0.1),
)
PAIRS = (Planned("best", "mid"), Planned("worst", "best", "b"), Planned("mid", "worst"))


def study_of(folder: Path, seconds: float = 0.02, warm_up: str = "") -> Study:
    """The paper's study, its steps as short as can be; `warm_up` replaces the steps of that phase."""
    file = fast_study(DATA, folder / "study.toml", seconds, 2)
    head, own, rest = file.read_text().partition("[session.warm_up]\n")
    if warm_up:
        file.write_text(head + own + warm_up + rest[rest.index("\n") :])
    return Study.load(file)


class Live:
    """`with Live(folder) as live:` - a session of comparisons, its hub, and a client for each role.

    Without `warm` it goes on compiling until `warmed` is set.
    """

    def __init__(
        self,
        folder: Path,
        *,
        blocks=None,
        seconds: float = 0.02,
        repeats: int = 4,
        device="sim",
        warm: bool = True,
        warm_up="",
        maps=None,
    ):
        self.maps = maps
        self.folder, self.device, self.warmed = folder, device, threading.Event()
        if warm:
            self.warmed.set()
        self.study = self.make_study(seconds, warm_up)
        self.blocks = blocks or (Block("validation", 3 * repeats, PAIRS * repeats),)
        self.path = folder / "P01_1.session.jsonl"
        self.failed: list[BaseException] = []
        self._sooner = pytest.MonkeyPatch()

    def make_study(self, seconds: float, warm_up: str) -> Study:
        """What is asked."""
        return study_of(self.folder, seconds, warm_up)

    def sets(self):
        """What is compared."""
        return example_sets(self.study, preset_of("paper"))

    def rig(self):
        """Makes what shows renderings."""
        return functools.partial(DeviceRig, self.study.file, self.connect)

    def header(self) -> Header:
        """What the log begins with."""
        sets = self.sets()
        return Header(study=self.study.file.hash, participant="P01", session="1", seed=0, blocks=self.blocks, sets=sets)

    def connect(self) -> Renderer:
        """The device."""
        options = {"finger": "none"} if self.device == "sim" else None
        return Renderer.open(self.device, options=options, patience=10.0)

    def __enter__(self) -> "Live":
        for module, name, value in SOONER:  # what a session waits for a second, or a tenth of one, at a time
            self._sooner.setattr(module, name, value)
        resumed = self.path.exists()
        self.log = (
            EventLog.resume(self.path, self.study.file)
            if resumed
            else EventLog.create(self.path, self.study.file, self.header())
        )
        self.place = serve.bound(0, keys=self.folder / "keys")
        chooser = LiveChooser(self.log.state)
        compiled = chooser.warm
        chooser.warm = lambda: (self.warmed.wait(PATIENCE), compiled())
        self.hub = Hub(self.log, chooser, self.rig(), tag="tag", maps=self.maps, gap=0.0)
        self.hub.invite = lambda role: {"link": self.place.link(role), "qr": ""}
        ready = threading.Event()
        self.thread = threading.Thread(target=self._serve, args=(ready,))
        self.thread.start()
        assert ready.wait(PATIENCE) and not self.failed, self.failed
        links = self.place.links()
        self.participant, self.experimenter = Client(links["participant"]), Client(links["experimenter"])
        return self

    def _serve(self, ready) -> None:
        def started(stop):
            self.stop = stop
            ready.set()

        try:
            serve.serve(self.place, self.hub, started)
        except BaseException as error:
            self.failed.append(error)
            ready.set()

    def __exit__(self, *_) -> None:
        self.warmed.set()
        self.stop()
        self.thread.join(PATIENCE)
        self._sooner.undo()
        self.log.close()
        assert not self.thread.is_alive()

    # What participants and experimenters do.

    def until(self, wanted, look=None):
        """The first view of which `wanted(view)` is true; the participant's, unless `look` gives another."""
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            view = (look or self.view)()
            if wanted(view):
                return view
            time.sleep(0.01)
        raise AssertionError(f"never came; the last view is {view}")

    def view(self):
        """The participant's."""
        return self.participant.get("/api/participant")

    def whole(self):
        """The experimenter's."""
        return self.experimenter.get("/api/experimenter")

    def begin(self) -> None:
        """Press Begin, as the page does."""
        trial = self.until(lambda view: view["may"]["begin"])["trial"]
        self.participant.post("/api/participant/begin", {"trial": trial and trial["id"]})

    def question(self):
        """The view, once something is asked."""
        return self.until(lambda view: view["questions"])

    def message(self, view, client="me", **changes):
        """An answer to what a view asks: each question's first option."""
        answers = {q["name"]: q["options"][0]["value"] for q in view["questions"]}
        return {"trial": view["trial"]["id"], "client": client, "answers": answers, "response_ms": 12.5} | changes

    def answer(self, view=None, **changes):
        """Answer what is asked."""
        return self.participant.post("/api/participant/answer", self.message(view or self.question(), **changes))

    def command(self, name, **content):
        """An experimenter's command; a refusal's sentence stands in the traceback."""
        try:
            return self.experimenter.post(f"/api/experimenter/{name}", content)
        except urllib.error.HTTPError as error:
            sentence = error.read()
            again = urllib.error.HTTPError(error.url, error.code, error.msg, error.headers, io.BytesIO(sentence))
            again.add_note(sentence.decode())
            raise again from None

    def events(self, kind=None):
        """What is in the log, on the disk."""
        return [event for event in read_log(self.path, self.study.file)[1] if kind in (None, event.kind)]

    def device_did(self, *conditions: str) -> None:
        """Waits until the log says so: the pages show what a device did before the log holds it."""
        self.until(lambda told: told == list(conditions), lambda: [e.data["condition"] for e in self.events("device")])

    def replayed(self) -> LiveSession:
        """The state that the log alone gives."""
        header, events, _ = read_log(self.path, self.study.file)
        return LiveSession.fold(self.study.file, header, events)

    def replays(self) -> None:
        """Waits until the log alone gives the state; the session may go on meanwhile."""
        self.until(lambda _: self.replayed() == self.hub.state, lambda: "the log gives another state")


def ask(live, path, *, data=None, **headers):
    """A bare request."""
    address = live.participant.address + path
    return urllib.request.urlopen(urllib.request.Request(address, data=data, headers=headers), timeout=PATIENCE)


def listen(live, heard):
    """Everything that comes as server-sent events, until the server ends; and the page itself."""
    key = {"Authorization": f"Bearer {live.participant._key}"}
    with (
        ask(live, "/api/participant/events", **key) as stream,
        contextlib.suppress(OSError, http.client.HTTPException),
    ):
        for kind in ("html", "js"):
            with ask(live, f"/static/participant.{kind}") as page:
                heard.append(page.read().decode())
        for line in stream:
            heard.append(line.decode())


def check_blinding(heard, state, *names):
    """Nothing of what a participant must not know is in what their browser was told."""
    words = ["best", "mid", "worst", "mean", "margin", "certificate", "renderings", "choice", *names]
    for word in [*words, "passiv", "probabilit", "aggregate", "individual", "validation"]:
        assert word not in heard, word
    pairs = [(trial.renderings, trial.presented) for trial in state.trials]
    for values in [values for pair in pairs for sides in pair for values in sides.values()]:
        for value in values.values():
            assert f"{value:.4g}" not in heard
            assert str(value) not in heard


@contextlib.contextmanager
def refused(status: int, words: str = ""):
    """What is done within must be answered with this status, and one sentence; `words` are in it."""
    with pytest.raises(urllib.error.HTTPError) as caught:
        yield
    with caught.value as error:
        text = error.read().decode()
    assert caught.value.code == status, text
    assert '"error"' in text
    assert words in text


def until_held(port: str) -> None:
    """Waits until a device that nobody talks to any more is in HOLD."""
    end = time.monotonic() + PATIENCE
    while True:
        assert time.monotonic() < end
        with contextlib.suppress(InputError):  # whoever sent heartbeats may still be dying
            link = Link(open_port(port, BAUD), patience=5.0)
            try:
                if link.request(messages.GetStatus()).state == State.HOLD:
                    return
            finally:
                link.close()
        time.sleep(0.02)
