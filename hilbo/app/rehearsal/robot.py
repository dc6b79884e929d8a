"""A simulated participant in a real browser: what `hilbo simulate --live` and the browser tests are driven by.

Chromium of this computer, without a window, is told by playwright what a person would do: open the link, press Begin,
feel (the simulated device's finger presses while a rendering is shown), read the question, choose a button or a key.
What it felt, the robot learns from the experimenter's JSON, which no participant has.
"""

import contextlib
import json
import shutil
import tempfile
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from hilbo.errors import InputError

__all__ = ["BROWSERS", "SIZES", "Client", "Participant", "browser", "find_browser", "held", "screenshots"]

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
_ARGUMENTS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-dev-shm-usage",
]
_PATIENCE = 120_000  # ms


def find_browser() -> str | None:
    """Chromium or Chrome on this computer, if playwright is there to drive it."""
    import importlib.util

    if importlib.util.find_spec("playwright") is None:
        return None
    return next((path for name in BROWSERS if (path := shutil.which(name))), None)


@contextlib.contextmanager
def browser() -> Iterator[Any]:
    """A browser without a window and without a past. Raises `InputError` where there is none."""
    program = find_browser()
    if program is None:
        raise InputError(
            "A simulated participant needs Chromium and playwright; install them (Debian: apt install chromium;"
            " pip install 'hilbo[browser]')."
        )
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver, tempfile.TemporaryDirectory() as home:
        opened = driver.chromium.launch(
            executable_path=program, headless=True, args=_ARGUMENTS, env={"HOME": home, "PATH": "/usr/bin:/bin"}
        )
        try:
            yield opened
        finally:
            opened.close()


class Client:
    """A program with a role's key: the JSON interface, spoken with the standard library."""

    def __init__(self, link: str):
        self.address, _, token = link.partition("/#")
        self._key = ""
        self._key = self.post("/api/join", {"token": token, "bearer": True})["key"]

    def get(self, path: str) -> Any:
        """The answer to a GET."""
        return self._ask(urllib.request.Request(self.address + path, headers=self._headers()))

    def post(self, path: str, content: dict[str, Any]) -> Any:
        """The answer to a POST."""
        body = json.dumps(content).encode()
        return self._ask(urllib.request.Request(self.address + path, data=body, headers=self._headers()))

    def _headers(self) -> dict[str, str]:
        return {"Content-Type": "application/json"} | ({"Authorization": f"Bearer {self._key}"} if self._key else {})

    @staticmethod
    def _ask(request: urllib.request.Request) -> Any:
        with urllib.request.urlopen(request, timeout=60) as reply:
            return json.load(reply)


class Participant:
    """The participant's page in a browser's window, and what a person does with it.

    `decide(trial, ask)` gives the label to choose; `trial` is the pending one of the experimenter's view. `feel(on)` is
    told when a rendering is shown.
    """

    def __init__(
        self,
        window: Any,
        link: str,
        watch: Callable[[], dict[str, Any]],
        decide: Callable[[dict[str, Any], str], str],
        feel: Callable[[bool], Any] = lambda _: None,
    ):
        self.window, self._watch, self._decide, self._feel = window, watch, decide, feel
        self.answered = 0
        window.set_default_timeout(_PATIENCE)
        window.goto(link)
        window.wait_for_url("**/participant")

    @property
    def phase(self) -> str:
        """Of the page."""
        return self.window.evaluate("document.body.dataset.phase")

    def act(self) -> str:
        """What a person would do now, if anything; the page's phase before."""
        phase = self.phase
        self._feel(phase == "step" and self._rendering())
        if self.window.is_visible("#options"):
            self._answer()
        elif self.window.is_visible("#go"):
            with contextlib.suppress(Exception):  # gone meanwhile
                self.window.click("#go", timeout=1000)
        return phase

    def _rendering(self) -> bool:
        return self.window.evaluate("!!(view && view.step && ['a', 'b'].includes(view.step.show))")

    def _answer(self) -> None:
        trial = self._pending()
        if trial is None:
            return
        names = self.window.evaluate("view && view.questions ? view.questions.slice(asked).map(q => q.name) : []")
        for name in names:
            value = self._decide(trial, name)
            key = self.window.evaluate(
                "([n, v]) => { const q = view && view.questions && view.questions.find(q => q.name === n);"
                " return q ? q.options.findIndex(o => o.value === v) + 1 : 0; }",
                [name, value],
            )
            if not key:
                return
            while not self.window.evaluate("performance.now() - laidOut > SETTLES"):  # sooner the page takes no key
                self.window.wait_for_timeout(20)
            self.window.keyboard.press(str(key))
        self.answered += bool(names)

    def _pending(self) -> dict[str, Any] | None:
        whole = self._watch()["whole"]
        return next((t for t in whole["trials"] if t["id"] == whole["pending"]), None)


SIZES = ((1440, 900), (1024, 768), (800, 1280), (390, 844))
"""Width and height in pixels: a desk, a tablet both ways up, a phone."""

_HOLD = "() => { window.drawing ??= draw; draw = () => {}; }"
_GO_ON = "() => { draw = window.drawing; draw(); }"


@contextlib.contextmanager
def held(window: Any) -> Iterator[None]:
    """The page stays as it is, whatever the server tells it meanwhile: what is read from it and pictures belong
    together."""
    window.evaluate(_HOLD)
    try:
        yield
    finally:
        window.evaluate(_GO_ON)


def screenshots(window: Any, folder: Path, name: str, whole: bool = False) -> list[Path]:
    """The page as every size of `SIZES` has it; `whole`: with what is below the screen's edge."""
    made = []
    for width, height in SIZES:
        window.set_viewport_size({"width": width, "height": height})
        window.wait_for_timeout(100)
        made.append(folder / f"{name}-{width}x{height}.png")
        window.screenshot(path=made[-1], animations="disabled", full_page=whole)
    window.set_viewport_size(dict(zip(("width", "height"), SIZES[0], strict=True)))
    return made
