"""Which scanner polls a device, and where its subscriptions are stored.

A scanner polls all devices itself, and may keep their subscriptions in JetStream
(`jetstream.restore`); or it shares devices with the other nodes of its fleet (`fleet.placement`).
Everything in which these differ is here.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Protocol, TypeAlias, TypeVar

from holdfast.net.nats.outbox import Outbox
from holdfast.scanner.messages.types import Announcement

if TYPE_CHECKING:
    from collections.abc import (
        Awaitable,
        Callable,
        Collection,
        Iterable,
        Iterator,
        Mapping,
        Sequence,
    )

    from nats.aio.client import Client
    from nats.aio.msg import Msg

    from holdfast import _core
    from holdfast.net.nats.connection import Handler
    from holdfast.scanner.messages.decoding import Decoded
    from holdfast.scanner.messages.types import (
        BrowseAnswer,
        BrowseRequest,
        DeviceReport,
        FleetReport,
        SubscribeRequest,
        UnsubscribeRequest,
        Variable,
    )
    from holdfast.scanner.responder import Responder
    from holdfast.scanner.subscriptions.device import ScannedDevice
    from holdfast.scanner.subscriptions.key import SubscriptionKey
    from holdfast.scanner.subscriptions.subscription import Subscription
    from holdfast.scanner.subscriptions.tag import ScannedTag

Changed = TypeVar("Changed")
"""What a change of subscriptions returns."""

LocalWrite: TypeAlias = "Callable[[Callable[[], float]], Awaitable[None]]"
"""Writes the value of a command to its device, as `LocalCommands.write` with its `remaining_s`."""


class DeviceControl(Protocol):
    """The devices of the scanner."""

    def lock(self, device: str) -> asyncio.Lock:
        """Returns the lock that serializes changes of a device."""

    def begin(self, device: ScannedDevice) -> None:
        """Polls a device from now on."""

    def end(self, device: ScannedDevice) -> None:
        """Polls a device no more."""

    def give_up(self, device_id: str, reason: str) -> None:
        """Publishes that a device is offline whose stored subscription is refused."""


class SubscriptionControl(Protocol):
    """Carries out what is stored."""

    def is_entry(self, subscription: SubscriptionKey) -> bool:
        """Whether a subscription is from an entry of a bucket, which keeps it then."""

    async def restore(self, request: SubscribeRequest) -> None:
        """Carries out a stored request. The lock of the device is held. Raises `Refused`."""

    async def adopt(
        self, device: str, desired: Mapping[str, Sequence[SubscribeRequest]], renewed: set[str]
    ) -> None:
        """Makes the subscriptions of a device those of the fleet, by subscriber.

        The `ttl` of `renewed` subscribers starts again. Raises `Refused`.
        """


class LocalCommands(Protocol):
    """The commands to devices that this scanner polls."""

    def remaining_s(self, message: Msg) -> float:
        """Returns how many seconds a command may wait now. Raises `Refused` if it is too late."""

    async def write(
        self, device_id: str, tag_id: str, text: str, remaining_s: Callable[[], float]
    ) -> None:
        """Writes to a device. Raises `Refused`; `Moved` if this scanner does not poll it."""


class ReportHandlers(Protocol):
    """The answers to requests for reports."""

    async def browse(self, message: Msg) -> BrowseAnswer:
        """Reports devices. Raises `Refused`."""

    async def variables(self, message: Msg) -> bytes:
        """Returns the latest values as JSON. Raises `Refused`."""


class LocalReports(ReportHandlers, Protocol):
    """Reports of what this scanner knows."""

    def request(self, message: Msg, kind: type[Decoded]) -> Decoded:
        """Parses a request. Raises `Refused`."""

    def browsed(self, request: BrowseRequest, ids: Iterable[str]) -> BrowseAnswer:
        """Returns an answer with these devices, as far as they are known."""

    def device_reports(self, ids: Iterable[str]) -> Iterator[tuple[str, DeviceReport]]:
        """Yields the reports of these devices, as far as they are known."""

    def device_variables(self, ids: Iterable[str]) -> Iterator[tuple[str, Iterator[Variable]]]:
        """Yields the latest values of these devices, as far as they are known."""

    def counts(self) -> Mapping[str, int]:
        """Returns what this scanner has done since its start."""

    @property
    def max_bytes(self) -> int:
        """The size limit of an answer."""


class Placement:
    """Polls all devices, and stores no subscriptions. Subclasses override what differs."""

    queue_group = ""
    """The NATS queue group of `shared_subjects`; empty without a fleet."""
    shared_subjects: Sequence[str] = ()
    """The subjects of which only one node of the fleet gets each message."""

    def outbox(self, _repeat_values: Callable[[], None], /) -> Outbox:
        """Returns the queue of messages, which keeps the newest of each tag while NATS is away.

        That of a fleet drops messages if it must, and calls `repeat_values` then.
        """
        return Outbox()

    def connected(self, client: Client | None) -> None:
        """Sets the client; `None` while there is no connection."""

    async def run(
        self, _devices: DeviceControl, _subscriptions: SubscriptionControl, ready: asyncio.Event, /
    ) -> None:
        """Restores subscriptions and stores changes until it is cancelled.

        Sets `ready` when requests may be carried out. Raises `FleetRefused`.
        """
        ready.set()
        await asyncio.Event().wait()

    async def leave(self) -> None:
        """Hands all devices over to other nodes, if there are any."""

    async def close(self) -> None:
        """Removes the states of devices, which would be out of date."""

    def on_subscribed(
        self, _device: ScannedDevice, _subscription: Subscription, /, *, is_stored: bool
    ) -> None:
        """Notes that a device is known from now on.

        The subscription must be stored, unless it is stored already.
        """

    def on_dropped(self, device: ScannedDevice) -> None:
        """Notes that a device is known no more."""

    def is_own(self, _device: ScannedDevice, /) -> bool:
        """Whether this scanner polls a device and publishes its values, now."""
        return True

    def takes_writes(self, _device: ScannedDevice, /) -> bool:
        """Whether this scanner can write to a device, now."""
        return True

    def fence(self, _device: ScannedDevice, /) -> _core.Fence | None:
        """Returns what closes when another node may poll a device; `None` if none ever may."""
        return None

    def lease(self, _device: ScannedDevice, /) -> int | None:
        """Returns the number of the lease, for the header of messages; `None` without a fleet."""
        return None

    async def store(
        self,
        _device: str,
        change: Callable[[], Awaitable[Changed]],
        _subscriber: str | None = None,
        /,
    ) -> Changed:
        """Makes a change of the subscriptions of a device, here and wherever else it must be.

        The lock of the device is held. `subscriber` has renewed its subscription. Raises `Refused`;
        then nothing has changed. Returns what `change` returns.
        """
        return await change()

    async def refresh(self, _device: str, /) -> None:
        """Carries out the latest change of the subscriptions of a device, whoever has made it.

        Raises `Refused` if it can't be known.
        """

    def on_unsubscribed(self, request: UnsubscribeRequest) -> None:
        """Notes that tags of a subscription are removed."""

    def take_over_refused(self, _refused: SubscribeRequest, /) -> bool:
        """Stores a refused request of a former scanner, to try it again. Returns whether it did."""
        return False

    def handed_over(self, request: SubscribeRequest, /) -> SubscribeRequest:
        """Returns the request of a known subscription as the next scanner is to have it."""
        return request

    def removals(self, known: Iterable[SubscriptionKey], /) -> Iterator[UnsubscribeRequest]:
        """Yields what to remove from stored subscriptions, for the next scanner of this process.

        That scanner gets the `known` subscriptions from this one.
        """
        return (owner.removal() for owner in known)

    def on_state_changed(self, device: str) -> None:
        """Notes that the state of a device has changed, or that the device is gone."""

    async def wait_until_stored(
        self, _subscription: SubscriptionKey, _tags: Collection[str] = (), /
    ) -> str | None:
        """Waits until a changed subscription is stored; not while JetStream fails.

        Returns why one of these tags can't be stored, if so.
        """
        return None

    async def write(
        self,
        _device: ScannedDevice,
        _tag: ScannedTag,
        _text: str,
        write_here: LocalWrite,
        remaining_s: Callable[[], float],
        /,
    ) -> None:
        """Has a command carried out by the scanner that polls the device. Raises `Refused`.

        `remaining_s` refuses it if it is too late, and returns how many seconds it may wait.
        `write_here` carries it out in this scanner, and calls `remaining_s` immediately before it
        sends the write. It raises `Moved`, and writes nothing, if the device has moved.
        """
        await write_here(remaining_s)

    def is_addressed(self, _payload: bytes, /) -> bool:
        """Whether a shutdown message is for this scanner, and not for another node."""
        return True

    @property
    def writes_heartbeat(self) -> bool:
        """Whether this scanner writes the heartbeat, which all nodes share."""
        return True

    @property
    def has_others(self) -> bool:
        """Whether other nodes go on when this one ends."""
        return False

    def announcement(self, started: int, /) -> Announcement:
        """Returns what this scanner announces to others."""
        return Announcement(started_at=started)

    def shares_devices(self, _other: Announcement, /) -> bool:
        """Whether another scanner shares its devices with this one, so that it is no competitor."""
        return False

    def report(self) -> FleetReport | None:
        """Returns what `browse` reports of the fleet."""
        return None

    def reports(self, own: LocalReports) -> ReportHandlers:
        """Returns what answers requests for reports, from those of this scanner."""
        return own

    def handlers(
        self,
        _commands: LocalCommands,
        _reports: LocalReports,
        _responder: Responder,
        _end: Callable[[], None],
        /,
    ) -> Mapping[str, Handler]:
        """Returns the handlers of what other nodes ask, by subject. `end` ends this scanner."""
        return {}
