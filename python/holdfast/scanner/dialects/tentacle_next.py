"""The dialect of tentacle-next. Does no I/O.

Its messages have another form. They are converted to what the first generation would have sent, for
the same checks.
"""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import msgspec

from holdfast.runtime.malformed_json import MALFORMED_JSON, malformed_text
from holdfast.scanner.dialects.tentacle import utf8_text
from holdfast.scanner.errors import Refused
from holdfast.scanner.messages.subject_parts import tentacle_next_name

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from holdfast.scanner.messages.decoding import Normalize
    from holdfast.scanner.messages.types import UnsubscribeRequest

FUNCTION_CODES = {1: "coil", 2: "discrete", 3: "holding", 4: "input"}
"""The numbers that its PLC library sends."""

TAG_DEFAULTS = {"functionCode": "holding", "datatype": "uint16"}
"""What is meant by a key of a tag that is missing or empty."""

REGISTER_KEYS = {"tag": "id", "modbusDatatype": "datatype"}
"""The keys of `registers`, which its PLC library sends instead of `tags`."""

COMMAND_FORM = 'allowed: {"value": …} or a JSON value'


class _Command(msgspec.Struct):
    """A command. Its PLC library adds the name of the tag, which the subject has too."""

    value: msgspec.Raw


def normalized(found: dict[str, Any]) -> dict[str, Any]:
    """Returns a subscribe request with the keys of `SubscribeRequest`."""
    if "tags" not in found and type(found.get("registers")) is list:
        found["tags"] = [_register(each) for each in found.pop("registers")]
    if "tags" in found and found["tags"] is None:  # Go's JSON of an empty list.
        found["tags"] = []
    if type(found.get("tags")) is list:
        found["tags"] = [_tag(each) for each in found["tags"]]
    return found


def _register(found: Any) -> Any:
    if type(found) is not dict:
        return found
    tag = {REGISTER_KEYS.get(key, key): value for key, value in found.items()}
    code = tag.get("functionCode")
    if type(code) is int:
        tag["functionCode"] = FUNCTION_CODES.get(code, code)
    return tag


def _tag(found: Any) -> Any:
    if type(found) is not dict:
        return found
    return found | {key: default for key, default in TAG_DEFAULTS.items() if not found.get(key)}


class TentacleNext:
    """What programs of tentacle-next send and expect. `Tentacle` describes each member."""

    # Its PLC library sends to the second.
    command_subjects: tuple[str, ...] = ("command.>", "module.command.>")
    byte_orders: Mapping[tuple[str, str], str] = MappingProxyType({})
    reconnect_pauses_s: tuple[float, float] | None = None
    replaces_subscription = True
    normalize: Normalize | None = staticmethod(normalized)
    last_definition_counts = False  # Its gateway sends tags in random order.
    repeats_values = True

    def device_names(self, device: str) -> tuple[str, ...]:
        """Returns the only name."""
        return (tentacle_next_name(device),)

    def tag_name(self, tag: str) -> str:
        """Returns the last part of the subjects of a tag."""
        return tentacle_next_name(tag)

    def data_subject(self, prefix: str, device: str, tag: str) -> str:
        """Returns the subject that a tag has alone."""
        return f"{prefix}.data.{tentacle_next_name(device)}.{tentacle_next_name(tag)}"

    def second_data_subject(self, _prefix: str, _device: str, /) -> None:
        """Returns nothing: values are published once."""
        return

    def status_subjects(self, prefix: str, device: str) -> tuple[str, ...]:
        """Returns the only subject."""
        return (f"{prefix}.status.{tentacle_next_name(device)}",)

    def check_unsubscribe(self, request: UnsubscribeRequest) -> None:
        """Allows all: without tags, the whole subscription is meant."""

    def check_tag_ids(self, known: Iterable[str], new: Iterable[str]) -> None:
        """Checks that each tag of a device has a subject of its own. Raises `Refused`."""
        names = {tentacle_next_name(id): id for id in known}
        for id in new:
            if not id.isprintable():
                raise Refused(f"the tag id is {id!r}, allowed: printable characters and blanks")
            name = tentacle_next_name(id)
            other = names.setdefault(name, id)
            if other != id:
                raise Refused(
                    f"tag id {id!r} has the same name in subjects as {other!r}: {name}; "
                    "give one of them another id"
                )

    def byte_order_notes(self, *_: object) -> Iterable[str]:
        """Returns nothing: orders mean the same everywhere."""
        return ()

    def command_text(self, data: bytes) -> str:
        """Returns the value of a JSON command as text. Raises `Refused`."""
        utf8_text(data)  # So that this is what is said of other bytes.
        try:
            value = msgspec.json.decode(data)
            is_object = type(value) is dict
            raw = bytes(msgspec.json.decode(data, type=_Command).value) if is_object else data
            value = msgspec.json.decode(raw)
        except msgspec.ValidationError as error:
            raise Refused(f"{error}, {COMMAND_FORM}") from None
        except MALFORMED_JSON as error:
            raise Refused(f"not JSON: {malformed_text(error, data)}; {COMMAND_FORM}") from None
        if value is None or type(value) is dict:
            found = "null" if value is None else "an object"
            raise Refused(f"the value is {found}, allowed: numbers, booleans, texts and arrays")
        return value if type(value) is str else raw.decode()
