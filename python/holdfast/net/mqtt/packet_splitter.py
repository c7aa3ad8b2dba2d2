"""Splits the bytes from a broker into packets."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.net.mqtt.packets import variable_integer

if TYPE_CHECKING:
    from collections.abc import Iterator


class PacketSplitter:
    """Yields packets from pieces of a byte stream, without keeping a large one in memory."""

    def __init__(self, max_bytes: int, kept_bytes: int) -> None:
        """Of a packet with more than `max_bytes` bytes, `kept_bytes` are kept."""
        self._max_bytes, self._kept_bytes = max_bytes, kept_bytes
        self._left = b""
        """The beginning of a packet, before its body."""
        self._first = self._size = self._missing = 0
        """Of a packet whose body is not complete: first byte, size, and bytes to come."""
        self._body = bytearray()

    def feed(self, data: bytes) -> Iterator[tuple[int, bytes | bytearray, int]]:
        """Yields the first byte, the body and the uncut size of each packet that is complete.

        Take all of them before the next call. Raises `ValueError`.
        """
        if self._missing:
            rest = self._missing
            self._add(data[:rest])
            yield from self._completed()
            data = data[rest:]
        data = self._left + data
        at, end, most = 0, len(data), self._max_bytes
        while end - at >= 2:
            size, start = data[at + 1], at + 2
            if size > 127:
                long = variable_integer(data, at + 1)
                if long is None:
                    break
                size, start = long
            finish = start + size
            if finish > end or size > most:
                self._first, self._size, self._missing = data[at], size, size
                self._add(data[start:finish])
                yield from self._completed()
            else:
                yield data[at], data[start:finish], size
            at = finish
        self._left = data[at:]

    def _add(self, part: bytes) -> None:
        limit = self._size if self._size <= self._max_bytes else self._kept_bytes
        self._body += part[: limit - len(self._body)]
        self._missing -= len(part)

    def _completed(self) -> Iterator[tuple[int, bytearray, int]]:
        if self._missing:
            return
        body, self._body = self._body, bytearray()
        yield self._first, body, self._size
