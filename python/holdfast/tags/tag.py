"""A tag: a place in a device, the type of its value, and what the value means."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Set
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any

from holdfast.protocol import ADDRESSES, LAST_ADDRESS, WRITE_LIMITS
from holdfast.tags.base import Marker, Scaled, TagError
from holdfast.tags.rounding import Rounding
from holdfast.tags.scale import Linear, RegisterScale, plain_number
from holdfast.tags.writing import WritableTag, unwritable
from holdfast.types import AREAS, BIT_AREAS, Area
from holdfast.values import (
    ConversionError,
    UnknownEncoding,
    UnknownOrder,
    codec_for,
    decode,
    encode,
)
from holdfast.values.digits import decimal_of
from holdfast.values.errors import shown
from holdfast.values.integers import as_boolean, as_integer
from holdfast.values.numeric import limits
from holdfast.values.orders import DEFAULT_ORDER
from holdfast.values.types import Type, parsed


def default_type(area: Area) -> str:
    """The type of a tag that names none."""
    return "bool" if area in BIT_AREAS else "uint16"


@dataclass(frozen=True)
class Tag(WritableTag):
    """A tag. Raises `TagError`.

    A value is scale × number + offset, where the number is what the registers hold.
    """

    name: str
    area: Area
    address: int
    """Counted from 0, as in the protocol."""
    type: str = ""
    """As in `holdfast.values`. Default: `bool` in an area of bits, else `uint16`."""
    order: str = DEFAULT_ORDER
    encoding: str | None = None
    """The encoding of text; `None` for ASCII."""
    scale: float | RegisterScale = 1
    """A number, or the register that contains it."""
    offset: float = 0
    unit: str = ""
    """The unit of the value, such as `V` or `°C`."""
    writable: bool = False
    min: float | None = None
    """The smallest value that may be written."""
    max: float | None = None
    """The largest value that may be written."""
    states: Mapping[int, str] = field(default_factory=dict, hash=False)
    """Names of values, for tags that have a state."""
    null: Set[Marker] = frozenset()
    """What the registers hold when no value is available; NaN never is one."""
    deadband: float = 0
    """How much a value must change to count as changed."""
    round: Rounding | None = None
    """What happens to a value between two steps; `None`: whoever writes decides."""
    description: str = ""
    device_class: str = ""
    """What it is for Home Assistant, such as `energy_storage`. Empty: what its unit suggests."""
    state_class: str = ""
    """How Home Assistant keeps statistics of it, such as `total`. Empty: by its device class."""

    def __post_init__(self) -> None:
        if self.area not in AREAS:
            raise TagError("area", f"area is {self.area!r}, allowed: {', '.join(AREAS)}")
        address = as_integer(self.address)
        if address is None or not 0 <= address < ADDRESSES:
            found = f"address is {self.address!r}"
            raise TagError("address", f"{found}, allowed: 0 to {LAST_ADDRESS}")
        self._put("address", address)
        if not self.type:
            self._put("type", default_type(self.area))
        try:
            if parsed(self.type).base == "bool":
                self._put("order", DEFAULT_ORDER)
            codec_for(self.area, self.type, self.order, self.encoding)
        except ConversionError as error:
            raise TagError(_KEYS.get(type(error), "type"), str(error)) from None
        self._put("of_type", parsed(self.type))
        last = self.address + self.count - 1
        if last > LAST_ADDRESS:
            found = f"{self.type} from address {self.address} ends at {last}"
            raise TagError("address", f"{found}, allowed: up to {LAST_ADDRESS}")
        if isinstance(self.null, str | bytes) or not isinstance(self.null, Iterable):
            raise TagError("null", f"null is {shown(self.null)}, allowed: a set, as in {{65535}}")
        try:
            null = (as_decoded(marker, self.of_type, self.encoding) for marker in self.null)
            self._put("null", frozenset(null))
        except ValueError as error:
            raise TagError("null", str(error)) from None
        self._check_number()
        self._check_writable()

    def _put(self, name: str, value: object) -> None:
        object.__setattr__(self, name, value)

    of_type: Type = field(init=False, repr=False)
    """The type, split into its parts."""
    _linear: Linear = field(init=False, repr=False, hash=False)
    """Of a scale in a register, only the offset. Equal numbers may have other digits here."""

    def _check_number(self) -> None:
        for key in _NUMBERS:
            given = getattr(self, key)
            is_register = key == "scale" and isinstance(given, RegisterScale)
            if given is not getattr(Tag, key) and not is_register:
                self._put(key, plain_number(key, given))
        scale = 1 if isinstance(self.scale, RegisterScale) else self.scale
        self._put("_linear", Linear(scale, self.offset))
        if not self.is_number:
            for key in _NUMBERS:
                if (given := getattr(self, key)) != getattr(Tag, key):
                    raise TagError(key, f"{key} is {given}, allowed: only with numbers")
        if isinstance(self.scale, RegisterScale):
            self.scale.check(self)
        if self.deadband < 0:
            found = f"deadband is {self.deadband}"
            raise TagError("deadband", f"{found}, allowed: a finite number from 0")
        if self.min is not None and self.max is not None and self.min > self.max:
            raise TagError("max", f"max is {self.max}, allowed: at least min, {self.min}")
        if not isinstance(self.states, Mapping):
            raise TagError("states", f"states is {shown(self.states)}, allowed: names by number")
        if self.states and (self.is_float or self.of_type.base in ("string", "bytes")):
            raise TagError("states", f"found states of {self.type}, allowed: integers and bits")
        self._put("states", {self._state(key): name for key, name in self.states.items()})
        if len(set(self.states.values())) < len(self.states):
            names = list(self.states.values())
            twice = next(name for name in names if names.count(name) > 1)
            raise TagError("states", f"two states have the name {twice!r}")
        if self.round is not None and not self.is_stepped:
            message = "allowed: only with integers without states"
            raise TagError("round", f"round is {self.round}, {message}")

    def _state(self, given: object) -> int:
        """The number of a state. Raises `TagError` for one that the registers never hold."""
        bit = as_boolean(given)
        state = as_integer(given) if bit is None else int(bit)
        if state is None:
            raise TagError("states", f"found the state {shown(given)}, allowed: an integer")
        if isinstance(self.scale, RegisterScale):
            return state
        number = self._linear.number(state)
        if number.denominator != 1:
            found = f"{state} is between two values of the registers"
            raise TagError("states", f"{found}, allowed: steps of {abs(self.scale)}")
        least, most = limits(self.of_type.base) if self.is_number else (0, 1)
        if not least <= number <= most:
            found = f"{state}" if number == state else f"{state}, {number} in the registers,"
            raise TagError("states", f"{found} is outside {least} to {most} of {self.type}")
        return state

    def _check_writable(self) -> None:
        if self.writable and (flaw := self.unwritable) is not None:
            raise TagError("writable", f"found true, {flaw}")

    @property
    def source(self) -> Tag | None:
        """The register that contains the scale, if one does."""
        source = self.scale.source if isinstance(self.scale, RegisterScale) else None
        assert source is None or isinstance(source, Tag)
        return source

    @property
    def place_and_meaning(self) -> tuple[object, ...]:
        """Where the value is, and what it means: as long as it stays, so do values."""
        scale, source = self.scale, self.source
        form = scale.form if isinstance(scale, RegisterScale) else None
        place = (self.area, self.address, self.type, self.order, self.encoding)
        of = None if source is None else source.place_and_meaning
        return (*place, form, of, self._linear, self.unit, self.states, self.null)

    @property
    def unwritable(self) -> str | None:
        """Why no Modbus request can write the tag; `None` if one can."""
        if self.area not in WRITE_LIMITS:
            return f"{self.area} can't be written"
        return unwritable(self.area, self.of_type, self.type)

    def value(self, raw: Any) -> Any:
        """The value of what the registers hold; `None` if none is available.

        Raises `ValueError` if the scale is in a register: see `with_scale`.
        """
        if type(raw) is Scaled:
            return raw.value
        if isinstance(self.scale, RegisterScale):
            raise ValueError(self.unscaled)
        return self._value(raw, self._linear)

    def scaled(self, raw: Any, content: Any) -> Scaled:
        """The value, from the contents of its registers and of that of its scale.

        Raises `ValueError` if there is a number, but no scale.
        """
        assert isinstance(self.scale, RegisterScale), "only such tags have a register for it"
        if self._has_no_value(raw):
            return Scaled(self._value(raw, self._linear))
        return Scaled(self._value(self._as_written(raw), self.scale.linear(content, self.offset)))

    def with_scale(self, content: Any) -> Tag:
        """The tag with the scale that its register contains. Raises `ValueError` without one."""
        assert isinstance(self.scale, RegisterScale), "only such tags have a register for it"
        scaled = replace(self, scale=self.scale.factor(content), states={})
        scaled._put("states", self.states)  # With this scale, some may be none of its values.
        return scaled

    def resolved(self, tags: Mapping[str, Tag]) -> Tag:
        """The tag with the register of its scale, which is among `tags`. Raises `TagError`."""
        if not isinstance(self.scale, RegisterScale) or self.scale.name is None:
            return self
        source = tags.get(self.scale.name, self.scale.source)
        if source is None:
            raise TagError("scale", f"the tag {self.scale.name!r} does not exist in this list")
        return replace(self, scale=replace(self.scale, source=source))

    def _has_no_value(self, raw: Any) -> bool:
        return all(map(self.is_null, raw)) if type(raw) is list else self.is_null(raw)

    def _as_written(self, raw: Any) -> Any:
        """Floats as the decimals that they stand for: 0.1 of a `float32` is 0.1."""
        if type(raw) is list:
            return [self._as_written(item) for item in raw]
        if not isinstance(raw, float) or not math.isfinite(raw) or raw in self.null:
            return raw
        return Fraction(decimal_of(raw, self.of_type.base))

    def _value(self, raw: Any, linear: Linear) -> Any:
        if type(raw) is list:
            return [self._value(item, linear) for item in raw]
        if self.is_null(raw):
            return None
        if linear.is_identity:
            return float(raw) if isinstance(raw, Fraction) else raw
        # The digits of a float32 are found when it is shown: see `holdfast.tags.text`.
        return linear.value(self._as_written(raw) if self.of_type.base == "float64" else raw)

    def state(self, value: Any) -> str | None:
        """The name of a value, if it has one. With a scale of 0.5, 1.0 has that of 1."""
        return None if isinstance(value, list) else self.states.get(value)


_NUMBERS = ("scale", "offset", "min", "max", "deadband")

JUDGED_WITH = {
    "address": {"type"},
    "encoding": {"type"},
    "states": {"type", "scale", "offset"},
    "null": {"area", "type", "encoding"},
    "writable": {"area"},
}
"""The keys without which an error of another key may be none: those that a single integer in
holding registers, without a scale, may have in any case are not here."""

_KEYS = {UnknownOrder: "order", UnknownEncoding: "encoding"}
"""The keys that errors of conversions are about; all others are about the type."""


def as_decoded(marker: Marker, type: Type, encoding: str | None) -> Marker:
    """Converts a marker to the value that is decoded from the registers.

    Raises `ValueError` for a marker that the registers can't hold.
    """
    if type.base == "bytes":
        raise ValueError(f"not supported for {type.name}")
    made: Marker
    if marker in ("nan", "inf", "-inf") and type.is_float:
        made = float(marker)
    else:
        try:
            registers = encode(marker, type.element, encoding=encoding)
            made = decode(registers, type.element, encoding=encoding)
        except (ConversionError, TypeError) as error:
            raise ValueError(str(error)) from None
    # One NaN for all: a set with another one is not equal.
    return math.nan if made != made else made


class TagList:
    """The tags of a device, in their order.

    Raises `TagError` for two tags of one name, and for a scale that no tag of the list has,
    `TypeError` for what is not a `Tag`.
    """

    def __init__(self, tags: Iterable[Tag] = ()) -> None:
        self._tags: dict[str, Tag] = {}
        for tag in tags:
            if not isinstance(tag, Tag):
                example = "holdfast.Tag('flow', 'input_registers', 0, 'float32')"
                raise TypeError(f"{tag!r} is not a tag, allowed: {example}")
            if tag.name in self._tags:
                raise TagError("name", f"two tags have the name {tag.name!r}")
            self._tags[tag.name] = tag
        for name, tag in self._tags.items():
            self._tags[name] = tag.resolved(self._tags)

    def __iter__(self) -> Iterator[Tag]:
        return iter(self._tags.values())

    def __len__(self) -> int:
        return len(self._tags)

    def __contains__(self, name: object) -> bool:
        return name in self._tags

    def __getitem__(self, name: str) -> Tag:
        return self._tags[name]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, TagList) and list(self) == list(other)

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        return f"TagList({list(self)!r})"
