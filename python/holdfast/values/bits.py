"""Boolean values: a whole register, a single bit, or one bit of a register."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holdfast.protocol import MAX_WORD
from holdfast.values.errors import DoesNotFit, shown
from holdfast.values.integers import as_boolean, as_integer
from holdfast.values.kinds import Kind

if TYPE_CHECKING:
    from holdfast.values.orders import Order
    from holdfast.values.types import Type

TRUE = b"\0\1"
FALSE = b"\0\0"


class Bool(Kind):
    """`bool`: a bit of a bit area, or a register that is not 0. Its order has no effect."""

    struct_format = "H"
    finish = bool

    def unpack_one(self, data: bytes) -> bool:
        """Whether the register is not 0."""
        return data != FALSE

    def unpack_many(self, data: bytes) -> list[bool]:
        """Whether each register is not 0."""
        return list(map(bool, memoryview(data).cast("H")))

    def pack_one(self, value: Any) -> bytes:
        """1 or 0. Raises `DoesNotFit`."""
        return TRUE if _truth(value, self.name) else FALSE


class Bit(Kind):
    """`bit:N`: bit N of a register; bit 0 is the least significant.

    A packed bit is a mask for its register: OR it if the bit is true, AND it if false.
    """

    struct_format = "H"

    def __init__(self, type: Type, order: Order) -> None:
        super().__init__(type, order)
        self.bit = type.parameter
        mask = self._mask = 1 << type.parameter
        self.finish = lambda register: register & mask != 0

    def unpack_one(self, data: bytes) -> bool:
        """Whether the bit is set."""
        return int.from_bytes(self.arrange(data)) & self._mask != 0

    def pack_one(self, value: Any) -> bytes:
        """The mask. Raises `DoesNotFit`."""
        register = self._mask if _truth(value, self.name) else MAX_WORD ^ self._mask
        return self.arrange(register.to_bytes(2))


def merge(data: bytearray, start: int, masks: bytes) -> None:
    """Applies masks from `Bit.pack_one` to consecutive registers, starting at a byte."""
    for place in range(0, len(masks), 2):
        mask = int.from_bytes(masks[place : place + 2])
        here = slice(start + place, start + place + 2)
        register = int.from_bytes(data[here])
        register = register | mask if mask.bit_count() == 1 else register & mask
        data[here] = register.to_bytes(2)


def _truth(value: object, name: str) -> bool:
    truth = as_boolean(value)
    if truth is not None:
        return truth
    number = as_integer(value)
    if number in (0, 1):
        return number == 1
    raise DoesNotFit(f"{shown(value)} is not False, True, 0 or 1, which {name} requires")
