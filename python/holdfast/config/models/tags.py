"""Models of tags and profiles: names, types and units for what a device has."""

from __future__ import annotations

import unicodedata
from functools import cached_property
from math import isfinite
from typing import Annotated, Any

from pydantic import AfterValidator, Field, PlainSerializer, PlainValidator, Strict
from pydantic.config import JsonDict
from pydantic.json_schema import WithJsonSchema

from holdfast.config.models.base import INVALID, InvalidValue, Model
from holdfast.config.models.memories import Register
from holdfast.config.text.messages import show
from holdfast.config.values.scalars import NAME_KEYS, Name, NotNull, Number, check_state_name
from holdfast.config.values.tag_scale import SCALE_SCHEMA, ScaleConfig, parse_scale, written_scale
from holdfast.tags import Tag, TagList
from holdfast.tags.rounding import Rounding
from holdfast.types import Area
from holdfast.values.orders import DEFAULT_ORDER


def _written(marker: bool | int | float | str) -> bool | int | float | str:
    """A marker as JSON can have it."""
    return str(marker) if isinstance(marker, float) and not isfinite(marker) else marker


StateName = Annotated[str, AfterValidator(check_state_name)]
Marker = Annotated[bool | int | float | str, AfterValidator(_written)]
Scale = Annotated[
    float | ScaleConfig,
    PlainValidator(parse_scale),
    PlainSerializer(written_scale),
    WithJsonSchema(SCALE_SCHEMA),
]


def _not_empty(value: str) -> str:
    if not value:
        raise ValueError("found '', allowed: a type, such as float32")
    return value


def _one_line(value: str) -> str:
    if any(unicodedata.category(each) == "Cc" for each in value):
        raise ValueError(f"found {show(value)}, allowed: text without control characters")
    return value


_INTEGER_KEYS: JsonDict = {"propertyNames": {"pattern": "^-?[0-9]+$"}}


class TagConfig(Model):
    """A tag: a place in a device, the type of its value, and what the value means."""

    area: Area
    """The area."""
    address: Register
    """The first address, as in the protocol: counted from 0."""
    type: Annotated[Annotated[str, AfterValidator(_not_empty)] | None, NotNull()] = None
    """The type, such as float32, bit:3 or string:20. Default: bool or uint16, by area."""
    order: Annotated[str | None, NotNull()] = None
    """The byte order: ABCD, DCBA, BADC or CDAB. Default: that of the profile, or ABCD."""
    encoding: Annotated[str | None, NotNull()] = None
    """The encoding of text. Default: ASCII."""
    scale: Scale = 1.0
    """The value is scale × number + offset, where the number is what the registers hold. A mapping
    with from and as names the register that contains the scale."""
    offset: Number = 0.0
    """What is added."""
    unit: Annotated[str, AfterValidator(_one_line)] = ""
    """The unit of the value, such as V or °C."""
    writable: bool = False
    """Whether outputs and commands may write it."""
    min: Annotated[Number | None, NotNull()] = None
    """The smallest value that may be written."""
    max: Annotated[Number | None, NotNull()] = None
    """The largest value that may be written."""
    states: dict[int, StateName] = Field(default={}, json_schema_extra=_INTEGER_KEYS)
    """Names of values, by number."""
    null: Annotated[tuple[Marker, ...], Strict(False)] = ()
    """What the registers hold when no value is available, such as 65535 or nan."""
    deadband: Number = 0.0
    """How much a value must change to count as changed."""
    round: Annotated[Rounding | None, NotNull()] = None
    """What happens to a value between two steps. Default: exact for writes, nearest in mqtt.map."""
    description: str = ""
    """A description, for people."""

    def tag(self, name: str, order: str) -> Tag:
        """The tag, with a default order. Raises `TagError`."""
        settings: dict[str, Any] = {key: getattr(self, key) for key in _KEYS}
        settings["type"] = (self.type or "").lower()
        order = (self.order or order).upper()
        if INVALID in (*self.null, *self.states.values()):
            raise InvalidValue
        if not all(isinstance(number, int) for number in self.states):
            raise InvalidValue  # Invalid keys stay in a mapping.
        if isinstance(self.scale, ScaleConfig):
            settings["scale"] = self.scale.of(order)
        return Tag(name, null=frozenset(self.null), order=order, **settings)


_KEYS = tuple(key for key in TagConfig.model_fields if key not in ("null", "order"))


class ProfileConfig(Model):
    """The tags of a kind of device."""

    order: str = DEFAULT_ORDER
    """The byte order of tags that name none: ABCD, DCBA, BADC or CDAB."""
    tags: dict[Name, TagConfig] = Field(min_length=1, json_schema_extra=NAME_KEYS)
    """The tags, by name."""

    @cached_property
    def tag_list(self) -> TagList:
        """The tags; the same for all devices of the profile. Raises `TagError`."""
        return TagList(tag.tag(name, self.order) for name, tag in self.tags.items())
