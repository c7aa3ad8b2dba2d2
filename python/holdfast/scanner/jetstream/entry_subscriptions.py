"""Subscriptions from the entries of a JetStream bucket, which programs of tentacle-next write.

The key of an entry is `SUBSCRIBER.DEVICE`. Its value is the whole subscription, which ends when the
entry is deleted. If a new value is refused, the subscription of the former value ends, because that
value is out of date. A refusal is logged once, is in the reports to callers, and the entry is tried
again: its cause, such as an unknown host name or another subscriber, may be temporary.
"""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass, field
from enum import Enum
from hashlib import blake2b
from typing import TYPE_CHECKING, Any, Protocol

import msgspec

from holdfast.events import log_lines
from holdfast.runtime.malformed_json import MALFORMED_JSON
from holdfast.scanner.errors import Refused
from holdfast.scanner.jetstream.key_watch import KeyWatch

if TYPE_CHECKING:
    from collections.abc import Container, Iterable, Mapping

    from holdfast.scanner.jetstream.key_watch import WatchTimes, Written
    from holdfast.scanner.messages.types import SubscribeRequest
    from holdfast.scanner.subscriptions.key import SubscriptionKey
    from holdfast.scanner.subscriptions.subscription import Subscription

BUCKET = "scanner_config_"
"""The name of the bucket, before the prefix of all subjects."""

MAX_ENTRIES = 50_000
"""Limit of entries; further ones are ignored."""

MAX_HELD_BYTES = 64 * 1024 * 1024
"""Limit of the total size of refused values that are kept to try them again."""


class Outcome(Enum):
    """The result of carrying out an entry."""

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
    """Why an entry is refused, with its device and tags if its value can be decoded."""

    key: str
    reason: str
    written: Written | None
    """The refused value; `None` if it is too large to be kept for another attempt."""
    device: str | None = None
    tags: list[str] = field(default_factory=list)


class EntryControl(Protocol):
    """Carries out the entries of the bucket."""

    def check_entry(self, key: str, value: bytes) -> Subscription:
        """Returns the subscription of an entry. Raises `Refused`."""

    async def carry_out_entry(self, subscription: Subscription) -> None:
        """Replaces the subscription of an entry. Raises `Refused`."""

    async def end_entry(self, key: SubscriptionKey) -> None:
        """Ends the subscription of an entry."""


