"""Splits what a broker sends into packets, without keeping a large one in memory."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

MAX_PACKET = 65_536
"""Bytes of a packet. A larger one is skipped: commands are short."""


class Packets:
    """Packets from pieces of a byte stream."""

    def __init__(self) -> None:
        self._left = b""
        self._skip = 0
        self.skipped = 0
        """Packets that were too large."""

    def feed(self, data: bytes) -> Iterator[tuple[int, bytes]]:
        """Yields the first byte and the body of each packet. Raises `ValueError`."""
        if self._skip:
            gone = min(self._skip, len(data))
            self._skip -= gone
            data = data[gone:]
        data = self._left + data
        at, end = 0, len(data)
        while end - at >= 2:
            size, start = data[at + 1], at + 2
            if size > 127:
                long = _size(data, at + 1)
                if long is None:
                    break
                size, start = long
            if size > MAX_PACKET:
                self.skipped += 1
                self._skip = max(0, start + size - end)
                at = min(start + size, end)
                continue
            if start + size > end:
                break
            yield data[at], data[start : start + size]
            at = start + size
        self._left = data[at:]


def _size(data: bytes, at: int) -> tuple[int, int] | None:
    """A variable byte integer, and where it ends; `None` if more bytes are needed."""
    size = 0
    for place in range(4):
        if at + place >= len(data):
            return None
        digit = data[at + place]
        size |= (digit & 0x7F) << 7 * place
        if digit < 128:
            return size, at + place + 1
    raise ValueError("the length of a packet has more than 4 bytes")
