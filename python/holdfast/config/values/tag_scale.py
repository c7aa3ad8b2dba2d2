"""The scale of a tag: a number, or the register that contains it."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, get_args

from holdfast.config.text.messages import show
from holdfast.config.values.scalars import exact_number, is_name, whole
from holdfast.protocol import LAST_ADDRESS
from holdfast.runtime.suggestion import suggestion
from holdfast.runtime.text import either, listing
from holdfast.tags import Tag
from holdfast.tags.scale import Form, RegisterScale
from holdfast.tags.text import decimal_comma
from holdfast.types import AREAS, Area

if TYPE_CHECKING:
    from collections.abc import Sequence

FORMS: tuple[Form, ...] = get_args(Form)
MAX_NUMBER = sys.float_info.max
KEYS = ("from", "as")
PLACE_KEYS = ("area", "address", "type")
TYPES: dict[Form, str] = {"factor": "uint16", "exponent": "int16"}
"""The types of registers that have none."""

_ADDRESS = {"type": "integer", "minimum": 0, "maximum": LAST_ADDRESS}
_PLACE = {"area": {"enum": list(AREAS)}, "address": _ADDRESS, "type": {"type": "string"}}
_FROM = [
    {"type": "string", "description": "A tag of the same list."},
    {
        "type": "object",
        "required": ["area", "address"],
        "properties": _PLACE,
        "additionalProperties": False,
    },
]
_MAPPING = {
    "type": "object",
    "required": list(KEYS),
    "properties": {"from": {"anyOf": _FROM}, "as": {"enum": list(FORMS)}},
    "additionalProperties": False,
}
SCALE_SCHEMA: dict[str, Any] = {"anyOf": [{"type": "number"}, _MAPPING]}


@dataclass(frozen=True)
class ScaleConfig:
    """A register that contains the scale: the name of a tag, or a place."""

    form: Form
    source: str | tuple[Area, int, str]

    def of(self, order: str) -> RegisterScale:
        """The scale; `order` is the byte order of a register without a name. Raises `TagError`."""
        if isinstance(self.source, str):
            return RegisterScale(self.form, name=self.source)
        area, address, kind = self.source
        return RegisterScale(self.form, source=Tag("", area, address, kind.lower(), order))


def parse_scale(value: object) -> float | ScaleConfig:
    """Checks the scale of a tag. Raises `ValueError`."""
    if isinstance(value, ScaleConfig):
        return value
    if (
        isinstance(value, int | float)
        and not isinstance(value, bool)
        and -MAX_NUMBER <= value <= MAX_NUMBER
    ):
        return exact_number(value)
    if (comma := decimal_comma(str(value))) is not None:
        raise ValueError(f"{show(value)} {comma}")
    if not isinstance(value, dict):
        words = "a number, or a mapping with the keys from, as"
        raise ValueError(f"found {show(value)}, allowed: {words}")
    _keys(value, KEYS, KEYS, "")
    form = value["as"]
    if form not in FORMS:
        raise ValueError(
            f"as: found {show(form)}, allowed: {either(FORMS)}{suggestion(form, FORMS)}"
        )
    source = value["from"]
    if isinstance(source, dict):
        return ScaleConfig(form, _place(source, TYPES[form]))
    if not is_name(source):
        words = f"the name of a tag, or a mapping with the keys {listing(PLACE_KEYS)}"
        raise ValueError(f"from: found {show(source)}, allowed: {words}")
    return ScaleConfig(form, source)


def _place(source: dict[Any, Any], kind: str) -> tuple[Area, int, str]:
    _keys(source, PLACE_KEYS, PLACE_KEYS[:2], "from: ")
    area, address, given = source["area"], source["address"], source.get("type", kind)
    if area not in AREAS:
        raise ValueError(f"from: area: found {show(area)}, allowed: {either(AREAS)}")
    if type(address) is not int or not 0 <= address <= LAST_ADDRESS:
        words = f"an integer from 0 to {LAST_ADDRESS}"
        raise ValueError(f"from: address: found {show(address)}, allowed: {words}")
    if not isinstance(given, str) or not given:
        raise ValueError(f"from: type: found {show(given)}, allowed: a type, such as {kind}")
    return area, address, given


def _keys(value: dict[Any, Any], known: Sequence[str], needed: Sequence[str], where: str) -> None:
    for key in value:
        if key not in known:
            hint = suggestion(key, known)
            found = f"{where}found the key {show(key)}"
            raise ValueError(f"{found}, allowed: {listing(known)}{hint}")
    for key in needed:
        if key not in value:
            raise ValueError(f"{where}the key {key} is missing, allowed: {listing(known)}")


def written_scale(scale: float | ScaleConfig) -> int | float | dict[str, Any]:
    """The scale as in a file."""
    if not isinstance(scale, ScaleConfig):
        return whole(scale)
    place = scale.source
    source = place if isinstance(place, str) else dict(zip(PLACE_KEYS, place, strict=True))
    return {"from": source, "as": scale.form}
