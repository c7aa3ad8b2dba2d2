"""Finds the addresses of a request's host that `net.allow_list` allows; `pool` connects to them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

from holdfast.client.url import NetworkTarget
from holdfast.net.addresses import certificate_name
from holdfast.net.allow_list import NotAllowed
from holdfast.net.http.requests import BadRequest
from holdfast.net.tls import NO_FILES

if TYPE_CHECKING:
    from holdfast.net.allow_list import AllowList
    from holdfast.net.resolver import Resolve
    from holdfast.net.tls import Tls
    from holdfast.types import Transport

MAX_ROUTES = 256
"""The routes to addresses that are kept."""

MAX_SHOWN = 4
"""The most addresses of a name in an error message."""


@dataclass(frozen=True)
class Route:
    """How a device is reached."""

    named: NetworkTarget
    """The host as in the request. A name is a target of the appliance only, whose connection to it
    must lead to one of `allowed`."""
    allowed: tuple[NetworkTarget, ...]
    """The addresses that the gateway may connect to, which were checked."""

    @property
    def addresses(self) -> tuple[str, ...]:
        """The hosts of `allowed`."""
        return tuple(each.host for each in self.allowed)


class DeviceRoutes:
    """Routes to the targets that the egress list allows."""

    def __init__(self, allowed: AllowList, resolve: Resolve, tls: Tls) -> None:
        self._allowed = allowed
        self._resolve = resolve
        self._tls = tls
        # Devices are asked again and again, mostly by their addresses, and the list never changes.
        self._route_to_address = lru_cache(MAX_ROUTES)(self._to_address)

    async def route(
        self, transport: Transport, host: str, port: int, name: str | None = None
    ) -> Route:
        """Returns the route to a target. `name` is the name in its certificate, default the host.

        Raises `BadRequest` if it is not in the egress list, and `NoSuchName`.
        """
        try:
            route = self._route_to_address(transport, host, port, name)
            if route is None:
                addresses = await self._allowed.addresses(host, port, transport, self._resolve)
                route = self._route(transport, host, addresses, port, name)
        except NotAllowed as error:
            where = f" ({', '.join(error.found[:MAX_SHOWN])})" if error.found else ""
            detail = f"{host}{where}, port {port}, is not in the egress list of this gateway"
            raise BadRequest("refused_target", detail) from None
        return route

    def _to_address(
        self, transport: Transport, host: str, port: int, name: str | None
    ) -> Route | None:
        """Returns the route if the host is an address; `None` for a name."""
        address = self._allowed.literal(host, port, transport)
        return None if address is None else self._route(transport, host, (address,), port, name)

    def _route(
        self,
        transport: Transport,
        host: str,
        addresses: tuple[str, ...],
        port: int,
        name: str | None,
    ) -> Route:
        is_tls = transport == "tls"
        tls = replace(self._tls, name=certificate_name(name or host)) if is_tls else NO_FILES
        named, *allowed = (NetworkTarget(transport, at, port, tls) for at in (host, *addresses))
        return Route(named, tuple(allowed))
