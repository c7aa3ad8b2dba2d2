"""Tags: a place in a device, and the type of its value. Does no I/O."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, get_args

from holdfast import tags
from holdfast.protocol import ADDRESSES, LAST_ADDRESS, WRITE_LIMITS
from holdfast.scanner.errors import Refused
from holdfast.scanner.messages import tentacle
from holdfast.scanner.messages.types import FunctionCode, TagRequest
from holdfast.tags.decoding import Undecoded
from holdfast.tags.markers import as_decoded
from holdfast.tags.register_scale import Scaled
from holdfast.tags.writing import unwritable
from holdfast.types import AREAS, BIT_AREAS
from holdfast.values import ConversionError, WrongArea, codec_for
from holdfast.values.types import parsed

if TYPE_CHECKING:
    from holdfast.scanner.messages.leniency import Adjustments
    from holdfast.scanner.messages.types import DataType
    from holdfast.scanner.subscriptions.rules import Rules
    from holdfast.tags.markers import Marker
    from holdfast.types import Area
    from holdfast.values.types import Type

AREA_OF_CODE: dict[FunctionCode, Area] = dict(zip(get_args(FunctionCode), AREAS, strict=True))
CODE_OF_AREA = {area: code for code, area in AREA_OF_CODE.items()}
"""The names of the areas in messages."""

ORDERS = {"big": "ABCD", "little": "DCBA"}
"""Other names of byte orders, as callers of tentacle-modbus use them."""

NUMERIC = ("bcd", "float", "int", "uint")
"""What the names of numeric types begin with."""

NO_MARKERS: frozenset[Marker] = frozenset()
"""One object for nearly all tags."""

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
        """The value, from the contents of its registers and of that of its scale."""
        assert self.meaning is not None, "only tags of profiles have a scale"
        return self.meaning.scaled(raw, content)

    @property
    def asked_type(self) -> str:
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
        return unwritable(self.area, parsed(self.type), self.asked_type)

    def __str__(self) -> str:
        kind = "" if self.of_bits else f" {self.order}"
        return f"{self.asked_type}{kind} at {CODE_OF_AREA[self.area]} {self.address}"

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


def tag(request: TagRequest, order: str, where: str, changes: Adjustments, rules: Rules) -> Tag:
    """Creates the tag of a request; `order` is the default byte order. Raises `Refused`.

    Unless the rules are strict, a number in an area of bits becomes a boolean, and `writable` is
    ignored in an area that can't be written. Adds this to `changes`.
    """
    if request.profile is not None:
        return _of_profile(request.profile, request.id, where, rules)
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
        elif rules.dialect == "tentacle" and area not in BIT_AREAS:
            for note in tentacle.warnings(request, area, order):
                changes.warn(request.id, note)
            order = tentacle.order(name, order)
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
    try:
        null = NO_MARKERS
        if request.null:
            null = frozenset(as_decoded(each, type, request.encoding) for each in request.null)
    except ValueError as error:
        raise Refused(f"{where}.null: {error}") from None
    made = Tag(request.id, area, request.address, name, order, null, request.encoding)
    if request.writable and (flaw := made.unwritable) is not None:
        if area in WRITE_LIMITS or rules.strict:
            raise Refused(f"{where}: {flaw}")
        changes.add("writable_ignored", f"{request.id} ({area})")
    return made


def _is_number(type: Type) -> bool:
    return type.count is None and type.base.startswith(NUMERIC)


def profiled(name: str, rules: Rules) -> dict[str, TagRequest]:
    """The tags of a profile, as requests by id. Raises `Refused`."""
    return {
        tag.name: TagRequest(
            id=tag.name,
            address=tag.address,
            function_code=CODE_OF_AREA[tag.area],
            datatype=tag.type,
            writable=tag.writable,
            description=tag.description or None,
            profile=name,
        )
        for tag in _profile(name, "profile", rules)
    }


def _of_profile(name: str, id: str, where: str, rules: Rules) -> Tag:
    profile = _profile(name, f"{where}.profile", rules)
    if id not in profile:
        raise Refused(f"{where}: the profile {name} has no tag {id!r}")
    tag = profile[id]
    made = (tag.area, tag.address, tag.type, tag.order, tag.null, tag.encoding)
    return Tag(id, *made, profile=name, meaning=tag)


def _profile(name: str, where: str, rules: Rules) -> tags.TagList:
    found = rules.profiles.get(name)
    if found is None:
        allowed = ", ".join(rules.profiles) or "none, the configuration has no profiles"
        raise Refused(f"{where} is {name!r}, allowed: {allowed}")
    return found
