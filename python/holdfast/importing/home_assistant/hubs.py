"""Imports the `modbus` section of Home Assistant: entities become tags of devices.

A hub becomes one device for each unit id that its entities name.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any
from urllib.parse import quote, urlencode

from holdfast.config.text.messages import show
from holdfast.importing.home_assistant.entities import PLATFORMS, Entities, Places
from holdfast.importing.imported import Imported, Source
from holdfast.importing.key_reader import Section, section
from holdfast.importing.names import free_name, unique_names
from holdfast.net.addresses import joined
from holdfast.protocol import MAX_UNIT

if TYPE_CHECKING:
    from pathlib import Path

    from holdfast.config.text.yaml_document import KeyPath
    from holdfast.importing.notes import Desk

TIMEOUT_S = 3
SCAN_INTERVAL_S = 15
"""Defaults of the source."""

BROKER = "mqtt://homeassistant.local"

_SCHEMES = {"tcp": "tcp", "udp": "udp", "rtuovertcp": "rtu+tcp", "serial": "rtu"}
_PARITY = {"n": "none", "e": "even", "o": "odd"}

_HUB_REASONS = {
    "close_comm_on_error": "the connection ends when a device does not answer as it should",
    "retries": "see retries of tolerance; a write is never sent twice",
    "retry_on_empty": "see retries of tolerance",
}
_ENTITY_REASONS = {
    "lazy_error_count": "an entity is unavailable while its device does not answer",
    "min_value": "values are not limited",
    "max_value": "values are not limited",
    "zero_suppress": "small values are not replaced by 0",
    "temp_step": "the step is the scale",
}
_LOOKS = {
    "precision": "values are not rounded; Home Assistant can show fewer digits",
    "device_class": "it comes from the unit, if that has only one meaning",
    "state_class": "numbers are measurements, and energies totals",
    "unique_id": "the new entities have ids of their own",
    "write_registers": "one register is written with function 6",
    "target_temp_write_registers": "one register is written with function 6",
}
"""Keys that change no value, each with one note in all."""


def read_home_assistant(path: Path | str) -> Imported:
    """Converts the `modbus` section of a configuration, or a file that contains only that.

    Raises `ConfigError` with every problem that prevents the import.
    """
    source = Source(path, only="modbus")
    source.desk.quoted_numbers = True
    data = source.desk.document.data
    root: KeyPath = ("modbus",) if isinstance(data, dict) and "modbus" in data else ()
    hubs = data["modbus"] if root else data
    entries = [(root, hubs)] if isinstance(hubs, dict) else []
    if isinstance(hubs, list):
        entries = [((*root, index), hub) for index, hub in enumerate(hubs)]
    elif not entries and not source.problems:
        found = "nothing" if hubs is None else show(hubs)
        source.desk.problem(root, f"found {found}, allowed: the hubs of modbus")
    found_hubs = [section(source.desk, path, hub) for path, hub in entries]
    devices = _devices(source.desk, [hub for hub in found_hubs if hub is not None])
    if not devices and not source.desk.report.problems and not source.problems:
        source.desk.problem(root, "no hub has an entity that can be converted")
    source.finish()
    return Imported(
        source.file, "home-assistant", "Home Assistant", _config(devices), source.desk.notes
    )


def _config(devices: dict[str, dict[str, Any]]) -> dict[str, Any]:
    tags = [tag for device in devices.values() for tag in device["tags"].values()]
    output: dict[str, Any] = {"type": "mqtt", "url": BROKER, "discovery": "homeassistant"}
    if any(tag.get("writable") for tag in tags):
        output["writes"] = True
    return {"devices": devices, "outputs": {"home": output}}


def _devices(desk: Desk, hubs: list[Section]) -> dict[str, dict[str, Any]]:
    """The devices of all hubs, by name."""
    numbers = [f"_{index}" if index else "" for index in range(len(hubs))]
    wanted = [
        (hub.at("name"), hub.name("name") or f"modbus_hub{number}")
        for hub, number in zip(hubs, numbers, strict=True)
    ]
    names = unique_names(desk, wanted)
    taken, devices, looks = set(names), {}, _Looks(desk)
    for name, hub in zip(names, hubs, strict=True):
        read = _Hub(desk, hub, looks)
        read.read()
        units = {number: unit for number, unit in read.units.items() if unit.places.tags}
        for number, unit in units.items():
            its_name = name if len(units) == 1 else free_name(f"{name}-{number}"[-64:], taken)
            taken.add(its_name)
            devices[its_name] = {"url": read.url, **unit.device(number, read.timeout)}
    if devices:
        _to_check(desk, hubs[0].path, devices)
    looks.note()
    return devices


def _to_check(desk: Desk, path: KeyPath, devices: dict[str, dict[str, Any]]) -> None:
    """What a person must know before both run."""
    desk.check(path, f"the broker is {BROKER}: set its address, username and password_file")
    moved = "entities are new, under MQTT: remove this section, then rename them to keep their ids"
    desk.check(path, f"{moved} and their history")
    tags = [tag for device in devices.values() for tag in device["tags"].values()]
    if any(tag.get("type", "").startswith("float") for tag in tags):
        desk.check(path, "floats are not rounded to two digits")


@dataclass
class _Looks:
    """Notes on keys that many entities have, and that change no value."""

    desk: Desk
    found: dict[str, list[KeyPath]] = field(default_factory=dict)

    def collect(self, entity: Section) -> None:
        for key in _LOOKS:
            if entity.get(key) is not None:
                self.found.setdefault(key, []).append(entity.at(key))

    def note(self) -> None:
        for key, paths in self.found.items():
            more = f" (and {len(paths) - 1} more)" if len(paths) > 1 else ""
            self.desk.left_out(paths[0], f"{_LOOKS[key]}{more}")


@dataclass
class _Unit:
    """The entities of one unit id of a hub."""

    places: Places
    intervals: list[tuple[KeyPath, int]] = field(default_factory=list)

    def device(self, number: int, timeout: float) -> dict[str, Any]:
        """The device, without its URL."""
        interval = min((given for _, given in self.intervals), default=SCAN_INTERVAL_S)
        others = [(path, given) for path, given in self.intervals if given != interval]
        if others:
            path, given = others[0]
            more = f", and {len(others) - 1} more" if len(others) > 1 else ""
            message = f"polled every {interval} s, as the whole device; it was {given} s{more}"
            self.places.desk.changed(path, message)
        tags = self.places.tags
        return {"unit": number, "interval": interval, "timeout": timeout, "tags": tags}


@dataclass
class _Hub:
    """Reads one hub."""

    desk: Desk
    hub: Section
    looks: _Looks
    url: str = ""
    timeout: float = TIMEOUT_S
    units: dict[int, _Unit] = field(default_factory=dict)

    def read(self) -> None:
        hub = self.hub
        kind = hub.word("type", tuple(_SCHEMES), required=True)
        if kind is not None:
            self.url = self._serial_url() if kind == "serial" else self._network_url(kind)
        self.timeout = hub.number("timeout") or TIMEOUT_S
        for platform, convert in PLATFORMS.items():
            for entity in self._entities(platform):
                self._entity(entity, convert)
        hub.close(_HUB_REASONS)

    def _entities(self, platform: str) -> list[Section]:
        found = self.hub.get(platform)
        if isinstance(found, dict):
            return [Section(self.desk, self.hub.at(platform), found)]
        return self.hub.sections(platform)

    def _entity(self, entity: Section, convert: Entities) -> None:
        given = entity.get("device_address")
        key = "device_address" if given is not None else "slave"
        number = entity.integer(key, 0, MAX_UNIT, what="a unit id")
        unit = self.units.setdefault(1 if number is None else number, _Unit(Places(self.desk)))
        interval = entity.integer("scan_interval", 0, 86_400, what="seconds")
        if interval == 0:
            self.desk.changed(entity.at("scan_interval"), "polled with the others of its device")
        elif interval is not None:
            unit.intervals.append((entity.at("scan_interval"), interval))
        else:
            unit.intervals.append((entity.path, SCAN_INTERVAL_S))
        if entity.text("name", required=True) is not None:
            convert(unit.places, entity)
        self.looks.collect(entity)
        entity.close(_ENTITY_REASONS)

    def _network_url(self, kind: str) -> str:
        host = self.hub.text("host", required=True) or ""
        port = self.hub.integer("port", 1, 65535, required=True, what="a port") or 0
        return f"{_SCHEMES[kind]}://{joined(host, port)}{self._query({})}"

    def _serial_url(self) -> str:
        hub = self.hub
        method = hub.word("method", ("rtu", "ascii"), required=True)
        port = hub.text("port", required=True) or ""
        parity = hub.word("parity", tuple(_PARITY), required=True, any_case=True)
        options = {
            "baud": hub.integer("baudrate", 50, 4_000_000, required=True),
            "parity": _PARITY[parity or "n"],
            "stop_bits": hub.integer("stopbits", 1, 2, required=True),
        }
        bits = hub.integer("bytesize", 7, 8, required=True)
        if method == "ascii":
            options["data_bits"] = bits
        elif bits == 7:
            self.desk.problem(hub.at("bytesize"), "found 7 with method rtu, allowed: 8")
        return f"{method}://{quote(port)}{self._query(options)}"

    def _query(self, options: dict[str, Any]) -> str:
        """Options of the line, and pauses that the source made."""
        wait = self.hub.integer("message_wait_milliseconds", 0, 60_000, what="milliseconds")
        delay = self.hub.integer("delay", 0, 60, what="seconds")
        pauses = {"pause": wait / 1000 if wait else None, "pause_after_connect": delay or None}
        given = {key: value for key, value in {**options, **pauses}.items() if value is not None}
        return f"?{urlencode(given)}" if given else ""
