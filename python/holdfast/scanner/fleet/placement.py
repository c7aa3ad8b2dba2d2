"""A node of a fleet as a placement: devices are polled by the node that has their lease."""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING, Any

from holdfast import _core
from holdfast.events import log_lines
from holdfast.net.nats.connection import NatsConnection
from holdfast.net.nats.outbox import Outbox
from holdfast.scanner.fleet import shutdown
from holdfast.scanner.fleet.agreement import Terms
from holdfast.scanner.fleet.member import FleetMember
from holdfast.scanner.fleet.nodes import NodeAnswers, OtherNodes
from holdfast.scanner.fleet.questions import subject
from holdfast.scanner.fleet.reports import FleetReports
from holdfast.scanner.messages.types import Announcement, Answer, FleetReport

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from nats.aio.client import Client
    from nats.aio.msg import Msg

    from holdfast.net.nats.connection import Handler
    from holdfast.replication.leases.thread import StartThread
    from holdfast.scanner.placement import (
        LocalCommands,
        LocalReports,
        LocalWrite,
        ReportHandlers,
    )
    from holdfast.scanner.responder import Responder
    from holdfast.scanner.settings import FleetSettings, Settings
    from holdfast.scanner.subscriptions.device import ScannedDevice
    from holdfast.scanner.subscriptions.registry import Registry
    from holdfast.scanner.subscriptions.tag import ScannedTag

FIND_BUCKET_S = 15.0
"""Seconds in which all nodes have found the bucket that is made in place of a lost one."""

MAX_OTHER_BUCKETS = 100
"""Limit of remembered buckets of others."""


class FleetPlacement(FleetMember):
    """The placement of a scanner that is a node of a fleet, see `Placement`."""

    def __init__(
        self,
        settings: Settings,
        fleet_settings: FleetSettings,
        registry: Registry,
        start_thread: StartThread,
    ) -> None:
        """`start_thread` starts the thread of the leases."""
        self._settings = settings
        self._prefix = settings.prefix
        self._other_buckets: dict[str, float] = {}
        """When other buckets of subscriptions of the same name were first heard of."""
        self.queue_group = f"holdfast-{fleet_settings.name}"
        names = ("subscribe", "unsubscribe", "command.>", "browse", "variables")
        self.shared_subjects = [f"{settings.prefix}.{name}" for name in names]
        self._counts: Callable[[], Mapping[str, int]] = dict
        """What this node has done, from `reports` on."""
        terms = Terms.of(settings, fleet_settings)
        super().__init__(
            fleet_settings, terms, registry, self._about, self._connect_leases, start_thread
        )
        self._nodes = OtherNodes(settings.prefix, self)

    def outbox(self, repeat_values: Callable[[], None], /) -> Outbox:
        """Returns a queue that sends nothing while other nodes may poll the same devices."""
        return Outbox(
            may_send=lambda: not self.is_joined or self.partition_leases.may_publish,
            on_drop=repeat_values,
            at_once=True,
        )

    async def write(
        self,
        device: ScannedDevice,
        tag: ScannedTag,
        text: str,
        write_here: LocalWrite,
        remaining_s: Callable[[], float],
        /,
    ) -> None:
        """Has a command carried out by the node that polls the device. Raises `Refused`."""
        await self._nodes.write(device, tag.id, text, write_here, remaining_s)

    def is_addressed(self, payload: bytes, /) -> bool:
        """Whether a shutdown message is for all nodes, or for this one."""
        return shutdown.ends(payload, self.partition_leases.node)

    @property
    def writes_heartbeat(self) -> bool:
        """Whether this node writes the heartbeat: that with the first partition does."""
        return self.partition_leases.is_own(0)

    @property
    def has_others(self) -> bool:
        """Whether other nodes go on when this one ends."""
        return self.partition_leases.has_others

    def announcement(self, started: int, /) -> Announcement:
        """Returns what this node announces to other scanners."""
        fleet = self.partition_leases.settings.name
        return Announcement(started_at=started, fleet=fleet, bucket=self.desired.made_at)

    def shares_devices(self, other: Announcement, /) -> bool:
        """Whether another scanner is a node of this fleet.

        Two JetStreams have two fleets of the same name, which know nothing of each other.
        """
        if other.fleet != self.partition_leases.settings.name:
            return False
        own, now = self.desired.made_at, time.monotonic()
        if not own or other.bucket in ("", own):
            self._other_buckets.pop(own, None)
            return True
        if len(self._other_buckets) >= MAX_OTHER_BUCKETS:
            self._other_buckets.clear()
        return now < self._other_buckets.setdefault(other.bucket, now) + FIND_BUCKET_S

    def report(self) -> FleetReport:
        """Returns what `browse` reports of the fleet."""
        return FleetReport(
            self.partition_leases.settings.name,
            self.partition_leases.node,
            self.partition_leases.nodes,
        )

    def reports(self, own: LocalReports) -> ReportHandlers:
        """Returns the reports of all nodes."""
        self._counts = own.counts
        return FleetReports(self._registry, own, self._nodes)

    def handlers(
        self,
        commands: LocalCommands,
        reports: LocalReports,
        responder: Responder,
        end: Callable[[], None],
        /,
    ) -> Mapping[str, Handler]:
        """Returns the handlers of what other nodes ask, by subject. `end` ends this scanner."""
        node, process = self.partition_leases.node, self.partition_leases.leases.process
        answers = NodeAnswers(self, self._registry, commands, reports)
        handlers = {
            subject(self._prefix, node, what, process): responder.answering(what, handle)
            for what, handle in (
                ("command", answers.command),
                ("browse", answers.browse),
                ("variables", answers.variables),
            )
        }

        async def drain(message: Msg) -> None:
            """Hands all devices over to the other nodes, and ends."""
            log_lines.write(logging.INFO, "shutdown_asked")
            await responder.answer(message, Answer(success=True))
            end()

        return {**handlers, subject(self._prefix, node, "drain"): drain}

    async def _connect_leases(self, connected: Callable[[Client | None], None]) -> None:
        """Keeps a connection that only the leases use."""
        settings = self._settings
        broker = NatsConnection(
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
        own = list(self.own)
        return {
            "version": _core.__version__,
            "devices": len(own),
            "tags": sum(len(device.tags) for device in own),
            "refused": self.refused,
            **self._counts(),
        }
