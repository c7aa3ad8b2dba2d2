"""The application of REST: routing, authorization and responses.

The memory access checks everything about memories. A request that is refused here never reaches it.
"""

from __future__ import annotations

import asyncio
import contextlib
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias
from urllib.parse import parse_qsl

import msgspec

from holdfast import __version__
from holdfast.adapters.rest import openapi
from holdfast.adapters.rest.changes import MAX_VALUES, ChangeStreams
from holdfast.adapters.rest.refusals import REFUSALS
from holdfast.adapters.rest.routes import CHANGES, INGEST, READ, ROUTES
from holdfast.adapters.sessions import parse_session_id
from holdfast.ingest import Grant, Refused
from holdfast.types import AREAS
from holdfast.web import events
from holdfast.web import openapi_page as page
from holdfast.web.host import address_of
from holdfast.web.refusals import UNREAD, headers_with
from holdfast.web.requests import JSON, SAFE, BadRequest, Request, Response, response, shown

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Mapping, Sequence

    from holdfast._core import ListeningSocket
    from holdfast.adapters.diagnostics import DiagnosticsSource
    from holdfast.adapters.rest.routes import Parameter
    from holdfast.adapters.sessions import SessionControl
    from holdfast.config import RestConfig
    from holdfast.ingest import MemoryAccess

    Later: TypeAlias = Coroutine[Any, Any, Response | None]
    Handler: TypeAlias = Callable[[Request], Response | Later]

MORE_PARAMETERS = 4
"""Parameters that are read in excess of the allowed ones, for an error that names the wrong one."""
ANYONE = "anyone"
"""The name of the client when no tokens are configured."""


class Declined(Refused):
    """A refusal before the memory access was called, which has not counted it yet."""


class EndSession(msgspec.Struct, forbid_unknown_fields=True):
    """The body of a request that ends a session."""

    id: str


