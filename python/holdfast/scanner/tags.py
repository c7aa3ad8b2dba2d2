"""Tags: a place in a device, and the type of its value. Does no I/O."""

from __future__ import annotations

import math
from bisect import bisect_left
from dataclasses import dataclass
from typing import TYPE_CHECKING, get_args

from holdfast.protocol import ADDRESSES, LAST_ADDRESS, WRITE_LIMITS
from holdfast.scanner.errors import Refused
from holdfast.scanner.messages import FunctionCode
from holdfast.types import AREAS, BIT_AREAS
from holdfast.values import ConversionError, WrongArea, codec_for, decode, encode
from holdfast.values.types import parsed

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast.scanner.adjusting import Adjustments
    from holdfast.scanner.messages import DataType, Marker, TagRequest
    from holdfast.scanner.rules import Rules
    from holdfast.types import Area
    from holdfast.values.types import Type

AREA_OF_CODE: dict[FunctionCode, Area] = dict(zip(get_args(FunctionCode), AREAS, strict=True))
CODE_OF_AREA = {area: code for code, area in AREA_OF_CODE.items()}
"""The names of the areas in messages."""

FLOATS = ("float16", "float32", "float64")
ORDERS = {"big": "ABCD", "little": "DCBA"}
"""Other names of byte orders, as callers of tentacle-modbus use them."""

NUMERIC = ("bcd", "float", "int", "uint")
"""What the names of numeric types begin with."""

KINDS: dict[str, DataType] = {
    "bool": "boolean",
    "bit": "boolean",
    "string": "string",
    "bytes": "string",
}


@dataclass(frozen=True, slots=True)
class Tag:
    """A tag of a device. Two tags are the same if all fields are equal."""

    id: str
    area: Area
    address: int
    type: str
    order: str
    null: frozenset[Marker]
    """Markers, as decoded from the registers of the device."""
    encoding: str | None = None
    """The encoding of text; `None` for ASCII."""

    @property
    def count(self) -> int:
        """The number of bits or registers."""
        return parsed(self.type).registers

    @property
    def end(self) -> int:
        """The address after the last one."""
        return self.address + self.count

    @property
    def asked_type(self) -> str:
        """The type as requests name it."""
        bools = parsed(self.type).base == "bool"
        return "boolean" + self.type.removeprefix("bool") if bools else self.type

    @property
    def datatype(self) -> DataType:
        """The `datatype` in messages."""
        type = parsed(self.type)
        return "array" if type.count is not None else KINDS.get(type.base, "number")

    @property
    def unwritable(self) -> str | None:
        """Returns why no Modbus request can write the tag; `None` if one can."""
        type = parsed(self.type)
        if self.area not in WRITE_LIMITS:
            return f"functionCode {CODE_OF_AREA[self.area]} is not writable"
        if type.base == "bit" and type.count is not None:
            return f"{self.type} can't be written, only one bit can"
        most = WRITE_LIMITS[self.area]
        if type.registers > most:
            kind = "coils" if self.of_bits else "registers"
            has = f"{self.asked_type} has {type.registers} {kind}"
            return f"{has}, one request writes at most {most}"
        return None

    def __str__(self) -> str:
        kind = "" if self.of_bits else f" {self.order}"
        return f"{self.asked_type}{kind} at {CODE_OF_AREA[self.area]} {self.address}"

    @property
    def of_bits(self) -> bool:
        """Whether the tag is in an area of bits."""
        return self.area in BIT_AREAS


class Places:
    """An index of tags by address, to find the tags of a block quickly."""

    def __init__(self, tags: Iterable[Tag]) -> None:
        self._tags: dict[Area, list[Tag]] = {}
        for tag in sorted(tags, key=lambda tag: tag.address):
            self._tags.setdefault(tag.area, []).append(tag)
        self._starts = {area: [tag.address for tag in tags] for area, tags in self._tags.items()}

    def inside(self, area: Area, address: int, count: int) -> list[Tag]:
        """Returns the tags that are entirely inside a block, sorted by address."""
        starts, end = self._starts.get(area, []), address + count
        first, last = bisect_left(starts, address), bisect_left(starts, end)
        return [tag for tag in self._tags.get(area, [])[first:last] if tag.end <= end]


def tag(request: TagRequest, order: str, where: str, changes: Adjustments, rules: Rules) -> Tag:
    """Creates the tag of a request; `order` is the default byte order. Raises `Refused`.

    Unless the rules are strict, a number in an area of bits becomes a boolean, and `writable` is
    ignored in an area that can't be written. Adds this to `changes`.
    """
    area = AREA_OF_CODE[request.function_code]
    name = request.datatype
    if name == "boolean" or name.startswith("boolean["):
        name = "bool" + name.removeprefix("boolean")
    order = request.byte_order or order
    order = ORDERS.get(order, order)
    try:
        type = parsed(name)
        if _is_number(type) and area in BIT_AREAS and not rules.strict:
            changes.add("datatype_ignored", f"{request.id} ({name} in {area})")
            name, type = "bool", parsed("bool")
        if type.base == "bool":
            order = "ABCD"
        codec_for(area, name, order, request.encoding)
    except WrongArea:
        raise Refused(
            f"{where}: datatype is {name}, functionCode {request.function_code} reads boolean"
        ) from None
    except ConversionError as error:
        raise Refused(f"{where}: {error}") from None
    if request.address + type.registers > ADDRESSES:
        raise Refused(
            f"{where}: {name} from address {request.address}: the last address is {LAST_ADDRESS}"
        )
    null = frozenset(
        _marker(marker, type, request.encoding, where) for marker in request.null or ()
    )
    made = Tag(request.id, area, request.address, name, order, null, request.encoding)
    if request.writable and (flaw := made.unwritable) is not None:
        if area in WRITE_LIMITS or rules.strict:
            raise Refused(f"{where}: {flaw}")
        changes.add("writable_ignored", f"{request.id} ({area})")
    return made


def _is_number(type: Type) -> bool:
    return type.count is None and type.base.startswith(NUMERIC)


def _marker(marker: Marker, type: Type, encoding: str | None, where: str) -> Marker:
    """Converts a marker to the value that the tag's registers can hold."""
    if type.base == "bytes":
        raise Refused(f"{where}.null: not supported for {type.name}")
    if marker == "nan" and type.base in FLOATS:
        return math.nan
    try:
        registers = encode(marker, type.element, encoding=encoding)
        made: Marker = decode(registers, type.element, encoding=encoding)
    except (ConversionError, TypeError) as error:
        raise Refused(f"{where}.null: {error}") from None
    return made
