"""A node of a fleet as a placement: devices are polled by the node that has their lease."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from typing import TYPE_CHECKING, Any

import msgspec

from holdfast import _core, logs
from holdfast.config.scanning import written_pollable
from holdfast.scanner.fleet.agreement import PROTOCOL, Terms
from holdfast.scanner.fleet.answers import NodeAnswers
from holdfast.scanner.fleet.exchange import subject
from holdfast.scanner.fleet.member import FleetMember
from holdfast.scanner.fleet.nodes import OtherNodes
from holdfast.scanner.fleet.reports import FleetReports
from holdfast.scanner.messages.types import Answer, FleetReport
from holdfast.scanner.nats import wire
from holdfast.scanner.nats.connection import Broker
from holdfast.scanner.nats.outbox import Outbox

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping, Sequence

    from nats.aio.client import Client
    from nats.aio.msg import Msg

    from holdfast.leases import StartThread
    from holdfast.scanner.messages.types import UnsubscribeRequest
    from holdfast.scanner.nats.connection import Handler
    from holdfast.scanner.placement import (
        CommandHost,
        DeviceHost,
        ReportHandlers,
        ReportHost,
        SubscriptionHost,
    )
    from holdfast.scanner.responder import Handle
    from holdfast.scanner.settings import FleetSettings, Settings
    from holdfast.scanner.subscriptions.device import ScannedDevice
    from holdfast.scanner.subscriptions.registry import Registry
    from holdfast.scanner.subscriptions.tag import Tag

LEAVE_TIMEOUT_S = 10.0
"""Time to hand devices over to other nodes."""


class FleetPlacement:
    """The placement of a scanner that is a node of a fleet, see `Placement`."""

    def __init__(
        self,
        settings: Settings,
        fleet: FleetSettings,
        registry: Registry,
        start_thread: StartThread,
    ) -> None:
        """`start_thread` starts the thread of the leases."""
        self._settings = settings
        self._prefix = settings.prefix
        self._registry = registry
        self.fleet: str | None = fleet.name
        self.queue = f"holdfast-{fleet.name}"
        names = ("subscribe", "unsubscribe", "command.>", "browse", "variables")
        self.shared: Sequence[str] = [f"{settings.prefix}.{name}" for name in names]
        self.member = FleetMember(
            fleet,
            _terms(settings, fleet),
            registry,
            self._about,
            self._connect_leases,
            start_thread,
        )
        self._fleet = self.member.fleet
        self._nodes = OtherNodes(settings.prefix, self.member)
        self._counts: Callable[[], Mapping[str, int]] = dict
        """What this node has done, from `reports` on."""

    def outbox(self, repeat_values: Callable[[], None]) -> Outbox:
        """Returns a queue that sends nothing while other nodes may poll the same devices."""
        self._outbox = Outbox(
            may_send=lambda: not self.member.is_joined or self._fleet.may_publish,
            on_drop=repeat_values,
            at_once=True,
        )
        return self._outbox

    def connected(self, client: Client | None) -> None:
        """Sets the client; `None` while there is no connection."""
        self.member.connected(client)
        self._nodes.connected(client)

    async def run(
        self, devices: DeviceHost, subscriptions: SubscriptionHost, ready: asyncio.Event
    ) -> None:
        """Is a node until it is cancelled. Raises `FleetRefused`."""
        await self.member.run(devices, subscriptions, ready)

    async def leave(self) -> None:
        """Hands all devices over to other nodes."""
        # Whatever fails here, the leases end by themselves, and others take over then.
        with contextlib.suppress(Exception):
            async with asyncio.timeout(LEAVE_TIMEOUT_S):
                await self.member.leave()

    async def close(self) -> None:
        """Leaves all as it is: the other nodes go on with it."""

    def added(self, device: ScannedDevice) -> None:
        """Notes that a device is known from now on."""
        self.member.added(device)

    def dropped(self, device: ScannedDevice) -> None:
        """Notes that a device is known no more."""
        self.member.dropped(device)

    def is_own(self, device: ScannedDevice) -> bool:
        """Whether this node polls a device, now."""
        return self.member.is_own(device)

    def takes_writes(self, device: ScannedDevice) -> bool:
        """Whether this node can write to a device, now."""
        return self.member.is_own(device) and bool(device.polled_as)

    def fence(self, device: ScannedDevice) -> _core.Fence:
        """Returns what closes when another node may poll a device."""
        return self.member.fence(device)

    def lease(self, device: ScannedDevice) -> int:
        """Returns the number in the header of messages: that of a later node is greater."""
        return self._fleet.epoch(device.partition)

    async def store(
        self, device: str, change: Callable[[], Awaitable[object]], subscriber: str | None = None
    ) -> None:
        """Makes a change, here and in the desired state of the fleet. Raises `Refused`."""
        await self.member.store(device, change, subscriber)

    def subscribed(self, device: str, subscriber: str) -> None:
        """Has nothing to do: `store` has stored it."""

    def unsubscribed(self, request: UnsubscribeRequest) -> None:
        """Has nothing to do: `store` has stored it."""

    def state_changed(self, device: str) -> None:
        """Stores nothing: another node finds out the state of a device itself."""

    async def settled(self, device: str, subscriber: str) -> None:
        """Has nothing to wait for: `store` has stored it."""

    async def write(
        self,
        device: ScannedDevice,
        tag: Tag,
        text: str,
        own: Callable[[], Awaitable[bool]],
        remaining_s: Callable[[], float],
    ) -> None:
        """Has a command carried out by the node that polls the device. Raises `Refused`."""
        await self._nodes.write(device, tag.id, text, own, remaining_s)

    def is_addressed(self, payload: bytes) -> bool:
        """Whether a shutdown message is for all nodes, or for this one."""
        if not payload.strip():
            return True
        try:
            node = msgspec.json.decode(payload, type=dict[str, str]).get("node")
        except msgspec.DecodeError as error:
            logs.refused("message_malformed", kind="shutdown", reason=str(error))
            return False
        return node in (None, self._fleet.node)

    @property
    def writes_heartbeat(self) -> bool:
        """Whether this node writes the heartbeat: that with the first partition does."""
        return self._fleet.is_own(0)

    @property
    def has_others(self) -> bool:
        """Whether other nodes go on when this one ends."""
        return self._fleet.has_others

    def report(self) -> FleetReport:
        """Returns what `browse` reports of the fleet."""
        return FleetReport(self._fleet.settings.name, self._fleet.node, self._fleet.nodes)

    def reports(self, own: ReportHost) -> ReportHandlers:
        """Returns the reports of all nodes."""
        self._counts = own.counts
        return FleetReports(self._registry, own, self._nodes)

    def handlers(
        self,
        commands: CommandHost,
        reports: ReportHost,
        answering: Callable[[str, Handle], Handler],
        end: Callable[[], None],
    ) -> Mapping[str, Handler]:
        """Returns the handlers of what other nodes ask, by subject. `end` ends this scanner."""
        node, process = self._fleet.node, self._fleet.leases.process
        answers = NodeAnswers(self.member, self._registry, commands, reports)
        handlers = {
            subject(self._prefix, node, what, process): answering(what, handle)
            for what, handle in (
                ("command", answers.command),
                ("browse", answers.browse),
                ("variables", answers.variables),
            )
        }

        async def drain(message: Msg) -> None:
            """Hands all devices over to the other nodes, and ends."""
            logs.write(logging.INFO, "shutdown_asked")
            if message.reply:
                answer = wire.text(message.reply, msgspec.json.encode(Answer(success=True)))
                await self._outbox.answer(message.reply, answer)
            end()

        return {**handlers, subject(self._prefix, node, "drain"): drain}

    async def _connect_leases(self, connected: Callable[[Client | None], None]) -> None:
        """Keeps a connection that only the leases use."""
        settings = self._settings
        broker = Broker(
            settings.servers,
            {},
            connected,
            settings.ping,
            name="holdfast leases",
            max_pause_s=settings.max_pause_s,
        )
        await broker.run()

    def _about(self) -> dict[str, Any]:
        """What other nodes are shown of this one."""
        own = list(self.member.own)
        return {
            "version": _core.__version__,
            "devices": len(own),
            "tags": sum(len(device.tags) for device in own),
            **self._counts(),
        }


def _terms(settings: Settings, fleet: FleetSettings) -> Terms:
    """What the other nodes of the fleet must have, too."""
    return Terms(
        protocol=PROTOCOL,
        partitions=fleet.partitions,
        prefix=settings.prefix,
        allow=sorted(map(written_pollable, settings.allow)),
        writes=settings.writes,
        strict=settings.strict,
        defaults=str(settings.defaults),
        limits=str(settings.limits),
        profiles=",".join(sorted(settings.profiles)),
    )