class EntrySubscriptions:
    """Carries out the entries of the bucket."""

    def __init__(self, prefix: str, times: WatchTimes) -> None:
        self.bucket = BUCKET + prefix
        self._retry_s = times.retry_s
        self.watch = KeyWatch(self.bucket, ">", self._on_change, times)
        self._entries: dict[str, Entry] = {}
        self._keys: dict[SubscriptionKey, str] = {}
        self._lock = asyncio.Lock()
        """Held while entries are carried out."""
        self._held_bytes = 0
        self._has_logged_limit = False

    @property
    def refused(self) -> list[RefusedEntry]:
        """The refused entries, by key."""
        refused_entries = (entry.refused for _, entry in sorted(self._entries.items()))
        return [refused for refused in refused_entries if refused is not None]

    def key_of(self, subscription: SubscriptionKey) -> str | None:
        """Returns the key of the entry that a subscription is from; `None` if it is from none."""
        return self._keys.get(subscription)

    async def run(self, control: EntryControl) -> None:
        """Has `control` carry out the entries, until it is cancelled."""
        self._control = control
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self.watch.run())
            tasks.create_task(self._try_again())

    async def _on_change(self, changes: Mapping[str, Written | None]) -> None:
        """Carries out changed entries, and ends those that are deleted."""
        async with self._lock:
            deleted = [key for key, written in changes.items() if written is None]
            for key in deleted:
                await self._forget(key)
            changed = []
            for key, written in changes.items():
                if written is not None and self._is_new(key, written):
                    changed.append((key, written))
            await self._carry_out(changed)
            if deleted or changed:  # A change can remove the cause of an earlier refusal.
                await self._carry_out(self._refused_entries(excluded={key for key, _ in changed}))

    def _is_new(self, key: str, written: Written) -> bool:
        """Returns whether an entry is to be carried out; adds it if it is new.

        An entry that is only read again, and not written again, is known.
        """
        entry = self._entries.get(key)
        if entry is None:
            if len(self._entries) >= MAX_ENTRIES:
                if not self._has_logged_limit:
                    self._has_logged_limit = True
                    log_lines.write(
                        logging.WARNING, "too_many_entries", bucket=self.bucket, key=key
                    )
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
            await self._control.end_entry(subscription)

    async def _try_again(self) -> None:
        while True:
            await asyncio.sleep(self._retry_s)
            async with self._lock:
                await self._carry_out(self._refused_entries())

    def _refused_entries(self, excluded: Container[str] = ()) -> list[tuple[str, Written]]:
        """Returns the refused entries whose values are kept."""
        refused_entries = (entry.refused for entry in self._entries.values())
        return [
            (refused.key, refused.written)
            for refused in refused_entries
            if refused is not None and refused.written is not None and refused.key not in excluded
        ]

    async def _carry_out(self, entries: Iterable[tuple[str, Written]]) -> None:
        """Carries out entries. Refused ones are tried once more if a subscription has ended.

        The ended subscription can be the cause of a refusal: two entries that exchange their
        devices each refuse the other until one has ended.
        """
        refused = await self._carry_out_once(entries)
        if any(outcome is Outcome.ENDED for _, _, outcome in refused):
            await self._carry_out_once((key, written) for key, written, _ in refused)

    async def _carry_out_once(
        self, entries: Iterable[tuple[str, Written]]
    ) -> list[tuple[str, Written, Outcome]]:
        """Carries out entries concurrently. Returns the refused ones."""
        pairs = list(entries)
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
            subscription = self._control.check_entry(key, written.value)
            if entry.subscription not in (None, subscription.key):
                await self._release(entry)
            entry.subscription = subscription.key
            self._keys[subscription.key] = key
            await self._control.carry_out_entry(subscription)
        except Refused as refused:
            reason = str(refused)
        except Exception as error:  # An error in one entry must not affect the others.
            log_lines.problem("entry_failed", key=key)
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
        elif entry.subscription is not None:  # The refused request has changed nothing.
            del self._keys[entry.subscription]
            entry.subscription = None
        # Release the former value first, so that it does not count against the limit.
        before = entry.refused
        self._set_refused(entry, None)
        kept_value = written if self._held_bytes + len(written.value) <= MAX_HELD_BYTES else None
        self._set_refused(entry, RefusedEntry(key, reason, kept_value, *_subject_of(written.value)))
        entry.written = _identity(written)
        if before is None or before.reason != reason:
            log_lines.write(
                logging.WARNING, "entry_refused", bucket=self.bucket, key=key, reason=reason
            )

    def _set_refused(self, entry: Entry, refused: RefusedEntry | None) -> None:
        for record, sign in ((entry.refused, -1), (refused, 1)):
            if record is not None and record.written is not None:
                self._held_bytes += sign * len(record.written.value)
        entry.refused = refused


def check_entry(key: str, request: SubscribeRequest) -> None:
    """Checks the rules that apply to entries but not to requests. Raises `Refused`."""
    named = f"{request.subscriber_id}.{request.device_id}"
    if key != named:
        raise Refused(f"the key is {key!r}, allowed: SUBSCRIBER.DEVICE of its value: {named!r}")
    if request.ttl is not None:
        raise Refused("ttl is given; an entry lasts until it is deleted")


def _identity(written: Written) -> tuple[int, bytes]:
    """Returns what identifies a value of a key.

    A revision is not enough: a bucket that was deleted and created anew counts from 1 again.
    """
    return written.revision, blake2b(written.value, digest_size=16).digest()


def _subject_of(value: bytes) -> tuple[str | None, list[str]]:
    """Returns the device and the tags of a refused value, as far as it can be read."""
    try:
        decoded = msgspec.json.decode(value)
    except MALFORMED_JSON:
        return None, []
    device = _text_value(decoded, "deviceId")
    tags = decoded.get("tags") if type(decoded) is dict else None
    ids = [_text_value(tag, "id") for tag in tags] if type(tags) is list else []
    return device, [] if device is None else list(dict.fromkeys(filter(None, ids)))


def _text_value(decoded: Any, key: str) -> str | None:
    value = decoded.get(key) if type(decoded) is dict else None
    return value if type(value) is str else None
