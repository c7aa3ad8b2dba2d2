"""The devices that the scanner may connect to, and their addresses."""

from __future__ import annotations

from dataclasses import replace
from ipaddress import ip_network
from typing import TYPE_CHECKING

from holdfast.client.serial_settings import SerialTarget
from holdfast.client.url import NetworkTarget
from holdfast.net.addresses import certificate_name
from holdfast.net.allow_list import ALL_PORTS, AllowedNetwork, AllowList, NotAllowed
from holdfast.net.resolver import NoSuchName, Resolver
from holdfast.net.tls import NO_FILES
from holdfast.scanner.errors import Refused
from holdfast.scanner.polling.device_tls import endpoint_of

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast._core import Endpoint, Poller
    from holdfast.client.url import Target
    from holdfast.net.allow_list import AllowEntry
    from holdfast.net.tls import Tls

PRIVATE = tuple(
    AllowedNetwork(ip_network(text), ALL_PORTS)
    for text in (
        "127.0.0.0/8",
        "10.0.0.0/8",
        "172.16.0.0/12",
        "192.168.0.0/16",
        "::1/128",
        "fc00::/7",
    )
)
"""The default allow list."""

HINT = "allow it with --allow, or in nats.devices of the configuration"


class AllowedDevices:
    """The allowed devices; without entries, `PRIVATE`."""

    def __init__(
        self,
        entries: Iterable[AllowEntry] = (),
        tls: Tls = NO_FILES,
        shared_poller: Poller | None = None,
    ) -> None:
        """`shared_poller` may already have connections to the same devices."""
        self._list = AllowList(tuple(entries) or PRIVATE)
        self._tls = tls
        self._shared_poller = shared_poller
        self._resolve = Resolver()

    async def find(self, target: Target, *, after: Target | None = None) -> tuple[Target, Endpoint]:
        """Returns the address of a target, see `address`, and its endpoint. Raises `Refused`."""
        address = await self.address(target, after=after)
        if self._shared_poller is not None and target != address:
            # The appliance may be connected to the device by its name, and a device may accept
            # no second connection. Then the link of the appliance is used.
            by_name = endpoint_of(target, self._tls)
            if self._shared_poller.link_if_used(by_name) is not None:
                return address, by_name
        return address, endpoint_of(address, self._tls)

    async def address(self, target: Target, *, after: Target | None = None) -> Target:
        """Returns the target with an allowed address of its host. Raises `Refused`.

        With TLS, it keeps the expected name in the certificate. Of several addresses it uses the
        first, or the one that follows `after`.
        """
        if isinstance(target, SerialTarget):
            if not self._list.allows_device(target.device):
                raise Refused(f"{target.device} is not allowed; {HINT}")
            return target
        allowed = await self._addresses(target)
        last = after.host if isinstance(after, NetworkTarget) else ""
        at = (allowed.index(last) + 1) % len(allowed) if last in allowed else 0
        tls = NO_FILES
        if target.transport == "tls":
            tls = replace(target.tls, name=certificate_name(target.tls.name or target.host))
        return replace(target, host=allowed[at], tls=tls)

    async def _addresses(self, target: NetworkTarget) -> tuple[str, ...]:
        host = target.host
        try:
            return await self._list.addresses(host, target.port, target.transport, self._resolve)
        except NoSuchName as error:
            raise Refused(f"host {host}: {error.why}") from None
        except NotAllowed as error:
            resolved = f" ({', '.join(error.found)})" if error.found else ""
            networks = ", ".join(str(each.network) for each in self._list.networks)
            allowed = networks or "serial devices only"
            raise Refused(f"{host}{resolved} is not allowed, allowed: {allowed}") from None
