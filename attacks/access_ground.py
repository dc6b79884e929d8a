"""What the attempts of attacks/access.py have to do with: a session, a page of its experimenter, another server."""

import contextlib
import http.server
import json
import subprocess
import tempfile
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from attacks.sessions import started
from hilbo.app.hub.commands import COMMANDS
from hilbo.app.rehearsal.robot import Client, browser

__all__ = ["Ground", "Other", "ground"]


class Ground(NamedTuple):
    """The session that is attacked, an open page of its experimenter, and a server on another port of this host."""

    folder: Path
    process: subprocess.Popen
    address: str
    link: str  # the experimenter's, used
    key: str  # the experimenter's
    participant: Client
    page: Any
    other: "Other"

    def log(self) -> Path:
        """The session's log."""
        return next((self.folder / "logs").glob("*.jsonl"))

    def notes(self) -> int:
        """The number of notes in the log."""
        return self.log().read_text(encoding="utf-8").count('"kind":"note"')

    def status(self, path: str, content: dict[str, Any] | None = None, **headers: str) -> int:
        """The status of the response to a program's request; a POST with `content`."""
        body = None if content is None else json.dumps(content).encode()
        request = urllib.request.Request(self.address + path, body, {"Content-Type": "application/json", **headers})
        try:
            with urllib.request.urlopen(request, timeout=3) as reply:
                return reply.status
        except urllib.error.HTTPError as error:
            error.close()
            return error.code

    def all_of(self, role: str, **headers: str) -> str:
        """The statuses of all reading and commanding requests of a role, each once."""
        reads, posts = ("", "/events"), ["answer", "begin", "break", "more"]
        if role == "experimenter":
            reads, posts = (*reads, "/map"), [name for name in COMMANDS if name not in ("abort", "pause")]
        found = {self.status(f"/api/{role}{path}", **headers) for path in reads}
        found |= {self.status(f"/api/{role}/{name}", {}, **headers) for name in posts}
        return ", ".join(map(str, sorted(found)))

    def by_cookie(self, role: str, key: str) -> str:
        """The same with the key in cookies of every likely name."""
        names = (f"hilbo_{role}_{self.address.rpartition(':')[2]}", f"hilbo.key.{role}", "Authorization", "key")
        return self.all_of(role, Cookie="; ".join(f"{name}={key}" for name in names))


class Other(http.server.ThreadingHTTPServer):
    """Another program's server on this computer; `received` has the header of each request."""

    def __init__(self, port: int = 0) -> None:
        received: list[str] = []

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                received.append(f"{self.path}\n{self.headers}")
                self.send_response(200)
                self.send_header("Content-Type", "text/html")
                self.end_headers()
                self.wfile.write(b"<!doctype html><title>another program</title><body>")

            do_POST = do_GET

            def log_message(self, *_: Any) -> None:
                """Nothing is printed."""

        super().__init__(("127.0.0.1", port), Handler)
        self.received = received
        threading.Thread(target=self.serve_forever, daemon=True).start()

    @property
    def port(self) -> int:
        """Its port."""
        return self.server_address[1]


@contextlib.contextmanager
def ground() -> Iterator[Ground]:
    """A session with a page of the experimenter in a browser, and another server on this host."""
    with (
        tempfile.TemporaryDirectory() as home,
        started(Path(home), "--device", "sim") as (process, links, _),
        browser() as program,
    ):
        Path(home).chmod(0o755)  # as the folder of a laboratory, which others may enter
        page = program.new_context().new_page()
        page.goto(links["experimenter"])
        page.wait_for_url("**/experimenter")
        key = page.evaluate("localStorage.getItem('hilbo.key.experimenter')")
        address, other = links["experimenter"].partition("/#")[0], Other()
        participant = Client(links["participant"])
        try:
            yield Ground(Path(home), process, address, links["experimenter"], key, participant, page, other)
        finally:
            other.shutdown()
            other.server_close()
