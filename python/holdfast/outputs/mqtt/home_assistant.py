"""Discovery messages for Home Assistant: one device for each device, one entity for each tag."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import msgspec

from holdfast._core import __version__
from holdfast.outputs.mqtt.quantities import classes
from holdfast.tags.register_scale import RegisterScale
from holdfast.tags.text import text_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from holdfast.config.outputs import MqttOutputConfig
    from holdfast.tags import Tag

MIN_STEP = 0.001
"""The smallest step that Home Assistant accepts."""

MAX_NUMBER = 1e9
"""The bounds of writable floats without `min` and `max`."""

NONE = "None"
"""What Home Assistant takes as no value."""

_NOT_SHOWN = ("bytes",)


class Discovery:
    """The discovery messages of an output."""

    def __init__(self, output: str, settings: MqttOutputConfig) -> None:
        self._settings, self._names = settings, settings.topics
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

    def entities(self, tags: Mapping[str, Sequence[Tag]]) -> dict[str, bytes]:
        """The message of each entity, by its topic."""
        return dict(self._all(tags))

    def _all(self, tags: Mapping[str, Sequence[Tag]]) -> Iterator[tuple[str, bytes]]:
        for device, some in tags.items():
            shared = self._shared(device)
            for tag in some:
                if tag.of_type.count is not None or tag.of_type.base in _NOT_SHOWN:
                    continue
                component, own = self._entity(device, tag)
                unique = f"{_escaped(device)}--{_escaped(tag.name)}"
                entity = {
                    "name": tag.description or tag.name,
                    "unique_id": f"{self._node}_{unique}",
                    **self._state(device, tag),
                    **own,
                    **shared,
                }
                topic = f"{self._prefix}/{component}/{self._node}/{unique}/config"
                yield topic, msgspec.json.encode(entity)

    def _shared(self, device: str) -> dict[str, Any]:
        topics = (self._names.status, self._names.of_availability(device))
        return {
            "availability": [{"topic": topic} for topic in topics],
            "availability_mode": "all",
            "device": {"identifiers": [f"{self._node}_{_escaped(device)}"], "name": device},
            "origin": {"name": "Holdfast", "sw_version": __version__},
        }

    def _entity(self, device: str, tag: Tag) -> tuple[str, dict[str, Any]]:
        """The component of a tag, and what only that component has."""
        # Commands are refused for tags whose scale is in a register.
        writes = self._settings.writes and tag.writable and tag.source is None
        command = {"command_topic": self._names.of_commands(device, tag.name)} if writes else {}
        if tag.of_type.base in ("bool", "bit"):
            on, off = text_of(tag, True), text_of(tag, False)
            if not writes:
                return "binary_sensor", {"payload_on": on, "payload_off": off}
            states = {"state_on": on, "state_off": off}
            return "switch", {"payload_on": on, "payload_off": off, **states, **command}
        if tag.states:
            options = list(tag.states.values())
            if writes:
                return "select", {"options": options, **command}
            return "sensor", {"device_class": "enum", "options": options}
        if not tag.is_number:
            return "sensor", {}
        device_class, state_class = classes(tag.unit)
        own = {"unit_of_measurement": tag.unit} if tag.unit else {}
        if device_class is not None:
            own["device_class"] = device_class
        if writes:
            return "number", {**own, **_bounds(tag), "mode": "box", **command}
        return "sensor", {**own, "state_class": state_class}

    def _state(self, device: str, tag: Tag) -> dict[str, str]:
        """Where the state of an entity is. No value, and one without a name, is `None`."""
        form = self._settings.payload
        named = bool(tag.states)
        if form == "plain":
            known = f"in {_listed(tag.states.values())}" if named else "!= ''"
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
            found = f"{found} if {found} is not none else '{NONE}'"
        return {"state_topic": topic, "value_template": f"{{{{ {found} }}}}"}


def _bounds(tag: Tag) -> dict[str, float]:
    """The bounds of a number, and its step."""
    assert not isinstance(tag.scale, RegisterScale), "such a tag is a sensor"
    if tag.is_float:
        step, low, high = MIN_STEP, -MAX_NUMBER, MAX_NUMBER
    else:
        step = max(abs(tag.scale), MIN_STEP)
        ends = [limit * tag.scale + tag.offset for limit in _limits(tag)]
        low, high = min(ends), max(ends)
    low = low if tag.min is None else tag.min
    high = high if tag.max is None else tag.max
    return {"min": low, "max": high, "step": step}


def _limits(tag: Tag) -> tuple[int, int]:
    """The least and the greatest number that the registers of an integer hold."""
    bits, base = 16 * tag.count, tag.of_type.base
    if base.startswith("bcd"):
        return 0, 10 ** (bits // 4) - 1
    if base.startswith("uint"):
        return 0, 2**bits - 1
    return -(2 ** (bits - 1)), 2 ** (bits - 1) - 1


def _listed(names: Any) -> str:
    """A list of text in a template."""
    escaped = (name.replace("\\", "\\\\").replace("'", "\\'") for name in names)
    joined = "', '".join(escaped)
    return f"['{joined}']"


def _escaped(name: str) -> str:
    """A name in a discovery topic, which allows no dot. No two names become one."""
    return name.replace("-", "-m").replace(".", "-d")
