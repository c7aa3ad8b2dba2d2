"""SunSpec devices: finds their models, and decodes them by the published definitions.

The registers of such a device begin with `SunS`, followed by models: an id, a length, and as many
registers. Models that are not in `sunspec_models.json` are listed without their points.
"""

from __future__ import annotations

import functools
import json
from dataclasses import dataclass
from importlib import resources
from typing import TYPE_CHECKING, Any, TypeAlias

from holdfast.discovery.sunspec_texts import encoding_of, text_in
from holdfast.errors import (
    ConnectFailed,
    ConnectionLost,
    InvalidResponse,
    ModbusError,
    ModbusException,
    RequestTimeout,
)
from holdfast.protocol import ADDRESSES, READ_REGISTERS
from holdfast.tags.scale import EXPONENTS
from holdfast.values import decode, register_count

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    Read: TypeAlias = Callable[[int, int], list[int]]
    """Reads holding registers, from an address on. Raises `ModbusError`."""

BASES = (40000, 0, 50000)
"""Where the registers of a SunSpec device may begin, the usual place first."""

MARK = [0x5375, 0x6E53]
"""`SunS`"""

UNANSWERED = (RequestTimeout, InvalidResponse, ConnectionLost)
"""How reads of absent addresses end on devices that do not refuse them."""

END = 0xFFFF
"""The id after the last model."""

MAX_MODELS = 100
"""With the limit of an address, this limits the requests, whatever the device answers."""

TYPES = {
    "uint16": ("uint16", 0xFFFF),
    "count": ("uint16", 0xFFFF),
    "enum16": ("uint16", 0xFFFF),
    "bitfield16": ("uint16", 0xFFFF),
    "acc16": ("uint16", None),
    "int16": ("int16", -0x8000),
    "uint32": ("uint32", 0xFFFF_FFFF),
    "enum32": ("uint32", 0xFFFF_FFFF),
    "bitfield32": ("uint32", 0xFFFF_FFFF),
    "acc32": ("uint32", None),
    "int32": ("int32", -0x8000_0000),
    "uint64": ("uint64", 0xFFFF_FFFF_FFFF_FFFF),
    "acc64": ("uint64", None),
    "int64": ("int64", -0x8000_0000_0000_0000),
    "float32": ("float32", None),
    "float64": ("float64", None),
}
"""The type of each SunSpec type, and the value of a point that is not implemented."""

HIDDEN = ("sunssf", "pad")
"""Types of points that are not values of their own."""

HEADER = ("ID", "L")

UNITS = {"Secs": "s", "C": "°C", "AH": "Ah", "WH": "Wh", "Var": "var", "Varh": "varh", "Pct": "%"}
"""Units that are usually written otherwise."""


@dataclass(frozen=True)
class Point:
    """A value of a model."""

    name: str
    """Unique in its model, such as `PhVphA` or `module_2_DCA`."""
    address: int
    type: str
    scale: float
    """The value is this, times the number in the registers."""
    scaled_by: str | None
    """The name of the point that contains the scale factor, if one does."""
    scaled_at: int | None
    """The address of that point."""
    unit: str
    label: str
    can_be_written: bool
    states: Mapping[int, str]
    missing: int | None
    """The number of a point without a value; `None` for types without one."""
    value: Any
    """The decoded number, text, or `None` if the point is not implemented."""
    encoding: str | None = None
    """The encoding of a text."""


@dataclass(frozen=True)
class Model:
    """A model of a device."""

    id: int
    name: str | None
    """`None` if its definition is not known here."""
    label: str
    address: int
    """The address of its id."""
    length: int
    """Registers after id and length."""
    points: tuple[Point, ...]

    @property
    def without_value(self) -> int:
        """How many points have no value: the device never has it, or not in its present state."""
        return sum(point.value is None for point in self.points)

    @property
    def stop(self) -> int:
        """The address behind the model."""
        return self.address + 2 + self.length


@dataclass(frozen=True)
class SunSpec:
    """The SunSpec registers of a device."""

    base: int
    models: tuple[Model, ...]
    flaw: str | None = None
    """Why the end of the models was not found; `None` if it was."""

    @property
    def is_complete(self) -> bool:
        """Whether the end of the models was found."""
        return self.flaw is None

    @property
    def extent(self) -> range:
        """All addresses, with the end mark."""
        stop = self.models[-1].stop if self.models else self.base + 2
        return range(self.base, stop + 2 if self.is_complete else stop)


def find(read: Read, span: range = range(ADDRESSES)) -> SunSpec | None:
    """Looks for `SunS`, and reads all models that end within a span of addresses.

    Raises `ConnectFailed`, `ModbusError` if the device answers at none of the places, and other
    errors of `read` than those of a device.
    """
    silences: list[ModbusError] = []
    for base in BASES:
        if base not in span or base + len(MARK) > span.stop:
            continue
        try:
            if read(base, len(MARK)) == MARK:
                return _models(read, base, span.stop)
        except ModbusException:
            continue
        except UNANSWERED as error:
            if isinstance(error, ConnectFailed):
                raise
            silences.append(error)
    if len(silences) == len(BASES):
        raise silences[0]
    return None


