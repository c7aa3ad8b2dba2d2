"""Converts registers to a sequence of typed values for JSON, and back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from holdfast import values
from holdfast.net.http.fields import malformed
from holdfast.protocol import WRITE_REGISTERS
from holdfast.values import ConversionError, WrongArea
from holdfast.values.digits import decimal_of
from holdfast.values.json import jsonable
from holdfast.values.orders import DEFAULT_ORDER
from holdfast.values.types import FIXED

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.gateway.endpoint import Answer, Given
    from holdfast.types import Area

ORDERS = ("ABCD", "CDAB", "BADC", "DCBA")
ORDERS_OF_EIGHT = ("CDABGHEF", "EFGHABCD", "FEHGBADC", "DCBAHGFE")
"""Byte orders of devices that four letters can't express. They are for eight bytes."""

NUMBERS = sorted((each for each in FIXED if each != "bool"), key=lambda each: FIXED[each])


@dataclass(frozen=True)
class ValueType:
    """The type of the values of a request, and their byte order."""

    element: str
    order: str
    width: int
    """The number of registers of one value."""
    count: int | None
    """The length of an array type; `None` for other types."""

    def decode(self, raw: Sequence[int]) -> dict[str, Any]:
        """Returns the values and their texts; for what JSON can't have, `null` and the reason."""
        found = [self._value(raw[at : at + self.width]) for at in range(0, len(raw), self.width)]
        typed = [jsonable(each) for each in found]
        wrong = {str(at): _flaw(found[at]) for at, each in enumerate(typed) if each is None}
        return {
            "typed": typed,
            "typedText": [self._text(each) for each in found],
            **({"typedErrors": wrong} if wrong else {}),
        }

    def encode(self, given: Sequence[Any]) -> list[int]:
        """Converts values to registers. Raises `BadRequest`."""
        if self.element.startswith("bit:"):
            raise malformed("to write a bit of a register, use /api/modbus/write/mask")
        if self.count is not None and self.count != len(given):
            raise malformed(f"values has {len(given)} elements, the datatype has {self.count}")
        registers: list[int] = []
        for index, value in enumerate(given):
            try:
                registers += values.encode(self._plain(value), self.element, self.order)
            except ConversionError as error:
                raise malformed(f"values[{index}]: {error}") from None
        if len(registers) > WRITE_REGISTERS:
            raise malformed(f"{len(registers)} registers, allowed: {WRITE_REGISTERS} in a request")
        return registers

    def _plain(self, value: Any) -> Any:
        """Converts the JSON form of a value: bytes are hex."""
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
            return decimal_of(value, self.element)
        return value.hex(" ") if isinstance(value, bytes) else str(value)


def _flaw(value: ConversionError | float) -> str:
    """Why a value is `null` in JSON."""
    if isinstance(value, ConversionError):
        return str(value)
    return "not a number" if value != value else "infinite"


def parse_value_type(datatype: str | None, order: str, area: Area) -> ValueType | None:
    """Returns the type of a request; `None` without `datatype`. Raises `BadRequest`."""
    if datatype is None:
        if order != DEFAULT_ORDER:
            raise malformed("byteOrder requires datatype")
        return None
    try:
        type = values.codec_for(area, datatype, order).type
    except WrongArea:
        of = area.replace("_", " ")
        raise malformed(f"datatype is {datatype}, allowed for {of}: bool") from None
    except ConversionError as error:
        raise malformed(str(error)) from None
    return ValueType(type.element, order, type.width // 2, type.count)


async def encode(given: Given, _: object) -> Answer:
    """Answers with the registers that hold values, and the values as they are then read.

    Raises `BadRequest`.
    """
    kind = parse_value_type(given["datatype"], given["byteOrder"], "holding_registers")
    assert kind is not None
    registers = kind.encode(given["values"])
    return {"success": True, "values": registers, **kind.decode(registers)}


async def every(given: Given, _: object) -> Answer:
    """Answers with registers in every type and byte order."""
    return {"success": True, "tables": tables(given["registers"])}


def tables(registers: list[int]) -> list[dict[str, Any]]:
    """Returns registers in every type and byte order, as tables of texts."""
    found = [_table(registers, ORDERS, NUMBERS)]
    whole = [values.decode(registers, f"bytes:{2 * len(registers)}", each) for each in ORDERS]
    first = [values.decode(registers[:1], "uint16", each) for each in ORDERS]
    found[0]["rows"] += [
        {"type": "text", "texts": list(map(_printable, whole))},
        {"type": "bytes", "texts": [each.hex() for each in whole]},
        {"type": "bits on", "texts": list(map(_bits_on, first))},
        {"type": "bool", "texts": ["true" if registers[0] else "false", "", "", ""]},
    ]
    eight = [each for each in NUMBERS if FIXED[each] == 8]
    if 2 * len(registers) >= 8:
        found.append(_table(registers, ORDERS_OF_EIGHT, eight))
    return found


def _table(registers: list[int], orders: Sequence[str], types: Sequence[str]) -> dict[str, Any]:
    """The first value of each type that the registers hold, by byte order."""
    rows = []
    for name in types:
        width = FIXED[name] // 2
        if width <= len(registers):
            kinds = [ValueType(name, order, width, None) for order in orders]
            texts = [kind.decode(registers[:width])["typedText"][0] for kind in kinds]
            rows.append({"type": name, "texts": texts})
    return {"orders": list(orders), "rows": rows}


def _printable(data: bytes) -> str:
    return "".join(chr(byte) if 0x20 <= byte < 0x7F else "·" for byte in data)


def _bits_on(register: int) -> str:
    """The bits that are 1, as in `0 3-5`."""
    runs: list[list[int]] = []
    for bit in range(16):
        if register >> bit & 1:
            if runs and runs[-1][-1] == bit - 1:
                runs[-1][1:] = [bit]
            else:
                runs.append([bit])
    return " ".join("–".join(map(str, run)) for run in runs) or "none"


def quantity_of(given: int | None, kind: ValueType | None) -> int:
    """Returns the quantity to read: `given`, or by default the size of the type.

    Raises `BadRequest` if `given` does not fit the type.
    """
    if kind is None:
        return 1 if given is None else given
    whole = kind.width * (1 if kind.count is None else kind.count)
    if given is None:
        return whole
    if given % kind.width or (kind.count is not None and given != whole):
        takes = f"{whole}" if kind.count is not None else f"a multiple of {kind.width}"
        raise malformed(f"quantity is {given}, the datatype requires {takes}")
    return given
