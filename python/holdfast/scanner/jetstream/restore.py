"""What is kept in JetStream: subscriptions and states of devices, and how they are restored."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

import msgspec

from holdfast import logs
from holdfast.scanner.errors import Refused
from holdfast.scanner.jetstream.entries import (
    number,
    numbered,
    requests,
    restored,
    status_key,
    without,
)
from holdfast.scanner.jetstream.store import RETRIED, Keeper, Unit
from holdfast.scanner.messages.types import Status

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from holdfast.scanner.messages.types import SubscribeRequest, UnsubscribeRequest
    from holdfast.scanner.subscriptions.registry import Registry

RESTORING = 2.0
"""Seconds that requests wait for the restoration. It goes on after that."""


class Kept:
    """Connects the registry with the keeper."""

    def __init__(
        self,
        prefix: str,
        registry: Registry,
        subscribe: Callable[[SubscribeRequest], Awaitable[None]],
        is_kept_elsewhere: Callable[[Unit], bool],
    ) -> None:
        """`subscribe` carries out a kept request, or raises `Refused`.

        A unit that is kept elsewhere is not stored.
        """
        self._prefix = prefix
        self._registry = registry
        self._subscribe = subscribe
        self._is_kept_elsewhere = is_kept_elsewhere
        self._pending: dict[Unit, list[SubscribeRequest]] = {}
        """Kept requests that are not carried out yet."""
        self._logged: set[Unit] = set()
        """Pending units whose refusal is logged."""
        self._read = False
        self._found_pending = asyncio.Event()
        self.keeper = Keeper(prefix, self._entries, self._found)

    def changed(self, device: str, subscriber: str) -> None:
        """Stores a subscription that has changed, instead of what is pending."""
        self._touch(Unit(device, subscriber))

    def state_changed(self, device: str) -> None:
        """Stores the state of a device; removes it if the device is gone."""
        self.keeper.touch(Unit(device))

    def unsubscribed(self, request: UnsubscribeRequest) -> None:
        """Removes tags of a subscription, also of a pending one."""
        unit = Unit(request.device_id, request.subscriber_id)
        ids = request.ids
        left = [] if ids is None else without(self._pending.get(unit, []), set(ids))
        self._touch(unit)
        if left:
            self._pending[unit] = left

    async def settled(self, device: str, subscriber: str) -> None:
        """Waits until a changed subscription is stored; not while JetStream fails."""
        await self.keeper.settled(Unit(device, subscriber))

    def _touch(self, unit: Unit) -> None:
        self._pending.pop(unit, None)
        self._logged.discard(unit)
        self.keeper.touch(unit)

    def _entries(self, unit: Unit) -> Mapping[str, bytes]:
        """Returns what is to be stored for a unit."""
        if self._is_kept_elsewhere(unit):
            return {}
        if unit in self._pending:
            assert unit.subscriber is not None
            pending = map(msgspec.json.encode, self._pending[unit])
            return numbered(self._prefix, unit.device, unit.subscriber, pending)
        device = self._registry.devices.get(unit.device)
        if device is None:
            return {}
        if unit.subscriber is None:
            return {status_key(self._prefix, device.id): device.status}
        if unit.subscriber not in device.subscribers:
            return {}
        values = requests(device, unit.subscriber)
        return numbered(self._prefix, device.id, unit.subscriber, values)

    def _found(self, entries: list[tuple[str, bytes]]) -> Mapping[str, Unit]:
        """Takes the stored entries. At the first time, their subscriptions become pending.

        Everything known is compared with them again: the bucket may have been lost.
        Later, subscriptions that are not known here are left alone: another scanner may have stored
        them.
        """
        units: dict[str, Unit] = {}
        for key, value in sorted(entries, key=lambda entry: number(entry[0])):
            try:
                if key.startswith(f"{self._prefix}.status."):
                    units[key] = Unit(msgspec.json.decode(value, type=Status).device_id)
                    continue
                request = restored(value)
            except (Refused, msgspec.DecodeError) as error:
                logs.refused("kept_entry_malformed", kind="kept", key=key, reason=str(error))
                continue
            unit = Unit(request.device_id, request.subscriber_id)
            is_ours = unit in self.keeper.touched or self._is_known(unit)
            if not self._read and not is_ours:
                self._pending.setdefault(unit, []).append(request)
            if is_ours or unit in self._pending:
                units[key] = unit
        self._read = True
        for device in self._registry.devices.values():
            for name in (None, *device.subscribers):
                self.keeper.touch(Unit(device.id, name))
        if self._pending:
            self._found_pending.set()
        return units

    def _is_known(self, unit: Unit) -> bool:
        device = self._registry.devices.get(unit.device)
        return device is not None and unit.subscriber in device.subscribers

    async def restore(self, ready: asyncio.Event) -> None:
        """Carries out pending requests, until it is cancelled.

        Sets `ready` after the first attempt, or when it takes too long.
        """
        await self.keeper.tried.wait()
        while True:
            work = asyncio.create_task(self._restore_all())
            try:
                await asyncio.wait([work], timeout=None if ready.is_set() else RESTORING)
                ready.set()
                await work
            finally:
                work.cancel()
            if self._pending:
                await asyncio.sleep(RETRIED)
            else:
                self._found_pending.clear()
                await self._found_pending.wait()

    async def _restore_all(self) -> None:
        devices: dict[str, list[Unit]] = {}
        for unit in self._pending:
            devices.setdefault(unit.device, []).append(unit)
        await asyncio.gather(*map(self._restore_device, devices.values()))

    async def _restore_device(self, units: list[Unit]) -> None:
        for unit in units:
            found = self._pending.get(unit, [])
            try:
                for request in found:
                    if self._pending.get(unit) is not found:
                        break  # A caller has changed it.
                    await self._subscribe(request)
            except Refused as refused:
                if unit not in self._logged:
                    self._logged.add(unit)
                    self._log(logging.WARNING, "not_restored", unit, reason=str(refused))
                continue
            if found and self._pending.get(unit) is found:
                self._touch(unit)
                tags = sum(len(request.tags) for request in found)
                self._log(logging.INFO, "restored", unit, tags=tags)

    @staticmethod
    def _log(level: int, event: str, unit: Unit, **more: object) -> None:
        logs.write(level, event, device=unit.device, subscriber=unit.subscriber, **more)