def _models(read: Read, base: int, stop: int) -> SunSpec:
    models: list[Model] = []
    at = base + len(MARK)
    while len(models) < MAX_MODELS and at + 2 <= stop:
        try:
            number, length = read(at, 2)
            if number == END:
                return SunSpec(base, tuple(models))
            if not length or at + 2 + length > stop:
                # No model is empty: these are not headers of models.
                return SunSpec(base, tuple(models), f"{length} registers of a model at {at}")
            known = str(number) in definitions()
            registers = _block(read, at + 2, length) if known else []
            models.append(_model(number, at, length, registers))
        except ConnectFailed:
            raise
        except ModbusError as error:
            # Also the limit of requests: the models before it are complete.
            return SunSpec(base, tuple(models), f"{error}, of the model at {at}")
        at += 2 + length
    return SunSpec(base, tuple(models), f"no model is read from {at} on")


def _block(read: Read, address: int, count: int) -> list[int]:
    registers: list[int] = []
    while len(registers) < count:
        part = min(READ_REGISTERS, count - len(registers))
        registers += read(address + len(registers), part)
    return registers


def _model(number: int, address: int, length: int, registers: list[int]) -> Model:
    definition = definitions().get(str(number))
    if definition is None:
        return Model(number, None, "", address, length, ())
    # Offsets of the definition count from the id.
    whole = _Group(definition, [number, length, *registers], address)
    points = tuple(whole.points())
    return Model(number, definition["name"], definition["label"], address, length, points)


@functools.cache
def definitions() -> dict[str, Any]:
    """The definitions of models, by id."""
    text = resources.files("holdfast.discovery").joinpath("sunspec_models.json").read_text("utf-8")
    models: dict[str, Any] = json.loads(text)["models"]
    return models


@dataclass(eq=False)
class _Group:
    """A group of points at its place, with the groups in it."""

    definition: Mapping[str, Any]
    registers: Sequence[int]
    address: int
    offset: int = 0
    prefix: str = ""
    outer: _Group | None = None

    def __post_init__(self) -> None:
        self._places: list[tuple[int, list[Any]]] = []
        self._numbers: dict[str, tuple[int, int]] = {}
        """Offsets and raw values of single registers: counts and scale factors are among them."""
        self._inner: list[_Group] = []
        self.stop = self.offset
        for row in self.definition["points"]:
            size = _size(row[1])
            if self.stop + size > len(self.registers):
                self.stop = len(self.registers)
                return
            self._places.append((self.stop, row))
            if size == 1:
                self._numbers[row[0]] = self.stop, self.registers[self.stop]
            self.stop += size
        for inner in self.definition.get("groups", ()):
            self._repeat(inner)

    def _repeat(self, definition: Mapping[str, Any]) -> None:
        """Adds the repetitions of a group: a number, as many as a point says, or as many as fit."""
        count = definition.get("count", 1)
        is_single = count == 1
        if isinstance(count, str):
            _, found = self._number(count) or (0, 0)
            count = 0 if found == 0xFFFF else found
        elif count == 0:
            count = len(self.registers)
        for index in range(1, count + 1):
            if self.stop >= len(self.registers):
                return
            # Names have a number wherever devices differ in how many there are.
            name = definition["name"] if is_single else f"{definition['name']}_{index}"
            prefix = f"{self.prefix}{name}_"
            group = _Group(definition, self.registers, self.address, self.stop, prefix, self)
            if group.stop == self.stop:
                return
            self._inner.append(group)
            self.stop = group.stop

    def _number(self, name: str) -> tuple[int, int] | None:
        """Offset and raw value of a point of this group or one around it."""
        if name in self._numbers:
            return self._numbers[name]
        return None if self.outer is None else self.outer._number(name)

    def points(self) -> Iterator[Point]:
        """The points that are values, with those of inner groups."""
        for offset, row in self._places:
            if row[1] not in HIDDEN and not (self.outer is None and row[0] in HEADER):
                yield self._point(offset, row)
        for group in self._inner:
            yield from group.points()

    def _point(self, offset: int, row: list[Any]) -> Point:
        full: list[Any] = row + [""] * (7 - len(row))
        name, kind, factor, unit, label, access, symbols = full
        type, missing = TYPES.get(kind, (kind, None))
        registers = self.registers[offset : offset + _size(kind)]
        encoding = encoding_of(registers) if type.startswith("string") else None
        scale = self._scale(factor)
        scaled = self._number(factor) if isinstance(factor, str) and factor else None
        return Point(
            name=f"{self.prefix}{name}",
            address=self.address + offset,
            type=type,
            scale=1 if scale is None else scale,
            scaled_by=factor if isinstance(factor, str) and factor else None,
            scaled_at=None if scaled is None else self.address + scaled[0],
            unit=UNITS.get(unit, unit),
            label=label,
            can_be_written=access == "w",
            states={int(value): text for value, text in (symbols or {}).items()},
            missing=missing,
            value=None if scale is None else _value(registers, type, missing, encoding),
            encoding=encoding,
        )

    def _scale(self, factor: int | str) -> float | None:
        """The scale of a scale factor: a number, or the name of a point; `None` if it has none."""
        if factor == "":
            return 1
        found = self._number(factor) if isinstance(factor, str) else (0, factor & 0xFFFF)
        raw = None if found is None else found[1]
        power = None if raw is None else raw - 0x10000 if raw & 0x8000 else raw
        if power is None or power not in EXPONENTS:
            return None
        return float(f"1e{power}") if power < 0 else 10**power


def _size(kind: str) -> int:
    return 1 if kind in HIDDEN else register_count(TYPES.get(kind, (kind, None))[0])


def _value(registers: Sequence[int], type: str, missing: int | None, encoding: str | None) -> Any:
    if encoding is not None:
        return text_in(registers, encoding)
    value = decode(list(registers), type)
    return None if value == missing or value != value else value
