"""Polls and publishes devices, as their subscriptions change."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from dataclasses import dataclass, field
from typing import TYPE_CHECKING
from weakref import WeakValueDictionary

from holdfast.events import log_lines
from holdfast.scanner.errors import Refused
from holdfast.scanner.messages.types import UnsubscribeRequest
from holdfast.scanner.subscriptions.health import Health
from holdfast.scanner.subscriptions.key import SubscriptionKey
from holdfast.scanner.subscriptions.ttl import SubscriptionTtls

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Coroutine
    from typing import Any

    from holdfast.scanner.placement import Placement
    from holdfast.scanner.polling.allowed_devices import AllowedDevices
    from holdfast.scanner.polling.poller import Polling
    from holdfast.scanner.publish.publishers import Publishers
    from holdfast.scanner.subscriptions.device import ScannedDevice
    from holdfast.scanner.subscriptions.registry import Registry
    from holdfast.scanner.subscriptions.subscription import Subscription
    from holdfast.types import PolledBlock

EXTRA_SCAN_ABOVE_MS = 1000
"""At a scan interval of at most this, a new subscriber waits for the next regular scan."""


@dataclass(eq=False)
class Devices:
    """The devices of the registry, from their first subscription to their last."""

    _registry: Registry
    _addresses: AllowedDevices
    _polling: Polling
    _publishers: Publishers
    _placement: Placement
    _begin_task: Callable[[Coroutine[Any, Any, None]], None]
    """Runs a lookup of an address beside the polls."""
    _locks: WeakValueDictionary[str, asyncio.Lock] = field(default_factory=WeakValueDictionary)
    ttls: SubscriptionTtls = field(default_factory=SubscriptionTtls)

    def lock(self, device: str) -> asyncio.Lock:
        """Returns the lock that serializes changes of a device."""
        return self._locks.setdefault(device, asyncio.Lock())

    async def add(
        self,
        subscription: Subscription,
        *,
        is_stored: bool = False,
        renewed: bool = True,
    ) -> Collection[str]:
        """Adds a subscription, and polls and publishes accordingly. Raises `Refused`.

        A subscription that `is_stored` is not stored again. If it is not `renewed`, its time to
        live runs on. Returns the tags that are new to the subscriber.
        """
        known = self._registry.known(subscription)
        # The lookup awaits; from `subscribe` on there is no await until all state is consistent.
        # A known device keeps its address: a lookup could give another one of its name.
        address, endpoint = (
            await self._addresses.find(subscription.source.target)
            if known is None
            else (known.address, known.endpoint)
        )
        change = self._registry.subscribe(subscription, address)
        device = change.device
        if device is None or subscription.subscriber not in device.subscribers:
            return change.new
        # Without `renewed`, only a time that runs runs on, and only if the subscription has one.
        runs = self.ttls.ends(subscription.key)
        if renewed or subscription.ttl is None or not runs:
            self.ttls.renew(subscription.key, subscription.ttl)
        if change.former is not None:
            self._drop(change.former)
        device.endpoint = endpoint
        self._placement.on_subscribed(device, subscription, is_stored=is_stored)
        is_own = self._placement.is_own(device)
        # Where another node polls the device, `begin` makes all of its tags fresh.
        self._publishers.update(device, change.fresh if is_own else ())
        # A caller that subscribes to tags one by one knows the state already.
        if change.former is not None or not change.only_adds_tags:
            self._publishers.publish_state(device)
        hurries = bool(change.fresh) and device.rate > EXTRA_SCAN_ABOVE_MS
        if is_own and (change.polling or change.former or hurries):
            self._polling.renew(device)
        return change.new

    def give_up(self, device_id: str, reason: str) -> None:
        """Publishes that a device is offline whose stored subscription is refused."""
        # A stored id may have characters that break the NATS protocol. The known device may be the
        # same one, for another subscriber, or another one with the same name in subjects.
        if device_id.isprintable() and not self._registry.has_subjects_of(device_id):
            self._publishers.publish_given_up(device_id, reason)

    def keep_only(self, device_id: str, subscriber_id: str, tags: Collection[str]) -> None:
        """Removes the other tags of a subscription."""
        device = self._registry.devices.get(device_id)
        subscriber = None if device is None else device.subscribers.get(subscriber_id)
        others = [] if subscriber is None else [id for id in subscriber.tags if id not in tags]
        if others:
            self.remove(UnsubscribeRequest(device_id, subscriber_id, others))

    def remove(self, request: UnsubscribeRequest) -> None:
        """Removes tags of a subscription, and polls and publishes accordingly."""
        self._placement.on_unsubscribed(request)
        device, changed = self._registry.unsubscribe(request)
        if device is None:
            return
        if request.subscriber_id not in device.subscribers:
            self.ttls.renew(SubscriptionKey.of(request), None)
        if device.subscribers:
            self._publishers.update(device)
            if changed:
                self._poll(device, at_once=False)
        elif changed:  # It was the last subscriber.
            self._drop(device)
            self._placement.on_state_changed(device.id)

    def _poll(self, device: ScannedDevice, *, at_once: bool = True) -> None:
        """Applies changes of a device to the poller, if this scanner polls it."""
        if self._placement.is_own(device):
            self._polling.renew(device, at_once=at_once)

    def _drop(self, device: ScannedDevice) -> None:
        """Removes a device without subscribers."""
        self._publishers.remove(device)
        self._placement.on_dropped(device)
        self._polling.drop(device)

    def begin(self, device: ScannedDevice) -> None:
        """Polls a device that another node has polled until now."""
        device.health = Health()
        self._publishers.restart(device)
        self._publishers.publish_state(device)
        with contextlib.suppress(Refused):  # It is stopping.
            self._poll(device)

    def end(self, device: ScannedDevice) -> None:
        """Polls a device no more: another node will."""
        self._polling.drop(device)
        device.polled_as = ""
        # Shown only if no node reports the device: its last values are out of date then.
        device.health = Health("offline", error="no node reports it")

    def pause(self) -> None:
        """Stops polling all devices until `resume`."""
        self._polling.pause()
        for device in self._registry.devices.values():
            device.health.disable()
            self._publishers.publish_state(device)

    def on_poll(self, device: ScannedDevice, due: float, blocks: list[PolledBlock]) -> None:
        """Publishes the results of a poll."""
        try:
            self._handle_poll(device, due, blocks)
        except Exception:  # An error with one device must not affect the others.
            log_lines.problem("scan_failed", device=device.id)

    def _handle_poll(self, device: ScannedDevice, due: float, blocks: list[PolledBlock]) -> None:
        if not self._placement.is_own(device):
            return  # Another node may have published newer values.
        self._publishers.scans += 1
        health = device.health
        if health.judge(blocks):
            self._publishers.publish_state(device)
            level = logging.WARNING if health.error else logging.INFO
            reason = {} if health.error is None else {"error": health.error}
            log_lines.limited(
                level, f"device_{health.state}", kind=device.id, device=device.id, **reason
            )
        if device.may_have_moved():
            self._begin_task(self._look_up(device))
        device.latest.take(blocks)
        device.latest.forget_except(health.blocks)
        self._publishers.publish_values(device, due, blocks)

    async def _look_up(self, device: ScannedDevice) -> None:
        """Looks up the name of a device that does not respond; its address may have changed."""
        async with self.lock(device.id):
            if self._registry.devices.get(device.id) is not device:
                return
            try:
                target = device.source.target
                address, endpoint = await self._addresses.find(target, after=device.address)
            except Refused as refused:
                log_lines.refused("not_found", kind="name", device=device.id, reason=str(refused))
                return
            if address != device.address:
                device.address, device.endpoint = address, endpoint
                self._polling.renew(device)
                log_lines.write(logging.INFO, "moved", device=device.id, address=str(address))
