"""Logs whose chain and CRCs fit, and whose content hilbo would not have written: each refused in one sentence."""

import hashlib
import json
import zlib

import msgspec
import pytest
from live import STUDY, Driver

from hilbo.errors import InputError
from hilbo.session.export.psych_ds import psych_ds
from hilbo.session.export.tables import read_sessions
from hilbo.session.log.event_log import EventLog


def write(path, kind):
    """A session with every kind of event; the lines as they were written."""
    driver = Driver(kind)
    driver.step()
    doings = ("feel", "answer", "answer", "go", "answer", "hold", "undo", "void", "again", "pause", "resume", "note")
    for number, doing in enumerate(doings):
        driver.do(doing, number)
    with EventLog.create(path, STUDY.file, driver.header) as log:
        for event in driver.events:
            log.append(event)
    return [json.loads(line) for line in path.read_bytes().splitlines()]


def chained(path, lines):
    """The lines with numbers, chain and CRCs made anew."""
    previous, made = b"", []
    for number, line in enumerate(lines):
        link = hashlib.sha256(previous).hexdigest()[:16] if previous else ""
        body = {"seq": number, "kind": line["kind"], "time": line["time"], "data": line["data"], "previous": link}
        text = json.dumps(body, separators=(",", ":")).encode()[:-1]
        previous = text + b',"crc":"%08x"}\n' % zlib.crc32(text)
        made.append(previous)
    path.write_bytes(b"".join(made))


def first(lines, kind):
    return next(line for line in lines if line["kind"] == kind)


def data(kind, **changes):
    return lambda lines: first(lines, kind)["data"].update(changes)


def without(kind, key):
    return lambda lines: first(lines, kind)["data"].pop(key)


def rendering(**changes):
    return lambda lines: first(lines, "propose")["data"]["renderings"]["a"].update(changes)


def header_set(**changes):
    return lambda lines: lines[0]["data"]["sets"]["A"].update(changes)


def doubled(kind):
    return lambda lines: lines.insert(1 + lines.index(first(lines, kind)), dict(first(lines, kind)))


FORGED = {
    "no data": lambda lines: first(lines, "answer").update(data=None),
    "no kind": lambda lines: first(lines, "answer").update(kind=None),
    "a kind that is none": lambda lines: first(lines, "answer").update(kind="dance"),
    "a time that is none": lambda lines: first(lines, "answer").update(time=-1e11),
    "an answer without a trial": without("answer", "id"),
    "an answer to no trial": data("answer", id=999),
    "an answer that is none": data("answer", values={"class_a": "wonderful"}),
    "an answer without values": data("answer", values=None),
    "telemetry without its samples": data("answer", telemetry={"slewed": 1}),
    "more flagged samples than samples": data("answer", telemetry={"samples": 1, "slewed": 2}),
    "a flag that is none": data("answer", telemetry={"samples": 2, "warm": 1}),
    "less than no samples": data("answer", telemetry={"samples": -1}),
    "an answer twice": doubled("answer"),
    "a proposal twice": doubled("propose"),
    "a proposal out of turn": data("propose", id=7),
    "a proposal of no block": data("propose", block=9),
    "a proposal of no planned trial": data("propose", planned=99),
    "a rendering that is no number": rendering(u=None),
    "a rendering out of range": rendering(u=1e308),
    "a rendering below its range": rendering(u=-3.0),
    "a rendering that is not the plan's": rendering(u=0.5),
    "no rendering": data("propose", renderings={}),
    "another side": data("propose", renderings={"c": {"u": 0.5, "v": 0.5}}),
    "another step": data("stimulus", step=12),
    "another kind of step": data("stimulus", show="b"),
    "a device in no condition": data("device", condition="on fire"),
    "a device without a condition": without("device", "condition"),
    "a pause by nobody": data("pause", by="the cat"),
    "a note that is no text": data("note", text=7),
    "an event more": data("answer", more=1),
    "a set out of range": header_set(u=1e308),
    "a set without a number": header_set(u="x"),
    "no blocks": lambda lines: lines[0]["data"].update(blocks=[]),
    "a block of a phase that is none": lambda lines: lines[0]["data"]["blocks"][0].update(phase="dance"),
    "a block that needs more than it plans": lambda lines: lines[0]["data"]["blocks"][0].update(count=99),
    "a block of no material": lambda lines: lines[0]["data"]["blocks"][0].update(material="cheese"),
    "a planned trial of no set": lambda lines: lines[0]["data"]["blocks"][0]["trials"][0].update(a="Z"),
    "a participant who is a path": lambda lines: lines[0]["data"].update(participant="../P01"),
    "another schema": lambda lines: lines[0]["data"].update(schema=4),
}


