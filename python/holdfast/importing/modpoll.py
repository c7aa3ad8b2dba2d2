"""Imports configurations of modpoll, the Python program: its references become tags of devices.

The file is CSV with a row for each device, poll and reference. modpoll skips most rows that it
can't use; each of them is a note.
"""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from holdfast.config.text import yaml_document
from holdfast.config.text.messages import show
from holdfast.config.text.problems import ConfigError, Problem
from holdfast.importing.imported import Imported, NotImportable
from holdfast.importing.names import free_name, named_tags, unique_names
from holdfast.importing.notes import Desk
from holdfast.importing.source_requests import read_settings
from holdfast.protocol import ADDRESSES, MAX_UNIT, WRITE_LIMITS
from holdfast.types import AREAS, REGISTER_AREAS, Area
from holdfast.values import register_count
from holdfast.values.digits import FLOATS
from holdfast.values.numeric import INTEGERS
from holdfast.values.orders import SWAPPED_BYTES

if TYPE_CHECKING:
    from collections.abc import Iterator

    from holdfast.config.text.yaml_document import KeyPath

INTERVAL_S = 10.0
"""Seconds between polls without `--rate`, in the source too."""

_TIMEOUT_S = 3
_KINDS = ("device", "poll", "ref")
_MIN_CELLS = {"device": 3, "poll": 5, "ref": 5}

_AREAS: dict[str, Area] = dict(
    zip(("coil", "discrete_input", "holding_register", "input_register"), AREAS, strict=True)
)
_MAX_BITS = 2000
_MAX_REGISTERS = 123

_ORDERS = {"be_be": "ABCD", "le_be": "BADC", "le_le": "DCBA", "be_le": "CDAB"}
_OTHER_ORDER = "CDAB"
"""That of all other words."""

_WIDTHS = {kind: register_count(kind) for kind in (*INTEGERS, *FLOATS)}
_LISTS = {"bool": 1, "bool8": 1, "bool16": 2}
"""The types that are lists of bits, and how far they reach: registers, or bytes of coils."""


def read_modpoll(path: Path | str, url: str, interval_s: float = INTERVAL_S) -> Imported:
    """Converts a configuration of modpoll; `url` is what its command line names.

    Raises `ConfigError` with every problem that prevents the import.
    """
    rows = _Rows(str(path))
    rows.read(yaml_document.read_text(Path(path), rows.file, "CSV"))
    desk = Desk(yaml_document.table(rows.file, rows.data, rows.lines), folds=True)
    found = list(_devices(desk, rows))
    if not found and not desk.report.problems:
        desk.problem((), "no device with a reference that is read, allowed: at least one")
    names = unique_names(desk, [(each.path, str(each.path[0])) for each in found])
    timing = {"interval": interval_s, "timeout": _TIMEOUT_S}
    devices = {
        name: {"url": url, "unit": each.unit, **timing, **each.settings(desk)}
        for name, each in zip(names, found, strict=True)
    }
    if desk.report.problems:
        raise NotImportable(rows.file, desk.report.problems, desk.notes)
    message = "values are not published: add outputs for what the command line of modpoll says"
    desk.check((), message)
    return Imported(rows.file, "modpoll", "modpoll", {"devices": devices}, desk.notes)


@dataclass
class _Rows:
    """The rows of a file, each with its path: the device, and the reference or the poll."""

    file: str
    found: list[tuple[str, KeyPath, list[str]]] = field(default_factory=list)
    data: dict[str, dict[str, Any]] = field(default_factory=dict)
    lines: dict[KeyPath, int] = field(default_factory=dict)

    def read(self, text: str) -> None:
        """Takes all rows. Raises `ConfigError`."""
        reader = csv.reader(io.StringIO(text, newline=""))
        device, path = "", tuple[str, ...]()
        try:
            for cells in reader:
                # As in the source: "# device" is a device, too.
                kind = next((each for each in _KINDS if each in "".join(cells[:1]).lower()), None)
                if kind is None:
                    continue
                name = cells[1].strip() if len(cells) > 1 and kind != "poll" else ""
                if kind == "device":
                    device = free_name(name or kind, set(self.data))
                    self.data[device], path = {}, (device,)
                else:
                    inside = self.data[device] if device else self.data
                    label = free_name(name or kind, set(inside))
                    inside[label], path = {}, (device, label) if device else (label,)
                self.lines[path] = reader.line_num
                self.found.append((kind, path, cells))
        except csv.Error as error:
            problem = Problem(self.file, reader.line_num, None, "", f"not CSV: {error}")
            raise ConfigError(self.file, [problem]) from None


