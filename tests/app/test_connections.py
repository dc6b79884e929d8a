"""Connections without a key take nothing from those who hold one: numbers, times, sizes, and a quiet stderr."""

import asyncio
import os
import socket
import struct
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest
from bare_server import Bare, Nothing, connected, request, status, until_closed, until_words

from hilbo.app.server import serve
from hilbo.app.server.round_robin import RoundRobin
from hilbo.app.server.serve import _Admission

HALF = b"GET / HTTP/1.1\r\nHost: "


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    with Bare(tmp_path_factory.mktemp("bare")) as bare:
        yield bare


@pytest.fixture
def brief(monkeypatch):
    """Patience of a tenth of a second."""
    for module in ("connections", "admission"):
        monkeypatch.setattr(f"hilbo.app.server.{module}.PATIENCE", 0.1)


def patient(line, seconds=4.0):
    line.settimeout(seconds)
    return line


def test_half_a_header_is_not_waited_for(server, brief):
    with patient(connected(server.port)) as silent, patient(connected(server.port)) as half:
        half.sendall(HALF)
        assert until_closed(silent) == until_closed(half) == b""


def test_half_a_body_is_not_waited_for_though_it_comes_with_a_key(server, brief):
    with patient(connected(server.port)) as line:
        line.sendall(request(server, "/api/experimenter/note", server.experimenter._key, b"{", length=100))
        assert until_closed(line) == b""


def test_a_key_holder_s_open_stream_and_idle_connection_stay(server, brief):
    with connected(server.port) as stream, connected(server.port) as idle:
        stream.sendall(request(server, "/api/experimenter/events", server.experimenter._key))
        assert status(server.stops(idle)) == 200
        until_words(stream, b"event: view")
        with pytest.raises(TimeoutError):
            patient(stream, 0.3).recv(1)
        assert status(server.stops(idle)) == 200


def test_a_false_length_is_not_drained(server):
    with patient(connected(server.port), 5.0) as line:
        line.sendall(request(server, "/api/join", body=b"", length=200_000_000))
        with pytest.raises(ConnectionError):
            line.sendall(bytes(50_000_000))  # more than the kernel's buffers hold


def test_a_message_that_is_too_large_is_told_so(server):
    with connected(server.port) as line:
        line.sendall(request(server, "/api/experimenter/note", server.experimenter._key, bytes(20_000)))
        assert status(until_words(line, b"16384 bytes").decode()) == 413


def test_the_oldest_stranger_is_given_up_and_nobody_with_a_key(server, monkeypatch):
    monkeypatch.setattr("hilbo.app.server.round_robin._INTERVAL", 0.0005)  # s: a stranger's turn comes sooner
    with connected(server.port) as mine:
        assert status(server.stops(mine)) == 200
        strangers = [connected(server.port) for _ in range(900)]
        try:
            for line in strangers:
                line.sendall(HALF)
            assert status(server.stops(mine)) == 200
            assert status(server.stops()) == 200
            assert until_closed(patient(strangers[0])) == b""
            strangers[-1].sendall(f"127.0.0.1:{server.port}\r\n\r\n".encode())
            assert status(strangers[-1].recv(65536).decode()) == 200
        finally:
            for line in strangers:
                line.close()


def test_a_participant_s_connections_take_none_of_the_experimenter_s(server):
    with connected(server.port) as mine:
        assert status(server.stops(mine)) == 200
        theirs = [connected(server.port) for _ in range(100)]
        try:
            events = request(server, "/api/participant/events", server.participant._key)
            theirs[0].sendall(events)
            until_words(theirs[0], b"event: view")  # a busy server may hear those in another order that speak at once
            for line in theirs[1:]:
                line.sendall(events)
            assert status(server.stops(mine)) == 200
            until_words(theirs[-1], b"event: view")
            until_closed(patient(theirs[0]))
        finally:
            for line in theirs:
                line.close()


def test_a_key_in_two_pieces_is_one(server):
    whole = request(server, "/api/experimenter/estop", server.experimenter._key, b"{}")
    middle = whole.index(server.experimenter._key.encode()) + 10
    with connected(server.port) as line:
        line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        line.sendall(whole[:middle])
        time.sleep(0.05)
        line.sendall(whole[middle:])
        assert status(line.recv(65536).decode()) == 200


