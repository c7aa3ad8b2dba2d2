"""The requests and responses of HTTP: what a handler gets from a host, and gives back.

This module does not know routes. An invalid request raises `BadRequest`; the application converts
its reason to a status code.
"""

from __future__ import annotations

import json
import re
from collections.abc import Awaitable, Callable
from dataclasses import KW_ONLY, dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Any, TypeAlias

import msgspec

from holdfast.runtime.text import clip

if TYPE_CHECKING:
    from collections.abc import Sequence

Headers: TypeAlias = list[tuple[bytes, bytes]]
"""Names in lower case, and values."""

JSON = b"application/json"

COMMANDS = "commands"
"""The key in `Request.kept` of a pair: `Commands`, and a handler. The core then parses bodies that
follow the same head, and passes them to the handler as `ParsedWrites`; the handler returns the
second step. A body that the core does not parse arrives as a `Request`."""

MAX_KINDS = 64
"""Headers of responses that are kept."""

SAFE = ((b"cache-control", b"no-store"), (b"x-content-type-options", b"nosniff"))
"""Headers of every response: no caching, no guessing of content types."""

_JSON = re.compile(rb'application/json[ \t]*(;[ \t]*charset="?utf-?8"?[ \t]*)?', re.I)
_JSON_WITH_PARAMETERS = re.compile(rb"application/json[ \t]*(;.*)?", re.I)
_MAX_SHOWN = 40


class RequestError(Exception):
    """An error that a request ends with: `reason` is a word, `detail` a sentence."""

    def __init__(self, reason: str, detail: str) -> None:
        self.reason = reason
        self.detail = detail
        self.headers: tuple[tuple[bytes, bytes], ...] = ()
        """More headers of the response."""
        super().__init__(f"{reason}: {detail}")


class BadRequest(RequestError):
    """A request is invalid or refused."""


class ClientDisconnected(Exception):
    """The client closed the connection."""


class BrokenBody(Exception):
    """The body of a request is not valid HTTP. The host answers it, not the handler."""


@dataclass(frozen=True)
class Identity:
    """The certificate of a client over mutual TLS."""

    subject: str
    serial: str
    role: str | None = None


@dataclass(slots=True)
class Response:
    """A whole response. The host adds `date`, and `content-length` where HTTP has one."""

    status: int
    body: bytes = b""
    headers: Sequence[tuple[bytes, bytes]] = ()
    closes: bool = False
    """Whether the host closes the connection then. It reads on until the peer has the response."""


def response(kind: bytes, body: bytes, *more: tuple[bytes, bytes], status: int = 200) -> Response:
    """Returns a response with a body of this content type."""
    return Response(status, body, _headers(kind, more))


@lru_cache(MAX_KINDS)
def _headers(kind: bytes, more: tuple[tuple[bytes, bytes], ...]) -> Sequence[tuple[bytes, bytes]]:
    # The same tuple each time: the core then knows what it has.
    return ((b"content-type", kind), *SAFE, *more)


def rejection(status: int, reason: str, detail: str) -> Response:
    """Returns the refusal of a request, or its failure (500), in JSON."""
    word = "failed" if status == 500 else "rejected"
    body = msgspec.json.encode({"status": word, "reason": reason, "detail": detail})
    return response(JSON, body, status=status)


