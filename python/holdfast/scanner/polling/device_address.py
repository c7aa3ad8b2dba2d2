"""The address and the native endpoint of a device: what its name means now, if it is allowed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.scanner.polling.device_tls import endpoint_of

if TYPE_CHECKING:
    from holdfast._core import Endpoint, Poller
    from holdfast.client.url import Target
    from holdfast.net.tls import Tls
    from holdfast.scanner.polling.allowed_devices import AllowedDevices


class DeviceAddresses:
    """Looks up the addresses of devices."""

    def __init__(self, allowed: AllowedDevices, tls: Tls, shared_poller: Poller | None) -> None:
        """`shared_poller` may have connections of others to the same devices."""
        self._allowed = allowed
        self._tls = tls
        self._shared_poller = shared_poller

    async def find(self, target: Target, *, after: Target | None = None) -> tuple[Target, Endpoint]:
        """Returns an allowed address of a target, and its endpoint. Raises `Refused`.

        Of several addresses it is the first, or the one that follows `after`.
        """
        address = await self._allowed.address(target, after=after)
        if self._shared_poller is not None and target != address:
            # The appliance may use the device by its name, and a device may accept no second
            # connection. Then its link is used, which a name identifies.
            by_name = endpoint_of(target, self._tls)
            if self._shared_poller.known_link(str(target), by_name) is not None:
                return address, by_name
        return address, endpoint_of(address, self._tls)
