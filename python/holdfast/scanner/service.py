"""The scanner service: connects all parts, and handles requests.

The registry holds the subscriptions. Every change of it is passed to the poller and the publishers.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
import time
from collections.abc import (
    AsyncIterator,
    Awaitable,
    Callable,
    Collection,
    Coroutine,
    Iterable,
    Mapping,
    Sequence,
)
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias
from weakref import WeakValueDictionary

import msgspec

from holdfast import _core, logs, tasks
from holdfast.config.scanning import written_pollable
from holdfast.net.tls import NO_FILES, Tls
from holdfast.scanner import (
    browsing,
    commands,
    device_tls,
    kept_entries,
    tentacle,
    tentacle_next,
    wire,
    write_access,
)
from holdfast.scanner.adjusting import Adjustments, adjusted
from holdfast.scanner.broker import MAX_PAUSE, Broker, Ping, Servers
from holdfast.scanner.browsing import browsed
from holdfast.scanner.configured import Configured
from holdfast.scanner.enabling import Enabling
from holdfast.scanner.errors import Moved, Refused
from holdfast.scanner.expiring import Expiring
from holdfast.scanner.fleet.exchange import About, Command, Executed, subject
from holdfast.scanner.fleet.part import FleetPart
from holdfast.scanner.fleet.terms import PROTOCOL, FleetSettings, Terms
from holdfast.scanner.groups import grouped
from holdfast.scanner.health import Health
from holdfast.scanner.heartbeat import EVERY, Heart
from holdfast.scanner.hosts import Allowed
from holdfast.scanner.kept import Kept
from holdfast.scanner.lateness import Lateness
from holdfast.scanner.limits import ScannerLimits
from holdfast.scanner.messages import (
    Announcement,
    Answer,
    BrowseRequest,
    DeviceReport,
    EntryReport,
    FleetReport,
    HeartbeatMetadata,
    ServiceReport,
    Status,
    SubscribeRequest,
    UnsubscribeRequest,
    VariablesRequest,
    decode,
)
from holdfast.scanner.outbox import Outbox
from holdfast.scanner.polling import Polling
from holdfast.scanner.published_log import PublishedLog
from holdfast.scanner.publishing import Publisher
from holdfast.scanner.registry import Registry, understood
from holdfast.scanner.rivals import Rivals
from holdfast.scanner.rules import Defaults, Rules
from holdfast.scanner.variables import of_device, variables
from holdfast.scanner.watching import WATCH_TIMES, WatchTimes
from holdfast.standstill import LONG

if TYPE_CHECKING:
    from nats.aio.client import Client
    from nats.aio.msg import Msg

    from holdfast._core import Endpoint, Poller
    from holdfast.client.url import Target
    from holdfast.config.scanning import Dialect, Writes
    from holdfast.leases import StartThread
    from holdfast.net.allow_list import AllowEntry
    from holdfast.scanner.adjusting import Asked
    from holdfast.scanner.devices import ScannedDevice
    from holdfast.scanner.fleet.wants import Want
    from holdfast.scanner.keeping import Unit
    from holdfast.scanner.messages import BrowseAnswer
    from holdfast.scanner.receiving import SafeClient
    from holdfast.scanner.registry import Subscription
    from holdfast.tags import TagList
    from holdfast.types import PolledBlock

Handle: TypeAlias = "Callable[[Msg], Awaitable[Answer | BrowseAnswer | bytes]]"
"""Carries out a message. Returns the answer, or its JSON."""

LARGE = 16 * 1024
"""Size in bytes of a request that takes milliseconds to parse."""

SOON = 1000
"""Scan interval in milliseconds up to which a new subscriber waits for the next regular scan."""

MAX_PAYLOAD = 2**20
"""The size limit of messages in bytes, before a NATS server tells its own."""

MAX_ADJUSTED = 10_000
"""Limit of remembered subscribers whose requests were adjusted."""

MAX_REFUSED_SHOWN = 100
"""Limit of refused entries in the answer to `browse`."""

ENDING = 2.0
"""Timeout in seconds of each step of a stop."""

COUNTED = 10.0
"""Seconds between two counts of missed scans for other nodes: many devices take milliseconds."""

LEAVING = 10.0
"""Timeout in seconds of handing devices over to other nodes of a fleet."""

BROWSED = 100
"""Devices that other nodes are asked for at once."""

ENVELOPE = 512
"""Bytes of an answer of a fleet without devices."""


@dataclass(frozen=True)
class Settings:
    """The settings of a scanner."""

    servers: Servers = field(default_factory=Servers)
    prefix: str = "modbus"
    """The first part of all subjects, and the id of the module in messages."""
    allow: tuple[AllowEntry, ...] = ()
    """Networks and serial devices, see `Allowed`."""
    limits: ScannerLimits = field(default_factory=ScannerLimits)
    device_tls: Tls = NO_FILES
    """The TLS files for connections to devices."""
    defaults: Defaults = field(default_factory=Defaults)
    """What subscribe requests leave out."""
    writes: Writes = "tags"
    """Which tags callers may write."""
    strict: bool = False
    """Whether requests are refused that would otherwise be adjusted."""
    ping: Ping = field(default_factory=Ping)
    """How a NATS server that does not answer is detected."""
    max_pause_s: float = MAX_PAUSE
    """Between attempts to connect to NATS."""
    publish_logs: bool = True
    """Whether the log is also published."""
    keep_subscriptions: bool = True
    """Whether subscriptions and states are kept in JetStream."""
    dialect: Dialect = "tentacle"
    """The programs that it serves."""
    profiles: Mapping[str, TagList] = field(default_factory=dict)
    """The tags that requests can name by their profile."""
    fleet: FleetSettings | None = None
    """The fleet of scanners that it is a node of."""
    exact_pauses_s: tuple[float, float] = tentacle.PAUSES_S
    """The first and the longest pause after failures of a device; only with dialect `tentacle`."""
    watch_times: WatchTimes = WATCH_TIMES
    """Those of the buckets of tentacle-next."""
    standstill_s: float = LONG
    """The shortest time without the event loop after which commands that waited are refused."""

    @property
    def write_access(self) -> dict[str, str]:
        """What may be written, where, by whom, and what narrows it, in words."""
        return write_access.described(self.writes, self.allow, self.prefix, self.dialect)


class Scanner:
    """One service, from `run` to its end."""

    def __init__(
        self,
        settings: Settings,
        poller: Poller | None = None,
        start_thread: StartThread = threading.Thread.start,
    ) -> None:
        """Without `poller`, it has a poller of its own. `start_thread` is for leases."""
        self._poller = poller
        self._settings = settings
        self._allowed = Allowed(settings.allow)
        self._ended = asyncio.Event()
        self._tasks: set[asyncio.Task[None]] = set()
        self._one_by_one = asyncio.Lock()
        """Held while a request is parsed and checked."""
        self._turns: WeakValueDictionary[str, asyncio.Lock] = WeakValueDictionary()
        self._rules = Rules(
            settings.limits,
            settings.defaults,
            settings.strict,
            settings.dialect,
            settings.profiles,
        )
        self._registry = Registry(settings.limits, settings.writes, settings.dialect)
        self._adjusted: set[tuple[str, str]] = set()
        """The subscribers, and the kinds of adjustments, that are already logged."""
        self._publishers: dict[str, Publisher] = {}
        self._heart = Heart(settings.prefix, self._metadata, self._rival)
        self._rivals = Rivals(self._heart.started)
        self._scans = 0
        """Polls that were published."""
        self._counted = (-COUNTED, 0)
        """When missed scans were counted, and how many there were."""
        self._part: FleetPart | None = None
        if settings.fleet is not None:
            self._part = FleetPart(
                settings.fleet,
                _terms(settings, settings.fleet),
                settings.prefix,
                _Host(self),
                self._about,
                self._connect_leases,
                start_thread,
            )
        part = self._part
        self.outbox = (
            Outbox()
            if part is None
            else Outbox(
                may_send=lambda: not part.is_joined or part.fleet.may_publish,
                lost=self._publish_again,
                at_once=True,
            )
        )
        self._expiring = Expiring()
        self._lateness = Lateness(settings.standstill_s)
        self._configured: Configured | None = None
        self._enabling: Enabling | None = None
        if self._is_next:
            self._configured = Configured(
                settings.prefix,
                self._understand,
                self._carry_out,
                self._end_configured,
                settings.watch_times,
            )
            self._enabling = Enabling(settings.prefix, self._enable, settings.watch_times)
        self._kept = Kept(
            settings.prefix,
            self._registry,
            self._restore_request,
            lambda unit: self._key_of(unit.device, unit.subscriber) is not None,
        )
        self._ready = asyncio.Event()
        """Set when the kept subscriptions are restored, or can't be."""
        self._broker = Broker(
            settings.servers,
            self._handlers(),
            self._connected,
            settings.ping,
            shared=[] if part is None else self._shared(),
            queue="" if settings.fleet is None else f"holdfast-{settings.fleet.name}",
            max_pause_s=settings.max_pause_s,
        )
        self._has_logged_access = False
        self._due = asyncio.Event()
        """Set when the next heartbeat is due immediately."""

    async def run(self) -> None:
        """Serves until `end` is called, or until a shutdown message.

        Raises `OSError` for a file of the settings that can't be used.
        """
        device_tls.check(self._settings.device_tls)
        pauses = None if self._is_next else self._settings.exact_pauses_s
        self._polling = Polling(self._take, self._poller, self._fence, pauses)
        works = [self._broker.run(), self.outbox.run(), self._beat(), self._ended.wait()]
        works.append(self._expiring.run(self._expire))
        works.append(self._lateness.run(lambda: self._broker.client))
        if self._part is not None:
            works.append(self._part.run(self._ready))
        elif self._settings.keep_subscriptions:
            works += [self._kept.keeper.run(), self._kept.restore(self._ready)]
        else:
            self._ready.set()
        if self._configured is not None and self._enabling is not None:
            self._polling.pause()  # Until it is known that the scanner is enabled.
            works += [self._configured.run(), self._enabling.run()]
        running: list[asyncio.Task[object]] = [asyncio.create_task(work) for work in works]
        published_log = PublishedLog(self._settings.prefix, self._publish_log)
        if self._settings.publish_logs:
            logs.LOGGER.addHandler(published_log)
        try:
            done, _ = await asyncio.wait(running, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        finally:
            await self._stop(running)
            logs.LOGGER.removeHandler(published_log)

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

    def _connected(self, client: SafeClient | None) -> None:
        """Handles a new or lost connection.

        Messages that were sent before a disconnect may be lost, so a new connection publishes all
        values and states again.
        """
        self.outbox.connected(client)
        if self._part is None:
            self._kept.keeper.connected(client)
        else:
            self._part.connected(client)
        self._expiring.connected(client is not None)
        for part in (self._enabling, self._configured):
            if part is not None:
                part.connected(client)
        self._due.set()
        if client is not None:
            if not self._has_logged_access:
                self._has_logged_access = True
                logs.write(logging.INFO, "write_access", **self._settings.write_access)
            for device in self._registry.devices.values():
                self._publishers[device.id].renew(self._lease(device))
                self._publish_state(device)

    def _publish_again(self) -> None:
        """Publishes the next value of every tag, even if it is unchanged."""
        for publisher in self._publishers.values():
            publisher.renew()

    def _handlers(self) -> dict[str, Callable[[Msg], Awaitable[None]]]:
        prefix = self._settings.prefix

        async def shutdown(message: Msg) -> None:
            if not self._is_meant(message.data):
                return
            logs.write(logging.INFO, "shutdown_asked")
            self.end()

        # Who gets an answer may send anything: what is not answered is subscribed to before.
        handlers = {
            f"{prefix}.shutdown": shutdown,
            f"{prefix}.scanner": self._announced,
            f"{prefix}.subscribe": self._answering("subscribe", self._subscribe),
            f"{prefix}.unsubscribe": self._answering("unsubscribe", self._unsubscribe),
            f"{prefix}.command.>": self._answering("command", self._command),
            f"{prefix}.browse": self._answering("browse", self._browse),
            f"{prefix}.variables": self._answering("variables", self._variables),
        }
        if self._is_next:  # Its PLC library sends commands here.
            handlers[f"{prefix}.module.command.>"] = handlers[f"{prefix}.command.>"]
        if self._part is not None:
            for what, handle in (
                ("command", self._forwarded),
                ("browse", self._browse_own),
                ("variables", self._variables_own),
            ):
                fleet = self._part.fleet
                where = subject(prefix, fleet.node, what, fleet.leases.process)
                handlers[where] = self._answering(what, handle)
            handlers[subject(prefix, self._part.fleet.node, "drain")] = self._drain
        return handlers

    def _shared(self) -> list[str]:
        """The subjects that any node of the fleet answers."""
        names = ("subscribe", "unsubscribe", "command.>", "browse", "variables")
        return [f"{self._settings.prefix}.{name}" for name in names]

    def _is_meant(self, payload: bytes) -> bool:
        """Whether a shutdown message is for this scanner: for all of a fleet, or for one node."""
        if self._part is None or not payload.strip():
            return True
        try:
            node = msgspec.json.decode(payload, type=dict[str, str]).get("node")
        except msgspec.DecodeError as error:
            logs.refused("message_malformed", kind="shutdown", reason=str(error))
            return False
        return node in (None, self._part.fleet.node)

    async def _drain(self, message: Msg) -> None:
        """Hands all devices over to the other nodes, and ends."""
        logs.write(logging.INFO, "shutdown_asked")
        if message.reply:
            done = wire.text(message.reply, msgspec.json.encode(Answer(success=True)))
            await self.outbox.answer(message.reply, done)
        self.end()

    async def _connect_leases(self, connected: Callable[[Client | None], None]) -> None:
        """Keeps a connection that only the leases of a fleet use."""
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

    def _fence(self, device: ScannedDevice) -> _core.Fence | None:
        return None if self._part is None else self._part.fence(device)

    def _is_own(self, device: ScannedDevice) -> bool:
        """Whether this scanner polls a device, and tells what it has."""
        return self._part is None or self._part.is_own(device)

    def _about(self) -> dict[str, Any]:
        """What other nodes are shown of this one."""
        assert self._part is not None, "it is a node"
        own = list(self._part.own)
        now = time.monotonic()
        if now - self._counted[0] > COUNTED:
            missed = sum(each["missed"] for each in self._polling.counters().values())
            self._counted = now, missed
        return {
            "version": _core.__version__,
            "devices": len(own),
            "tags": sum(len(device.tags) for device in own),
            "scans": self._scans,
            "missed": self._counted[1],
            "lost": self._polling.dropped,
            "published": self.outbox.sent,
        }

    @property
    def _is_next(self) -> bool:
        return self._settings.dialect == "tentacle-next"

    @property
    def _is_enabled(self) -> bool:
        return self._enabling is None or self._enabling.enabled

    def _key_of(self, device: str, subscriber: str | None) -> str | None:
        """Returns the key of the entry that a subscription is from; `None` if it is from none."""
        return None if self._configured is None else self._configured.key_of(device, subscriber)

    async def _announced(self, message: Msg) -> None:
        """Handles the announcement of another scanner, or of this one."""
        with contextlib.suppress(msgspec.DecodeError):
            other = msgspec.json.decode(message.data, type=Announcement)
            if self._part is None or other.fleet != self._part.fleet.settings.name:
                self._rival(other.started_at)

    def _rival(self, started: int) -> None:
        if self._rivals.seen(started):
            self._announce()

    def _announce(self) -> None:
        subject = f"{self._settings.prefix}.scanner"
        fleet = None if self._part is None else self._part.fleet.settings.name
        text = wire.message(subject, Announcement(started_at=self._heart.started, fleet=fleet))
        if self._broker.client is not None:
            self.outbox.put([((subject,), text)])

    def _publish_log(self, key: object, text: bytes) -> None:
        if self._broker.client is not None:
            self.outbox.put([(key, text)])

    def _metadata(self) -> HeartbeatMetadata:
        return HeartbeatMetadata(
            device_count=len(self._registry.devices),
            tag_count=self._registry.tags,
            version=_core.__version__,
            enabled=self._is_enabled if self._is_next else None,
        )

    def _answering(self, kind: str, handle: Handle) -> Callable[[Msg], Awaitable[None]]:
        """Returns a handler that carries out messages concurrently and answers them."""

        async def carry_out(message: Msg) -> None:
            answer: Answer | BrowseAnswer | bytes
            most = self._settings.limits.pending
            try:
                if len(self._tasks) > most:
                    raise Refused(f"too many requests: {most} are pending, which is the limit")
                await self._ready.wait()
                for part in (self._enabling, self._configured):
                    if part is not None:
                        await part.read()
                answer = await handle(message)
            except Refused as refused:
                logs.refused(
                    "request_refused", kind=kind, subject=message.subject, reason=str(refused)
                )
                answer = Answer(success=False, error=str(refused))
            except Exception as error:  # An error in one request must not stop the service.
                logs.problem("request_failed", subject=message.subject)
                answer = Answer(success=False, error=f"internal error: {type(error).__name__}")
            if message.reply:
                subject = message.reply
                payload = answer if isinstance(answer, bytes) else msgspec.json.encode(answer)
                await self.outbox.answer(subject, wire.text(subject, payload))

        async def begin(message: Msg) -> None:
            self._begin(carry_out(message))

        return begin

    def _begin(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _subscribe(self, message: Msg) -> Answer:
        async with self._in_order(message):
            changes = Adjustments()
            request = self._decoded(message.data, SubscribeRequest, changes)
            asked = understood(request, self._rules, changes)
            self._check_not_configured(asked.device, asked.subscriber)
        async with self._turn(asked.device):
            fresh = self._registry.fresh(asked)
            if self._part is not None:
                change = partial(self._add, asked, kept=True)
                await self._part.store(asked.device, change, asked.subscriber)
            else:
                await self._add(asked)
            if self._is_next:
                self._remove_others(asked)
        await self._kept.settled(asked.device, asked.subscriber)
        self._log_adjustments(asked.subscriber, asked.device, changes)
        self._log_warnings(asked, changes, fresh)
        self._log_subscribed(asked)
        own = len(request.tags)
        return Answer(success=True, count=own if request.profile is None else len(asked.tags))

    @staticmethod
    def _log_subscribed(asked: Subscription) -> None:
        logs.write(
            logging.INFO,
            "subscribed",
            device=asked.device,
            subscriber=asked.subscriber,
            tags=len(asked.tags),
            scan_rate=asked.rate,
        )

    def _check_not_configured(self, device: str, subscriber: str) -> None:
        """Raises `Refused` for a subscription that is from an entry of the bucket."""
        key = self._key_of(device, subscriber)
        if key is not None and self._configured is not None:
            raise Refused(
                f"the subscription of {subscriber!r} to {device!r} is the entry {key!r} of the "
                f"bucket {self._configured.bucket}: change that entry"
            )

    def _understand(self, key: str, value: bytes) -> Subscription:
        """Checks the key and the value of an entry. Raises `Refused`."""
        changes = Adjustments()
        request = self._decoded(value, SubscribeRequest, changes)
        tentacle_next.check_entry(key, request)
        asked = understood(request, self._rules, changes)
        self._log_adjustments(asked.subscriber, asked.device, changes)
        return asked

    async def _carry_out(self, asked: Subscription) -> None:
        """Carries out an entry: the whole subscription of a subscriber. Raises `Refused`."""
        async with self._turn(asked.device):
            await self._add(asked)
            self._remove_others(asked)
        self._log_subscribed(asked)

    def _remove_others(self, asked: Subscription) -> None:
        """Removes the tags of a subscription that a request does not have."""
        device = self._registry.devices.get(asked.device)
        subscriber = None if device is None else device.subscribers.get(asked.subscriber)
        others = (
            [] if subscriber is None else [id for id in subscriber.tags if id not in asked.tags]
        )
        if others:
            self._remove(UnsubscribeRequest(asked.device, asked.subscriber, others))

    async def _end_configured(self, unit: Unit) -> None:
        """Ends the subscription of an entry."""
        assert unit.subscriber is not None
        async with self._turn(unit.device):
            self._remove(UnsubscribeRequest(unit.device, unit.subscriber))
        logs.write(
            logging.INFO,
            "unsubscribed",
            device=unit.device,
            subscriber=unit.subscriber,
            tags="all",
        )

    def _enable(self, enabled: bool) -> None:
        """Begins or stops polling, as the bucket `service_enabled` has it."""
        if enabled:
            self._polling.resume()
        else:
            self._polling.pause()
            for device in self._registry.devices.values():
                device.health.disable()
                self._publish_state(device)
        self._due.set()

    async def _restore_request(self, request: SubscribeRequest) -> None:
        """Carries out a kept request, unless an entry has replaced it. Raises `Refused`."""
        if self._key_of(request.device_id, request.subscriber_id) is not None:
            return
        changes = Adjustments()
        asked = understood(request, self._rules, changes)
        async with self._turn(asked.device):
            await self._add(asked, kept=True)
        self._log_warnings(asked, changes, asked.tags)

    async def _add(self, asked: Subscription, *, kept: bool = False, renewed: bool = True) -> None:
        """Adds a subscription, and polls and publishes accordingly. Raises `Refused`.

        A subscription that is already `kept` is not stored again. If it is not `renewed`, its time
        runs on.
        """
        address, endpoint = await self._place(asked)
        known = self._registry.devices.get(asked.device)
        is_extended = known is not None and known.is_extended_by(asked.subscriber, asked.tags)
        fresh = self._registry.fresh(asked)
        change = self._registry.subscribe(asked, address)
        device = change.device
        if device is None or asked.subscriber not in device.subscribers:
            return
        if renewed:
            self._expiring.renew(device.id, asked.subscriber, asked.ttl)
        if change.former is not None:
            self._drop(change.former)
        device.endpoint = endpoint
        if change.former is not None or self._is_next or asked.publish == "scan":
            fresh = asked.tags
        self._begin_publishing(device, fresh)
        if not kept:
            self._kept.changed(device.id, asked.subscriber)
        if change.former is not None or not is_extended:
            self._publish_state(device)
        if change.polling or change.former or (fresh and device.rate > SOON):
            self._poll(device)

    def _poll(self, device: ScannedDevice, *, at_once: bool = True) -> None:
        """Polls a device as it is now, if this scanner polls it."""
        if self._is_own(device):
            self._polling.renew(device, at_once=at_once)

    def _decoded(self, data: bytes, kind: type[Asked], changes: Adjustments) -> Asked:
        most = self._settings.limits.request
        if self._is_next and kind is SubscribeRequest:
            data = tentacle_next.request(data, most)
        if self._settings.strict:
            return decode(data, kind, most)
        return adjusted(data, kind, most, changes)

    def _log_adjustments(self, subscriber: str, device: str, changes: Adjustments) -> None:
        """Logs what was changed in a request: once for each subscriber and kind."""
        for kind, what in changes:
            if (subscriber, kind) in self._adjusted:
                continue
            if len(self._adjusted) >= MAX_ADJUSTED:
                self._adjusted.clear()
            self._adjusted.add((subscriber, kind))
            logs.write(logging.WARNING, kind, subscriber=subscriber, device=device, found=what)

    @staticmethod
    def _log_warnings(asked: Subscription, changes: Adjustments, fresh: Collection[str]) -> None:
        """Logs what callers must know of the tags that they had not subscribed to before."""
        about = {"subscriber": asked.subscriber, "device": asked.device}
        for tag, note in changes.warnings:
            if tag in fresh:
                logs.write(logging.WARNING, "byte_order_differs", **about, tag=tag, note=note)

    def _begin_publishing(self, device: ScannedDevice, fresh: Collection[str]) -> None:
        """Publishes a device as it is now, and the next value of `fresh` tags in any case."""
        if self._part is not None:
            self._part.added(device)
        publisher = self._publishers.get(device.id)
        if publisher is None:
            publisher = self._publishers[device.id] = self._publisher(device)
        # Where a device is only known, `begin` makes all of its tags new.
        publisher.want(lambda: grouped(device), fresh if self._is_own(device) else ())

    def _publisher(self, device: ScannedDevice) -> Publisher:
        settings, lease = self._settings, self._lease(device)
        return Publisher(settings.prefix, device.id, settings.dialect, lease)

    def _lease(self, device: ScannedDevice) -> int | None:
        """Returns the number that messages about a device have in a fleet."""
        return None if self._part is None else self._part.fleet.epoch(device.partition)

    async def _place(self, asked: Subscription) -> tuple[Target, Endpoint | None]:
        """Returns the address of a device: the known one, or the result of a lookup."""
        device = self._registry.known(asked)
        if device is None:
            address = await self._allowed.address(asked.source.target)
            return address, self._endpoint(asked.source.target, address)
        return device.address, device.endpoint

    def _endpoint(self, target: Target, address: Target) -> Endpoint:
        """Returns the endpoint of an allowed address.

        It is that of the target itself, if the appliance uses the device by this name: a device may
        accept no second connection. Raises `Refused`.
        """
        tls = self._settings.device_tls
        if self._poller is not None and target != address:
            by_name = device_tls.endpoint_of(target, tls)
            if self._poller.known_link(str(target), by_name) is not None:
                return by_name
        return device_tls.endpoint_of(address, tls)

    async def _unsubscribe(self, message: Msg) -> Answer:
        async with self._in_order(message):
            changes = Adjustments()
            request = self._decoded(message.data, UnsubscribeRequest, changes)
            if not self._is_next:
                tentacle.check_unsubscribe(request)
            self._check_not_configured(request.device_id, request.subscriber_id)
        async with self._turn(request.device_id):
            await self._remove_wanted(request)
        await self._kept.settled(request.device_id, request.subscriber_id)
        self._log_adjustments(request.subscriber_id, request.device_id, changes)
        logs.write(
            logging.INFO,
            "unsubscribed",
            device=request.device_id,
            subscriber=request.subscriber_id,
            tags="all" if request.ids is None else len(request.ids),
        )
        return Answer(success=True)

    async def _remove_wanted(self, request: UnsubscribeRequest) -> None:
        """Removes tags of a subscription, also from what a fleet wants. Raises `Refused`."""

        async def change() -> None:
            self._remove(request)

        if self._part is None:
            self._remove(request)
        else:
            await self._part.store(request.device_id, change)

    def _remove(self, request: UnsubscribeRequest) -> None:
        """Removes tags of a subscription, and polls and publishes accordingly."""
        if self._part is None:
            self._kept.unsubscribed(request)
        device, changed = self._registry.unsubscribe(request)
        if device is None:
            return
        if request.subscriber_id not in device.subscribers:
            self._expiring.renew(device.id, request.subscriber_id, None)
        if device.subscribers:
            self._publishers[device.id].want(lambda: grouped(device))
            if changed:
                self._poll(device, at_once=False)
        elif changed:
            self._drop(device)
            self._kept.state_changed(device.id)

    async def _expire(self, unit: Unit) -> None:
        """Ends a subscription that was not renewed within its `ttl`."""
        assert unit.subscriber is not None
        async with self._turn(unit.device):
            if not self._expiring.is_due(unit):  # It was renewed while this waited.
                return
            device = self._registry.devices.get(unit.device)
            ttl = None
            if device is not None and not self._is_own(device):
                # The node that polls the device ends it. If it does not, this one looks again.
                subscriber = device.subscribers.get(unit.subscriber)
                ttl = None if subscriber is None else subscriber.ttl
            self._expiring.renew(unit.device, unit.subscriber, ttl)
            if ttl is not None:
                return
            try:
                await self._remove_wanted(UnsubscribeRequest(unit.device, unit.subscriber))
            except Refused:
                self._expiring.renew(unit.device, unit.subscriber, 1)
                return
        logs.write(logging.INFO, "expired", device=unit.device, subscriber=unit.subscriber)

    @contextlib.asynccontextmanager
    async def _in_order(self, message: Msg, *, is_large: bool = False) -> AsyncIterator[None]:
        """Serializes requests. Lets polls run before a request that takes milliseconds."""
        async with self._one_by_one:
            if is_large or len(message.data) > LARGE:
                await asyncio.sleep(0)
            yield

    def _drop(self, device: ScannedDevice) -> None:
        """Removes a device without subscribers."""
        del self._publishers[device.id]
        if self._part is not None:
            self._part.dropped(device)
        if device.polled_as:
            self._polling.drop(device)

    def _turn(self, device: str) -> asyncio.Lock:
        """Returns the lock that serializes requests for one device."""
        return self._turns.setdefault(device, asyncio.Lock())

    async def _command(self, message: Msg) -> Answer:
        name = message.subject.removeprefix(f"{self._settings.prefix}.")
        name = name.removeprefix("module.").removeprefix("command.")
        most = self._settings.limits.command
        if len(message.data) > most:
            raise Refused(f"the value has {len(message.data)} bytes, allowed: {most}")
        try:
            text = message.data.decode()
        except UnicodeDecodeError:
            raise Refused("the value is not UTF-8 text") from None
        if self._is_next:
            text = tentacle_next.command(message.data)
        async with self._in_order(message):
            device, tag = self._registry.commanded(name)
        check = partial(self._lateness.check, message)
        if self._part is None:
            await commands.write(self._polling, device, tag, text, check)
        else:
            own = partial(self._write, device.id, tag.id, text, check)
            await self._part.command(device, tag.id, text, own, check)
        return Answer(success=True)

    async def _write(
        self, device_id: str, tag_id: str, text: str, check: Callable[[], float]
    ) -> bool:
        """Writes to a device that this node polls. Returns whether it does. Raises `Refused`."""
        device = self._registry.devices.get(device_id)
        if device is None or tag_id not in device.tags:
            raise Refused(f"no tag {tag_id!r} of {device_id}")
        if not self._is_own(device) or not device.polled_as:
            return False
        try:
            await commands.write(self._polling, device, device.tags[tag_id], text, check)
        except Moved:
            return False
        return True

    async def _forwarded(self, message: Msg) -> bytes:
        """Carries out a command that another node has received."""
        assert self._part is not None, "it is a node"
        command = msgspec.json.decode(message.data, type=Command)
        device = self._registry.devices.get(command.device)
        try:
            is_current = device is not None and self._part.is_current(device, command.epoch)
            done = is_current and await self._write(
                command.device,
                command.tag,
                command.text,
                lambda: min(self._lateness.check(message), command.within),
            )
            executed = Executed(moved=not done)
        except Refused as refused:
            executed = Executed(error=str(refused))
        return msgspec.json.encode(executed)

    async def _browse_own(self, message: Msg) -> bytes:
        """Reports devices that this node polls, to another node."""
        about = msgspec.json.decode(message.data, type=About)
        counters = self._polling.counters()
        shown = self._shown_devices(about.devices)
        return self._told(
            (id, browsing.report(*shown[id], counters, self._most()))
            for id in about.devices
            if id in shown
        )

    async def _variables_own(self, message: Msg) -> bytes:
        """Tells another node the values of devices that this node polls."""
        about = msgspec.json.decode(message.data, type=About)
        shown = self._shown_devices(about.devices)
        prefix = self._settings.prefix
        return self._told(
            (id, list(of_device(*shown[id], prefix))) for id in about.devices if id in shown
        )

    def _told(self, found: Iterable[tuple[str, object]]) -> bytes:
        """As many as fit into a message."""
        texts: list[bytes] = []
        room = self._most() - ENVELOPE
        for id, content in found:
            text = msgspec.json.encode(id) + b":" + msgspec.json.encode(content)
            room -= len(text) + 1
            if room < 0:
                break
            texts.append(text)
        return b'{"devices":{' + b",".join(texts) + b"}}"

    async def _browse(self, message: Msg) -> BrowseAnswer:
        request = BrowseRequest()
        if message.data:
            request = decode(message.data, BrowseRequest, self._settings.limits.request)
        if self._part is not None:
            return await self._browse_all(request)
        async with self._in_order(message, is_large=True):
            return self._browsed(request)

    async def _variables(self, message: Msg) -> bytes:
        request = VariablesRequest()
        if message.data:
            request = decode(message.data, VariablesRequest, self._settings.limits.request)
        if self._part is not None:
            return await self._all_variables(request)
        async with self._in_order(message, is_large=True):
            prefix = self._settings.prefix
            refused = () if self._configured is None else self._configured.refused
            return variables(request, self._shown_devices(), refused, prefix, self._most())

    def _shown_devices(
        self, ids: Iterable[str] | None = None
    ) -> dict[str, tuple[ScannedDevice, Mapping[str, str]]]:
        """Returns each device with the errors of its tags that could not be decoded.

        With `ids`, only these devices, as far as they are known.
        """
        known = self._registry.devices
        return {
            id: (known[id], self._publishers[id].undecoded)
            for id in (known if ids is None else ids)
            if id in known
        }

    def _most(self) -> int:
        """Returns the size limit of an answer."""
        client = self._broker.client
        return MAX_PAYLOAD if client is None else client.max_payload

    def _browsed(self, request: BrowseRequest, ids: Iterable[str] | None = None) -> BrowseAnswer:
        service = ServiceReport(
            started_at=self._heart.started,
            published=self.outbox.sent,
            replaced=self.outbox.replaced,
            dropped=self.outbox.dropped,
            lost_scans=self._polling.dropped,
            other_scanners=self._rivals.current() or None,
        )
        if self._part is not None:
            fleet = self._part.fleet
            service.fleet = FleetReport(fleet.settings.name, fleet.node, fleet.nodes)
        if self._configured is not None:
            service.enabled = self._is_enabled
            service.refused_entries = [
                EntryReport(key=entry.key, error=entry.reason)
                for entry in self._configured.refused[:MAX_REFUSED_SHOWN]
            ] or None
        counters = self._polling.counters()
        return browsed(request, self._shown_devices(ids), counters, service, self._most())

    async def _adopt(self, device: str, want: Want | None, renewed: set[str]) -> None:
        """Makes the subscriptions of a device those of the fleet. Raises `Refused`."""
        wanted: dict[str, list[SubscribeRequest]] = {}
        for text in () if want is None else want.requests:
            request = kept_entries.restored(bytes(text))
            wanted.setdefault(request.subscriber_id, []).append(request)
        known = self._registry.devices.get(device)
        for subscriber in [] if known is None else list(known.subscribers):
            if subscriber not in wanted:
                self._remove(UnsubscribeRequest(device, subscriber))
        for subscriber, requests in wanted.items():
            tags: set[str] = set()
            for request in requests:
                asked = understood(request, self._rules)
                await self._add(asked, kept=True, renewed=subscriber in renewed)
                tags |= asked.tags.keys()
            known = self._registry.devices.get(device)
            found = None if known is None else known.subscribers.get(subscriber)
            others = [] if found is None else [id for id in found.tags if id not in tags]
            if others:
                self._remove(UnsubscribeRequest(device, subscriber, others))

    async def _browse_all(self, request: BrowseRequest) -> BrowseAnswer:
        """Reports devices of all nodes."""
        assert self._part is not None, "it is a node"
        ids = sorted(self._registry.devices)
        if request.device_id is not None:
            ids = [id for id in ids if id == request.device_id]
        offset = request.offset or 0
        page = ids[offset : offset + BROWSED]
        devices = [self._registry.devices[id] for id in page]
        found = await self._part.told("browse", devices)
        answer = self._browsed(msgspec.structs.replace(request, offset=None), page)
        answer.count = len(self._registry.devices)
        shown: list[DeviceReport] = []
        room = self._most() - ENVELOPE
        for report in answer.devices:
            with contextlib.suppress(msgspec.ValidationError):
                if report.device_id in found and request.tag_offset is None:
                    report = msgspec.convert(found[report.device_id], DeviceReport)
            room -= len(msgspec.json.encode(report)) + 1
            if room < 0 and shown:
                break
            shown.append(report)
        if answer.next is not None or len(shown) < len(answer.devices):
            answer.next = offset + len(shown)
        elif offset + len(page) < len(ids):
            answer.next = offset + len(page)
        answer.devices = shown
        return answer

    async def _all_variables(self, request: VariablesRequest) -> bytes:
        """Returns the latest values of devices of all nodes."""
        assert self._part is not None, "it is a node"
        left, texts = request.offset or 0, list[bytes]()
        room = self._most() - ENVELOPE
        ids = sorted(self._registry.devices)
        for at in range(0, len(ids), BROWSED):
            page = [
                device
                for id in ids[at : at + BROWSED]
                if request.device_id in (None, id)
                and (device := self._registry.devices.get(id)) is not None
            ]
            skipped = 0
            while skipped < len(page) and left >= len(page[skipped].tags):
                left -= len(page[skipped].tags)
                skipped += 1
            page = page[skipped:]
            found = await self._part.told("variables", page)
            shown = self._shown_devices(device.id for device in page)
            for device in page:
                values = found.get(device.id)
                if values is None and device.id in shown:
                    values = list(of_device(*shown[device.id], self._settings.prefix))
                for value in (values or [])[left:]:
                    text = msgspec.json.encode(value)
                    room -= len(text) + 1
                    if room < 0:
                        return b"[" + b",".join(texts) + b"]"
                    texts.append(text)
                left = 0
        return b"[" + b",".join(texts) + b"]"

    def _take(self, device: ScannedDevice, due: float, blocks: list[PolledBlock]) -> None:
        """Publishes the results of a poll."""
        try:
            self._publish(device, due, blocks)
        except Exception:  # An error with one device must not affect the others.
            logs.problem("scan_failed", device=device.id)

    def _publish(self, device: ScannedDevice, due: float, blocks: list[PolledBlock]) -> None:
        if not self._is_own(device):
            return  # Another node may have published newer values.
        self._scans += 1
        if device.health.judge(blocks):
            self._tell(device)
        if device.may_have_moved():
            self._begin(self._look_up(device))
        device.latest.take(blocks)
        id = device.id
        messages = self._publishers[id].messages(due, blocks)
        self.outbox.put([((id, tag), text) for tag, text in messages])
        if len(device.subjects) > 1:
            one, other = (f"{self._settings.prefix}.data.{name}" for name in device.subjects)
            self.outbox.put(
                [((id, tag, other), wire.readdressed(text, one, other)) for tag, text in messages]
            )

    async def _look_up(self, device: ScannedDevice) -> None:
        """Looks up the name of a device that does not respond; its address may have changed."""
        async with self._turn(device.id):
            if self._registry.devices.get(device.id) is not device:
                return
            try:
                address = await self._allowed.address(device.source.target, after=device.address)
                endpoint = self._endpoint(device.source.target, address)
            except Refused as refused:
                logs.refused("not_found", kind="name", device=device.id, reason=str(refused))
                return
            if address != device.address:
                device.address, device.endpoint = address, endpoint
                self._polling.renew(device)
                logs.write(logging.INFO, "moved", device=device.id, address=str(address))

    def _tell(self, device: ScannedDevice) -> None:
        """Publishes and logs the state of a device."""
        self._publish_state(device)
        health = device.health
        level = logging.WARNING if health.error else logging.INFO
        told = {} if health.error is None else {"error": health.error}
        logs.write(level, f"device_{health.state}", device=device.id, **told)

    def _publish_state(self, device: ScannedDevice) -> None:
        if not self._is_own(device):
            return
        health = device.health
        status = Status(
            device_id=device.id,
            state=health.state,
            failures=health.failures,
            error=health.error,
            timestamp=int(time.time() * 1000),
        )
        device.status = msgspec.json.encode(status)
        self._kept.state_changed(device.id)
        for name in device.subjects:
            subject = f"{self._settings.prefix}.status.{name}"
            text = wire.text(subject, device.status)
            if (lease := self._lease(device)) is not None:
                text = wire.leased(text, lease)
            self.outbox.put([((device.id, subject), text)])

    async def _beat(self) -> None:
        while True:
            self._due.clear()
            self._announce()
            if self._part is None or self._part.fleet.is_own(0):
                await self._heart.beat(self._broker.client)
            tasks.check()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(EVERY):
                    await self._due.wait()

    async def _stop(self, running: Sequence[asyncio.Task[object]]) -> None:
        """Stops all parts, each with a timeout."""
        for part in (self._enabling, self._configured):
            if part is not None:
                part.connected(None)
        if self._part is not None:
            with contextlib.suppress(Exception):  # Whatever fails, the leases end by themselves.
                async with asyncio.timeout(LEAVING):
                    await self._part.leave()
        await _within(self._polling.stop())
        for request in list(self._tasks):
            request.cancel()
        await _within(self._farewell())
        await _within(tasks.end(running))

    async def _farewell(self) -> None:
        """Deletes heartbeat and states, and waits until all messages are sent."""
        if self._part is None and self._settings.keep_subscriptions:
            with contextlib.suppress(Exception):
                await self._kept.keeper.stop()
        if self._part is None or not self._part.fleet.has_others:
            await self._heart.stop(self._broker.client)
        await self.outbox.flush()


class _Host:
    """What the scanner does for its fleet."""

    def __init__(self, scanner: Scanner) -> None:
        self._scanner = scanner

    def turn(self, device: str) -> asyncio.Lock:
        return self._scanner._turn(device)

    async def adopt(self, device: str, want: Want | None, renewed: set[str]) -> None:
        await self._scanner._adopt(device, want, renewed)

    def want(self, device: str) -> list[bytes]:
        known = self._scanner._registry.devices.get(device)
        if known is None:
            return []
        return [text for each in known.subscribers for text in kept_entries.requests(known, each)]

    def timed(self, device: str) -> Iterable[str]:
        known = self._scanner._registry.devices.get(device)
        subscribers = {} if known is None else known.subscribers
        return [name for name, each in subscribers.items() if each.ttl is not None]

    def begin(self, device: ScannedDevice) -> None:
        scanner = self._scanner
        device.health = Health()
        publisher = scanner._publishers[device.id] = scanner._publisher(device)
        publisher.want(lambda: grouped(device), device.tags)
        scanner._publish_state(device)
        with contextlib.suppress(Refused):  # It is stopping.
            scanner._poll(device)

    def end(self, device: ScannedDevice) -> None:
        if device.polled_as:
            self._scanner._polling.drop(device)
            device.polled_as = ""


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


async def _within(step: Awaitable[object]) -> None:
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(ENDING):
            await step
