"""Checks rules between keys of devices: reads, destinations, ranges and forwards."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from holdfast.config.allowed import allowed
from holdfast.config.devices import LAST_SLOT, STATUS_BLOCK, TAKING_TIME, takes_writes
from holdfast.config.initial import extent
from holdfast.config.lenient import entries, integer, mapping, parsed
from holdfast.config.memory_checks import area_of
from holdfast.config.range_checks import check_ranges, counted
from holdfast.config.scalars import parse_receiver_url
from holdfast.config.words import show
from holdfast.net.addresses import joined
from holdfast.protocol import ADDRESSES, LAST_ADDRESS, MAX_WORD
from holdfast.runtime.text import either
from holdfast.types import AREAS, BIT_AREAS, REGISTER_AREAS, Area

if TYPE_CHECKING:
    from holdfast.config.grant_checks import GrantChecks
    from holdfast.config.report import Report
    from holdfast.config.source import KeyPath

MAX_OF_A_PACKET = MAX_WORD
"""The maximum number of values in one raw ingest packet."""

_NAMING = {"v1": "unit", "crc": "memory_id"}
"""The key for the target of a packet, by format."""


_OF_POLLING = ("interval", "cost", "readable", "forbidden", "forward", "status", "stale")
"""Keys that only concern polling, and that are not set by default."""


@dataclass(frozen=True)
class Claim:
    """Addresses of a memory that a read or status block writes; `path` is its place in the file."""

    path: KeyPath
    memory: str
    area: Area
    addresses: range

    def __str__(self) -> str:
        return f"{self.area} {extent(self.addresses)} of {self.memory}"


@dataclass
class DeviceChecks:
    """Checks the devices of one file."""

    report: Report
    grants: GrantChecks
    memories: dict[Any, Any]
    """The memories, as in the file and not validated."""

    def __post_init__(self) -> None:
        self._claims: list[Claim] = []

    def check(self, devices: object) -> None:
        """Reports what is wrong."""
        for name, device in mapping(devices).items():
            if isinstance(device, dict):
                self._device(("devices", name), device)
        self._overlaps()

    def _device(self, path: KeyPath, device: dict[Any, Any]) -> None:
        self._polling(path, device)
        self._passing(path, device)
        self._aging(path, device)
        if "max_gap" in device and "cost" in device:
            message = "found together with max_gap, allowed: only one of them"
            self.report.add((*path, "cost"), message, of_key=True)
        if device.get("readable") and not device.get("max_gap") and "cost" not in device:
            message = "has no effect: gaps are read only with max_gap or cost"
            self.report.doubt((*path, "readable"), message)
        check_ranges((*path, "readable"), device.get("readable"), self.report)
        forbidden = check_ranges((*path, "forbidden"), device.get("forbidden"), self.report)
        for index, forward in enumerate(entries(device.get("forward"))):
            where = (*path, "forward", index)
            self._forward(where, mapping(forward))
            self._offsets((*where, "offsets"), mapping(forward), entries(device.get("reads")))
        for index, read in enumerate(entries(device.get("reads"))):
            if isinstance(read, dict):
                forwarded = bool(device.get("forward"))
                self._read((*path, "reads", index), read, forbidden, forwarded=forwarded)
        if isinstance(device.get("status"), dict):
            self._status((*path, "status"), device["status"])

    def _polling(self, path: KeyPath, device: dict[Any, Any]) -> None:
        """Reads and tags need an interval; without them, all settings of polling have no effect."""
        if any(key in device for key in TAKING_TIME):
            if "interval" not in device:
                words = allowed((*path, "interval"), self.report.document.data)
                message = f"missing, allowed: {words}"
                self.report.add((*path, "interval"), message, of_key=True)
            return
        for key in _OF_POLLING:
            if device.get(key):
                self.report.doubt(
                    (*path, key), "has no effect: the device has no reads and no tags"
                )

    def _passing(self, path: KeyPath, device: dict[Any, Any]) -> None:
        """Warns about writes that can't be passed on to the device."""
        passes = device.get("writes") == "pass"
        if device.get("emulate") is True and not passes:
            self.report.doubt((*path, "emulate"), "has no effect without writes: pass")
        reads = [mapping(read) for read in entries(device.get("reads"))]
        if passes and not any(
            takes_writes(read.get("area"), mapping(read.get("into")).get("area")) for read in reads
        ):
            message = "pass has no effect: no coils are read into coils, and no holding registers"
            self.report.doubt((*path, "writes"), f"{message} into holding registers")

    def _aging(self, path: KeyPath, device: dict[Any, Any]) -> None:
        """Warns about values that are always or never stale."""
        if not isinstance(device.get("stale"), dict):
            return
        reads = [mapping(read) for read in entries(device.get("reads"))]
        if reads and not any("into" in read for read in reads):
            self.report.doubt((*path, "stale"), "has no effect: no read has an into")
        after, interval = device["stale"].get("after"), device.get("interval")
        if _is_number(after) and _is_number(interval) and after <= interval:
            found = f"found {after}, which is not more than interval, {interval}"
            message = f"{found}: values are stale between two polls"
            self.report.doubt((*path, "stale", "after"), message)

    def _forward(self, path: KeyPath, forward: dict[Any, Any]) -> None:
        form = forward.get("format", "v1")
        if "crc" in forward and form == "v1":
            message = "found with format v1, allowed: only with format crc"
            self.report.add((*path, "crc"), message, of_key=True)
        if form not in ("v1", "crc") or not forward:
            return
        self._target(path, forward, form)
        if isinstance(forward.get("status"), dict):
            self._target((*path, "status"), forward["status"], form)
            self._forwarded_status((*path, "status"), forward, forward["status"], form)

    def _target(self, path: KeyPath, of: dict[Any, Any], form: str) -> None:
        """Packets of a format name their memory in one way."""
        needed, other = _NAMING[form], _NAMING["v1" if form == "crc" else "crc"]
        if needed not in of:
            message = f"missing with format {form}, allowed: an integer from 0 to {MAX_WORD}"
            self.report.add((*path, needed), message, of_key=True)
        if other in of:
            message = f"found with format {form}, allowed: {needed}"
            self.report.add((*path, other), message, of_key=True)

    def _forwarded_status(
        self, path: KeyPath, forward: dict[Any, Any], status: dict[Any, Any], form: str
    ) -> None:
        """Each block of a receiver has one device."""
        receiver = parsed(parse_receiver_url, forward.get("url"))
        area, slot = status.get("area"), integer(status.get("slot"), 0, LAST_SLOT)
        target = integer(status.get(_NAMING[form]), 0, MAX_WORD)
        if receiver is None or area not in REGISTER_AREAS or slot is None or target is None:
            return
        of = f"{_NAMING[form]} {target} of {joined(receiver.host, receiver.port)}"
        block = range(slot * STATUS_BLOCK, (slot + 1) * STATUS_BLOCK)
        self._claims.append(Claim(path, of, area, block))

    def _offsets(self, path: KeyPath, forward: dict[Any, Any], reads: list[Any]) -> None:
        """With its offset, every read is within the area of the receiver."""
        for area, added in mapping(forward.get("offsets")).items():
            offset = integer(added, 0, LAST_ADDRESS)
            for read in map(mapping, reads):
                of = mapping(read.get("into")) or read
                address = integer(of.get("address"), 0, LAST_ADDRESS)
                count = integer(read.get("count"), 1, ADDRESSES)
                if of.get("area") != area or offset is None or address is None or count is None:
                    continue
                if offset + address + count > ADDRESSES:
                    most = ADDRESSES - address - count
                    message = (
                        f"found {offset}, which moves {extent(range(address, address + count))}"
                    )
                    allowed = f"beyond {LAST_ADDRESS}, allowed: 0 to {most}"
                    self.report.add((*path, area), f"{message} {allowed}")
                    break

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
        asked = counted(path, address, read.get("count"), "address", self.report)
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
                message = f"found {show(area)}, allowed for {of}: {either(kin)}"
                self.report.add((*path, "area"), message)
            return
        there = area_of(self.memories, path, into.get("memory"), area, self.report)
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
        there = area_of(self.memories, path, status.get("memory"), area, self.report)
        if there is None or slot is None:
            return
        block = range(slot * STATUS_BLOCK, (slot + 1) * STATUS_BLOCK)
        if block[0] not in there or block[-1] not in there:
            found = f"found {slot}, which covers addresses {extent(block)}"
            allowed = f"allowed in {area} of {status['memory']}: {extent(there)}"
            self.report.add((*path, "slot"), f"{found}, {allowed}")
            return
        self._claims.append(Claim(path, status["memory"], area, block))

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


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _meet(one: range, other: range) -> bool:
    return one.start < other.stop and other.start < one.stop


def _last(path: KeyPath) -> str:
    return f"{path[-2]}[{path[-1]}]"
