"""Imports the `modbus` section of Home Assistant: entities become tags of devices.

A hub becomes one device for each unit id that its entities name, and for each of their intervals.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote, urlencode

from holdfast.client.url import parse
from holdfast.config.text.messages import show
from holdfast.config.values.scalars import MAX_TIME, MIN_TIME
from holdfast.importing.home_assistant.entities import PLATFORMS, Entities, Places, Wanted
from holdfast.importing.home_assistant.included_files import IncludedFiles
from holdfast.importing.home_assistant.source_defaults import (
    SCAN_INTERVAL_S,
    SERIAL_WAIT_MS,
    TIMEOUT_S,
    UNIT,
)
from holdfast.importing.home_assistant.write_actions import note_write_actions
from holdfast.importing.imported import Imported, Source
from holdfast.importing.key_reader import Secret, Section, section
from holdfast.importing.names import MAX_LENGTH, free_name, unique_names
from holdfast.net.addresses import joined
from holdfast.protocol import MAX_UNIT

if TYPE_CHECKING:
    from collections.abc import Iterator

    from holdfast.config.text.yaml_document import KeyPath
    from holdfast.importing.notes import Desk

BROKER = "mqtt://homeassistant.local"

_SCHEMES = {"tcp": "tcp", "udp": "udp", "rtuovertcp": "rtu+tcp", "serial": "rtu"}
_PARITY = {"n": "none", "e": "even", "o": "odd"}

_HUB_REASONS = {
    "close_comm_on_error": "the connection ends when a device does not answer as it should",
    "retries": "see retries of tolerance; a write is never sent twice",
    "retry_on_empty": "see retries of tolerance",
}
_ENTITY_REASONS = {
    "brightness_address": "brightness is not converted: add a tag",
    "color_temp_address": "color temperatures are not converted: add a tag",
    "device_class": "what it becomes has none",
    "lazy_error_count": "an entity is unavailable while its device does not answer",
    "max_temp": "the limits of color temperatures are not converted",
    "max_value": "values are not limited",
    "min_temp": "the limits of color temperatures are not converted",
    "min_value": "values are not limited",
    "precision": "values are not rounded; Home Assistant can show fewer digits",
    "step": "the step is the scale",
    "temp_step": "the step is the scale",
    "unique_id": "the new entities have ids of their own",
    "zero_suppress": "small values are not replaced by 0",
}
_MAX_DEPTH = 3
"""How deep the section can be in a file: as in `homeassistant: packages: NAME: modbus`."""

_PACKAGES = ("homeassistant", "packages")

_FORMER = (
    "found platform: modbus, the form before Home Assistant 2021.7, allowed: entities in lists of "
    "their hub in modbus, such as sensors and switches, with address in place of register"
)


def read_home_assistant(path: Path | str) -> Imported:
    """Converts the `modbus` section of a configuration, or a file that contains only that.

    Raises `ConfigError` with every problem that prevents the import.
    """
    source = Source(path, IncludedFiles(Path(path).parent).resolve)
    desk = source.desk
    desk.quoted_numbers = desk.folds = True
    roots = list(_sections((), desk.document.data))
    former = list(_former((), desk.document.data))
    if roots:
        for where, problem in source.narrow(roots):
            if _may_have_hubs(where, roots):
                desk.left_out_for(problem)
    entries: list[tuple[KeyPath, Any]] = []
    for root in roots or ([] if former else [()]):
        hubs = desk.report.raw(root)
        if isinstance(hubs, list):
            entries += [((*root, index), hub) for index, hub in enumerate(hubs)]
        elif isinstance(hubs, dict):
            entries.append((root, hubs))
        elif not source.problems:
            found = "nothing" if hubs is None else show(hubs)
            desk.problem(root, f"found {found}, allowed: the hubs of modbus")
    has_type = any("type" in hub for _, hub in entries if isinstance(hub, dict))
    if entries and not roots and not has_type:
        message = "no section modbus, nor a hub with its type: import the file that has the hubs"
        desk.problem((), message)
        entries = []
    found_hubs = [section(desk, path, hub) for path, hub in entries]
    devices = _devices(desk, [hub for hub in found_hubs if hub is not None])
    for entry in former:
        (desk.left_out if devices else desk.problem)(entry, _FORMER)
    if not devices and not desk.report.problems and not source.problems:
        desk.problem((roots or [()])[0], "no hub has an entity that can be converted")
    source.finish()
    return Imported(source.file, "home-assistant", "Home Assistant", _config(devices), desk.notes)


def _sections(path: KeyPath, data: Any) -> Iterator[KeyPath]:
    """The paths of all sections `modbus`: the source joins those of packages."""
    if not isinstance(data, dict) or len(path) > _MAX_DEPTH:
        return
    for key, value in data.items():
        if key == "modbus":
            yield (*path, key)
        else:
            yield from _sections((*path, key), value)


def _may_have_hubs(path: KeyPath, roots: list[KeyPath]) -> bool:
    """Whether a value that could not be read can be a package, or what has or gives packages."""
    keys = tuple(key for key in path if isinstance(key, str))
    is_beside = any(len(root) > 1 and keys[:-1] == root[:-2] for root in roots)
    return is_beside or (len(keys) <= _MAX_DEPTH and keys[:2] == _PACKAGES[: len(keys)])


def _former(path: KeyPath, data: Any) -> Iterator[KeyPath]:
    """The paths of all entries of the form before the section had the entities."""
    if isinstance(data, dict) and data.get("platform") == "modbus":
        yield path
    elif isinstance(data, dict | list) and len(path) <= _MAX_DEPTH + 1:
        for key, value in data.items() if isinstance(data, dict) else enumerate(data):
            if key != "modbus":
                yield from _former((*path, key), value)


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
    taken, devices = set(names), dict[str, dict[str, Any]]()
    of_units: dict[tuple[str, int], list[str]] = {}
    found = [_Hub(desk, hub) for hub in hubs]
    for read in found:
        read.read()
    _share_connections(desk, found)
    for (_, source_name), name, read in zip(wanted, names, found, strict=True):
        units = {number: places for number, places in read.units.items() if places.tags}
        for number, places in units.items():
            of_unit = name if len(units) == 1 else f"{name}-{number}"
            its_names: list[str] = []
            for interval, tags in _by_interval(places).items():
                wished = f"{of_unit}-{interval}s" if its_names else of_unit
                its_name = name if wished == name else free_name(wished[-MAX_LENGTH:], taken)
                taken.add(its_name)
                if its_names:
                    message = f"entities polled every {interval} s are tags of {its_name}"
                    desk.changed(next(iter(tags.values())).at, message)
                its_names.append(its_name)
                # The source read each entity alone: registers between them may not exist.
                devices[its_name] = {
                    "url": read.url,
                    "unit": number,
                    "interval": interval,
                    "timeout": read.timeout,
                    "max_gap": 0,
                    "tags": {key: each.tag for key, each in tags.items()},
                }
            of_units.setdefault((source_name, number), []).extend(its_names)
    if devices:
        _to_check(desk, hubs[0].path)
        note_write_actions(desk, hubs[0].path, of_units, devices)
    return devices


def _by_interval(places: Places) -> dict[int, dict[str, Wanted]]:
    """The tags of a unit, the shortest interval first; 0, for none, is the shortest, too."""
    tags = places.named()
    given = (each.interval for each in tags.values() if each.interval)
    shortest = min(given, default=SCAN_INTERVAL_S)
    groups: dict[int, dict[str, Wanted]] = {shortest: {}}
    for key, each in sorted(tags.items(), key=lambda item: item[1].interval):
        groups.setdefault(each.interval or shortest, {})[key] = each
    return groups


def _share_connections(desk: Desk, hubs: list[_Hub]) -> None:
    """Hubs at one address share a connection, so its options are the same."""
    groups: dict[str, list[_Hub]] = {}
    for hub in hubs:
        groups.setdefault(hub.location, []).append(hub)
    for group in groups.values():
        shared: dict[str, float] = {}
        for hub in group:
            for key, value in hub.tolerance.items():
                shared[key] = max(value, shared.get(key, 0))
        for hub in group:
            if hub.tolerance != shared:
                message = "hubs at one address share a connection: pauses and functions of another"
                desk.changed(hub.hub.path, message)
                hub.tolerance = shared


def _to_check(desk: Desk, path: KeyPath) -> None:
    """What a person must know before both run."""
    desk.check(path, f"the broker is {BROKER}: set its address, username and password_file")
    moved = "entities are new, under MQTT: remove this section, then rename them to keep their ids"
    desk.check(path, f"{moved} and their history")
    digits = "the source had 2 digits of floats, none of integers"
    desk.check(path, f"values are not rounded; {digits}")
    advice = "remove a tag that the device never answers, or only with 04; set max_registers if it"
    desk.check(path, f"neighbours are read together: {advice} answers only short requests")


@dataclass
class _Hub:
    """Reads one hub."""

    desk: Desk
    hub: Section
    location: str = ""
    """The URL without its options."""
    line: dict[str, Any] = field(default_factory=dict)
    """The options of the serial line."""
    tolerance: dict[str, float] = field(default_factory=dict)
    timeout: float = TIMEOUT_S
    units: dict[int, Places] = field(default_factory=dict)

    def read(self) -> None:
        hub = self.hub
        kind = hub.word("type", tuple(_SCHEMES), required=True)
        if kind is not None:
            self.location = self._serial() if kind == "serial" else self._network(kind)
        self.timeout = self._timeout()
        for platform, convert in PLATFORMS.items():
            for entity in self._entities(platform):
                self._entity(entity, platform, convert)
        self._choose_functions()
        hub.close(_HUB_REASONS)

    def _timeout(self) -> float:
        """The seconds of a request and its reply."""
        given = self.hub.number("timeout") or TIMEOUT_S
        if not MIN_TIME <= given <= MAX_TIME:
            message = f"found {show(given)}, allowed: {MIN_TIME} to {MAX_TIME} seconds"
            self.hub.problem("timeout", message)
        return given

    @property
    def url(self) -> str:
        """The URL with the options of the line, and what the device needs."""
        options = {**self.line, **self.tolerance}
        return f"{self.location}?{urlencode(options)}" if options else self.location

    @property
    def _is_line(self) -> bool:
        """Whether requests go to a serial line itself, where 0 is the broadcast."""
        return self.location.startswith(("rtu:", "ascii:"))

    def _choose_functions(self) -> None:
        """Writes all values with functions 15 and 16 if one was: the device has no 5 or 6."""
        written = [places.written for places in self.units.values()]
        if not any(each[True] for each in written):
            return
        self.tolerance["write_multiple"] = 1
        for path in (path for each in written for path in each[False]):
            self.desk.changed(path, "written with function 15 or 16, as others of this hub")

    def _entities(self, platform: str) -> list[Section]:
        found = self.hub.get(platform)
        if isinstance(found, dict):
            return [Section(self.desk, self.hub.at(platform), found)]
        return self.hub.sections(platform)

    def _entity(self, entity: Section, platform: str, convert: Entities) -> None:
        given = entity.get("device_address")
        key = "device_address" if given is not None else "slave"
        number = entity.integer(key, int(self._is_line), MAX_UNIT, what="a unit id")
        if entity.get(key) is None:
            message = f"no slave: unit {UNIT}, as in newer versions; older ones asked 0"
            self.desk.check(entity.path, message)
        places = self.units.setdefault(UNIT if number is None else number, Places(self.desk))
        interval = entity.integer("scan_interval", 0, 10**9, what="seconds")
        if interval is not None and interval > MAX_TIME:
            interval = int(MAX_TIME)
            entity.changed("scan_interval", f"polled every {interval} s, the longest interval")
        known = len(places.tags)
        if entity.text("name", required=True) is not None:
            places.begin(entity, platform, SCAN_INTERVAL_S if interval is None else interval)
            convert(places, entity)
        if interval == 0 and len(places.tags) > known:
            entity.changed("scan_interval", "polled with the others of its device")
        entity.close(_ENTITY_REASONS)

    def _network(self, kind: str) -> str:
        host = self.hub.text("host", required=True) or ""
        port = self.hub.integer("port", 1, 65535, required=True, what="a port") or 0
        url = f"{_SCHEMES[kind]}://{joined(host, port)}"
        if host and port:
            self._check(url, "host")
        self._pauses(0)
        return url

    def _serial(self) -> str:
        hub = self.hub
        method = hub.word("method", ("rtu", "ascii"), required=True) or "rtu"
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
            hub.problem("bytesize", "found 7 with method rtu, allowed: 8")
        scheme, mark, address = port.partition("://")
        url = f"{method}://{quote(port)}"
        if mark and scheme == "socket":
            url, options = f"{method}+tcp://{address}", {}
        elif mark:
            message = f"found {show(port)}, allowed: a serial port, or socket://host:port"
            hub.problem("port", message)
        elif not port.startswith("/"):
            url = f"{method}:///{quote(port)}"
        if (port and not mark) or scheme == "socket":
            self._check(url, "port")
        self.line = {key: value for key, value in options.items() if value is not None}
        self._pauses(SERIAL_WAIT_MS)
        return url

    def _check(self, url: str, key: str) -> None:
        try:
            parse(url)
        except ValueError as error:
            hidden = isinstance(self.hub.data.get(key), Secret)
            message = "found a secret, allowed: the address of a device" if hidden else str(error)
            self.hub.problem(key, message)

    def _pauses(self, usual_wait_ms: int) -> None:
        """The pauses that the source made."""
        wait = self.hub.integer("message_wait_milliseconds", 0, 60_000, what="milliseconds")
        wait = usual_wait_ms if wait is None else wait
        delay = self.hub.integer("delay", 0, 60, what="seconds")
        pauses = {"pause": wait / 1000, "pause_after_connect": delay}
        self.tolerance = {key: value for key, value in pauses.items() if value}
