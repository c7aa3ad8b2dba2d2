"""Imports configurations of modbus-proxy: its devices become links, with a listener each.

Its files are YAML, JSON or TOML, as their names end. It speaks Modbus TCP only, whatever the scheme
of a URL.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from holdfast.client.base import MAX_TIMEOUT_S
from holdfast.client.url import MAX_PAUSE_S
from holdfast.config.text.messages import show
from holdfast.config.values.ip_addresses import Bind, parse_bind
from holdfast.importing.imported import Imported, NotImportable, Source
from holdfast.importing.key_reader import Section
from holdfast.importing.names import allowed_name, free_name
from holdfast.importing.notes import Desk
from holdfast.importing.source_requests import joined as joined_ranges
from holdfast.importing.toml_document import document
from holdfast.net.addresses import LOOPBACK, joined
from holdfast.net.hosts import host_and_port
from holdfast.protocol import MAX_UNIT

if TYPE_CHECKING:
    from holdfast.config.text.problems import Problem

TIMEOUT_S = 10
"""Seconds for a device without a timeout, as documented. The source waited without an end."""

_PORT = 502
"""That of a `bind` without one. A device without one was never reached."""

_THIS_MACHINE = ("", "0", "0.0.0.0")

_TOP_REASONS = {"logging": "the log is on standard error; see log"}


def read_modbus_proxy(path: Path | str) -> Imported:
    """Converts a configuration of modbus-proxy.

    Raises `ConfigError` with every problem that prevents the import.
    """
    problems: list[Problem] = []
    if Path(path).suffix == ".toml":
        desk, is_mapping = Desk(document(path)), True
    else:
        source = Source(path)
        desk, problems, is_mapping = source.desk, source.problems, source.is_mapping()
    desk.folds = True
    config: dict[str, Any] = {}
    if is_mapping:
        config = _Proxies(desk).read(Section(desk, (), desk.document.data))
    if problems := problems + desk.report.problems:
        raise NotImportable(desk.document.file, problems, desk.notes)
    return Imported(desk.document.file, "modbus-proxy", "modbus-proxy", config, desk.notes)


@dataclass
class _Proxies:
    """Reads `devices` into links, devices for other unit ids, and listeners."""

    desk: Desk
    links: dict[str, dict[str, Any]] = field(default_factory=dict)
    devices: dict[str, dict[str, Any]] = field(default_factory=dict)
    listeners: dict[str, dict[str, Any]] = field(default_factory=dict)
    _addresses: dict[tuple[str, int], str] = field(default_factory=dict)
    """The link of each address."""

    def read(self, root: Section) -> dict[str, Any]:
        """The configuration."""
        if root.get("devices") == []:
            root.problem("devices", "no device, allowed: at least one")
        for one in root.sections("devices", required=True):
            self._read_one(one)
        root.close(_TOP_REASONS)
        for message in (
            "a write is sent once; modbus-proxy sent it again, as it did reads",
            "without a reply, clients get exception 0A or 0B; modbus-proxy closed the connection",
        ):
            root.changed("devices", message)
        message = "function codes that the standard does not have do not pass"
        root.check("devices", f"{message}: if some have to, list all in functions of the rule")
        devices = {"devices": self.devices} if self.devices else {}
        return {**devices, "links": self.links, "listeners": self.listeners}

    def _read_one(self, one: Section) -> None:
        modbus = one.mapping("modbus", required=True)
        listen = one.mapping("listen", required=True)
        link = None if modbus is None else self._link(modbus)
        bind = None if listen is None else self._bind(listen)
        other_ids = self._other_ids(one)
        one.close()
        if link is None or bind is None:
            return
        units: dict[int | str, dict[str, str]] = {
            unit: {"route": self._device(link, real)} for unit, real in other_ids.items()
        }
        same = (range(unit, unit + 1) for unit in range(MAX_UNIT + 1) if unit not in other_ids)
        for ids in joined_ranges(same):
            key = ids.start if len(ids) == 1 else f"{ids.start}-{ids.stop - 1}"
            units[key] = {"route": link}
        sources = list(map(str, LOOPBACK))
        if not bind.address.is_loopback:
            sources = ["0.0.0.0/0", "::/0"]
            message = "sources are all addresses; list only networks that need it"
            self.desk.check(one.at("listen"), message)
        self.listeners[free_name(link, set(self.listeners))] = {
            "type": "modbus-tcp",
            "bind": str(bind),
            "idle_timeout": 0,
            "rules": [{"sources": sources, "units": units, "access": "read-write"}],
        }

    def _link(self, modbus: Section) -> str | None:
        """The link of a device, which all with its address share."""
        address = self._address(modbus)
        timeout = self._timeout(modbus)
        pause = modbus.number("connection_time") or 0
        modbus.close()
        if address is None or timeout is None:
            return None
        tolerance: dict[str, Any] = {"retries": 1}
        if pause > MAX_PAUSE_S:
            modbus.changed("connection_time", f"lowered to {MAX_PAUSE_S} s, the longest pause")
        if pause > 0:
            tolerance["pause_after_connect"] = min(pause, MAX_PAUSE_S)
        made = {"url": f"tcp://{joined(*address)}", "timeout": timeout, "tolerance": tolerance}
        if address in self._addresses:
            name = self._addresses[address]
            if self.links[name] != made:
                message = "timeout and connection_time are those of the first with this url"
                modbus.changed("url", f"{message}, as both share a connection")
            return name
        host, port = address
        wanted = host if port == _PORT else f"{host}-{port}"
        name = self._addresses[address] = free_name(allowed_name(wanted), self._taken())
        self.links[name] = made
        return name

    def _device(self, link: str, unit: int) -> str:
        """The device with this unit id behind a link."""
        url, timeout = self.links[link]["url"], self.links[link]["timeout"]
        made = {"url": url, "timeout": timeout, "unit": unit}
        for name, each in self.devices.items():
            if each == made:
                return name
        name = free_name(f"{link}-unit-{unit}", self._taken())
        self.devices[name] = made
        return name

    def _taken(self) -> set[str]:
        return {*self.links, *self.devices}

    def _address(self, modbus: Section) -> tuple[str, int] | None:
        """Host and port of a device."""
        text = modbus.text("url", required=True)
        if text is None:
            return None
        scheme, _, rest = text.rpartition("://")
        host, _, port = rest.removesuffix("/").rpartition(":")
        try:
            here = "127.0.0.1" if host in _THIS_MACHINE else host
            name, number = host_and_port(f"{here}:{port}")
        except ValueError:
            number = None
        if number is None:
            modbus.problem("url", f"found {show(text)}, allowed: host:port, as in plc1:502")
            return None
        if scheme.lower() not in ("", "tcp"):
            modbus.check("url", "connects by Modbus TCP, as modbus-proxy did with any scheme")
        return name, number

    def _timeout(self, modbus: Section) -> int | float | None:
        """Seconds for a request; `None` and a problem, if the source can't have used it."""
        seconds = modbus.number("timeout")
        if seconds is None:
            message = f"no timeout: {TIMEOUT_S} s; modbus-proxy waited without an end"
            self.desk.check(modbus.path, message)
            return TIMEOUT_S
        if not 0.001 <= seconds <= MAX_TIMEOUT_S:
            allowed = f"allowed: seconds, 0.001 to {MAX_TIMEOUT_S:.0f}"
            modbus.problem("timeout", f"found {seconds}, {allowed}")
            return None
        return seconds

    def _bind(self, listen: Section) -> Bind | None:
        """The address and port of a listener."""
        text = listen.text("bind", required=True)
        listen.close()
        if text is None:
            return None
        rest = text.rpartition("://")[2]
        host, _, port = (rest if ":" in rest else f"{rest}:{_PORT}").rpartition(":")
        address = "0.0.0.0" if host in _THIS_MACHINE else host
        if host.lower() == "localhost":
            address = "127.0.0.1"
        try:
            return parse_bind(f"{address}:{port}")
        except ValueError:
            message = f"found {show(text)}, allowed: an IP address and a port, as in 0:9000"
            listen.problem("bind", message)
            return None

    def _other_ids(self, one: Section) -> dict[int, int]:
        """The unit ids of clients for which the device has others."""
        given = one.mapping("unit_id_remapping")
        found: dict[int, int] = {}
        if given is None:
            return found
        for key in given.data:
            if isinstance(key, str) or not 0 <= key <= MAX_UNIT:
                given.left_out(key, "no unit id as an integer; modbus-proxy ignored it")
                continue
            unit = given.integer(key, 0, MAX_UNIT, required=True, what="a unit id")
            if unit is not None and unit != key:
                found[key] = unit
        return found