@dataclass(slots=True, eq=False)
class Request:
    """One request. A host makes a subclass for a body that still arrives, and for streams."""

    method: str
    path: str
    """The path, percent-decoded."""
    query: bytes
    """The part behind `?`, as it was sent."""
    headers: Headers
    """Without Content-Length."""
    peer: str
    """The address of the client as text: `10.0.0.9:51200`."""
    _: KW_ONLY
    version: str = "1.1"
    """The version of HTTP, `1.0` or `1.1`."""
    whole: bytes | None = b""
    """The body, if it has arrived together with the head; `None` while it still arrives."""
    length: int | None = None
    """The length of the body, if the head says it."""
    identity: Identity | None = None
    who: str = "-"
    """The name of the token's owner; `-` until the token was checked."""
    kept: dict[str, Any] = field(default_factory=dict)
    """A cache for the application. All requests to this server with an identical head share it,
    from any client. Empty after a restart."""
    _by_name: dict[bytes, list[bytes]] | None = field(default=None, init=False, repr=False)

    # What a host provides.

    async def receive(self, most: int) -> bytes:
        """Waits for a body that still arrives, at most `most` bytes.

        Raises `BadRequest`, `BrokenBody` and `ClientDisconnected`.
        """
        raise NotImplementedError

    def when_gone(self, function: Callable[[], object] | None) -> None:
        """Sets the function to call when the client disconnects; `None` removes it.

        Calls it at once if the client already has. The body must have been read. From
        here on, a half-close of the client means that it is gone.
        """
        raise NotImplementedError

    def is_client_there(self) -> bool:
        """Whether the client is still connected, by what the system knows now. Thread-safe.

        `when_gone` may call its function later, as after the process was stopped. The body must
        have been read, and a half-close means the same as there.
        """
        raise NotImplementedError

    async def begin(self, status: int, headers: Headers) -> None:
        """Begins a stream. From here on, a half-close of the client means that it is gone."""
        raise NotImplementedError

    async def send(self, data: bytes) -> None:
        """Sends a part of a stream when there is room for it. Raises `ClientDisconnected`."""
        raise NotImplementedError

    async def end(self) -> None:
        """Ends a stream."""
        raise NotImplementedError

    # The body.

    def arrived(self, most: int) -> bytes | None:
        """Returns the body, at most `most` bytes; `None` if it still arrives. Raises `BadRequest`.

        A body that is too large by its length is refused before it arrives.
        """
        size = self.length if self.whole is None else len(self.whole)
        if size is not None and size > most:
            raise BadRequest("too_large", f"the body has more than {most} bytes")
        return self.whole

    async def body(self, most: int) -> bytes:
        """Reads the body, at most `most` bytes.

        Raises `BadRequest`, `BrokenBody` and `ClientDisconnected`.
        """
        whole = self.arrived(most)
        if whole is not None:
            return whole
        self.whole = await self.receive(most)
        return self.whole

    # The headers.

    def values(self, name: bytes) -> list[bytes]:
        """Returns the values of all headers of this name."""
        by_name = self._by_name
        if by_name is None:
            by_name = self._by_name = {}
            for key, value in self.headers:
                by_name.setdefault(key, []).append(value)
        return by_name.get(name, [])

    def header(self, name: bytes) -> bytes | None:
        """Returns the value of the last header of this name, if there is one."""
        found = self.values(name)
        return found[-1] if found else None

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

    def check_no_query(self) -> None:
        """Raises `BadRequest` for parameters beside a body that has all fields."""
        if self.query:
            found = shown(self.query.decode("latin-1"))
            raise BadRequest("malformed", f"the query is {found}, allowed: none beside a body")

    def check_uncompressed(self) -> None:
        """Raises `BadRequest` for a compressed body."""
        coding = self.header(b"content-encoding")
        if coding is not None and coding.lower() != b"identity":
            raise BadRequest("not_json", f"Content-Encoding is {_found(coding)}, allowed: none")


SecondStep: TypeAlias = Callable[[], Response]
"""The second step of a handler: it is called once the others of the batch have had their first."""

Handler: TypeAlias = Callable[[Request], Response | SecondStep | Awaitable[Response | None]]
"""Answers a request: at once, in two steps, or as a coroutine. `None`: it has sent a stream."""


def shown(text: str) -> str:
    """Quotes untrusted text, cut to a limited length."""
    return json.dumps(clip(text, _MAX_SHOWN))


def _found(value: bytes | None) -> str:
    return "missing" if value is None else shown(value.decode("latin-1"))
