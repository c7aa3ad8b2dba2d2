"""Commands: a value as text, into a coil or holding registers of a device."""

from __future__ import annotations

import asyncio
import base64
import binascii
import logging
import math
import re
from decimal import Decimal
from typing import TYPE_CHECKING, Any

import msgspec

from holdfast import logs
from holdfast.client import Client
from holdfast.errors import ModbusError
from holdfast.scanner.errors import Refused
from holdfast.scanner.tags import FLOATS, WRITABLE
from holdfast.target import SerialTarget
from holdfast.values import ConversionError, encode
from holdfast.values.types import parsed

if TYPE_CHECKING:
    from holdfast.scanner.devices import Device
    from holdfast.scanner.tags import Tag

IDLE = 10.0
"""Seconds after which the connection of the last command is closed: devices have few."""

BOOLEANS = {"true": True, "1": True, "false": False, "0": False}

_NUMBER = re.compile(r"-?[0-9]{1,400}(\.[0-9]{1,400})?([eE][+-]?[0-9]{1,3})?")


def value(text: str, tag: Tag) -> Any:
    """The value that a text is for a tag. Raises `Refused`."""
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
    """A value that the type of the tag can hold."""
    try:
        encode(made, tag.type, tag.order)
    except ConversionError as error:
        raise Refused(str(error)) from None
    return made


def _boolean(text: str, tag: Tag) -> bool:
    found = BOOLEANS.get(text.strip().lower())
    if found is None:
        raise Refused(f"{_shown(text)} is no {tag.type}, allowed are true, false, 1 and 0")
    return found


def _number(text: str, tag: Tag, is_float: bool) -> int | float:
    if _NUMBER.fullmatch(text) is None:
        raise Refused(f"{_shown(text)} is no {tag.type}, allowed is a number as JSON has it")
    if is_float:
        number = float(text)
        if math.isinf(number):
            raise Refused(f"{_shown(text)} does not fit {tag.type}")
        return number
    exact = Decimal(text)
    if exact.adjusted() > 20 or exact != exact.to_integral_value():
        raise Refused(f"{_shown(text)} is no {tag.type}")
    return int(exact)


def _bytes(text: str, tag: Tag) -> bytes:
    try:
        return base64.b64decode(text.strip(), validate=True)
    except (binascii.Error, ValueError):
        raise Refused(f"{_shown(text)} is no {tag.type}, allowed is base64") from None


def _array(text: str, tag: Tag) -> list[Any]:
    try:
        items = msgspec.json.decode(text)
    except (msgspec.DecodeError, RecursionError):
        items = None
    if not isinstance(items, list):
        raise Refused(f"{_shown(text)} is no {tag.type}, allowed is a JSON array")
    base = parsed(tag.type).base
    if base == "bytes":
        items = [_bytes(item, tag) if isinstance(item, str) else item for item in items]
    made: list[Any] = _checked(items, tag)
    return made


def _shown(text: str) -> str:
    return repr(text if len(text) <= 40 else f"{text[:40]}…")


class Writer:
    """Writes to one device, one value after the other."""

    def __init__(self, device: Device) -> None:
        source = device.source
        if isinstance(device.address, SerialTarget):
            raise Refused(f"{device.id} is on a serial line, which can't be written while scanned")
        self.address = device.address
        self._release = source.release
        self._client = Client(
            str(device.address), unit=source.unit, timeout=source.timeout / 1000, max_in_flight=1
        )
        self._idle: asyncio.TimerHandle | None = None
        self._under_way = 0

    async def write(self, tag: Tag, made: Any) -> None:
        """Returns when the device has confirmed the value. Raises `Refused`."""
        self._rest()
        self._under_way += 1
        try:
            await self._client.write(tag.area, tag.address, made, tag.type, tag.order)
        except (ModbusError, ValueError) as error:
            raise Refused(f"not written: {error}") from None
        finally:
            self._under_way -= 1
            if self._under_way == 0:
                await self._done()

    async def close(self) -> None:
        """Ends the connection; commands that wait fail."""
        self._rest()
        await self._client.close()

    async def _done(self) -> None:
        if self._release:
            await self._client.close()
        else:
            loop = asyncio.get_running_loop()
            self._idle = loop.call_later(IDLE, self._close_idle)

    def _close_idle(self) -> None:
        self._idle = None
        self._closing = asyncio.ensure_future(self._client.close())

    def _rest(self) -> None:
        if self._idle is not None:
            self._idle.cancel()
            self._idle = None


class Writers:
    """The writers of all devices that had commands."""

    def __init__(self) -> None:
        self._writers: dict[str, Writer] = {}

    async def write(self, device: Device, tag: Tag, text: str) -> None:
        """Writes a value that is given as text. Raises `Refused`."""
        if not device.writable(tag.id) or tag.area not in WRITABLE:
            raise Refused(f"tag {tag.id!r} of {device.id} is not writable")
        made = value(text, tag)
        writer = self._writers.get(device.id)
        if writer is None or writer.address != device.address:
            await self.drop(device.id)
            writer = self._writers[device.id] = Writer(device)
        await writer.write(tag, made)
        logs.write(logging.INFO, "tag_written", device=device.id, tag=tag.id)

    async def drop(self, device: str) -> None:
        """Ends the connection of a device that is not wanted any more."""
        writer = self._writers.pop(device, None)
        if writer is not None:
            await writer.close()

    async def close(self) -> None:
        """Ends all connections."""
        await asyncio.gather(*(self.drop(device) for device in list(self._writers)))
