"""Present the stimuli of a hilbo session from a program of your own.

hilbo does not guard your actuators, and certifies nothing about them. If your program moves something that people
touch, an independent hardware stop within reach of the hand must be provided by you.

One file, for Python 3.9 or newer, which needs nothing but the standard library: copy it next to your program.

    from hilbo_stimulus import Stimulus

    with Stimulus("http://127.0.0.1:8642/#…", name="my scene", version="1.0") as stimulus:
        for order in stimulus:
            if order.do == "present":
                show(order.show, order.values)       # "test" with values, "reference" without
                stimulus.presented()                 # or presented({"height": 540.0}): the values really presented
            else:
                blank()
                stimulus.neutral()

With asyncio: `async for order in stimulus.orders()`, and `await asyncio.to_thread(stimulus.presented)`.

A program that moves something says `force=True` and gives `go_neutral`, a function that takes away all force. It is
called in a thread of this module, as soon as the server orders it, or has been silent for the time that it states
(`silence_s`, 1 s by default), or its connection fails; so it may be called while your own loop is busy, and often.
Set `stimulus.contact = True` while a hand touches it: no order to present is handed to you until that is over.
docs/guides/stimulus.md of hilbo has the protocol.
"""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import json
import logging
import math
import os
import socket
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from typing import Any, NamedTuple
from urllib.parse import urlsplit

__all__ = ["Order", "Stimulus", "StimulusError"]

_FORCE_WAIT = 0.05  # s between two reports of a program that moves something: its contact has to be known
_AGAIN = 0.2  # s until a server that does not answer is asked again
_JOIN = 10.0  # s that the first answer may take
_log = logging.getLogger("hilbo_stimulus")


class StimulusError(RuntimeError):
    """The session does not let this program in, or has ended its part; the message gives the reason."""


class Order(NamedTuple):
    """What the program has to show from now on, to be confirmed within `within_s`.

    `do`: "present", "neutral" (show nothing, push nothing) or "stop" (the same, at once). `show`: "test", with the
    `values` of its parameters in the study's units (names for levels), or "reference"; `side`: "a" or "b" where two
    tests are compared.
    """

    number: int
    do: str
    show: str = ""
    side: str = ""
    trial: str = ""
    step: int = 0
    values: Mapping[str, Any] = {}
    within_s: float = 0.0


_SILENCE = Order(0, "neutral")  # before a server has spoken, and after one is silent


