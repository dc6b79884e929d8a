"""Who can do what: each attempt on a real session, its browser and its files, and the outcome that it must have.

    python attacks/access.py            # tries all of them
    python attacks/access.py --table    # prints the table of docs/guides/live.md

Needs Chromium; the attempts of another user of the computer need root, and count as "not tried" without it.
"""

import contextlib
import errno
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

sys.path[:0] = [str(Path(__file__).parents[1])]

from attacks.access_ground import Ground, Other, ground
from attacks.sessions import started
from attacks.support import main
from hilbo.app.rehearsal.rehearsal import HILBO
from hilbo.app.rehearsal.robot import Client
from hilbo.device.failures import DeviceError
from hilbo.device.local import simulator

__all__ = ["ATTEMPTS", "Attempt", "table", "tried"]

_NOBODY = 65534
_DENIED = (errno.EPERM, errno.EACCES, errno.EADDRINUSE)
_PATIENCE = 60.0  # s
_MANY = 170  # cookies of 4,000 bytes that a page of another port sets; Chromium keeps 180 of a host


class Attempt(NamedTuple):
    """`run` tries it and returns the outcome in words; `outcome` is what it must be."""

    who: str
    what: str
    outcome: str
    run: Callable[[Ground], str]


# Pages of others in the experimenter's browser.

_READS = "fetch(HERE + '/api/experimenter', {credentials: 'include'}).then((r) => r.text())"
_COMMANDS = """Promise.allSettled([{mode: 'no-cors'}, {headers: {Authorization: 'Bearer x'}}].map((more) =>
    fetch(HERE + '/api/experimenter/note', {method: 'POST', credentials: 'include', body: '{"text": "x"}', ...more}),
)).then(() => new Promise((done) => {
    const form = document.createElement('form');
    Object.assign(form, {method: 'post', enctype: 'text/plain', action: HERE + '/api/experimenter/note', target: 'f'});
    form.append(Object.assign(document.createElement('input'), {name: '{"text": "x', value: '"}'}));
    document.body.append(Object.assign(document.createElement('iframe'), {name: 'f'}), form);
    form.submit();
    setTimeout(done, 500);
})).then(() => '')"""
_STORAGE = """new Promise((done) => {
    const look = (w) => {
        try { return w.localStorage.getItem('hilbo.key.experimenter') || 'nothing'; } catch (e) { return e.name; }
    };
    const frame = Object.assign(document.createElement('iframe'), {src: HERE + '/experimenter'});
    document.body.append(frame);
    const all = [window, frame.contentWindow, window.open(HERE + '/experimenter')];
    setTimeout(() => done(all.map((w) => w ? look(w) : 'none').join(' ')), 1000);
})"""


@contextlib.contextmanager
def _visited(ground: Ground, host: str) -> Iterator[Any]:
    """A page of the other server in the experimenter's browser."""
    page = ground.page.context.new_page()
    try:
        page.goto(f"http://{host}:{ground.other.port}/")
        yield page
    finally:
        for opened in page.context.pages:
            if opened is not ground.page:
                opened.close()


def _received(host: str) -> Callable[[Ground], str]:
    def run(ground: Ground) -> str:
        ground.other.received.clear()
        with _visited(ground, host) as page:
            page.evaluate("fetch('/more', {method: 'POST', credentials: 'include'}).then(() => '')")
        told = "\n".join(ground.other.received)
        assert "/more" in told
        return "received" if ground.key in told or "cookie" in told.lower() else "not received"

    return run


def _scripted(host: str, script: str) -> Callable[[Ground], str]:
    def run(ground: Ground) -> str:
        before = ground.notes()
        with _visited(ground, host) as page:
            said = page.evaluate(script.replace("HERE", repr(ground.address)) + ".catch((e) => e.name)")
            page.wait_for_timeout(300)
        if ground.notes() != before:
            return "accepted"
        return "read" if ground.key in said or "P01" in said else "refused"

    return run


def _flooded(ground: Ground) -> str:
    """Cookies of the host, set by another port, that make every request of the browser too large."""
    with _visited(ground, "127.0.0.1") as page:
        page.evaluate(f"for (let i = 0; i < {_MANY}; i++) document.cookie = `c${{i}}=${{'x'.repeat(4000)}}`")
    said = ground.page.evaluate("command('note', {text: 'flooded'}).then((news) => news ? 'accepted' : 'refused')")
    loaded = _loads(ground)
    ground.page.context.clear_cookies()
    end = time.monotonic() + _PATIENCE
    while not _loads(ground) and time.monotonic() < end:  # Chromium may still be showing its own page of the error
        pass
    return f"the open page's commands are {said}; it {'is' if loaded else 'cannot be'} loaded again"


