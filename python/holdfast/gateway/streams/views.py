"""Views: several ranges and tag lists of one device in one stream of events."""

from __future__ import annotations

import asyncio
import contextlib
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias

from holdfast.client.tag_reading import TagReader
from holdfast.errors import ModbusError, ModbusException
from holdfast.gateway.device import Failed, error_fields, exception_text
from holdfast.gateway.endpoint import TARGET_FIELDS
from holdfast.gateway.endpoints.read import RANGE, Range
from holdfast.gateway.endpoints.request_tags import LIST, MAX_TAGS, NAME, described, tags_of
from holdfast.gateway.fields import POLL_TIMEOUT_MS, max_streams, timeout
from holdfast.gateway.streams.watch import interval_field
from holdfast.net.http.fields import Field, filled, malformed, object_with
from holdfast.net.http.requests import BadRequest, shown
from holdfast.net.http.schemas import BOOLEAN, Schema, array
from holdfast.tags.text import plain, text_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from holdfast.client.tag_reading import Reading
    from holdfast.gateway.device import RequestedDevice
    from holdfast.gateway.endpoint import Given
    from holdfast.gateway.settings import GatewayLimits
    from holdfast.net.http.events import Stream
    from holdfast.tags import Tag, TagList
    from holdfast.types import Area

PATH = "/api/modbus/watch/view"
MAX_PARTS = 32

ONLY = Field("only", array(NAME.schema, MAX_TAGS), "Only the tags with these names", None)
TAGS = (*LIST, ONLY)
PART_SCHEMA: Schema = {"oneOf": [object_with(RANGE), object_with(TAGS)]}
PARTS = Field(
    "parts",
    array(PART_SCHEMA, MAX_PARTS),
    "Ranges, and tag lists as text or by the name of a profile",
)
MAX_STREAMS = max_streams(
    "With this many streams for the client's address, or with no stream left, the stream ends "
    "after its first event, as with `once`: browsers allow six connections to a host"
)


def fields(limits: GatewayLimits) -> tuple[Field, ...]:
    """Returns the fields of a request for a view."""
    return (
        *TARGET_FIELDS,
        PARTS,
        interval_field(limits),
        Field("once", BOOLEAN, "End after the first event", False),
        Field("describe", BOOLEAN, "Whether `view` describes the tags", True),
        MAX_STREAMS,
        timeout(POLL_TIMEOUT_MS, round(1000 * limits.timeout), "Timeout of each read in ms"),
    )


@dataclass(frozen=True)
class _State:
    """What a part holds: numbers, their texts, and why some have no value, by index."""

    values: Sequence[Any]
    texts: Sequence[str]
    errors: Mapping[int, str] = field(default_factory=dict)


class _RangePart:
    def __init__(self, given: Given) -> None:
        self.tags: Sequence[Tag] = ()
        self._range = Range(given)

    def about(self) -> dict[str, Any]:
        """What the part is, for JSON."""
        return {"kind": "range", "functionCode": self._range.function, **self._range.fields}

    async def read(self, device: RequestedDevice) -> _State:
        found = await self._range.read(device)
        if self._range.kind is None:
            return _State(found, ())
        typed = self._range.kind.decode(found)
        errors = {int(at): text for at, text in typed.get("typedErrors", {}).items()}
        return _State(found, typed["typedText"], errors)


class _TagsPart:
    def __init__(self, tags: Iterable[Tag]) -> None:
        self.tags: Sequence[Tag] = list(tags)
        self._reader = TagReader(self.tags)

    def about(self) -> dict[str, Any]:
        return {"kind": "tags"}

    async def read(self, device: RequestedDevice) -> _State:
        def fetch(area: Area, address: int, kind: str) -> Any:
            return device.attempt(lambda client: client.read(area, address, kind))

        readings = await self._reader.read_with(fetch)
        silence = readings[0].error
        if isinstance(silence, ModbusError) and not any(map(_is_answer, readings)):
            raise device.failure(silence)
        return _State(
            [plain(each.tag, each.value) for each in readings],
            [text_of(each.tag, each.value) for each in readings],
            {at: _error(each) for at, each in enumerate(readings) if each.error is not None},
        )


_Part: TypeAlias = _RangePart | _TagsPart


def _is_answer(reading: Reading) -> bool:
    return not isinstance(reading.error, ModbusError) or isinstance(reading.error, ModbusException)


def _error(reading: Reading) -> str:
    error = reading.error
    return exception_text(error) if isinstance(error, ModbusException) else str(error)


