"""Tags: a place in a device, and the type of its value. Does no I/O."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, get_args

from holdfast import tags
from holdfast.protocol import WRITE_LIMITS
from holdfast.scanner.messages.types import FunctionCode
from holdfast.tags.decoding import Undecoded
from holdfast.tags.register_scale import Scaled
from holdfast.tags.writing import unwritable
from holdfast.types import AREAS, BIT_AREAS
from holdfast.values.types import parsed

if TYPE_CHECKING:
    from holdfast.scanner.messages.types import DataType
    from holdfast.tags.markers import Marker
    from holdfast.types import Area
    from holdfast.values.types import Type

AREA_OF_CODE: dict[FunctionCode, Area] = dict(zip(get_args(FunctionCode), AREAS, strict=True))
CODE_OF_AREA = {area: code for code, area in AREA_OF_CODE.items()}
"""The names of the areas in messages."""

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
    profile: str | None = None
    """The profile that the tag is from."""
    meaning: tags.Tag | None = None
    """The tag of the profile: scale, limits of writes, names of states."""

    @property
    def count(self) -> int:
        """The number of bits or registers."""
        return parsed(self.type).registers

    @property
    def end(self) -> int:
        """The address after the last one."""
        return self.address + self.count

    @property
    def source(self) -> tags.Tag | None:
        """The register that contains the scale, if one does."""
        return None if self.meaning is None else self.meaning.source

    @property
    def span(self) -> range:
        """The addresses that one request must read: those of the value and of its scale."""
        return range(self.address, self.end) if self.meaning is None else self.meaning.span

    def scaled(self, raw: Any, content: Any) -> Scaled:
        """The value, from its registers and the register that contains its scale."""
        assert self.meaning is not None, "only tags of profiles have a scale"
        return self.meaning.scaled(raw, content)

    @property
    def requested_type(self) -> str:
        """The type as requests name it."""
        bools = parsed(self.type).base == "bool"
        return "boolean" + self.type.removeprefix("bool") if bools else self.type

    @property
    def datatype(self) -> DataType:
        """The `datatype` in messages."""
        return datatype(parsed(self.type))

    @property
    def unwritable(self) -> str | None:
        """Returns why no Modbus request can write the tag; `None` if one can."""
        if self.area not in WRITE_LIMITS:
            return f"functionCode {CODE_OF_AREA[self.area]} is not writable"
        return unwritable(self.area, parsed(self.type), self.requested_type)

    def __str__(self) -> str:
        kind = "" if self.of_bits else f" {self.order}"
        return f"{self.requested_type}{kind} at {CODE_OF_AREA[self.area]} {self.address}"

    @property
    def of_bits(self) -> bool:
        """Whether the tag is in an area of bits."""
        return self.area in BIT_AREAS


def clean(value: Any, tag: Tag) -> Any:
    """Returns a decoded value; `None` for NaN and for markers of the tag."""
    if type(value) is Scaled:
        return value.value
    if type(value) is list:
        return [clean(item, tag) for item in value]
    if type(value) is float and value != value:
        return None
    if type(value) is Undecoded:
        return value
    if tag.null and value in tag.null:
        return None
    return value if tag.meaning is None else tag.meaning.value(value)


def datatype(type: Type) -> DataType:
    """Returns the `datatype` in messages."""
    return "array" if type.count is not None else KINDS.get(type.base, "number")
