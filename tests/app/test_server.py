"""Who the server of a live session lets do what, through the JSON that pages and programs speak; what it refuses."""

import json
import random
import urllib.error
from pathlib import Path

import pytest
from live_server import Live, ask, refused

import hilbo
from hilbo.app.hub.commands import COMMANDS
from hilbo.app.hub.hub import PRESSES


@pytest.fixture(scope="module")
def quiet(tmp_path_factory):
    """A session in which nobody presses Begin."""
    with Live(tmp_path_factory.mktemp("quiet")) as session:
        session.until(lambda view: view["may"]["begin"])
        session.until(lambda _: session.hub.state.pending.sent)
        yield session


PATHS = [
    *(("participant", path) for path in ("", "/events")),
    *(("participant", f"/{name}") for name in ("answer", *PRESSES)),
    *(("experimenter", path) for path in ("", "/events", "/map")),
    *(("experimenter", f"/{name}") for name in COMMANDS),
]
READS = ("", "/events", "/map")


@pytest.mark.parametrize(("role", "path"), PATHS)
def test_everything_needs_the_key_of_its_role(quiet, role, path):
    other = quiet.experimenter if role == "participant" else quiet.participant
    data = None if path in READS else b"{}"
    before = quiet.hub.state.seq
    for key in (None, "wrong", other._key):
        headers = {} if key is None else {"Authorization": f"Bearer {key}"}
        with refused(401):
            ask(quiet, f"/api/{role}{path}", data=data, **headers)
    assert quiet.hub.state.seq == before


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "example.org"},
        {"Host": "example.org:80"},
        {"Origin": "http://example.org"},
        {"Origin": "null"},
        {"Sec-Fetch-Site": "cross-site"},
    ],
)
@pytest.mark.parametrize("path", ["/", "/static/participant.js", "/participant", "/api/participant", "/api/join"])
def test_what_comes_from_elsewhere_is_refused_with_the_right_key_too(quiet, path, headers):
    with refused(403):
        ask(quiet, path, Authorization=f"Bearer {quiet.participant._key}", **headers)


def test_no_cookie_is_set_and_none_counts(quiet):
    origin = quiet.participant.address
    for role in ("participant", "experimenter"):
        key = {"participant": quiet.participant, "experimenter": quiet.experimenter}[role]._key
        port = origin.rpartition(":")[2]
        cookie = "; ".join(f"{name}={key}" for name in (f"hilbo_{role}_{port}", f"hilbo.key.{role}", "Authorization"))
        for path, data in (("", None), ("/events", None), ("/begin" if role == "participant" else "/note", b"{}")):
            with refused(401):
                ask(quiet, f"/api/{role}{path}", data=data, Cookie=cookie, Origin=origin)
    with ask(quiet, "/api/participant", Authorization=f"Bearer {quiet.participant._key}", Origin=origin) as reply:
        assert reply.headers["Set-Cookie"] is None
        assert "default-src 'none'" in reply.headers["Content-Security-Policy"]
        assert reply.headers["Cache-Control"] == "no-store"


def test_a_page_has_no_content_without_a_key(quiet):
    with ask(quiet, "/experimenter") as page:
        assert page.read() == (Path(hilbo.__file__).parent / "app" / "static" / "experimenter.html").read_bytes()
    with refused(401):
        quiet.participant.post("/api/join", {"token": "again"})


def test_what_is_not_understood_is_refused_and_harms_nothing(quiet):
    view = quiet.until(lambda view: view["trial"])
    rng, before = random.Random(0), quiet.hub.state.seq
    for number in range(200):
        with refused_somehow():
            quiet_post(quiet, "answer", malformed(rng, view["trial"]["id"], number))
    assert quiet.hub.state.seq == before
    assert quiet.view() == view


