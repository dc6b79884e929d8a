"""E-STOP while a thousand hostile connections are open: from the press to the device's acknowledgement.

    python attacks/emergency_stop.py --count 200 --seed 0 --connections 1000

The connections are of one other process, from this computer, and come again as soon as they are given up: silent ones,
half headers a byte at a time, endless bodies, noise, clients that leave in mid-body, wrong keys, pages asked for as
fast as they are given, one by one and 200 at once, and the same with the participant's key, as a stolen tablet would.
Presses go by turns over a connection that is open already and over a new one. 99 % have to be acknowledged within
100 ms.
"""

import asyncio
import contextlib
import http.client
import logging
import multiprocessing
import random
import re
import resource
import socket
import struct
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[1])]

from attacks.sessions import Session, session
from attacks.support import main

__all__ = ["WITHIN", "Siege", "besieged"]

WITHIN = 0.1  # s
_OF_DEVICE = re.compile(r"[0-9:]{8} +The device ")  # lines of `hilbo session` on its conditions
_KINDS = ("silent", "drip", "endless", "noise", "leaves", "wrong key", "asks", "asks with the participant's key",
          "many at once", "many at once with the participant's key")  # fmt: skip
_AT_ONCE = 200  # requests in one piece


def head(port: int, what: str, key: str = "", length: int | None = None) -> bytes:
    """The header of a request."""
    lines = [f"{what} HTTP/1.1", f"Host: 127.0.0.1:{port}"]
    lines += [f"Authorization: Bearer {key}"] if key else []
    lines += [f"Content-Length: {length}"] if length is not None else []
    return "\r\n".join([*lines, "", ""]).encode()


async def attack(port: int, kind: str, key: str, rng: random.Random) -> None:
    """One connection of a kind, until it is given up."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    try:
        if kind == "silent":
            await reader.read()
        elif kind == "drip":
            for byte in head(port, "GET /"):
                writer.write(bytes([byte]))
                await asyncio.sleep(1.0)
        elif kind == "endless":
            writer.write(head(port, "POST /api/join", length=10**9))
            while True:
                writer.write(bytes(4096))
                await writer.drain()
                await asyncio.sleep(0.01)
        elif kind == "noise":
            writer.write(rng.randbytes(rng.randrange(1, 2000)) + b"\r\n\r\n")
            await reader.read()
        elif kind == "leaves":
            writer.write(head(port, "POST /api/join", length=1000) + b"{")
            await writer.drain()
            await asyncio.sleep(rng.uniform(0, 0.05))
            linger = struct.pack("ii", 1, 0)  # the connection is reset, not ended
            writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
        elif kind == "wrong key":
            writer.write(head(port, "POST /api/experimenter/estop", "a" * 32, length=2) + b"{}")
            await reader.read()
        else:
            theirs = kind.endswith("key")
            what = head(port, "GET /api/participant", key) if theirs else head(port, "GET /static/experimenter.js")
            while True:
                writer.write(what * (_AT_ONCE if kind.startswith("many") else 1))
                if not await reader.read(65536):
                    return
    finally:
        writer.close()


async def _besiege(port: int, connections: int, key: str, seed: int, attempts) -> None:
    async def again(number):
        rng = random.Random(f"{seed}/{number}")
        while True:
            with contextlib.suppress(OSError):
                attempts[number % len(_KINDS)] += 1
                await asyncio.wait_for(attack(port, _KINDS[number % len(_KINDS)], key, rng), 30)

    await asyncio.gather(*(again(number) for number in range(connections)))


def _hostile(port: int, connections: int, key: str, seed: int, attempts) -> None:
    most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(most, 4 * connections + 100), most))
    logging.disable()  # what asyncio says of connections that were given up
    asyncio.run(_besiege(port, connections, key, seed, attempts))


class Siege:
    """A session under attack; `press` is one E-STOP. `times` (s) are those of the presses, by kind of connection."""

    def __init__(self, held: Session):
        self.held, self.times = held, {"open": [], "new": []}
        self.line = http.client.HTTPConnection("127.0.0.1", held.port, timeout=30)
        self._headers = {"Authorization": f"Bearer {held.experimenter._key}", "Content-Type": "application/json"}

    def press(self, rng: random.Random, number: int) -> str:
        """The word under which a press counts."""
        kind = ("open", "new")[number % 2]
        time.sleep(rng.uniform(0, 0.2))
        line = self.line if kind == "open" else http.client.HTTPConnection("127.0.0.1", self.held.port, timeout=30)
        begun = time.perf_counter()
        said = self._command(line, "estop")
        took = time.perf_counter() - begun
        self.times[kind].append(took)
        if kind == "new":
            line.close()
        self._command(self.line, "clear")
        if said != 200:
            return f"THROUGH: not acknowledged ({said})"
        return f"{kind} connection, acknowledged {'within' if took <= WITHIN else 'later than'} 100 ms"

    def _command(self, line, name) -> int:
        line.request("POST", f"/api/experimenter/{name}", b"{}", self._headers)
        answer = line.getresponse()
        answer.read()
        return answer.status


@contextlib.contextmanager
def besieged(connections: int, seed: int = 0):
    """A siege that has begun: every connection has been tried."""
    spawned = multiprocessing.get_context("spawn")
    attempts = spawned.Array("q", len(_KINDS), lock=False)
    with tempfile.TemporaryDirectory() as folder, session(Path(folder), "--device", "sim") as held:
        _warm(held)
        arguments = (held.port, connections, held.participant._key, seed, attempts)
        said = held.words.read_text(encoding="utf-8")
        hostile = spawned.Process(target=_hostile, args=arguments, daemon=True)
        hostile.start()
        siege = Siege(held)
        try:
            while sum(attempts) < connections:
                time.sleep(0.05)
            siege._command(siege.line, "estop")
            siege._command(siege.line, "clear")
            yield siege
        finally:
            hostile.kill()
            hostile.join()
            tried = Counter(dict(zip(_KINDS, attempts, strict=True)))
            print("connections tried:", ", ".join(f"{n:,} {kind}" for kind, n in tried.items()))
            siege.line.close()
            words = held.words.read_text(encoding="utf-8").removeprefix(said)
            others = [line for line in words.splitlines() if not _OF_DEVICE.match(line)]
            assert not others, words


def _warm(held: Session) -> None:
    """Waits until everything is compiled; a session does not begin before."""
    while not held.participant.get("/api/participant")["may"]["begin"]:
        time.sleep(0.1)


def prepared() -> None:
    """The command line."""
    connections = 1000
    if "--connections" in sys.argv:
        at = sys.argv.index("--connections")
        connections = int(sys.argv[at + 1])
        del sys.argv[at : at + 2]
    with besieged(connections) as siege:
        try:
            main(lambda: siege.press, __doc__.partition("\n")[0], 200)
        except SystemExit as end:
            times = [took for kind in siege.times.values() for took in kind]
            late = sum(took > WITHIN for took in times) > 0.01 * len(times)
            raise SystemExit(bool(end.code or late)) from None
        finally:
            for kind, times in siege.times.items():
                ordered = sorted(times)
                if ordered:
                    shares = (ordered[int(share * (len(ordered) - 1))] for share in (0.5, 0.99, 1.0))
                    print(
                        kind,
                        "connections, ms: median {:.1f}, 99 % {:.1f}, largest {:.1f}".format(
                            *(1e3 * t for t in shares)
                        ),
                    )


if __name__ == "__main__":
    prepared()
