"""HTTP around a hub: pages, JSON, and a stream of views for each role.

    GET  /                       trades the token of a link for a key
    POST /api/join               {"token": …}
    GET  /participant            the page; so /experimenter
    GET  /api/participant        the view; so /api/experimenter, and /api/experimenter/map
    GET  /api/participant/events the same as server-sent events, at every change
    POST /api/participant/…      answer, begin, break, more, here
    POST /api/experimenter/…     pause, resume, repeat, undo, void, abort, note, estop, clear, invite …
    POST /api/stimulus/hello     a program that presents begins
    GET  /preparer               the page of a person who presents; POST /api/preparer/hello and /api/preparer as below
    POST /api/stimulus           report; the response is the newest order (these two, and join, also as form and lines)
    GET  /try, /api/try, /api/try/map   the page of `hilbo try` (`tried`), what it presents, and its end

Errors are {"error": sentence}: 400 not understood, 401 no key, 403 from elsewhere, 404 none there, 409 not now, 413 too
large, 503 not written. The event loop only waits here: files, device and arithmetic have separate threads.
"""

import asyncio
import contextlib
import html
import mimetypes
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any

import msgspec
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import HTMLResponse, Response, StreamingResponse
from starlette.routing import Route

from hilbo.app.hub.commands import COMMANDS, NotNowError, others_present
from hilbo.app.hub.hub import PRESSES
from hilbo.app.rigs.stimulus_rig import OverError, StimulusRig
from hilbo.app.server.tried import Tried
from hilbo.app.wire import lines, messages
from hilbo.app.wire.security import PAGES, Gate, Role
from hilbo.errors import InputError
from hilbo.session.log.event_log import LogError

__all__ = ["application"]

# In memory: a visitor then takes neither a file of this process nor a thread of it.
_FILES = {path.name: path.read_bytes() for path in (Path(__file__).parents[1] / "static").iterdir()}
_ALIVE = 5.0  # s between signs of life in a silent stream
Served = Any
"""The `Hub` of a session, or the check of a stimulus program in its place."""
Handler = Callable[[Request], Awaitable[Response]]
_TAKEN = "This link has been used by a program that is still there; end that one first, or ask for a new link."
_JOIN_TEXTS = ("lang", "wait", "no_link", "used_link", "no_server")
_HEADERS = {
    b"content-security-policy": b"default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self';"
    b" img-src 'self' data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    b"x-content-type-options": b"nosniff",
    b"referrer-policy": b"no-referrer",
    b"cache-control": b"no-store",
    b"cross-origin-opener-policy": b"same-origin",
    b"cross-origin-resource-policy": b"same-origin",
}


class _Guard:
    """ASGI middleware that refuses requests from other hosts and origins with 403, and sets the security headers of all
    responses."""

    def __init__(self, app: Any, gate: Gate):
        self.app, self.gate = app, gate

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """Handle one ASGI connection; a client that disconnects within its body gets no response."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        request = Request(scope)
        why = self.gate.refuses(request.headers)

        async def sending(message):
            if message["type"] == "http.response.start":
                message["headers"] = [*message["headers"], *_HEADERS.items()]
            await send(message)

        with contextlib.suppress(ClientDisconnect):  # in mid-body: no client to answer
            await (_error(403, why) if why else self.app)(scope, receive, sending)


def application(hub: Served, gate: Gate, tried: Tried | None = None) -> Starlette:
    """The ASGI application of one session, or of a replacement of its hub. `tried`: makes the data of the page of
    `hilbo try`, whose routes exist only with it."""
    guarded = _for(hub, gate)
    routes = [
        Route("/", _join_page(hub)),
        Route("/api/join", _json_or_lines(_join(hub, gate)), methods=["POST"]),
        Route("/api/experimenter/map", guarded("experimenter", _map)),
    ]
    routes += [Route(f"/{role}", _page(f"{role}.html")) for role in PAGES]  # without content: that needs the key
    for role in ("participant", "experimenter"):
        routes += [Route(f"/api/{role}", guarded(role, _view)), Route(f"/api/{role}/events", guarded(role, _events))]
    routes += [Route("/api/participant/answer", guarded("participant", _answer), methods=["POST"])]
    routes += [Route(f"/api/participant/{n}", guarded("participant", _press), methods=["POST"]) for n in PRESSES]
    routes += [Route(f"/api/experimenter/{n}", guarded("experimenter", _command), methods=["POST"]) for n in COMMANDS]
    for path, handler in (("", _report), ("/hello", _hello)):
        routes += [Route(f"/api/preparer{path}", guarded("preparer", handler), methods=["POST"])]
        routes += [Route(f"/api/stimulus{path}", _json_or_lines(guarded("stimulus", handler)), methods=["POST"])]
    if tried is not None:
        routes += [Route("/try", _page("try.html")), Route("/api/try", guarded("stimulus", _json_of(tried.facts)))]
        routes += [Route("/api/try/map", guarded("stimulus", _json_of(tried.map)))]
    routes += [Route(f"/static/{name}", _page(name)) for name in _FILES]
    return Starlette(routes=routes, middleware=[Middleware(_Guard, gate=gate)])


def _page(name: str) -> Handler:
    """A handler that returns a file of the folder static, which needs no key."""

    async def page(_request: Request) -> Response:
        return Response(_FILES[name], media_type=mimetypes.guess_type(name)[0])

    return page


def _join_page(hub: Served) -> Handler:
    """A handler that returns the page which trades a link's token for a key, with texts in the study's language."""

    async def way_in(_request: Request) -> Response:
        page = _FILES["join.html"].decode()
        for key in _JOIN_TEXTS:
            page = page.replace(f"{{{key}}}", html.escape(hub.text(key)))
        return HTMLResponse(page)

    return way_in


def _json_or_lines(handler: Handler) -> Handler:
    """A handler whose response is that of `handler` in JSON or, where the request was a form, the same content as lines
    of text with HTTP status 200."""

    async def handle(request: Request) -> Response:
        answer = await handler(request)
        if not getattr(request.state, "form", _is_form(request)):
            return answer
        text = lines.lines_of(answer.status_code, msgspec.json.decode(answer.body))
        return Response(text, media_type="text/plain")

    return handle


def _is_form(request: Request) -> bool:
    """Whether the request's Content-Type is that of a form."""
    return request.headers.get("content-type", "").partition(";")[0].strip().lower() == lines.FORM


