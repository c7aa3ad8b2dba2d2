"""Answers `browse` and `variables`, with what this scanner knows."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING

from holdfast.scanner.messages.decoding import decode
from holdfast.scanner.messages.types import BrowseRequest, VariablesRequest
from holdfast.scanner.reports.browse import browsed, device_report
from holdfast.scanner.reports.variables import device_variables, variables

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from nats.aio.client import Client
    from nats.aio.msg import Msg

    from holdfast.scanner.jetstream.buckets import Buckets
    from holdfast.scanner.messages.types import BrowseAnswer, DeviceReport, Variable
    from holdfast.scanner.nats.outbox import Outbox
    from holdfast.scanner.polling.poller import Polling
    from holdfast.scanner.publish.publishers import Publishers
    from holdfast.scanner.reports.service_status import ServiceStatus
    from holdfast.scanner.responder import Responder
    from holdfast.scanner.settings import Settings
    from holdfast.scanner.subscriptions.device import ScannedDevice
    from holdfast.scanner.subscriptions.registry import Registry

USUAL_MAX_PAYLOAD_BYTES = 2**20
"""The size limit of messages, before a NATS server sends its own."""

MISSED_COUNT_INTERVAL_S = 10.0
"""Between two counts of missed scans for other nodes: many devices take milliseconds."""


class Reports:
    """Reports devices of the registry."""

    def __init__(
        self,
        settings: Settings,
        registry: Registry,
        polling: Polling,
        publishers: Publishers,
        outbox: Outbox,
        status: ServiceStatus,
        buckets: Buckets,
        responder: Responder,
        client: Callable[[], Client | None],
    ) -> None:
        """`client` returns the client while there is a connection."""
        self._prefix = settings.prefix
        self._max_request_bytes = settings.limits.request
        self._registry = registry
        self._polling = polling
        self._publishers = publishers
        self._outbox = outbox
        self._status = status
        self._buckets = buckets
        self._responder = responder
        self._client = client
        self._missed = 0
        self._missed_counted_at = -math.inf

    @property
    def max_bytes(self) -> int:
        """The size limit of an answer."""
        client = self._client()
        return USUAL_MAX_PAYLOAD_BYTES if client is None else client.max_payload

    def browse_request(self, message: Msg) -> BrowseRequest:
        """Parses a request; an empty one is valid. Raises `Refused`."""
        if not message.data:
            return BrowseRequest()
        return decode(message.data, BrowseRequest, self._max_request_bytes)

    def variables_request(self, message: Msg) -> VariablesRequest:
        """Parses a request; an empty one is valid. Raises `Refused`."""
        if not message.data:
            return VariablesRequest()
        return decode(message.data, VariablesRequest, self._max_request_bytes)

    async def browse(self, message: Msg) -> BrowseAnswer:
        """Reports devices. Raises `Refused`."""
        request = self.browse_request(message)
        async with self._responder.in_order(message, is_large=True):
            return self.browsed(request, self._registry.devices)

    async def variables(self, message: Msg) -> bytes:
        """Returns the latest values as JSON. Raises `Refused`."""
        request = self.variables_request(message)
        async with self._responder.in_order(message, is_large=True):
            devices = self._known(self._registry.devices)
            refused = self._buckets.refused
            return variables(request, devices, refused, self._prefix, self.max_bytes)

    def browsed(self, request: BrowseRequest, ids: Iterable[str]) -> BrowseAnswer:
        """Returns an answer with these devices, as far as they are known. Raises `Refused`."""
        counters, status = self._polling.counters(), self._status.report()
        return browsed(request, self._known(ids), counters, status, self.max_bytes)

    def device_reports(self, ids: Iterable[str]) -> Iterator[tuple[str, DeviceReport]]:
        """Yields the reports of these devices, as far as they are known."""
        counters, max_bytes = self._polling.counters(), self.max_bytes
        for id, (device, undecoded) in self._known(ids).items():
            yield id, device_report(device, undecoded, counters, max_bytes)

    def device_variables(self, ids: Iterable[str]) -> Iterator[tuple[str, list[Variable]]]:
        """Yields the latest values of these devices, as far as they are known."""
        for id, (device, undecoded) in self._known(ids).items():
            yield id, list(device_variables(device, undecoded, self._prefix))

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

    def _known(self, ids: Iterable[str]) -> dict[str, tuple[ScannedDevice, Mapping[str, str]]]:
        """Returns devices, each with the errors of its tags that could not be decoded."""
        devices = self._registry.devices
        return {id: (devices[id], self._publishers.undecoded(id)) for id in ids if id in devices}
