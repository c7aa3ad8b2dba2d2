"""Answers `browse` and `variables`, with what this scanner knows."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from holdfast.scanner.messages.decoding import decode
from holdfast.scanner.messages.types import (
    BrowseRequest,
    EntryReport,
    ServiceReport,
    VariablesRequest,
)
from holdfast.scanner.reports.browse import DeviceReporter, browsed
from holdfast.scanner.reports.variables import variable, variables

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from nats.aio.msg import Msg

    from holdfast.net.nats.outbox import Outbox
    from holdfast.scanner.jetstream.buckets import Buckets
    from holdfast.scanner.messages.decoding import Decoded
    from holdfast.scanner.messages.types import BrowseAnswer, DeviceReport, Variable
    from holdfast.scanner.placement import Placement
    from holdfast.scanner.polling.poller import Polling
    from holdfast.scanner.presence import Presence
    from holdfast.scanner.publish.publishers import Publishers
    from holdfast.scanner.responder import Responder
    from holdfast.scanner.settings import Settings
    from holdfast.scanner.subscriptions.device import ScannedDevice
    from holdfast.scanner.subscriptions.registry import Registry

MISSED_COUNT_INTERVAL_S = 10.0
"""Between two counts of missed scans for other nodes: many devices take milliseconds."""

MAX_REFUSED_SHOWN = 100
"""Limit of refused entries in an answer."""


@dataclass(eq=False)
class Reports:
    """Reports the service, and devices of the registry."""

    _settings: Settings
    _registry: Registry
    _polling: Polling
    _publishers: Publishers
    _outbox: Outbox
    _presence: Presence
    _buckets: Buckets
    _placement: Placement
    _responder: Responder
    _missed: int = 0
    _missed_counted_at: float = -math.inf

    @property
    def max_bytes(self) -> int:
        """The size limit of an answer."""
        return self._outbox.max_answer

    def request(self, message: Msg, kind: type[Decoded]) -> Decoded:
        """Parses a request; an empty one is valid. Raises `Refused`."""
        return decode(message.data or b"{}", kind, self._settings.limits.request)

    async def browse(self, message: Msg) -> BrowseAnswer:
        """Reports devices. Raises `Refused`."""
        request = self.request(message, BrowseRequest)
        async with self._responder.in_order(message, is_large=True):
            return self.browsed(request, self._registry.devices)

    async def variables(self, message: Msg) -> bytes:
        """Returns the latest values as JSON. Raises `Refused`."""
        request = self.request(message, VariablesRequest)
        async with self._responder.in_order(message, is_large=True):
            devices, refused = self._registry.devices, self._buckets.refused
            return variables(request, devices, refused, self._settings.prefix, self.max_bytes)

    def browsed(self, request: BrowseRequest, ids: Iterable[str]) -> BrowseAnswer:
        """Returns an answer with these devices, as far as they are known. Raises `Refused`."""
        devices = {device.id: device for device in self._known(ids)}
        return browsed(request, devices, self._polling.counters(), self._service(), self.max_bytes)

    def device_reports(self, ids: Iterable[str]) -> Iterator[tuple[str, DeviceReport]]:
        """Yields the reports of these devices, as far as they are known."""
        counters, max_bytes = self._polling.counters(), self.max_bytes
        for device in self._known(ids):
            yield device.id, DeviceReporter(device, counters).whole(max_bytes)

    def device_variables(self, ids: Iterable[str]) -> Iterator[tuple[str, Iterator[Variable]]]:
        """Yields the latest values of these devices, as far as they are known."""
        for device in self._known(ids):
            tags = device.tags.values()
            yield device.id, (variable(device, tag, self._settings.prefix) for tag in tags)

    def counts(self) -> Mapping[str, int]:
        """Returns what this scanner has done since its start, for other nodes of a fleet."""
        now = time.monotonic()
        if now > self._missed_counted_at + MISSED_COUNT_INTERVAL_S:
            self._missed_counted_at = now
            self._missed = sum(each["missed"] for each in self._polling.counters().values())
        return {
            "scans": self._publishers.scans,
            "missed": self._missed,
            "lost": self._polling.dropped,
            "published": self._outbox.sent,
        }

    def _service(self) -> ServiceReport:
        refused = [
            EntryReport(key=entry.key, error=entry.reason)
            for entry in self._buckets.refused[:MAX_REFUSED_SHOWN]
        ]
        return ServiceReport(
            started_at=self._presence.heartbeat.started,
            published=self._outbox.sent,
            replaced=self._outbox.replaced,
            dropped=self._outbox.dropped,
            lost_scans=self._polling.dropped,
            other_scanners=self._presence.other_scanners.current() or None,
            enabled=self._buckets.is_enabled,
            refused_entries=refused or None,
            fleet=self._placement.report(),
        )

    def _known(self, ids: Iterable[str]) -> Iterator[ScannedDevice]:
        devices = self._registry.devices
        return (devices[id] for id in ids if id in devices)
