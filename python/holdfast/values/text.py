"""Strings and bytes, two bytes per register."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holdfast.values.errors import DoesNotFit, Undecodable, UnknownEncoding, shown
from holdfast.values.kinds import Bytewise

if TYPE_CHECKING:
    from holdfast.values.orders import Order
    from holdfast.values.types import Type


class Bytes(Bytewise):
    """`bytes:N`: exactly N bytes. With odd N, the last byte is written as 0 and not read."""

    def __init__(self, type: Type, order: Order) -> None:
        super().__init__(type, order)
        self.size = type.parameter

    def unpack_one(self, data: bytes) -> Any:
        """The bytes."""
        return self.arrange(data)[: self.size]

    def pack_one(self, value: Any) -> bytes:
        """The bytes, with padding. Raises `DoesNotFit`."""
        if not isinstance(value, bytes | bytearray | memoryview):
            raise DoesNotFit(f"{shown(value)} is not bytes, which {self.name} requires")
        data = bytes(value)
        if len(data) != self.size:
            raise DoesNotFit(f"found {len(data)} bytes, {self.name} requires {self.size}")
        return self._padded(data)

    def _padded(self, data: bytes) -> bytes:
        return self.arrange(data.ljust(self.width, b"\0"))


class Text(Bytes):
    """`string:N`: up to N bytes of text, padded with NUL."""

    def __init__(self, type: Type, order: Order, encoding: str) -> None:
        super().__init__(type, order)
        self._encoding = encoding
        try:
            blank = "".encode(encoding).ljust(self.size, b"\0").decode(encoding)
        except UnicodeError:
            blank = "?"
        except (LookupError, ValueError):
            raise UnknownEncoding(f"encoding {shown(encoding)} is unknown") from None
        if blank.strip("\0"):
            found = f"encoding {encoding} can't pad with NUL"
            raise UnknownEncoding(f"{found} to the {self.size} bytes of {self.name}")

    def unpack_one(self, data: bytes) -> str:
        """The text without its padding. Raises `Undecodable`."""
        field = self.arrange(data)[: self.size]
        try:
            text = field.decode(self._encoding).rstrip("\0")
            text.encode()  # Some encodings have halves of characters, which no JSON can contain.
            return text
        except UnicodeError:
            raise Undecodable(f"{shown(field)} is not a {self.name} in {self._encoding}") from None

    def pack_one(self, value: Any) -> bytes:
        """The text with padding. Raises `DoesNotFit`, also for text that ends with NUL."""
        if not isinstance(value, str):
            raise DoesNotFit(f"{shown(value)} is not text, which {self.name} requires")
        try:
            data = value.encode(self._encoding)
        except UnicodeError:
            raise DoesNotFit(f"{shown(value)} can't be encoded in {self._encoding}") from None
        if len(data) > self.size:
            found = f"{shown(value)} has {len(data)} bytes in {self._encoding}"
            raise DoesNotFit(f"{found}, allowed in {self.name}: up to {self.size}")
        field = self._padded(data)
        back = self.unpack_one(field)
        if back != value:
            raise DoesNotFit(f"{shown(value)} would be read back as {shown(back)}")
        return field
