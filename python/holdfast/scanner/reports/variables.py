"""The answer to `variables`: the latest value of every tag, for callers that come late."""

from __future__ import annotations

from itertools import chain, islice
from typing import TYPE_CHECKING

import msgspec

from holdfast.scanner.messages.types import Variable

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from holdfast.scanner.jetstream.entry_subscriptions import RefusedEntry
    from holdfast.scanner.messages.types import Quality, VariablesRequest
    from holdfast.scanner.subscriptions.device import ScannedDevice
    from holdfast.scanner.subscriptions.tag import Tag

_encode = msgspec.json.Encoder().encode

ENVELOPE_BYTES = 2
"""Bytes of an answer without variables."""


def variables(
    request: VariablesRequest,
    devices: Mapping[str, tuple[ScannedDevice, Mapping[str, str]]],
    refused: Iterable[RefusedEntry],
    module: str,
    max_bytes: int,
) -> bytes:
    """Returns the answer as JSON, with as many tags as fit into `max_bytes`.

    `devices` holds each device with the errors of tags that could not be decoded. The tags are
    sorted by device; `offset` of the request skips the first ones. The tags of `refused` follow.
    """
    texts: list[bytes] = []
    room = max_bytes - ENVELOPE_BYTES
    known = sum(
        len(device.tags) for id, (device, _) in devices.items() if request.device_id in (None, id)
    )
    skipped = max((request.offset or 0) - known, 0)
    for variable in chain(
        (_variable(*each, module) for each in _requested(request, devices)),
        islice(_refused(request, devices, refused, module), skipped, None),
    ):
        text = _encode(variable)
        room -= len(text) + 1
        if room < 0:
            break
        texts.append(text)
    return b"[" + b",".join(texts) + b"]"


def device_variables(
    device: ScannedDevice, undecoded: Mapping[str, str], module: str
) -> Iterator[Variable]:
    """Yields the latest value of each tag of a device."""
    for tag in list(device.tags.values()):
        yield _variable(device, undecoded, tag, module)


def _requested(
    request: VariablesRequest, devices: Mapping[str, tuple[ScannedDevice, Mapping[str, str]]]
) -> Iterator[tuple[ScannedDevice, Mapping[str, str], Tag]]:
    ids: Iterable[str] = sorted(devices)
    if request.device_id is not None:
        ids = [request.device_id] if request.device_id in devices else []
    left = request.offset or 0
    for id in ids:
        device, undecoded = devices[id]
        if left >= len(device.tags):
            left -= len(device.tags)
            continue
        for tag in list(device.tags.values())[left:]:
            yield device, undecoded, tag
        left = 0


def _refused(
    request: VariablesRequest,
    devices: Mapping[str, tuple[ScannedDevice, Mapping[str, str]]],
    refused: Iterable[RefusedEntry],
    module: str,
) -> Iterator[Variable]:
    """Yields the tags of refused entries, except those that others have subscribed to."""
    for entry in refused:
        if entry.device is None or request.device_id not in (None, entry.device):
            continue
        known = devices[entry.device][0].tags if entry.device in devices else {}
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


def _variable(
    device: ScannedDevice, undecoded: Mapping[str, str], tag: Tag, module: str
) -> Variable:
    latest = device.latest.value(tag)
    quality: Quality = "good"
    if latest is None:
        quality = "uncertain"
    elif device.health.state != "online" or tag.id in undecoded or _failed(device, tag):
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


def _failed(device: ScannedDevice, tag: Tag) -> bool:
    """Returns whether the last scan that read a tag failed."""
    span = tag.span
    return any(
        fault and area == tag.area and address <= span.start and span.stop <= address + count
        for area, address, count, _, fault, _ in device.health.blocks
    )
