"""Checks rules between keys of devices: reads, destinations, ranges and forwards."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from holdfast._core import CONTACTS_PER_LAG
from holdfast.config import read_plans
from holdfast.config.allowed_words import allowed
from holdfast.config.checks.common import given, items, until_invalid
from holdfast.config.checks.memories import area_of, check_memory
from holdfast.config.models.devices import TAKING_TIME, takes_writes
from holdfast.config.text.messages import show
from holdfast.net.addresses import joined
from holdfast.protocol import ADDRESSES, LAST_ADDRESS, MAX_WORD
from holdfast.runtime.text import counted, either, extent
from holdfast.types import BIT_AREAS, REGISTER_AREAS, Area

if TYPE_CHECKING:
    from collections.abc import Iterator

    from holdfast.config.checks.common import Scope
    from holdfast.config.models.devices import (
        DestinationConfig,
        DeviceConfig,
        ForwardConfig,
        ForwardedStatusConfig,
        ReadConfig,
        StatusConfig,
    )
    from holdfast.config.models.root import Config
    from holdfast.config.text.yaml_document import KeyPath

MAX_OF_A_PACKET = MAX_WORD
"""The maximum number of values in one raw ingest packet."""

_NAMING = {"v1": "unit", "crc": "memory_id"}
"""The key for the target of a packet, by format."""

_OF_POLLING = ("interval", "max_gap", "readable", "forbidden", "forward", "status", "stale")
"""Keys that only concern polling, and that are not set by default."""


@dataclass(frozen=True)
class Claim:
    """Addresses of a memory that a read or status block writes; `path` is its place in the file.

    Claims of one `source` that overlap are written with the same values.
    """

    path: KeyPath
    memory: str
    area: Area
    addresses: range
    source: tuple[str, Area, int] | None = None

    def __str__(self) -> str:
        return f"{self.area} {extent(self.addresses)} of {self.memory}"


def check_devices(scope: Scope) -> None:
    """Reports what is wrong."""
    with until_invalid():
        claims: list[Claim] = []
        for path, device in items(("devices",), scope.config.devices):
            _Device(scope, path, device, claims).check()
        for path, message in _overlaps(scope, claims):
            scope.report.add(path, f"{message}, allowed: addresses without overlap")


@dataclass
class _Device:
    """Checks one device, and notes which addresses of memories it writes."""

    scope: Scope
    path: KeyPath
    device: DeviceConfig
    claims: list[Claim]

    def __post_init__(self) -> None:
        self.report = self.scope.report

    def check(self) -> None:
        """Reports what is wrong."""
        self._polling()
        path, device = self.path, self.device
        with until_invalid():
            for where, forward in items((*path, "forward"), device.forward):
                self._forward(where, forward)
        with until_invalid():
            for where, read in items((*path, "reads"), device.reads):
                self._read(where, read)
        with until_invalid():
            if device.status is not None:
                self._status((*path, "status"), device.status)

    def _polling(self) -> None:
        """Reads and tags need an interval."""
        if given(self.device, *TAKING_TIME) and not given(self.device, "interval"):
            path = (*self.path, "interval")
            words = allowed(path, self.report.document.data)
            self.report.add_key(path, f"missing, allowed: {words}")

    def _forward(self, path: KeyPath, forward: ForwardConfig) -> None:
        with until_invalid():
            if given(forward, "crc") and forward.format == "v1":
                message = "found with format v1, allowed: only with format crc"
                self.report.add_key((*path, "crc"), message)
            self._target(path, forward, forward.format)
            status = forward.status
            if status is not None:
                self._target((*path, "status"), status, forward.format)
                self._forwarded_status((*path, "status"), forward, status)
        with until_invalid():
            for area in forward.offsets.model_fields_set:
                self._offset((*path, "offsets", area), area, getattr(forward.offsets, area))

    def _target(self, path: KeyPath, of: ForwardConfig | ForwardedStatusConfig, form: str) -> None:
        """Packets of a format name their memory in one way."""
        needed, other = _NAMING[form], _NAMING["v1" if form == "crc" else "crc"]
        if not given(of, needed):
            message = f"missing with format {form}, allowed: an integer from 0 to {MAX_WORD}"
            self.report.add_key((*path, needed), message)
        if given(of, other):
            self.report.add_key((*path, other), f"found with format {form}, allowed: {needed}")

    def _forwarded_status(
        self, path: KeyPath, forward: ForwardConfig, status: ForwardedStatusConfig
    ) -> None:
        """Each block of a receiver has one device."""
        memory = _memory_of(forward, status)
        if memory is not None:
            self.claims.append(Claim(path, memory, status.area, status.addresses))

    def _offset(self, path: KeyPath, area: str, offset: int) -> None:
        """With its offset, every read is within the area of the receiver."""
        for _, read in items(path, self.device.reads):
            with until_invalid():
                of = read.into or read
                if of.area == area and offset + of.address + read.count > ADDRESSES:
                    most = ADDRESSES - of.address - read.count
                    span = extent(range(of.address, of.address + read.count))
                    found = f"found {offset}, which moves {span} beyond {LAST_ADDRESS}"
                    self.report.add(path, f"{found}, allowed: 0 to {most}")
                    return

    def _read(self, path: KeyPath, read: ReadConfig) -> None:
        with until_invalid():
            self._asked(path, read)
        forwarded = bool(given(self.device, "forward"))
        with until_invalid():
            if forwarded and read.count == ADDRESSES:
                allowed = f"allowed with forward: up to {MAX_OF_A_PACKET}, the limit of one packet"
                self.report.add((*path, "count"), f"found {read.count}, {allowed}")
        with until_invalid():
            if read.into is not None:
                self._destination((*path, "into"), read, read.into)

    def _asked(self, path: KeyPath, read: ReadConfig) -> None:
        """The addresses of a read exist, and none of them is forbidden."""
        if read.address + read.count > ADDRESSES:
            found = f"found address {read.address} and count {read.count}"
            self.report.add((*path, "count"), f"{found}, allowed: a sum up to {ADDRESSES}")
            return
        asked = range(read.address, read.address + read.count)
        for where, each in items((*self.path, "forbidden"), self.device.forbidden):
            with until_invalid():
                if each.area == read.area and _meet(asked, each.addresses):
                    span = f"{extent(each.addresses)} of forbidden[{where[-1]}]"
                    message = f"found {extent(asked)}, which overlaps {span}"
                    line = f"in line {self.report.line(where)}"
                    self.report.add_key(path, f"{message} {line}, allowed: other addresses")

    def _destination(self, path: KeyPath, read: ReadConfig, into: DestinationConfig) -> None:
        with until_invalid():
            check_memory(self.scope, (*path, "memory"), into.memory)
        with until_invalid():
            if (into.area in BIT_AREAS) != (read.area in BIT_AREAS):
                same_kind = BIT_AREAS if read.area in BIT_AREAS else REGISTER_AREAS
                message = f"found {show(into.area)}, allowed for {read.area}: {either(same_kind)}"
                self.report.add((*path, "area"), message)
                return
        noun = "bits" if into.area in BIT_AREAS else "registers"
        found = f"found {read.count} {noun} from {into.address}"
        addresses = range(into.address, into.address + read.count)
        self._claim((*path, "address"), Claim(path, into.memory, into.area, addresses), found)

    def _status(self, path: KeyPath, status: StatusConfig) -> None:
        with until_invalid():
            check_memory(self.scope, (*path, "memory"), status.memory)
        found = f"found {status.slot}, which covers addresses {extent(status.addresses)}"
        claim = Claim(path, status.memory, status.area, status.addresses)
        self._claim((*path, "slot"), claim, found)

    def _claim(self, path: KeyPath, claim: Claim, found: str) -> None:
        """Notes addresses, or reports at `path` that the area of the memory does not have them."""
        there = area_of(self.scope, claim.path, claim.memory, claim.area)
        if there is None:
            return
        if claim.addresses[0] in there and claim.addresses[-1] in there:
            self.claims.append(claim)
        else:
            allowed = f"allowed in {claim.area} of {claim.memory}: {extent(there)}"
            self.report.add(path, f"{found}, {allowed}")


def _memory_of(forward: ForwardConfig, named: ForwardConfig | ForwardedStatusConfig) -> str | None:
    """The memory of a receiver that packets name."""
    target = named.unit if forward.format == "v1" else named.memory_id
    if target is None:
        return None
    receiver = forward.receiver
    return f"{_NAMING[forward.format]} {target} of {joined(receiver.host, receiver.port)}"


def _forwarded_reads(config: Config) -> Iterator[Claim]:
    for name, device in config.devices.items():
        for forward in device.forward:
            memory = _memory_of(forward, forward)
            assert memory is not None, "a valid configuration has one"
            for index, read in enumerate(device.reads):
                at = read.into or read
                first = at.address + getattr(forward.offsets, at.area)
                yield Claim(
                    ("devices", name, "reads", index),
                    memory,
                    at.area,
                    range(first, first + read.count),
                    (name, read.area, first - read.address),
                )


def _overlaps(scope: Scope, claims: list[Claim]) -> Iterator[tuple[KeyPath, str]]:
    """Reads and blocks that write an address twice: the later one in the file, and a message."""
    order = {id(claim): number for number, claim in enumerate(claims)}
    widest: dict[tuple[str, str], Claim] = {}
    for claim in sorted(claims, key=lambda claim: claim.addresses.start):
        key = (claim.memory, claim.area)
        before = widest.setdefault(key, claim)
        is_same = before is claim or (claim.source is not None and claim.source == before.source)
        if not is_same and claim.addresses.start < before.addresses.stop:
            first, second = sorted((before, claim), key=lambda each: order[id(each)])
            overlapped = f"{extent(first.addresses)} of {scope.report.named(first.path)}"
            yield second.path, f"found {second}, which overlaps {overlapped}"
        if claim.addresses.stop > before.addresses.stop:
            widest[key] = claim


def _meet(one: range, other: range) -> bool:
    return one.start < other.stop and other.start < one.stop


def warn_of_devices(scope: Scope) -> None:
    """Warns about settings of valid devices that have no effect, or undo each other."""
    # Programs that Holdfast replaces accept this: each poll overwrites the values of the other.
    for where, message in _overlaps(scope, list(_forwarded_reads(scope.config))):
        scope.report.warn(where, f"{message}: the values overwrite each other at the receiver")
    for path, device in scope.config.devices.items():
        for where, message in _warnings(scope, ("devices", path), device):
            scope.report.warn(where, message)


def _stale_elsewhere(config: Config, device: DeviceConfig) -> Iterator[str]:
    """On a node that does not poll the device, values are as old as its contact with the log."""
    assert device.stale is not None
    memories = [config.memories[read.into.memory] for read in device.reads if read.into is not None]
    for log in dict.fromkeys(each.replicate.log for each in memories if each.replicate is not None):
        contact = config.logs[log].max_lag / CONTACTS_PER_LAG
        if device.stale.after < contact:
            yield (
                f"found {device.stale.after:g}, which is less than {contact:g} (max_lag / "
                f"{CONTACTS_PER_LAG} of logs.{log}): values are stale on nodes that do not poll it"
            )


def _pauses(config: Config, name: str, device: DeviceConfig) -> tuple[float, int]:
    """The seconds of a poll in which the tolerance of the device allows no request, at least, and
    the number of requests of a poll."""
    tolerance = device.target.tolerance
    if (not tolerance.has_pauses and not tolerance.reconnect) or device.max_gap == "auto":
        return 0, 0
    reads = [(read.area, read.address, read.count) for read in device.reads]
    tags = [
        (tag.area, part.start, len(part))
        for tag in config.tags(name)
        for part in tag.parts(device.max_registers, device.max_bits)
    ]
    requests = len(read_plans.plan([*reads, *tags], read_plans.rules(device)).blocks)
    connections = requests / tolerance.close_after if tolerance.close_after else 0
    connecting = max(tolerance.reconnect + tolerance.pause_after_connect, tolerance.pause)
    return connections * connecting + (requests - connections) * tolerance.pause, requests


def _warnings(scope: Scope, path: KeyPath, device: DeviceConfig) -> Iterator[tuple[KeyPath, str]]:
    if not given(device, *TAKING_TIME):
        for key in given(device, *_OF_POLLING):
            if getattr(device, key):
                yield (*path, key), "has no effect: the device has no reads and no tags"
    passes = device.writes == "pass"
    if device.emulate and not passes:
        yield (*path, "emulate"), "has no effect without writes: pass"
    if passes and not any(
        read.into is not None and takes_writes(read.area, read.into.area) for read in device.reads
    ):
        message = "pass has no effect: no coils are read into coils, and no holding registers"
        yield (*path, "writes"), f"{message} into holding registers"
    if device.is_polled and device.interval is not None:
        pauses, requests = _pauses(scope.config, str(path[-1]), device)
        if round(pauses, 9) > device.interval:
            found = f"found {device.interval:g}, but the pauses of {counted(requests, 'request')}"
            yield (*path, "interval"), f"{found} take {pauses:g} s in each poll: polls are late"
    stored = any(read.into is not None for read in device.reads)
    if device.stale is not None:
        if device.reads and not stored:
            yield (*path, "stale"), "has no effect: no read has an into"
        if device.interval is not None and device.stale.after <= device.interval:
            after, interval = (*path, "stale", "after"), (*path, "interval")
            found = f"found {scope.report.raw(after)}, which is not more than interval, "
            yield after, f"{found}{scope.report.raw(interval)}: values are stale between two polls"
        for message in _stale_elsewhere(scope.config, device):
            yield (*path, "stale", "after"), message
    if device.readable and not device.max_gap:
        yield (*path, "readable"), "has no effect: gaps are read only with max_gap"
    for index, read in enumerate(device.reads):
        if read.into is None and not device.forward:
            message = "has no effect: the read has no into and the device has no forward"
            yield (*path, "reads", index), message
