"""Watching: polls a range and streams the changes."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Any

from holdfast.errors import ModbusException
from holdfast.gateway.device import Failed, error_fields
from holdfast.gateway.endpoint import TARGET_FIELDS
from holdfast.gateway.endpoints.read import RANGE, Range
from holdfast.gateway.fields import POLL_TIMEOUT_MS, timeout
from holdfast.net.http.fields import Field
from holdfast.net.http.requests import BadRequest
from holdfast.net.http.schemas import integer

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import TypeAlias

    from holdfast.gateway.device import RequestedDevice
    from holdfast.gateway.endpoint import Given
    from holdfast.gateway.settings import GatewayLimits
    from holdfast.net.http.events import Stream

    Event: TypeAlias = tuple[str, Any]

PATH = "/api/modbus/watch"
INTERVAL_MS = 1_000
MAX_INTERVAL_MS = 3_600_000


def interval_field(limits: GatewayLimits) -> Field:
    """Returns the field for the polling interval."""
    least = round(1000 * limits.interval)
    return Field(
        "interval",
        integer(least, MAX_INTERVAL_MS),
        "Polling interval in ms",
        max(least, INTERVAL_MS),
    )


def fields(limits: GatewayLimits) -> tuple[Field, ...]:
    """Returns the fields of a request for a watch."""
    return (
        *TARGET_FIELDS,
        *RANGE,
        interval_field(limits),
        timeout(POLL_TIMEOUT_MS, round(1000 * limits.timeout), "Timeout of each poll in ms"),
    )


async def watch(given: Given, device: RequestedDevice, stream: Stream) -> None:
    """Polls until it is cancelled. A failure before the first event raises, as for a read."""
    view = _View(Range(given), device)
    interval = given["interval"] / 1000
    loop = asyncio.get_running_loop()
    due = loop.time()
    event: Event | None
    try:
        event = view.all(await view.wanted.read(device))
    except ModbusException as error:
        event = view.problem_event(error)
    await stream.begin()
    while True:
        if event is not None:
            await stream.event(*event)
        await stream.beat()
        due = max(due + interval, loop.time())
        await stream.pause(due)
        try:
            event = view.changed(await stream.during(view.wanted.read(device)))
        except (ModbusException, Failed, BadRequest) as error:
            event = view.problem_event(error)


class _View:
    """The state that the client knows, and the events that update it."""

    def __init__(self, wanted: Range, device: RequestedDevice) -> None:
        self.wanted = wanted
        self._device = device
        self._values: list[Any] | None = None
        self._problem: dict[str, Any] = {}

    def all(self, found: list[Any]) -> Event:
        """Returns an event with all values."""
        self._values, self._problem = found, {}
        return "values", {**self._now(), **self.wanted.with_values(found)}

    def changed(self, found: list[Any]) -> Event | None:
        """Returns an event with the changed values; `None` if nothing changed."""
        before = self._values
        if before is None or self._problem:
            return self.all(found)
        self._values = found
        places = [at for at, value in enumerate(found) if value != before[at]]
        if not places:
            return None
        values = [{"address": self.wanted.address + at, "value": found[at]} for at in places]
        return "change", {**self._now(), "changes": values, **self._typed(found, places)}

    def problem_event(self, error: ModbusException | Failed | BadRequest) -> Event | None:
        """Returns an event with the error; `None` if the client knows it already."""
        found = error_fields(error)
        if found == self._problem:
            return None
        self._problem = found
        return "problem", {**self._now(), **found}

    def _typed(self, found: list[Any], places: Sequence[int]) -> dict[str, Any]:
        """Returns the typed values that contain changed registers."""
        kind = self.wanted.kind
        if kind is None:
            return {}
        typed: list[dict[str, Any]] = []
        for index in sorted({at // kind.width for at in places}):
            value = kind.decode(found[index * kind.width : (index + 1) * kind.width])
            change = {"index": index, "value": value["typed"][0], "text": value["typedText"][0]}
            if "typedErrors" in value:
                change["error"] = value["typedErrors"]["0"]
            typed.append(change)
        return {"typed": typed}

    def _now(self) -> dict[str, Any]:
        return {"time": round(1000 * time.time()), "rtt": self._device.rtt}
