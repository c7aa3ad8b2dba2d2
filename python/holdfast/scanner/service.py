"""The scanner service: makes its parts, connects them, and stops them."""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from itertools import chain
from typing import TYPE_CHECKING

from holdfast.events import log_lines
from holdfast.net.nats.connection import NatsConnection
from holdfast.runtime import tasks
from holdfast.scanner.commands import Commands
from holdfast.scanner.dialects import DIALECTS, Dialect
from holdfast.scanner.errors import Refused
from holdfast.scanner.fleet.placement import FleetPlacement
from holdfast.scanner.jetstream.buckets import Buckets, TentacleNextBuckets
from holdfast.scanner.jetstream.entries import is_last, joined, requests, restored
from holdfast.scanner.jetstream.restore import StoredSubscriptions
from holdfast.scanner.messages.types import UnsubscribeRequest
from holdfast.scanner.placement import Placement
from holdfast.scanner.polling import device_tls
from holdfast.scanner.polling.allowed_devices import AllowedDevices
from holdfast.scanner.polling.devices import Devices
from holdfast.scanner.polling.poller import Polling
from holdfast.scanner.presence import Presence
from holdfast.scanner.publish.log_mirror import LogMirror
from holdfast.scanner.publish.publishers import Publishers
from holdfast.scanner.reports.reports import Reports
from holdfast.scanner.requests import Requests
from holdfast.scanner.responder import Responder
from holdfast.scanner.subscriptions.key import SubscriptionKey
from holdfast.scanner.subscriptions.registry import Registry
from holdfast.scanner.subscriptions.request_rules import Rules

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from nats.aio.msg import Msg

    from holdfast._core import Poller
    from holdfast.net.nats.connection import Handler
    from holdfast.net.nats.tolerant_client import SafeClient
    from holdfast.replication.leases.thread import StartThread
    from holdfast.scanner.messages.types import SubscribeRequest, SubscriptionRequest
    from holdfast.scanner.settings import Settings

STOP_STEP_TIMEOUT_S = 2.0
"""Timeout of each step of a stop."""

REQUESTS_TIMEOUT_S = 3.0
"""Timeout at a stop for the last requests to arrive and to be carried out: that of a device, by
default. An appliance waits 5 s for all of the stop."""


