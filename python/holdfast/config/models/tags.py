"""Models of tags and profiles: names, types and units for what a device has."""

from __future__ import annotations

import unicodedata
from functools import cached_property
from math import isfinite
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import AfterValidator, Field, PlainSerializer, PlainValidator, Strict
from pydantic.config import JsonDict
from pydantic.json_schema import WithJsonSchema

from holdfast.config.models.base import INVALID, InvalidValue, Model
from holdfast.config.models.memories import Register
from holdfast.config.text.messages import show
from holdfast.config.values.scalars import NAME_KEYS, Name, NotNull, Number, check_state_name
from holdfast.config.values.tag_scale import SCALE_SCHEMA, ScaleConfig, parse_scale, written_scale
from holdfast.tags import Tag, TagError, TagList
from holdfast.tags.rounding import Rounding
from holdfast.tags.tag import JUDGED_WITH
from holdfast.types import BIT_AREAS, Area
from holdfast.values.orders import DEFAULT_ORDER

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping


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


def _class_word(value: str) -> str:
    if value:
        # Few configurations have one.
        from holdfast.config.values.home_assistant_classes import is_class_word

        if not is_class_word(value):
            raise ValueError(f"found {show(value)}, allowed: a word, such as energy_storage")
    return value


ClassWord = Annotated[str, AfterValidator(_class_word)]
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
    device_class: ClassWord = ""
    """What it is for Home Assistant, such as energy_storage. Default: what its unit suggests."""
    state_class: ClassWord = ""
    """How Home Assistant keeps statistics of it: measurement, measurement_angle, total or
    total_increasing. Default: by its device class."""

    def tag(self, name: str, order: str) -> Tag:
        """The tag, with a default order. Raises `TagError`."""
        settings = self._valid_settings(order)
        if len(settings) < len(type(self).model_fields):
            raise InvalidValue
        return _made(name, settings)

    def flaws(self, name: str, order: str) -> Iterator[TagError]:
        """Every reason why the valid keys do not make a tag.

        A key with a flaw counts as not given, and what can't be judged without it is not reported.
        """
        settings = self._valid_settings(order)
        wrong = type(self).model_fields.keys() - settings.keys()
        while True:
            try:
                _made(name, settings)
                return
            except TagError as error:
                is_register = isinstance(settings.pop(error.key, None), ScaleConfig)
                needed = {"area", "address"} if is_register else JUDGED_WITH.get(error.key, ())
                if wrong.isdisjoint((error.key, *needed)):
                    yield error
                wrong.add(error.key)
                if error.key == "type" and settings.get("area") in BIT_AREAS:
                    del settings["area"]  # Each key of numbers would be an error in bits.
                    wrong.add("area")

    def _valid_settings(self, order: str) -> dict[str, Any]:
        settings = dict(self.__dict__)  # Invalid keys are not there.
        if self.__dict__.get("type") is None and "area" not in settings:
            settings.pop("type", None)  # The area decides which type is the default.
        elif "type" in settings:
            settings["type"] = (self.type or "").lower()
        if "order" in settings:
            settings["order"] = (self.order or order).upper()
        if "null" in settings:
            settings["null"] = frozenset(self.null)
        # Invalid entries stay in a set or mapping, and so do invalid keys.
        if INVALID in settings.get("null", ()):
            del settings["null"]
        states = settings.get("states", {})
        if INVALID in states.values() or not all(isinstance(number, int) for number in states):
            del settings["states"]
        return settings


def _made(name: str, settings: Mapping[str, Any]) -> Tag:
    """The tag with these settings. Raises `TagError`."""
    settings = {**_STAND_INS, **settings}
    scale = settings.get("scale")
    if isinstance(scale, ScaleConfig):
        try:
            settings["scale"] = scale.of(settings.get("order", DEFAULT_ORDER))
        except TagError as error:
            # An order that is no order of the tag is the error, not the scale.
            Tag(name, **{**settings, "scale": 1, "states": {}})
            raise TagError("scale", f"from: {error}") from None
    return Tag(name, **settings)


_STAND_INS: dict[str, Any] = {"area": "holding_registers", "address": 0, "type": "uint64"}
"""In place of an invalid area, address or type, so that other keys are judged all the same. Eight
bytes can have every order."""


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
