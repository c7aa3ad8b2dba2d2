"""The routes: what a request asks for, who asks, and how it is answered.

A plain ASGI application. All that bears on memory is the door's work; what is refused here was
refused before it came to the memory access.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, TypeAlias
from urllib.parse import parse_qsl

import msgspec

from holdfast import __version__
from holdfast.adapters.rest import openapi
from holdfast.ingest import Grant, Refused
from holdfast.types import AREAS
from holdfast.web import openapi_page as page
from holdfast.web.host import SAFE, address_of, headers_of, respond
from holdfast.web.requests import BadRequest, ClientDisconnected, Request, respond_to_its_end, shown

if TYPE_CHECKING:
    import socket
    from collections.abc import Awaitable, Callable

    from holdfast.appliance.diagnostics import Diagnostics
    from holdfast.config import RestConfig
    from holdfast.ingest import MemoryAccess
    from holdfast.web.host import Receive, Scope, Send

    Answer: TypeAlias = tuple[bytes, bytes]
    Handler: TypeAlias = Callable[[Request], Answer | Awaitable[Answer]]

STATUSES = {
    reason: int(status) for status, reasons in openapi.REASONS.items() for reason in reasons
}
"""The status of an answer, by the reason of the refusal."""

JSON = b"application/json"
INGEST = "/api/v1/ingest"
PARAMETERS = ("memory", "area", "address", "count")
ANYONE = "anyone"
"""Who asks, where there are no tokens."""

LINGER_TIMEOUT = 2.0
"""Seconds that a client has to end a body that is too large, so that it gets the answer."""


class Declined(Refused):
    """Refused before it came to the memory access, which does not know of it yet."""


class App:
    """The ASGI application."""

    def __init__(
        self,
        settings: RestConfig,
        memory_access: MemoryAccess,
        diagnostics: Diagnostics,
        listener: socket.socket,
    ) -> None:
        self._memory_access = memory_access
        self._diagnostics = diagnostics
        self._max_body = settings.max_body
        tokens = () if settings.tokens == "none" else settings.tokens
        self._tokens = [(token.name, bytes.fromhex(token.sha256)) for token in tokens]
        self._grants = {
            token.name: Grant(
                token.name,
                frozenset(token.memories),
                frozenset(token.areas),
                token.access == "read-write",
            )
            for token in tokens
        }
        self._anyone = (
            Grant(ANYONE, frozenset(memory_access.memories), frozenset(AREAS))
            if settings.tokens == "none"
            else None
        )
        host, port, *_ = listener.getsockname()
        document = openapi.document(__version__, self._max_body, secured=self._anyone is None)
        self._document = msgspec.json.encode(document)
        self._page = page.render(document, f"http://{address_of(host, port)}")
        self.routes: dict[str, tuple[str, Handler]] = {
            INGEST: ("POST", self._ingest),
            "/api/v1/memory/read": ("GET", self._read),
            "/api/v1/health": ("GET", self._health),
            "/api/v1/diagnostics/memory": ("GET", self._memories),
            "/api/v1/diagnostics/stats": ("GET", self._stats),
            "/api/v1/diagnostics/mqtt": ("GET", self._mqtt),
            "/openapi.json": ("GET", self._openapi),
            "/docs": ("GET", self._docs),
        }

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answers one request."""
        request = Request(scope, receive)
        try:
            kind, body = await self._answer(request)
        except BadRequest as unfit:
            await self._refuse(request, Declined(unfit.reason, unfit.detail), send)
        except Refused as refused:
            await self._refuse(request, refused, send)
        except ClientDisconnected:
            pass
        else:
            headers = headers_of(kind, body) if body else list(SAFE)
            await respond(send, 200 if body else 204, headers + request.more_headers, body)

    async def _answer(self, request: Request) -> Answer:
        path, method = request.scope["path"], request.scope["method"]
        route = self.routes.get(path)
        if route is None:
            raise Declined("not_found", f"there is nothing at {shown(path)}")
        allowed, handler = route
        if method == allowed or (method == "HEAD" and allowed == "GET"):
            answer = handler(request)
            return answer if isinstance(answer, tuple) else await answer
        methods = "POST, OPTIONS" if allowed == "POST" else "GET, HEAD, OPTIONS"
        request.more_headers.append((b"allow", methods.encode()))
        if method == "OPTIONS":
            return JSON, b""
        raise Declined("method_not_allowed", f"allowed are {methods}")

    async def _refuse(self, request: Request, refused: Refused, send: Send) -> None:
        """Counts what the door does not know of, and answers."""
        if isinstance(refused, Declined):
            write = request.scope["path"] == INGEST and request.scope["method"] == "POST"
            note = self._memory_access.refuse if write else self._memory_access.note
            note(refused, request.who, request.peer)
        status = STATUSES[refused.reason]
        body = msgspec.json.encode(refused.answer())
        headers = headers_of(JSON, body) + request.more_headers
        if status == 401:
            headers.append((b"www-authenticate", b"Bearer"))
        if status in (408, 413) or request.header(b"expect") is not None:
            await respond_to_its_end(request, send, status, headers, body)
        else:
            await respond(send, status, headers, body)

    async def _ingest(self, request: Request) -> Answer:
        grant = self._authorize(request)
        request.check_json()
        body = await request.body(self._max_body)
        return JSON, msgspec.json.encode(
            self._memory_access.ingest(body, grant, request.peer).answer()
        )

    def _read(self, request: Request) -> Answer:
        grant = self._authorize(request)
        memory, area, address, count = _parameters(request.scope["query_string"])
        start = _number("address", address, 0, 65535)
        amount = _number("count", count, 1, 65536)
        values = self._memory_access.read(memory, area, start, amount, grant, request.peer)
        return JSON, msgspec.json.encode({"values": values})

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

    def _openapi(self, _: Request) -> Answer:
        return JSON, self._document

    def _docs(self, request: Request) -> Answer:
        request.more_headers.append((b"content-security-policy", page.POLICY))
        return page.KIND, self._page

    def _authorize(self, request: Request) -> Grant:
        """Whose request it is. Raises `Declined`."""
        if self._anyone is not None:
            if not request.is_direct:
                # A page of the web can make its own name lead to this machine, but not change it.
                host = shown((request.header(b"host") or b"").decode("latin-1"))
                detail = f"Host is {host}, without tokens allowed are IP addresses and localhost"
                raise Declined("not_granted", detail)
            request.who = ANYONE
            return self._anyone
        grant = self._grants[request.owner(self._tokens)]
        request.who = grant.name
        return grant


