"""What a write gets that is sent again with the same `Idempotency-Key`: it is carried out once.

A browser sends a POST again by itself when the connection that it has reused ends without a
response, although the device may have the write already. Proxies and programs may do so too.
"""

from __future__ import annotations

import asyncio
import hashlib
import secrets
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from holdfast.gateway.write_outcome import WriteOutcome
from holdfast.net.http.fields import Field, malformed
from holdfast.net.http.requests import BadRequest

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from holdfast.gateway.device import RequestedDevice
    from holdfast.net.http.requests import Request, Response

MAX_LENGTH = 128
MAX_ENDED = 4096
"""The writes that have ended whose keys are remembered."""

KEY = Field(
    "Idempotency-Key",
    {"type": "string", "pattern": f"^[!-~]{{1,{MAX_LENGTH}}}$"},
    "A new text for each write. If the same request arrives again with it, nothing is written "
    "again. With `/`, it has to begin with `keyPrefix` of `GET /api/gateway`",
    None,
    allowed=f"1 to {MAX_LENGTH} visible ASCII characters",
    example="0b5c1f3e-4f0e-4c8e-9c55-1f6f0a6e1d10",
)
_HEADER = KEY.name.lower().encode()
_MAYBE_WRITTEN = WriteOutcome("failed", True).header


@dataclass(slots=True, eq=False)
class _Write:
    """A write with a key."""

    request: bytes
    """The digest of its path and its body."""
    ended: asyncio.Event = field(default_factory=asyncio.Event)
    maybe_sent: bool = False
    """Whether the device may have received it."""
    response: Response | None = None
    """The response of the device, if there was one."""


class RepeatedWrites:
    """The writes with keys of one gateway, since it was started."""

    def __init__(self) -> None:
        self.prefix = f"{secrets.token_hex(4)}/"
        """What a key begins with that no other start of a gateway accepts."""
        self._pending: dict[tuple[str, str], _Write] = {}
        self._ended: dict[tuple[str, str], _Write] = {}

    async def write_once(
        self, request: Request, device: RequestedDevice, write: Callable[[], Awaitable[Response]]
    ) -> Response:
        """Carries out a write, unless one with its key may have reached the device.

        Then it returns the response of the device to that one. Raises `BadRequest` if there was
        none, and for keys that can't be used.
        """
        key = self._key(request)
        if key is None:
            return await write()
        name, digest = (request.who, key), _digest(request)
        while (known := self._known(name)) is not None:
            if known.request != digest:
                raise malformed(f"{KEY.name} was used for another request, allowed: a new one")
            # The first may have reached the device: if this request is cancelled here, it says so.
            device.maybe_sent = True
            await known.ended.wait()
            if known.response is not None:
                return known.response
            if known.maybe_sent:
                raise _repeated(f"{KEY.name} is known, but not what the device has replied")
            device.maybe_sent = False
        return await self._first(name, _Write(digest), device, write)

    def add_maybe_written_header(self, request: Request, refusal: BadRequest) -> None:
        """Says in the refusal of a repetition that the first may have been carried out.

        A repetition may be refused before its key is looked up, for example as one too many.
        """
        try:
            key = self._key(request)
        except BadRequest as unusable:
            more = unusable.headers
        else:
            known = None if key is None else self._known((request.who, key))
            is_repetition = known is not None and known.request == _digest(request)
            more = (_MAYBE_WRITTEN,) if is_repetition else ()
        present = {header for header, _ in refusal.headers}
        refusal.headers += tuple(each for each in more if each[0] not in present)

    async def _first(
        self,
        name: tuple[str, str],
        this: _Write,
        device: RequestedDevice,
        write: Callable[[], Awaitable[Response]],
    ) -> Response:
        self._pending[name] = this
        try:
            this.response = await write()
            return this.response
        finally:
            del self._pending[name]
            this.maybe_sent = device.maybe_sent
            if this.maybe_sent:
                self._ended[name] = this
            if len(self._ended) > MAX_ENDED:
                del self._ended[next(iter(self._ended))]
            this.ended.set()

    def _known(self, name: tuple[str, str]) -> _Write | None:
        return self._pending.get(name) or self._ended.get(name)

    def _key(self, request: Request) -> str | None:
        """Returns the key of a request. Raises `BadRequest`."""
        value = request.header(_HEADER)
        if value is None:
            return None
        # Quoted or not: it is a text of structured headers, which few programs send as such.
        key: str = KEY.check(value.decode("latin-1").strip('"'))
        if "/" in key and not key.startswith(self.prefix):
            raise _repeated(f'{KEY.name} has "/", but is not from this start of the gateway')
        return key


def _digest(request: Request) -> bytes:
    return hashlib.sha256(b"%b\n%b" % (request.path.encode(), request.whole or b"")).digest()


def _repeated(why: str) -> BadRequest:
    """Returns the refusal of a write whose outcome is unknown."""
    error = BadRequest("repeated", f"{why}: the write may have been carried out before")
    error.headers = (_MAYBE_WRITTEN,)
    return error
