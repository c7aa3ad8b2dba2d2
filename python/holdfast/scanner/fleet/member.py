"""A node of a fleet: its membership, its leases, and the desired state.

All nodes know all subscriptions, so any of them answers any request. A device is polled by the node
that has the lease of its partition.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from typing import TYPE_CHECKING, Any

import msgspec
from nats.errors import Error
from nats.js.errors import NoStreamResponseError

from holdfast.client.url import connection_of
from holdfast.events import log_lines
from holdfast.net.nats.connection import nats_reason
from holdfast.net.nats.key_bucket import Outdated
from holdfast.replication.leases.leases import FIRST_RETRY_S, MAX_RETRY_S
from holdfast.runtime import tasks
from holdfast.runtime.backoff import Backoff
from holdfast.scanner.errors import NotConfirmed, Refused
from holdfast.scanner.fleet.assignment import partition_of
from holdfast.scanner.fleet.desired_state import DesiredDevice, DesiredState
from holdfast.scanner.fleet.partition_leases import PartitionLeases
from holdfast.scanner.jetstream.entries import requests as stored_requests
from holdfast.scanner.jetstream.entries import restored
from holdfast.scanner.placement import Changed, Placement

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Collection, Iterator

    from nats.aio.client import Client

    from holdfast import _core
    from holdfast.replication.leases.thread import Connect, StartThread
    from holdfast.scanner.fleet.agreement import Terms
    from holdfast.scanner.messages.types import SubscribeRequest
    from holdfast.scanner.placement import DeviceControl, SubscriptionControl
    from holdfast.scanner.settings import FleetSettings
    from holdfast.scanner.subscriptions.device import ScannedDevice
    from holdfast.scanner.subscriptions.registry import Registry
    from holdfast.scanner.subscriptions.subscription import Subscription

ADOPT_RETRY_S = 10.0
"""Between attempts to carry out a subscription of another node that is refused here."""

MAX_STORE_ATTEMPTS = 20
"""Attempts to store a device that other nodes change at the same time."""

CONNECTION_CHECK_S = 0.1
"""Between looks whether there is a connection."""

LEAVE_TIMEOUT_S = 10.0
"""Time to hand devices over to other nodes."""


class FleetMember(Placement):
    """Joins the fleet, follows the desired state, and knows which devices are its own."""

    def __init__(
        self,
        settings: FleetSettings,
        terms: Terms,
        registry: Registry,
        about: Callable[[], dict[str, Any]],
        connect: Connect,
        start_thread: StartThread,
    ) -> None:
        """`connect` makes a connection for the leases alone, `start_thread` starts their thread."""
        self.partition_leases = PartitionLeases(
            settings,
            terms,
            about,
            self._gained,
            self._lost,
            connect=connect,
            start_thread=start_thread,
        )
        self._backoff = Backoff(FIRST_RETRY_S, MAX_RETRY_S, jitter=True)
        self._applied: dict[str, int] = {}
        """The revision of each device that is carried out here. Only that one may be replaced: one
        that is newer has what others have changed."""
        self.desired = DesiredState(settings.name, self._on_change, self._applied.clear)
        self._check_interval_s = settings.check_interval_s
        self._registry = registry
        self.client: Client | None = None
        self._has_new_client = asyncio.Event()
        self._has_touched = asyncio.Event()
        self._touched: set[str] = set()
        self._refused: set[str] = set()
        """The devices whose subscriptions are refused here. This node does not know them."""
        self._renewed: dict[str, dict[str, int]] = {}
        """When subscribers with a time to live have renewed it, by device and subscriber."""
        self._devices: dict[int, dict[str, ScannedDevice]] = {}
        self.is_joined = False

    def connected(self, client: Client | None) -> None:
        """Sets the client; `None` while there is no connection."""
        self.client = client
        self._has_new_client.set()
        self.partition_leases.connected(is_connected=client is not None)

    async def run(
        self, devices: DeviceControl, subscriptions: SubscriptionControl, ready: asyncio.Event, /
    ) -> None:
        """Is a node of the fleet until it is cancelled. Raises `FleetRefused`.

        Sets `ready` when it knows the desired state.
        """
        self._device_control, self._subscription_control = devices, subscriptions
        self.partition_leases.start()
        try:
            async with tasks.beating(self.partition_leases.heartbeat):
                await self._open(ready)
                works = (
                    self.partition_leases.run(),
                    self._follow_again(),
                    self._adopt_changes(),
                    self._adopt_refused(),
                )
                running = [asyncio.create_task(work) for work in works]
                try:
                    done, _ = await asyncio.wait(running, return_when=asyncio.FIRST_COMPLETED)
                    for task in done:
                        task.result()
                finally:
                    await tasks.end(running)
        finally:
            await self.partition_leases.stop()

    async def _open(self, ready: asyncio.Event) -> None:
        """Joins the fleet, and reads the desired state."""
        while not self.is_joined:
            client, partitions = self.client, self.partition_leases
            leases, terms = partitions.leases, partitions.terms
            if client is None or leases.reason is not None or not leases.is_read:
                await asyncio.sleep(CONNECTION_CHECK_S)
                continue
            try:
                await self.desired.open(client, terms, partitions.has_terms, has_joined=False)
                self._has_new_client.clear()
                await partitions.join()
                await self.desired.agree(terms, partitions.has_terms, may_replace=True)
                await self._read(ready)
                self.is_joined = True
                self._backoff.succeeded()
            except (Error, OSError) as error:
                await self._pause(error)

    async def _pause(self, error: Exception) -> None:
        """Waits after an attempt to open a bucket that has failed. All nodes fail together."""
        log_lines.refused("fleet_unavailable", kind="fleet", reason=nats_reason(error))
        await asyncio.sleep(self._backoff.failed())

    async def _read(self, ready: asyncio.Event) -> None:
        await self.desired.is_read.wait()
        await self._adopt_all(self.desired.devices)
        ready.set()

    async def _follow_again(self) -> None:
        """Follows the bucket anew after each reconnect, and whenever nothing comes from it.

        The server may have forgotten who follows it, or have lost the bucket.
        """
        while True:
            await tasks.within(self._check_interval_s, self._has_new_client.wait())
            client = self.client
            if client is None:
                await asyncio.sleep(CONNECTION_CHECK_S)
                continue
            if not self._has_new_client.is_set():
                with contextlib.suppress(Error, OSError):
                    if await self.desired.is_followed():
                        await self.desired.forget_ended()
                        continue
            self._has_new_client.clear()
            try:
                await self.desired.open(
                    client, self.partition_leases.terms, lambda _: True, has_joined=True
                )
            except (Error, OSError) as error:
                await self._pause(error)
                self._has_new_client.set()
            else:
                self._backoff.succeeded()

    async def _adopt_changes(self) -> None:
        """Carries out what other nodes have stored."""
        async with asyncio.TaskGroup() as running:
            while True:
                await self._has_touched.wait()
                self._has_touched.clear()
                touched, self._touched = self._touched, set()
                # A device may wait for a name server; what changes next does not wait for it.
                running.create_task(self._adopt_all(touched))

    async def _adopt_refused(self) -> None:
        while True:
            await asyncio.sleep(ADOPT_RETRY_S)
            await asyncio.gather(*map(self._adopt, tuple(self._refused)))

    async def _adopt_all(self, devices: Collection[str]) -> None:
        await asyncio.gather(*map(self._adopt, devices))
        # One that comes later may have been in the way, as on a connection with other settings.
        refused = self._refused.intersection(devices)
        if len(refused) < len(devices):
            await asyncio.gather(*map(self._adopt, refused))

    def _on_change(self, device: str) -> None:
        self._touched.add(device)
        self._has_touched.set()

    async def _adopt(self, device: str) -> None:
        async with self._device_control.lock(device):
            await self._adopt_locked(device)

    async def _adopt_locked(self, device: str) -> None:
        if self._applied.get(device, 0) != self.desired.revision(device):
            await self._adopt_now(device)

    async def refresh(self, device: str, /) -> None:
        """Carries out the latest change of a device. Raises `Refused` if it can't be read."""
        # Under the lock: reads may overtake each other, and commands must stay in order.
        async with self._device_control.lock(device):
            await self._read_newer(device, "not written")
            await self._adopt_locked(device)

    async def _read_newer(self, device: str, outcome: str) -> None:
        """Reads the latest change of a device. Raises `Refused` with the outcome if it can't."""
        try:
            await self.desired.read(device)
        except (Error, OSError) as error:
            self._has_new_client.set()  # The bucket may be lost.
            flaw = f"{self.desired.bucket} can't be read: {nats_reason(error)}"
            raise Refused(f"{outcome}: {flaw}") from None

    async def _adopt_now(self, device: str) -> Refused | None:
        """Returns why it is refused here. Then this node does not know the device any more."""
        self._refused.discard(device)
        revision, desired = self.desired.value(device)
        times = {} if desired is None else desired.renewed
        before = self._renewed.get(device, {})
        renewed = {each for each, at in times.items() if before.get(each) != at}
        try:
            by_subscriber: dict[str, list[SubscribeRequest]] = {}
            for text in () if desired is None else desired.requests:
                request = restored(bytes(text))
                by_subscriber.setdefault(request.subscriber_id, []).append(request)
            await self._subscription_control.adopt(device, by_subscriber, renewed)
        except Refused as refused:
            log_lines.refused("not_restored", kind="fleet", device=device, reason=str(refused))
            self._refused.add(device)
            # What it was before must not go on: programs count on the new address and tags.
            await self._subscription_control.adopt(device, {}, set())
            self._applied.pop(device, None)
            self._renewed.pop(device, None)
            return refused
        self._applied[device] = revision
        if not revision:  # Its deletion has ended.
            del self._applied[device]
        self._note_renewed(device, times)
        return None

    def _note_renewed(self, device: str, times: dict[str, int]) -> None:
        self._renewed.pop(device, None)
        if times:
            self._renewed[device] = dict(times)

    async def store(
        self,
        device: str,
        change: Callable[[], Awaitable[Changed]],
        subscriber: str | None = None,
        /,
    ) -> Changed:
        """Makes a change of the subscriptions of a device, here and in the bucket."""
        # The change is made here first: it may be refused. If another node was faster, its value is
        # adopted, which undoes the change, and the change is made again on top of it.
        was_changed = False
        for _ in range(MAX_STORE_ATTEMPTS):
            changed = await change()
            now = int(time.time() * 1000)
            before = self._renewed.get(device, {})
            renewed = {
                each: now if each == subscriber else before.get(each, now)
                for each in self._subscribers_with_ttl(device)
            }
            requests = [msgspec.Raw(each) for each in self._requests(device)]
            desired = DesiredDevice(requests=requests, renewed=renewed) if requests else None
            try:
                self._check_size(device, desired)
                revision = self._applied.get(device, 0)
                self._applied[device] = await self.desired.store(device, desired, revision)
            except Outdated:
                try:
                    await self._read_newer(device, "not stored")
                finally:
                    refused = await self._adopt_now(device)
                if refused is not None:
                    raise Refused(f"the fleet's subscriptions of {device}: {refused}") from None
                was_changed = self.desired.revision(device) > revision
                continue
            except Refused:
                await self._adopt_now(device)
                raise
            except (Error, OSError) as error:
                self._has_new_client.set()  # The bucket may be lost.
                await self._adopt_now(device)
                reason = nats_reason(error)
                if isinstance(error, NoStreamResponseError):
                    raise Refused(f"not stored in {self.desired.bucket}: {reason}") from None
                raise NotConfirmed(f"not confirmed by {self.desired.bucket}: {reason}") from None
            self._note_renewed(device, renewed)
            return changed
        if not was_changed:
            # The server that refuses it has another change, which can't be read before a majority
            # of the servers has it.
            raise Refused(
                f"not stored in {self.desired.bucket}: an earlier change of {device} is not "
                "confirmed yet by a majority of the servers: try again"
            )
        raise Refused(
            f"{device} was changed by other nodes {MAX_STORE_ATTEMPTS} times meanwhile: try again"
        )

    def _requests(self, device_id: str) -> Iterator[bytes]:
        """Yields the requests that make the subscriptions of a device."""
        if (device := self._registry.devices.get(device_id)) is not None:
            for subscriber in device.subscribers:
                yield from stored_requests(device, subscriber)

    def _subscribers_with_ttl(self, device_id: str) -> list[str]:
        device = self._registry.devices.get(device_id)
        subscribers = {} if device is None else device.subscribers
        return [name for name, each in subscribers.items() if each.ttl is not None]

    def _check_size(self, device: str, desired: DesiredDevice | None) -> None:
        client = self.client
        if desired is None or client is None:
            return
        size, most = len(msgspec.json.encode(desired)), client.max_payload - 1024
        if size > most:
            raise Refused(
                f"the subscriptions of {device} take {size} bytes, a fleet stores at most {most}: "
                "use fewer tags, or set max_payload of the NATS server"
            )

    def on_subscribed(
        self,
        device: ScannedDevice,
        _subscription: Subscription,
        /,
        *,
        is_stored: bool,  # noqa: ARG002
    ) -> None:
        """A device is known from now on. `store` stores its subscriptions."""
        device.partition = partition_of(
            connection_of(device.source.target), self.partition_leases.settings.partitions
        )
        self._devices.setdefault(device.partition, {})[device.id] = device

    def on_dropped(self, device: ScannedDevice) -> None:
        """A device is known no more."""
        of_partition = self._devices.get(device.partition, {})
        if of_partition.get(device.id) is device:
            del of_partition[device.id]

    def known(self, device: ScannedDevice) -> ScannedDevice:
        """Returns a device as it is known now; another node may have changed its address."""
        return self._registry.devices.get(device.id, device)

    def is_own(self, device: ScannedDevice, /) -> bool:
        """Whether this node polls a device, now."""
        return self.partition_leases.is_own(device.partition)

    def takes_writes(self, device: ScannedDevice, /) -> bool:
        """Whether this node can write to a device, now."""
        return self.is_own(device) and bool(device.polled_as)

    def lease(self, device: ScannedDevice, /) -> int:
        """Returns the number in the header of messages: that of a later node is greater."""
        return self.partition_leases.epoch(device.partition)

    def fence(self, device: ScannedDevice, /) -> _core.Fence:
        """The fence of a device."""
        return self.partition_leases.fence(device.partition)

    def is_current(self, device: ScannedDevice, epoch: int) -> bool:
        """Whether this node has the lease of a device since that revision, or a later one."""
        return self.is_own(device) and self.partition_leases.revision(device.partition) >= epoch

    @property
    def refused(self) -> int:
        """How many devices of the fleet are refused here."""
        return len(self._refused)

    @property
    def own(self) -> Iterator[ScannedDevice]:
        """The devices that this node polls."""
        for partition in self.partition_leases.partitions:
            yield from self._devices.get(partition, {}).values()

    def _gained(self, partition: int) -> None:
        for device in list(self._devices.get(partition, {}).values()):
            self._device_control.begin(device)

    def _lost(self, partition: int) -> None:
        for device in list(self._devices.get(partition, {}).values()):
            self._device_control.end(device)

    async def leave(self) -> None:
        """Hands all devices over to other nodes."""
        if not self.is_joined:
            return
        log_lines.write(logging.INFO, "fleet_leaving", fleet=self.partition_leases.settings.name)
        # Whatever fails here, the leases end by themselves, and others take over then.
        with contextlib.suppress(Exception):
            async with asyncio.timeout(LEAVE_TIMEOUT_S):
                await self.partition_leases.leave()
