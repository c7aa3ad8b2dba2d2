"""What is kept in JetStream: subscriptions and states of devices, and how they are restored."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from typing import TYPE_CHECKING

import msgspec

from holdfast.events import log_lines
from holdfast.runtime.malformed_json import MALFORMED_JSON, malformed_text
from holdfast.scanner.errors import Refused
from holdfast.scanner.jetstream.availability import MAX_RETRY_S
from holdfast.scanner.jetstream.entries import (
    is_last,
    joined,
    number,
    numbered,
    requests,
    restored,
    status_key,
    without,
)
from holdfast.scanner.jetstream.store import EntryStore
from holdfast.scanner.messages.types import Status
from holdfast.scanner.placement import Placement
from holdfast.scanner.subscriptions.key import SubscriptionKey

if TYPE_CHECKING:
    from collections.abc import Mapping

    from nats.aio.client import Client

    from holdfast.scanner.messages.types import SubscribeRequest, UnsubscribeRequest
    from holdfast.scanner.placement import DeviceHost, SubscriptionHost
    from holdfast.scanner.subscriptions.device import ScannedDevice
    from holdfast.scanner.subscriptions.registry import Registry

MAX_RESTORE_WAIT_S = 2.0
"""How long requests wait for stored subscriptions. After that, restoring continues."""


class StoredSubscriptions(Placement):
    """Stores the subscriptions and states of the registry, and restores them after a start."""

    def __init__(self, prefix: str, registry: Registry) -> None:
        self._prefix = prefix
        self._registry = registry
        self._pending: dict[SubscriptionKey, list[SubscribeRequest]] = {}
        """Stored requests that are not carried out yet."""
        self._logged: set[SubscriptionKey] = set()
        """Pending subscriptions whose refusal is logged."""
        self._has_read = False
        self._found_pending = asyncio.Event()
        self._store = EntryStore(prefix, self._entries, self._on_read)

    def connected(self, client: Client | None) -> None:
        """Sets the client; `None` while there is no connection."""
        self._store.connected(client)

    async def run(
        self, devices: DeviceHost, host: SubscriptionHost, ready: asyncio.Event, /
    ) -> None:
        """Restores and stores, until it is cancelled.

        `host` carries out stored requests. Subscriptions from entries of another bucket are not
        stored. Sets `ready` after the first attempt to restore, or when it takes too long.
        """
        self._device_host, self._host = devices, host
        async with asyncio.TaskGroup() as running:
            running.create_task(self._store.run())
            running.create_task(self._restore(ready))

    async def close(self) -> None:
        """Removes the states of devices, which would be out of date. Then stores nothing."""
        with contextlib.suppress(Exception):  # JetStream is optional, and may fail in any way.
            await self._store.stop()

    def subscribed(self, device: ScannedDevice, subscriber: str | None, /) -> None:
        """Stores a subscription that has changed, instead of what is pending."""
        if subscriber is not None:
            self._touch(SubscriptionKey(device.id, subscriber))

    def state_changed(self, device: str) -> None:
        """Stores the state of a device; removes it if the device is gone."""
        self._store.touch(SubscriptionKey(device))

    def unsubscribed(self, request: UnsubscribeRequest) -> None:
        """Removes tags of a subscription, also of a pending one."""
        owner = SubscriptionKey.of(request)
        ids = request.ids
        left = [] if ids is None else without(self._pending.get(owner, []), set(ids))
        self._touch(owner)
        if left:
            self._pending[owner] = left

    async def settled(self, subscription: SubscriptionKey, /) -> str | None:
        """Waits until a changed subscription is stored; not while JetStream fails."""
        return await self._store.settled(subscription)

    def _touch(self, owner: SubscriptionKey) -> None:
        self._pending.pop(owner, None)
        self._logged.discard(owner)
        self._store.touch(owner)

    def _entries(self, owner: SubscriptionKey) -> Mapping[str, bytes]:
        """Returns the entries of an owner: nothing, if it is gone."""
        if self._host.is_entry(owner):
            return {}
        if owner in self._pending:
            assert owner.subscriber is not None
            pending = map(msgspec.json.encode, self._pending[owner])
            return numbered(self._prefix, owner.device, owner.subscriber, pending)
        device = self._registry.devices.get(owner.device)
        if device is None:
            return {}
        if owner.subscriber is None:
            return {status_key(self._prefix, device.id): device.status}
        if owner.subscriber not in device.subscribers:
            return {}
        values = requests(device, owner.subscriber, self._store.max_bytes)
        return numbered(self._prefix, device.id, owner.subscriber, values)

    def _on_read(self, entries: list[tuple[str, bytes]]) -> Mapping[str, SubscriptionKey]:
        """Takes the stored entries. At the first time, their subscriptions become pending.

        Everything known is compared with them again: the bucket may have been lost.
        Later, subscriptions that are not known here are left alone: another scanner may have stored
        them.
        """
        owners: dict[str, SubscriptionKey] = {}
        for key, value in sorted(entries, key=lambda entry: number(entry[0])):
            try:
                if key.startswith(f"{self._prefix}.status."):
                    owners[key] = SubscriptionKey(msgspec.json.decode(value, type=Status).device_id)
                    continue
                request = restored(value)
            except (Refused, *MALFORMED_JSON) as error:
                reason = malformed_text(error)
                log_lines.refused("kept_entry_malformed", kind="kept", key=key, reason=reason)
                continue
            owner = SubscriptionKey.of(request)
            is_ours = owner in self._store.touched or self._is_known(owner)
            if not self._has_read and not is_ours:
                self._pending.setdefault(owner, []).append(request)
            # An owner that is returned replaces or removes what is stored under its keys.
            if is_ours or owner in self._pending:
                owners[key] = owner
        self._has_read = True
        for device in self._registry.devices.values():
            for name in (None, *device.subscribers):
                self._store.touch(SubscriptionKey(device.id, name))
        if self._pending:
            self._found_pending.set()
        return owners

    def _is_known(self, owner: SubscriptionKey) -> bool:
        device = self._registry.devices.get(owner.device)
        return device is not None and owner.subscriber in device.subscribers

    async def _restore(self, ready: asyncio.Event) -> None:
        """Carries out pending requests, until it is cancelled."""
        await self._store.tried.wait()
        while True:
            work = asyncio.create_task(self._restore_all())
            try:
                await asyncio.wait([work], timeout=None if ready.is_set() else MAX_RESTORE_WAIT_S)
                ready.set()
                await work
            finally:
                work.cancel()
            if self._pending:
                await asyncio.sleep(MAX_RETRY_S)
            else:
                self._found_pending.clear()
                await self._found_pending.wait()

    async def _restore_all(self) -> None:
        devices: dict[str, list[SubscriptionKey]] = {}
        for owner in self._pending:
            devices.setdefault(owner.device, []).append(owner)
        await asyncio.gather(*map(self._restore_device, devices.values()))

    async def _restore_device(self, owners: list[SubscriptionKey]) -> None:
        pending = [(owner, self._pending.get(owner, [])) for owner in owners]
        for owner, found in sorted(pending, key=lambda each: is_last(each[1])):
            if not found or self._pending.get(owner) is not found:
                continue  # A caller has changed it.
            try:
                await self._host.restore(joined(found))
            except Refused as refused:
                if owner not in self._logged:
                    self._logged.add(owner)
                    log_lines.write(
                        logging.WARNING, "not_restored", **owner.fields, reason=str(refused)
                    )
                    self._device_host.give_up(owner.device, str(refused))
                continue
            if self._pending.get(owner) is found:
                self._touch(owner)
                tags = sum(len(request.tags) for request in found)
                log_lines.write(logging.INFO, "restored", **owner.fields, tags=tags)