@dataclass(frozen=True)
class _Poll:
    """What one request of the source reads."""

    area: Area
    start: int
    size: int
    order: str
    references: list[_Reference] = field(default_factory=list)
    """Those that are read, in the order of the file."""

    @property
    def is_of_bits(self) -> bool:
        return self.area not in REGISTER_AREAS

    @property
    def end(self) -> int:
        return self.start + self.size


@dataclass(frozen=True)
class _Reference:
    path: KeyPath
    name: str
    address: int
    bit: int | None
    type: str
    settings: dict[str, Any]
    """The keys that its tags have besides their places and types."""

    @property
    def width(self) -> int:
        """Registers, or bytes of coils."""
        if self.type.startswith("string"):
            length = self.type[len("string") :]
            # Longer than any poll anyway: Python converts no number of thousands of digits.
            return (int(length[:9]) + 1) // 2 if length.isdecimal() else 1
        return (_WIDTHS | _LISTS).get(self.type, 1)


@dataclass
class _Device:
    path: KeyPath
    unit: int
    polls: list[_Poll] = field(default_factory=list)
    tags: list[tuple[KeyPath, str, dict[str, Any]]] = field(default_factory=list)

    def settings(self, desk: Desk) -> dict[str, Any]:
        """The tags by name, and how they are read; a renamed one has its reference's name as
        description.
        """
        tags = named_tags(desk, self.tags)
        requests = [(each.area, range(each.start, each.end)) for each in self.polls]
        return {**read_settings(requests, tags.values()), "tags": tags}


def _devices(desk: Desk, rows: _Rows) -> Iterator[_Device]:
    """The devices that have tags."""
    made: list[_Device] = []
    poll: _Poll | None = None
    for kind, path, cells in rows.found:
        is_whole = len(cells) >= _MIN_CELLS[kind]
        is_comment = cells[0].lstrip().startswith("#")
        if kind == "device" and is_comment and is_whole and _integer(cells[2]) is None:
            # A comment on the form of devices: what follows is of the device before it.
            desk.left_out(path, f"found {show(cells[2])}, no unit id; modpoll ignored it")
            continue
        if cells[0].strip().lower() != kind and is_whole:
            desk.check(path, f"{show(cells[0])} is a {kind}, as in modpoll")
        if kind == "device" and (is_whole or cells[0].strip().lower() == kind):
            # The source gave what follows a device that is not valid to the one before it.
            unit = _integer(cells[2]) if is_whole else None
            if unit is None or not 0 <= unit <= MAX_UNIT:
                found = show(cells[2]) if is_whole else f"{len(cells)} cells"
                allowed = f"allowed: device,NAME,UNIT, with a unit id from 0 to {MAX_UNIT}"
                desk.problem(path, f"found {found}, {allowed}")
            made.append(_Device(path, unit or 0))
            poll = None
        elif not is_whole:
            message = f"a row of {len(cells)} cells, allowed: at least {_MIN_CELLS[kind]}"
            desk.left_out(path, message)
            poll = None if kind == "poll" else poll
        elif not made:
            desk.left_out(path, "no device is above it")
        elif kind == "poll":
            poll = _poll(desk, path, cells)
            if poll is not None:
                made[-1].polls.append(poll)
        elif poll is None:
            desk.left_out(path, "no poll that is read is above it")
        else:
            _take(desk, poll, path, cells)
    for device in made:
        for each in device.polls:
            device.tags += _bit_tags(desk, each) if each.is_of_bits else _tags(desk, each)
        _leave_out_replaced(desk, device)
        if device.tags:
            yield device
        else:
            desk.left_out(device.path, "no reference of it is read")


