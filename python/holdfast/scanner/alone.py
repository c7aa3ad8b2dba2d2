"""A scanner that polls all devices itself, and keeps subscriptions in JetStream for a restart."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

from holdfast.faults import STANDBY, fault_text
from holdfast.scanner.errors import Refused
from holdfast.scanner.jetstream.restore import StoredSubscriptions
from holdfast.scanner.nats.outbox import Outbox

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping, Sequence

    from nats.aio.client import Client

    from holdfast.scanner.messages.types import UnsubscribeRequest
    from holdfast.scanner.nats.connection import Handler
    from holdfast.scanner.placement import (
        DeviceHost,
        ReportHandlers,
        ReportHost,
        SubscriptionHost,
    )
    from holdfast.scanner.subscriptions.device import ScannedDevice
    from holdfast.scanner.subscriptions.registry import Registry
    from holdfast.scanner.subscriptions.tag import Tag


class Alone:
    """The placement of a scanner without a fleet, see `Placement`."""

    fleet: str | None = None
    queue = ""
    shared: Sequence[str] = ()
    writes_heartbeat = True
    has_others = False

    def __init__(self, prefix: str, registry: Registry, *, keeps_subscriptions: bool) -> None:
        self._stored = StoredSubscriptions(prefix, registry)
        self._keeps_subscriptions = keeps_subscriptions

    def outbox(self, _repeat_values: Callable[[], None], /) -> Outbox:
        """Returns a queue that keeps the newest message of each tag while NATS is away."""
        return Outbox()

    def connected(self, client: Client | None) -> None:
        """Sets the client; `None` while there is no connection."""
        self._stored.connected(client)

    async def run(
        self, _devices: DeviceHost, subscriptions: SubscriptionHost, ready: asyncio.Event, /
    ) -> None:
        """Restores subscriptions and stores changes until it is cancelled."""
        if self._keeps_subscriptions:
            await self._stored.run(subscriptions, ready)
        else:
            ready.set()
            await asyncio.Event().wait()

    async def leave(self) -> None:
        """Does nothing: there are no other nodes."""

    async def close(self) -> None:
        """Removes the states of devices, which would be out of date."""
        if self._keeps_subscriptions:
            with contextlib.suppress(Exception):  # JetStream is optional, and may fail in any way.
                await self._stored.close()

    def added(self, device: ScannedDevice) -> None:
        """Does nothing: all devices are polled here."""

    def dropped(self, device: ScannedDevice) -> None:
        """Does nothing: all devices are polled here."""

    def is_own(self, _device: ScannedDevice, /) -> bool:
        """Whether this scanner polls a device: it polls all."""
        return True

    def takes_writes(self, _device: ScannedDevice, /) -> bool:
        """Whether this scanner can write to a device: to all."""
        return True

    def fence(self, _device: ScannedDevice, /) -> None:
        """Returns nothing: no other scanner may poll a device."""
        return

    def lease(self, _device: ScannedDevice, /) -> None:
        """Returns nothing: messages need no number when only one scanner sends them."""
        return

    async def store(
        self,
        _device: str,
        change: Callable[[], Awaitable[object]],
        _subscriber: str | None = None,
        /,
    ) -> None:
        """Makes a change. It is stored later: JetStream is optional. Raises `Refused`."""
        await change()

    def subscribed(self, device: str, subscriber: str) -> None:
        """Stores a subscription that has changed."""
        self._stored.changed(device, subscriber)

    def unsubscribed(self, request: UnsubscribeRequest) -> None:
        """Removes tags of a subscription, also of one that is not restored yet."""
        self._stored.unsubscribed(request)

    def state_changed(self, device: str) -> None:
        """Stores the state of a device; removes it if the device is gone."""
        self._stored.state_changed(device)

    async def settled(self, device: str, subscriber: str) -> None:
        """Waits until a changed subscription is stored; not while JetStream fails."""
        await self._stored.settled(device, subscriber)

    async def write(
        self,
        _device: ScannedDevice,
        _tag: Tag,
        _text: str,
        own: Callable[[], Awaitable[bool]],
        _check: Callable[[], float],
        /,
    ) -> None:
        """Carries a command out. Raises `Refused`."""
        if not await own():
            raise Refused(f"not written: {fault_text(STANDBY)}")

    def is_addressed(self, _payload: bytes, /) -> bool:
        """Whether a shutdown message is for this scanner: each one is."""
        return True

    def report(self) -> None:
        """Returns nothing: there is no fleet."""
        return

    def reports(self, own: ReportHost) -> ReportHandlers:
        """Returns the reports of this scanner, which has all devices."""
        return own

    def handlers(self, *_: object) -> Mapping[str, Handler]:
        """Returns nothing: there are no other nodes."""
        return {}