async def _message(kind: type, request: Request) -> Any:
    """The request's message, of the class `kind`. A JSON object is read as JSON for any header: many clients
    declare every body a form. Whether it is a form is kept in `request.state.form`. Raises `InputError`."""
    body = await _body(request)
    request.state.form = _is_form(request) and not body.lstrip().startswith(b"{")
    return messages.read(kind, body, request.state.form)


def _join(hub: Served, gate: Gate) -> Handler:
    """The handler of /api/join: trade a token for its role and a new key, which ends the role's other streams.

    A used token is answered only to the browser that has its key, without a new one, and to a stimulus program that
    returns once the present one is gone. Else 400, 401, or 503 where the key cannot be stored.
    """

    async def join(request: Request) -> Response:
        try:
            message = await _message(messages.Join, request)
        except InputError as error:
            return _not_understood(error)
        if gate.asked_for(message.token) == "stimulus" and not message.bearer:
            return _error(400, "This link is for a program that presents, not for a browser; give it to the program.")
        used_by = gate.let_in(message.token)
        if used_by in PAGES and gate.admits(used_by, _bearer(request)):
            return _json({"role": used_by})  # the same browser opens its link again
        back = used_by == "stimulus" and message.bearer and isinstance(hub.rig, StimulusRig)
        if back and not await hub.rig.free():
            return _error(401, _TAKEN)
        try:
            granted = gate.redeem(message.token, again=back)
        except InputError as error:
            return _error(503, str(error))
        if granted is None:
            return _error(401, "This link has been used, or is not of this session; ask for a new one.")
        role, key = granted
        hub.watchers.end(role)
        return _json({"role": role, "key": key})

    return join


def _for(hub: Served, gate: Gate) -> Callable[[Role, Callable], Handler]:
    """A function that makes of a role and a `handler(hub, role, request)` a handler which requires the role's key, else
    401, and turns the errors of hub and messages into responses. A participant's request without a window counts as a
    program's sign of life."""

    def guarded(role: Role, handler: Callable) -> Handler:
        async def handle(request: Request) -> Response:
            if not gate.admits(role, _bearer(request)):
                await _body(request)  # the connection ends with the response; data still under way are dropped
                return _error(401, "Open the link of this session first; this page is no longer part of it.")
            if role == "participant" and _page_of(request) is None:
                hub.watchers.heard()
            try:
                return await handler(hub, role, request)
            except LogError as error:
                return _json({"error": str(error)}, 503)
            except OverError as error:
                return _json({"error": str(error), **error.standing}, 409)
            except NotNowError as error:
                return _json({"error": str(error), "view": hub.view(role)}, 409)
            except InputError as error:
                return _not_understood(error)

        return handle

    return guarded


async def _view(hub: Served, role: Role, _request: Request) -> Response:
    """The view of the role."""
    return _json(hub.view(role))


