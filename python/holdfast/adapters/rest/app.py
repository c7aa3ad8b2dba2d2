"""The ASGI application of REST: routing, authorization and responses.

The memory access checks everything about memories. A request that is refused here never reaches it.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable
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
from holdfast.web import openapi_page as page
from holdfast.web.events import headers_of_stream
from holdfast.web.host import SAFE, address_of, headers_of, respond
from holdfast.web.refusals import UNREAD, headers_with
from holdfast.web.requests import BadRequest, ClientDisconnected, Request, respond_to_its_end, shown

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable, Mapping, Sequence

    from holdfast.adapters.diagnostics import DiagnosticsSource
    from holdfast.adapters.rest.routes import Parameter
    from holdfast.adapters.sessions import SessionControl
    from holdfast.config import RestConfig
    from holdfast.ingest import MemoryAccess
    from holdfast.web.host import Receive, Scope, Send

    Answer: TypeAlias = tuple[bytes, bytes]
    Following: TypeAlias = Callable[[Send], Awaitable[None]]
    Handler: TypeAlias = Callable[[Request], Answer | Following | Awaitable[Answer]]

JSON = b"application/json"
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
    """The ASGI application."""

    def __init__(
        self,
        settings: RestConfig,
        memory_access: MemoryAccess,
        diagnostics: DiagnosticsSource,
        sessions: SessionControl,
        listener: socket.socket,
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

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answers one request."""
        self._loop = asyncio.get_running_loop()
        request = Request(scope, receive)
        try:
            answer = await self._answer(request)
        except BadRequest as unfit:
            await self._refuse(request, Declined(unfit.reason, unfit.detail), send)
        except Refused as refused:
            await self._refuse(request, refused, send)
        except ClientDisconnected:
            pass
        else:
            if not isinstance(answer, tuple):
                await answer(send)
                return
            kind, body = answer
            headers = headers_of(kind, body) if body else list(SAFE)
            await respond(send, 200 if body else 204, headers + request.more_headers, body)

    @property
    def open_streams(self) -> int:
        """How many change streams are open."""
        return self._streams.open

    def end(self) -> None:
        """Ends all streams. Thread-safe."""
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):  # The loop is already closed.
                self._loop.call_soon_threadsafe(self._streams.end)

    async def _answer(self, request: Request) -> Answer | Following:
        path, method = request.scope["path"], request.scope["method"]
        route = self.routes.get(path)
        if route is None:
            raise Declined("not_found", f"no resource at {shown(path)}")
        allowed, handler = route
        if method == allowed or (method == "HEAD" and allowed == "GET"):
            answer = handler(request)
            return await answer if isinstance(answer, Awaitable) else answer
        methods = "POST, OPTIONS" if allowed == "POST" else "GET, HEAD, OPTIONS"
        request.more_headers.append((b"allow", methods.encode()))
        if method == "OPTIONS":
            return JSON, b""
        raise Declined("method_not_allowed", f"allowed: {methods}")

    async def _refuse(self, request: Request, refused: Refused, send: Send) -> None:
        """Sends the refusal, and counts it unless the memory access has."""
        if isinstance(refused, Declined):
            asked = request.scope["path"], request.scope["method"]
            write = asked == (INGEST.path, INGEST.method)
            note = self._memory_access.refuse if write else self._memory_access.note
            note(refused, request.who, request.peer)
        status = REFUSALS.status(refused.reason)
        body = msgspec.json.encode(refused.answer())
        headers = headers_of(JSON, body) + request.more_headers + headers_with(status)
        if status in UNREAD or request.header(b"expect") is not None:
            await respond_to_its_end(request, send, status, headers, body)
        else:
            await respond(send, status, headers, body)

    async def _ingest(self, request: Request) -> Answer:
        grant = self._authorize(request)
        request.check_json()
        body = await request.body(self._max_body)
        ingest = partial(self._memory_access.ingest, body, grant, request.peer)
        written = await asyncio.to_thread(ingest) if self._memory_access.may_wait else ingest()
        return JSON, msgspec.json.encode(written.answer())

    def _read(self, request: Request) -> Answer:
        grant = self._authorize(request)
        given = _given(request.scope["query_string"], READ.parameters)
        values = self._memory_access.read(**given, grant=grant, peer=request.peer)
        return JSON, msgspec.json.encode({"values": values})

    def _changes(self, request: Request) -> Following:
        grant = self._authorize(request)
        given = _given(request.scope["query_string"], CHANGES.parameters)
        memory, ranges = given["memory"], _ranges(given)
        self._streams.check_room()
        follower = self._memory_access.follow(memory, ranges, grant, request.peer)
        if request.method == "HEAD":
            headers = headers_of_stream() + request.more_headers
            return lambda send: respond(send, 200, headers)
        places = [(memory, area) for area, _, _ in ranges]
        return partial(self._streams.serve, request, follower, places, given["min_interval"])

    def _health(self, _: Request) -> Answer:
        return JSON, b'{"status":"ok"}'

    def _memories(self, request: Request) -> Answer:
        grant = self._authorize(request)
        memories = self._diagnostics.memories()
        shown = {name: entry for name, entry in memories.items() if name in grant.memories}
        return JSON, msgspec.json.encode({"memories": shown})

    def _stats(self, request: Request) -> Answer:
        self._authorize(request)
        return JSON, _encoded(self._diagnostics.stats())

    def _mqtt(self, request: Request) -> Answer:
        self._authorize(request)
        status = self._diagnostics.adapter("mqtt")
        if status is None:
            raise Declined("not_configured", "the configuration has no mqtt")
        least: dict[str, object] = {"connected": False, "broker": None, "topics": []}
        return JSON, _encoded(least | status)

    def _list_sessions(self, request: Request) -> Answer:
        self._authorize_manager(request)
        return JSON, msgspec.json.encode({"sessions": self._sessions.sessions()})

    async def _end_session(self, request: Request) -> Answer:
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
        return JSON, msgspec.json.encode({"status": "ended", "id": asked.id})

    def _openapi(self, _: Request) -> Answer:
        return JSON, self._document

    def _docs(self, request: Request) -> Answer:
        request.more_headers.append((b"content-security-policy", page.POLICY))
        return page.KIND, self._page

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


def _encoded(document: Any) -> bytes:
    """Encodes the status of adapters as JSON; values of other types as their text."""
    return msgspec.json.encode(document, enc_hook=str)
