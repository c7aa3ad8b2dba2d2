"""What waits to be published. While NATS does not take it, the newest value of each tag is kept.

Messages flow through in order as long as the server takes them. When there is no connection, or it
is slow, each message takes the place of the older one of the same tag; the number of those that
wait is bounded too. So a scanner neither stops nor grows, and when the server is back it gets what
is true now.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import OrderedDict
from typing import TYPE_CHECKING

from nats.errors import Error

from holdfast.scanner import wire

if TYPE_CHECKING:
    from collections.abc import Iterable

    from nats.aio.client import Client

BACKLOG = 2 * 1024 * 1024
"""Bytes that may be on their way; beyond them the connection is slow."""

PIECE = 512 * 1024
"""Bytes of what was kept that are sent at once; the rest may still be replaced."""

KEPT = 200_000
"""Messages that are kept while there is no connection."""

CHECK_INTERVAL = 0.005
"""Seconds between looks whether a slow connection takes more."""


class Outbox:
    """Messages on their way to NATS."""

    def __init__(self, most: int = KEPT) -> None:
        self._client: Client | None = None
        self._flowing: list[bytes] = []
        self._size = 0
        self._kept: OrderedDict[object, bytes] = OrderedDict()
        self._most = most
        self._news = asyncio.Event()
        self.sent = 0
        """Messages that were handed to the connection."""
        self.replaced = 0
        """Messages whose place a newer one of the same tag took."""
        self.dropped = 0
        """Messages that were lost because too many were kept."""

    def connected(self, client: Client | None) -> None:
        """What is put in goes to this client from now on; to nobody if it is `None`."""
        self._client = client
        self._news.set()

    def put(self, messages: Iterable[tuple[object, bytes]]) -> None:
        """Messages, each with what it tells of, such as device and tag."""
        if self._kept or self._size > BACKLOG or not self._takes():
            for key, text in messages:
                self._keep(key, text)
        else:
            texts = [text for _, text in messages]
            self._flowing += texts
            self._size += sum(map(len, texts))
        self._news.set()

    async def answer(self, subject: str, text: bytes) -> None:
        """A message that somebody waits for: it goes before those that wait here."""
        client = self._client
        if client is not None and client.is_connected:
            await wire.send(client, text, 1)
        else:
            self.put([(subject, text)])

    async def run(self) -> None:
        """Sends what is put in, for ever."""
        while True:
            await self._news.wait()
            self._news.clear()
            while (self._flowing or self._kept) and self._client is not None:
                if not self._takes():
                    await asyncio.sleep(CHECK_INTERVAL)
                    continue
                await self._send(self._client)

    async def flush(self) -> None:
        """Waits until the server has what was put in, or is gone."""
        while (self._flowing or self._kept) and self._client is not None:
            await asyncio.sleep(CHECK_INTERVAL)
        if self._client is not None:
            with contextlib.suppress(Error):
                await self._client.flush()

    async def _send(self, client: Client) -> None:
        texts = self._flowing
        self._flowing, self._size = [], 0
        if not texts:
            texts = self._oldest()
        self.sent += len(texts)
        await wire.send(client, b"".join(texts), len(texts))

    def _oldest(self) -> list[bytes]:
        """Takes some of what was kept, in its order."""
        texts, size = [], 0
        while self._kept and size < PIECE:
            _, text = self._kept.popitem(last=False)
            texts.append(text)
            size += len(text)
        return texts

    def _takes(self) -> bool:
        """Whether the connection takes more just now."""
        client = self._client
        return client is not None and client.is_connected and wire.backlog(client) < BACKLOG

    def _keep(self, key: object, text: bytes) -> None:
        # What takes the place of another has its turn too, lest it wait for ever.
        if key in self._kept:
            self.replaced += 1
        elif len(self._kept) >= self._most:
            self._kept.popitem(last=False)
            self.dropped += 1
        self._kept[key] = text
