"""Imports configurations of the Modbus Replicator: units become devices that are forwarded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from holdfast.client.base import MIN_INTERVAL_S
from holdfast.config.models.devices import LAST_SLOT
from holdfast.config.text.messages import show
from holdfast.importing.imported import Imported, Source
from holdfast.importing.key_reader import Section, seconds, section
from holdfast.importing.names import unique_names
from holdfast.net.addresses import joined
from holdfast.net.hosts import host_and_port
from holdfast.protocol import ADDRESSES, LAST_ADDRESS, MAX_UNIT
from holdfast.types import AREAS, Area

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator
    from pathlib import Path

    from holdfast.config.text.yaml_document import KeyPath
    from holdfast.importing.notes import Desk

MAX_MS = 86_400_000

DEVICE_TIMEOUT_S = 5
"""Seconds for a device without a timeout. The source waited for it without an end."""

TARGET_TIMEOUT_S = 2
"""Seconds for a target of a device without a timeout, as in the source."""

_AREAS: dict[int, Area] = dict(enumerate(AREAS, 1))
"""The areas by the functions that read them."""

_TOP_REASONS = {
    "listeners": "for the memories in this file, use: holdfast import mma",
    "Status_Memory": "the replicator ignores it; each target has a status_unit_id",
}

_READ_REASONS = {"interval_ms": "each unit has one interval here, that of its poll"}


def read_replicator(path: Path | str) -> Imported:
    """Converts a configuration of the Modbus Replicator.

    Raises `ConfigError` with every problem that prevents the import.
    """
    source = Source(path)
    devices: dict[str, Any] = {}
    if source.is_mapping():
        root = Section(source.desk, (), source.desk.document.data)
        devices = _Units(source.desk).read(root)
    source.finish()
    program = "the Modbus Replicator"
    return Imported(source.file, "replicator", program, {"devices": devices}, source.desk.notes)


@dataclass
class _Units:
    """Reads `replicator.units` into devices."""

    desk: Desk

    def read(self, root: Section) -> dict[str, Any]:
        """The devices by name."""
        replicator = root.mapping("replicator", required=True)
        root.close(_TOP_REASONS)
        if replicator is None:
            return {}
        sections = replicator.sections("units", required=True)
        replicator.close(_TOP_REASONS)
        if replicator.get("units") == []:
            replicator.problem("units", "no unit, allowed: at least one")
        wanted = [(each.at("id"), each.name("id", required=True) or "unit") for each in sections]
        devices = [self._device(each) for each in sections]
        names = unique_names(self.desk, wanted)
        kept = {name: each for name, each in zip(names, devices, strict=True) if each}
        if sections and not kept and not self.desk.report.problems:
            replicator.problem("units", "no unit has a target that is written")
        if kept:
            partly = "if a read fails, the others are written; the replicator wrote none"
            replicator.check("units", partly)
        self._retry(kept.values())
        return kept

    def _device(self, one: Section) -> dict[str, Any]:
        """The device of a unit; empty if it is not polled or not valid."""
        source = one.mapping("source", required=True)
        poll = one.mapping("poll", required=True)
        reads = list(self._reads(one))
        targets = one.entries("targets") or []
        interval = None if poll is None else self._interval(poll)
        one.close()
        if source is None:
            return {}
        endpoint = self._endpoint(source)
        timeout = self._timeout(source)
        block = self._block(source, has_targets=bool(targets))
        number = source.integer("unit_id", 0, MAX_UNIT, what="a unit id")
        source.close()
        found = [section(self.desk, path, value) for path, value in targets]
        forward = [
            each
            for target in found
            if target is not None
            for each in self._forwards(target, reads, block, timeout)
        ]
        if not forward:
            self.desk.left_out(one.path, "no target is written, so it is not polled")
            return {}
        if endpoint is None or interval is None:
            return {}
        return {
            "url": f"tcp://{endpoint}",
            "unit": number or 0,
            "interval": interval,
            "timeout": timeout or DEVICE_TIMEOUT_S,
            "reads": reads,
            "forward": forward,
        }

    def _interval(self, poll: Section) -> float | None:
        """Seconds between polls."""
        given = poll.integer("interval_ms", 1, MAX_MS, required=True, what="milliseconds")
        poll.close()
        if given is not None and given < MIN_INTERVAL_S * 1000:
            message = f"raised to {MIN_INTERVAL_S * 1000:g} ms, the shortest interval"
            poll.changed("interval_ms", message)
            return MIN_INTERVAL_S
        return None if given is None else seconds(given)

    def _timeout(self, source: Section) -> float | None:
        """Seconds for a request; `None` if the source waits without an end."""
        given = source.integer("timeout_ms", -MAX_MS, MAX_MS, what="milliseconds")
        if given is not None and given > 0:
            return seconds(given)
        message = f"no timeout_ms: {DEVICE_TIMEOUT_S} s; the replicator waited without an end"
        self.desk.check(source.path, message)
        return None

    def _endpoint(self, one: Section) -> str | None:
        """Host and port of an address to connect to."""
        text = one.text("endpoint", required=True)
        if text is None:
            return None
        try:
            host, port = host_and_port(f"127.0.0.1{text}" if text.startswith(":") else text)
        except ValueError:
            port = None
        if port is None:
            one.problem("endpoint", f"found {show(text)}, allowed: host:port, as in 10.5.1.29:502")
            return None
        return joined(host, port)

    def _block(self, source: Section, *, has_targets: bool) -> dict[str, Any] | None:
        """The status block, without its unit id; `None` if there is none."""
        slot = source.integer("status_slot", 0, LAST_SLOT)
        name = source.name("device_name") or ""
        if not name.isascii():
            source.problem("device_name", f"found {show(name)}, allowed: ASCII characters")
        if slot is None:
            return None
        if not has_targets:
            message = "found without targets, allowed: only with targets"
            source.problem_of_key("status_slot", message)
        shown = "".join(each if " " <= each <= "~" else "?" for each in name[:16])
        return {"area": "holding_registers", "slot": slot, "name": shown}

    def _reads(self, one: Section) -> Iterator[dict[str, Any]]:
        if one.get("reads") == []:
            one.problem("reads", "no read, allowed: at least one")
        for read in one.sections("reads", required=True):
            function = read.integer("fc", 1, 4, required=True, what="a function")
            address = read.integer("address", 0, LAST_ADDRESS) or 0
            count = read.integer("quantity", 1, LAST_ADDRESS, required=True)
            for key in ("invert", "addinvert"):
                # The source ignored them for registers.
                if read.flag(key) and function in (1, 2):
                    read.problem(key, "found true, allowed: false; nothing here inverts bits")
            read.close(_READ_REASONS)
            if function is None or count is None:
                continue
            if address + count > ADDRESSES:
                allowed = f"allowed: up to {ADDRESSES - address} from address {address}"
                read.problem("quantity", f"found {count}, {allowed}")
                continue
            yield {"area": _AREAS[function], "address": address, "count": count}

    def _forwards(
        self,
        target: Section,
        reads: list[dict[str, Any]],
        block: dict[str, Any] | None,
        timeout: float | None,
    ) -> Iterator[dict[str, Any]]:
        """What one target receives: the reads for each of its memories, and one status block."""
        number = target.integer("id", 0, 2**32 - 1, required=True)
        endpoint = self._endpoint(target)
        unit = target.integer("unit_id", 0, MAX_UNIT, what="a unit id")
        status_unit = target.integer("status_unit_id", 0, MAX_UNIT, what="a unit id")
        memories = target.entries("memories") or []
        offsets = [self._offsets(path, value, reads) for path, value in memories]
        for key in ("health_output", "health_control"):
            health = target.get(key)
            if isinstance(health, dict) and health.get("enabled") is not False:
                message = "found a coil that tells whether the source answers, allowed: without"
                hint = "nothing here writes it; stale of a device refuses old values"
                target.problem_of_key(key, f"{message}: {hint}")
        target.close()
        if block is not None and status_unit is None:
            message = f"missing with status_slot, allowed: a unit id from 0 to {MAX_UNIT}"
            target.problem_of_key("status_unit_id", message)
        if number is None or endpoint is None:
            return
        if number > MAX_UNIT:
            message = f"its id is {number}, more than {MAX_UNIT}: the replicator never wrote to it"
            self._leave_out(target, message, block)
            return
        if not offsets:
            self._leave_out(target, "no memories: it received no values", block)
            return
        if unit is not None and unit != number:
            message = f"packets go to unit {number}, the id of the target, as before"
            target.left_out("unit_id", message)
        wait = TARGET_TIMEOUT_S if timeout is None else timeout
        for index, added in enumerate(offsets):
            forward: dict[str, Any] = {"url": f"raw://{endpoint}", "unit": number, "timeout": wait}
            if added:
                forward["offsets"] = added
            if index == 0 and block is not None and status_unit is not None:
                forward["status"] = {"unit": status_unit, **block}
            yield forward

    def _leave_out(self, target: Section, reason: str, block: dict[str, Any] | None) -> None:
        """Notes that a target receives nothing, also not the status block that it received."""
        lost = "" if block is None else ". It received the status block, which requires values here"
        self.desk.left_out(target.path, f"{reason}{lost}")

    def _offsets(
        self, path: KeyPath, value: object, reads: list[dict[str, Any]]
    ) -> dict[Area, int]:
        """What is added to addresses, by area; the source has it by function."""
        memory = section(self.desk, path, value)
        if memory is None:
            return {}
        memory.get("memory_id")  # The source only compared it with others.
        given = memory.mapping("offsets")
        memory.close()
        found: dict[Area, int] = {}
        if given is None:
            return found
        for function in list(given.data):
            if isinstance(function, str):
                message = f"found {show(function)}, allowed: a function from 1 to 4, without quotes"
                given.problem_of_key(function, message)
                continue
            if function not in _AREAS:
                given.left_out(function, "no read has this function, allowed: 1 to 4")
                continue
            area = _AREAS[function]
            most = ADDRESSES - max(
                (read["address"] + read["count"] for read in reads if read["area"] == area),
                default=1,
            )
            offset = given.integer(function, 0, most, what="an offset")
            if offset:
                found[area] = offset
        return found

    def _retry(self, devices: Collection[dict[str, Any]]) -> None:
        """Retries each address at the shortest interval of its devices, as the source does."""
        soonest: dict[str, float] = {}
        for device in devices:
            url, interval = device["url"], device["interval"]
            soonest[url] = min(interval, soonest.get(url, interval))
        for device in devices:
            pause = soonest[device["url"]]
            device["retry"] = {"first": pause, "most": pause}