class App:
    """The application."""

    def __init__(
        self,
        settings: RestConfig,
        memory_access: MemoryAccess,
        diagnostics: DiagnosticsSource,
        sessions: SessionControl,
        listener: ListeningSocket,
        scheme: str,
    ) -> None:
        self._memory_access = memory_access
        self._diagnostics = diagnostics
        self._sessions = sessions
        self._max_body = settings.max_body
        tokens = () if settings.tokens == "none" else settings.tokens
        self._tokens = [(token.name, bytes.fromhex(token.sha256)) for token in tokens]
        self._grants = {
            token.name: Grant(
                token.name,
                frozenset(token.memories),
                frozenset(token.areas),
                token.access == "read-write",
                frozenset(token.while_sealed or ()),
            )
            for token in tokens
        }
        self._managers = {token.name for token in tokens if token.manage}
        self._streams = ChangeStreams(settings.max_connections)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._anyone = (
            Grant(ANYONE, frozenset(memory_access.memories), frozenset(AREAS))
            if settings.tokens == "none"
            else None
        )
        host, port, *_ = listener.getsockname()
        document = openapi.document(__version__, self._max_body, secured=self._anyone is None)
        self._document = msgspec.json.encode(document)
        self._page = page.render(document, f"{scheme}://{address_of(host, port)}")
        handlers: dict[str, Handler] = {
            "ingest": self._ingest,
            "read": self._read,
            "changes": self._changes,
            "health": self._health,
            "memories": self._memories,
            "stats": self._stats,
            "mqtt": self._mqtt,
            "sessions": self._list_sessions,
            "end_session": self._end_session,
            "openapi": self._openapi,
            "docs": self._docs,
        }
        self.routes = {each.path: (each.method, handlers[each.name]) for each in ROUTES}

    def __call__(self, request: Request) -> Response | Later:
        """Answers one request; at once, unless its body still arrives or something must wait."""
        self._loop = asyncio.get_running_loop()
        try:
            answer = self._answer(request)
        except (BadRequest, Refused) as refused:
            return self._refusal(request, refused)
        return answer if isinstance(answer, Response) else self._finished(request, answer)

    async def _finished(self, request: Request, answer: Later) -> Response | None:
        try:
            return await answer
        except (BadRequest, Refused) as refused:
            return self._refusal(request, refused)

    @property
    def open_streams(self) -> int:
        """How many change streams are open."""
        return self._streams.open

    def end(self) -> None:
        """Ends all streams. Thread-safe."""
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):  # The loop is already closed.
                self._loop.call_soon_threadsafe(self._streams.end)

    def _answer(self, request: Request) -> Response | Later:
        route = self.routes.get(request.path)
        if route is None:
            raise Declined("not_found", f"no resource at {shown(request.path)}")
        allowed, handler = route
        if request.method == allowed or (request.method == "HEAD" and allowed == "GET"):
            return handler(request)
        methods = "POST, OPTIONS" if allowed == "POST" else "GET, HEAD, OPTIONS"
        if request.method == "OPTIONS":
            answer = Response(204, headers=list(SAFE))
        else:
            refused = Declined("method_not_allowed", f"allowed: {methods}")
            answer = self._refusal(request, refused)
        answer.headers.append((b"allow", methods.encode()))
        return answer

    def _refusal(self, request: Request, refused: BadRequest | Refused) -> Response:
        """Returns the refusal, and counts it unless the memory access has."""
        if isinstance(refused, BadRequest):
            refused = Declined(refused.reason, refused.detail)
        if isinstance(refused, Declined):
            write = (request.path, request.method) == (INGEST.path, INGEST.method)
            note = self._memory_access.refuse if write else self._memory_access.note
            note(refused, request.who, request.peer)
        status = REFUSALS.status(refused.reason)
        answer = _json(refused.answer(), *headers_with(status), status=status)
        answer.closes = status in UNREAD or request.header(b"expect") is not None
        return answer

    def _ingest(self, request: Request) -> Response | Later:
        grant = self._authorize(request)
        request.check_json()
        body = request.arrived(self._max_body)
        if body is None or self._memory_access.may_wait:
            return self._ingest_later(request, grant)
        return _json(self._memory_access.ingest(body, grant, request.peer).answer())

    async def _ingest_later(self, request: Request, grant: Grant) -> Response:
        """Writes a body that still arrives, or to a memory whose writes can wait."""
        body = await request.body(self._max_body)
        ingest = partial(self._memory_access.ingest, body, grant, request.peer)
        written = await asyncio.to_thread(ingest) if self._memory_access.may_wait else ingest()
        return _json(written.answer())

    def _read(self, request: Request) -> Response:
        grant = self._authorize(request)
        given = _given(request.query, READ.parameters)
        values = self._memory_access.read(**given, grant=grant, peer=request.peer)
        return _json({"values": values})

    def _changes(self, request: Request) -> Response | Later:
        grant = self._authorize(request)
        given = _given(request.query, CHANGES.parameters)
        memory, ranges = given["memory"], _ranges(given)
        self._streams.check_room()
        follower = self._memory_access.follow(memory, ranges, grant, request.peer)
        if request.method == "HEAD":
            return Response(200, headers=list(events.HEADERS))
        places = [(memory, area) for area, _, _ in ranges]
        return self._streams.serve(request, follower, places, given["min_interval"])

    def _health(self, _: Request) -> Response:
        return _json({"status": "ok"})

    def _memories(self, request: Request) -> Response:
        grant = self._authorize(request)
        memories = self._diagnostics.memories()
        shown = {name: entry for name, entry in memories.items() if name in grant.memories}
        return _json({"memories": shown})

    def _stats(self, request: Request) -> Response:
        self._authorize(request)
        return _json(self._diagnostics.stats())

    def _mqtt(self, request: Request) -> Response:
        self._authorize(request)
        status = self._diagnostics.adapter("mqtt")
        if status is None:
            raise Declined("not_configured", "the configuration has no mqtt")
        least: dict[str, object] = {"connected": False, "broker": None, "topics": []}
        return _json(least | status)

    def _list_sessions(self, request: Request) -> Response:
        self._authorize_manager(request)
        return _json({"sessions": self._sessions.sessions()})

    async def _end_session(self, request: Request) -> Response:
        grant = self._authorize_manager(request)
        request.check_json()
        body = await request.body(self._max_body)
        try:
            asked = msgspec.json.decode(body, type=EndSession)
            listener, number = parse_session_id(asked.id)
        except ValueError as error:
            raise _malformed(str(error)) from None
        by = {"listener": "rest", "peer": request.peer, "source": grant.name}
        if not await asyncio.to_thread(self._sessions.end_session, listener, number, by):
            raise Declined("unknown_session", f"no session {shown(asked.id)}")
        return _json({"status": "ended", "id": asked.id})

    def _openapi(self, _: Request) -> Response:
        return response(JSON, self._document)

    def _docs(self, _: Request) -> Response:
        return response(page.KIND, self._page, (b"content-security-policy", page.POLICY))

    def _authorize(self, request: Request) -> Grant:
        """Returns the grant of the request's client. Raises `Declined` and `BadRequest`."""
        if self._anyone is not None:
            if not request.is_direct():
                # DNS rebinding: a web page can point its own name at this machine, but the browser
                # still sends that name as Host.
                host = shown((request.header(b"host") or b"").decode("latin-1"))
                detail = f"Host is {host}, allowed without tokens: an IP address or localhost"
                raise Declined("not_granted", detail)
            request.who = ANYONE
            return self._anyone
        grant = self._grants[request.owner(self._tokens)]
        request.who = grant.name
        return grant

    def _authorize_manager(self, request: Request) -> Grant:
        """As `_authorize`, for a client that may manage the appliance."""
        grant = self._authorize(request)
        if grant.name not in self._managers:
            detail = f"{grant.name} may not manage sessions, allowed: tokens with manage: true"
            raise Declined("not_granted", detail)
        return grant


