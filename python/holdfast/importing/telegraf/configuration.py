"""Imports the Modbus inputs of Telegraf: their fields become tags of devices.

An input becomes one device for each unit id, measurement and set of tags. `outputs.influxdb_v2`
becomes an output for each measurement; tokens stay in the source.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from holdfast.config.values.scalars import (
    MEASUREMENT_FORM,
    NAME_FORM,
    POINT_TAG_FORM,
    is_measurement,
    is_name,
    is_point_tag,
)
from holdfast.importing.imported import Imported, NotImportable
from holdfast.importing.key_reader import Section, section
from holdfast.importing.names import free_name, unique_names
from holdfast.importing.notes import Desk
from holdfast.importing.telegraf.durations import interval
from holdfast.importing.telegraf.fields import MEASUREMENT, Field
from holdfast.importing.telegraf.influx import Influx
from holdfast.importing.telegraf.inputs import INTERVAL_S, Device, InputReader, share_connections
from holdfast.importing.telegraf.reasons import LOGGED, NO_COUNTERPART
from holdfast.importing.toml_document import VARIABLE, document
from holdfast.runtime.text import listing

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from holdfast.config.text.yaml_document import KeyPath

_MAX_SHOWN_FIELDS = 5

_UNREAD_TEXTS = ("alias", "log_level", "tags", "startup_error_behavior")
"""Keys of an input that may contain environment variables, as nothing is made of them."""

_AGENT_REASONS = {
    "collection_jitter": "first polls are spread over the interval",
    "debug": LOGGED,
    "flush_interval": "values are sent when they are read",
    "flush_jitter": "values are sent when they are read",
    "hostname": "no point has the tag host; see tags of the output",
    "metric_buffer_limit": "see buffer of the output, which counts values",
    "omit_hostname": "no point has the tag host",
    "precision": "times are those of the replies, in microseconds",
    "quiet": LOGGED,
    "round_interval": "polls start at whole intervals from the first",
}
_OTHER_OUTPUTS = {
    "file": "add an output of type file, with format: influx for line protocol",
    "influxdb": "add an output of type influx, with url: http://host:8086/write?db=NAME",
    "mqtt": "its topics and messages have another form; add an output of type mqtt",
    "prometheus_client": "use metrics with values: true",
}


def read_telegraf(path: Path | str) -> Imported:
    """Converts the Modbus inputs of a configuration of Telegraf.

    Raises `ConfigError` with every problem that prevents the import.
    """
    desk = Desk(document(path), folds=True)
    file = desk.document.file
    root = Section(desk, (), desk.document.data)
    if not _refuse_variables(desk):
        config = _Import(desk, root).read()
    if desk.report.problems:
        raise NotImportable(file, desk.report.problems, desk.notes)
    return Imported(file, "telegraf", "Telegraf", config, desk.notes)


def _refuse_variables(desk: Desk) -> bool:
    """Adds a problem for each environment variable in a value that is converted."""
    data = desk.document.data
    read: list[tuple[KeyPath, Any]] = [(("agent", "interval"), _at(data, "agent", "interval"))]
    for path, value in _plugins(data, "inputs", "modbus"):
        keys = value if isinstance(value, dict) else {}
        read += [((*path, key), each) for key, each in keys.items() if key not in _UNREAD_TEXTS]
    outputs = list(_plugins(data, "outputs", "influxdb_v2"))
    for path, value in outputs:
        read += [((*path, key), _at(value, key)) for key in Influx.SHOWN]
    if outputs:
        read.append((("global_tags",), _at(data, "global_tags")))
    for path, value in read:
        for place, text in _texts(path, value):
            if (found := VARIABLE.search(text)) is not None:
                name = found[1] or found[2]
                message = f"found the environment variable {name}, which Telegraf replaces"
                desk.problem(place, f"{message}, allowed: its value")
    return bool(desk.report.problems)


def _at(data: Any, *keys: str) -> Any:
    for key in keys:
        data = data.get(key) if isinstance(data, dict) else None
    return data


def _texts(path: KeyPath, value: Any) -> Iterator[tuple[KeyPath, str]]:
    """All texts inside a value, each with its path."""
    if isinstance(value, str):
        yield path, value
    elif isinstance(value, dict | list):
        inside = value.items() if isinstance(value, dict) else enumerate(value)
        for key, each in inside:
            # Tags of an input or of its parts are only used for names of devices.
            if key != "tags" or path[0] != "inputs":
                yield from _texts((*path, key), each)


def _plugins(data: Any, kind: str, name: str) -> Iterator[tuple[KeyPath, Any]]:
    """The tables of a plugin, which is one table or an array of them."""
    found = _at(data, kind, name)
    if isinstance(found, list):
        yield from (((kind, name, index), each) for index, each in enumerate(found))
    elif found is not None:
        yield (kind, name), found


@dataclass
class _Import:
    """Reads the whole file."""

    desk: Desk
    root: Section
    found: list[Device] = field(default_factory=list)
    interval: float | None = None

    def read(self) -> dict[str, Any]:
        """The configuration."""
        agent = self.root.mapping("agent")
        if agent is not None:
            self.interval = interval(agent) or INTERVAL_S
            agent.close({**dict.fromkeys(agent.data, NO_COUNTERPART), **_AGENT_REASONS})
        for one in self._sections("inputs", "modbus", "not a Modbus input", {}):
            self.found += InputReader(one, self.interval).devices()
        if not self.found and not self.desk.report.problems:
            message = "no inputs.modbus with a field that can be converted, allowed: at least one"
            self.desk.problem(("inputs",), message)
        share_connections(self.desk, self.found)
        devices = self._named()
        outputs = self._outputs(list(devices))
        self.root.close(
            dict.fromkeys(("processors", "aggregators"), "values are published as they are read")
            | {"secretstores": "secrets are in files; see token_file and password_file"}
        )
        return {"devices": devices, **({"outputs": outputs} if outputs else {})}

    def _sections(
        self, kind: str, name: str, reason: str, reasons: Mapping[str, str] = _OTHER_OUTPUTS
    ) -> list[Section]:
        """The tables of a plugin; all others of its kind are left out."""
        plugins = self.root.mapping(kind)
        for key in plugins.data if plugins is not None else ():
            if key != name:
                self.desk.left_out((kind, key), reasons.get(key, reason))
        found = _plugins(self.root.data, kind, name)
        made = [section(self.desk, path, value) for path, value in found]
        return [each for each in made if each is not None]

    def _named(self) -> dict[str, dict[str, Any]]:
        """The devices by name: that of the input, with the unit id if another has the same, and
        with what tells devices of one unit apart.
        """
        units = {(each.name, each.path, each.unit) for each in self.found}
        of_name = Counter(name for name, _, _ in units)
        wanted = []
        for each in self.found:
            numbered = [str(each.unit)] if of_name[each.name] > 1 else []
            series = [each.series] if each.series else []
            wanted.append((each.path, "-".join([each.name, *numbered, *series])))
        names = unique_names(self.desk, wanted)
        for name, each in zip(names, self.found, strict=True):
            for path in {at: None for one in each.fields if (at := one.tagged_at) is not None}:
                message = f"add an output with these tags, and list {name} in its devices"
                self.desk.left_out(path, message)
        return {name: each.data for name, each in zip(names, self.found, strict=True)}

    def _outputs(self, names: list[str]) -> dict[str, dict[str, Any]]:
        reason = "no output is like it; there are influx, mqtt, sparkplug, file and nats"
        sections = self._sections("outputs", "influxdb_v2", reason)
        tags = self.root.mapping("global_tags")
        fields = [each for device in self.found for each in device.fields]
        measured = self._by_measurement(names) if sections else {}
        outputs: dict[str, dict[str, Any]] = {}
        for one in sections:
            made = Influx(one).read()
            if made is None:
                continue
            made |= {"tags": found} if (found := self._global_tags(tags)) else {}
            for measurement, devices in measured.items():
                output = dict(made)
                if measurement != MEASUREMENT:
                    output["measurement"] = measurement
                if len(measured) > 1:
                    output["devices"] = devices
                outputs[free_name("influx", set(outputs))] = output
            self._compare(one, fields)
        if not outputs:
            self._without_output(tags, fields)
        return outputs

    def _by_measurement(self, names: list[str]) -> dict[str, list[str]]:
        """The devices of each measurement, by name."""
        found: dict[str, list[str]] = {}
        for name, device in zip(names, self.found, strict=True):
            one = device.fields[0]
            measurement = one.measurement
            if not is_measurement(measurement):
                message = f"a measurement is {MEASUREMENT_FORM}"
                self.desk.left_out(one.measured_at or one.path, message)
                measurement = MEASUREMENT
            found.setdefault(measurement, []).append(name)
        return found

    def _without_output(self, tags: Section | None, fields: list[Field]) -> None:
        if tags is not None and tags.data:
            self.desk.left_out(tags.path, "no output is converted; see tags of outputs")
        for each in fields:
            if each.measured_at is not None:
                message = "no output is converted; see measurement of outputs"
                self.desk.left_out(each.measured_at, message)

    def _global_tags(self, tags: Section | None) -> dict[str, str]:
        if tags is None:
            return {}
        found = {}
        for key in tags.data:
            value = tags.get(key)
            if not is_name(key):
                tags.left_out(key, f"a tag of an output has {NAME_FORM}")
            elif key == "device":
                tags.left_out(key, "the tag device is the name of the device")
            elif not isinstance(value, str) or not value:
                tags.left_out(key, "a tag without text is not written")
            elif not is_point_tag(value):
                tags.left_out(key, f"the value of a tag of an output is {POINT_TAG_FORM}")
            else:
                found[key] = value
        return found

    def _compare(self, output: Section, fields: list[Field]) -> None:
        """Notes how points differ from those of the source."""
        message = "points have the tag device in place of name, slave_id, type and host"
        self.desk.changed(output.path, f"{message}: change the queries")
        names = list(dict.fromkeys(each.name for each in fields if each.retyped))
        if names:
            some = listing(names[:_MAX_SHOWN_FIELDS])
            more = f" and {len(names) - _MAX_SHOWN_FIELDS} more" * (len(names) > _MAX_SHOWN_FIELDS)
            message = f"{some}{more} have another type than in Telegraf (bits are booleans, "
            message += "whole numbers integers, or floats if some are beyond int64)"
            advice = "InfluxDB refuses them in the same measurement of a bucket: use another bucket"
            self.desk.check(output.path, f"{message}; {advice}")