def _loads(ground: Ground) -> bool:
    """Whether the experimenter's page can be loaded."""
    from playwright.sync_api import Error

    try:
        reply = ground.page.goto(f"{ground.address}/experimenter", timeout=5000)
    except Error:
        ground.page.wait_for_timeout(500)
        return False
    return reply is not None and reply.ok


_OF_PAGES = (
    ("receive the key", "not received", _received),
    ("read the view by fetch", "refused", lambda host: _scripted(host, _READS)),
    ("command by fetch or a form", "refused", lambda host: _scripted(host, _COMMANDS)),
    ("read the key in a frame or window of the page", "refused", lambda host: _scripted(host, _STORAGE)),
)


# Another user of this computer.


def _as_nobody(action: Callable[[Ground], str]) -> Callable[[Ground], str]:
    """The action in a process of another user; what is denied to it ends as "denied"."""

    def run(ground: Ground) -> str:
        if os.name != "posix" or os.geteuid() != 0:
            return "not tried"
        read, write = os.pipe()
        child = os.fork()
        if child == 0:
            said = "failed"
            try:
                os.setgroups([])
                os.setgid(_NOBODY)
                os.setuid(_NOBODY)
                said = action(ground)
            except OSError as error:
                said = "denied" if error.errno in _DENIED else str(error)
            finally:
                os.write(write, said.encode())
                os._exit(0)
        os.close(write)
        os.waitpid(child, 0)
        with os.fdopen(read) as said:
            return said.read()

    return run


def _reads(ground: Ground) -> str:
    for path in sorted(ground.folder.rglob("*")):
        if path.is_file():
            with contextlib.suppress(PermissionError):
                if path.read_bytes() and path.parent.name == "logs":
                    return f"reads {path.name}"
    return "denied"


def _writes(ground: Ground) -> str:
    (ground.folder / "logs" / "planted").write_text("x")
    return "writes"


def _listens(ground: Ground) -> str:
    for host in ("127.0.0.1", ""):
        with socket.socket() as line:
            line.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            line.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
            with contextlib.suppress(OSError):
                line.bind((host, int(ground.address.rpartition(":")[2])))
                line.listen()
                return f"listens on {host or 'all addresses'}"
    return "denied"


def _ends(ground: Ground) -> str:
    os.kill(ground.process.pid, 9)
    return "ends it"


def _listed(ground: Ground) -> str:
    """What every user may see of a process is its command line; its environment is its owner's."""
    shown = Path(f"/proc/{ground.process.pid}/cmdline").read_bytes().decode()
    secrets = (ground.key, ground.participant._key, ground.link.partition("#")[2])
    return "read" if any(secret in shown for secret in secrets) else "denied"


def _waits(ground: Ground) -> str:
    """Another user's program listens on the session's port after the server has ended, while a page is still open."""
    ground.process.kill()
    ground.process.wait(_PATIENCE)
    port, end = int(ground.address.rpartition(":")[2]), time.monotonic() + _PATIENCE
    taken = Other(port)
    try:
        while not taken.received and time.monotonic() < end:
            ground.page.wait_for_timeout(100)
    finally:
        taken.shutdown()
        taken.server_close()
    return "received" if ground.key in "\n".join(taken.received) else "not received"


# Planted files.


def _planted_modules(ground: Ground) -> str:
    """Modules in the folder in which a session is rehearsed."""
    folder = ground.folder / "planted"
    folder.mkdir()
    for name in ("typer", "numpy", "json", "hilbo"):
        (folder / f"{name}.py").write_text("open('ran', 'w').close()\nraise SystemExit(3)\n")
    done = subprocess.run([*HILBO, "--version"], cwd=folder, capture_output=True)
    return "run" if (folder / "ran").exists() or done.returncode else "not run"


def _planted_links(ground: Ground) -> str:
    """A link in the place of the file of keys of a session that is to begin."""
    folder = ground.folder / "linked"
    folder.mkdir()
    (folder / "target").write_text("precious")
    keys = next((ground.folder / "logs").glob("*keys*"))
    (folder / "logs").mkdir()
    (folder / "logs" / keys.name).symlink_to(folder / "target")
    with started(folder) as (_, links, _words):
        Client(links["participant"])
    return "not followed" if (folder / "target").read_text() == "precious" else "followed"


def _planted_build(ground: Ground) -> str:
    """A program in the place of the simulated device, in a cache folder that others may write."""
    cache = ground.folder / "cache"
    with _cache(cache):
        path = simulator.built()
    path.parent.chmod(0o777)
    path.write_text("#!/bin/sh\n")
    try:
        with _cache(cache):
            simulator.built()
    except DeviceError:
        return "refused"
    return "run"


