"""Converts readings to the payloads of MQTT messages."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import msgspec

from holdfast.outputs.mqtt.delivery import Message, packed_topic
from holdfast.tags.text import plain, text_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from holdfast.config.models.outputs import MqttOutputConfig
    from holdfast.polling import Reading
    from holdfast.tags import Tag

MAX_POLL_SPREAD_S = 1.0
"""Readings of a device that are further apart belong to different polls."""

_json = msgspec.json.Encoder()


class Payloads:
    """Converts readings to messages. For one thread."""

    def __init__(self, settings: MqttOutputConfig) -> None:
        self._names, self._retain = settings.topics, settings.retain
        self._form = settings.payload
        self._topics: dict[tuple[str, str], bytes] = {}
        self._tags: dict[str, set[str]] | None = None
        """The tags of the configuration; `None` until they are known."""
        self._known: dict[str, dict[str, dict[str, Any]]] = {}
        self._before: dict[str, dict[str, dict[str, Any]] | None] = {}

    def messages(self, readings: list[Reading]) -> list[Message]:
        """The messages of readings of configured tags, in their order."""
        tags = self._tags
        if tags is not None:
            readings = [each for each in readings if each.name in tags.get(each.device, ())]
        if self._form == "device":
            return list(self._of_devices(readings))
        payload = _text if self._form == "plain" else _object
        topics, retain = self._topics, self._retain
        messages = []
        for reading in readings:
            device, tag = reading[0], reading[1]
            topic = topics.get((device, tag.name)) or self.topic(reading)
            messages.append(Message(topic, payload(reading), retain))
        return messages

    def settle(self, *, sent: bool) -> None:
        """Confirms the last `messages`; if they were not sent, restores the state before them."""
        before, self._before = self._before, {}
        if sent:
            return
        for device, known in before.items():
            if known is None:
                self._known.pop(device, None)
            else:
                self._known[device] = known

    def restrict_to(self, tags: dict[str, set[str]]) -> None:
        """Forgets all other devices and tags, also those of the last `messages`."""
        self._tags = tags
        self._topics.clear()
        self._known = {
            device: {
                part: {name: value for name, value in values.items() if name in tags[device]}
                for part, values in known.items()
            }
            for device, known in self._known.items()
            if device in tags
        }

    def topic(self, reading: Reading) -> bytes:
        """The topic of the message that has a reading."""
        device, tag = reading.device, reading.tag
        is_shared = self._form == "device"
        name = self._names.of_device(device) if is_shared else self._names.of_tag(device, tag.name)
        topic = self._topics[device, tag.name] = packed_topic(name)
        return topic

    def _of_devices(self, readings: list[Reading]) -> Iterator[Message]:
        """One message for the readings of each poll. It has the last value of every tag."""
        for group in _polls(readings):
            device = group[0].device
            if device not in self._before:
                self._begin(device)
            known = self._known[device]
            for reading in group:
                _, tag, value, _, _, _ = reading
                known["values"][tag.name] = plain(tag, value)
                for part, found in (("states", _state(tag, value)), ("errors", reading.error)):
                    if found is not None:
                        known[part][tag.name] = found
                    else:
                        known[part].pop(tag.name, None)
            time = _time(max(reading.time for reading in group))
            filled = {key: known[key] for key in ("values", "states", "errors") if known[key]}
            payload = _json.encode({"time": time, **filled})
            yield Message(self.topic(group[0]), payload, self._retain)

    def _begin(self, device: str) -> None:
        known = self._known.get(device)
        self._before[device] = known
        copy = {part: dict(values) for part, values in (known or {}).items()}
        self._known[device] = {"values": {}, "states": {}, "errors": {}, **copy}


def _polls(readings: list[Reading]) -> Iterator[list[Reading]]:
    """Readings that come from one poll of one device, as far as their order and times show.

    Those of several polls of less than a second that waited together may share a group: what waits
    does not know its poll.
    """
    group: list[Reading] = []
    names: set[str] = set()
    for reading in readings:
        if group and (
            reading.device != group[0].device
            or reading.tag.name in names
            or abs(reading.time - group[0].time) > MAX_POLL_SPREAD_S
        ):
            yield group
            group, names = [], set()
        group.append(reading)
        names.add(reading.tag.name)
    if group:
        yield group


def _text(reading: Reading) -> bytes:
    return text_of(reading[1], reading[2]).encode()


def _object(reading: Reading) -> bytes:
    _, tag, value, time, _, _ = reading
    found: dict[str, Any] = {"value": plain(tag, value), "time": _time(time)}
    if tag.unit:
        found["unit"] = tag.unit
    if tag.states:
        found["state"] = _state(tag, value)
    error = reading.error
    if error is not None:
        found["error"] = error
    return _json.encode(found)


def _state(tag: Tag, value: Any) -> str | None:
    return tag.state(value) if tag.states else None


def _time(time: float) -> str:
    return datetime.fromtimestamp(time, UTC).isoformat(timespec="microseconds")[:-6] + "Z"
