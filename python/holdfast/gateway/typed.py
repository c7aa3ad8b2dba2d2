"""Typed values in JSON: registers to values of a type one behind the other, and back."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from holdfast import values
from holdfast.gateway.fields import malformed
from holdfast.tools.inference import shortest
from holdfast.values import ConversionError, WrongArea

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.types import Area


@dataclass(frozen=True)
class Typed:
    """Any number of values of one type."""

    element: str
    order: str
    width: int
    """The registers that a value takes."""
    count: int | None
    """How many values the type names, if it is an array."""

    def decode(self, raw: Sequence[int]) -> dict[str, Any]:
        """The values for programs and for people; where there is none, `null` and why."""
        found = [self._value(raw[at : at + self.width]) for at in range(0, len(raw), self.width)]
        wrong = {
            str(index): str(each)
            for index, each in enumerate(found)
            if isinstance(each, ConversionError)
        }
        return {
            "typed": [_jsonable(each) for each in found],
            "typedText": [self._text(each) for each in found],
            **({"typedErrors": wrong} if wrong else {}),
        }

    def encode(self, given: Sequence[Any]) -> list[int]:
        """The registers of values. Raises `BadRequest`."""
        if self.element.startswith("bit:"):
            raise malformed("a bit of a register is written by /api/modbus/write/mask")
        if self.count is not None and self.count != len(given):
            raise malformed(f"values has {len(given)} elements, the datatype {self.count}")
        registers: list[int] = []
        for index, value in enumerate(given):
            try:
                registers += values.encode(self._plain(value), self.element, self.order)
            except ConversionError as error:
                raise malformed(f"values[{index}]: {error}") from None
        return registers

    def _plain(self, value: Any) -> Any:
        """A value as the byte interpreter takes it: bytes are hex in JSON."""
        if self.element.startswith("bytes:") and isinstance(value, str):
            try:
                return bytes.fromhex(value)
            except ValueError:
                raise ConversionError("bytes are pairs of hexadecimal digits") from None
        return value

    def _value(self, raw: Sequence[int]) -> Any:
        try:
            return values.decode(raw, self.element, self.order)
        except ConversionError as error:
            return error

    def _text(self, value: Any) -> str:
        if isinstance(value, ConversionError):
            return "?"
        if isinstance(value, bool):
            return "true" if value else "false"
        if isinstance(value, float):
            return shortest(value, self.element)
        return value.hex(" ") if isinstance(value, bytes) else str(value)


def typed(datatype: str | None, order: str, area: Area) -> Typed | None:
    """What a request asks for; `None` if it names no type. Raises `BadRequest`."""
    if datatype is None:
        if order != "ABCD":
            raise malformed("byteOrder goes with datatype")
        return None
    try:
        type = values.codec_for(area, datatype, order).type
    except WrongArea:
        of = area.replace("_", " ")
        raise malformed(f"datatype is {datatype}, of {of} allowed is bool") from None
    except ConversionError as error:
        raise malformed(str(error)) from None
    return Typed(type.element, order, type.width // 2, type.count)


def quantity_of(given: int | None, kind: Typed | None) -> int:
    """How many bits or registers to read: as many as were asked for, or as the type takes."""
    if kind is None:
        return 1 if given is None else given
    whole = kind.width * (1 if kind.count is None else kind.count)
    if given is None:
        return whole
    if given % kind.width or (kind.count is not None and given != whole):
        takes = f"{whole}" if kind.count is not None else f"a multiple of {kind.width}"
        raise malformed(f"quantity is {given}, the datatype takes {takes}")
    return given


def _jsonable(value: Any) -> Any:
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, ConversionError) or (
        isinstance(value, float) and not math.isfinite(value)
    ):
        return None
    return value
