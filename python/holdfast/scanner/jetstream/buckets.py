"""The buckets of JetStream that the programs of a dialect write for the scanner.

One has the entries of subscriptions, the other a key that says whether the scanner is enabled.
Without JetStream, and without the key, it is.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Protocol

import msgspec

from holdfast.events import log_lines
from holdfast.runtime.malformed_json import MALFORMED_JSON, malformed_text
from holdfast.scanner.errors import Refused
from holdfast.scanner.jetstream.entry_subscriptions import EntryControl, EntrySubscriptions
from holdfast.scanner.jetstream.key_watch import KeyWatch

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from nats.aio.client import Client

    from holdfast.scanner.jetstream.entry_subscriptions import RefusedEntry
    from holdfast.scanner.jetstream.key_watch import WatchTimes, Written
    from holdfast.scanner.subscriptions.key import SubscriptionKey

BUCKET = "service_enabled"


class _State(msgspec.Struct):
    enabled: bool


class EnabledKey:
    """Follows the key of the scanner."""

    def __init__(self, key: str, times: WatchTimes) -> None:
        self._key = key
        self.watch = KeyWatch(BUCKET, key, self._on_change, times)
        self._last_reported: bool | None = None
        self.enabled = True

    async def run(self, enable: Callable[[bool], None]) -> None:
        """Calls `enable` with the first state and each new one, until it is cancelled."""
        self._enable = enable
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self.watch.run())
            tasks.create_task(self._report_first())

    async def _report_first(self) -> None:
        """Enables the scanner if there is no key, or it can't be read."""
        await self.watch.tried.wait()
        self._report()

    async def _on_change(self, found: Mapping[str, Written | None]) -> None:
        """Takes the state; a malformed one changes nothing."""
        if self._key not in found:
            return
        written = found[self._key]
        value = b"" if written is None else written.value
        try:
            enabled = written is None or msgspec.json.decode(value, type=_State).enabled
        except MALFORMED_JSON as error:
            reason = malformed_text(error, value)
            log_lines.refused(
                "enabled_entry_malformed", kind="enabled", key=self._key, reason=reason
            )
            return
        if enabled != self.enabled:
            self.enabled = enabled
            level = logging.INFO if enabled else logging.WARNING
            log_lines.write(
                level, "scanner_enabled" if enabled else "scanner_disabled", key=self._key
            )
        self._report()

    def _report(self) -> None:
        if self._last_reported is not self.enabled:
            self._last_reported = self.enabled
            self._enable(self.enabled)


class BucketControl(EntryControl, Protocol):
    """Carries out what programs write."""

    def enable(self, is_enabled: bool) -> None:
        """Polls devices, or stops polling them."""


class Buckets:
    """What programs have written: nothing with tentacle-modbus, which had no such buckets."""

    @property
    def is_enabled(self) -> bool | None:
        """Whether devices are polled; `None` if no program can change it."""
        return None

    @property
    def refused(self) -> Sequence[RefusedEntry]:
        """The refused entries of the bucket of subscriptions, by key."""
        return ()

    def key_of(self, _subscription: SubscriptionKey, /) -> str | None:
        """Returns the key of the entry that a subscription is from; `None` if it is from none."""
        return None

    def check_not_entry(self, subscription: SubscriptionKey) -> None:
        """Raises `Refused` for a subscription that is from an entry."""

    def connected(self, client: Client | None) -> None:
        """Sets the client; `None` while there is no connection."""

    async def read(self) -> None:
        """Waits until the buckets are read for the first time, but not for long."""

    async def run(self, _control: BucketControl, /) -> None:
        """Has `control` carry out what is written, until it is cancelled."""
        await asyncio.Event().wait()


class TentacleNextBuckets(Buckets):
    """Those of tentacle-next."""

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

    def key_of(self, subscription: SubscriptionKey, /) -> str | None:
        """Returns the key of the entry that a subscription is from; `None` if it is from none."""
        return self._entries.key_of(subscription)

    def check_not_entry(self, subscription: SubscriptionKey) -> None:
        """Raises `Refused` for a subscription that is from an entry."""
        if (key := self.key_of(subscription)) is not None:
            of = f"the subscription of {subscription.subscriber!r} to {subscription.device!r}"
            at = f"the entry {key!r} of the bucket {self._entries.bucket}"
            raise Refused(f"{of} is {at}: change that entry")

    def connected(self, client: Client | None) -> None:
        """Sets the client; `None` while there is no connection."""
        self._enabled_key.watch.connected(client)
        self._entries.watch.connected(client)

    async def read(self) -> None:
        """Waits until both buckets are read for the first time, but not for long."""
        await self._enabled_key.watch.read()
        await self._entries.watch.read()

    async def run(self, control: BucketControl, /) -> None:
        """Has `control` carry out what is written, until it is cancelled."""
        control.enable(False)  # Until it is known that the scanner is enabled.
        async with asyncio.TaskGroup() as running:
            running.create_task(self._entries.run(control))
            running.create_task(self._enabled_key.run(control.enable))
