"""The scanner service: connects all parts, and handles requests.

The registry holds the subscriptions. Every change of it is passed to the poller and the publishers.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias
from weakref import WeakValueDictionary

import msgspec

from holdfast import _core, logs
from holdfast.net.tls import NO_FILES, Tls
from holdfast.scanner import commands, device_tls, tentacle_next, wire
from holdfast.scanner.adjusting import Adjustments, adjusted
from holdfast.scanner.broker import Broker, Ping, Servers
from holdfast.scanner.browsing import browsed
from holdfast.scanner.configured import Configured
from holdfast.scanner.enabling import Enabling
from holdfast.scanner.errors import Refused
from holdfast.scanner.expiring import Expiring
from holdfast.scanner.groups import grouped
from holdfast.scanner.heartbeat import EVERY, Heart
from holdfast.scanner.hosts import Allowed
from holdfast.scanner.kept import Kept
from holdfast.scanner.limits import ScannerLimits
from holdfast.scanner.messages import (
    Announcement,
    Answer,
    BrowseRequest,
    EntryReport,
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
from holdfast.scanner.variables import variables

if TYPE_CHECKING:
    from nats.aio.client import Client
    from nats.aio.msg import Msg

    from holdfast._core import Endpoint, Poller
    from holdfast.client.url import Target
    from holdfast.config.scanning import Dialect, Writes
    from holdfast.net.allow_list import AllowEntry
    from holdfast.scanner.adjusting import Asked
    from holdfast.scanner.devices import ScannedDevice
    from holdfast.scanner.keeping import Unit
    from holdfast.scanner.messages import BrowseAnswer
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
    publish_logs: bool = True
    """Whether the log is also published."""
    keep_subscriptions: bool = True
    """Whether subscriptions and states are kept in JetStream."""
    dialect: Dialect = "tentacle"
    """The programs that it serves."""
    profiles: Mapping[str, TagList] = field(default_factory=dict)
    """The tags that requests can name by their profile."""


class Scanner:
    """One service, from `run` to its end."""

    def __init__(self, settings: Settings, poller: Poller | None = None) -> None:
        """Without `poller`, it has a poller of its own."""
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
        self.outbox = Outbox()
        self._expiring = Expiring()
        self._configured: Configured | None = None
        self._enabling: Enabling | None = None
        if self._is_next:
            self._configured = Configured(
                settings.prefix, self._understand, self._carry_out, self._end_configured
            )
            self._enabling = Enabling(settings.prefix, self._enable)
        self._kept = Kept(
            settings.prefix,
            self._registry,
            self._restore_request,
            lambda unit: self._key_of(unit.device, unit.subscriber) is not None,
        )
        self._ready = asyncio.Event()
        """Set when the kept subscriptions are restored, or can't be."""
        self._broker = Broker(settings.servers, self._handlers(), self._connected, settings.ping)
        self._due = asyncio.Event()
        """Set when the next heartbeat is due immediately."""

    async def run(self) -> None:
        """Serves until `end` is called, or until a shutdown message.

        Raises `OSError` for a file of the settings that can't be used.
        """
        device_tls.check(self._settings.device_tls)
        self._polling = Polling(self._take, self._poller)
        works = [self._broker.run(), self.outbox.run(), self._beat(), self._ended.wait()]
        works.append(self._expiring.run(self._expire))
        if self._settings.keep_subscriptions:
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

    def _connected(self, client: Client | None) -> None:
        """Handles a new or lost connection.

        Messages that were sent before a disconnect may be lost, so a new connection publishes all
        values and states again.
        """
        self.outbox.connected(client)
        self._kept.keeper.connected(client)
        self._expiring.connected(client is not None)
        for part in (self._enabling, self._configured):
            if part is not None:
                part.connected(client)
        self._due.set()
        if client is not None:
            for device in self._registry.devices.values():
                self._publishers[device.id].renew()
                self._publish_state(device)

    def _handlers(self) -> dict[str, Callable[[Msg], Awaitable[None]]]:
        prefix = self._settings.prefix

        async def shutdown(_: Msg) -> None:
            logs.write(logging.INFO, "shutdown_asked")
            self.end()

        handlers = {
            f"{prefix}.subscribe": self._answering("subscribe", self._subscribe),
            f"{prefix}.unsubscribe": self._answering("unsubscribe", self._unsubscribe),
            f"{prefix}.command.>": self._answering("command", self._command),
            f"{prefix}.browse": self._answering("browse", self._browse),
            f"{prefix}.variables": self._answering("variables", self._variables),
            f"{prefix}.scanner": self._announced,
            f"{prefix}.shutdown": shutdown,
        }
        if self._is_next:  # Its PLC library sends commands here.
            handlers[f"{prefix}.module.command.>"] = handlers[f"{prefix}.command.>"]
        return handlers

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
            self._rival(msgspec.json.decode(message.data, type=Announcement).started_at)

    def _rival(self, started: int) -> None:
        if self._rivals.seen(started):
            self._announce()

    def _announce(self) -> None:
        subject = f"{self._settings.prefix}.scanner"
        text = wire.message(subject, Announcement(started_at=self._heart.started))
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
            await self._add(asked)
            if self._is_next:
                self._remove_others(asked)
        await self._kept.settled(asked.device, asked.subscriber)
        self._log_adjustments(asked.subscriber, asked.device, changes)
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
        asked = understood(request, self._rules)
        async with self._turn(asked.device):
            await self._add(asked, kept=True)

    async def _add(self, asked: Subscription, *, kept: bool = False) -> None:
        """Adds a subscription, and polls and publishes accordingly. Raises `Refused`.

        A subscription that is already `kept` is not stored again.
        """
        address, endpoint = await self._place(asked)
        known = self._registry.devices.get(asked.device)
        is_extended = known is not None and known.is_extended_by(asked.subscriber, asked.tags)
        change = self._registry.subscribe(asked, address)
        device = change.device
        if device is None or asked.subscriber not in device.subscribers:
            return
        self._expiring.renew(device.id, asked.subscriber, asked.ttl)
        if change.former is not None:
            self._drop(change.former)
        device.endpoint = endpoint
        self._begin_publishing(device, asked)
        if not kept:
            self._kept.changed(device.id, asked.subscriber)
        if change.former is not None or not is_extended:
            self._publish_state(device)
        if change.polling or change.former or (asked.tags and device.rate > SOON):
            self._polling.renew(device)

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

    def _begin_publishing(self, device: ScannedDevice, asked: Subscription) -> None:
        publisher = self._publishers.get(device.id)
        if publisher is None:
            publisher = Publisher(self._settings.prefix, device.id, self._settings.dialect)
            self._publishers[device.id] = publisher
        publisher.want(lambda: grouped(device), asked.tags)

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
            self._check_not_configured(request.device_id, request.subscriber_id)
        async with self._turn(request.device_id):
            self._remove(request)
        await self._kept.settled(request.device_id, request.subscriber_id)
        self._log_adjustments(request.subscriber_id, request.device_id, changes)
        logs.write(
            logging.INFO,
            "unsubscribed",
            device=request.device_id,
            subscriber=request.subscriber_id,
            tags="all" if request.tag_ids is None else len(request.tag_ids),
        )
        return Answer(success=True)

    def _remove(self, request: UnsubscribeRequest) -> None:
        """Removes tags of a subscription, and polls and publishes accordingly."""
        self._kept.unsubscribed(request)
        device, changed = self._registry.unsubscribe(request)
        if device is None:
            return
        if request.subscriber_id not in device.subscribers:
            self._expiring.renew(device.id, request.subscriber_id, None)
        if device.subscribers:
            self._publishers[device.id].want(lambda: grouped(device))
            if changed:
                self._polling.renew(device, at_once=False)
        elif changed:
            self._drop(device)
            self._kept.state_changed(device.id)

    async def _expire(self, unit: Unit) -> None:
        """Ends a subscription that was not renewed within its `ttl`."""
        assert unit.subscriber is not None
        async with self._turn(unit.device):
            if not self._expiring.is_due(unit):  # It was renewed while this waited.
                return
            self._expiring.renew(unit.device, unit.subscriber, None)
            self._remove(UnsubscribeRequest(unit.device, unit.subscriber))
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
        self._polling.drop(device)

    def _turn(self, device: str) -> asyncio.Lock:
        """Returns the lock that serializes requests for one device."""
        return self._turns.setdefault(device, asyncio.Lock())

    async def _command(self, message: Msg) -> Answer:
        name = message.subject.removeprefix(f"{self._settings.prefix}.")
        name = name.removeprefix("module.").removeprefix("command.")
        most = self._settings.limits.command
        if len(message.data) > most:
            raise Refused(f"the value has {len(message.data)} bytes, allowed are {most}")
        try:
            text = message.data.decode()
        except UnicodeDecodeError:
            raise Refused("the value is not UTF-8 text") from None
        if self._is_next:
            text = tentacle_next.command(message.data)
        async with self._in_order(message):
            device, tag = self._registry.commanded(name)
        await commands.write(self._polling, device, tag, text)
        return Answer(success=True)

    async def _browse(self, message: Msg) -> BrowseAnswer:
        request = BrowseRequest()
        if message.data:
            request = decode(message.data, BrowseRequest, self._settings.limits.request)
        async with self._in_order(message, is_large=True):
            return self._browsed(request)

    async def _variables(self, message: Msg) -> bytes:
        request = VariablesRequest()
        if message.data:
            request = decode(message.data, VariablesRequest, self._settings.limits.request)
        async with self._in_order(message, is_large=True):
            prefix = self._settings.prefix
            refused = () if self._configured is None else self._configured.refused
            return variables(request, self._shown_devices(), refused, prefix, self._most())

    def _shown_devices(self) -> dict[str, tuple[ScannedDevice, Mapping[str, str]]]:
        """Returns each device with the errors of its tags that could not be decoded."""
        return {
            id: (device, self._publishers[id].undecoded)
            for id, device in self._registry.devices.items()
        }

    def _most(self) -> int:
        """Returns the size limit of an answer."""
        client = self._broker.client
        return MAX_PAYLOAD if client is None else client.max_payload

    def _browsed(self, request: BrowseRequest) -> BrowseAnswer:
        service = ServiceReport(
            started_at=self._heart.started,
            published=self.outbox.sent,
            replaced=self.outbox.replaced,
            dropped=self.outbox.dropped,
            lost_scans=self._polling.dropped,
            other_scanners=self._rivals.current() or None,
        )
        if self._configured is not None:
            service.enabled = self._is_enabled
            service.refused_entries = [
                EntryReport(key=entry.key, error=entry.reason)
                for entry in self._configured.refused[:MAX_REFUSED_SHOWN]
            ] or None
        counters = self._polling.counters()
        return browsed(request, self._shown_devices(), counters, service, self._most())

    def _take(self, device: ScannedDevice, due: float, blocks: list[PolledBlock]) -> None:
        """Publishes the results of a poll."""
        try:
            self._publish(device, due, blocks)
        except Exception:  # An error with one device must not affect the others.
            logs.problem("scan_failed", device=device.id)

    def _publish(self, device: ScannedDevice, due: float, blocks: list[PolledBlock]) -> None:
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
            self.outbox.put([((device.id, subject), wire.text(subject, device.status))])

    async def _beat(self) -> None:
        while True:
            self._due.clear()
            self._announce()
            await self._heart.beat(self._broker.client)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(EVERY):
                    await self._due.wait()

    async def _stop(self, running: Sequence[asyncio.Task[object]]) -> None:
        """Stops all parts, each with a timeout."""
        for part in (self._enabling, self._configured):
            if part is not None:
                part.connected(None)
        await _within(self._polling.stop())
        for request in list(self._tasks):
            request.cancel()
        await _within(self._farewell())
        for task in running:
            task.cancel()
        await _within(asyncio.wait(running))

    async def _farewell(self) -> None:
        """Deletes heartbeat and states, and waits until all messages are sent."""
        if self._settings.keep_subscriptions:
            with contextlib.suppress(Exception):
                await self._kept.keeper.stop()
        await self._heart.stop(self._broker.client)
        await self.outbox.flush()


async def _within(step: Awaitable[object]) -> None:
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(ENDING):
            await step
