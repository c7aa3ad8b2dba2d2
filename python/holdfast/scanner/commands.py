"""Commands: write a value, given as text, to coils or holding registers of a device."""

from __future__ import annotations

import base64
import binascii
import logging
import math
import re
from decimal import Decimal
from typing import TYPE_CHECKING, Any

import msgspec

from holdfast import logs
from holdfast.client.requests import write_typed
from holdfast.faults import fault_text
from holdfast.scanner.errors import Refused
from holdfast.scanner.health import is_unwritten
from holdfast.scanner.tags import FLOATS
from holdfast.values import ConversionError, encode
from holdfast.values.types import parsed

if TYPE_CHECKING:
    from holdfast.scanner.devices import ScannedDevice
    from holdfast.scanner.polling import Polling
    from holdfast.scanner.tags import Tag

BOOLEANS = {"true": True, "1": True, "false": False, "0": False}

_NUMBER = re.compile(r"[+-]?([0-9]{1,400}(\.[0-9]{0,400})?|\.[0-9]{1,400})([eE][+-]?[0-9]{1,3})?")


def value(text: str, tag: Tag) -> Any:
    """Parses a text to a value of a tag's type. Raises `Refused`."""
    type = parsed(tag.type)
    if type.count is not None:
        return _array(text, tag)
    if type.base == "string":
        made: Any = text
    elif type.base == "bytes":
        made = _bytes(text, tag)
    elif type.base in ("bool", "bit"):
        made = _boolean(text, tag)
    else:
        made = _number(text.strip(), tag, type.base in FLOATS)
    return _checked(made, tag)


def _checked(made: Any, tag: Tag) -> Any:
    """Returns the value if it fits the type of the tag. Raises `Refused`."""
    try:
        encode(made, tag.type, tag.order, encoding=tag.encoding)
    except ConversionError as error:
        raise Refused(str(error).replace(tag.type, tag.asked_type)) from None
    return made


def _boolean(text: str, tag: Tag) -> bool:
    found = BOOLEANS.get(text.strip().lower())
    if found is None:
        raise Refused(
            f"{_shown(text)} is not a valid {tag.asked_type}, allowed are true, false, 1 and 0"
        )
    return found


def _number(text: str, tag: Tag, is_float: bool) -> int | float:
    if _NUMBER.fullmatch(text) is None:
        raise Refused(f"{_shown(text)} is not a valid {tag.asked_type}, allowed is a JSON number")
    if is_float:
        number = float(text)
        if math.isinf(number):
            raise Refused(f"{_shown(text)} does not fit {tag.asked_type}")
        return number
    exact = Decimal(text)
    if exact.adjusted() > 20 or exact != exact.to_integral_value():
        raise Refused(f"{_shown(text)} is not a valid {tag.asked_type}")
    return int(exact)


def _bytes(text: str, tag: Tag) -> bytes:
    try:
        return base64.b64decode(text.strip(), validate=True)
    except (binascii.Error, ValueError):
        raise Refused(
            f"{_shown(text)} is not a valid {tag.asked_type}, allowed is base64"
        ) from None


def _array(text: str, tag: Tag) -> list[Any]:
    try:
        items = msgspec.json.decode(text)
    except (msgspec.DecodeError, RecursionError):
        items = None
    if not isinstance(items, list):
        raise Refused(f"{_shown(text)} is not a valid {tag.asked_type}, allowed is a JSON array")
    base = parsed(tag.type).base
    if base == "bytes":
        items = [_bytes(item, tag) if isinstance(item, str) else item for item in items]
    made: list[Any] = _checked(items, tag)
    return made


def _shown(text: str) -> str:
    return repr(text if len(text) <= 40 else f"{text[:40]}…")


async def write(polling: Polling, device: ScannedDevice, tag: Tag, text: str) -> None:
    """Writes a value, given as text. Returns when the device has confirmed it.

    Raises `Refused`.
    """
    if (flaw := device.unwritable(tag)) is not None:
        raise Refused(f"tag {tag.id!r} of {device.id} is not writable: {flaw}")
    made = value(text, tag)
    try:
        [request] = write_typed(
            tag.area, tag.address, made, tag.type, tag.order, tag.encoding, split=False
        )
    except ValueError as error:
        raise Refused(f"not written: {error}") from None
    fault = await polling.write(device, request)
    if fault:
        said = "not written" if is_unwritten(fault) else "not confirmed"
        raise Refused(f"{said}: {fault_text(fault)}")
    logs.write(logging.INFO, "tag_written", device=device.id, tag=tag.id)
