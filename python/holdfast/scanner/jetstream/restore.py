"""What is kept in JetStream: subscriptions and states of devices, and how they are restored."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING

import msgspec

from holdfast.events import log_lines
from holdfast.runtime.malformed_json import MALFORMED_JSON, malformed_text
from holdfast.scanner.errors import Refused
from holdfast.scanner.jetstream.availability import MAX_RETRY_S
from holdfast.scanner.jetstream.changes_before_read import ChangesBeforeRead
from holdfast.scanner.jetstream.entries import (
    is_last,
    joined,
    number,
    numbered,
    replaced_by,
    requests,
    resized,
    restored,
    status_key,
    status_keys,
    tag_ids,
    with_later,
    with_profile,
    without,
)
from holdfast.scanner.jetstream.store import EntryStore
from holdfast.scanner.messages.subject_parts import subject_id
from holdfast.scanner.messages.types import Status
from holdfast.scanner.placement import Placement
from holdfast.scanner.subscriptions.key import SubscriptionKey
from holdfast.scanner.subscriptions.subscription import SETTINGS

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping

    from nats.aio.client import Client

    from holdfast.scanner.messages.types import SubscribeRequest, UnsubscribeRequest
    from holdfast.scanner.placement import DeviceControl, SubscriptionControl
    from holdfast.scanner.subscriptions.device import ScannedDevice
    from holdfast.scanner.subscriptions.registry import Registry
    from holdfast.scanner.subscriptions.request_rules import Rules
    from holdfast.scanner.subscriptions.subscription import Subscription

MAX_RESTORE_WAIT_S = 2.0
"""How long requests wait for stored subscriptions. After that, restoring continues."""


@dataclass(slots=True)
class Pending:
    """A stored subscription that is not carried out yet, with the later requests for it."""

    parts: list[SubscribeRequest]
    removed: set[str]
    """The ids of tags that its subscriber has removed from what is stored."""
    is_changed: bool
    """Whether it is not as it is stored. Else its entries stay, whatever their size."""
    is_logged: bool = False
    """Whether its refusal is logged."""


class StoredSubscriptions(Placement):
    """Stores the subscriptions and states of the registry, and restores them after a start."""

    def __init__(self, prefix: str, registry: Registry, rules: Rules) -> None:
        self._prefix = prefix
        self._registry = registry
        self._profiles = rules.profiles
        self._defaults = {"timeout": rules.defaults.timeout, "release": False, "plan": None}
        """The `SETTINGS` of a device that no request has given."""
        self._dialect = rules.dialect
        self._changes = ChangesBeforeRead()
        self._pending: dict[SubscriptionKey, Pending] = {}
        self._has_read = False
        self._found_pending = asyncio.Event()
        self._store = EntryStore(prefix, self._entries, self._on_read)

    def connected(self, client: Client | None) -> None:
        """Sets the client; `None` while there is no connection."""
        self._store.connected(client)

    async def run(
        self, devices: DeviceControl, subscriptions: SubscriptionControl, ready: asyncio.Event, /
    ) -> None:
        """Restores and stores, until it is cancelled.

        `subscriptions` carries out stored requests; those from entries of another bucket are not
        stored. Sets `ready` after the first attempt to restore, or when it takes too long.
        """
        self._device_control, self._subscription_control = devices, subscriptions
        async with asyncio.TaskGroup() as running:
            running.create_task(self._store.run())
            running.create_task(self._restore(ready))

    async def close(self) -> None:
        """Removes the states of devices, which would be out of date. Then stores nothing."""
        with contextlib.suppress(Exception):  # JetStream is optional, and may fail in any way.
            await self._store.stop()

    def on_subscribed(
        self, device: ScannedDevice, subscription: Subscription, /, *, is_stored: bool
    ) -> None:
        """Stores a subscription that has changed, together with what is pending of it."""
        owner, given = subscription.key, subscription.given_settings
        replaces = self._dialect.replaces_subscription
        if not self._has_read:
            self._changes.requested(owner, given, replaces=replaces)
        if is_stored:
            return
        pending = self._pending.get(owner)
        if pending is None or replaces:
            self._touch(owner)
        else:
            more = device, subscription.subscriber, given, self._profiles
            self._change(owner, pending, with_later(pending.parts, *more))

    def on_state_changed(self, device: str) -> None:
        """Stores the state of a device; removes it if the device is gone."""
        self._store.touch(SubscriptionKey(device))

    def on_unsubscribed(self, request: UnsubscribeRequest) -> None:
        """Removes tags of a subscription, also of a pending one."""
        owner, ids = SubscriptionKey.of(request), request.ids
        if not self._has_read:
            self._changes.removed(owner, ids)
        pending = self._pending.get(owner)
        if pending is None or ids is None:
            self._touch(owner)
        else:
            removed = tag_ids(pending.parts, self._profiles).intersection(ids)
            pending.removed |= removed
            self._change(owner, pending, without(pending.parts, removed, self._profiles))

    def _change(
        self, owner: SubscriptionKey, pending: Pending, parts: list[SubscribeRequest]
    ) -> None:
        """Stores what a pending subscription has become. It is not pending without `parts`."""
        if not parts:
            self._touch(owner)
            return
        if parts != pending.parts:
            pending.parts, pending.is_changed = parts, True
        self._store.touch(owner)

    def take_over_refused(self, refused: SubscribeRequest, /) -> bool:
        """Makes a refused request of a former scanner pending. What is stored is older."""
        owner = SubscriptionKey.of(refused)
        if not self._has_read:
            given = [key for key in SETTINGS if getattr(refused, key) is not None]
            self._changes.requested(owner, given)
        # Parts as they are stored: some may be accepted alone.
        parts = [*map(restored, resized([refused], self._store.max_bytes))]
        pending = self._pending.get(owner)
        if pending is not None:  # Of several, the first one is the newest.
            parts = replaced_by(parts, pending.parts, self._profiles) or pending.parts
        elif self._is_known(owner):
            assert owner.subscriber is not None
            more = self._registry.devices[owner.device], owner.subscriber, SETTINGS
            parts = with_later(parts, *more, self._profiles)
        if parts:
            self._pending[owner] = Pending(parts, set(), is_changed=True)
            self._store.touch(owner)
        return True

    def handed_over(self, request: SubscribeRequest, /) -> SubscribeRequest:
        """Returns the request of a known subscription without defaults that no request has given.

        They would replace the stored settings, which are not read yet.
        """
        device = self._registry.devices[request.device_id]
        if self._has_read or len(device.subscribers) > 1:
            return request
        owner = SubscriptionKey.of(request)
        if self._changes.are_forgotten(owner):
            return request  # Which settings were given is not known.
        given = self._changes.of(owner).given
        not_given = {
            key: None
            for key in SETTINGS
            if key not in given and getattr(request, key) == self._defaults[key]
        }
        return msgspec.structs.replace(request, **not_given)

    def removals(self, known: Iterable[SubscriptionKey], /) -> Iterator[UnsubscribeRequest]:
        """Yields what to remove from stored subscriptions, for the next scanner of this process."""
        if not self._has_read:
            yield from self._changes.removals()
            return
        touched = {owner for owner in self._store.touched if owner.subscriber is not None}
        yield from super().removals((touched | {*known}) - self._pending.keys())
        for owner in touched & self._pending.keys():
            if removed := self._pending[owner].removed:  # The entries still have these tags.
                yield owner.removal(list(removed))

    async def wait_until_stored(
        self, subscription: SubscriptionKey, tags: Collection[str] = (), /
    ) -> str | None:
        """Waits until a changed subscription is stored; not while JetStream fails."""
        if not await self._store.wait_until_written(subscription):
            return None
        limit = self._store.max_bytes
        for value in (self._entries(subscription) or {}).values():
            # Too large is only an entry with a single tag.
            if len(value) > limit and restored(value).tags[0].id in tags:
                return f"an entry takes {len(value)} bytes, the server takes {limit}"
        return None

    def _touch(self, owner: SubscriptionKey) -> None:
        self._pending.pop(owner, None)
        self._store.touch(owner)

    def _entries(self, owner: SubscriptionKey) -> Mapping[str, bytes] | None:
        """Returns the entries of an owner: nothing, if it is gone; `None` if they stay."""
        if self._subscription_control.is_entry(owner):
            return {}
        if (pending := self._pending.get(owner)) is not None:
            if not pending.is_changed or self._is_displaced(owner):
                return None
            assert owner.subscriber is not None
            values = resized(pending.parts, self._store.max_bytes)
            return numbered(self._prefix, owner.device, owner.subscriber, values)
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
                if key.startswith(status_keys(self._prefix)):
                    owners[key] = SubscriptionKey(msgspec.json.decode(value, type=Status).device_id)
                    continue
                request = restored(value)
            except (Refused, *MALFORMED_JSON) as error:
                reason = malformed_text(error, value)
                log_lines.refused("kept_entry_malformed", kind="kept", key=key, reason=reason)
                continue
            owner = SubscriptionKey.of(request)
            found.setdefault(owner, []).append(request)
            is_ours = owner in self._store.touched or self._is_known(owner)
            # An owner that is returned replaces or removes what is stored under its keys.
            if is_ours or owner in self._pending or not self._has_read:
                owners[key] = owner
        if not self._has_read:
            for owner, parts in found.items():
                left = self._left(owner, parts)
                removed = self._changes.of(owner).removed
                if (pending := self._pending.get(owner)) is not None:
                    # A former scanner has handed it over, and it is newer.
                    given = self._changes.of(owner).given
                    kept = [key for key in SETTINGS if key not in given]
                    left = left and replaced_by(left, pending.parts, self._profiles, kept)
                    left = left or pending.parts
                    removed = tag_ids(parts, self._profiles) - tag_ids(left, self._profiles)
                if left:
                    self._pending[owner] = Pending(left, removed, left != parts)
            self._changes.clear()
            self._has_read = True
        for device in self._registry.devices.values():
            for name in (None, *device.subscribers):
                self._store.touch(SubscriptionKey(device.id, name))
        for owner in self._pending:
            self._store.touch(owner)
        if self._pending:
            self._found_pending.set()
        return owners

    def _left(
        self, owner: SubscriptionKey, parts: list[SubscribeRequest]
    ) -> list[SubscribeRequest]:
        """Returns what to carry out of stored requests, with the later ones of their subscriber."""
        changes = self._changes.of(owner)
        left = [] if changes.replaces else parts
        if changes.removed:
            left = without(left, changes.removed, self._profiles)
        if left and self._is_known(owner):
            assert owner.subscriber is not None
            device = self._registry.devices[owner.device]
            more = device, owner.subscriber, changes.given, self._profiles
            left = with_later(left, *more)
        return left

    def _is_known(self, owner: SubscriptionKey) -> bool:
        device = self._registry.devices.get(owner.device)
        return device is not None and owner.subscriber in device.subscribers

    def _is_displaced(self, owner: SubscriptionKey) -> bool:
        """Whether a known subscription has the keys of this one: that of another device id."""
        device = self._registry.named(subject_id(owner.device))
        if device is None or device.id == owner.device:
            return False
        return owner.subscriber in device.subscribers

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
        pending = [(owner, self._pending[owner]) for owner in owners if owner in self._pending]
        pending.sort(key=lambda each: (is_last(each[1].parts), not self._is_known(each[0])))
        for owner, each in pending:
            refused = await self._restore_one(owner)
            if refused is None or each.is_logged:
                continue
            each.is_logged = True
            await self._restore_parts(owner, each)
            log_lines.write(logging.WARNING, "not_restored", **owner.fields, reason=str(refused))
            if owner in self._pending:
                self._device_control.give_up(owner.device, str(refused))

    async def _restore_one(self, owner: SubscriptionKey) -> Refused | None:
        # Under the lock: a caller may change or end the subscription while this waits for it.
        async with self._device_control.lock(owner.device):
            if (pending := self._pending.get(owner)) is None:
                return None
            try:
                await self._subscription_control.restore(joined(pending.parts))
            except Refused as refused:
                return refused
            self._touch(owner)
            tags = sum(len(request.tags) for request in pending.parts)
            log_lines.write(logging.INFO, "restored", **owner.fields, tags=tags)
            return None

    async def _restore_parts(self, owner: SubscriptionKey, pending: Pending) -> None:
        """Carries out the parts of a refused subscription that are not refused alone.

        Before the restart, they may have been carried out by later requests.
        """
        parts = pending.parts
        if len(parts) < 2 or self._is_known(owner):
            return
        for part in parts:
            # Each under the lock: requests must not wait for the lookups of all.
            async with self._device_control.lock(owner.device):
                if self._pending.get(owner) is not pending or pending.parts is not parts:
                    return  # A caller has changed or ended it.
                # Without its profile, which would add the tags of other parts.
                with contextlib.suppress(Refused):
                    await self._subscription_control.restore(
                        with_profile(part, None, self._profiles)
                    )
