"""What a tag is: a place in a device, and how its bits or registers become a value. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from holdfast.scanner.errors import Refused
from holdfast.values import ConversionError, decode, encode
from holdfast.values.codec import codec_of
from holdfast.values.types import parsed

if TYPE_CHECKING:
    from holdfast.scanner.messages import DataType, FunctionCode, Marker, TagRequest
    from holdfast.types import Area
    from holdfast.values.types import Type

AREAS: dict[FunctionCode, Area] = {
    "coil": "coils",
    "discrete": "discrete_inputs",
    "holding": "holding_registers",
    "input": "input_registers",
}
FUNCTION_CODES: dict[Area, FunctionCode] = {area: code for code, area in AREAS.items()}
BITS = ("coils", "discrete_inputs")
WRITABLE = ("coils", "holding_registers")

FLOATS = ("float16", "float32", "float64")
KINDS: dict[str, DataType] = {
    "bool": "boolean",
    "bit": "boolean",
    "string": "string",
    "bytes": "string",
}


@dataclass(frozen=True, slots=True)
class Tag:
    """A tag of a device. Two are the same if all of this is."""

    id: str
    area: Area
    address: int
    type: str
    order: str
    null: frozenset[Marker]
    """As the device would send them."""

    @property
    def count(self) -> int:
        """Its bits or registers."""
        return parsed(self.type).registers

    @property
    def end(self) -> int:
        """The address behind it."""
        return self.address + self.count

    @property
    def asked_type(self) -> str:
        """Its type as requests name it."""
        bools = parsed(self.type).base == "bool"
        return "boolean" + self.type.removeprefix("bool") if bools else self.type

    @property
    def datatype(self) -> DataType:
        """What its messages say that it is."""
        type = parsed(self.type)
        return "array" if type.count is not None else KINDS.get(type.base, "number")

    @property
    def of_bits(self) -> bool:
        """Whether it is in an area of bits."""
        return self.area in BITS


def tag(request: TagRequest, order: str, where: str) -> Tag:
    """The tag of a request in which `order` is that of the device. Raises `Refused`."""
    area = AREAS[request.function_code]
    name = request.datatype
    if name == "boolean" or name.startswith("boolean["):
        name = "bool" + name.removeprefix("boolean")
    order = request.byte_order or order
    try:
        type = parsed(name)
        if type.base == "bool":
            order = "ABCD"
        codec_of(name, order, None)
    except ConversionError as error:
        raise Refused(f"{where}: {error}") from None
    if area in BITS and type.base != "bool":
        raise Refused(
            f"{where}: datatype is {name}, functionCode {request.function_code} reads boolean"
        )
    if request.writable and area not in WRITABLE:
        raise Refused(f"{where}: what functionCode {request.function_code} reads can't be written")
    if request.address + type.registers > 65536:
        raise Refused(f"{where}: {name} from address {request.address} on, the last is 65535")
    null = frozenset(_marker(marker, type, where) for marker in request.null or ())
    return Tag(request.id, area, request.address, name, order, null)


def _marker(marker: Marker, type: Type, where: str) -> Marker:
    """A marker as the device would send it: of a float the nearest that the type has."""
    if type.base == "bytes":
        raise Refused(f"{where}.null: not for {type.name}")
    if marker == "nan" and type.base in FLOATS:
        return math.nan
    try:
        made: Marker = decode(encode(marker, type.element), type.element)
    except (ConversionError, TypeError) as error:
        raise Refused(f"{where}.null: {error}") from None
    return made
