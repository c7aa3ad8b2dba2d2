"""Subscriptions from the entries of a JetStream bucket, as programs of tentacle-next write them.

The key of an entry is `SUBSCRIBER.DEVICE`. Its value is the whole subscription, which ends when the
entry is deleted. An entry that is refused ends the subscription of its former value, which is out
of date. It is logged once, shown to callers, and tried again: what refuses it, such as an
unknown name or another subscriber, may end.
"""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass, field
from enum import Enum
from hashlib import blake2b
from typing import TYPE_CHECKING, Any, Protocol

import msgspec

from holdfast import logs
from holdfast.scanner.errors import Refused
from holdfast.scanner.jetstream.key_watch import KeyWatch
from holdfast.scanner.subscriptions.key import SubscriptionKey

if TYPE_CHECKING:
    from collections.abc import Container, Iterable, Mapping

    from nats.aio.client import Client

    from holdfast.scanner.jetstream.key_watch import WatchTimes, Written
    from holdfast.scanner.messages.types import SubscribeRequest
    from holdfast.scanner.subscriptions.subscription import Subscription

BUCKET = "scanner_config_"
"""The name of the bucket, before the prefix of all subjects."""

MAX_ENTRIES = 50_000
"""Limit of entries; further ones are ignored."""

MAX_HELD_BYTES = 64 * 1024 * 1024
"""Limit of the values of refused entries that are kept to try them again."""


class Outcome(Enum):
    """What has become of an entry."""

    CARRIED_OUT = "its subscription is that of its value"
    REFUSED = "refused; nothing has changed"
    ENDED = "refused; the subscription of its former value has ended"


@dataclass
class Entry:
    """An entry of the bucket."""

    written: tuple[int, bytes] | None = None
    """The revision and a digest of the value that was carried out or refused last."""
    subscription: SubscriptionKey | None = None
    """Its subscription; `None` if it is refused."""
    refused: RefusedEntry | None = None


@dataclass
class RefusedEntry:
    """Why an entry is refused, and what it is about, as far as its value can be read."""

    key: str
    reason: str
    written: Written | None
    """`None` if it is not kept to try it again."""
    device: str | None = None
    tags: list[str] = field(default_factory=list)


class EntryHost(Protocol):
    """Carries out the entries of the bucket."""

    def check_entry(self, key: str, value: bytes) -> Subscription:
        """Returns the subscription of an entry. Raises `Refused`."""

    async def carry_out_entry(self, asked: Subscription) -> None:
        """Makes a subscription that of the entry. Raises `Refused`."""

    async def end_entry(self, key: SubscriptionKey) -> None:
        """Ends the subscription of an entry."""


