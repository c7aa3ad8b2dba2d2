"""Commands: write a value, given as text, to coils or holding registers of a device."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

from holdfast import logs
from holdfast.client.requests import write_typed
from holdfast.faults import EXPIRED, STANDBY, fault_text
from holdfast.scanner.errors import Moved, Refused
from holdfast.scanner.lateness import AGAIN
from holdfast.scanner.subscriptions.health import is_unwritten
from holdfast.tags.text import value_from
from holdfast.tags.writing import from_text
from holdfast.values import ConversionError, encode
from holdfast.values.types import parsed

if TYPE_CHECKING:
    from collections.abc import Callable

    from holdfast import tags
    from holdfast.scanner.polling import Polling
    from holdfast.scanner.subscriptions.device import ScannedDevice
    from holdfast.scanner.subscriptions.tag import Tag


def value(text: str, tag: Tag) -> Any:
    """Parses a text to a value of a tag's type. Raises `Refused`."""
    try:
        made = from_text(text, parsed(tag.type), tag.asked_type)
    except ValueError as error:
        raise Refused(str(error)) from None
    return _checked(made, tag)


def _of_profile(text: str, tag: Tag, meaning: tags.Tag) -> Any:
    """What the registers have to hold for a value of a profile's tag, given as text."""
    try:
        return _checked(meaning.raw(value_from(meaning, text)), tag)
    except ValueError as error:
        raise Refused(str(error)) from None


def _checked(made: Any, tag: Tag) -> Any:
    """Returns the value if it fits the type of the tag. Raises `Refused`."""
    try:
        encode(made, tag.type, tag.order, encoding=tag.encoding)
    except ConversionError as error:
        raise Refused(str(error).replace(tag.type, tag.asked_type)) from None
    return made


async def write(
    polling: Polling, device: ScannedDevice, tag: Tag, text: str, check: Callable[[], float]
) -> None:
    """Writes a value, given as text. Returns when the device has confirmed it.

    `check` is called at the last moment: it refuses what is too late, and returns how many seconds
    the write may wait for the device. Raises `Refused`.
    """
    if (flaw := device.unwritable(tag)) is not None:
        raise Refused(f"tag {tag.id!r} of {device.id} is not writable: {flaw}")
    made = value(text, tag) if tag.meaning is None else _of_profile(text, tag, tag.meaning)
    try:
        [request] = write_typed(
            tag.area, tag.address, made, tag.type, tag.order, tag.encoding, split=False
        )
    except ValueError as error:
        raise Refused(f"not written: {error}") from None
    fault = await polling.write(device, request, within=check())
    if fault == STANDBY:
        raise Moved(f"not written: {fault_text(fault)}")
    if fault:
        said = "not written" if is_unwritten(fault) else "not confirmed"
        again = f"; {AGAIN}" if fault == EXPIRED else ""
        raise Refused(f"{said}: {fault_text(fault)}{again}")
    logs.write(logging.INFO, "tag_written", device=device.id, tag=tag.id)
