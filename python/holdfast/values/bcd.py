"""BCD: decimal digits of four bits each."""

from __future__ import annotations

from typing import Any

from holdfast.integers import as_integer
from holdfast.values.errors import DoesNotFit, Undecodable, shown
from holdfast.values.kinds import Bytewise


class Bcd(Bytewise):
    """`bcd16` and `bcd32`: four and eight digits, no sign."""

    def unpack_one(self, data: bytes) -> int:
        """The number. Raises `Undecodable` for a digit above 9."""
        digits = self.arrange(data).hex()
        try:
            return int(digits)
        except ValueError:
            found = f"digits 0x{digits.upper()}"
            raise Undecodable(f"{found} are not {self.name}, allowed: 0 to 9") from None

    def pack_one(self, value: Any) -> bytes:
        """The digits of an integer. Raises `DoesNotFit`."""
        number = as_integer(value)
        if number is None:
            raise DoesNotFit(f"{shown(value)} is not an integer, which {self.name} requires")
        most = 10 ** (2 * self.width) - 1
        if not 0 <= number <= most:
            raise DoesNotFit(f"{shown(value)} is outside 0 to {most} of {self.name}")
        return self.arrange(bytes.fromhex(f"{number:0{2 * self.width}d}"))
