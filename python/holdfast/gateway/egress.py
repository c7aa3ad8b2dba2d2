"""Resolves the host of a request to addresses that the egress list allows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from holdfast.net.addresses import certificate_name
from holdfast.net.allow_list import NotAllowed

if TYPE_CHECKING:
    from holdfast.net.allow_list import AllowList
    from holdfast.net.resolver import Resolve
    from holdfast.types import Transport

MAX_SHOWN = 4
"""The most addresses of a name in an error message."""


class Refused(Exception):
    """The target is not in the egress list."""


@dataclass(frozen=True)
class Route:
    """The allowed addresses of a device, and how to connect to them."""

    transport: Transport
    host: str
    """The name or address in the request."""
    addresses: tuple[str, ...]
    port: int
    name: str | None = None
    """The expected name in the device's certificate; `None` without TLS."""


class Egress:
    """The egress list and the resolver."""

    def __init__(self, allowed: AllowList, resolve: Resolve) -> None:
        self._allowed = allowed
        self._resolve = resolve

    async def route(
        self, transport: Transport, host: str, port: int, name: str | None = None
    ) -> Route:
        """Returns the route to a target. `name` is the name in its certificate, default the host.

        Raises `Refused` and `NoSuchName`.
        """
        try:
            addresses = await self._allowed.addresses(host, port, transport, self._resolve)
        except NotAllowed as error:
            where = f" ({', '.join(error.found[:MAX_SHOWN])})" if error.found else ""
            raise Refused(
                f"{host}{where}, port {port}, is not in the egress list of this gateway"
            ) from None
        secure = transport == "tls"
        expected = certificate_name(name or host) if secure else None
        return Route(transport, host, addresses, port, expected)
