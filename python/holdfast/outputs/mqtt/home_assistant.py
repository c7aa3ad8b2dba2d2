"""Discovery messages for Home Assistant: one device for each device, one entity for each tag.

A device class is that of the tag, or what its unit suggests: % and m³, for example, suggest none.
Each device also has diagnostic entities, and all are behind one device for the output.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import msgspec

from holdfast._core import __version__
from holdfast.config.values.home_assistant_classes import (
    BINARY_SENSORS,
    SWITCHES,
    TEXTS,
    is_on_or_off,
    of_number,
    takes,
    unit_of,
)
from holdfast.net.addresses import address_in
from holdfast.tags.scale import RegisterScale, linear_of
from holdfast.tags.text import text_of
from holdfast.values.numeric import limits

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping, Sequence

    from holdfast.config.models.outputs import MqttOutputConfig
    from holdfast.outputs.device_access import DeviceInfo
    from holdfast.tags import Tag

MIN_STEP = 0.001
"""The smallest step that Home Assistant accepts."""

MAX_NUMBER = 1e9
"""The bounds of writable floats without `min` and `max`."""

NONE = "None"
"""What Home Assistant takes as no value."""

ORIGIN = {"name": "Holdfast", "sw_version": __version__}


class Discovery:
    """The discovery messages of an output."""

    def __init__(self, output: str, settings: MqttOutputConfig) -> None:
        self._output, self._settings, self._names = output, settings, settings.topics
        self._prefix = settings.discovery_prefix
        self._node = f"holdfast_{_escaped(output)}"

    @property
    def birth_topic(self) -> str:
        """Where Home Assistant says that it has started."""
        return f"{self._prefix}/status"

    @property
    def filter(self) -> str:
        """Matches the topics of all entities that this output may have published."""
        return f"{self._prefix}/+/{self._node}/+/config"

    def owns(self, topic: str) -> bool:
        """Whether a topic is one of an entity of this output."""
        first, _, rest = topic.removeprefix(f"{self._prefix}/").partition(f"/{self._node}/")
        return topic.startswith(f"{self._prefix}/") and bool(first) and rest.endswith("/config")

    def entities(
        self, tags: Mapping[str, Sequence[Tag]], devices: Mapping[str, DeviceInfo]
    ) -> dict[str, bytes]:
        """The message of each entity, by its topic.

        A device that is not in `devices` has just been removed.
        """
        return {
            f"{self._prefix}/{component}/{self._node}/{place}/config": msgspec.json.encode(entity)
            for component, place, entity in self._all(tags, devices)
        }

    def _all(
        self, tags: Mapping[str, Sequence[Tag]], devices: Mapping[str, DeviceInfo]
    ) -> Iterator[tuple[str, str, dict[str, Any]]]:
        """The component of each entity, its place in topics and ids, and its message.

        A place with two hyphens in a row is that of a tag: names are escaped.
        """
        # Home Assistant wants to know the device of the output before those behind it.
        if tags.keys() & devices.keys():
            yield self._connection("connection", self._names.status, self._hub())
        for device in (each for each in tags if each in devices):
            of, status = self._of_device(device, devices[device]), self._names.status
            topic, escaped = self._names.of_availability(device), _escaped(device)
            behind = {"availability": [{"topic": status}], **of}
            yield self._connection(f"{escaped}-connection", topic, behind)
            yield self._address(f"{escaped}-address", topic, devices[device], behind)
            shared = {
                "availability": [{"topic": status}, {"topic": topic}],
                "availability_mode": "all",
                **of,
            }
            for tag in tags[device]:
                if tag.of_type.count is not None or tag.of_type.base == "bytes":
                    continue
                component, own = self._entity(device, tag)
                place = f"{escaped}--{_escaped(tag.name)}"
                entity = {
                    "name": tag.description or tag.name,
                    "unique_id": f"{self._node}_{place}",
                    **self._state(device, tag, own),
                    **own,
                    **shared,
                }
                yield component, place, entity

    def _hub(self) -> dict[str, Any]:
        """The device of the output."""
        device = {
            "identifiers": [self._node],
            "name": f"Holdfast {self._output}",
            "manufacturer": "Holdfast",
            "sw_version": __version__,
        }
        return {"device": device, "origin": ORIGIN}

    def _of_device(self, device: str, info: DeviceInfo) -> dict[str, Any]:
        found = {
            "manufacturer": info.maker,
            "model": info.model,
            "sw_version": info.version,
            "configuration_url": _page(info.host),
        }
        own = {
            "identifiers": [f"{self._node}_{_escaped(device)}"],
            "name": device,
            "via_device": self._node,
            **{key: value for key, value in found.items() if value is not None},
        }
        return {"device": own, "origin": ORIGIN}

    def _connection(
        self, place: str, topic: str, shared: dict[str, Any]
    ) -> tuple[str, str, dict[str, Any]]:
        """Whether the output is connected, or a device answers."""
        entity = {
            "name": "Connection",
            "unique_id": f"{self._node}_{place}",
            "state_topic": topic,
            "payload_on": "online",
            "payload_off": "offline",
            "device_class": "connectivity",
            "entity_category": "diagnostic",
            **shared,
        }
        return "binary_sensor", place, entity

    def _address(
        self, place: str, topic: str, info: DeviceInfo, shared: dict[str, Any]
    ) -> tuple[str, str, dict[str, Any]]:
        """The address of a device: a template without the message, so it needs no topic."""
        entity = {
            "name": "Address",
            "unique_id": f"{self._node}_{place}",
            "state_topic": topic,
            "value_template": f"{{{{ {_quoted(info.address)} }}}}",
            "entity_category": "diagnostic",
            **shared,
        }
        return "sensor", place, entity

    def _entity(self, device: str, tag: Tag) -> tuple[str, dict[str, Any]]:
        """The component of a tag, and what only that component has."""
        # Commands are refused for tags whose scale is in a register.
        writes = self._settings.writes and tag.writable and tag.source is None
        command = {"command_topic": self._names.of_commands(device, tag.name)} if writes else {}
        if is_on_or_off(tag):
            on, off = ("on", "off")
            if set(tag.states.values()) != {on, off}:
                on, off = text_of(tag, True), text_of(tag, False)
            if off == "on":  # A relay that is on at 0: Home Assistant has no names, only on.
                on, off = off, on
            shown = {"payload_on": on, "payload_off": off}
            if not writes:
                return "binary_sensor", shown | _device_class(tag, BINARY_SENSORS)
            shown |= {"state_on": on, "state_off": off}
            return "switch", shown | command | _device_class(tag, SWITCHES)
        if tag.states:
            options = list(tag.states.values())
            if writes:
                return "select", {"options": options, **command}
            return "sensor", {"device_class": "enum", "options": options}
        if not tag.is_number:
            return "sensor", _device_class(tag, TEXTS)
        device_class, state_class = of_number(tag)
        own = {"unit_of_measurement": unit_of(tag)} if tag.unit else {}
        if device_class:
            own["device_class"] = device_class
        if writes and (bounds := _bounds(tag))["min"] < bounds["max"]:
            return "number", {**own, **bounds, "mode": "box", **command}
        return "sensor", {**own, "state_class": state_class}

    def _state(self, device: str, tag: Tag, own: dict[str, Any]) -> dict[str, str]:
        """Where the state of an entity is. No value, and one without a name, is `None`.

        So is a number beyond its bounds: Home Assistant would go on to show the one before.
        """
        form = self._settings.payload
        named = bool(tag.states)
        if form == "plain":
            known = f"in {_listed(tag.states.values())}" if named else "!= ''"
            known += _within(own, "value")
            template = f"{{{{ value if value {known} else '{NONE}' }}}}"
            return {"state_topic": self._names.of_tag(device, tag.name), "value_template": template}
        if form == "json":
            topic = self._names.of_tag(device, tag.name)
            found = f"value_json.get('{'state' if named else 'value'}')"
        else:
            topic = self._names.of_device(device)
            part = "states" if named else "values"
            found = f"value_json.get('{part}', {{}}).get('{tag.name}')"
        if not named and tag.of_type.base in ("bool", "bit"):
            found = f"{{true: 'true', false: 'false'}}.get({found}, '{NONE}')"
        else:
            found = f"{found} if {found} is not none{_within(own, found)} else '{NONE}'"
        return {"state_topic": topic, "value_template": f"{{{{ {found} }}}}"}


def _device_class(tag: Tag, known: Collection[str]) -> dict[str, str]:
    """The class that a tag names, if its entity, whose classes are `known`, can have it."""
    is_given = tag.device_class and takes(known, tag.device_class)
    return {"device_class": tag.device_class} if is_given else {}


def _bounds(tag: Tag) -> dict[str, float]:
    """The bounds of a number, and its step."""
    assert not isinstance(tag.scale, RegisterScale), "such a tag is a sensor"
    if tag.is_float:
        step, low, high = MIN_STEP, -MAX_NUMBER, MAX_NUMBER
    else:
        step = max(abs(tag.scale), MIN_STEP)
        linear = linear_of(tag.scale, tag.offset)
        ends = [linear.value(limit) for limit in limits(tag.of_type.base)]
        low, high = min(ends), max(ends)
    low = low if tag.min is None else tag.min
    high = high if tag.max is None else tag.max
    return {"min": low, "max": high, "step": step}


def _within(own: dict[str, Any], value: str) -> str:
    """A condition in a template: the bounds of an entity, if it has some.

    All are floats: as one, an integer of 64 bits may be larger than itself.
    """
    if "min" not in own:
        return ""
    return f" and {float(own['min'])} <= float({value}) <= {float(own['max'])}"


def _listed(names: Any) -> str:
    """A list of text in a template."""
    return f"[{', '.join(map(_quoted, names))}]"


def _quoted(text: str) -> str:
    """Text in a template."""
    escaped = text.replace("\\", "\\\\").replace("'", "\\'")
    return f"'{escaped}'"


def _page(host: str | None) -> str | None:
    """Where a device may have a page of its own; none on a serial line or on this machine."""
    if host is None or host == "localhost":
        return None
    address = address_in(host)
    if address is not None and address.is_loopback:
        return None
    return f"http://{f'[{host}]' if ':' in host else host}/"


def _escaped(name: str) -> str:
    """A name in a discovery topic, which allows no dot. No two names become one."""
    return name.replace("-", "-m").replace(".", "-d")
