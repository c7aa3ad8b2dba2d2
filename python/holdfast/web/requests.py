"""Requests as HTTP applications see them: bodies, tokens, and where they come from.

Nothing here knows a route. What can't be taken raises `BadRequest`, whose reason the application
turns into a status.
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
    from collections.abc import Iterable

    from holdfast.web.host import Headers, Receive, Scope, Send

LINGER_TIMEOUT = 2.0
"""Seconds that a client has to end a body that is too large, so that it gets the answer."""

_JSON = re.compile(rb'application/json[ \t]*(;[ \t]*charset="?utf-?8"?[ \t]*)?', re.I)
_JSON_WITH_PARAMETERS = re.compile(rb"application/json[ \t]*(;.*)?", re.I)
_MAX_SHOWN = 40


class BadRequest(Exception):
    """A request that can't be taken: why, in a word and in a sentence."""

    def __init__(self, reason: str, detail: str) -> None:
        self.reason = reason
        self.detail = detail
        super().__init__(f"{reason}: {detail}")


class ClientDisconnected(Exception):
    """The client went away."""


class Request:
    """What is known of a request."""

    __slots__ = ("arrived", "method", "more_headers", "path", "peer", "receive", "scope", "who")

    def __init__(self, scope: Scope, receive: Receive) -> None:
        self.scope = scope
        self.receive = receive
        self.path: str = scope["path"]
        self.method: str = scope["method"]
        self.peer: str = scope["state"]["peer"]
        self.who = "-"
        """Who asks, once that is known."""
        self.arrived = False
        """Whether all of the body has come."""
        self.more_headers: Headers = []
        """Headers of the answer, whichever it is."""

    def headers(self, wanted: bytes) -> list[bytes]:
        """All headers of this name."""
        return [value for name, value in self.scope["headers"] if name == wanted]

    def header(self, wanted: bytes) -> bytes | None:
        """The last header of this name, if there is one."""
        found = self.headers(wanted)
        return found[-1] if found else None

    @property
    def late(self) -> bool:
        """Whether it did not arrive in time."""
        return "late" in self.scope["state"]

    def check_json(self, *also: bytes, parameters: bool = False) -> None:
        """Raises `BadRequest` unless the body is plain JSON, or of one of these types in name.

        With `parameters` the type may have any.
        """
        kind = self.header(b"content-type")
        form = _JSON_WITH_PARAMETERS if parameters else _JSON
        if (kind is None or not form.fullmatch(kind)) and (kind or b"") not in also:
            raise BadRequest(
                "not_json", f"Content-Type is {_found(kind)}, allowed is application/json"
            )
        coding = self.header(b"content-encoding")
        if coding is not None and coding.lower() != b"identity":
            raise BadRequest("not_json", f"Content-Encoding is {_found(coding)}, allowed is none")

    async def body(self, most: int) -> bytes:
        """All of the body. Raises `BadRequest`, and `ClientDisconnected` when the client is."""
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
                raise BadRequest("timeout", f"{size} bytes came in time, more were announced")
        return b"".join(pieces)

    async def gone(self) -> None:
        """Returns when the client goes away; only for a request that has arrived."""
        while (await self.receive())["type"] != "http.disconnect":
            pass

    @property
    def is_foreign(self) -> bool:
        """Whether a browser says that a page of another site sends this."""
        origin, host = self.header(b"origin"), self.header(b"host") or b""
        if origin is not None and origin.partition(b"://")[2].lower() != host.lower():
            return True
        return self.header(b"sec-fetch-site") in (b"cross-site", b"same-site")

    @property
    def is_direct(self) -> bool:
        """Whether its Host, if it has one, names this machine without a name server's help.

        A page of the web can make its own name lead to this machine, but not change that header.
        """
        host = self.header(b"host")
        return host is None or _is_direct(host)

    def owner(self, tokens: Iterable[tuple[str, bytes]]) -> str:
        """The name of its token, of those with a name and a SHA-256. Raises `BadRequest`."""
        given = self.headers(b"authorization")
        if len(given) != 1:
            detail = "there is more than one Authorization" if given else "no Authorization"
            raise BadRequest("unauthorized", f"{detail}, needed is Authorization: Bearer TOKEN")
        scheme, _, secret = given[0].partition(b" ")
        if scheme.lower() != b"bearer":
            raise BadRequest("unauthorized", "Authorization is not of the form Bearer TOKEN")
        digest = hashlib.sha256(secret.strip()).digest()
        owner = None
        for name, known in tokens:  # All of them: the time tells nothing.
            if hmac.compare_digest(known, digest):
                owner = name
        if owner is None:
            raise BadRequest("unauthorized", "the token is not known")
        return owner


async def respond_to_its_end(
    request: Request, send: Send, status: int, headers: Headers, body: bytes
) -> None:
    """Answers a request of which more may come, takes that for a while, and ends the connection.

    A connection that is closed while the client sends is reset, and the answer lost with it.
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
    """Text from outside, quoted and cut short."""
    return json.dumps(text if len(text) <= _MAX_SHOWN else f"{text[:_MAX_SHOWN]}…")


def _found(value: bytes | None) -> str:
    return "missing" if value is None else shown(value.decode("latin-1"))


def _too_large(most: int) -> BadRequest:
    return BadRequest("too_large", f"the body has more than {most} bytes")


@functools.lru_cache(maxsize=64)
def _is_direct(host: bytes) -> bool:
    name = re.sub(r":[0-9]*\Z", "", host.decode("latin-1")).lower()
    return name in ("", "localhost") or address_in(name) is not None
