"""Imports the Modbus inputs of Telegraf: each becomes one device for each unit id that it reads.

Fields with other tags, or of another measurement, are a device of their own: an output has one set
of tags, and one measurement, for its devices.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any
from urllib.parse import quote, unquote, urlencode, urlsplit

from holdfast.client.serial_settings import SerialTarget
from holdfast.client.url import MAX_PAUSE_S, MAX_RETRIES, connection_of, parse
from holdfast.config.text.messages import show
from holdfast.config.values.scalars import MIN_TIME
from holdfast.importing.telegraf.durations import interval, seconds
from holdfast.importing.telegraf.fields import STYLES, Field, Fields
from holdfast.importing.telegraf.reasons import FILTERS, LOGGED
from holdfast.net.addresses import joined
from holdfast.protocol import MAX_UNIT, READ_BITS, READ_REGISTERS
from holdfast.values import register_count

if TYPE_CHECKING:
    from collections.abc import Mapping

    from holdfast.config.text.yaml_document import KeyPath
    from holdfast.importing.key_reader import Section
    from holdfast.importing.notes import Desk

INTERVAL_S = 10
"""The default of the source."""

TIMEOUT_S = 1
"""Seconds for an input without a timeout. The source waits without an end."""

_NETWORK_MODES = {"TCP": "tcp", "RTUoverTCP": "rtu+tcp", "ASCIIoverTCP": "ascii+tcp"}
_SERIAL_MODES = {"RTU": "rtu", "ASCII": "ascii"}
_PARITY = {"N": "none", "E": "even", "O": "odd"}
_SERIAL_KEYS = ("baud_rate", "data_bits", "parity", "stop_bits", "rs485")


_INPUT_REASONS = {
    **FILTERS,
    "alias": "a device has one name",
    "always_include_global_tags": "an output adds its tags to all points",
    "always_include_local_tags": "an output adds its tags to all points",
    "collection_jitter": "first polls are spread over the interval",
    "collection_offset": "first polls are spread over the interval",
    "debug_connection": LOGGED,
    "exclude_register_type_tag": "no point has the tag type",
    "log_level": LOGGED,
    "precision": "times are those of the replies, in microseconds",
    "startup_error_behavior": "a device that can't be reached is tried again",
    "tags": "add an output with these tags, and list the devices of this input in its devices",
}


@dataclass
class Device:
    """A device, with the name that its input has."""

    path: KeyPath
    name: str
    unit: int
    series: str
    """What tells it apart from others of this unit."""
    data: dict[str, Any]
    fields: list[Field]
    """At least one; all have the same measurement and tags."""


@dataclass
class InputReader:
    """Reads one input."""

    input: Section
    agent_interval: float | None
    """`None` if the file has no agent: that can be in another file."""
    tolerance: dict[str, Any] = field(default_factory=dict)
    limits: dict[str, int] = field(default_factory=dict)

    def devices(self) -> list[Device]:
        """The devices that have tags."""
        one = self.input
        name = one.name("name", required=True) or "device"
        url = self._url()
        timing = {"interval": self._interval(), "timeout": self._timeout()}
        location, one_request_per_field = self._workarounds()
        self._read_busy_retries()
        fields = Fields(one, location, one_request_per_field)
        style = fields.read()
        self._rename_measurements(fields)
        others = {key for each in STYLES if each != style for key in STYLES[each]}
        reason = f"Telegraf ignored it with configuration_type {style}"
        one.close(_INPUT_REASONS | dict.fromkeys(others - set(STYLES[style]), reason))
        made = []
        for number, unit in fields.units.items():
            if not unit.fields:
                continue
            if url is not None and url.startswith(("rtu:", "ascii:")):
                self._check_serial_unit(number)
            for series, its_fields in unit.series():
                data: dict[str, Any] = {"url": url, "unit": number, **timing}
                if self.tolerance:
                    data["tolerance"] = dict(self.tolerance)
                data |= unit.settings(one.desk, its_fields, self._limits(its_fields))
                made.append(Device(one.at("name"), name, number, series, data, its_fields))
        return made

    def _limits(self, fields: list[Field]) -> dict[str, int]:
        """The limits that the source names. No request is shorter than the longest field."""
        most = self.limits.get("max_registers")
        types = (each.tag.get("type", "bool") for each in fields)
        longest = min(max(map(register_count, types)), READ_REGISTERS)
        if most is None or longest <= most:
            return self.limits
        path = (*self.input.at("workarounds"), "max_word_registers_per_request")
        message = f"raised to {longest}, the registers of the longest field: one request reads it"
        self.input.desk.changed(path, message)
        return self.limits | {"max_registers": longest}

    def _check_serial_unit(self, number: int) -> None:
        if number == 0:
            allowed = f"allowed on a serial line: 1 to {MAX_UNIT}"
            self.input.desk.problem(self.input.path, f"found slave_id {number}, {allowed}")

    def _interval(self) -> float:
        given = self.input.get("interval")
        if given is not None and not isinstance(given, str):
            message = "Telegraf ignored an interval that is not text; see that of the agent"
            self.input.left_out("interval", message)
            return self.agent_interval or INTERVAL_S
        found = interval(self.input)
        if found is None and self.agent_interval is None:
            message = f"no agent in this file: {INTERVAL_S} s, the default of Telegraf"
            self.input.desk.check(self.input.path, message)
        return found or self.agent_interval or INTERVAL_S

    def _timeout(self) -> float:
        given = seconds(self.input, "timeout")
        if given is None:
            message = f"no timeout: {TIMEOUT_S} s; Telegraf waited without an end"
            self.input.desk.check(self.input.path, message)
            return TIMEOUT_S
        if given < MIN_TIME:
            self.input.changed("timeout", "raised to 1 ms, the shortest timeout")
        return max(given, MIN_TIME)

    def _rename_measurements(self, fields: Fields) -> None:
        """Applies the keys that change the measurement of all fields."""
        override = self.input.text("name_override")
        prefix, suffix = self.input.text("name_prefix"), self.input.text("name_suffix")
        keys = ("name_override", "name_prefix", "name_suffix")
        given = [key for key in keys if self.input.get(key)]
        for each in (each for unit in fields.units.values() for each in unit.fields):
            each.measurement = f"{prefix or ''}{override or each.measurement}{suffix or ''}"
            each.measured_at = self.input.at(given[0]) if given else each.measured_at

    def _read_busy_retries(self) -> None:
        """Reads how often a busy device is asked again."""
        times = self.input.integer("busy_retries", 0, 1_000_000)
        if self.input.get("busy_retries_wait") is not None:
            message = "the pause before a retry is at least 0.1 s; see pause of tolerance"
            self.input.left_out("busy_retries_wait", message)
        if times:
            self.tolerance |= {"retries": min(times, MAX_RETRIES), "retry_busy": True}
            message = f"{min(times, MAX_RETRIES)} retries, also after timeouts and lost connections"
            self.input.changed("busy_retries", message)

    def _workarounds(self) -> tuple[str | None, bool]:
        """Reads the table of workarounds. Returns where text is in registers, and whether each
        field has a request of its own.
        """
        table = self.input.mapping("workarounds")
        if table is None:
            return None, False
        for key, option in (
            ("pause_after_connect", "pause_after_connect"),
            ("pause_between_requests", "pause"),
        ):
            pause = seconds(table, key)
            if pause is not None and pause > MAX_PAUSE_S:
                table.problem(key, f"found {pause} seconds, allowed: up to {MAX_PAUSE_S}")
            elif pause is not None:
                self.tolerance[option] = pause
        if table.flag("close_connection_after_gather"):
            self.tolerance["close_after"] = 1
        if one_request_per_field := bool(table.flag("one_request_per_field")):
            message = "no request is longer than the longest field; shorter ones may share one"
            table.changed("one_request_per_field", message)
        for key, option, most in (
            ("max_bit_registers_per_request", "max_bits", READ_BITS),
            ("max_word_registers_per_request", "max_registers", READ_REGISTERS),
        ):
            number = table.integer(key, 0, most)
            if number and one_request_per_field:
                table.left_out(key, "one_request_per_field makes requests as short as fields")
            elif number:
                self.limits[option] = number
        location = table.text("string_register_location")
        if location not in (None, "both", "lower", "upper"):
            message = f"found {show(location)}, allowed: both, lower or upper"
            table.problem("string_register_location", message)
        if table.flag("read_coils_starting_at_zero"):
            message = "requests are planned from all tags; see max_registers and max_bits"
            table.left_out("read_coils_starting_at_zero", message)
        table.close()
        return location, one_request_per_field

    def _url(self) -> str | None:
        """The URL of the controller."""
        text = self.input.text("controller", required=True)
        if text is None:
            return None
        try:
            parts = urlsplit(text)
            is_network, port = parts.scheme == "tcp", parts.port
        except ValueError:
            self._wrong_controller(text)
            return None
        if is_network:
            made = self._network_url(parts.hostname or "127.0.0.1", port)
        elif parts.scheme in ("", "file"):
            made = self._serial_url(f"{parts.netloc}{unquote(parts.path)}")
        else:
            made = None
        try:
            parse(made or "")
        except ValueError:
            self._wrong_controller(text)
            return None
        return made

    def _wrong_controller(self, text: str) -> None:
        forms = "tcp://host:502, file:///dev/ttyUSB0 or COM1"
        self.input.problem("controller", f"found {show(text)}, allowed: {forms}")

    def _mode(self, modes: Mapping[str, str]) -> str:
        first = next(iter(modes.values()))
        if self.input.get("transmission_mode") in (None, "", "auto"):
            return first
        return modes.get(self.input.word("transmission_mode", ("auto", *modes)) or "", first)

    def _network_url(self, host: str, port: int | None) -> str | None:
        mode = self._mode(_NETWORK_MODES)
        for key in _SERIAL_KEYS:
            if self.input.get(key) is not None:
                self.input.left_out(key, "Telegraf used it for serial lines only")
        return None if port is None else f"{mode}://{joined(host, port)}"

    def _serial_url(self, device: str) -> str | None:
        mode = self._mode(_SERIAL_MODES)
        parity = self.input.get("parity")
        options = {
            "baud": self.input.integer("baud_rate", 0, 4_000_000) or 19200,
            "parity": _PARITY[self.input.word("parity", tuple(_PARITY)) or "E" if parity else "E"],
            "stop_bits": self.input.integer("stop_bits", 0, 2) or 1,
        }
        bits = self.input.integer("data_bits", 0, 8) or 8
        if mode == "ascii" and bits in (7, 8):
            options["data_bits"] = bits
        elif bits != 8:
            allowed = "7 or 8" if mode == "ascii" else "8 with transmission_mode RTU"
            self.input.problem("data_bits", f"found {bits}, allowed: {allowed}")
        if (rts := self._rs485()) is not None:
            options["rs485"] = rts
        if re.fullmatch(r"COM[0-9]+|\\\\\.\\.+", device):
            device = f"/{device}"
        return f"{mode}://{quote(device)}?{urlencode(options)}" if device[:1] == "/" else None

    def _rs485(self) -> str | None:
        """How the driver switches the direction of the line."""
        table = self.input.mapping("rs485")
        if table is None:
            return None
        during, after = table.flag("rts_high_during_send"), table.flag("rts_high_after_send")
        for key in ("delay_rts_before_send", "delay_rts_after_send"):
            if seconds(table, key):
                table.left_out(key, "RTS switches without a delay")
        if table.flag("rx_during_tx"):
            table.left_out("rx_during_tx", "an echo is detected; see echo of tolerance")
        table.close()
        if bool(during) == bool(after):
            message = "RTS is the same during and after sending, so it switches nothing"
            table.desk.left_out(table.path, message)
            return None
        return "rts" if during else "rts-low"


def share_connections(desk: Desk, devices: list[Device]) -> None:
    """Gives devices at one address the same tolerance: the largest value of each setting.

    Reports different settings of one serial line, and when connections are closed.
    """
    groups: dict[str, list[Device]] = {}
    for each in devices:
        if each.data["url"] is not None:
            groups.setdefault(connection_of(parse(each.data["url"])), []).append(each)
    for group in groups.values():
        shared: dict[str, Any] = {}
        for each in group:
            for key, value in each.data.get("tolerance", {}).items():
                shared[key] = max(value, shared.get(key, value))
            _compare_lines(desk, group[0], each)
        if shared.get("pause_after_connect"):
            shared.pop("close_after", None)  # Telegraf connected once for all requests of a poll.
        for each in group:
            own = each.data.get("tolerance", {})
            path = (*each.path[:-1], "workarounds", "close_connection_after_gather")
            if "close_after" in own and "close_after" in shared:
                desk.changed(path, "the connection is closed after each request")
            elif own.pop("close_after", None):
                message = "the connection stays open: with close_after, each request would wait for"
                desk.left_out(path, f"{message} pause_after_connect")
            if own != shared:
                message = "devices at one address share pauses and retries"
                desk.changed(each.path[:-1], f"{message}: the largest value of each applies")
                each.data["tolerance"] = dict(shared)


def _compare_lines(desk: Desk, first: Device, other: Device) -> None:
    """Reports different settings of one serial line."""
    one, two = parse(first.data["url"]), parse(other.data["url"])
    if one != two and isinstance(one, SerialTarget):
        line = desk.document.place(first.path, of_key=True).line
        message = f"the serial settings differ from those of the input at line {line} of the file"
        path = (*other.path[:-1], "controller")
        desk.problem(path, f"{message}, allowed: the same settings")
