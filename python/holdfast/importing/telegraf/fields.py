"""What fields of Telegraf's `inputs.modbus` become: tags of devices.

Telegraf has three styles of configuration: `register`, `request` and `metric`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias

from holdfast.importing.names import named_tags
from holdfast.importing.source_requests import Request, joined, read_settings
from holdfast.protocol import ADDRESSES, LAST_ADDRESS, MAX_UNIT
from holdfast.runtime.text import listing
from holdfast.tags.read_gap import DEFAULT_MAX_GAP
from holdfast.types import BIT_AREAS
from holdfast.values import register_count
from holdfast.values.digits import FLOATS
from holdfast.values.numeric import INTEGERS, limits

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from holdfast.config.text.yaml_document import KeyPath
    from holdfast.importing.key_reader import Section
    from holdfast.importing.notes import Desk
    from holdfast.types import Area

MEASUREMENT = "modbus"
"""The default measurement of the source, and of an output."""

MAX_INSERT_FILL = 50
"""The default of the source for metrics; requests have none."""

STYLES: dict[str, tuple[str, ...]] = {
    "register": ("slave_id", "discrete_inputs", "coils", "holding_registers", "input_registers"),
    "request": ("request",),
    "metric": ("metric", "optimization", "optimization_max_register_fill"),
}
"""The styles, with the keys that only they have."""

_TYPES = {kind.upper(): kind for kind in (*INTEGERS, *FLOATS)}
_SIZES = {name: register_count(kind) for name, kind in _TYPES.items()}
"""Registers of a value; one of another type is in one."""

_BYTES = ("INT8L", "INT8H", "UINT8L", "UINT8H")
_INPUT_TYPES = (*_TYPES, *_BYTES, "STRING", "BIT")

_IEEE = {f"{kind}-IEEE": kind for kind in _TYPES if kind.startswith("FLOAT")}
_FIXED = {
    "FIXED": {1: "INT16", 2: "INT32", 4: "INT64"},
    "UFIXED": {1: "UINT16", 2: "UINT32", 4: "UINT64"},
}
"""Integers that become floats, by the number of addresses."""

_DATA_TYPES = (
    *(kind for kind in _INPUT_TYPES if not kind.startswith("FLOAT")),
    *_IEEE,
    *_FIXED,
)

_AREAS: dict[str, Area] = {
    "coil": "coils",
    "discrete": "discrete_inputs",
    "holding": "holding_registers",
    "input": "input_registers",
}

_ORDERS = {
    **{order: order for order in ("ABCD", "CDAB", "BADC", "DCBA")},
    "MSW-BE": "ABCD",
    "LSW-BE": "CDAB",
    "MSW-LE": "BADC",
    "LSW-LE": "DCBA",
}
_ORDERS_OF_REGISTERS = {
    "AB": "ABCD",
    "BA": "DCBA",
    **{order: order for order in ("ABCD", "CDAB", "BADC", "DCBA")},
    "ABCDEFGH": "ABCD",
    "GHEFCDAB": "CDAB",
    "BADCFEHG": "BADC",
    "HGFEDCBA": "DCBA",
}

_OF_ONE_REGISTER = {"ABCD": "ABCD", "CDAB": "ABCD", "BADC": "BADC", "DCBA": "BADC"}
"""Orders that only swap the bytes in each register: those of bits and text in the source."""

_BIT_REASONS = dict.fromkeys(
    ("bit", "byte_order", "length", "scale", "type"),
    "Telegraf ignored it for coils and discrete inputs",
)


Typed: TypeAlias = tuple[dict[str, Any], bool]
"""The settings of a tag, and whether line protocol has another type for it than before."""


@dataclass
class Field:
    """A field of the source, as a tag without its name."""

    path: KeyPath
    name: str
    tag: dict[str, Any]
    retyped: bool
    """Whether line protocol has another type for it: an integer, a float, a boolean."""
    measurement: str = MEASUREMENT
    measured_at: KeyPath | None = None
    """Where the measurement is named; `None` for the default."""
    point_tags: tuple[tuple[str, str], ...] = ()
    """The tags that its points have in the source, sorted by name."""
    tagged_at: KeyPath | None = None
    """Where these are; `None` if there are none."""


@dataclass
class Unit:
    """The fields of one unit id of an input."""

    fields: list[Field] = field(default_factory=list)
    requests: list[Request] = field(default_factory=list)
    """What each request of the source reads."""
    reads: dict[Area, list[range]] = field(default_factory=dict)
    """What fields read that are in no request yet."""

    def join(self, max_gap: int | None) -> None:
        """Makes requests of what fields read: with `None` one for each field."""
        for area, ranges in self.reads.items():
            made = ranges if max_gap is None else joined(ranges, max_gap)
            self.requests += [(area, each) for each in made]
        self.reads = {}

    def series(self) -> list[tuple[str, list[Field]]]:
        """The fields of each measurement and set of tags, with what tells these sets apart."""
        found: dict[tuple[str, tuple[tuple[str, str], ...]], list[Field]] = {}
        for each in self.fields:
            found.setdefault((each.measurement, each.point_tags), []).append(each)
        measurements = {measurement for measurement, _ in found}
        shared = set.intersection(*(set(tags) for _, tags in found))
        made: list[tuple[str, list[Field]]] = []
        for (measurement, tags), fields in found.items():
            words = [measurement] if len(measurements) > 1 else []
            words += [value for name, value in tags if (name, value) not in shared]
            made.append(("-".join(words), fields))
        return made

    def settings(
        self, desk: Desk, fields: list[Field], limits: Mapping[str, int]
    ) -> dict[str, Any]:
        """How these fields are read, and their tags by name; a renamed one has the name of its
        field as description. `limits` are those that the source names.
        """
        tags = named_tags(desk, [(each.path, each.name, each.tag) for each in fields])
        return {**read_settings(self.requests, tags.values()), **limits, "tags": tags}


@dataclass
class Fields:
    """Reads the fields of one input, in the order of the file."""

    source: Section
    location: str | None = None
    """Which bytes of a register contain text: `lower`, `upper`, or both."""
    one_request_per_field: bool = False
    units: dict[int, Unit] = field(default_factory=dict)

    def read(self) -> str:
        """Reads all fields. Returns the style."""
        style = word(self.source, "configuration_type", tuple(STYLES)) or "register"
        if style == "register":
            self._registers()
        elif style == "request":
            for request in self.source.sections("request", required=True):
                self._request(request)
        else:
            gap = self._gap(self.source, MAX_INSERT_FILL)
            for metric in self.source.sections("metric", required=True):
                self._metric(metric)
            for unit in self.units.values():
                unit.join(gap)
        self._note_bits()
        return style

    def _note_bits(self) -> None:
        found = [each for unit in self.units.values() for each in unit.fields if each.retyped]
        if any(each.tag.get("type", "bit:").startswith("bit:") for each in found):
            message = "bits without BOOL are true and false; Telegraf had 1 and 0"
            self.source.desk.changed(self.source.path, message)

    def _unit(self, section: Section) -> Unit:
        number = section.integer("slave_id", 0, MAX_UNIT, what="a unit id")
        return self.units.setdefault(number or 0, Unit())

    def _registers(self) -> None:
        """The style `register`: a list for each area."""
        unit = self._unit(self.source)
        for area in _AREAS.values():
            for entry in self.source.sections(area):
                self._register(unit, entry, area)
        unit.join(None if self.one_request_per_field else 0)

    def _register(self, unit: Unit, entry: Section, area: Area) -> None:
        name = entry.name("name", required=True)
        addresses = self._addresses(entry)
        found: Typed | None = None
        if area in BIT_AREAS:
            found = self._bit_of_area(entry, "data_type")
            if addresses is not None and len(addresses) != 1:
                self._wrong_count(entry, "coils and discrete inputs", len(addresses), "1")
            self._add(unit, entry, name, addresses, area, found, [entry])
            entry.close(_BIT_REASONS)
            return
        kind = self._data_type(entry, addresses)
        order = entry.word("byte_order", tuple(_ORDERS_OF_REGISTERS), required=True)
        if kind is not None and addresses and order is not None:
            found = self._of_registers(entry, kind, len(addresses), order)
        self._add(unit, entry, name, addresses, area, found, [entry])
        entry.close({"bit": "Telegraf used it for BIT only"})

    def _data_type(self, entry: Section, addresses: range | None) -> str | None:
        if entry.get("data_type") == "FLOAT32":
            if addresses is not None and len(addresses) == 1:
                # An IEEE float has two registers: Telegraf fails with it since 1.37.
                entry.check("data_type", "FLOAT32 at one address: UFIXED, as until Telegraf 1.36")
                return "UFIXED"
            message = "found FLOAT32, unsigned integers until Telegraf 1.36 and IEEE floats since"
            allowed = "allowed: UFIXED or FLOAT32-IEEE"
            entry.problem("data_type", f"{message}, {allowed}")
            return None
        return entry.word("data_type", _DATA_TYPES, required=True)

    def _addresses(self, entry: Section) -> range | None:
        """The addresses of a list, which must follow each other."""
        listed = entry.entries("address", required=True)
        if listed is None:
            return None
        numbers = [value for _, value in listed]
        for path, value in listed:
            if type(value) is not int or not 0 <= value <= LAST_ADDRESS:
                message = f"found {value!r}, allowed: an address from 0 to {LAST_ADDRESS}"
                entry.desk.problem(path, message)
                return None
        if not numbers or numbers != list(range(numbers[0], numbers[0] + len(numbers))):
            message = f"found {listing(numbers) or 'no address'}, allowed: addresses that follow"
            entry.problem("address", f"{message} each other, the lowest first")
            return None
        return range(numbers[0], numbers[0] + len(numbers))

    def _of_registers(self, entry: Section, kind: str, count: int, order: str) -> Typed | None:
        """Settings of registers in the style `register`, whose length is that of a list."""
        order_here = _ORDERS_OF_REGISTERS[order]
        if kind == "STRING":
            return self._text(entry, count, order_here)
        if kind == "BIT":
            if count != 1:
                self._wrong_count(entry, kind, count, "1")
                return None
            return self._bit(entry, order_here)
        if kind in _FIXED:
            if count not in _FIXED[kind]:
                self._wrong_count(entry, kind, count, "1, 2 or 4")
                return None
            real, output = _FIXED[kind][count], "FLOAT64"
        else:
            real, output = _IEEE.get(kind, kind), "native"
        size = _SIZES.get(real, 1)
        if count != size:
            self._wrong_count(entry, kind, count, str(size))
            return None
        if len(order) != 2 * count:
            message = f"found {order} with {count} addresses, allowed: {2 * count} letters"
            entry.problem("byte_order", message)
            return None
        if not entry.get("scale"):
            message = "missing or 0, allowed: any other number; 1.0 leaves the value as it is"
            entry.problem_of_key("scale", message)
            return None
        return self._number(entry, real, order_here, output)

    def _wrong_count(self, entry: Section, kind: str, count: int, allowed: str) -> None:
        entry.problem("address", f"found {count} addresses, allowed with {kind}: {allowed}")

    def _request(self, request: Section) -> None:
        """The style `request`: fields of one area."""
        unit = self._unit(request)
        known = len(unit.fields)
        area = _AREAS[word(request, "register", tuple(_AREAS)) or "holding"]
        order = _ORDERS[word(request, "byte_order", tuple(_ORDERS)) or "ABCD"]
        for entry in self._entries(request):
            if entry.flag("omit"):
                unit.reads.setdefault(area, []).append(self._omitted(entry, area))
            else:
                self._field(unit, entry, area, order, [entry, request])
        unit.join(self._gap(request, None))
        request.text("measurement")
        self._tag(request, unit.fields[known:])
        request.close()

    def _metric(self, metric: Section) -> None:
        """The style `metric`: fields of any area."""
        unit = self._unit(metric)
        known = len(unit.fields)
        order = _ORDERS[word(metric, "byte_order", tuple(_ORDERS)) or "ABCD"]
        for entry in self._entries(metric):
            area = _AREAS[word(entry, "register", tuple(_AREAS)) or "holding"]
            self._field(unit, entry, area, order, [metric])
        metric.text("measurement")
        self._tag(metric, unit.fields[known:])
        metric.close()

    def _entries(self, section: Section) -> list[Section]:
        if section.get("fields") == []:
            section.problem("fields", "no field, allowed: at least one")
        return section.sections("fields", required=True)

    def _tag(self, section: Section, fields: list[Field]) -> None:
        """Gives fields the tags of their request or metric."""
        table = section.mapping("tags")
        given = table.data.items() if table is not None else ()
        if tags := tuple(sorted((name, str(value)) for name, value in given if value)):
            for each in fields:
                each.point_tags, each.tagged_at = tags, section.at("tags")

    def _gap(self, section: Section, default: int | None) -> int | None:
        """The largest gap that the source read to join two fields; `None` if it joined none."""
        allowed = ("none", "shrink", "rearrange", "aggressive", "max_insert")
        kind = word(section, "optimization", allowed)
        fill = section.integer("optimization_max_register_fill", 0, 2000)
        if self.one_request_per_field:
            return None
        if kind == "aggressive":
            message = f"gaps of up to {DEFAULT_MAX_GAP} are read; see max_gap of the device"
            section.changed("optimization", message)
            return DEFAULT_MAX_GAP
        return (fill or default or 0) if kind == "max_insert" else 0

    def _omitted(self, entry: Section, area: Area) -> range:
        """The addresses of a field that is only there to be read with the others."""
        for key in entry.data:
            entry.get(key)
        address = entry.integer("address", 0, LAST_ADDRESS) or 0
        kind = entry.text("type")
        if area in BIT_AREAS:
            size = 1
        elif kind == "STRING":
            size = entry.integer("length", 1, LAST_ADDRESS) or 1
        else:
            size = _SIZES.get(kind or "", 1)
        return range(address, address + size)

    def _field(
        self, unit: Unit, entry: Section, area: Area, order: str, measured: list[Section]
    ) -> None:
        """A field with its own type, in the styles `request` and `metric`."""
        name = entry.name("name", required=True)
        address = entry.integer("address", 0, LAST_ADDRESS) or 0
        found: Typed | None = None
        if area in BIT_AREAS:
            found = self._bit_of_area(entry, "output")
            addresses = range(address, address + 1)
            self._add(unit, entry, name, addresses, area, found, measured)
            entry.close(_BIT_REASONS)
            return
        kind = entry.word("type", _INPUT_TYPES, required=True)
        output = word(entry, "output", ("INT64", "UINT64", "FLOAT64", "STRING"))
        length, size = self._length(entry, kind)
        if kind is not None and (output == "STRING") > (kind == "STRING"):
            entry.problem("output", "found STRING, allowed: only with type STRING")
        elif kind == "STRING" and length:
            found = self._text(entry, length, order)
        elif kind == "BIT":
            found = self._bit(entry, order)
        elif kind is not None and kind != "STRING":
            scaled = "FLOAT64" if entry.get("scale") else "native"
            found = self._number(entry, kind, order, output or scaled)
        self._add(unit, entry, name, range(address, address + size), area, found, measured)
        entry.close()

    def _length(self, entry: Section, kind: str | None) -> tuple[int | None, int]:
        """The length that is given, and the number of registers."""
        length = entry.integer("length", 0, LAST_ADDRESS, what="registers")
        bit = entry.get("bit")
        if kind != "STRING" and length:
            entry.problem("length", f"found {length}, allowed: only with STRING")
        if kind == "STRING" and not entry.get("length"):
            entry.problem_of_key("length", "missing, allowed: the number of registers")
        if kind != "BIT" and bit:
            entry.problem("bit", f"found {bit}, allowed: only with BIT")
        if kind == "STRING":
            return length, length or 1
        return None, _SIZES.get(kind or "", 1)

    def _bit_of_area(self, entry: Section, key: str) -> Typed:
        output = word(entry, key, ("UINT16", "BOOL"))
        return {}, output != "BOOL"

    def _bit(self, entry: Section, order: str) -> Typed | None:
        number = entry.integer("bit", 0, 15, what="a bit")
        if entry.get("scale"):
            entry.left_out("scale", "Telegraf ignored it for bits")
        return {"type": f"bit:{number or 0}", **_order(_OF_ONE_REGISTER[order])}, True

    def _text(self, entry: Section, count: int, order: str) -> Typed | None:
        """Text of registers in their order, whatever the order of bytes is."""
        if entry.get("scale"):
            entry.left_out("scale", "Telegraf ignored it for text")
        if self.location in ("lower", "upper"):
            message = f"text in the {self.location} byte of each register: there is no such type"
            entry.desk.left_out(entry.path, f"{message}; read the registers as uint16[{count}]")
            return None
        message = "all NULs at its end are removed, not only one; other text than UTF-8 is an error"
        entry.desk.changed(entry.path, message)
        settings = {"type": f"string:{2 * count}", **_order(_OF_ONE_REGISTER[order])}
        return {**settings, "encoding": "utf-8"}, False

    def _number(self, entry: Section, kind: str, order: str, output: str) -> Typed | None:
        """A number with its scale. `native` is the output type that the type itself has."""
        scale = entry.number("scale") or 1
        if kind in _BYTES:
            message = f"no type has one byte ({kind}): read the register as uint16, or its bits"
            entry.desk.left_out(entry.path, message)
            return None
        is_float, as_integer = kind.startswith("FLOAT"), output not in ("native", "FLOAT64")
        if is_float and as_integer:
            entry.problem("output", f"found {output} with {kind}, allowed: FLOAT64")
            return None
        is_whole = float(scale).is_integer()
        was_float = is_float or output == "FLOAT64"
        if not was_float and not is_whole:
            entry.changed("scale", "digits behind the point are kept; Telegraf dropped them")
        if not was_float:
            key, kept = ("scale", kind) if output == "native" else ("output", output)
            if not _fits(kind, int(scale) if is_whole else scale, kept):
                message = f"numbers beyond {kept} stay as they are; Telegraf had other ones"
                entry.changed(key, message)
        settings = {"type": _TYPES[kind]}
        settings |= _order(_OF_ONE_REGISTER[order] if _SIZES[kind] == 1 else order)
        becomes_float = is_float or not is_whole or not _fits(kind, int(scale), "INT64")
        return settings | ({} if scale == 1 else {"scale": scale}), was_float != becomes_float

    def _add(
        self,
        unit: Unit,
        entry: Section,
        name: str | None,
        addresses: range | None,
        area: Area,
        found: Typed | None,
        measured: Iterable[Section],
    ) -> None:
        """Adds a tag, and notes its measurement."""
        named = [(each.at("measurement"), each.text("measurement")) for each in measured]
        if addresses is not None:
            unit.reads.setdefault(area, []).append(addresses)
        if name is None or addresses is None or found is None:
            return
        if addresses.stop > ADDRESSES:
            message = f"found {addresses.start}, allowed: up to {ADDRESSES - len(addresses)}"
            entry.problem("address", message)
            return
        settings, retyped = found
        tag = {"area": area, "address": addresses.start, **settings}
        made = Field(entry.at("name"), name, tag, retyped)
        for path, measurement in named:
            if measurement is not None and made.measured_at is None:
                made.measurement, made.measured_at = measurement, path
        unit.fields.append(made)


def _fits(kind: str, factor: float, kept: str) -> bool:
    """Whether all integers of one type, times a factor, are within another type."""
    least, most = limits(_TYPES[kept])
    return all(least <= factor * end <= most for end in limits(_TYPES[kind]))


def _order(order: str) -> dict[str, str]:
    """The byte order, if it is not the default."""
    return {} if order == "ABCD" else {"order": order}


def word(section: Section, key: str, allowed: tuple[str, ...]) -> str | None:
    """The word at a key. Empty text counts as absent in the source."""
    return None if section.get(key) == "" else section.word(key, allowed)