class Stimulus:
    """Connection of this program to a session, kept by two separate threads until `close`.

    `link`: the one that `hilbo session` prints for the stimulus, for one program at a time. `force`: the program moves
    something that people touch; it must then give `go_neutral`, a function that takes all force away and is called in a
    thread of this class. `neutral_within_s`: time (s) within which everything is neutral after `go_neutral` was called
    or after an order; it is reported to the session. `key_file`: file, readable by you alone, in which the key that the
    link was traded for is kept: a program that is started again with it may go on, and waits, with one warning, until
    the one before has been silent. Raises `StimulusError` if the session does not let it in, ValueError for `force`
    without `go_neutral`, OSError without a connection.
    """

    def __init__(
        self,
        link: str,
        name: str,
        version: str = "",
        *,
        force: bool = False,
        go_neutral: Callable[[], Any] | None = None,
        neutral_within_s: float = 1.0,
        key_file: str | None = None,
    ):
        if force and go_neutral is None:
            raise ValueError("A program with force gives go_neutral, a function that takes all force away.")
        self._hello = {"name": name, "version": version, "force": force, "neutral_within_s": neutral_within_s}
        self._go_neutral, self._contact = go_neutral, False
        self._address = urlsplit(link).netloc
        self._key = self._keyed(urlsplit(link).fragment, key_file)
        self.parameters: list = []  # of the study: name, unit, low, high, tolerance; or name and levels
        self.silence_s, self._run = 1.0, ""
        self._changed = threading.Condition()
        self._order, self._handed = _SILENCE, _SILENCE
        self._done = (0, "busy")  # the newest order that something was done about, and what
        self._heard = time.monotonic()
        self._why: str | None = None
        self._waits = ""  # for what, since the last time that it was said
        self._closed = False
        self._lines: dict = {}  # thread -> its connection
        self._thread = threading.Thread(target=self._talk, name="hilbo-stimulus", daemon=True)
        self._watch = threading.Thread(target=self._listen, name="hilbo-silence", daemon=True)
        self._thread.start()
        self._watch.start()

    # What your program does.

    @property
    def order(self) -> Order:
        """The newest order, for programs that look at every frame; "neutral" while no server has given one."""
        return self._order

    @property
    def contact(self) -> bool:
        """Whether a hand touches the moving part, set by your program.

        With `force`, orders to present are withheld by `next` meanwhile.
        """
        return self._contact

    @contact.setter
    def contact(self, yes: bool) -> None:
        with self._changed:
            self._contact = yes
            self._changed.notify_all()

    def next(self, timeout: float | None = None) -> Order | None:
        """Wait for the newest order that was not returned yet; None after `timeout` s, or once closed.

        No `timeout`: wait as long as it takes. Raises `StimulusError` when this program is no longer part of the
        session.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._why or self._is_due(), timeout)
            if self._why:
                raise StimulusError(self._why)
            if self._closed or not self._is_due():
                return None
            self._handed = self._order
            return self._handed

    def __iter__(self) -> Iterator[Order]:
        """Yield orders until `close`; if several came at once only the newest. Raises `StimulusError` as `next`."""
        while True:
            order = self.next(0.5)
            if order is not None:
                yield order
            elif self._closed:
                return

    async def orders(self) -> AsyncIterator[Order]:
        """Yield orders as `__iter__` does, for asyncio; each wait takes a thread of the loop's executor."""
        while True:
            order = await asyncio.get_running_loop().run_in_executor(None, self.next, 0.5)
            if order is not None:
                yield order
            elif self._closed:
                return

    def presented(self, values: Mapping[str, Any] | None = None) -> bool:
        """Confirm that what the last order asked for is shown from now on; whether the session accepted that.

        `values`: what is really shown, by default what the order asked for. False if it came too late or is too far off
        (the trial is void then), or if the connection failed. Raises ValueError for a value that is not finite.
        """
        order = self._handed
        found = dict(order.values if values is None else values)
        for name, value in found.items():
            if not isinstance(value, str) and not math.isfinite(value):
                raise ValueError(f"{name} is {value}, which is no number.")
        return self._say(order, "presented", **({"values": found} if found else {}))

    def neutral(self) -> bool:
        """Confirm that nothing is shown, and nothing pushes, from now on; whether the session accepted that."""
        return self._say(self._handed, "neutral")

    def failed(self, why: str) -> bool:
        """Report that the last order cannot be carried out, and why: the trial is void. Whether that was accepted."""
        return self._say(self._handed, "failed", why=why[:500])

    def begin_again(self, why: str) -> None:
        """Report that a device has stopped by itself, and why: the trial is void.

        `go_neutral` is called, and the program registers with the session again.
        """
        self._lost(why)

    def close(self) -> None:
        """Call `go_neutral`, end the connections and wait for the threads; nothing is reported to the session."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._neutral_now()
        for line in list(self._lines.values()):
            with contextlib.suppress(OSError, AttributeError):  # so that nobody waits for an answer
                line.sock.shutdown(socket.SHUT_RDWR)
        for thread in (self._thread, self._watch):
            if thread is not threading.current_thread():
                thread.join(2 * self.silence_s)
        for line in list(self._lines.values()):
            line.close()

    def __enter__(self) -> Stimulus:
        """Return this object."""
        return self

    def __exit__(self, *_: Any) -> None:
        """Close, also after an exception."""
        self.close()

    # What goes on beside it.

    def _is_due(self) -> bool:
        """Whether there is an order that `next` has not returned yet and that may be returned now (see `contact`)."""
        waits = self._hello["force"] and self.contact and self._order.do == "present"
        return self._order is not self._handed and not waits

    def _talk(self) -> None:
        """Body of the first thread: register, then report the state regularly and receive orders, until the end."""
        while not self._closed and not self._why:
            try:
                if not self._run:
                    self._begin()
                else:
                    order, (number, state) = self._order, self._done
                    wait = _FORCE_WAIT if self._hello["force"] else self.silence_s / 3
                    self._report(order, state if number == order.number else "busy", wait_s=wait)
            except (OSError, http.client.HTTPException, ValueError) as error:
                self._lost(str(error) or type(error).__name__)
                time.sleep(_AGAIN)

    def _listen(self) -> None:
        """Body of the second thread: go neutral as soon as the server has been silent for longer than `silence_s`."""
        while not self._closed:
            time.sleep(min(0.05, self.silence_s / 10))
            if self._run and time.monotonic() - self._heard > self.silence_s:
                self._lost(f"the server has been silent for {self.silence_s:g} s")

    def _begin(self) -> None:
        """Register this program with the session and take its first order.

        If the session refuses for good, end; if another program still has the place, warn once and return after a
        pause.
        """
        status, found = self._post("/api/stimulus/hello", self._hello)
        if status == 200:
            self._hello["run"] = found["run"]  # if it is lost, its own place is taken at once
            self.silence_s, self.parameters = found["silence_s"], found["parameters"]
            self._heard, self._run = time.monotonic(), found["run"]
            self._take(found["run"], found)
            self._waits = ""
        elif status in (400, 401, 403):
            self._end(found["error"])
        else:
            if found["error"] != self._waits:
                _log.warning("waiting: %s", found["error"])
            self._waits = found["error"]
            time.sleep(_AGAIN)

    def _say(self, order: Order, state: str, **more: Any) -> bool:
        """Send a report from the program's own thread; whether it was accepted.

        False without sending for an order that is no longer the newest; True without sending for one that no server
        gave. A failed connection makes everything neutral.
        """
        if order.number != self._order.number:
            return False  # it is over; the next one is there already
        if not order.number:
            return True  # there is no server to send it to
        try:
            taken = self._report(order, state, **more)
        except (OSError, http.client.HTTPException, ValueError) as error:
            self._lost(str(error) or type(error).__name__)
            return False
        if taken:
            self._done = (order.number, state)
        return taken

    def _report(self, order: Order, state: str, **more: Any) -> bool:
        """Send one report and take the order in the reply; whether the report was accepted.

        Not sent while the program is not registered. A refusal for good ends this program's part, other conflicts make
        it register again.
        """
        run = self._run
        if not run:
            return False
        report = {"run": run, "order": order.number, "state": state, "contact": bool(self.contact), **more}
        if state == "presented":
            report["trial"] = order.trial
        status, found = self._post("/api/stimulus", report)
        if status != 200:
            _log.warning("%s", found.get("error", status))
        if status in (401, 403):
            self._end(found["error"])
        elif "order" in found:
            self._take(run, found)
        elif status == 409:  # another server, or one that gave this program up
            self._lost(found["error"])
        return status == 200

    def _take(self, run: str, found: Mapping[str, Any]) -> None:
        """Store a newer order of the current registration (`run`); call `go_neutral` if it is not to present."""
        with self._changed:
            if run != self._run:
                return  # it came after the silence
            self._heard = time.monotonic()
            if found["order"] <= self._order.number:
                return
            rest = {key: found[key] for key in Order._fields[2:] if key in found}
            self._order = order = Order(found["order"], found["do"], **rest)
            self._changed.notify_all()
        if order.do != "present" and self._go_neutral is not None and self._neutral_now():
            self._done = (order.number, "neutral")

    def _neutral_now(self) -> bool:
        """Call `go_neutral`, if given; False, with a log entry, if it raised an exception."""
        try:
            if self._go_neutral is not None:
                self._go_neutral()
            return True
        except Exception:
            _log.exception("go_neutral failed")
            return False

    def _lost(self, why: str) -> None:
        """Give up the registration: the order becomes "neutral", `go_neutral` is called, and `why` is logged.

        Nothing happens if the program is not registered or is closed.
        """
        with self._changed:
            if not self._run or self._closed:
                return
            self._run, self._order = "", Order(0, "neutral")
            self._changed.notify_all()
        _log.warning("neutral: %s", why)
        self._neutral_now()

    def _end(self, why: str) -> None:
        """End this program's part for good: call `go_neutral`; `next` raises `StimulusError` with `why` from now on."""
        with self._changed:
            self._why = why
            self._changed.notify_all()
        self._neutral_now()

    # The line.

    def _keyed(self, token: str, file: str | None) -> str:
        """Key for this session: from the key `file` if it was made with this link, else traded for the link's token.

        A new key is written to the file. Raises `StimulusError` for a link that is not valid.
        """
        kept = {}
        if file:  # opened first: the key that the link is traded for has to go somewhere
            with open(os.open(file, os.O_RDWR | os.O_CREAT, 0o600), encoding="utf-8") as opened:
                kept = _read(opened.read())
        if kept.get("token") == token and kept.get("address") == self._address:
            return kept["key"]
        with contextlib.closing(http.client.HTTPConnection(self._address, timeout=_JOIN)) as line:
            status, found = _asked(line, "/api/join", {"token": token, "bearer": True}, {})
        if status != 200 or found.get("role") != "stimulus":
            raise StimulusError(found.get("error", "This link is not the one for the stimulus."))
        if file:
            with open(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w", encoding="utf-8") as opened:
                json.dump({"address": self._address, "token": token, "key": found["key"]}, opened)
        return found["key"]

    def _post(self, path: str, content: Mapping[str, Any]) -> tuple:
        """Send JSON to the server on this thread's own connection; HTTP status and content of the reply.

        A connection that fails is closed, and the exception raised.
        """
        me = threading.get_ident()
        line = self._lines.get(me) or http.client.HTTPConnection(self._address, timeout=self.silence_s)
        self._lines[me], line.timeout = line, self.silence_s
        if line.sock is not None:
            line.sock.settimeout(self.silence_s)
        try:
            return _asked(line, path, content, {"Authorization": f"Bearer {self._key}"})
        except BaseException:
            self._lines.pop(me).close()
            raise


def _read(text: str) -> dict:
    """Content of a key file; an empty dict if it is not a JSON object."""
    try:
        found = json.loads(text)
    except ValueError:
        found = {}
    return found if isinstance(found, dict) else {}


def _asked(line: http.client.HTTPConnection, path: str, content: Any, headers: Any) -> tuple:
    """POST `content` as JSON to `path`; HTTP status and decoded JSON of the reply."""
    line.request("POST", path, json.dumps(content, allow_nan=False), {"Content-Type": "application/json", **headers})
    reply = line.getresponse()
    return reply.status, json.loads(reply.read())
