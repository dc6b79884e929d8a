"""A session's log under everything that can happen to a file and to the process that writes it."""

import os
import random
import signal
import subprocess
import sys
import zlib

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from live import CHOOSER, RAW, STUDY, Driver, header

from hilbo import Study
from hilbo.app.pages.log_words import line
from hilbo.errors import InputError
from hilbo.session.log import actions as live
from hilbo.session.log.event_log import EventLog, LogError, read_log
from hilbo.session.log.log_files import begun, log_name, log_paths
from hilbo.session.log.records import Event
from hilbo.session.log.state import LiveSession

CHILD = """
import sys
sys.path[:0] = ["tests/support", "."]
from live import STUDY, CHOOSER, Driver, header
from hilbo.session.log import actions as live
from hilbo.session.log.event_log import EventLog
"""


def drive(driver, rounds=9):
    driver.step()
    for number in range(rounds):
        kind = "go" if driver.state.screen == "ready" else "answer"
        driver.do(kind, number)
    return driver


@pytest.fixture(scope="module")
def driven():
    return drive(Driver())


def write(path, driver):
    with EventLog.create(path, STUDY.file, driver.header) as log:
        for event in driver.events:
            log.append(event)
        assert log.state == driver.state
    return path.read_bytes()


def test_a_log_reads_back_and_goes_on(tmp_path, driven):
    path = tmp_path / log_name(driven.header)
    write(path, driven)
    assert log_paths(tmp_path) == [path]
    read_header, events, dropped = read_log(path, STUDY.file)
    assert (read_header, events, dropped) == (driven.header, driven.events, "")
    with EventLog.resume(path, STUDY.file) as log:
        assert log.state == driven.state
        log.append(live.note(log.state, "again: ü, \n, \u2028", 1e9 + 0.1))
    assert read_log(path)[1][-1].data["text"] == "again: ü, \n, \u2028"
    first = path.read_bytes().split(b"\n")[0]
    assert b'"schema":3,"study":"' + STUDY.file.hash.encode() in first


@given(st.integers(0, 10**9))
@settings(max_examples=40)
def test_a_log_cut_anywhere_resumes_to_the_same_next_trial(tmp_path_factory, driven, number):
    folder = tmp_path_factory.mktemp("cut")
    whole = write(folder / "whole.jsonl", driven)
    cut = number % (len(whole) + 1)
    path = folder / "cut.jsonl"
    path.write_bytes(whole[:cut])
    lines = whole[:cut].count(b"\n")
    if lines and whole[cut : cut + 1] == b"\n":
        lines += 1  # its newline alone is missing
    if lines == 0:
        with pytest.raises(InputError, match="no complete first line"):
            EventLog.resume(path, STUDY.file)
        return
    with EventLog.resume(path, STUDY.file) as log:
        kept = driven.events[: lines - 1]
        assert log.state == LiveSession.fold(STUDY.file, driven.header, kept)
        good = b"".join(whole.splitlines(keepends=True)[:lines])
        assert bool(log.dropped) == (len(good) < cut)
        assert path.read_bytes() == good
        following = driven.events[lines - 1] if lines - 1 < len(driven.events) else None
        if following is not None and following.kind == "propose":
            assert live.propose(log.state, CHOOSER, following.time) == following
        for event in driven.events[lines - 1 :]:
            log.append(event)
    assert path.read_bytes().split(b"\n")[1:] == whole.split(b"\n")[1:]


def test_a_last_line_that_lacks_its_newline_counts_and_gets_it(tmp_path, driven):
    path = tmp_path / "log.jsonl"
    whole = write(path, driven)
    path.write_bytes(whole[:-1])
    assert read_log(path, STUDY.file) == (driven.header, driven.events, "")
    with EventLog.resume(path, STUDY.file) as log:
        assert log.state == driven.state and log.dropped == ""
        assert path.read_bytes() == whole
        log.append(live.note(log.state, "goes on", 1e9))
    assert len(read_log(path, STUDY.file)[1]) == len(driven.events) + 1
    lines = whole.splitlines(keepends=True)
    path.write_bytes(b"".join([*lines[:-2], lines[-1][:-1]]))
    with pytest.raises(InputError, match="does not follow"):
        read_log(path)


def test_a_newline_that_cannot_be_written_is_one_sentence_and_the_log_stays(tmp_path, driven, monkeypatch):
    path = tmp_path / "log.jsonl"
    whole = write(path, driven)
    path.write_bytes(whole[:-1])

    def full(file, content):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "write", full)
    with pytest.raises(InputError, match=r"log\.jsonl: cannot be written \(No space left"):
        EventLog.resume(path, STUDY.file)
    monkeypatch.undo()
    assert path.read_bytes() == whole[:-1]
    EventLog.resume(path, STUDY.file).close()  # nobody holds it


