"""The routes: what a request asks for, who asks, and how it is answered.

A plain ASGI application. All that bears on memory is the door's work; what is refused here was
refused before it came to the door.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import hashlib
import hmac
import ipaddress
import json
import re
from typing import TYPE_CHECKING, Any, TypeAlias
from urllib.parse import parse_qsl

import msgspec

from holdfast import __version__
from holdfast.adapters.rest import openapi, page
from holdfast.http import SAFE, address_of, headers_of, respond
from holdfast.ingest import Grant, Refused
from holdfast.types import AREAS

if TYPE_CHECKING:
    import socket
    from collections.abc import Awaitable, Callable

    from holdfast.config import RestConfig
    from holdfast.diagnostics import Diagnostics
    from holdfast.http import Headers, Receive, Scope, Send
    from holdfast.ingest import Door

    Answer: TypeAlias = tuple[bytes, bytes]
    Handler: TypeAlias = Callable[["_Request"], Answer | Awaitable[Answer]]

STATUSES = {
    reason: int(status) for status, reasons in openapi.REASONS.items() for reason in reasons
}
"""The status of an answer, by the reason of the refusal."""

JSON = b"application/json"
INGEST = "/api/v1/ingest"
PARAMETERS = ("memory", "area", "address", "count")
NOBODY = "-"
"""Who asks, as long as that is not known."""

ANYONE = "anyone"
"""Who asks, where there are no tokens."""

LINGER = 2.0
"""Seconds that a client has to end a body that is too large, so that it gets the answer."""

_CONTENT_TYPE = re.compile(rb'application/json[ \t]*(;[ \t]*charset="?utf-?8"?[ \t]*)?', re.I)
_LONGEST_SHOWN = 40


class Declined(Refused):
    """Refused before it came to the door, which does not know of it yet."""


class Gone(Exception):
    """The client went away in the middle of its request."""


class App:
    """The ASGI application."""

    def __init__(
        self, settings: RestConfig, door: Door, diagnostics: Diagnostics, listener: socket.socket
    ) -> None:
        self._door = door
        self._diagnostics = diagnostics
        self._max_body = settings.max_body
        tokens = () if settings.tokens == "none" else settings.tokens
        self._tokens = [
            (
                bytes.fromhex(token.sha256),
                Grant(
                    token.name,
                    frozenset(token.memories),
                    frozenset(token.areas),
                    token.access == "read-write",
                ),
            )
            for token in tokens
        ]
        self._anyone = (
            Grant(ANYONE, frozenset(door.memories), frozenset(AREAS))
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
        request = _Request(scope, receive)
        try:
            kind, body = await self._answer(request)
        except Refused as refused:
            await self._refuse(request, refused, send)
        except Gone:
            pass
        else:
            headers = headers_of(kind, body) if body else list(SAFE)
            await respond(send, 200 if body else 204, headers + request.more_headers, body)

    async def _answer(self, request: _Request) -> Answer:
        path, method = request.scope["path"], request.scope["method"]
        route = self.routes.get(path)
        if route is None:
            raise Declined("not_found", f"there is nothing at {_shown(path)}")
        allowed, handler = route
        if method == allowed or (method == "HEAD" and allowed == "GET"):
            answer = handler(request)
            return answer if isinstance(answer, tuple) else await answer
        methods = "POST, OPTIONS" if allowed == "POST" else "GET, HEAD, OPTIONS"
        request.more_headers.append((b"allow", methods.encode()))
        if method == "OPTIONS":
            return JSON, b""
        raise Declined("method_not_allowed", f"allowed are {methods}")

    async def _refuse(self, request: _Request, refused: Refused, send: Send) -> None:
        """Counts what the door does not know of, and answers."""
        if isinstance(refused, Declined):
            write = request.scope["path"] == INGEST and request.scope["method"] == "POST"
            note = self._door.refuse if write else self._door.note
            note(refused, request.who, request.peer)
        status = STATUSES[refused.reason]
        body = msgspec.json.encode(refused.answer())
        headers = headers_of(JSON, body) + request.more_headers
        if status == 401:
            headers.append((b"www-authenticate", b"Bearer"))
        expects = request.header(b"expect") is not None
        if expects or status in (408, 413):
            headers.append((b"connection", b"close"))
        if status != 413 or expects or request.arrived:
            await respond(send, status, headers, body)
            return
        # A connection that is closed while the client sends is reset, and the answer lost with it.
        await send({"type": "http.response.start", "status": status, "headers": headers})
        await send({"type": "http.response.body", "body": body, "more_body": True})
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(LINGER):
                while (await request.receive()).get("more_body", False) and not request.late:
                    pass
        await send({"type": "http.response.body", "body": b""})

    async def _ingest(self, request: _Request) -> Answer:
        grant = self._authorize(request)
        kind = request.header(b"content-type")
        if kind is None or not _CONTENT_TYPE.fullmatch(kind):
            raise Declined(
                "not_json", f"Content-Type is {_found(kind)}, allowed is {JSON.decode()}"
            )
        coding = request.header(b"content-encoding")
        if coding is not None and coding.lower() != b"identity":
            raise Declined("not_json", f"Content-Encoding is {_found(coding)}, allowed is none")
        body = await self._body(request)
        return JSON, msgspec.json.encode(self._door.ingest(body, grant, request.peer).answer())

    async def _body(self, request: _Request) -> bytes:
        """All of the body, which arrives in one piece or in many."""
        told = request.header(b"content-length")
        if told is not None and int(told) > self._max_body:
            raise self._too_large()
        pieces: list[bytes] = []
        size, more = 0, True
        while more:
            message = await request.receive()
            if message["type"] == "http.disconnect":
                raise Gone
            piece, more = message["body"], message["more_body"]
            request.arrived = not more
            pieces.append(piece)
            size += len(piece)
            if size > self._max_body:
                raise self._too_large()
            if more and request.late:
                raise Declined("timeout", f"{size} bytes came in time, more were announced")
        return pieces[0] if len(pieces) == 1 else b"".join(pieces)

    def _too_large(self) -> Declined:
        return Declined("too_large", f"the body has more than {self._max_body} bytes")

    def _read(self, request: _Request) -> Answer:
        grant = self._authorize(request)
        memory, area, address, count = _parameters(request.scope["query_string"])
        start = _number("address", address, 0, 65535)
        amount = _number("count", count, 1, 65536)
        values = self._door.read(memory, area, start, amount, grant, request.peer)
        return JSON, msgspec.json.encode({"values": values})

    def _health(self, _: _Request) -> Answer:
        return JSON, b'{"status":"ok"}'

    def _memories(self, request: _Request) -> Answer:
        grant = self._authorize(request)
        memories = self._diagnostics.memories()
        shown = {name: entry for name, entry in memories.items() if name in grant.memories}
        return JSON, msgspec.json.encode({"memories": shown})

    def _stats(self, request: _Request) -> Answer:
        self._authorize(request)
        return JSON, _encoded(self._diagnostics.stats())

    def _mqtt(self, request: _Request) -> Answer:
        self._authorize(request)
        status = self._diagnostics.adapter("mqtt")
        if status is None:
            raise Declined("not_configured", "the configuration has no mqtt")
        least: dict[str, object] = {"connected": False, "broker": None, "topics": []}
        return JSON, _encoded(least | status)

    def _openapi(self, _: _Request) -> Answer:
        return JSON, self._document

    def _docs(self, request: _Request) -> Answer:
        request.more_headers.append((b"content-security-policy", page.POLICY))
        return page.KIND, self._page

    def _authorize(self, request: _Request) -> Grant:
        """Whose request it is. Raises `Declined`."""
        if self._anyone is not None:
            host = request.header(b"host")
            if host is not None and not _is_direct(host):
                # A page of the web can make its own name lead to this machine, but not change it.
                detail = f"Host is {_found(host)}, without tokens allowed are IP addresses"
                raise Declined("not_granted", f"{detail} and localhost")
            request.who = ANYONE
            return self._anyone
        given = [value for name, value in request.scope["headers"] if name == b"authorization"]
        if len(given) != 1:
            detail = "there is more than one Authorization" if given else "no Authorization"
            raise Declined("unauthorized", f"{detail}, needed is Authorization: Bearer TOKEN")
        scheme, _, secret = given[0].partition(b" ")
        if scheme.lower() != b"bearer":
            raise Declined("unauthorized", "Authorization is not of the form Bearer TOKEN")
        digest = hashlib.sha256(secret.strip()).digest()
        grant = None
        for known, its_grant in self._tokens:  # All of them: the time tells nothing.
            if hmac.compare_digest(known, digest):
                grant = its_grant
        if grant is None:
            raise Declined("unauthorized", "the token is not known")
        request.who = grant.name
        return grant


class _Request:
    """What is known of a request."""

    __slots__ = ("arrived", "more_headers", "peer", "receive", "scope", "who")

    def __init__(self, scope: Scope, receive: Receive) -> None:
        self.scope = scope
        self.receive = receive
        self.peer: str = scope["state"]["peer"]
        self.who = NOBODY
        self.arrived = False
        self.more_headers: Headers = []

    def header(self, wanted: bytes) -> bytes | None:
        """The last header of this name, if there is one."""
        found = None
        for name, value in self.scope["headers"]:
            if name == wanted:
                found = value
        return found

    @property
    def late(self) -> bool:
        """Whether it did not arrive in time."""
        return "late" in self.scope["state"]


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
            raise _malformed(f"{_shown(name)} is not a parameter, allowed are {names}")
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
    raise _malformed(f"{name} is {_shown(text)}, allowed is a number from {least} to {most}")


def _malformed(detail: str) -> Declined:
    return Declined("malformed", detail)


@functools.lru_cache(maxsize=64)
def _is_direct(host: bytes) -> bool:
    """Whether a Host header names this machine without a name server's help."""
    name = re.sub(r":[0-9]*\Z", "", host.decode("latin-1")).lower()
    if name in ("", "localhost"):
        return True
    try:
        ipaddress.ip_address(name.removeprefix("[").removesuffix("]"))
    except ValueError:
        return False
    return True


def _encoded(document: Any) -> bytes:
    """JSON of what adapters say of themselves, whatever that is."""
    return msgspec.json.encode(document, enc_hook=str)


def _found(value: bytes | None) -> str:
    return "missing" if value is None else _shown(value.decode("latin-1"))


def _shown(text: str) -> str:
    """Text from outside, quoted and cut short."""
    return json.dumps(text if len(text) <= _LONGEST_SHOWN else f"{text[:_LONGEST_SHOWN]}…")