async def _map(hub: Served, _role: Role, _request: Request) -> Response:
    """The slices of the map, or 404."""
    slices = await hub.map()
    return _error(404, "This session has no map.") if slices is None else _json(slices)


def _json_of(content: Callable[[Any], Awaitable[Any]]) -> Callable:
    """A handler (hub, role, request) whose JSON response is that of the async function `content(hub)`."""

    async def handle(hub: Served, _role: Role, _request: Request) -> Response:
        return _json(await content(hub))

    return handle


async def _answer(hub: Served, role: Role, request: Request) -> Response:
    """Log a participant's answer; the response has what `Hub.answer` returns, and the new view."""
    message = messages.read(messages.Answer, await _body(request))
    accepted = await hub.answer(message, _page_of(request))
    return _json(accepted | {"view": hub.view(role)})


async def _press(hub: Served, role: Role, request: Request) -> Response:
    """Carry out the participant's button that ends the path; the response has the new view."""
    message = messages.read(messages.Press, await _body(request))
    await hub.press(request.url.path.rpartition("/")[2], message, _page_of(request))
    return _json({"view": hub.view(role)})


async def _command(hub: Served, _role: Role, request: Request) -> Response:
    """Carry out the experimenter's command that ends the path."""
    message = messages.read(messages.Command, await _body(request))
    return _json(await hub.command(request.url.path.rpartition("/")[2], message))


def _presenter(hub: Served, role: Role) -> StimulusRig:
    """The rig of a stimulus program or a preparer. Raises `InputError` in sessions in which another rig or role
    presents."""
    if not isinstance(hub.rig, StimulusRig) or hub.rig.role != role:
        raise InputError(others_present(hub.rig.title))
    return hub.rig


async def _hello(hub: Served, role: Role, request: Request) -> Response:
    """Accept a program or preparer's page that joins (`StimulusRig.hello`). Raises `InputError`, which the server
    answers."""
    message = await _message(messages.Hello, request)
    return _json(await _presenter(hub, role).hello(message, _bearer(request) or ""))


async def _report(hub: Served, role: Role, request: Request) -> Response:
    """Apply a report; the response is the current order, perhaps later (`StimulusRig.report`). Raises `InputError`,
    which the server answers."""
    return _json(await _presenter(hub, role).report(await _message(messages.Report, request)))


async def _events(hub: Served, role: Role, request: Request) -> Response:
    """The stream of the role's views, as server-sent events."""
    return StreamingResponse(_stream(hub, role, _page_of(request) or ""), media_type="text/event-stream")


async def _stream(hub: Served, role: Role, page: str) -> AsyncIterator[bytes]:
    """Server-sent events: the view now and after every change, only the newest of several; a comment every `_ALIVE` s;
    at the end the event `moved`, if another window replaced this one. The stream counts as a watcher while it lasts."""
    watcher = hub.watchers.add(role, page)
    hub.publish()
    try:
        yield b"retry: 1000\n\n"
        while not watcher.ended:
            watcher.news.clear()
            yield b"event: view\ndata: " + msgspec.json.encode(hub.view(role)) + b"\n\n"
            while not watcher.news.is_set():
                try:
                    await asyncio.wait_for(watcher.news.wait(), _ALIVE)
                except TimeoutError:
                    yield b": alive\n\n"
        if watcher.why:
            yield b"event: moved\ndata: " + msgspec.json.encode({"error": watcher.why}) + b"\n\n"
    finally:
        hub.watchers.remove(watcher)
        hub.publish()


async def _body(request: Request) -> bytes:
    """The body, read to its end; of one that is too large only the beginning, just longer than a message may be."""
    body = b""
    async for part in request.stream():
        body += part
        if len(body) > messages.LARGEST:
            break
    return body


def _bearer(request: Request) -> str | None:
    """The key in a request's Authorization header; None without one."""
    kind, _, key = request.headers.get("authorization", "").partition(" ")
    return key.strip() if kind.lower() == "bearer" and key.strip() else None


def _page_of(request: Request) -> str | None:
    """The id of the browser window that sends a request, at most 64 characters; None for a program."""
    return request.headers.get("x-hilbo-page", "")[:64] or None


def _json(content: Any, status: int = 200) -> Response:
    """A response with the content as JSON."""
    return Response(msgspec.json.encode(content), status, media_type="application/json")


def _not_understood(error: InputError) -> Response:
    """An error response for a message that is refused: 413 if it is too large, else 400."""
    return _error(413 if isinstance(error, messages.TooLargeError) else 400, str(error))


def _error(status: int, sentence: str) -> Response:
    """A response {"error": sentence} with this status."""
    return _json({"error": sentence}, status)
