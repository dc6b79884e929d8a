"""The stimulus's messages as a form and as lines: the same session, for programs without a JSON parser."""

import asyncio
import urllib.error
import urllib.parse
import urllib.request

import pytest
from live_server import PATIENCE
from live_stimulus import SETS, LiveStimulus
from starlette.requests import Request

from hilbo.app.server import server
from hilbo.app.wire import messages
from hilbo.app.wire.lines import fields_of, lines_of
from hilbo.errors import InputError
from hilbo.study.file.plan_file import Block, Planned


def test_a_form_is_read_as_text():
    fields = fields_of(b"order=5&state=presented&value.hue=211.0&value.an+%C3%BC%3D1=x&why=")
    assert fields == {"order": "5", "state": "presented", "why": "", "values": {"hue": "211.0", "an ü=1": "x"}}
    assert fields_of(b"") == {}


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (b"order=5&order=6", "has order twice"),
        (b"value.a=5&value.a=6", "has value.a twice"),
        (b"order", "not understood"),
        (b"why=%ff", "not understood"),
        (b"&".join(b"k%d=1" % i for i in range(65)), "not understood"),
    ],
)
def test_a_form_that_cannot_be_meant_is_refused_in_a_sentence(body, words):
    with pytest.raises(InputError, match=words):
        fields_of(body)


def test_an_answer_has_a_line_for_each_fact():
    parameter = {"name": "a b", "unit": "c/deg", "low": 0.1, "high": 1e-7, "tolerance": 0.5}
    content = {"run": "x\ty\nz", "parameters": [parameter], "do": "present", "values": {"a b": 1 / 3, "kind": "red"}}
    assert lines_of(200, content).split("\n") == [
        "status\t200",
        "run\tx y z",
        "parameter\ta b\t0.1\t1e-07\t0.5\tc/deg",
        "do\tpresent",
        "value\ta b\t0.3333333333333333",
        "value\tkind\tred",
        "",
    ]
    assert lines_of(409, {"force": True}) == "status\t409\nforce\ttrue\n"


def request_of(body: bytes) -> Request:
    """As curl and Python's urllib send a body whose kind nobody states: with the header of a form."""

    async def receive():
        return {"type": "http.request", "body": body}

    return Request({"type": "http", "headers": [(b"content-type", b"application/x-www-form-urlencoded")]}, receive)


def test_an_object_of_json_is_no_form_whatever_its_header_says():
    for body, form in ((b' {"token": "abc"}', False), (b"token=abc", True)):
        request = request_of(body)
        assert asyncio.run(server._message(messages.Join, request)).token == "abc"
        assert request.state.form == form


class Form:
    """A program that posts forms and reads lines."""

    def __init__(self, link):
        self.address, _, token = link.partition("/#")
        self.key = ""
        self.key = self.post("/api/join", token=token, bearer="true")["key"]

    def post(self, path, **fields):
        headers = {"Authorization": f"Bearer {self.key}"} if self.key else {}
        body = urllib.parse.urlencode(fields).encode()
        with urllib.request.urlopen(
            urllib.request.Request(self.address + path, body, headers), timeout=PATIENCE
        ) as reply:
            assert reply.status == 200 and reply.headers["content-type"].startswith("text/plain")
            lines = [line.split("\t") for line in reply.read().decode().splitlines()]
        assert lines[0][0] == "status"
        single = {line[0]: line[1] for line in lines if len(line) == 2}
        return single | {f"value.{line[1]}": line[2] for line in lines if line[0] == "value"}


def test_a_session_by_forms_and_what_is_refused(tmp_path):
    with LiveStimulus(tmp_path, blocks=(Block("warm-up", 1, (Planned("best"),)),), felt=60.0) as live:
        program = Form(live.link())
        assert program.post("/api/join", token="x")["status"] == "401"
        refused = program.post("/api/stimulus/hello", name="form", version="1", force="perhaps", neutral_within_s="0.5")
        assert refused["status"] == "400" and "force" in refused["error"]
        said = program.post("/api/stimulus/hello", name="form", version="1", force="false", neutral_within_s="0.5")
        run, order = said["run"], said
        live.participant.post("/api/participant/begin", {})

        def report(state, **more):
            return program.post("/api/stimulus", run=run, order=order["order"], state=state, **more)

        while order.get("show") != "test":
            presents = {"trial": order["trial"]} if order["do"] == "present" else {}
            order = report("presented" if presents else "neutral", wait_s="0.3", **presents)
        values = {key: text for key, text in order.items() if key.startswith("value.")}
        assert values == {f"value.{name}": repr(number) for name, number in SETS["best"].items()}
        for status, words, wrong in (
            ("409", "which is no number", {"value.hue": "nan"}),
            ("409", "hue is confirmed as red; it must be a number from", {"value.hue": "red"}),
            ("409", "hue is confirmed as inf, which is no number", {"value.hue": "1e999"}),
            ("400", "unknown field", {"colour": "3"}),
            ("409", "and for nothing else", {"value.depth": "3"}),
        ):
            reply = report("presented", trial=order["trial"], **values | wrong)
            assert reply["status"] == status and words in reply["error"], reply
        assert report("presented", trial=order["trial"], **values)["status"] == "200"
        live.until(lambda _: live.events("sent"))
        assert live.events("sent")[0].data["values"] == SETS["best"]
        program.key = "another"
        assert report("neutral")["status"] == "401"
