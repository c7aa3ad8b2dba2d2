"""What is kept in JetStream: subscriptions and states of devices, and how they are restored."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from dataclasses import dataclass, field
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
    with_later,
    without,
)
from holdfast.scanner.jetstream.store import EntryStore
from holdfast.scanner.messages.types import Status
from holdfast.scanner.placement import Placement
from holdfast.scanner.subscriptions.key import SubscriptionKey

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping

    from nats.aio.client import Client

    from holdfast.scanner.dialects import Dialect
    from holdfast.scanner.messages.types import SubscribeRequest, UnsubscribeRequest
    from holdfast.scanner.placement import DeviceHost, SubscriptionHost
    from holdfast.scanner.subscriptions.device import ScannedDevice
    from holdfast.scanner.subscriptions.registry import Registry
    from holdfast.scanner.subscriptions.subscription import Subscription

MAX_REMOVED_IDS = 10_000
"""Limit of remembered ids of tags that a subscriber has removed: a device has no more."""

MAX_RESTORE_WAIT_S = 2.0
"""How long requests wait for stored subscriptions. After that, restoring continues."""


@dataclass(slots=True)
class Changes:
    """What a subscriber changes before its stored subscription is read.

    Without JetStream, it is never read. So the requests are not kept here: the registry has what
    they add.
    """

    replaces: bool = False
    """Whether nothing of the stored subscription is left."""
    removed: set[str] = field(default_factory=set)
    """The ids of removed tags."""
    given: set[str] = field(default_factory=set)
    """The `SETTINGS` that its requests contain."""

    def remove(self, ids: Collection[str] | None) -> None:
        """Removes tags; `None` for all."""
        if ids is None:
            self.replaces = True
        elif len(self.removed) < MAX_REMOVED_IDS:
            self.removed.update(ids)


class StoredSubscriptions(Placement):
    """Stores the subscriptions and states of the registry, and restores them after a start."""

    def __init__(self, prefix: str, registry: Registry, dialect: Dialect) -> None:
        self._prefix = prefix
        self._registry = registry
        self._dialect = dialect
        self._changes: dict[SubscriptionKey, Changes] = {}
        """What subscribers change before the stored requests are read."""
        self._pending: dict[SubscriptionKey, list[SubscribeRequest]] = {}
        """Stored requests that are not carried out yet, and the later ones of their subscribers."""
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

    def subscribed(
        self, device: ScannedDevice, subscription: Subscription, is_stored: bool, /
    ) -> None:
        """Stores a subscription that has changed, together with what is pending of it."""
        owner, given = subscription.key, subscription.given_settings
        if not self._has_read:
            changes = self._changes.setdefault(owner, Changes())
            changes.given |= given
            changes.replaces |= self._dialect.replaces_subscription
        if is_stored:
            return
        pending = [] if self._dialect.replaces_subscription else self._pending.get(owner, [])
        if pending and (pending := with_later(pending, device, subscription.subscriber, given)):
            self._pending[owner] = pending
            self._store.touch(owner)
        else:
            self._touch(owner)

    def state_changed(self, device: str) -> None:
        """Stores the state of a device; removes it if the device is gone."""
        self._store.touch(SubscriptionKey(device))

    def unsubscribed(self, request: UnsubscribeRequest) -> None:
        """Removes tags of a subscription, also of a pending one."""
        owner = SubscriptionKey.of(request)
        ids = request.ids
        if not self._has_read:
            self._changes.setdefault(owner, Changes()).remove(ids)
        left = [] if ids is None else without(self._pending.get(owner, []), set(ids))
        self._touch(owner)
        if left:
            self._pending[owner] = left

    def removals(self, known: Iterable[SubscriptionKey], /) -> Iterator[UnsubscribeRequest]:
        """Yields what to remove from stored subscriptions, for the next scanner of this process."""
        if not self._has_read:
            for owner, changes in self._changes.items():
                yield owner.removal(None if changes.replaces else list(changes.removed))
            return
        touched = {owner for owner in self._store.touched if owner.subscriber is not None}
        yield from super().removals((touched | {*known}) - self._pending.keys())

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
        found: dict[SubscriptionKey, list[SubscribeRequest]] = {}
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
            found.setdefault(owner, []).append(request)
            is_ours = owner in self._store.touched or self._is_known(owner)
            # An owner that is returned replaces or removes what is stored under its keys.
            if is_ours or owner in self._pending or not self._has_read:
                owners[key] = owner
        if not self._has_read:
            left = {owner: self._left(owner, parts) for owner, parts in found.items()}
            self._pending = {owner: parts for owner, parts in left.items() if parts}
            self._changes.clear()
            self._has_read = True
        for device in self._registry.devices.values():
            for name in (None, *device.subscribers):
                self._store.touch(SubscriptionKey(device.id, name))
        if self._pending:
            self._found_pending.set()
        return owners

    def _left(
        self, owner: SubscriptionKey, parts: list[SubscribeRequest]
    ) -> list[SubscribeRequest]:
        """Returns what to carry out of stored requests, with the later ones of their subscriber."""
        changes = self._changes.get(owner, Changes())
        left = [] if changes.replaces else parts
        if changes.removed:
            left = without(left, changes.removed)
        if left and self._is_known(owner):
            assert owner.subscriber is not None
            device = self._registry.devices[owner.device]
            left = with_later(left, device, owner.subscriber, changes.given)
        return left

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
        # Known subscribers first: they decide on the settings that all subscribers must share.
        pending = [(is_last(self._pending.get(owner, [])), owner) for owner in owners]
        for _, owner in sorted(pending, key=lambda each: (each[0], not self._is_known(each[1]))):
            # Under the lock: a caller may change or end the subscription while this waits for it.
            async with self._device_host.lock(owner.device):
                if found := self._pending.get(owner):
                    await self._restore_one(owner, found)

    async def _restore_one(self, owner: SubscriptionKey, found: list[SubscribeRequest]) -> None:
        try:
            await self._host.restore(joined(found))
        except Refused as refused:
            if owner in self._logged:
                return
            self._logged.add(owner)
            await self._restore_parts(owner, found)
            log_lines.write(logging.WARNING, "not_restored", **owner.fields, reason=str(refused))
            self._device_host.give_up(owner.device, str(refused))
        else:
            self._touch(owner)
            tags = sum(len(request.tags) for request in found)
            log_lines.write(logging.INFO, "restored", **owner.fields, tags=tags)

    async def _restore_parts(self, owner: SubscriptionKey, found: list[SubscribeRequest]) -> None:
        """Carries out the parts of a refused subscription that are not refused alone.

        Before the restart, they may have been carried out by later requests.
        """
        if len(found) > 1 and not self._is_known(owner):
            for part in found:  # Without its profile, which would add the tags of other parts.
                with contextlib.suppress(Refused):
                    await self._host.restore(msgspec.structs.replace(part, profile=None))
