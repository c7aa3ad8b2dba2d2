"""The counts of the service, and what else `browse` reports of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.scanner.messages.types import EntryReport, ServiceReport

if TYPE_CHECKING:
    from holdfast.scanner.jetstream.buckets import Buckets
    from holdfast.scanner.nats.outbox import Outbox
    from holdfast.scanner.placement import Placement
    from holdfast.scanner.polling.poller import Polling
    from holdfast.scanner.presence import Presence

MAX_REFUSED_SHOWN = 100
"""Limit of refused entries in an answer."""


class ServiceStatus:
    """Reports the service."""

    def __init__(
        self,
        presence: Presence,
        outbox: Outbox,
        polling: Polling,
        buckets: Buckets,
        placement: Placement,
    ) -> None:
        self._presence = presence
        self._outbox = outbox
        self._polling = polling
        self._buckets = buckets
        self._placement = placement

    def report(self) -> ServiceReport:
        """Returns the report."""
        refused = [
            EntryReport(key=entry.key, error=entry.reason)
            for entry in self._buckets.refused[:MAX_REFUSED_SHOWN]
        ]
        return ServiceReport(
            started_at=self._presence.started,
            published=self._outbox.sent,
            replaced=self._outbox.replaced,
            dropped=self._outbox.dropped,
            lost_scans=self._polling.dropped,
            other_scanners=self._presence.other_scanners.current() or None,
            enabled=self._buckets.is_enabled,
            refused_entries=refused or None,
            fleet=self._placement.report(),
        )
