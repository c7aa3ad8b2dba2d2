"""Mapping: finds the valid addresses of a device and streams the progress."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Any

from holdfast.discovery import address_search
from holdfast.discovery.address_search import Survey
from holdfast.errors import ConnectionLost, ModbusError, ModbusException
from holdfast.gateway.device import Failed
from holdfast.gateway.endpoint import TARGET_FIELDS
from holdfast.gateway.fields import (
    ADDRESS_SCHEMA,
    AREA_LIST,
    MAP_READ_TIMEOUT_MS,
    max_streams,
    timeout,
)
from holdfast.net.http.fields import Field, malformed
from holdfast.net.http.requests import BadRequest
from holdfast.net.http.schemas import BOOLEAN, integer
from holdfast.protocol import LAST_ADDRESS, READ_BITS
from holdfast.types import AREAS, BIT_AREAS

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence
    from typing import TypeAlias

    from holdfast.client import Client
    from holdfast.discovery.address_search import AreaMap, Finding
    from holdfast.gateway.device import RequestedDevice
    from holdfast.gateway.endpoint import Given
    from holdfast.gateway.settings import GatewayLimits
    from holdfast.net.http.events import Stream
    from holdfast.types import Area

    Call: TypeAlias = Callable[[Client], Awaitable[Any]]

PATH = "/api/modbus/map"

PROGRESS_INTERVAL_S = 0.2
"""Between two progress events."""

MAX_SHOWN = 500
"""The most ranges in a progress event; with more, it has none. The result has all ranges."""


def fields(limits: GatewayLimits) -> tuple[Field, ...]:
    """Returns the fields of a request for a map."""
    return (
        *TARGET_FIELDS,
        AREA_LIST,
        Field("first", ADDRESS_SCHEMA, "The first address to map", 0),
        Field("last", ADDRESS_SCHEMA, "The last address to map", LAST_ADDRESS),
        Field("exact", BOOLEAN, "Read every address instead of samples", False),
        Field("maxQuantity", integer(1, READ_BITS), "Largest quantity of one read", None),
        max_streams("Refuse the map (`busy`) if the client's address has this many streams"),
        timeout(MAP_READ_TIMEOUT_MS, round(1000 * limits.timeout), "Timeout of each read in ms"),
    )


def _planned(given: Given) -> Survey:
    """Returns the survey of a request. Raises `BadRequest`."""
    if given["first"] > given["last"]:
        raise malformed(f"first is {given['first']}, greater than last, {given['last']}")
    return Survey(
        given["areas"] or AREAS,
        exact=given["exact"],
        max_quantity=given["maxQuantity"],
        span=range(given["first"], given["last"] + 1),
    )


async def map_device(given: Given, device: RequestedDevice, stream: Stream, longest: float) -> None:
    """Maps a device. A failure before the first response raises, as for a read."""
    survey = _planned(given)
    began = time.monotonic()
    await _require_reply(survey, device)
    await stream.begin()
    running = asyncio.create_task(_run(survey, device, longest))
    sent = 0  # Findings that the client has.
    try:
        while not running.done():
            found = survey.findings[sent:]
            sent += len(found)
            await stream.event("progress", _progress(survey, found))
            await asyncio.wait([running], timeout=PROGRESS_INTERVAL_S)
        failure = running.result()
    finally:
        running.cancel()
        await asyncio.wait([running])
    result = {**_result(survey, failure), "seconds": round(time.monotonic() - began, 3)}
    await stream.event("result", result)
    await stream.end()


async def _require_reply(survey: Survey, device: RequestedDevice) -> None:
    """Reads in one area after the other until the device responds.

    Raises `Failed` and `BadRequest` if it does not respond in any.
    """
    areas = survey.order
    for found in areas:
        try:
            kind = "bool" if found.area in BIT_AREAS else "uint16"
            await device.ask(_read(found.area, survey.span.start, kind))
        except ModbusException:  # An exception is a response: the device is reachable.
            pass
        except Failed as error:
            if error.reason != "timeout" or found is areas[-1]:
                raise
            continue
        return


async def _run(survey: Survey, device: RequestedDevice, longest: float) -> Failed | None:
    """Carries out a survey. Returns why it ended early, or `None`."""
    try:
        async with asyncio.timeout(longest):
            await address_search.run(survey, lambda *place: device.attempt(_read(*place)))
    except TimeoutError:
        return Failed("unfinished", f"not finished within {longest:g} s")
    except ModbusError as error:
        reason = "connection_lost" if isinstance(error, ConnectionLost) else "timeout"
        return Failed(reason, str(error))
    except BadRequest as error:
        return Failed(error.reason, error.detail)
    except Failed as error:
        return error
    return None


def _read(area: Area, address: int, kind: str) -> Call:
    """Returns a read, for `ask` or `attempt`."""
    return lambda client: client.read(area, address, kind)


def _progress(survey: Survey, findings: Sequence[Finding]) -> dict[str, Any]:
    """The progress; `findings` are those since the last event."""
    few = sum(len(found.ranges) for found in survey.areas) <= MAX_SHOWN
    return {
        "at": survey.at,
        "total": survey.total,
        "requests": survey.requests,
        "found": [
            {"area": area, "first": each.start, "last": each.stop - 1} for area, each in findings
        ],
        "areas": [
            {
                "area": found.area,
                "addresses": found.addresses,
                "notSearchedFrom": survey.not_searched_from(found),
                **({"ranges": _pairs(found.ranges)} if few else {}),
            }
            for found in _ordered(survey)
        ],
    }


def _ordered(survey: Survey) -> list[AreaMap]:
    return sorted(survey.areas, key=lambda found: AREAS.index(found.area))


def _result(survey: Survey, failure: Failed | None) -> dict[str, Any]:
    return {
        "success": failure is None,
        **({} if failure is None else {"error": failure.detail, "reason": failure.reason}),
        "requests": survey.requests,
        "exact": survey.exact,
        "first": survey.span.start,
        "last": survey.span.stop - 1,
        "areas": [_area(survey, found) for found in _ordered(survey)],
    }


def _area(survey: Survey, found: AreaMap) -> dict[str, Any]:
    return {
        "area": found.area,
        "state": found.state,
        "addresses": found.addresses,
        "ranges": _pairs(found.ranges),
        "absent": sum(map(len, found.absent)),
        "absentRanges": _pairs(found.absent),
        "notAsked": len(survey.span) - found.asked,
        "notSearchedFrom": survey.not_searched_from(found),
        "failures": {str(kind): _pairs(ranges) for kind, ranges in found.failures.items()},
        "givenUp": found.given_up,
        "largest": found.largest,
        "requests": found.requests,
    }


def _pairs(ranges: list[range]) -> list[list[int]]:
    return [[each.start, each.stop - 1] for each in ranges]
