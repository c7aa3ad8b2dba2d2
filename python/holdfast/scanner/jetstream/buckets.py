"""The buckets of JetStream that the programs of a dialect write for the scanner."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Protocol

from holdfast.scanner.errors import Refused
from holdfast.scanner.jetstream.enabled_key import EnabledKey
from holdfast.scanner.jetstream.entry_subscriptions import EntryHost, EntrySubscriptions

if TYPE_CHECKING:
    from collections.abc import Sequence

    from nats.aio.client import Client

    from holdfast.scanner.jetstream.entry_subscriptions import RefusedEntry
    from holdfast.scanner.jetstream.key_watch import WatchTimes


class BucketHost(EntryHost, Protocol):
    """Carries out what programs write."""

    def enable(self, is_enabled: bool) -> None:
        """Polls devices, or stops polling them."""


class Buckets(Protocol):
    """What programs have written."""

    @property
    def is_enabled(self) -> bool | None:
        """Whether devices are polled; `None` if no program can change it."""

    @property
    def refused(self) -> Sequence[RefusedEntry]:
        """The refused entries of the bucket of subscriptions, by key."""

    def key_of(self, device: str, subscriber: str | None) -> str | None:
        """Returns the key of the entry that a subscription is from; `None` if it is from none."""

    def check_not_entry(self, device: str, subscriber: str) -> None:
        """Raises `Refused` for a subscription that is from an entry."""

    def connected(self, client: Client | None) -> None:
        """Sets the client; `None` while there is no connection."""

    async def read(self) -> None:
        """Waits until the buckets are read for the first time, but not for long."""

    async def run(self, host: BucketHost) -> None:
        """Has `host` carry out what is written, until it is cancelled."""


class NoBuckets:
    """Those of tentacle-modbus, which had none, see `Buckets`."""

    is_enabled = None
    refused: Sequence[RefusedEntry] = ()

    def key_of(self, *_: object) -> None:
        """Returns nothing: all subscriptions are from requests."""

    def check_not_entry(self, device: str, subscriber: str) -> None:
        """Raises nothing: all subscriptions are from requests."""

    def connected(self, client: Client | None) -> None:
        """Has nothing to read."""

    async def read(self) -> None:
        """Has nothing to wait for."""

    async def run(self, _host: BucketHost, /) -> None:
        """Waits until it is cancelled."""
        await asyncio.Event().wait()


class TentacleNextBuckets:
    """Those of tentacle-next, see `Buckets`."""

    def __init__(self, prefix: str, times: WatchTimes) -> None:
        self._entries = EntrySubscriptions(prefix, times)
        self._enabled_key = EnabledKey(prefix, times)

    @property
    def is_enabled(self) -> bool:
        """Whether devices are polled."""
        return self._enabled_key.enabled

    @property
    def refused(self) -> Sequence[RefusedEntry]:
        """The refused entries, by key."""
        return self._entries.refused

    def key_of(self, device: str, subscriber: str | None) -> str | None:
        """Returns the key of the entry that a subscription is from; `None` if it is from none."""
        return self._entries.key_of(device, subscriber)

    def check_not_entry(self, device: str, subscriber: str) -> None:
        """Raises `Refused` for a subscription that is from an entry."""
        key = self._entries.key_of(device, subscriber)
        if key is not None:
            raise Refused(
                f"the subscription of {subscriber!r} to {device!r} is the entry {key!r} of the "
                f"bucket {self._entries.bucket}: change that entry"
            )

    def connected(self, client: Client | None) -> None:
        """Sets the client; `None` while there is no connection."""
        self._enabled_key.connected(client)
        self._entries.connected(client)

    async def read(self) -> None:
        """Waits until both buckets are read for the first time, but not for long."""
        await self._enabled_key.read()
        await self._entries.read()

    async def run(self, host: BucketHost) -> None:
        """Has `host` carry out what is written, until it is cancelled."""
        host.enable(False)  # Until it is known that the scanner is enabled.
        async with asyncio.TaskGroup() as running:
            running.create_task(self._entries.run(host))
            running.create_task(self._enabled_key.run(host.enable))
