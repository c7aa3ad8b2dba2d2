"""Reads messages of programs of tentacle-next, where their form differs. Does no I/O.

`request` and `command` return what the first generation would have sent, for the same checks.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import msgspec

from holdfast.scanner.errors import Refused
from holdfast.scanner.messages.types import check_size

if TYPE_CHECKING:
    from holdfast.scanner.messages.types import SubscribeRequest

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


def request(data: bytes, most: int) -> bytes:
    """Returns a subscribe request of at most `most` bytes with the keys of `SubscribeRequest`.

    A request that is not a JSON object is returned as it is. Raises `Refused` if it is too large.
    """
    check_size(data, most)
    try:
        found = msgspec.json.decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return data
    if type(found) is not dict:
        return data
    if "tags" not in found and type(found.get("registers")) is list:
        found["tags"] = [_register(each) for each in found.pop("registers")]
    if "tags" in found and found["tags"] is None:  # Go's JSON of an empty list.
        found["tags"] = []
    if type(found.get("tags")) is list:
        found["tags"] = [_tag(each) for each in found["tags"]]
    return msgspec.json.encode(found)


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


def command(data: bytes) -> str:
    """Returns the value of a command as text. Raises `Refused`."""
    try:
        value = msgspec.json.decode(data)
        raw = bytes(msgspec.json.decode(data, type=_Command).value) if type(value) is dict else data
        value = msgspec.json.decode(raw)
    except msgspec.ValidationError as error:
        raise Refused(f"{error}, {COMMAND_FORM}") from None
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise Refused(f"not JSON: {error}; {COMMAND_FORM}") from None
    if value is None or type(value) is dict:
        found = "null" if value is None else "an object"
        raise Refused(f"the value is {found}, allowed: numbers, booleans, texts and arrays")
    return value if type(value) is str else raw.decode()


def check_entry(key: str, request: SubscribeRequest) -> None:
    """Checks what only entries of the bucket must fulfil. Raises `Refused`."""
    named = f"{request.subscriber_id}.{request.device_id}"
    if key != named:
        raise Refused(f"the key is {key!r}, allowed: SUBSCRIBER.DEVICE of its value: {named!r}")
    if request.ttl is not None:
        raise Refused("ttl is given; an entry lasts until it is deleted")