def _leave_out_replaced(desk: Desk, device: _Device) -> None:
    """Leaves out the references whose name a later one has: the source had one value for it."""
    references = [each for poll in device.polls for each in poll.references]
    last = {each.name: each.path for each in references}
    for each in references:
        if (path := last[each.name]) != each.path:
            line = desk.document.place(path, of_key=True).line
            desk.withdraw(each.path)
            message = f"line {line} has this name, too: the last counts, as in modpoll"
            desk.left_out(each.path, message)
    kept = set(last.values())
    device.tags = [each for each in device.tags if each[0] in kept]


def _integer(text: str) -> int | None:
    """A number as the source reads it: decimal, 0x, 0o or 0b."""
    try:
        return int(text, 0)
    except ValueError:
        return None


def _poll(desk: Desk, path: KeyPath, cells: list[str]) -> _Poll | None:
    area = _AREAS.get(cells[1].lower())
    start, size = _integer(cells[2]), _integer(cells[3])
    if area is None:
        words = ", ".join(_AREAS)
        desk.left_out(path, f"found {show(cells[1])}, allowed: {words}; modpoll ignored it")
        return None
    most = _MAX_REGISTERS if area in REGISTER_AREAS else _MAX_BITS
    if start is None or size is None or size > most or not 0 <= start <= ADDRESSES - size:
        found = f"found {show(cells[2])} and {show(cells[3])}"
        desk.left_out(path, f"{found}, allowed: a first address, and a number up to {most}")
        return None
    order = _ORDERS.get(cells[4].lower())
    if order is None and area in REGISTER_AREAS:
        message = f"{show(cells[4])} is none of BE_BE, BE_LE, LE_BE, LE_LE"
        desk.check(path, f"{message}: read as BE_LE, as in modpoll")
    return _Poll(area, start, size, order or _OTHER_ORDER)


def _take(desk: Desk, poll: _Poll, path: KeyPath, cells: list[str]) -> None:
    """Adds a reference to its poll, if the source does so."""
    type_ = cells[3].lower()
    address, bit = _place(cells[2])
    if address is None or (bit is not None and type_ != "bool"):
        allowed = "allowed: an address, or with the type bool address:bit, bit 0 to 15"
        desk.problem(path, f"found {show(cells[2])} of type {show(cells[3])}, {allowed}")
        return
    rights = (cells[4] or "r").lower()
    settings: dict[str, Any] = {}
    scale = _scale(desk, path, cells[6] if len(cells) > 6 else "")
    if scale is not None and type_ in _WIDTHS:
        settings["scale"] = scale
    if len(cells) > 5 and (unit := " ".join(cells[5].split())):
        settings["unit"] = unit
    if "w" in rights and poll.area in WRITE_LIMITS:
        settings["writable"] = True
    name = cells[1].replace(" ", "_")
    reference = _Reference(path, name, address, bit, type_, settings)
    of_place = [each for each in poll.references if (each.address, each.bit) == (address, bit)]
    if of_place:
        first = of_place[0].name
        desk.left_out(path, f"{first} has this address; modpoll read only the first reference")
    elif not poll.start <= address <= poll.end - reference.width:
        desk.left_out(path, f"not in its poll, {poll.area} {poll.start} to {poll.end - 1}")
    elif "r" not in rights:
        desk.left_out(path, "a reference that is not read; tags are")
    else:
        poll.references.append(reference)


def _place(text: str) -> tuple[int | None, int | None]:
    """An address, and a bit if there is one; the address is `None` if one of them is not valid."""
    first, colon, last = text.partition(":")
    address = _integer(first)
    if not colon:
        return address, None
    try:
        bit = int(last)
    except ValueError:
        return None, None
    return (address, bit) if 0 <= bit <= 15 else (None, None)