def _parameters(query: bytes) -> list[str]:
    """The four parameters of a read, in their order. Raises `Declined`."""
    names = ", ".join(PARAMETERS)
    try:
        pairs = parse_qsl(query.decode("latin-1"), keep_blank_values=True, max_num_fields=8)
    except ValueError:
        raise _malformed(f"there are more than 8 parameters, allowed are {names}") from None
    given: dict[str, str] = {}
    for name, value in pairs:
        if name not in PARAMETERS:
            raise _malformed(f"{shown(name)} is not a parameter, allowed are {names}")
        if name in given:
            raise _malformed(f"{name} is given more than once, allowed is once")
        given[name] = value
    for name in PARAMETERS:
        if name not in given:
            raise _malformed(f"{name} is missing, needed are {names}")
    return [given[name] for name in PARAMETERS]


def _number(name: str, text: str, least: int, most: int) -> int:
    """A parameter as a number. Raises `Declined`."""
    if re.fullmatch("[0-9]{1,10}", text) and least <= int(text) <= most:
        return int(text)
    raise _malformed(f"{name} is {shown(text)}, allowed is a number from {least} to {most}")


def _malformed(detail: str) -> Declined:
    return Declined("malformed", detail)


def _encoded(document: Any) -> bytes:
    """JSON of what adapters say of themselves, whatever that is."""
    return msgspec.json.encode(document, enc_hook=str)
