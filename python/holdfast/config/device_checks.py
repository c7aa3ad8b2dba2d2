"""Checks rules between keys of devices: destinations, ranges, forwards and serial lines.

A serial line that is polled for NATS subscribers can't have another user.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from pydantic import TypeAdapter

from holdfast.client.target import SerialTarget, parse
from holdfast.client.tolerance import STRICT, Tolerance
from holdfast.config.devices import LAST_SLOT, STATUS_BLOCK, ToleranceConfig
from holdfast.config.files import check_readable
from holdfast.config.initial import extent
from holdfast.config.lenient import entries, fitting, integer, mapping, parsed
from holdfast.config.listeners import SERIAL_TYPES
from holdfast.config.memory_checks import addresses
from holdfast.config.scalars import NOT_ON_A_LINE, parse_url
from holdfast.config.scanning import parse_pollable
from holdfast.config.words import choice, listing, show
from holdfast.net.allow_list import AllowedDevice
from holdfast.protocol import ADDRESSES, LAST_ADDRESS, MAX_SERIAL_UNIT, MAX_UNIT, MAX_WORD
from holdfast.types import AREAS, BIT_AREAS, REGISTER_AREAS, SERIAL_FRAMES, Area

if TYPE_CHECKING:
    from pathlib import Path

    from holdfast.client.target import Target
    from holdfast.config.grant_checks import GrantChecks
    from holdfast.config.report import Report
    from holdfast.config.source import KeyPath

MAX_OF_A_PACKET = MAX_WORD
"""The maximum number of values in one raw ingest packet."""

_NAMING = {"v1": "unit", "crc": "memory_id"}
"""The key for the target of a packet, by format."""


@dataclass(frozen=True)
class Claim:
    """Addresses of a memory that a read or status block writes; `path` is its place in the file."""

    path: KeyPath
    memory: str
    area: Area
    addresses: range

    def __str__(self) -> str:
        return f"{self.area} {extent(self.addresses)} of {self.memory}"


@dataclass(frozen=True)
class _Shared:
    """What devices of one address have in common."""

    tolerance: Tolerance
    in_flight: object


@dataclass
class DeviceChecks:
    """Checks the devices of one file; files are relative to `folder`."""

    folder: Path
    report: Report
    grants: GrantChecks
    memories: dict[Any, Any]
    """The memories, as in the file and not validated."""

    def __post_init__(self) -> None:
        self._claims: list[Claim] = []
        self._lines: dict[str, tuple[KeyPath, SerialTarget]] = {}
        self._addresses: dict[tuple[str, str, int], tuple[KeyPath, _Shared]] = {}

    def check(self, data: dict[Any, Any]) -> None:
        """Reports what is wrong."""
        taken = _serial_listeners(data)
        for name, device in mapping(data.get("devices")).items():
            if isinstance(device, dict):
                self._device(("devices", name), device, taken)
        self._subscribed(entries(mapping(data.get("nats")).get("devices")), taken)
        self._overlaps()

    def _device(self, path: KeyPath, device: dict[Any, Any], taken: dict[str, KeyPath]) -> None:
        target = parsed(_target, device.get("url"))
        if target is not None:
            target = self._tolerance(path, target, device)
            self._shared(path, target, device)
        if isinstance(target, SerialTarget):
            self._line(path, target, device.get("unit"), taken)
        elif target is not None:
            for key, file in target.tls.files():
                where, shown = (*path, "url"), f"{key}={show(file)}"
                check_readable(where, file, self.folder, self.report, shown=shown)
        if "max_gap" in device and "cost" in device:
            message = "found together with max_gap, allowed: only one of them"
            self.report.add((*path, "cost"), message, of_key=True)
        if device.get("readable") and not device.get("max_gap") and "cost" not in device:
            message = "has no effect: gaps are read only with max_gap or cost"
            self.report.doubt((*path, "readable"), message)
        self._ranges((*path, "readable"), device.get("readable"))
        forbidden = self._ranges((*path, "forbidden"), device.get("forbidden"))
        for index, forward in enumerate(entries(device.get("forward"))):
            self._forward((*path, "forward", index), mapping(forward))
        for index, read in enumerate(entries(device.get("reads"))):
            if isinstance(read, dict):
                forwarded = bool(device.get("forward"))
                self._read((*path, "reads", index), read, forbidden, forwarded=forwarded)
        if isinstance(device.get("status"), dict):
            self._status((*path, "status"), device["status"])

    def _tolerance(self, path: KeyPath, target: Target, device: dict[Any, Any]) -> Target:
        """The target with what its device needs tolerated."""
        block = device.get("tolerance")
        if block is None:
            return target
        where = (*path, "tolerance")
        if target.tolerance != STRICT:
            message = "found beside options of the URL, allowed: one of both"
            self.report.add(where, message, of_key=True)
        if mapping(block).get("echo") is True and not _has_echo(target):
            message = "found true, allowed with RTU and ASCII frames only"
            self.report.add((*where, "echo"), message)
        found = fitting(TypeAdapter(ToleranceConfig), block)
        tolerance = STRICT if found is None else Tolerance(**found.model_dump())
        return replace(target, tolerance=tolerance)

    def _shared(self, path: KeyPath, target: Target, device: dict[Any, Any]) -> None:
        """What devices of one address share, which have one connection."""
        if isinstance(target, SerialTarget):
            return
        settings = _Shared(target.tolerance, device.get("in_flight", 1))
        key = (target.transport, target.host, target.port)
        first, other = self._addresses.setdefault(key, (path, settings))
        if settings != other:
            differs = "in_flight" if settings.in_flight != other.in_flight else "tolerance"
            where = (*path, differs if differs in device else "url")
            message = f"found another {differs} than {self._named(first)} has at this address"
            self.report.add(where, f"{message}, allowed: the same")

    def _line(
        self, path: KeyPath, target: SerialTarget, unit: object, taken: dict[str, KeyPath]
    ) -> None:
        """Devices share a serial line only with equal settings, and never with a listener."""
        number = integer(unit, 0, MAX_UNIT)
        if number is not None and not 1 <= number <= MAX_SERIAL_UNIT:
            allowed = (
                f"allowed on a serial line: a unit id from 1 to {MAX_SERIAL_UNIT}{NOT_ON_A_LINE}"
            )
            self.report.add((*path, "unit"), f"found {number}, {allowed}")
        port = os.path.realpath(target.device)
        if port in taken:
            self._taken((*path, "url"), target.device, taken[port])
        first, other = self._lines.setdefault(port, (path, target))
        if replace(target, device=other.device) != other:
            message = f"found line settings that differ from those of {self._named(first)}"
            self.report.add((*path, "url"), f"{message}, allowed: the same settings")

    def _subscribed(self, devices: list[Any], taken: dict[str, KeyPath]) -> None:
        """Reports serial lines of the scanner that a device or a listener uses."""
        lines = {port: path for port, (path, _) in self._lines.items()} | taken
        for index, device in enumerate(devices):
            entry = parsed(parse_pollable, device)
            port = os.path.realpath(entry.path) if isinstance(entry, AllowedDevice) else None
            if port in lines:
                self._taken(("nats", "devices", index), str(entry), lines[port])

    def _taken(self, path: KeyPath, device: str, owner: KeyPath) -> None:
        of = self._named(owner)
        message = f"found {show(device)}, which is the device of {of}, allowed: a different one"
        self.report.add(path, message)

    def _ranges(self, path: KeyPath, ranges: object) -> list[tuple[KeyPath, object, range]]:
        """The valid ranges, each with its path and its area."""
        found = []
        for index, each in enumerate(entries(ranges)):
            if not isinstance(each, dict):
                continue
            here = (*path, index)
            if "end" in each and "count" in each:
                message = "found together with end, allowed: only one of them"
                self.report.add((*here, "count"), message, of_key=True)
            elif not each.keys() & {"end", "count"}:
                message = "found neither end nor count, allowed: one of them"
                self.report.add(here, message, of_key=True)
            else:
                span = self._range(here, each)
                if span is not None:
                    found.append((here, each.get("area"), span))
        return found

    def _range(self, path: KeyPath, each: dict[Any, Any]) -> range | None:
        start = integer(each.get("start"), 0, LAST_ADDRESS)
        if "count" in each:
            return self._sum(path, start, each["count"], "start")
        end = integer(each["end"], 0, LAST_ADDRESS)
        if start is None or end is None:
            return None
        if end < start:
            message = f"found {end}, allowed: the last address, {start} or more"
            self.report.add((*path, "end"), message)
            return None
        return range(start, end + 1)

    def _sum(self, path: KeyPath, first: int | None, count: object, key: str) -> range | None:
        """The `count` addresses from `first` on, `None` if they are not valid."""
        number = integer(count, 1, ADDRESSES)
        if first is None or number is None:
            return None
        if first + number > ADDRESSES:
            message = f"found {key} {first} and count {number}, allowed: a sum up to {ADDRESSES}"
            self.report.add((*path, "count"), message)
            return None
        return range(first, first + number)

    def _forward(self, path: KeyPath, forward: dict[Any, Any]) -> None:
        form = forward.get("format", "v1")
        if "crc" in forward and form == "v1":
            message = "found with format v1, allowed: only with format crc"
            self.report.add((*path, "crc"), message, of_key=True)
        if form not in ("v1", "crc") or not forward:
            return
        needed, other = _NAMING[form], _NAMING["v1" if form == "crc" else "crc"]
        if needed not in forward:
            message = f"missing with format {form}, allowed: an integer from 0 to {MAX_WORD}"
            self.report.add((*path, needed), message, of_key=True)
        if other in forward:
            message = f"found with format {form}, allowed: {needed}"
            self.report.add((*path, other), message, of_key=True)

    def _read(
        self,
        path: KeyPath,
        read: dict[Any, Any],
        forbidden: list[tuple[KeyPath, object, range]],
        *,
        forwarded: bool,
    ) -> None:
        area = read.get("area")
        address = integer(read.get("address"), 0, LAST_ADDRESS)
        asked = self._sum(path, address, read.get("count"), "address")
        count = integer(read.get("count"), 1, ADDRESSES)
        for where, of, span in forbidden:
            if asked is not None and of == area and _meet(asked, span):
                message = f"found {extent(asked)}, which overlaps {extent(span)} of {_last(where)}"
                line = f"in line {self.report.line(where)}"
                self.report.add(path, f"{message} {line}, allowed: other addresses", of_key=True)
        if forwarded and count == ADDRESSES:
            allowed = f"allowed with forward: up to {MAX_OF_A_PACKET}, the limit of one packet"
            self.report.add((*path, "count"), f"found {count}, {allowed}")
        if isinstance(read.get("into"), dict):
            into = (*path, "into")
            self._destination(into, read["into"], area, count)
        elif "into" not in read and not forwarded:
            message = "has no effect: the read has no into and the device has no forward"
            self.report.doubt(path, message)

    def _destination(
        self, path: KeyPath, into: dict[Any, Any], of: object, count: int | None
    ) -> None:
        self.grants.memory((*path, "memory"), into.get("memory"))
        area, address = into.get("area"), integer(into.get("address"), 0, LAST_ADDRESS)
        if area not in AREAS or (of in AREAS and (area in BIT_AREAS) != (of in BIT_AREAS)):
            if area in AREAS:
                kin = BIT_AREAS if of in BIT_AREAS else REGISTER_AREAS
                message = f"found {show(area)}, allowed for {of}: {choice(kin)}"
                self.report.add((*path, "area"), message)
            return
        there = self._there(path, into.get("memory"), area)
        if there is None or address is None or count is None:
            return
        if address not in there or address + count - 1 not in there:
            noun = "bits" if area in BIT_AREAS else "registers"
            found = f"found {count} {noun} from {address}"
            allowed = f"allowed in {area} of {into['memory']}: {extent(there)}"
            self.report.add((*path, "address"), f"{found}, {allowed}")
            return
        self._claims.append(Claim(path, into["memory"], area, range(address, address + count)))

    def _status(self, path: KeyPath, status: dict[Any, Any]) -> None:
        self.grants.memory((*path, "memory"), status.get("memory"))
        area, slot = status.get("area"), integer(status.get("slot"), 0, LAST_SLOT)
        if area not in REGISTER_AREAS:
            return
        there = self._there(path, status.get("memory"), area)
        if there is None or slot is None:
            return
        block = range(slot * STATUS_BLOCK, (slot + 1) * STATUS_BLOCK)
        if block[0] not in there or block[-1] not in there:
            found = f"found {slot}, which covers addresses {extent(block)}"
            allowed = f"allowed in {area} of {status['memory']}: {extent(there)}"
            self.report.add((*path, "slot"), f"{found}, {allowed}")
            return
        self._claims.append(Claim(path, status["memory"], area, block))

    def _there(self, path: KeyPath, name: object, area: Any) -> range | None:
        """The addresses of an area of a memory, `None` if the memory or area is not valid."""
        memory = self.memories.get(name) if isinstance(name, str) else None
        if not isinstance(memory, dict):
            return None
        if area not in memory:
            areas = [each for each in AREAS if each in memory]
            allowed = f"allowed: {listing(areas)}" if areas else "and it has no other area"
            message = f"found {show(area)}, an area that {name} does not have, {allowed}"
            self.report.add((*path, "area"), message)
            return None
        return addresses(memory[area])

    def _overlaps(self) -> None:
        """Reports reads and blocks that write an address twice, at the later one in the file."""
        order = {claim.path: number for number, claim in enumerate(self._claims)}
        widest: dict[tuple[str, str], Claim] = {}
        for claim in sorted(self._claims, key=lambda claim: claim.addresses.start):
            key = (claim.memory, claim.area)
            before = widest.setdefault(key, claim)
            if before is not claim and claim.addresses.start < before.addresses.stop:
                first, second = sorted((before, claim), key=lambda each: order[each.path])
                overlapped = f"{extent(first.addresses)} of {self._named(first.path)}"
                message = f"found {second}, which overlaps {overlapped}"
                self.report.add(second.path, f"{message}, allowed: addresses without overlap")
            if claim.addresses.stop > before.addresses.stop:
                widest[key] = claim

    def _named(self, path: KeyPath) -> str:
        return f"{self.report.document.spell(path)} in line {self.report.line(path)}"


def _target(url: object) -> Target:
    return parse(parse_url(url))


def _serial_listeners(data: dict[Any, Any]) -> dict[str, KeyPath]:
    """The serial ports of listeners, each with the path of its listener."""
    ports: dict[str, KeyPath] = {}
    for name, listener in mapping(data.get("listeners")).items():
        if mapping(listener).get("type") in SERIAL_TYPES:
            device = mapping(mapping(listener).get("serial")).get("device")
            if isinstance(device, str) and device and "\0" not in device:
                ports.setdefault(os.path.realpath(device), ("listeners", name))
    return ports


def _meet(one: range, other: range) -> bool:
    return one.start < other.stop and other.start < one.stop


def _last(path: KeyPath) -> str:
    return f"{path[-2]}[{path[-1]}]"


def _has_echo(target: Target) -> bool:
    return isinstance(target, SerialTarget) or target.transport in SERIAL_FRAMES
