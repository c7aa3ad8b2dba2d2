"""Requests of HTTP applications: bodies, tokens, and origins.

This module does not know routes. An invalid request raises `BadRequest`; the application converts
its reason to a status code.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import hashlib
import hmac
import json
import re
from typing import TYPE_CHECKING

from holdfast.net.addresses import address_in

if TYPE_CHECKING:
    from collections.abc import Container, Iterable

    from holdfast.web.host import Headers, Receive, Scope, Send

LINGER_TIMEOUT = 2.0
"""Seconds to keep reading an oversized body, so that the client receives the response."""

_JSON = re.compile(rb'application/json[ \t]*(;[ \t]*charset="?utf-?8"?[ \t]*)?', re.I)
_JSON_WITH_PARAMETERS = re.compile(rb"application/json[ \t]*(;.*)?", re.I)
_MAX_SHOWN = 40


class BadRequest(Exception):
    """A request is invalid or refused: `reason` is a word, `detail` a sentence."""

    def __init__(self, reason: str, detail: str) -> None:
        self.reason = reason
        self.detail = detail
        super().__init__(f"{reason}: {detail}")


class ClientDisconnected(Exception):
    """The client closed the connection."""


class Request:
    """An HTTP request."""

    __slots__ = ("arrived", "method", "more_headers", "path", "peer", "receive", "scope", "who")

    def __init__(self, scope: Scope, receive: Receive) -> None:
        self.scope = scope
        self.receive = receive
        self.path: str = scope["path"]
        self.method: str = scope["method"]
        self.peer: str = scope["state"]["peer"]
        self.who = "-"
        """The name of the token's owner; `-` until the token was checked."""
        self.arrived = False
        """Whether the body was received completely."""
        self.more_headers: Headers = []
        """Additional headers of the response."""

    def headers(self, wanted: bytes) -> list[bytes]:
        """Returns all headers of this name."""
        return [value for name, value in self.scope["headers"] if name == wanted]

    def header(self, wanted: bytes) -> bytes | None:
        """Returns the last header of this name, if there is one."""
        found = self.headers(wanted)
        return found[-1] if found else None

    @property
    def late(self) -> bool:
        """Whether the request did not arrive in time."""
        return "late" in self.scope["state"]

    def check_json(self, *also: bytes, parameters: bool = False) -> None:
        """Raises `BadRequest` unless Content-Type is JSON or in `also`, without compression.

        With `parameters`, the type may have any parameters.
        """
        kind = self.header(b"content-type")
        form = _JSON_WITH_PARAMETERS if parameters else _JSON
        if (kind is None or not form.fullmatch(kind)) and (kind or b"") not in also:
            raise BadRequest(
                "not_json", f"Content-Type is {_found(kind)}, allowed: application/json"
            )
        self.check_uncompressed()

    def check_uncompressed(self) -> None:
        """Raises `BadRequest` for a compressed body."""
        coding = self.header(b"content-encoding")
        if coding is not None and coding.lower() != b"identity":
            raise BadRequest("not_json", f"Content-Encoding is {_found(coding)}, allowed: none")

    async def body(self, most: int) -> bytes:
        """Reads the body, at most `most` bytes. Raises `BadRequest` and `ClientDisconnected`."""
        told = self.header(b"content-length")
        if told is not None and int(told) > most:
            raise _too_large(most)
        pieces: list[bytes] = []
        size, more = 0, True
        while more:
            message = await self.receive()
            if message["type"] == "http.disconnect":
                raise ClientDisconnected
            piece, more = message["body"], message["more_body"]
            self.arrived = not more
            pieces.append(piece)
            size += len(piece)
            if size > most:
                raise _too_large(most)
            if more and self.late:
                raise BadRequest("timeout", f"the body is incomplete: {size} bytes arrived in time")
        return b"".join(pieces)

    async def gone(self) -> None:
        """Returns when the client disconnects. The body must have been read."""
        while (await self.receive())["type"] != "http.disconnect":
            pass

    def let_leave(self) -> None:
        """Treats a half-close as a disconnect from now on: a stream has no other end."""
        self.scope["state"]["leaving"] = True

    @property
    def is_foreign(self) -> bool:
        """Whether a browser sent the request from a page of another site."""
        origin, host = self.header(b"origin"), self.header(b"host") or b""
        if origin is not None and origin.partition(b"://")[2].lower() != host.lower():
            return True
        return self.header(b"sec-fetch-site") in (b"cross-site", b"same-site")

    @property
    def is_from_page(self) -> bool:
        """Whether a web page sent the request, also one of this server."""
        return any(self.headers(name) for name in (b"origin", b"referer", b"sec-fetch-site"))

    def is_direct(self, names: Container[str] = ()) -> bool:
        """Whether Host is missing, an IP address, `localhost`, or one of `names` in lower case.

        This prevents DNS rebinding: a web page can point its own name at this machine, but the
        browser still sends that name as Host.
        """
        host = self.header(b"host")
        name = None if host is None else _name_in(host)
        return name is None or name in names

    def owner(self, tokens: Iterable[tuple[str, bytes]]) -> str:
        """Returns the name of the request's token. Raises `BadRequest` if there is none.

        `tokens` are names and SHA-256 hashes.
        """
        given = self.headers(b"authorization")
        if len(given) != 1:
            detail = "more than one Authorization header" if given else "no Authorization header"
            raise BadRequest("unauthorized", f"{detail}, required: Authorization: Bearer TOKEN")
        scheme, _, secret = given[0].partition(b" ")
        if scheme.lower() != b"bearer":
            raise BadRequest("unauthorized", "Authorization is not of the form Bearer TOKEN")
        digest = hashlib.sha256(secret.strip()).digest()
        owner = None
        for name, known in tokens:  # Compares all of them, so the time reveals nothing.
            if hmac.compare_digest(known, digest):
                owner = name
        if owner is None:
            raise BadRequest("unauthorized", "unknown token")
        return owner


async def respond_to_its_end(
    request: Request, send: Send, status: int, headers: Headers, body: bytes
) -> None:
    """Responds to a request whose body is not fully read, and closes the connection.

    First it reads more of the body, for at most `LINGER_TIMEOUT`. Closing a connection while the
    client still sends would reset it, and the client would lose the response.
    """
    closing = [*headers, (b"connection", b"close")]
    await send({"type": "http.response.start", "status": status, "headers": closing})
    if request.arrived or request.late or request.header(b"expect") is not None:
        await send({"type": "http.response.body", "body": body})
        return
    await send({"type": "http.response.body", "body": body, "more_body": True})
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(LINGER_TIMEOUT):
            while (await request.receive()).get("more_body", False) and not request.late:
                pass
    await send({"type": "http.response.body", "body": b""})


def shown(text: str) -> str:
    """Quotes untrusted text, cut to a limited length."""
    return json.dumps(text if len(text) <= _MAX_SHOWN else f"{text[:_MAX_SHOWN]}…")


def _found(value: bytes | None) -> str:
    return "missing" if value is None else shown(value.decode("latin-1"))


def _too_large(most: int) -> BadRequest:
    return BadRequest("too_large", f"the body has more than {most} bytes")


@functools.lru_cache(maxsize=64)
def _name_in(host: bytes) -> str | None:
    """Returns the name in a Host header; `None` for an IP address, `localhost` or nothing."""
    name = re.sub(r":[0-9]*\Z", "", host.decode("latin-1")).lower()
    return None if name in ("", "localhost") or address_in(name) is not None else name