async def parts_of(given: Given, profiles: Mapping[str, TagList]) -> list[_Part]:
    """Returns the parts of a view. Raises `BadRequest`."""
    parts: list[_Part] = []
    for at, part in enumerate(given["parts"]):
        if not isinstance(part, dict):
            raise malformed(f"parts[{at}] is not an object")
        is_list = "tags" in part or "profile" in part
        try:
            known = filled(part, TAGS if is_list else RANGE)
            parts.append(await _listed(known, profiles) if is_list else _RangePart(known))
        except BadRequest as error:
            raise malformed(f"parts[{at}]: {error.detail}") from None
    return parts


async def _listed(given: Given, profiles: Mapping[str, TagList]) -> _TagsPart:
    tags, only = await tags_of(given, profiles), given["only"]
    for name in only or ():
        if name not in tags:
            raise malformed(f"only: the list has no tag {shown(name)}")
    return _TagsPart(tags if only is None else [tags[name] for name in only])


@dataclass
class _Watched:
    """A part, and what the client knows of it."""

    part: _Part
    state: _State | None = None
    problem: dict[str, Any] = field(default_factory=dict)
    """The fields of the error of the last poll."""
    silent: int = 0
    """The number of the poll that it did not answer last; 0 if it did."""


class View:
    """The parts of one view."""

    def __init__(self, parts: Sequence[_Part], device: RequestedDevice) -> None:
        self._parts = [_Watched(part) for part in parts]
        self._device = device
        self._number = 0
        self._took = 0

    async def first(self, *, stream: bool, describe: bool) -> dict[str, Any]:
        """Polls, and returns the data of `view`. Raises if no part was answered."""
        await self._poll()
        parts = []
        for each in self._parts:
            about = {**each.part.about(), **each.problem}
            if describe and each.part.tags:
                about["tags"] = [described(tag) for tag in each.part.tags]
            state = each.state
            if state is not None:
                about |= {
                    "values": state.values,
                    "texts": state.texts,
                    "errors": {str(at): text for at, text in state.errors.items()},
                }
            parts.append(about)
        return {**self._now(), "stream": stream, "parts": parts}

    async def change(self) -> dict[str, Any]:
        """Polls, and returns the data of `change`."""
        before = [(each.state, each.problem) for each in self._parts]
        with contextlib.suppress(Failed, BadRequest):  # Each part has the error.
            await self._poll()
        parts = []
        for at, (each, (state, known)) in enumerate(zip(self._parts, before, strict=True)):
            changed = _changes(state, each.state)
            if each.problem != known:
                changed |= each.problem or {"error": None}
            if changed:
                parts.append({"part": at, **changed})
        return {**self._now(), "parts": parts}

    async def _poll(self) -> None:
        """Reads all parts: first those that answered before, then those silent for longest.

        A device that does not answer is not asked further in this poll. If no part was answered,
        the error is raised.
        """
        began = time.perf_counter()
        self._number += 1
        answered, ended = False, None
        for each in sorted(self._parts, key=lambda each: each.silent):
            if ended is None:
                try:
                    each.state, each.problem = await each.part.read(self._device), {}
                    answered, each.silent = True, 0
                except ModbusException as error:
                    each.problem = error_fields(error)
                    answered, each.silent = True, 0
                except (Failed, BadRequest) as error:
                    ended, each.silent = error, self._number
            if ended is not None:
                each.problem = error_fields(ended)
        self._took = round(1000 * (time.perf_counter() - began))
        if ended is not None and not answered:
            raise ended

    def _now(self) -> dict[str, Any]:
        return {"time": round(1000 * time.time()), "rtt": self._took}


def _changes(before: _State | None, now: _State | None) -> dict[str, Any]:
    """Returns what changed, as pairs of index and value."""
    if now is None or before is now:
        return {}
    known = _State((), ()) if before is None else before
    found = {
        "values": _pairs(known.values, now.values),
        "texts": _pairs(known.texts, now.texts),
        "errors": [
            [at, now.errors.get(at)]
            for at in sorted({*known.errors, *now.errors})
            if known.errors.get(at) != now.errors.get(at)
        ],
    }
    return {name: pairs for name, pairs in found.items() if pairs}


def _pairs(before: Sequence[Any], now: Sequence[Any]) -> list[list[Any]]:
    if not before:
        return [[at, value] for at, value in enumerate(now)]
    pairs = zip(before, now, strict=True)
    return [[at, value] for at, (known, value) in enumerate(pairs) if known != value]


async def follow(given: Given, view: View, stream: Stream, *, streaming: bool) -> None:
    """Polls until it is cancelled, or once. An error before the first event raises, as for a read.

    Each poll has an event, so that the client knows how old its values are.
    """
    interval = given["interval"] / 1000
    loop = asyncio.get_running_loop()
    due = loop.time()
    data = await view.first(stream=streaming, describe=given["describe"])
    await stream.begin()
    await stream.event("view", data)
    while streaming:
        due = max(due + interval, loop.time())
        await stream.pause(due)
        await stream.event("change", await stream.during(view.change()))
    await stream.end()