class EntrySubscriptions:
    """Carries out the entries of the bucket."""

    def __init__(self, prefix: str, times: WatchTimes) -> None:
        self.bucket = BUCKET + prefix
        self._retry_s = times.retry_s
        self._watch = KeyWatch(self.bucket, ">", self._on_change, times)
        self._entries: dict[str, Entry] = {}
        self._keys: dict[SubscriptionKey, str] = {}
        self._lock = asyncio.Lock()
        """Held while entries are carried out."""
        self._held_bytes = 0
        self._has_logged_limit = False

    def connected(self, client: Client | None) -> None:
        """Sets the client; `None` while there is no connection."""
        self._watch.connected(client)

    @property
    def refused(self) -> list[RefusedEntry]:
        """The refused entries, by key."""
        found = (entry.refused for _, entry in sorted(self._entries.items()))
        return [refused for refused in found if refused is not None]

    def key_of(self, device: str, subscriber: str | None) -> str | None:
        """Returns the key of the entry that a subscription is from; `None` if it is from none."""
        return None if subscriber is None else self._keys.get(SubscriptionKey(device, subscriber))

    async def read(self) -> None:
        """Waits until the entries are read for the first time, but not for long."""
        await self._watch.read()

    async def run(self, host: EntryHost) -> None:
        """Has `host` carry out the entries, until it is cancelled."""
        self._host = host
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._watch.run())
            tasks.create_task(self._try_again())

    async def _on_change(self, found: Mapping[str, Written | None], is_all: bool) -> None:
        """Carries out changed entries; with `is_all`, ends those that are not there any more."""
        async with self._lock:
            gone = [key for key in self._entries if key not in found] if is_all else []
            gone += [key for key, written in found.items() if written is None]
            for key in gone:
                await self._forget(key)
            wanted = []
            for key, written in found.items():
                if written is not None and self._is_new(key, written):
                    wanted.append((key, written))
            await self._carry_out(wanted)
            if gone or wanted:  # One of these may have been why others were refused.
                await self._carry_out(self._refused_entries(but={key for key, _ in wanted}))

    def _is_new(self, key: str, written: Written) -> bool:
        """Returns whether an entry is to be carried out; adds it if it is new.

        An entry that is only read again, and not written again, is known.
        """
        entry = self._entries.get(key)
        if entry is None:
            if len(self._entries) >= MAX_ENTRIES:
                if not self._has_logged_limit:
                    self._has_logged_limit = True
                    logs.write(logging.WARNING, "too_many_entries", bucket=self.bucket, key=key)
                return False
            self._entries[key] = Entry()
            return True
        # After a reconnect, all entries are read again.
        return entry.written != _identity(written)

    async def _forget(self, key: str) -> None:
        entry = self._entries.pop(key, None)
        if entry is not None:
            self._set_refused(entry, None)
            await self._release(entry)

    async def _release(self, entry: Entry) -> None:
        """Ends the subscription of an entry."""
        subscription, entry.subscription = entry.subscription, None
        if subscription is not None:
            del self._keys[subscription]
            await self._host.end_entry(subscription)

    async def _try_again(self) -> None:
        while True:
            await asyncio.sleep(self._retry_s)
            async with self._lock:
                await self._carry_out(self._refused_entries())

    def _refused_entries(self, but: Container[str] = ()) -> list[tuple[str, Written]]:
        """Returns the refused entries whose values are kept."""
        refused = (entry.refused for entry in self._entries.values())
        return [
            (each.key, each.written)
            for each in refused
            if each is not None and each.written is not None and each.key not in but
        ]

    async def _carry_out(self, wanted: Iterable[tuple[str, Written]]) -> None:
        """Carries out entries. Refused ones are tried once more if a subscription has ended.

        It may have been why another entry was refused, as when two entries exchange their devices.
        """
        refused = await self._carry_out_once(wanted)
        if any(outcome is Outcome.ENDED for _, _, outcome in refused):
            await self._carry_out_once((key, written) for key, written, _ in refused)

    async def _carry_out_once(
        self, wanted: Iterable[tuple[str, Written]]
    ) -> list[tuple[str, Written, Outcome]]:
        """Carries out entries concurrently. Returns the refused ones."""
        pairs = list(wanted)
        outcomes = await asyncio.gather(
            *(self._carry_out_one(key, written) for key, written in pairs)
        )
        return [
            (key, written, outcome)
            for (key, written), outcome in zip(pairs, outcomes, strict=True)
            if outcome is not Outcome.CARRIED_OUT
        ]

    async def _carry_out_one(self, key: str, written: Written) -> Outcome:
        entry = self._entries[key]
        had_subscription = entry.subscription is not None
        try:
            asked = self._host.check_entry(key, written.value)
            subscription = SubscriptionKey(asked.device, asked.subscriber)
            if entry.subscription not in (None, subscription):
                await self._release(entry)
            entry.subscription = subscription
            self._keys[subscription] = key
            await self._host.carry_out_entry(asked)
        except Refused as refused:
            reason = str(refused)
        except Exception as error:  # An error in one entry must not affect the others.
            logs.problem("entry_failed", key=key)
            reason = f"internal error: {type(error).__name__}"
        else:
            self._set_refused(entry, None)
            entry.written = _identity(written)
            return Outcome.CARRIED_OUT
        await self._refuse(key, written, reason, had_subscription=had_subscription)
        return Outcome.ENDED if had_subscription else Outcome.REFUSED

    async def _refuse(
        self, key: str, written: Written, reason: str, *, had_subscription: bool
    ) -> None:
        """Refuses an entry. A subscription that its subscriber has by request stays."""
        entry = self._entries[key]
        if had_subscription:
            await self._release(entry)
        elif entry.subscription is not None:  # What was refused has changed nothing.
            del self._keys[entry.subscription]
            entry.subscription = None
        before = entry.refused
        self._set_refused(entry, None)
        kept = written if self._held_bytes + len(written.value) <= MAX_HELD_BYTES else None
        self._set_refused(entry, RefusedEntry(key, reason, kept, *_subject_of(written.value)))
        entry.written = _identity(written)
        if before is None or before.reason != reason:
            logs.write(logging.WARNING, "entry_refused", bucket=self.bucket, key=key, reason=reason)

    def _set_refused(self, entry: Entry, refused: RefusedEntry | None) -> None:
        for each, sign in ((entry.refused, -1), (refused, 1)):
            if each is not None and each.written is not None:
                self._held_bytes += sign * len(each.written.value)
        entry.refused = refused


def check_entry(key: str, request: SubscribeRequest) -> None:
    """Checks what only entries of the bucket must fulfil. Raises `Refused`."""
    named = f"{request.subscriber_id}.{request.device_id}"
    if key != named:
        raise Refused(f"the key is {key!r}, allowed: SUBSCRIBER.DEVICE of its value: {named!r}")
    if request.ttl is not None:
        raise Refused("ttl is given; an entry lasts until it is deleted")


def _identity(written: Written) -> tuple[int, bytes]:
    """Returns what identifies a value of a key, also when the bucket is replaced."""
    return written.revision, blake2b(written.value, digest_size=16).digest()


def _subject_of(value: bytes) -> tuple[str | None, list[str]]:
    """Returns the device and the tags of a refused value, as far as it can be read."""
    try:
        found = msgspec.json.decode(value)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None, []
    device = _text_value(found, "deviceId")
    tags = found.get("tags") if type(found) is dict else None
    ids = [_text_value(tag, "id") for tag in tags] if type(tags) is list else []
    return device, [] if device is None else list(dict.fromkeys(filter(None, ids)))


def _text_value(found: Any, key: str) -> str | None:
    value = found.get(key) if type(found) is dict else None
    return value if type(value) is str else None
