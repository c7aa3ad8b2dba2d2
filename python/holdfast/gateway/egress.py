"""The way from the host of a request to addresses that the egress list has."""

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
"""Addresses of a name that a refusal tells."""


class Refused(Exception):
    """The target is not in the egress list."""


@dataclass(frozen=True)
class Route:
    """A way to a device that may be gone: its addresses, each of them in the list."""

    transport: Transport
    addresses: tuple[str, ...]
    port: int
    name: str | None = None
    """The name that the device's certificate must have, with TLS."""


class Egress:
    """The list, and how names become addresses."""

    def __init__(self, allowed: AllowList, resolve: Resolve) -> None:
        self._allowed = allowed
        self._resolve = resolve

    async def route(
        self, transport: Transport, host: str, port: int, name: str | None = None
    ) -> Route:
        """The way to a target; `name` is that of its certificate, if it is not the host.

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
        return Route(transport, addresses, port, certificate_name(name or host) if secure else None)
