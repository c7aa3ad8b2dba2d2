"""Carries out subscribe and unsubscribe requests from callers, bucket entries and storage."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING

import msgspec

from holdfast.events import log_lines
from holdfast.runtime.text import clip
from holdfast.scanner.errors import Refused
from holdfast.scanner.jetstream.entries import (
    is_last,
    joined,
    restored,
    tag_ids,
    with_later,
    without,
)
from holdfast.scanner.jetstream.entries import requests as stored_requests
from holdfast.scanner.jetstream.entry_subscriptions import check_entry
from holdfast.scanner.messages.decoding import Adjustments, decode_lenient
from holdfast.scanner.messages.types import Answer, SubscribeRequest, UnsubscribeRequest
from holdfast.scanner.subscriptions.key import SubscriptionKey
from holdfast.scanner.subscriptions.subscription import gained, subscription_of, without_lost

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping, Sequence

    from nats.aio.msg import Msg

    from holdfast.scanner.jetstream.buckets import Buckets
    from holdfast.scanner.messages.decoding import Lenient, Normalize
    from holdfast.scanner.placement import Placement
    from holdfast.scanner.polling.devices import Devices
    from holdfast.scanner.responder import Responder
    from holdfast.scanner.subscriptions.device import Subscriber
    from holdfast.scanner.subscriptions.registry import Registry
    from holdfast.scanner.subscriptions.request_rules import Rules
    from holdfast.scanner.subscriptions.subscription import Subscription

RETRY_EXPIRY_S = 1
"""Delay before an expired subscription is removed again after JetStream has failed."""

MAX_LOGGED_IDS = 200
"""The most characters of tag ids in one line of the log."""

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
            if not log_lines.requested(
                logging.WARNING, kind, subscriber=subscriber, device=device, found=found
            ):
                continue  # Its repetition may be logged.
            if len(self._written) >= MAX_REMEMBERED:
                # Logging an adjustment twice is harmless; memory without limit is not.
                self._written.clear()
            self._written.add((subscriber, kind))

    def byte_orders(
        self, subscription: Subscription, adjustments: Adjustments, new: Collection[str]
    ) -> None:
        """Logs what callers must know of the tags that they had not subscribed to before."""
        tags: dict[str, list[str]] = {}
        for tag, note in adjustments.byte_orders:
            if tag in new:
                tags.setdefault(note, []).append(tag)
        about = {"subscriber": subscription.subscriber, "device": subscription.device}
        for note, ids in tags.items():
            shown = clip(", ".join(ids), MAX_LOGGED_IDS)
            log_lines.requested(
                logging.WARNING,
                "byte_order_differs",
                **about,
                count=len(ids),
                tags=shown,
                note=note,
            )

    def subscribed(self, subscription: Subscription) -> None:
        """Logs a subscription."""
        tags, rate = len(subscription.tags), subscription.rate
        fields = subscription.key.fields
        log_lines.requested(logging.INFO, "subscribed", **fields, tags=tags, scan_rate=rate)

    def tags_not_restored(
        self, subscription: Subscription, tags: Iterable[str], reason: str
    ) -> None:
        """Logs the tags without which a stored subscription is carried out."""
        shown = clip(", ".join(tags), MAX_LOGGED_IDS)
        fields = subscription.key.fields
        log_lines.write(logging.WARNING, "tags_not_restored", **fields, tags=shown, reason=reason)

    def unsubscribed(self, request: UnsubscribeRequest, *, was_known: bool = True) -> None:
        """Logs the end of a subscription, or of some of its tags."""
        tags = "all" if request.ids is None else len(request.ids)
        fields = SubscriptionKey.of(request).fields
        if was_known:
            log_lines.requested(logging.INFO, "unsubscribed", **fields, tags=tags)
        else:  # Apart: any number of requests that end nothing must not hide others.
            log_lines.limited(logging.INFO, "unsubscribed", kind="unknown", **fields, tags=tags)


@dataclass(eq=False)
class Requests:
    """Adds and removes subscriptions."""

    _rules: Rules
    _registry: Registry
    _devices: Devices
    _placement: Placement
    _buckets: Buckets
    _responder: Responder
    enable: Callable[[bool], None]
    """Called with the value of the `enabled` key when a program writes it."""
    former: dict[SubscriptionKey, list[SubscribeRequest]] = field(default_factory=dict)
    """Requests of a former scanner that are refused here. The next scanner may accept them."""
    _log: RequestLog = field(default_factory=RequestLog)

    async def subscribe(self, message: Msg) -> Answer:
        """Adds the subscription of a request. Raises `Refused`."""
        async with self._responder.in_order(message):
            normalize = self._rules.dialect.normalize
            request, adjustments = self._decoded(message.data, SubscribeRequest, normalize)
            subscription = subscription_of(request, self._rules, adjustments)
            # The program that owns the entry would overwrite this request at its next change.
            self._buckets.check_not_entry(subscription.key)
        async with self._devices.lock(subscription.device):
            add = partial(self._devices.add, subscription)
            new = await self._placement.store(subscription.device, add, subscription.subscriber)
            if self._rules.dialect.replaces_subscription:
                self._devices.keep_only(
                    subscription.device, subscription.subscriber, subscription.tags
                )
            self._renew_former(subscription)
        # Outside the lock: storing can take seconds, and other requests need not wait for it.
        unstored = await self._placement.wait_until_stored(
            subscription.key, subscription.tags.keys()
        )
        self._log.adjusted(subscription.subscriber, subscription.device, adjustments)
        self._log.byte_orders(subscription, adjustments, new)
        self._log.subscribed(subscription)
        if unstored is not None:
            return Answer(success=False, error=f"subscribed, but not kept: {unstored}")
        count = len(request.tags) if request.profile is None else len(subscription.tags)
        return Answer(success=True, count=count)

    def _renew_former(self, subscription: Subscription) -> None:
        """Adds a new request to the refused ones of its subscriber, which keep their tags."""
        former = self.former.pop(subscription.key, [])
        device = self._registry.devices.get(subscription.device)
        if self._rules.dialect.replaces_subscription or not former:
            return
        if device is not None and subscription.subscriber in device.subscribers:
            more = device, subscription.subscriber, subscription.given_settings
            # Each by itself: what is refused of one must not refuse another.
            parts = [with_later([each], *more, self._rules.profiles) for each in former]
            former = [joined(each) for each in parts if each]
        if former:
            self.former[subscription.key] = former

    async def unsubscribe(self, message: Msg) -> Answer:
        """Removes tags of a subscription. Raises `Refused`."""
        async with self._responder.in_order(message):
            request, adjustments = self._decoded(message.data, UnsubscribeRequest)
            self._rules.dialect.check_unsubscribe(request)
            owner = SubscriptionKey.of(request)
            self._buckets.check_not_entry(owner)
        async with self._devices.lock(request.device_id):
            was_known = await self._remove_stored(request)
        former = self.former.pop(owner, [])
        if request.ids is not None:
            ids, profiles = set(request.ids), self._rules.profiles
            left = [each for whole in former for each in without([whole], ids, profiles)]
            if left:
                self.former[owner] = left
        await self._placement.wait_until_stored(owner)
        self._log.adjusted(request.subscriber_id, request.device_id, adjustments)
        self._log.unsubscribed(request, was_known=was_known or bool(former))
        return Answer(success=True)

    def _decoded(
        self, data: bytes, kind: type[Lenient], normalize: Normalize | None = None
    ) -> tuple[Lenient, Adjustments]:
        adjustments = Adjustments(not self._rules.strict)
        max_bytes = self._rules.limits.request
        return decode_lenient(data, kind, max_bytes, adjustments, normalize), adjustments

    async def _remove_stored(self, request: UnsubscribeRequest) -> bool:
        """Removes tags of a subscription wherever it is stored. Raises `Refused`.

        Returns whether any was known.
        """

        async def change() -> bool:
            device = self._registry.devices.get(request.device_id)
            subscriber = None if device is None else device.subscribers.get(request.subscriber_id)
            was_known = subscriber is not None and (
                request.ids is None or any(id in subscriber.tags for id in request.ids)
            )
            self._devices.remove(request)
            return was_known

        return await self._placement.store(request.device_id, change)

    async def expire(self, subscription: SubscriptionKey) -> None:
        """Ends a subscription that was not renewed within its `ttl`."""
        device_id, subscriber_id = subscription.device, subscription.subscriber
        assert subscriber_id is not None
        ttls = self._devices.ttls
        async with self._devices.lock(device_id):
            if not ttls.is_due(subscription):  # It was renewed while this waited.
                return
            device = self._registry.devices.get(device_id)
            subscriber = None if device is None else device.subscribers.get(subscriber_id)
            if device is None or subscriber is None or not self._placement.is_own(device):
                # The node that polls the device ends it. If it does not, this one looks again.
                ttls.renew(subscription, None if subscriber is None else subscriber.ttl)
                return

            async def change() -> bool:
                # Each time: another node may have renewed it, which a failed attempt finds out.
                if is_due := ttls.is_due(subscription):
                    self._devices.remove(UnsubscribeRequest(device_id, subscriber_id))
                return is_due

            try:
                has_ended = await self._placement.store(device_id, change)
            except Refused:  # JetStream fails: the subscription must not stay for ever.
                ttls.renew(subscription, RETRY_EXPIRY_S)
                return
        if has_ended:
            self.former.pop(subscription, None)
            log_lines.requested(logging.INFO, "expired", **subscription.fields)

    def is_entry(self, subscription: SubscriptionKey) -> bool:
        """Whether a subscription is from an entry of a bucket."""
        return self._buckets.key_of(subscription) is not None

    def check_entry(self, key: str, value: bytes) -> Subscription:
        """Returns the subscription of an entry. Raises `Refused`."""
        normalize = self._rules.dialect.normalize
        request, adjustments = self._decoded(value, SubscribeRequest, normalize)
        check_entry(key, request)
        subscription = subscription_of(request, self._rules, adjustments)
        self._log.adjusted(subscription.subscriber, subscription.device, adjustments)
        return subscription

    async def carry_out_entry(self, subscription: Subscription) -> None:
        """Replaces a subscription by the one of its entry. Raises `Refused`."""
        async with self._devices.lock(subscription.device):
            await self._devices.add(subscription)
            self._devices.keep_only(subscription.device, subscription.subscriber, subscription.tags)
        self.former.pop(subscription.key, None)
        self._log.subscribed(subscription)

    async def end_entry(self, subscription: SubscriptionKey) -> None:
        """Ends the subscription of an entry."""
        assert subscription.subscriber is not None
        request = UnsubscribeRequest(subscription.device, subscription.subscriber)
        async with self._devices.lock(subscription.device):
            self._devices.remove(request)
        self.former.pop(subscription, None)
        self._log.unsubscribed(request)

    async def restore(self, request: SubscribeRequest) -> None:
        """Carries out a stored request, unless an entry has replaced it. Raises `Refused`.

        The lock of the device is held.
        """
        owner = SubscriptionKey.of(request)
        if not self.is_entry(owner):
            await self._add_stored(request, is_stored=True)
            ids = {tag.id for tag in request.tags}
            # A part of a stored subscription does not have all of their tags.
            left = [each for each in self.former.pop(owner, ()) if tag_ids([each], {}) - ids]
            if left:
                self.former[owner] = left

    async def _add_stored(
        self, request: SubscribeRequest, *, is_stored: bool = False, renewed: bool = True
    ) -> Subscription:
        """Adds the subscription of a stored request, with the tags that profiles have now.

        Without tags that a profile has gained, if they are refused. Raises `Refused`.
        """
        left, lost = without_lost(request, self._rules)
        if not (left.tags or left.profile):
            left, lost = request, []  # Refused, and so kept: the tags may return.
        more = gained(left, self._rules)
        adjustments = Adjustments()
        try:
            subscription = subscription_of(left, self._rules, adjustments)
            await self._devices.add(subscription, is_stored=is_stored, renewed=renewed)
        except Refused as refused:
            if not (more and left.tags):
                raise
            adjustments = Adjustments()
            subscription = subscription_of(left, self._rules, adjustments, expands=False)
            await self._devices.add(subscription, is_stored=is_stored, renewed=renewed)
            self._log.tags_not_restored(subscription, more, str(refused))
        if lost:
            reason = "their profile does not have them any more"
            self._log.tags_not_restored(subscription, lost, reason)
        if is_stored:  # In a fleet, the node that has received the request has logged it.
            self._log.byte_orders(subscription, adjustments, subscription.tags)
        return subscription

    async def adopt(
        self, device: str, desired: Mapping[str, Sequence[SubscribeRequest]], renewed: set[str]
    ) -> None:
        """Replaces the subscriptions of a device by those that the fleet has stored.

        `desired` has the requests of each subscriber; other subscribers are removed. The `ttl` of
        `renewed` subscribers starts again. Raises `Refused`.
        """
        self._keep_subscribers(device, desired)
        try:
            await self._adopt(device, desired, renewed)
        except Refused:
            if device not in self._registry.devices:
                raise
            # Several subscribers have changed the device together: what one of them has now
            # contradicts what is known here of the next one. So all of them begin anew.
            self._keep_subscribers(device, ())
            await self._adopt(device, desired, desired)

    def _keep_subscribers(self, device: str, subscribers: Collection[str]) -> None:
        """Removes the other subscribers of a device."""
        known = self._registry.devices.get(device)
        for subscriber in [] if known is None else list(known.subscribers):
            if subscriber not in subscribers:
                self._devices.remove(UnsubscribeRequest(device, subscriber))

    async def _adopt(
        self,
        device: str,
        desired: Mapping[str, Sequence[SubscribeRequest]],
        renewed: Collection[str],
    ) -> None:
        for request in map(joined, sorted(desired.values(), key=is_last)):
            subscriber, wanted = request.subscriber_id, _sorted(request)
            present, known = self._carried_out(device, subscriber)
            if known is not None and (wanted == present or (wanted, present) == known.adopted):
                # Adding it again would make the device be scanned, and its values be published.
                if subscriber in renewed:
                    self._devices.ttls.renew(SubscriptionKey.of(request), request.ttl)
                continue
            if known is not None:
                known.profile = request.profile  # It may have ended at another node.
            subscription = await self._add_stored(request, renewed=subscriber in renewed)
            self._devices.keep_only(device, subscriber, subscription.tags)
            present, known = self._carried_out(device, subscriber)
            if known is not None:
                known.adopted = None if present is None or present == wanted else (wanted, present)

    def _carried_out(
        self, device_id: str, subscriber_id: str
    ) -> tuple[SubscribeRequest | None, Subscriber | None]:
        """Returns the request that makes a subscription as it is known here, and its subscriber."""
        device = self._registry.devices.get(device_id)
        known = None if device is None else device.subscribers.get(subscriber_id)
        if device is None or known is None:
            return None, None
        return _sorted(joined([*map(restored, stored_requests(device, subscriber_id))])), known


def _sorted(request: SubscribeRequest) -> SubscribeRequest:
    """Returns a request in a form to compare: nodes of a fleet may have its tags in any order."""
    return msgspec.structs.replace(request, tags=sorted(request.tags, key=lambda tag: tag.id))