def malformed(rng, trial, number):
    """A message that is none: bytes, wrong types, unknown keys, wrong names, endless or deep ones."""
    good = {"trial": trial, "client": "c", "answers": {"class_a": "close"}, "response_ms": 1.0}
    kinds = [
        lambda: rng.randbytes(rng.randrange(1, 200)),
        lambda: json.dumps(good | {"extra": 1}).encode(),
        lambda: json.dumps({k: v for k, v in good.items() if k != rng.choice(list(good)[:3])}).encode()[:-1],
        lambda: json.dumps(good | {rng.choice(list(good)): rng.choice([None, 3, [], {}, "", True])}).encode(),
        lambda: json.dumps(
            good | {"trial": rng.choice(["", "tag:1", "x:1.1", "tag:999.1", "tag:-1.1", "tag:1.99"])}
        ).encode(),
        lambda: json.dumps(good | {"answers": {"class_a": "best"}}).encode(),
        lambda: json.dumps(good | {"client": "c" * 65}).encode(),
        lambda: b"[" * 20_000,
        lambda: json.dumps(good | {"clicked": "x" * 20_000}).encode(),
        lambda: json.dumps(good | {"response_ms": rng.choice([-1, 1e300])}).encode(),
        lambda: b'{"trial": "\xff\xfe"}',
        lambda: b"null",
    ]
    return kinds[number % len(kinds)]()


def quiet_post(live, name, data):
    ask(live, f"/api/participant/{name}", data=data, Authorization=f"Bearer {live.participant._key}")


def test_a_browser_that_opens_its_used_link_again_finds_its_page_and_nobody_else_does(quiet):
    body = json.dumps({"token": quiet.place.link("preparer").partition("#")[2]}).encode()
    page = {"Content-Type": "application/json", "Origin": quiet.participant.address}
    with ask(quiet, "/api/join", data=body, **page) as first:
        joined = json.load(first)
        assert joined["role"] == "preparer" and first.headers["Set-Cookie"] is None
    with ask(quiet, "/api/join", data=body, **page, Authorization=f"Bearer {joined['key']}") as again:
        assert json.load(again) == {"role": "preparer"}
    wrong = joined["key"][:-1] + ("_" if joined["key"].endswith("-") else "-")
    for other in ({}, {"Authorization": f"Bearer {wrong}"}, {"Cookie": f"hilbo_preparer={joined['key']}"}):
        with refused(401, "This link has been used"):
            ask(quiet, "/api/join", data=body, **page, **other)


class refused_somehow:  # noqa: N801  (read as a word)
    def __enter__(self):
        return self

    def __exit__(self, kind, error, trace):
        assert isinstance(error, urllib.error.HTTPError), error
        with error:
            assert error.code in (400, 409, 413), error
            assert json.loads(error.read())["error"]
        return True


def test_the_documents_name_every_address():
    text = (Path(__file__).parents[2] / "docs" / "guides" / "live.md").read_text(encoding="utf-8")
    for name in (*PRESSES, *COMMANDS, "answer", "events", "join"):
        assert f"`{name}`" in text or f"/{name}" in text, name


class German(Live):
    """The same session in German, with a text of the study's own."""

    def make_study(self, seconds, warm_up):
        file = super().make_study(seconds, warm_up)
        path = self.folder / "study.toml"
        words = '[session]\nlanguage = "de"\ntexts = {no_link = "<b> \\"&"}\n'
        path.write_text(path.read_text().replace("[session.warm_up]", f"{words}[session.warm_up]"))
        return type(file).load(path)


def test_the_way_in_speaks_the_language_of_the_study(tmp_path, quiet):
    def page(live):
        with ask(live, "/") as reply:
            return reply.read().decode()

    assert '<html lang="en">' in page(quiet) and "This page needs a link." in page(quiet)
    with German(tmp_path, warm=False) as live:
        german = page(live)
    assert (
        '<html lang="de">' in german and "Einen Moment bitte" in german and "Dieser Link wurde schon benutzt" in german
    )
    assert 'data-no-link="&lt;b&gt; &quot;&amp;"' in german and "{" not in german