def _given(query: bytes, parameters: Sequence[Parameter]) -> dict[str, Any]:
    """Parses a query: every parameter once, unless it has a default or may be repeated.

    Raises `BadRequest` or `Declined`.
    """
    known = {each.name: each for each in parameters}
    names = ", ".join(known)
    most = sum(each.most for each in parameters) + MORE_PARAMETERS
    try:
        pairs = parse_qsl(query.decode("latin-1"), keep_blank_values=True, max_num_fields=most)
    except ValueError:
        raise _malformed(f"more than {most} parameters, allowed: {names}") from None
    given: dict[str, list[str]] = {}
    for name, value in pairs:
        if name not in known:
            raise _malformed(f"{shown(name)} is not a parameter, allowed: {names}")
        values = given.setdefault(name, [])
        values.append(value)
        if len(values) > known[name].most:
            times = "once" if known[name].most == 1 else f"{known[name].most} times"
            raise _malformed(f"{name} is given more than {times}")
    required = [each.name for each in parameters if each.default is None]
    for name in required:
        if name not in given:
            raise _malformed(f"{name} is missing, required: {', '.join(required)}")
    return {name: each.parse(given.get(name)) for name, each in known.items()}


def _ranges(given: Mapping[str, Any]) -> list[tuple[str, int, int]]:
    """Returns the ranges of a query. Raises `Declined` if they are incomplete or too large."""
    areas, addresses, counts = (given[key] for key in ("area", "address", "count"))
    if not len(areas) == len(addresses) == len(counts):
        found = f"{len(areas)} area, {len(addresses)} address and {len(counts)} count"
        raise _malformed(f"the query has {found}, allowed: the same number of each")
    if sum(counts) > MAX_VALUES:
        raise _malformed(f"the ranges have {sum(counts)} values, allowed: {MAX_VALUES}")
    return list(zip(areas, addresses, counts, strict=True))


def _malformed(detail: str) -> Declined:
    return Declined("malformed", detail)


def _json(document: Any, *more: tuple[bytes, bytes], status: int = 200) -> Response:
    """Returns a response in JSON; values of other types are as their text."""
    return response(JSON, msgspec.json.encode(document, enc_hook=str), *more, status=status)
