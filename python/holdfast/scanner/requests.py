"""Carries out subscribe and unsubscribe requests: of callers, of entries, stored ones."""

from __future__ import annotations

import logging
from functools import partial
from typing import TYPE_CHECKING

from holdfast import logs
from holdfast.scanner.errors import Refused
from holdfast.scanner.jetstream.entry_subscriptions import check_entry
from holdfast.scanner.messages.decoding import decode_lenient
from holdfast.scanner.messages.leniency import Adjustments
from holdfast.scanner.messages.types import Answer, SubscribeRequest, UnsubscribeRequest
from holdfast.scanner.request_log import RequestLog
from holdfast.scanner.subscriptions.subscription import subscription_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from nats.aio.msg import Msg

    from holdfast.scanner.jetstream.buckets import Buckets
    from holdfast.scanner.placement import Placement
    from holdfast.scanner.polling.devices import Devices
    from holdfast.scanner.responder import Responder
    from holdfast.scanner.subscriptions.key import SubscriptionKey
    from holdfast.scanner.subscriptions.registry import Registry
    from holdfast.scanner.subscriptions.rules import Rules
    from holdfast.scanner.subscriptions.subscription import Subscription

RETRY_EXPIRY_S = 1
"""Time until a subscription is ended again that a fleet could not remove from its bucket."""