class Scanner:
    """One service, from `run` to its end."""

    def __init__(
        self,
        settings: Settings,
        poller: Poller | None = None,
        start_thread: StartThread = threading.Thread.start,
        former: Iterable[SubscriptionRequest] = (),
    ) -> None:
        """Without `poller`, it has a poller of its own. `start_thread` is for leases.

        It begins with the subscriptions of a `former` scanner: its `stored_requests`.
        """
        self._settings = settings
        self.former = former
        """What it begins with, until that is restored."""
        self._ended = asyncio.Event()
        self._ready = asyncio.Event()
        """Set when the stored subscriptions are restored, or can't be."""
        self._has_logged_access = False
        dialect, prefix = DIALECTS[settings.dialect], settings.prefix
        rules = Rules(
            settings.limits, settings.defaults, settings.strict, dialect, settings.profiles
        )
        self._registry = Registry(settings.limits, settings.writes, dialect)
        self._placement = _placement(settings, self._registry, rules, start_thread)
        self._buckets = _buckets(settings)
        self.outbox = self._placement.outbox(lambda: self._publishers.repeat_values())
        self._publishers = Publishers(prefix, dialect, self.outbox, self._placement)
        self._polling = Polling(
            poller,
            self._placement.fence,
            settings.exact_pauses_s or dialect.reconnect_pauses_s,
        )
        self._responder = Responder(
            settings.limits.pending, self.outbox, self._ready.wait, self._buckets.read
        )
        self._allowed = AllowedDevices(settings.allow, settings.device_tls, poller)
        self._devices = Devices(
            self._registry,
            self._allowed,
            self._polling,
            self._publishers,
            self._placement,
            self._responder.begin,
        )
        self._presence = Presence(
            prefix, self._registry, self._buckets, self._placement, self.outbox, self._client
        )
        self._requests = Requests(
            rules,
            self._registry,
            self._devices,
            self._placement,
            self._buckets,
            self._responder,
            self._enable,
        )
        self._commands = Commands(
            settings, dialect, self._registry, self._polling, self._placement, self._responder
        )
        self._reports = Reports(
            settings,
            self._registry,
            self._polling,
            self._publishers,
            self.outbox,
            self._presence,
            self._buckets,
            self._placement,
            self._responder,
        )
        self._broker = NatsConnection(
            settings.servers,
            self._handlers(dialect),
            self._connected,
            settings.ping,
            name="holdfast scan",
            shared=self._placement.shared_subjects,
            queue=self._placement.queue_group,
            until_member=self._ready.wait if self._placement.shared_subjects else None,
            max_pause_s=settings.max_pause_s,
        )

    async def run(self) -> None:
        """Serves until `end` is called, or until a shutdown message.

        Raises `OSError` for a file of the settings that can't be used.
        """
        device_tls.check(self._settings.device_tls)
        self._polling.start(self._devices.on_poll)
        if self._buckets.is_enabled is not None:
            self._polling.pause()  # Until it is known whether devices may be polled.
        # Before requests arrive, which may end what is restored.
        await self._restore_former()
        works = [
            self._buckets.run(self._requests),  # First: it may pause polling.
            self._broker.run(),
            self.outbox.run(),
            self._presence.run(),
            self._devices.ttls.run(self._requests.expire),
            self._commands.lateness.run(lambda: self._broker.client),
            self._placement.run(self._devices, self._requests, self._ready),
            self._ended.wait(),
        ]
        running: list[asyncio.Task[object]] = [asyncio.create_task(work) for work in works]
        log_mirror = LogMirror(self._settings.prefix, self._publish_log)
        if self._settings.publish_logs:
            log_lines.LOGGER.addHandler(log_mirror)
        try:
            done, _ = await asyncio.wait(running, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()  # Raises the error with which a part has ended, if it has.
        finally:
            await self._stop(running)
            log_lines.LOGGER.removeHandler(log_mirror)

    async def _restore_former(self) -> None:
        former, self.former = self.former, ()
        if self._settings.fleet is not None:
            return  # A fleet has stored all of them.
        removals: list[UnsubscribeRequest] = []
        added: list[SubscribeRequest] = []
        for request in former:
            if isinstance(request, UnsubscribeRequest):
                removals.append(request)
            else:
                added.append(request)
        wholes = sorted(added, key=lambda whole: is_last([whole]))
        outcomes = await asyncio.gather(*map(self._restore, wholes))
        refused = [whole for whole, ok in zip(wholes, outcomes, strict=True) if not ok]
        # Before the refused requests, which replace what is stored.
        for removal in removals:
            self._placement.on_unsubscribed(removal)
        for whole in refused:
            # The subscriber of one with a `ttl` repeats it.
            if self._placement.take_over_refused(whole) or whole.ttl is None:
                owner = SubscriptionKey.of(whole)
                self._requests.former.setdefault(owner, []).append(whole)

    async def _restore(self, request: SubscribeRequest) -> bool:
        """Carries out a request of a former scanner. Returns whether it was accepted."""
        owner = SubscriptionKey.of(request)
        try:
            async with self._devices.lock(request.device_id):
                await self._requests.restore(request)
        except Refused as refused:
            log_lines.write(logging.WARNING, "not_restored", **owner.fields, reason=str(refused))
            self._devices.give_up(request.device_id, str(refused))
            return False
        log_lines.write(logging.INFO, "restored", **owner.fields, tags=len(request.tags))
        return True

    def stored_requests(self) -> Iterator[SubscriptionRequest]:
        """Yields requests that make the subscriptions, except those from entries of a bucket.

        One for each subscription, and one for each that is refused and may be accepted later.
        Requests before them remove what is stored and out of date.
        """
        yield from self.former
        known = [
            (owner, device)
            for device in self._registry.devices.values()
            for owner in (SubscriptionKey(device.id, name) for name in device.subscribers)
            if not self._requests.is_entry(owner)
        ]
        yield from self._placement.removals(owner for owner, _ in known)
        for owner, device in known:
            assert owner.subscriber is not None
            whole = joined([*map(restored, requests(device, owner.subscriber))])
            yield self._placement.handed_over(whole)
        # Last: a refused one must not displace one that is carried out.
        yield from chain.from_iterable(self._requests.former.values())

    @property
    def serves(self) -> bool:
        """Whether requests currently reach the service."""
        return self._broker.serves

    @property
    def devices(self) -> int:
        """The number of polled devices."""
        return 0 if self._ended.is_set() else len(self._registry.devices)

    def end(self) -> None:
        """Ends the service."""
        self._ended.set()

    def _client(self) -> SafeClient | None:
        return self._broker.client

    def _connected(self, client: SafeClient | None) -> None:
        """Handles a new or lost connection."""
        self.outbox.connected(client)
        self._placement.connected(client)
        self._devices.ttls.connected(client is not None)
        self._buckets.connected(client)
        self._presence.beat_soon()
        if client is None:
            return
        if not self._has_logged_access:
            self._has_logged_access = True
            log_lines.write(logging.INFO, "write_access", **self._settings.write_access)
        # What was sent just before the connection was lost may not have arrived.
        for device in self._registry.devices.values():
            self._publishers.repeat(device)

    def _enable(self, is_enabled: bool) -> None:
        """Begins or stops polling when the `enabled` key changes."""
        if is_enabled:
            self._polling.resume()
        else:
            self._devices.pause()
        self._presence.beat_soon()

    def _publish_log(self, key: object, text: bytes) -> None:
        if self._broker.client is not None:
            self.outbox.put([(key, text)])

    def _handlers(self, dialect: Dialect) -> dict[str, Handler]:
        prefix, answering = self._settings.prefix, self._responder.answering
        reports = self._placement.reports(self._reports)

        async def shutdown(message: Msg) -> None:
            if self._placement.is_addressed(message.data):
                log_lines.write(logging.INFO, "shutdown_asked")
                self.end()

        # First those without replies: a caller that gets a reply counts on all subjects, and a
        # message to one that is not subscribed to yet is lost without an error.
        handlers = {
            f"{prefix}.shutdown": shutdown,
            f"{prefix}.scanner": self._presence.announced,
            f"{prefix}.subscribe": answering("subscribe", self._requests.subscribe),
            f"{prefix}.unsubscribe": answering("unsubscribe", self._requests.unsubscribe),
        }
        for each in dialect.command_subjects:
            handlers[f"{prefix}.{each}"] = answering("command", self._commands.command)
        handlers |= {
            f"{prefix}.browse": answering("browse", reports.browse),
            f"{prefix}.variables": answering("variables", reports.variables),
        }
        more = self._placement.handlers(self._commands, self._reports, self._responder, self.end)
        return {**handlers, **more}

    async def _stop(self, running: Sequence[asyncio.Task[object]]) -> None:
        """Stops all parts, each with a timeout."""
        # First nothing new may begin; then other nodes take over while this one still polls.
        self._buckets.connected(None)
        began = time.monotonic()
        await tasks.within(STOP_STEP_TIMEOUT_S, self._broker.drain())
        left_s = max(0.0, began + REQUESTS_TIMEOUT_S - time.monotonic())
        await self._placement.leave()
        await self._responder.finish(left_s)
        await tasks.within(STOP_STEP_TIMEOUT_S, self._polling.stop())
        await tasks.within(STOP_STEP_TIMEOUT_S, self._responder.end())
        await tasks.within(STOP_STEP_TIMEOUT_S, self._publish_end())
        await tasks.within(STOP_STEP_TIMEOUT_S, tasks.end(running))

    async def _publish_end(self) -> None:
        """Deletes heartbeat and states, and waits until all messages are sent."""
        await self._placement.close()
        await self._presence.stop()
        await self.outbox.flush()


def _placement(
    settings: Settings, registry: Registry, rules: Rules, start_thread: StartThread
) -> Placement:
    if settings.fleet is not None:
        return FleetPlacement(settings, settings.fleet, registry, start_thread)
    if settings.keep_subscriptions:
        return StoredSubscriptions(settings.prefix, registry, rules)
    return Placement()


def _buckets(settings: Settings) -> Buckets:
    if settings.dialect == "tentacle-next":
        return TentacleNextBuckets(settings.prefix, settings.watch_times)
    return Buckets()