@contextlib.contextmanager
def _cache(folder: Path) -> Iterator[None]:
    before = os.environ.get("XDG_CACHE_HOME")
    os.environ["XDG_CACHE_HOME"] = str(folder)
    try:
        yield
    finally:
        if before is None:
            del os.environ["XDG_CACHE_HOME"]
        else:
            os.environ["XDG_CACHE_HOME"] = before


_STRANGER, _PERSON, _EXPERIMENTER = (
    "without a key",
    "the participant's key as a Bearer",
    "the experimenter's key as a Bearer",
)
_PORT, _SITE = "a page of another port of this host", "a page of another site"
_USER, _PLANTED = "another user of this computer", "files planted where hilbo looks"


def _of(key: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {key}"}


ATTEMPTS = (
    Attempt(_STRANGER, "read or command as the experimenter", "401", lambda g: g.all_of("experimenter")),
    Attempt(_STRANGER, "read or answer as the participant", "401", lambda g: g.all_of("participant")),
    Attempt(_STRANGER, "open a link that was used", "401",
            lambda g: str(g.status("/api/join", {"token": g.link.partition("#")[2]}))),
    Attempt("the experimenter's key in a cookie", "read or command", "401",
            lambda g: g.by_cookie("experimenter", g.key)),
    Attempt("the participant's key in a cookie", "read or answer", "401",
            lambda g: g.by_cookie("participant", g.participant._key)),
    Attempt(_PERSON, "read its view", "200", lambda g: str(g.status("/api/participant", **_of(g.participant._key)))),
    Attempt(_PERSON, "read or command as the experimenter", "401",
            lambda g: g.all_of("experimenter", **_of(g.participant._key))),
    Attempt(_EXPERIMENTER, "read its view", "200", lambda g: str(g.status("/api/experimenter", **_of(g.key)))),
    Attempt(_EXPERIMENTER, "write a note", "200",
            lambda g: str(g.status("/api/experimenter/note", {"text": "x"}, **_of(g.key)))),
    Attempt(_EXPERIMENTER, "read or answer as the participant", "401", lambda g: g.all_of("participant", **_of(g.key))),
    Attempt(_EXPERIMENTER, "under a name that the session was not started for (DNS rebinding)", "403",
            lambda g: str(g.status("/api/experimenter", **_of(g.key), Host="example.org"))),
    *(Attempt(who, what, outcome, make(host)) for who, host in ((_PORT, "127.0.0.1"), (_SITE, "localhost")) for
      what, outcome, make in _OF_PAGES),
    Attempt(_PORT, "set cookies until the browser's requests are too large",
            "the open page's commands are accepted; it cannot be loaded again", _flooded),
    Attempt(_USER, "read logs and keys", "denied", _as_nobody(_reads)),
    Attempt(_USER, "create a file next to the log", "denied", _as_nobody(_writes)),
    Attempt(_USER, "read keys or links in the list of processes", "denied", _as_nobody(_listed)),
    Attempt(_USER, "listen on the port of the session", "denied", _as_nobody(_listens)),
    Attempt(_USER, "end the session's process", "denied", _as_nobody(_ends)),
    Attempt(_PLANTED, "modules in the folder in which hilbo starts processes", "not run", _planted_modules),
    Attempt(_PLANTED, "a program in a cache folder that others may write", "refused", _planted_build),
    Attempt(_PLANTED, "a link in the place of the file of keys", "not followed", _planted_links),
    Attempt(_USER, "receive the key by listening on the port after the session, while its page is open", "received",
            _waits),
)  # fmt: skip
"""In this order: the last one ends the session."""


def tried(ground: Ground, attempt: Attempt) -> str:
    """The word under which an attempt counts."""
    outcome = attempt.run(ground)
    words = f"{attempt.who}: {attempt.what}: {outcome}"
    return words if outcome in (attempt.outcome, "not tried") else f"THROUGH: {words}"


def table() -> str:
    """All attempts and their outcomes, as Markdown."""
    rows = [f"| {attempt.who} | {attempt.what} | {attempt.outcome} |" for attempt in ATTEMPTS]
    return "\n".join(["| who | attempt | outcome |", "|---|---|---|", *rows])


if __name__ == "__main__":
    if sys.argv[1:] == ["--table"]:
        print(table())
    else:
        with ground() as attacked:
            main(lambda: lambda _, number: tried(attacked, ATTEMPTS[number]), __doc__.partition("\n")[0], len(ATTEMPTS))
