"""What `browse` tells: devices, tags, subscribers, blocks, and what goes wrong."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import msgspec

from holdfast.scanner.health import described
from holdfast.scanner.messages import (
    BlockReport,
    BrowseAnswer,
    DeviceReport,
    PlanReport,
    SubscriberReport,
    TagReport,
)
from holdfast.scanner.tags import FUNCTION_CODES

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from holdfast.scanner.devices import Device
    from holdfast.scanner.messages import BrowseRequest, ServiceReport

ENVELOPE = 300
"""Bytes of an answer that are no device."""


def browsed(
    request: BrowseRequest,
    devices: Mapping[str, tuple[Device, Mapping[str, str]]],
    counters: Mapping[str, Mapping[str, Any]],
    service: ServiceReport,
    most: int,
) -> BrowseAnswer:
    """The answer, in at most so many bytes. `devices` come with their tags that have no value."""
    if request.device_id is not None:
        wanted = [request.device_id] if request.device_id in devices else []
    else:
        wanted = sorted(devices)[request.offset or 0 :]
    room = most - ENVELOPE
    reports: list[DeviceReport] = []
    for id in wanted:
        device, undecoded = devices[id]
        report = _report(device, undecoded, counters.get(device.polled_as, {}))
        size = len(msgspec.json.encode(report)) + 1
        if size > most - ENVELOPE:
            report = msgspec.structs.replace(report, blocks=None, tags=None, subscribers=None)
            size = len(msgspec.json.encode(report)) + 1
        if size > room:
            following = (request.offset or 0) + len(reports)
            return BrowseAnswer(True, len(devices), service, reports, following)
        room -= size
        reports.append(report)
    return BrowseAnswer(True, len(devices), service, reports)


def _report(
    device: Device, undecoded: Mapping[str, str], counters: Mapping[str, Any]
) -> DeviceReport:
    health, source, plan = device.health, device.source, device.source.plan
    return DeviceReport(
        device_id=device.id,
        url=str(source.target),
        address=str(device.address),
        unit_id=source.unit,
        state=health.state,
        failures=health.failures,
        error=health.error,
        last_answer=None if health.last_answer is None else int(health.last_answer * 1000),
        scan_rate=device.rate,
        timeout=source.timeout,
        release=source.release,
        scans=health.scans,
        missed=counters.get("missed", 0),
        round_trip=round(counters.get("round_trip", 0.0) * 1000, 3),
        tag_count=len(device.tags),
        plan=PlanReport(
            max_gap=plan.max_gap,
            max_registers=plan.max_registers,
            max_bits=plan.max_bits,
            readable=list(plan.readable) or None,
            forbidden=list(plan.forbidden) or None,
        ),
        blocks=list(_blocks(device)),
        tags=list(_tags(device, undecoded)),
        subscribers=[
            SubscriberReport(
                id=id,
                scan_rate=subscriber.rate,
                publish=subscriber.publish,
                deadband=subscriber.deadband or None,
                tag_ids=list(subscriber.tags),
            )
            for id, subscriber in device.subscribers.items()
        ],
    )


def _blocks(device: Device) -> Iterator[BlockReport]:
    tags = list(device.tags.values())
    if not device.health.blocks:
        for area, address, count, members, holes in device.source.plan.blocks(tags):
            yield BlockReport(
                area=area, address=address, count=count, tags=len(members), holes=holes
            )
    for area, address, count, _, fault, _ in device.health.blocks:
        inside = [
            tag
            for tag in tags
            if tag.area == area and tag.address >= address and tag.end <= address + count
        ]
        wanted = {at for tag in inside for at in range(tag.address, tag.end)}
        yield BlockReport(
            area=area,
            address=address,
            count=count,
            tags=len(inside),
            holes=count - len(wanted),
            error=described(fault) if fault else None,
        )


def _tags(device: Device, undecoded: Mapping[str, str]) -> Iterator[TagReport]:
    faults = [block for block in device.health.blocks if block[4]]
    for tag in device.tags.values():
        error = undecoded.get(tag.id)
        for area, address, count, _, fault, _ in faults:
            if tag.area == area and tag.address >= address and tag.end <= address + count:
                error = described(fault)
        descriptions = (
            subscriber.tags[tag.id].description
            for subscriber in device.subscribers.values()
            if tag.id in subscriber.tags
        )
        yield TagReport(
            id=tag.id,
            address=tag.address,
            function_code=FUNCTION_CODES[tag.area],
            datatype=tag.asked_type,
            byte_order=tag.order,
            writable=device.writable(tag.id),
            description=next(filter(None, descriptions), None),
            error=error,
        )
