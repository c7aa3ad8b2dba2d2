"""Tags: a place in a device, and the type of its value. Does no I/O."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, get_args

from holdfast import tags
from holdfast.scanner.messages.types import FunctionCode
from holdfast.tags.base import BaseTag, Scaled
from holdfast.tags.decoding import Undecoded
from holdfast.tags.text import plain
from holdfast.types import AREAS
from holdfast.values.types import parsed

if TYPE_CHECKING:
    from holdfast.scanner.messages.types import DataType
    from holdfast.tags.base import Marker
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
class ScannedTag(BaseTag):
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
    profile_tag: tags.Tag | None = None
    """The tag in the profile, with scale, limits of writes and names of states."""

    @property
    def source(self) -> tags.Tag | None:
        """The register that contains the scale, if one does."""
        return None if self.profile_tag is None else self.profile_tag.source

    def value(self, raw: Any) -> Any:
        """The value of what the registers hold; `None` if none is available."""
        if type(raw) is Undecoded:
            return raw
        if self.profile_tag is not None:
            return self.profile_tag.value(raw)
        if type(raw) is list:
            return [None if self.is_null(item) else item for item in raw]
        return None if self.is_null(raw) else raw

    def published(self, value: Any) -> Any:
        """A value as it is published: that of a profile with the digits of its type."""
        return value if self.profile_tag is None else plain(self.profile_tag, value)

    def scaled(self, raw: Any, content: Any) -> Scaled:
        """The value, from its registers and the register that contains its scale."""
        assert self.profile_tag is not None, "only tags of profiles have a scale"
        return self.profile_tag.scaled(raw, content)

    @property
    def requested_type(self) -> str:
        """The type as requests name it."""
        bools = parsed(self.type).base == "bool"
        return "boolean" + self.type.removeprefix("bool") if bools else self.type

    @property
    def datatype(self) -> DataType:
        """The `datatype` in messages."""
        return datatype(parsed(self.type))

    def __str__(self) -> str:
        kind = "" if self.of_bits else f" {self.order}"
        return f"{self.requested_type}{kind} at {CODE_OF_AREA[self.area]} {self.address}"


def datatype(type: Type) -> DataType:
    """Returns the `datatype` in messages."""
    return "array" if type.count is not None else KINDS.get(type.base, "number")