@pytest.mark.parametrize("words", FORGED)
def test_a_log_that_fits_and_says_what_cannot_be_is_refused(tmp_path, words):
    path = tmp_path / "P01_1.session.jsonl"
    lines = write(path, "optimisation")
    chained(path, lines)
    EventLog.resume(path, STUDY.file).close()  # as it was, it is a good log
    FORGED[words](lines)
    chained(path, lines)
    content = path.read_bytes()
    for read in (lambda: EventLog.resume(path, STUDY.file), lambda: read_sessions(tmp_path, STUDY.file)):
        with pytest.raises(InputError, match=r"P01_1\.session\.jsonl"):
            read()
    assert path.read_bytes() == content


@pytest.mark.parametrize("text", [b"[]", b"7", b"{" * 5000, b'{"seq":0}', b"\xff\xfe"])
def test_a_line_that_is_no_event_is_refused(tmp_path, text):
    path = tmp_path / "P01_1.session.jsonl"
    path.write_bytes(text + b',"crc":"%08x"}\n' % zlib.crc32(text))
    with pytest.raises(InputError, match=":1: "):
        EventLog.resume(path, STUDY.file)


def test_a_log_is_its_owners_alone(tmp_path):
    path = tmp_path / "P01_1.session.jsonl"
    write(path, "optimisation")
    assert path.stat().st_mode & 0o077 == 0


def older_words(lines):
    """What earlier versions took: words that begin as a formula does."""
    for kind, key in (("note", "text"), ("undo", "reason"), ("void", "reason")):
        first(lines, kind)["data"][key] = "- participant sneezed"


@pytest.mark.parametrize("person", ["_test", "P01.", "NUL", "Ümit"])
def test_words_and_ids_of_earlier_versions_make_no_log_unreadable(tmp_path, person):
    path = tmp_path / "P01_1.session.jsonl"
    lines = write(path, "optimisation")
    older_words(lines)
    lines[0]["data"]["participant"] = person
    chained(path, lines)
    EventLog.resume(path, STUDY.file).close()
    sessions = read_sessions(tmp_path, STUDY.file)
    exported = psych_ds(sessions, tmp_path / "tables", STUDY.file)
    table = next(file for file in exported if file.name == "study-plain_table-presentations_data.csv").read_text()
    assert "sneezed" not in table and table.count("see the log") == 1
    header = msgspec.structs.replace(sessions[0].header, session="2")
    with pytest.raises(InputError, match="participant is"):
        EventLog.create(tmp_path / "new.session.jsonl", STUDY.file, header)


def test_an_export_names_the_log_whose_label_a_spreadsheet_would_run(tmp_path):
    path = tmp_path / "P01_1.session.jsonl"
    lines = write(path, "optimisation")
    lines[0]["data"]["session"] = "=1+1"
    chained(path, lines)
    with pytest.raises(InputError, match=r"P01_-1-1~[0-9a-f]{8}\.session\.jsonl: the session's label"):
        psych_ds(read_sessions(tmp_path, STUDY.file), tmp_path / "tables", STUDY.file)
