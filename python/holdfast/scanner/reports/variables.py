"""The answer to `variables`: the latest value of every tag, for callers that come late."""

from __future__ import annotations

import sys
from itertools import chain, islice
from typing import TYPE_CHECKING

import msgspec

from holdfast.scanner.messages.types import Variable

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from holdfast.scanner.jetstream.entry_subscriptions import RefusedEntry
    from holdfast.scanner.messages.types import Quality, VariablesRequest
    from holdfast.scanner.subscriptions.device import ScannedDevice
    from holdfast.scanner.subscriptions.tag import ScannedTag

_encode = msgspec.json.Encoder().encode

ENVELOPE_BYTES = 2
"""Bytes of an answer without variables."""


def variables(
    request: VariablesRequest,
    devices: Mapping[str, ScannedDevice],
    refused: Iterable[RefusedEntry],
    module: str,
    max_bytes: int,
) -> bytes:
    """Returns the answer as JSON, with as many tags as fit into `max_bytes`.

    The tags are sorted by device; `offset` of the request skips the first ones. The tags of
    `refused` follow.
    """
    offset = min(request.offset or 0, sys.maxsize)  # `islice` takes no larger number.
    requested = [devices[id] for id in sorted(devices) if request.device_id in (None, id)]
    tags = ((device, tag) for device in requested for tag in device.tags.values())
    skipped = max(offset - sum(len(device.tags) for device in requested), 0)
    found = chain(
        (variable(*each, module) for each in islice(tags, offset, None)),
        islice(_refused(request, devices, refused, module), skipped, None),
    )
    room = max_bytes - ENVELOPE_BYTES
    text, _ = joined((fitting(each, room) for each in found), room)
    return b"[" + text + b"]"


def joined(texts: Iterable[bytes], room: int) -> tuple[bytes, bool]:
    """Joins the first texts, as many as fit into so many bytes, with commas.

    Returns also whether all of them fit.
    """
    first: list[bytes] = []
    room += 1  # The first one has no comma.
    for text in texts:
        room -= len(text) + 1
        if room < 0:
            return b",".join(first), False
        first.append(text)
    return b",".join(first), True


def fitting(found: Variable, room: int) -> bytes:
    """Returns a variable as JSON; without its value, with an error, if it takes more than `room`.

    Callers ask for the next ones until there are none: each must fit into an answer.
    """
    text = _encode(found)
    if len(text) <= room:
        return text
    error = f"too large: found {len(text)} bytes, an answer takes {room}"
    less = msgspec.structs.replace(found, value=None, quality="bad", description=None, error=error)
    return _encode(less)


def _refused(
    request: VariablesRequest,
    devices: Mapping[str, ScannedDevice],
    refused: Iterable[RefusedEntry],
    module: str,
) -> Iterator[Variable]:
    """Yields the tags of refused entries, except those that others have subscribed to."""
    for entry in refused:
        if entry.device is None or request.device_id not in (None, entry.device):
            continue
        known = devices[entry.device].tags if entry.device in devices else {}
        for id in entry.tags:
            if id not in known:
                yield Variable(
                    module_id=module,
                    device_id=entry.device,
                    variable_id=id,
                    value=None,
                    datatype="number",
                    quality="bad",
                    origin="modbus",
                    error=entry.reason,
                )


def variable(device: ScannedDevice, tag: ScannedTag, module: str) -> Variable:
    """Returns the latest value of a tag."""
    latest = device.latest.value(tag)
    quality: Quality = "good"
    if latest is None:
        quality = "uncertain"
    elif device.health.state != "online" or tag.id in device.undecoded or not _read(device, tag):
        quality = "bad"
    return Variable(
        module_id=module,
        device_id=device.id,
        variable_id=tag.id,
        value=None if latest is None else latest.value,
        datatype=tag.datatype,
        quality=quality,
        origin="modbus",
        last_updated=None if latest is None else int(latest.time * 1000),
        description=device.description(tag.id),
    )


def _read(device: ScannedDevice, tag: ScannedTag) -> bool:
    """Returns whether the last scan read a tag, without a fault."""
    span = tag.span
    faults = [
        fault
        for area, address, count, _, fault, _ in device.health.blocks
        if area == tag.area and address <= span.start and span.stop <= address + count
    ]
    return bool(faults) and not any(faults)