@given(st.integers(0, 10**9), st.integers(1, 255))
@settings(max_examples=80)
def test_a_changed_byte_is_refused_with_its_line(tmp_path_factory, driven, number, change):
    folder = tmp_path_factory.mktemp("damage")
    content = bytearray(write(folder / "whole.jsonl", driven))
    place = number % (len(content) - 1)  # without the very last newline the line counts
    line = content[:place].count(b"\n") + 1
    content[place] ^= change
    path = folder / "damaged.jsonl"
    path.write_bytes(content)
    with pytest.raises(InputError, match=rf"damaged\.jsonl:{line}: "):
        EventLog.resume(path, STUDY.file)
    assert path.read_bytes() == content


def test_missing_swapped_and_forged_lines_are_refused(tmp_path, driven):
    lines = write(tmp_path / "whole.jsonl", driven).splitlines(keepends=True)
    path = tmp_path / "log.jsonl"
    for changed in (lines[:3] + lines[4:], [*lines[:3], lines[4], lines[3], *lines[5:]], lines[1:]):
        path.write_bytes(b"".join(changed))
        with pytest.raises(InputError, match=r"does not follow|is no header"):
            read_log(path)
    body = lines[5].rpartition(b',"crc"')[0].replace(b'"time":', b'"time":1')
    lines[5] = body + b',"crc":"%08x"}\n' % zlib.crc32(body)
    path.write_bytes(b"".join(lines))
    with pytest.raises(InputError, match=r"log\.jsonl:7: does not follow"):
        read_log(path)


def test_another_study_another_writer_and_other_files_are_refused(tmp_path, driven):
    path = tmp_path / "log.jsonl"
    write(path, driven)
    other = Study.from_dict(RAW | {"study": RAW["study"] | {"attribute": "softness"}})
    with pytest.raises(InputError, match="is the log of another study"):
        EventLog.resume(path, other.file)
    with pytest.raises(InputError, match="exists already"):
        EventLog.create(path, STUDY.file, driven.header)
    with EventLog.resume(path, STUDY.file), pytest.raises(InputError, match="written by another hilbo"):
        EventLog.resume(path, STUDY.file)
    EventLog.resume(path, STUDY.file).close()  # and is free again
    with pytest.raises(InputError, match="no such session was begun"):
        EventLog.resume(tmp_path / "none.jsonl", STUDY.file)
    for content, sentence in ((b"", "no complete first line"), (b"participant,trial\n", "is damaged")):
        path.write_bytes(content)
        with pytest.raises(InputError, match=sentence):
            read_log(path)


@given(st.integers(0, 10**9))
@settings(max_examples=20)
def test_a_log_that_was_killed_within_its_first_line_is_begun_again(tmp_path_factory, driven, number):
    folder = tmp_path_factory.mktemp("killed")
    whole = write(folder / log_name(driven.header), driven)
    path = folder / "P09_1.session.jsonl"
    path.write_bytes(whole[: number % (whole.index(b"\n") + 1)])
    assert not begun(path)
    assert log_paths(folder) == [folder / log_name(driven.header)]  # nobody's table waits for it
    EventLog.create(path, STUDY.file, driven.header).close()
    assert begun(path)
    assert read_log(path, STUDY.file) == (driven.header, [], "")


@pytest.mark.parametrize("content", [b"my notes", b"my notes\n", b'{"seq":0,"kind":"note"}'])
def test_what_is_no_beginning_of_a_log_is_not_written_over(tmp_path, driven, content):
    path = tmp_path / "log.jsonl"
    path.write_bytes(content)
    with pytest.raises(InputError, match="exists already"):
        EventLog.create(path, STUDY.file, driven.header)
    assert path.read_bytes() == content


@pytest.mark.deep  # a process that imports all
def test_a_writer_in_another_process_is_refused_too(tmp_path, driven):
    path = tmp_path / "log.jsonl"
    write(path, driven)
    with EventLog.resume(path, STUDY.file):
        code = CHILD + f"EventLog.resume({str(path)!r}, STUDY.file)"
        run = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True)
        assert "written by another hilbo" in run.stderr


def test_an_event_that_does_not_follow_is_not_written(tmp_path, driven):
    path = tmp_path / "log.jsonl"
    with EventLog.create(path, STUDY.file, driven.header) as log:
        size = path.stat().st_size
        with pytest.raises(InputError, match="does not follow"):
            log.append(driven.events[3])
        assert path.stat().st_size == size


FULL = """
import resource, signal, os
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
path = sys.argv[1]
driver = Driver()
log = EventLog.create(path, STUDY.file, driver.header)
resource.setrlimit(resource.RLIMIT_FSIZE, (os.path.getsize(path) + 5000, resource.RLIM_INFINITY))
try:
    while True:
        log.append(live.note(log.state, "x" * 300, 1.0))
        print(log.state.seq, flush=True)
except Exception as error:
    print(type(error).__name__, error)
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
log.append(live.note(log.state, "space again", 2.0))
print(log.state.seq)
"""


@pytest.mark.skipif(os.name == "nt", reason="limits of POSIX")
def test_a_full_disk_is_one_sentence_and_loses_nothing(tmp_path):
    path = tmp_path / "log.jsonl"
    command = [sys.executable, "-W", "ignore", "-c", CHILD + FULL, str(path)]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    *told, sentence, last = run.stdout.splitlines()
    assert sentence.startswith("LogError") and "free some space" in sentence
    assert int(last) == int(told[-1]) + 1 and int(told[-1]) > 5
    _, events, dropped = read_log(path, STUDY.file)
    assert dropped == "" and [event.seq for event in events] == list(range(1, int(last) + 1))
    assert events[-1].data["text"] == "space again"