def test_many_requests_in_one_piece_are_all_answered(server):
    with connected(server.port) as line:
        line.sendall(request(server, "/api/experimenter", server.experimenter._key) * 50)
        came = b""
        while came.count(b'{"role":"experimenter"}') < 50:
            came += line.recv(65536)


def test_a_stranger_is_answered_once(server):
    with patient(connected(server.port)) as line:
        line.sendall(request(server, "/static/participant.js") * 30)
        came = until_closed(line)
    assert came.count(b"HTTP/1.1 200") == 1
    assert b"connection: close" in came


def test_a_key_that_has_ended_is_told_so_when_all_of_the_message_has_come(server):
    """What comes after the end of a connection can take the answer with it."""
    whole = request(server, "/api/participant/here", "a" * 32, b"{}")
    with connected(server.port) as line:
        line.sendall(whole[:-1])
        with pytest.raises(TimeoutError):
            patient(line, 0.1).recv(1)
        line.sendall(whole[-1:])
        assert status(until_closed(patient(line)).decode()) == 401


def test_what_a_participant_asks_for_in_one_piece_is_answered_turn_by_turn(server):
    begun = time.monotonic()
    with connected(server.port) as line:
        line.sendall(request(server, "/api/participant", server.participant._key) * 30)
        came = b""
        while came.count(b'{"role":"participant"}') < 30:
            came += line.recv(65536)
    assert time.monotonic() - begun > 29 * 0.005


@pytest.mark.parametrize("length", [5_000, 15_000])
def test_a_key_behind_cookies_of_other_programs_is_seen(server, brief, length):
    more = f"Cookie: other={'x' * length}\r\nAuthorization: Bearer {server.experimenter._key}\r\n\r\n"
    with connected(server.port) as stream:
        stream.sendall(request(server, "/api/experimenter/events")[:-2] + more.encode())
        until_words(stream, b"event: view")
        with pytest.raises(TimeoutError):
            patient(stream, 0.3).recv(1)


def test_the_event_loop_watches_sockets_on_windows_too(tmp_path, monkeypatch):
    """What is the default there cannot."""

    class Proactor(asyncio.SelectorEventLoop):
        def add_reader(self, *_):
            raise NotImplementedError

    monkeypatch.setattr(asyncio, "ProactorEventLoop", Proactor, raising=False)
    monkeypatch.setattr("uvicorn.loops.asyncio.sys", SimpleNamespace(platform="win32"))
    monkeypatch.setattr("bare_server.PATIENCE", 0.5)
    with Bare(tmp_path) as own:
        assert status(own.stops()) == 200


def test_every_connection_has_no_delay(server, monkeypatch):
    """Without it the body of an answer waits for the acknowledgement of its header, 40 ms."""
    seen, accept = [], socket.socket.accept

    def accepted(listening):
        line, address = accept(listening)
        seen.append(line)
        return line, address

    monkeypatch.setattr(socket.socket, "accept", accepted)
    with connected(server.port) as line:
        assert status(server.stops(line)) == 200
        assert seen[-1].getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


NOISE = [
    b"\x16\x03\x01\x02\x00" + bytes(range(256)),
    b"GET / HTTP/9.9\r\n\r\n",
    b"POST /api/join HTTP/1.1\r\nHost: 127.0.0.1:%d\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n",
    b"GET / HTTP/1.1\r\nHost: 127.0.0.1:%d\r\nTransfer-Encoding: chunked\r\n\r\n5\r\nabc",
    b"GET / HTTP/1.1\r\nHost: 127.0.0.1:%d\r\nConnection: upgrade\r\nUpgrade: websocket\r\n\r\n",
    b"POST /api/join HTTP/1.1\r\nHost: 127.0.0.1:%d\r\nContent-Length: 100\r\n\r\n{",
    b"POST /api/join HTTP/1.1\r\nHost: 127.0.0.1:%d\r\nContent-Length: 2\r\nContent-Length: 3\r\n\r\n{}",
    b"GET / HTTP/1.1\r\nHost: 127.0.0.1:%d\r\n" + b"X: " + b"y" * 70_000,
    b"GET / HTTP/1.1\r\nHost: 127.0.0.1:%d\r\nTransfer-Encoding: chunked\r\n\r\n",
    b"GET /api/experimenter/events HTTP/1.1\r\nHost: 127.0.0.1:%d\r\nAuthorization: Bearer KEY\r\n\r\n",
    b"POST /api/experimenter/note HTTP/1.1\r\nHost: 127.0.0.1:%d\r\nAuthorization: Bearer KEY\r\n"
    b"Content-Length: 9\r\n\r\n{",
]


