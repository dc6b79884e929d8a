"""A simulated participant in a real browser, for `hilbo simulate --live` and the browser tests.

Playwright drives the Chromium of this computer, without a window, as a person would: it opens the link, presses Begin,
feels (the simulated device's finger presses while a rendering is presented), reads the question, and presses a key.
It reads the stimulus from the experimenter's JSON, which no participant has.
"""

import contextlib
import io
import json
import shutil
import tempfile
import urllib.error
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
    """Path of Chromium or Chrome on this computer; None without one, or without playwright to drive it."""
    import importlib.util

    if importlib.util.find_spec("playwright") is None:
        return None
    return next((path for name in BROWSERS if (path := shutil.which(name))), None)


@contextlib.contextmanager
def browser() -> Iterator[Any]:
    """A browser without a window and with an empty profile, closed at the end. Raises `InputError` where `find_browser`
    gives None."""
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
    """A program with a role's key, which uses the JSON interface with the standard library. To make one redeems the
    link, which works once."""

    def __init__(self, link: str):
        self.address, _, token = link.partition("/#")
        self._key = ""
        self._key = self.post("/api/join", {"token": token, "bearer": True})["key"]

    def get(self, path: str) -> Any:
        """The JSON response to a GET. Raises `urllib.error.HTTPError` for a status of an error."""
        return self._ask(urllib.request.Request(self.address + path, headers=self._headers()))

    def post(self, path: str, content: dict[str, Any]) -> Any:
        """The JSON response to a POST. Raises `urllib.error.HTTPError` for a status of an error."""
        body = json.dumps(content).encode()
        return self._ask(urllib.request.Request(self.address + path, data=body, headers=self._headers()))

    def _headers(self) -> dict[str, str]:
        """Headers of a request, with the key once there is one."""
        return {"Content-Type": "application/json"} | ({"Authorization": f"Bearer {self._key}"} if self._key else {})

    @staticmethod
    def _ask(request: urllib.request.Request) -> Any:
        """Send a request and return its JSON response; waits up to 60 s. An `HTTPError` has its content in memory, so
        that no connection stays open until it is collected."""
        try:
            with urllib.request.urlopen(request, timeout=60) as reply:
                return json.load(reply)
        except urllib.error.HTTPError as error:
            with error:
                content = io.BytesIO(error.read())
            raise urllib.error.HTTPError(error.url, error.code, error.msg, error.headers, content) from None


class Participant:
    """The participant's page in a browser's window, and what a person does with it.

    `watch()` returns the experimenter's view; `decide(trial, ask)` the label to choose, for the pending trial of that
    view; `feel(on)` is called with whether a rendering is presented. `answered` counts the answered trials. To make one
    opens the link.
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
        """The phase that the page shows, such as "step" or "answer"."""
        return self.window.evaluate("document.body.dataset.phase")

    def act(self) -> str:
        """Do what a person would do now: feel, answer the questions, press the button to go on, or nothing. Returns the
        phase before that."""
        phase = self.phase
        self._feel(phase == "step" and self._rendering())
        if self.window.is_visible("#options"):
            self._answer()
        elif self.window.is_visible("#go"):
            with contextlib.suppress(Exception):  # gone meanwhile
                self.window.click("#go", timeout=1000)
        return phase

    def _rendering(self) -> bool:
        """Whether the page shows a step with a rendering, a or b."""
        return self.window.evaluate("!!(view && view.step && ['a', 'b'].includes(view.step.show))")

    def _answer(self) -> None:
        """Answer all open questions by the number keys, each once the page accepts keys, and count the trial in
        `answered`; stops if a question is gone, and does nothing without a pending trial."""
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
        """The pending trial of the experimenter's view, or None."""
        whole = self._watch()["whole"]
        return next((t for t in whole["trials"] if t["id"] == whole["pending"]), None)


SIZES = ((1440, 900), (1024, 768), (800, 1280), (390, 844))
"""Width and height in pixels: a desk, a tablet both ways up, a phone."""

_HOLD = "() => { window.drawing ??= draw; draw = () => {}; }"
_GO_ON = "() => { draw = window.drawing; draw(); }"


@contextlib.contextmanager
def held(window: Any) -> Iterator[None]:
    """Within the block the page is not redrawn for messages of the server, so that its text and its
    screenshots agree."""
    window.evaluate(_HOLD)
    try:
        yield
    finally:
        window.evaluate(_GO_ON)


def screenshots(window: Any, folder: Path, name: str, whole: bool = False) -> list[Path]:
    """Write a PNG of the page at each size of `SIZES`, NAME-WIDTHxHEIGHT.png, and return the paths. `whole`: the full
    page, beyond the window's edge. The window then has the first size."""
    made = []
    for width, height in SIZES:
        window.set_viewport_size({"width": width, "height": height})
        window.wait_for_timeout(100)
        made.append(folder / f"{name}-{width}x{height}.png")
        window.screenshot(path=made[-1], animations="disabled", full_page=whole)
    window.set_viewport_size(dict(zip(("width", "height"), SIZES[0], strict=True)))
    return made
