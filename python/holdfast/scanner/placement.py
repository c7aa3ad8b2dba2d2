"""Which scanner polls a device, and where its subscriptions are stored.

A scanner polls all devices itself (`alone`), or shares them with the other nodes of its fleet
(`fleet.placement`). Everything in which the two differ is behind this interface.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping, Sequence

    from nats.aio.client import Client
    from nats.aio.msg import Msg

    from holdfast import _core
    from holdfast.scanner.messages.types import (
        BrowseAnswer,
        BrowseRequest,
        DeviceReport,
        FleetReport,
        SubscribeRequest,
        UnsubscribeRequest,
        Variable,
        VariablesRequest,
    )
    from holdfast.scanner.nats.connection import Handler
    from holdfast.scanner.nats.outbox import Outbox
    from holdfast.scanner.responder import Handle
    from holdfast.scanner.subscriptions.device import ScannedDevice
    from holdfast.scanner.subscriptions.tag import Tag


class DeviceHost(Protocol):
    """The devices of the scanner."""

    def lock(self, device: str) -> asyncio.Lock:
        """Returns the lock that serializes changes of a device."""

    def begin(self, device: ScannedDevice) -> None:
        """Polls a device from now on."""

    def end(self, device: ScannedDevice) -> None:
        """Polls a device no more."""


class SubscriptionHost(Protocol):
    """Carries out what is stored."""

    def is_entry(self, device: str, subscriber: str | None) -> bool:
        """Whether a subscription is from an entry of a bucket, which keeps it then."""

    async def restore(self, request: SubscribeRequest) -> None:
        """Carries out a stored request. Raises `Refused`."""

    async def adopt(
        self, device: str, wanted: Mapping[str, Sequence[SubscribeRequest]], renewed: set[str]
    ) -> None:
        """Makes the subscriptions of a device those of the fleet, by subscriber.

        The `ttl` of `renewed` subscribers starts again. Raises `Refused`.
        """


class CommandHost(Protocol):
    """The commands to devices that this scanner polls."""

    def remaining_s(self, message: Msg) -> float:
        """Returns how many seconds a command may wait now. Raises `Refused` if it is too late."""

    async def write(
        self, device_id: str, tag_id: str, text: str, remaining_s: Callable[[], float]
    ) -> bool:
        """Writes to a device. Returns whether this scanner polls it. Raises `Refused`."""


class ReportHandlers(Protocol):
    """The answers to requests for reports."""

    async def browse(self, message: Msg) -> BrowseAnswer:
        """Reports devices. Raises `Refused`."""

    async def variables(self, message: Msg) -> bytes:
        """Returns the latest values as JSON. Raises `Refused`."""


class ReportHost(ReportHandlers, Protocol):
    """Reports of what this scanner knows."""

    def browse_request(self, message: Msg) -> BrowseRequest:
        """Parses a request. Raises `Refused`."""

    def variables_request(self, message: Msg) -> VariablesRequest:
        """Parses a request. Raises `Refused`."""

    def browsed(self, request: BrowseRequest, ids: Iterable[str]) -> BrowseAnswer:
        """Returns an answer with these devices, as far as they are known."""

    def device_reports(self, ids: Iterable[str]) -> Iterator[tuple[str, DeviceReport]]:
        """Yields the reports of these devices, as far as they are known."""

    def device_variables(self, ids: Iterable[str]) -> Iterator[tuple[str, list[Variable]]]:
        """Yields the latest values of these devices, as far as they are known."""

    def counts(self) -> Mapping[str, int]:
        """Returns what this scanner has done since its start."""

    @property
    def max_bytes(self) -> int:
        """The size limit of an answer."""


class Placement(Protocol):
    """See the module."""

    fleet: str | None
    """The name of the fleet; `None` without one."""
    queue: str
    """The queue group of subjects of which only one node gets each message; empty without one."""
    shared: Sequence[str]
    """These subjects."""

    def outbox(self, repeat_values: Callable[[], None], /) -> Outbox:
        """Returns the queue of messages. It calls `repeat_values` when it had to drop some."""

    def connected(self, client: Client | None) -> None:
        """Sets the client; `None` while there is no connection."""

    async def run(
        self, devices: DeviceHost, subscriptions: SubscriptionHost, ready: asyncio.Event, /
    ) -> None:
        """Restores subscriptions and stores changes until it is cancelled.

        Sets `ready` when requests may be carried out. Raises `FleetRefused`.
        """

    async def leave(self) -> None:
        """Hands all devices over to other nodes, if there are any."""

    async def close(self) -> None:
        """Removes the states of devices, which would be out of date."""

    def added(self, device: ScannedDevice) -> None:
        """Notes that a device is known from now on."""

    def dropped(self, device: ScannedDevice) -> None:
        """Notes that a device is known no more."""

    def is_own(self, device: ScannedDevice, /) -> bool:
        """Whether this scanner polls a device and publishes its values, now."""

    def takes_writes(self, device: ScannedDevice, /) -> bool:
        """Whether this scanner can write to a device, now."""

    def fence(self, device: ScannedDevice, /) -> _core.Fence | None:
        """Returns what closes when another node may poll a device; `None` if none ever may."""

    def lease(self, device: ScannedDevice, /) -> int | None:
        """Returns the number for the header of messages about a device; `None` without a fleet."""

    async def store(
        self,
        device: str,
        change: Callable[[], Awaitable[object]],
        subscriber: str | None = None,
        /,
    ) -> None:
        """Makes a change of the subscriptions of a device, here and wherever else it must be.

        The lock of the device is held. `subscriber` has renewed its subscription. Raises `Refused`;
        then nothing has changed.
        """

    def subscribed(self, device: str, subscriber: str) -> None:
        """Notes that a subscription has changed."""

    def unsubscribed(self, request: UnsubscribeRequest) -> None:
        """Notes that tags of a subscription are removed."""

    def state_changed(self, device: str) -> None:
        """Notes that the state of a device has changed, or that the device is gone."""

    async def settled(self, device: str, subscriber: str) -> None:
        """Waits until a changed subscription is stored; not while JetStream fails."""

    async def write(
        self,
        device: ScannedDevice,
        tag: Tag,
        text: str,
        own: Callable[[], Awaitable[bool]],
        remaining_s: Callable[[], float],
        /,
    ) -> None:
        """Has a command carried out by the scanner that polls the device. Raises `Refused`.

        `own` carries it out here. It returns false, and writes nothing, if the device has moved.
        `remaining_s` refuses it if it is too late, and returns how many seconds it may wait.
        """

    def is_addressed(self, payload: bytes, /) -> bool:
        """Whether a shutdown message is for this scanner, and not for another node."""

    @property
    def writes_heartbeat(self) -> bool:
        """Whether this scanner writes the heartbeat, which all nodes share."""

    @property
    def has_others(self) -> bool:
        """Whether other nodes go on when this one ends."""

    def report(self) -> FleetReport | None:
        """Returns what `browse` reports of the fleet."""

    def reports(self, own: ReportHost) -> ReportHandlers:
        """Returns what answers requests for reports, from those of this scanner."""

    def handlers(
        self,
        commands: CommandHost,
        reports: ReportHost,
        answering: Callable[[str, Handle], Handler],
        end: Callable[[], None],
        /,
    ) -> Mapping[str, Handler]:
        """Returns the handlers of what other nodes ask, by subject. `end` ends this scanner."""
