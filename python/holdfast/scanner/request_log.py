"""Logs requests: what they have changed, and what was adjusted in them."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from holdfast import logs

if TYPE_CHECKING:
    from collections.abc import Collection

    from holdfast.scanner.messages.leniency import Adjustments
    from holdfast.scanner.messages.types import UnsubscribeRequest
    from holdfast.scanner.subscriptions.subscription import Subscription

MAX_REMEMBERED = 10_000
"""Limit of remembered subscribers whose requests were adjusted."""


class RequestLog:
    """Writes each kind of adjustment once for each subscriber: callers repeat their requests."""

    def __init__(self) -> None:
        self._written: set[tuple[str, str]] = set()
        """The subscribers, and the kinds of adjustments, that are already logged."""

    def adjusted(self, subscriber: str, device: str, adjustments: Adjustments) -> None:
        """Logs what was changed in a request."""
        for kind, found in adjustments.summary():
            if (subscriber, kind) in self._written:
                continue
            if len(self._written) >= MAX_REMEMBERED:
                self._written.clear()
            self._written.add((subscriber, kind))
            logs.write(logging.WARNING, kind, subscriber=subscriber, device=device, found=found)

    def byte_orders(
        self, asked: Subscription, adjustments: Adjustments, fresh: Collection[str]
    ) -> None:
        """Logs what callers must know of the tags that they had not subscribed to before."""
        about = {"subscriber": asked.subscriber, "device": asked.device}
        for tag, note in adjustments.byte_orders:
            if tag in fresh:
                logs.write(logging.WARNING, "byte_order_differs", **about, tag=tag, note=note)

    def subscribed(self, asked: Subscription) -> None:
        """Logs a subscription."""
        logs.write(
            logging.INFO,
            "subscribed",
            device=asked.device,
            subscriber=asked.subscriber,
            tags=len(asked.tags),
            scan_rate=asked.rate,
        )

    def unsubscribed(self, request: UnsubscribeRequest) -> None:
        """Logs the end of a subscription, or of some of its tags."""
        logs.write(
            logging.INFO,
            "unsubscribed",
            device=request.device_id,
            subscriber=request.subscriber_id,
            tags="all" if request.ids is None else len(request.ids),
        )