class Requests:
    """Adds and removes subscriptions."""

    def __init__(
        self,
        rules: Rules,
        registry: Registry,
        devices: Devices,
        placement: Placement,
        buckets: Buckets,
        responder: Responder,
        enable: Callable[[bool], None],
    ) -> None:
        """`enable` is called with what programs have written to a bucket."""
        self._rules = rules
        self._registry = registry
        self._devices = devices
        self._placement = placement
        self._buckets = buckets
        self._responder = responder
        self.enable = enable
        self._log = RequestLog()

    async def subscribe(self, message: Msg) -> Answer:
        """Adds the subscription of a request. Raises `Refused`."""
        async with self._responder.in_order(message):
            rules, adjustments = self._rules, Adjustments(not self._rules.strict)
            max_bytes, normalize = rules.limits.request, rules.dialect.normalize
            request = decode_lenient(
                message.data, SubscribeRequest, max_bytes, adjustments, normalize
            )
            asked = subscription_of(request, rules, adjustments)
            self._buckets.check_not_entry(asked.device, asked.subscriber)
        async with self._devices.lock(asked.device):
            fresh = self._registry.fresh(asked)  # Before the change, after which no tag is fresh.
            add = partial(self._devices.add, asked)
            await self._placement.store(asked.device, add, asked.subscriber)
            if rules.dialect.replaces_subscription:
                self._devices.keep_only(asked.device, asked.subscriber, asked.tags)
        await self._placement.settled(asked.device, asked.subscriber)
        self._log.adjusted(asked.subscriber, asked.device, adjustments)
        self._log.byte_orders(asked, adjustments, fresh)
        self._log.subscribed(asked)
        count = len(request.tags) if request.profile is None else len(asked.tags)
        return Answer(success=True, count=count)

    async def unsubscribe(self, message: Msg) -> Answer:
        """Removes tags of a subscription. Raises `Refused`."""
        async with self._responder.in_order(message):
            rules, adjustments = self._rules, Adjustments(not self._rules.strict)
            max_bytes = rules.limits.request
            request = decode_lenient(message.data, UnsubscribeRequest, max_bytes, adjustments)
            rules.dialect.check_unsubscribe(request)
            self._buckets.check_not_entry(request.device_id, request.subscriber_id)
        async with self._devices.lock(request.device_id):
            await self._remove_stored(request)
        await self._placement.settled(request.device_id, request.subscriber_id)
        self._log.adjusted(request.subscriber_id, request.device_id, adjustments)
        self._log.unsubscribed(request)
        return Answer(success=True)

    async def _remove_stored(self, request: UnsubscribeRequest) -> None:
        """Removes tags of a subscription wherever it is stored. Raises `Refused`."""

        async def change() -> None:
            self._devices.remove(request)

        await self._placement.store(request.device_id, change)

    async def expire(self, subscription: SubscriptionKey) -> None:
        """Ends a subscription that was not renewed within its `ttl`."""
        device_id, subscriber_id = subscription.device, subscription.subscriber
        assert subscriber_id is not None
        ttls = self._devices.ttls
        async with self._devices.lock(device_id):
            if not ttls.is_due(subscription):  # It was renewed while this waited.
                return
            device = self._registry.devices.get(device_id)
            ttl = None
            if device is not None and not self._placement.is_own(device):
                # The node that polls the device ends it. If it does not, this one looks again.
                subscriber = device.subscribers.get(subscriber_id)
                ttl = None if subscriber is None else subscriber.ttl
            ttls.renew(device_id, subscriber_id, ttl)
            if ttl is not None:
                return
            try:
                await self._remove_stored(UnsubscribeRequest(device_id, subscriber_id))
            except Refused:  # JetStream fails: the subscription must not stay for ever.
                ttls.renew(device_id, subscriber_id, RETRY_EXPIRY_S)
                return
        logs.write(logging.INFO, "expired", device=device_id, subscriber=subscriber_id)

    def is_entry(self, device: str, subscriber: str | None) -> bool:
        """Whether a subscription is from an entry of a bucket."""
        return self._buckets.key_of(device, subscriber) is not None

    def check_entry(self, key: str, value: bytes) -> Subscription:
        """Returns the subscription of an entry. Raises `Refused`."""
        rules, adjustments = self._rules, Adjustments(not self._rules.strict)
        max_bytes, normalize = rules.limits.request, rules.dialect.normalize
        request = decode_lenient(value, SubscribeRequest, max_bytes, adjustments, normalize)
        check_entry(key, request)
        asked = subscription_of(request, rules, adjustments)
        self._log.adjusted(asked.subscriber, asked.device, adjustments)
        return asked

    async def carry_out_entry(self, asked: Subscription) -> None:
        """Makes a subscription that of its entry. Raises `Refused`."""
        async with self._devices.lock(asked.device):
            await self._devices.add(asked)
            self._devices.keep_only(asked.device, asked.subscriber, asked.tags)
        self._log.subscribed(asked)

    async def end_entry(self, subscription: SubscriptionKey) -> None:
        """Ends the subscription of an entry."""
        assert subscription.subscriber is not None
        request = UnsubscribeRequest(subscription.device, subscription.subscriber)
        async with self._devices.lock(subscription.device):
            self._devices.remove(request)
        self._log.unsubscribed(request)

    async def restore(self, request: SubscribeRequest) -> None:
        """Carries out a stored request, unless an entry has replaced it. Raises `Refused`."""
        if self.is_entry(request.device_id, request.subscriber_id):
            return
        adjustments = Adjustments()
        asked = subscription_of(request, self._rules, adjustments)
        async with self._devices.lock(asked.device):
            await self._devices.add(asked, is_stored=True)
        self._log.byte_orders(asked, adjustments, asked.tags)

    async def adopt(
        self, device: str, wanted: Mapping[str, Sequence[SubscribeRequest]], renewed: set[str]
    ) -> None:
        """Makes the subscriptions of a device those of the fleet, by subscriber.

        The `ttl` of `renewed` subscribers starts again. Raises `Refused`.
        """
        known = self._registry.devices.get(device)
        for subscriber in [] if known is None else list(known.subscribers):
            if subscriber not in wanted:
                self._devices.remove(UnsubscribeRequest(device, subscriber))
        for subscriber, requests in wanted.items():
            tags: set[str] = set()
            for request in requests:
                asked = subscription_of(request, self._rules)
                # A large subscription is stored as several requests.
                await self._devices.add(asked, renewed=subscriber in renewed)
                tags |= asked.tags.keys()
            self._devices.keep_only(device, subscriber, tags)