def noise(port, key):
    """Hostile bytes, hung up after in three ways."""
    for number, words in enumerate(NOISE * 3):
        line = connected(port)
        line.sendall(words.replace(b"%d", b"%d" % port).replace(b"KEY", key.encode()))
        if number % 3:
            time.sleep(0.02)
        if words.endswith(b"chunked\r\n\r\n"):
            time.sleep(0.05)  # it has been answered
            line.sendall(b"zz\r\n")
            time.sleep(0.02)
        if number % 3 == 2:
            line.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        line.close()


def test_nothing_that_strangers_do_is_printed(tmp_path, capfd, caplog):
    with Bare(tmp_path) as own:
        noise(own.port, own.experimenter._key)
        stream, half = connected(own.port), connected(own.port)
        stream.sendall(request(own, "/api/experimenter/events", own.experimenter._key))
        half.sendall(request(own, "/api/experimenter/note", own.experimenter._key, b"{", length=9))
        assert status(own.stops()) == 200
    stream.close()
    half.close()
    assert capfd.readouterr().err == "" and caplog.text == ""


FEW = """
import resource, sys
resource.setrlimit(resource.RLIMIT_NOFILE, (64, int(sys.argv[2])))
from pathlib import Path
from bare_server import Bare, connected, status
own = Bare(Path(sys.argv[1]))
with own:
    print(own.port, flush=True)
    sys.stdin.readline()
    print(resource.getrlimit(resource.RLIMIT_NOFILE)[0], status(own.stops()))
"""


def test_who_is_just_let_in_when_the_server_ends_is_known_to_it():
    """Else nobody ends that connection, and the server waits 3 s for it and complains."""
    known = []

    class Known(asyncio.Protocol):
        def __init__(self, **_):
            pass

        def connection_made(self, transport):
            known.append(transport)

    async def admitted(line):
        server = SimpleNamespace(config=SimpleNamespace(http=Known), server_state=None)
        admission = _Admission(server)
        admission.admit(line, None)
        await admission.settled()
        known.pop().abort()
        await asyncio.sleep(0)

    here, there = socket.socketpair()
    with here, there:
        here.setblocking(False)
        asyncio.run(admitted(here))


@pytest.mark.deep
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no limit of files")
@pytest.mark.parametrize("files", [256, 4096])
def test_the_process_asks_for_files_and_lives_with_what_it_gets(tmp_path, files):
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    command = [sys.executable, "-c", FEW, str(tmp_path), str(files)]
    path = os.pathsep.join(sys.path)
    with subprocess.Popen(command, text=True, env=os.environ | {"PYTHONPATH": path}, **pipes) as process:
        port = int(process.stdout.readline())
        strangers = [connected(port) for _ in range(400)]
        for line in strangers:
            line.send(HALF)
        said, errors = process.communicate("\n", timeout=30)
        for line in strangers:
            line.close()
    assert errors == ""
    assert said.split() == [str(min(files, 1024)), "200"]


def test_one_of_each_goes_on_at_every_turn():
    gone, waiting = [], [*((number, None) for number in range(30)), *((number, "participant") for number in range(5))]

    async def turns():
        rows = RoundRobin(lambda who, role: gone.append((who, role)))
        for who, role in waiting:
            rows.add(who, role)
        rows.remove(7)
        rows.add(8, None)  # keeps its place
        while len(gone) < len(waiting) - 1:
            await asyncio.sleep(0.001)

    asyncio.run(turns())
    assert gone[:4] == [(0, "participant"), (0, None), (1, "participant"), (1, None)]
    assert [who for who, role in gone if role is None] == [*range(7), *range(8, 30)]
    assert [who for who, role in gone if role] == [0, 1, 2, 3, 4]


def test_what_is_told_of_the_start_may_fail_and_the_session_is_closed(tmp_path):
    """A terminal that is gone, say: the device's watchdog is not the only one to notice."""
    hub, closed = Nothing(), []

    async def close():
        closed.append(True)

    def started(stop):
        raise OSError("the terminal is gone")

    hub.close = close
    with pytest.raises(OSError, match="the terminal is gone"):
        serve.serve(serve.bound(0, keys=tmp_path / "keys"), hub, started)
    assert closed == [True]