def _scale(desk: Desk, path: KeyPath, text: str) -> float | None:
    """A scale, if there is one: the source ignores text and 0."""
    try:
        found = float(text)
    except ValueError:
        if text.strip():
            desk.left_out(path, f"{show(text)} is no scale; modpoll ignored it")
        return None
    if not math.isfinite(found):
        desk.problem(path, f"found the scale {show(text)}, allowed: a number")
        return None
    return found if found not in (0, 1) else None


def _tags(desk: Desk, poll: _Poll) -> Iterator[tuple[KeyPath, str, dict[str, Any]]]:
    """The tags of a poll of registers."""
    swaps_bytes = poll.order in SWAPPED_BYTES
    for each in poll.references:
        place = {"area": poll.area, "address": each.address}
        if each.bit is not None:
            bit = each.bit ^ 8 if swaps_bytes else each.bit
            yield each.path, each.name, {**place, "type": f"bit:{bit}", **each.settings}
        elif each.type in _LISTS:
            # The bits of the high byte are first.
            bits = [*range(8, 16), *range(8 if each.type == "bool16" else 0)]
            places = [{**place, "type": f"bit:{bit}"} for bit in bits]
            yield from _elements(desk, each, dict(enumerate(places)), "the high byte first")
        elif each.type.startswith("string") and each.width:
            kind = {"type": f"string:{2 * each.width}", "encoding": "utf-8"}
            yield each.path, each.name, {**place, **kind, **each.settings}
        elif each.type in _WIDTHS:
            has_order = poll.order != "ABCD" and (swaps_bytes or each.width > 1)
            order = {"order": poll.order} if has_order else {}
            yield each.path, each.name, {**place, "type": each.type, **order, **each.settings}
        else:
            desk.left_out(each.path, f"{show(each.type)} is no type; modpoll had no value")


def _bit_tags(desk: Desk, poll: _Poll) -> Iterator[tuple[KeyPath, str, dict[str, Any]]]:
    """The tags of a poll of coils or discrete inputs.

    The source takes a byte of the reply after the other: an address behind the start of the poll
    counts bytes, and begins later if the reference before it has taken that byte. A single bit, as
    a type of registers, takes more bytes than it counts.
    """
    at, byte = poll.start, 0
    for each in poll.references:
        byte += max(0, each.address - at)
        at = max(at, each.address) + each.width
        first = poll.start + 8 * byte
        is_known = each.type in _WIDTHS | _LISTS or each.type.startswith("string")
        is_list = each.type in _LISTS and each.bit is None
        byte += (each.width if is_list else 2 * each.width) if is_known else 0
        if each.type not in _LISTS:
            message = f"{show(each.type)} is no type of coils here, allowed: bool, bool8, bool16"
            desk.left_out(each.path, message)
        elif first + (0 if is_list else 8) >= poll.end:  # A list has what is left.
            desk.left_out(each.path, "the reply ended before its byte; modpoll had no value")
        elif each.bit is not None:
            # A bit of a number with 16 bits, whose first coil is the highest bit.
            bit = each.bit ^ 8 if poll.order in SWAPPED_BYTES else each.bit
            coil = first + 15 - bit
            if coil < poll.end:
                place = {"area": poll.area, "address": coil, "type": "bool"}
                yield each.path, each.name, {**place, **each.settings}
            else:
                desk.left_out(each.path, f"not in its poll, coil {coil}; modpoll had false")
        else:
            # Each byte has its last coil first.
            coils = (first + 8 * byte + 7 - bit for byte in range(each.width) for bit in range(8))
            places = {
                index: {"area": poll.area, "address": coil, "type": "bool"}
                for index, coil in enumerate(coils)
                if coil < poll.end
            }
            yield from _elements(desk, each, places, "the last bit of each byte first")


def _elements(
    desk: Desk, one: _Reference, places: dict[int, dict[str, Any]], order: str
) -> Iterator[tuple[KeyPath, str, dict[str, Any]]]:
    """A tag for each element of a list, by its number."""
    names = f"{one.name}_{min(places)} to {one.name}_{max(places)}"
    desk.changed(one.path, f"a list of bits, {order}: {names}, one tag for each")
    for number, place in places.items():
        yield one.path, f"{one.name}_{number}", {**place, **one.settings}
