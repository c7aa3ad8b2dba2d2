"""The actions of Home Assistant that write, and that stop when `modbus` is removed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holdfast.config.text.messages import show
from holdfast.config.values.mqtt_output_topics import TopicNames
from holdfast.runtime.text import all_of, either
from holdfast.values import register_count

if TYPE_CHECKING:
    from collections.abc import Iterator

    from holdfast.config.text.yaml_document import KeyPath
    from holdfast.importing.notes import Desk
    from holdfast.types import Area

_WRITES: dict[str, Area] = {
    "modbus.write_register": "holding_registers",
    "modbus.write_coil": "coils",
}
"""The actions that write, and where."""

_ACTION_KEYS = ("action", "service", "service_template", "perform_action")
_DATA_KEYS = ("data", "data_template", "service_data")
"""What an action and its data were called over time."""


def note_write_actions(
    desk: Desk,
    section: KeyPath,
    of_units: dict[tuple[str, int], list[str]],
    devices: dict[str, dict[str, Any]],
) -> None:
    """Notes the actions in the file that write, with what replaces them.

    `of_units` has the names of the devices of each hub and unit id.
    """
    stops = f"{either(_WRITES)} in automations and scripts stops, also in other files"
    desk.check(section, f"{stops}: publish to set topics instead, with writes: true in the output")
    places: dict[tuple[str, str], list[KeyPath]] = {}
    for path, action, data in _writes((), desk.document.data):
        hub, unit = data.get("hub", "modbus_hub"), data.get("slave", data.get("unit", 1))
        address = data.get("address")
        names = of_units.get((str(hub), _whole(unit)), [])
        place = (_WRITES[action], _whole(address))
        tags = [
            (name, key, tag)
            for name in names
            for key, tag in devices[name]["tags"].items()
            if (tag["area"], tag["address"]) == place and tag.get("type") != "bit:0"
        ]
        instead = "make a tag writable, and publish to its set topic"
        if tags:
            instead = _instead(*min(tags, key=_preference))
        target = f"address {show(address)} of unit {show(unit)} of hub {show(hub)}"
        message = f"{action} to {target} stops when modbus is removed: {instead}"
        file = desk.document.place(path, of_key=True).file
        places.setdefault((message, file), []).append(path)
    for (message, _), paths in places.items():
        lines = dict.fromkeys(desk.document.place(path, of_key=True).line for path in paths)
        more = f" (lines {all_of(lines)})" if len(lines) > 1 else ""
        desk.check(paths[0], f"{message}{more}")


def _writes(path: KeyPath, value: Any) -> Iterator[tuple[KeyPath, str, dict[str, Any]]]:
    """The actions that write, also in a template that chooses the action, and their data."""
    inside = value.items() if isinstance(value, dict) else ()
    for key, each in enumerate(value) if isinstance(value, list) else inside:
        if key in _ACTION_KEYS and isinstance(each, str):
            data = next((value[name] for name in _DATA_KEYS if name in value), None)
            for action in _WRITES:
                if action in each.lower():
                    yield (*path, key), action, data if isinstance(data, dict) else {}
        yield from _writes((*path, key), each)


def _whole(value: Any) -> int:
    """The number as the source read it; -1, which nothing has, for a template."""
    try:
        return int(float(value))
    except (TypeError, ValueError, OverflowError):
        return -1


def _preference(candidate: tuple[str, str, dict[str, Any]]) -> tuple[bool, int]:
    """Least for a tag that is writable already, then for one of one register, as was written."""
    _, _, tag = candidate
    return not tag.get("writable"), register_count(tag.get("type", "uint16"))


def _instead(device: str, name: str, tag: dict[str, Any]) -> str:
    """What replaces an action that wrote the registers of a tag."""
    topic = TopicNames(None, None, whole_device=False).of_commands(device, name)
    value = "the scaled value" if {"scale", "offset"} & set(tag) else "the value"
    grant = "" if tag.get("writable") else f"set writable: true for {name} of {device}, and "
    return f"{grant}publish {value} to {topic}"
