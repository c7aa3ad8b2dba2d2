"""Queues messages for NATS. While NATS is slow or disconnected, it keeps only the newest of a tag.

As long as the server accepts messages, they are sent in order. Otherwise each message replaces the
older one of the same tag, and the number of kept messages is limited. So the scanner neither blocks
nor grows, and after a reconnect the server gets the current values.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import OrderedDict
from dataclasses import KW_ONLY, dataclass
from typing import TYPE_CHECKING

from nats.errors import Error

from holdfast.events import log_lines
from holdfast.net.nats import batch

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from holdfast.net.nats.tolerant_client import SafeClient

MAX_BACKLOG_BYTES = 2 * 1024 * 1024
"""Unsent bytes above which the connection counts as slow."""

MAX_BATCH_BYTES = 512 * 1024
"""Bytes of kept messages that are sent at once. The others can still be replaced."""

MAX_KEPT_MESSAGES = 200_000
"""Limit of kept messages."""

USUAL_MAX_PAYLOAD_BYTES = 2**20
"""The size limit of messages, before a server sends its own."""

MAX_REMEMBERED = 10_000
"""Limit of remembered messages that were too large."""

CHECK_INTERVAL_S = 0.005
"""Time between checks whether a slow connection accepts more."""


@dataclass(eq=False)
class Outbox:
    """The queue of messages for NATS."""

    max_kept: int = MAX_KEPT_MESSAGES
    _: KW_ONLY
    may_send: Callable[[], bool] = lambda: True
    """Asked before each sending. While it returns false, messages are dropped."""
    on_drop: Callable[[], None] = lambda: None
    """Called when messages are dropped."""
    at_once: bool = False
    """Whether nothing waits in this process after a sending."""

    def __post_init__(self) -> None:
        self._client: SafeClient | None = None
        self._queue: list[bytes] = []
        self._queue_bytes = 0
        self._kept: OrderedDict[tuple[object, object], bytes] = OrderedDict()
        self._too_large: set[tuple[object, object]] = set()
        """Messages of which it is logged that they are too large."""
        self._has_messages = asyncio.Event()
        self.sent = 0
        """Messages sent to the connection."""
        self.replaced = 0
        """Messages that a newer one of the same tag replaced."""
        self.dropped = 0
        """Messages lost: too many waited, or this node may not publish any more."""

    def connected(self, client: SafeClient | None) -> None:
        """Sets the client for further messages; `None` while there is no connection."""
        self._client = client
        self._has_messages.set()

    @property
    def max_payload(self) -> int:
        """The size limit of messages in bytes. The server ends a connection with a larger one."""
        return USUAL_MAX_PAYLOAD_BYTES if self._client is None else self._client.max_payload

    @property
    def max_answer(self) -> int:
        """The size limit of the payload of an answer."""
        return self.max_payload - len(batch.ANSWER_HEADER)

    def put(self, messages: Collection[tuple[object, bytes]], of: object = None) -> None:
        """Adds messages `of` a device, each with a key such as its tag; a newer one replaces it.

        Messages that are larger than the server allows are dropped, and logged once.
        """
        if self._kept or self._queue_bytes > MAX_BACKLOG_BYTES or not self._accepts():
            for key, text in messages:
                self._keep((of, key), text)
        else:
            texts = [text for _, text in messages]
            size, most = sum(map(len, texts)), self.max_payload
            if size > most and max(map(len, texts)) > most:
                texts = [text for key, text in messages if self._fits((of, key), text)]
                size = sum(map(len, texts))
            self._queue += texts
            self._queue_bytes += size
        self._has_messages.set()

    async def answer(self, subject: str, payload: bytes) -> None:
        """Sends a message that a caller waits for, before all queued messages."""
        client, text = self._client, batch.answer(subject, payload)
        if client is not None and client.is_connected:
            await batch.send(client, text, 1)
        else:
            self.put([(subject, text)])

    async def run(self) -> None:
        """Sends queued messages, until it is cancelled."""
        while True:
            await self._has_messages.wait()
            self._has_messages.clear()
            while (self._queue or self._kept) and self._client is not None:
                if not self.may_send():
                    self.dropped += len(self._queue) + len(self._kept)
                    self._queue, self._queue_bytes = [], 0
                    self._kept.clear()
                    self.on_drop()
                    continue
                if not self._accepts() or (self.at_once and batch.unsent(self._client) > 0):
                    await asyncio.sleep(CHECK_INTERVAL_S)
                    continue
                await self._send(self._client)

    async def flush(self) -> None:
        """Waits until the server has received all messages, or is disconnected."""
        while (self._queue or self._kept) and self._client is not None:
            await asyncio.sleep(CHECK_INTERVAL_S)
        if self._client is not None:
            with contextlib.suppress(Error):
                await self._client.flush()

    async def _send(self, client: SafeClient) -> None:
        texts = self._queue
        self._queue, self._queue_bytes = [], 0
        if not texts:
            texts = self._oldest()
        self.sent += len(texts)
        if self.at_once:
            batch.send_at_once(client, b"".join(texts), len(texts))
        else:
            await batch.send(client, b"".join(texts), len(texts))

    def _oldest(self) -> list[bytes]:
        """Removes and returns the oldest kept messages, about `MAX_BATCH_BYTES` bytes."""
        texts, size, most = list[bytes](), 0, self.max_payload
        while self._kept and size < MAX_BATCH_BYTES:
            key, text = self._kept.popitem(last=False)
            # Not before: the server to which it is sent may have another limit.
            if len(text) <= most or self._fits(key, text):
                texts.append(text)
                size += len(text)
        return texts

    def _fits(self, key: tuple[object, object], text: bytes) -> bool:
        """Returns whether the server takes a message. Logs once of each key that it does not."""
        subject, size = batch.subject_and_size(text)
        if size <= self.max_payload:
            return True
        if key not in self._too_large:
            if len(self._too_large) >= MAX_REMEMBERED:
                # Logging a message twice is harmless; memory without limit is not.
                self._too_large.clear()
            self._too_large.add(key)
            fields = {"tag": key[1]} if isinstance(key[1], str) and key[1] != subject else {}
            reason = f"found {size} bytes, the server takes {self.max_payload}"
            log_lines.refused(
                "message_too_large", kind="nats", subject=subject, **fields, reason=reason
            )
        return False

    def _accepts(self) -> bool:
        """Returns whether the connection currently accepts more."""
        client = self._client
        return (
            client is not None and client.is_connected and batch.backlog(client) < MAX_BACKLOG_BYTES
        )

    def _keep(self, key: tuple[object, object], text: bytes) -> None:
        # A replacement keeps the position of the older message, so it can't wait forever.
        if key in self._kept:
            self.replaced += 1
        elif len(self._kept) >= self.max_kept:
            self._kept.popitem(last=False)
            self.dropped += 1
        self._kept[key] = text
