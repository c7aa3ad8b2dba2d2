"""Converts registers in any form to bytes, and bytes to registers."""

from __future__ import annotations

import struct
import sys
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias, cast

from holdfast.protocol import MAX_WORD
from holdfast.runtime.text import counted
from holdfast.values.errors import InvalidRegister, WrongLength, shown
from holdfast.values.integers import as_boolean, as_integer
from holdfast.values.orders import swap_registers

if TYPE_CHECKING:
    from typing_extensions import Buffer

    from holdfast.types import Integers

Registers: TypeAlias = "Sequence[int] | Integers | Buffer"
"""Integers 0 to 65535, big-endian bytes, or a buffer of unsigned 16-bit integers, such as a numpy
array of `uint16`. For `bool`, also bits: a sequence of 0, 1, `False`, `True`, or a `bool` array.
"""

ALLOWED = "a sequence of integers, bytes, or a buffer of bytes or of unsigned 16-bit integers"


class RegisterBlock:
    """A fixed number of registers as bytes: big-endian, or `swapped`. `bits` allows bools."""

    def __init__(self, count: int, name: str, *, swapped: bool = False, bits: bool = False) -> None:
        self.count = count
        self._name = name
        self._swapped = swapped
        self._bits = bits
        form = struct.Struct(f"{'<' if swapped else '>'}{count}H")
        self._pack = form.pack
        self._unpack = form.unpack

    def pack(self, registers: Registers) -> bytes:
        """Registers as bytes. Raises `WrongLength`, `InvalidRegister` and `TypeError`."""
        if type(registers) is not list and type(registers) is not tuple:
            registers = _plain(registers)
            if isinstance(registers, bytes):
                return self._checked(registers)
        if bool in map(type, registers) and not self._bits:
            raise self._flaw(registers)
        try:
            return self._pack(*registers)
        except (struct.error, TypeError):
            if self._bits and any(map(_is_foreign_boolean, registers)):
                return self.pack([_plain_boolean(register) for register in registers])
            raise self._flaw(registers) from None

    def unpack(self, data: bytes | bytearray) -> list[int]:
        """Bytes as registers."""
        return list(self._unpack(data))

    def _checked(self, data: bytes) -> bytes:
        if len(data) != 2 * self.count:
            raise self._wrong_length(counted(len(data), "byte"), f" ({2 * self.count} bytes)")
        return swap_registers(data) if self._swapped else data

    def _flaw(self, registers: Sequence[int]) -> WrongLength | InvalidRegister:
        if len(registers) != self.count:
            return self._wrong_length(str(len(registers)))
        for index, register in enumerate(registers):
            found = f"registers[{index}]: {shown(register)}"
            if as_integer(register) is None and not (self._bits and isinstance(register, bool)):
                return InvalidRegister(f"{found} is not an integer")
            if not 0 <= register <= MAX_WORD:
                return InvalidRegister(f"{found} is outside 0 to {MAX_WORD}")
        raise AssertionError("registers without a flaw were refused")

    def _wrong_length(self, found: str, also: str = "") -> WrongLength:
        takes = counted(self.count, "register")
        return WrongLength(f"{self._name} takes {takes}{also}, found {found}")


def _is_foreign_boolean(value: object) -> bool:
    return not isinstance(value, bool) and as_boolean(value) is not None


def _plain_boolean(value: Any) -> Any:
    truth = as_boolean(value)
    return value if truth is None else truth


def _plain(registers: Registers) -> bytes | Sequence[int]:
    """Converts a buffer to big-endian bytes, and a sequence to a tuple."""
    try:
        view = memoryview(registers)  # type: ignore[arg-type]
    except TypeError:
        unordered = isinstance(registers, str | Mapping)
        if unordered or not hasattr(registers, "__len__") or not hasattr(registers, "__getitem__"):
            found = f"registers are {shown(registers)}"
            raise TypeError(f"{found}, allowed: {ALLOWED}") from None
        return tuple(cast("Sequence[int]", registers))
    mark, code = view.format[:-1], view.format[-1]
    if view.ndim == 1 and code in "Bc":
        return view.tobytes()
    if view.ndim == 1 and code == "H":
        big = mark in (">", "!") or (mark in ("", "@", "=") and sys.byteorder == "big")
        return view.tobytes() if big else swap_registers(view.tobytes())
    if view.ndim == 1 and code == "?":
        return tuple(map(bool, view.tobytes()))
    found = f"registers are a buffer of format {view.format!r}, dimensions {view.ndim}"
    raise TypeError(f"{found}, allowed: {ALLOWED}")
