"""Watching: polls a range and streams the changes."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Any

from holdfast.errors import ModbusException
from holdfast.gateway.device import Failed, exception_text
from holdfast.gateway.endpoint import TARGET
from holdfast.gateway.fields import ADDRESS, BYTE_ORDER, DATATYPE, timeout
from holdfast.gateway.reading import FUNCTION, QUANTITY, Range
from holdfast.web.fields import Field
from holdfast.web.requests import BadRequest
from holdfast.web.schemas import integer

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import TypeAlias

    from holdfast.gateway.device import RequestedDevice
    from holdfast.gateway.endpoint import Given
    from holdfast.gateway.settings import GatewayLimits
    from holdfast.web.events import Stream

    Event: TypeAlias = tuple[str, Any]

PATH = "/api/modbus/watch"
TIMEOUT = 5_000
INTERVAL = 1_000
MAX_INTERVAL = 3_600_000


def interval_field(limits: GatewayLimits) -> Field:
    """Returns the field for the polling interval."""
    least = round(1000 * limits.interval)
    return Field(
        "interval",
        integer(least, MAX_INTERVAL),
        "Polling interval in ms",
        max(least, INTERVAL),
    )


def fields(limits: GatewayLimits) -> tuple[Field, ...]:
    """Returns the fields of a request for a watch."""
    return (
        *TARGET,
        FUNCTION,
        ADDRESS,
        QUANTITY,
        DATATYPE,
        BYTE_ORDER,
        interval_field(limits),
        timeout(TIMEOUT, round(1000 * limits.timeout), "Timeout of each poll in ms"),
    )


async def watch(given: Given, device: RequestedDevice, stream: Stream) -> None:
    """Polls until it is cancelled. A failure before the first event raises, as for a read."""
    view = _View(Range(given), device)
    interval = given["interval"] / 1000
    loop = asyncio.get_running_loop()
    due = loop.time()
    event: Event | None
    try:
        event = view.all(await view.asked.read(device))
    except ModbusException as error:
        event = view.problem(error)
    await stream.begin()
    while True:
        if event is not None:
            await stream.event(*event)
        await stream.beat()
        due = max(due + interval, loop.time())
        await stream.pause(due)
        try:
            event = view.changed(await stream.during(view.asked.read(device)))
        except (ModbusException, Failed, BadRequest) as error:
            event = view.problem(error)


class _View:
    """The state that the client knows, and the events that update it."""

    def __init__(self, asked: Range, device: RequestedDevice) -> None:
        self.asked = asked
        self._device = device
        self._values: list[Any] | None = None
        self._problem = ""

    def all(self, found: list[Any]) -> Event:
        """Returns an event with all values."""
        self._values, self._problem = found, ""
        kind = self.asked.kind
        return "values", {
            **self._now(),
            "address": self.asked.address,
            "quantity": self.asked.quantity,
            "format": self.asked.format,
            "values": found,
            **({} if kind is None else kind.decode(found)),
        }

    def changed(self, found: list[Any]) -> Event | None:
        """Returns an event with the changed values; `None` if nothing changed."""
        before = self._values
        if before is None or self._problem:
            return self.all(found)
        self._values = found
        places = [at for at, value in enumerate(found) if value != before[at]]
        if not places:
            return None
        values = [{"address": self.asked.address + at, "value": found[at]} for at in places]
        return "change", {**self._now(), "changes": values, **self._typed(found, places)}

    def problem(self, error: Exception) -> Event | None:
        """Returns an event with the error; `None` if the client knows it already."""
        told = exception_text(error) if isinstance(error, ModbusException) else _detail(error)
        if told == self._problem:
            return None
        self._problem = told
        return "problem", {**self._now(), "error": told, "reason": _reason(error)}

    def _typed(self, found: list[Any], places: Sequence[int]) -> dict[str, Any]:
        """Returns the typed values that contain changed registers."""
        kind = self.asked.kind
        if kind is None:
            return {}
        typed: list[dict[str, Any]] = []
        for index in sorted({at // kind.width for at in places}):
            told = kind.decode(found[index * kind.width : (index + 1) * kind.width])
            entry = {"index": index, "value": told["typed"][0], "text": told["typedText"][0]}
            typed.append(entry)
        return {"typed": typed}

    def _now(self) -> dict[str, Any]:
        return {"time": round(1000 * time.time()), "rtt": self._device.rtt}


def _detail(error: Exception) -> str:
    return error.detail if isinstance(error, Failed | BadRequest) else str(error)


def _reason(error: Exception) -> str:
    return error.reason if isinstance(error, Failed | BadRequest) else "exception"