def test_a_failing_fsync_acknowledges_nothing(tmp_path, driven, monkeypatch):
    path = tmp_path / "log.jsonl"
    with EventLog.create(path, STUDY.file, driven.header) as log:
        log.append(driven.events[0])
        state, size = log.state, path.stat().st_size

        def fails(file):
            raise OSError(5, "Input/output error")

        monkeypatch.setattr(os, "fsync", fails)
        with pytest.raises(LogError, match="Input/output error"):
            log.append(driven.events[1])
        assert log.state is state and path.stat().st_size == size
        monkeypatch.undo()
        log.append(driven.events[1])
    assert read_log(path)[1] == driven.events[:2]


@pytest.mark.parametrize("time", [-1.0, -5e10, 9e10])
def test_whatever_the_clock_says_what_was_acknowledged_can_be_read(tmp_path, time):
    path = tmp_path / "log.jsonl"
    with EventLog.create(path, STUDY.file, header()) as log:
        log.append(live.note(log.state, "early", time))
        state = log.state
    assert read_log(path)[1][0].time == time
    with EventLog.resume(path, STUDY.file) as log:
        assert log.state == state
    assert line(state, read_log(path)[1][0])[2].endswith("early")


READY = {"condition": "ready", "trial": None}


@pytest.mark.parametrize(
    ("event", "why"),
    [
        (Event(seq=1, kind="note", time=-1e11, data={"text": "in antiquity"}), "check the date of this computer"),
        (Event(seq=1, kind="note", time=float("nan"), data={"text": "never"}), "not what this hilbo writes"),
        (Event(seq=1, kind="other", time=0.0, data={}), 'of the kind "other"'),
        (Event(seq=1, kind="device", time=0.0, data={"condition": "ready"}), "trial"),
        (Event(seq=1, kind="sent", time=0.0, data={"id": 1, "side": "a", "values": {"u": float("nan")}}), "float"),
    ],
)
def test_what_no_reader_would_accept_is_not_written(tmp_path, event, why):
    path = tmp_path / "log.jsonl"
    with EventLog.create(path, STUDY.file, header()) as log:
        before, state = path.read_bytes(), log.state
        with pytest.raises(LogError, match=why):
            log.append(event)
        assert path.read_bytes() == before and log.state is state
        log.append(Event(seq=1, kind="device", time=0.0, data=READY))
    assert [event.kind for event in read_log(path)[1]] == ["device"]


def test_no_two_sessions_have_one_file_name():
    parts = ("A", "1", "A_1", "1_2", "2", "A-1", "1-2", "1 2", "1~2", "_", "-", "é", "e\u0301", "x" * 64)
    pairs = [(person, label) for person in parts[:6] for label in parts]
    names = [log_name(msgspec.structs.replace(header(), participant=p, session=label)) for p, label in pairs]
    assert len(set(names)) == len(pairs)
    assert log_name(header()) == "P01_1.session.jsonl"
    assert all(name.isascii() and not set(name) & set(' /\\:*?"<>|') for name in names)


KILLED = """
log = EventLog.resume(sys.argv[1], STUDY.file)
while True:
    log.append(live.note(log.state, "x" * (log.state.seq % 977), float(log.state.seq)))
    print(log.state.seq, flush=True)
"""


@pytest.mark.deep
@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_kill_9_while_appending_loses_nothing_acknowledged(tmp_path):
    path = tmp_path / "log.jsonl"
    EventLog.create(path, STUDY.file, header()).close()
    rng, acknowledged = random.Random(0), 0
    for _ in range(12):
        command = [sys.executable, "-W", "ignore", "-c", CHILD + KILLED, str(path)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
            assert child.stdout is not None
            for _ in range(rng.randrange(1, 200)):
                acknowledged = int(child.stdout.readline())
            child.send_signal(signal.SIGKILL)
            rest = [line for line in child.stdout.read().splitlines(keepends=True) if line.endswith("\n")]
            acknowledged = int(rest[-1]) if rest else acknowledged
        _, events, _ = read_log(path, STUDY.file)
        assert [event.seq for event in events] == list(range(1, len(events) + 1))
        assert len(events) in (acknowledged, acknowledged + 1)


def test_numbers_survive_a_log_bit_for_bit(tmp_path):
    values = [0.1, 1 / 3, 5e-324, 1.7976931348623157e308, -0.0, 123456789.123456789]
    path = tmp_path / "log.jsonl"
    with EventLog.create(path, STUDY.file, header()) as log:
        log.append(Event(seq=1, kind="device", time=0.1 + 0.2, data={"condition": "ready", "trial": None, "v": values}))
    (event,) = read_log(path)[1]
    assert event.time == 0.1 + 0.2 and list(map(repr, event.data["v"])) == list(map(repr, values))
