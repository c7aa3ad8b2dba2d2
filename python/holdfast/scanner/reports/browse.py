"""The answer to `browse`: devices, tags, subscribers, blocks and errors."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import msgspec

from holdfast.polling.faults import fault_text
from holdfast.scanner.errors import Refused
from holdfast.scanner.messages.types import (
    BlockReport,
    BrowseAnswer,
    DeviceReport,
    PlanReport,
    SubscriberReport,
    TagReport,
)
from holdfast.scanner.subscriptions.health import without_overlap
from holdfast.scanner.subscriptions.tag import CODE_OF_AREA
from holdfast.scanner.subscriptions.write_access import unwritable
from holdfast.tags.decoding import Places

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence, Set

    from holdfast.scanner.messages.types import BrowseRequest, ServiceReport
    from holdfast.scanner.subscriptions.device import ScannedDevice
    from holdfast.scanner.subscriptions.tag import ScannedTag

_encode = msgspec.json.Encoder().encode

ENVELOPE_BYTES = 1024
"""Bytes of an answer without devices and `service`, and of the errors that the polling node adds to
a page."""

MIN_TAG_BYTES = 100
"""The fewest bytes of a tag in an answer. It limits how many tags can fit."""

MIN_ID_BYTES = 4
"""The fewest bytes of a tag id in the list of a subscriber."""


def browsed(
    request: BrowseRequest,
    devices: Mapping[str, ScannedDevice],
    counters: Mapping[str, Mapping[str, Any]],
    service: ServiceReport,
    max_bytes: int,
) -> BrowseAnswer:
    """Returns the answer, with at most `max_bytes` bytes.

    Raises `Refused` for `tagOffset` without `deviceId`.
    """
    answer = BrowseAnswer(True, len(devices), service, [])
    max_bytes -= len(_encode(service))
    room = max_bytes - ENVELOPE_BYTES
    if request.device_id is not None:
        if request.device_id in devices:
            report = DeviceReporter(devices[request.device_id], counters)
            page, answer.next_tag = report.page(request.tag_offset or 0, room)
            answer.devices.append(page)
        return answer
    if request.tag_offset is not None:
        raise Refused("tagOffset requires deviceId")
    first = request.offset or 0
    for at, id in enumerate(sorted(devices)[first:], first):
        whole = DeviceReporter(devices[id], counters).whole(max_bytes)
        size = len(_encode(whole)) + 1
        if size > room and answer.devices:
            answer.next = at
            break
        room -= size
        answer.devices.append(whole)
    return answer


class DeviceReporter:
    """Creates the reports of one device."""

    def __init__(self, device: ScannedDevice, counters: Mapping[str, Mapping[str, Any]]) -> None:
        """`counters` has those of all devices, by their names in the poller."""
        self._device = device
        self._counters = counters.get(device.polled_as, {})
        self._tags = list(device.tags.values())
        self._places = Places(self._tags)
        self._min_tag_bytes = MIN_TAG_BYTES + MIN_ID_BYTES * len(device.subscribers)

    def whole(self, max_bytes: int) -> DeviceReport:
        """Returns the whole report; without tags, blocks and subscribers if it is too large."""
        if len(self._tags) * MIN_TAG_BYTES <= max_bytes:
            report = self._with(self._tags)
            if len(_encode(report)) < max_bytes - ENVELOPE_BYTES:
                return report
        return self._head()

    def page(self, offset: int, room: int) -> tuple[DeviceReport, int | None]:
        """Returns a report with as many tags as fit, and the offset of the next tag, if any."""
        left = self._tags[offset:]
        count = min(len(left), max(room // self._min_tag_bytes, 1))
        while True:
            report = self._with(left[:count])
            size = len(_encode(report)) + 1
            following = None if count == len(left) else offset + count
            if size <= room:
                return report, following
            if count <= 1:
                return self._head(), following
            count = min(count - 1, max(count * room // size, 1))

    def _head(self) -> DeviceReport:
        device, health = self._device, self._device.health
        source, plan = device.source, device.source.plan
        return DeviceReport(
            device_id=device.id,
            url=str(source.target),
            address=str(device.address),
            unit_id=source.unit,
            state=health.state,
            state_since=_milliseconds(health.since),
            failures=health.failures,
            error=health.error,
            last_answer=_milliseconds(health.last_answer),
            last_error=health.last_error,
            last_error_at=_milliseconds(health.last_error_at),
            scan_rate=device.rate,
            timeout=source.timeout,
            release=source.release,
            scans=health.scans,
            missed=self._counters.get("missed", 0),
            round_trip=round(self._counters.get("round_trip", 0.0) * 1000, 3),
            tag_count=len(device.tags),
            plan=PlanReport(
                max_gap=plan.max_gap,
                max_registers=plan.max_registers,
                max_bits=plan.max_bits,
                readable=list(plan.readable) or None,
                forbidden=list(plan.forbidden) or None,
            ),
        )

    def _with(self, tags: Sequence[ScannedTag]) -> DeviceReport:
        """Returns a report with these tags, their blocks and their subscribers."""
        ids = {tag.id for tag in tags}
        return msgspec.structs.replace(
            self._head(),
            blocks=list(self._blocks(ids)),
            tags=list(self._reports(tags)),
            subscribers=[
                SubscriberReport(
                    id=id,
                    scan_rate=subscriber.rate,
                    publish=subscriber.publish,
                    deadband=subscriber.deadband or None,
                    ttl=subscriber.ttl,
                    tag_ids=[id for id in subscriber.tags if id in ids],
                )
                for id, subscriber in self._device.subscribers.items()
            ],
        )

    def _blocks(self, ids: Set[str]) -> Iterator[BlockReport]:
        """Yields the blocks that contain some of these tags."""
        blocks = self._device.health.blocks
        if self._device.health.state != "online":
            planned = self._device.source.plan.blocks(self._tags)
            not_read = [(*block[:3], None, 0, 0.0) for block in without_overlap(planned, blocks)]
            blocks = [*blocks, *not_read]
        for area, address, count, _, fault, _ in blocks:
            inside = self._places.inside(area, address, count)
            if not any(tag.id in ids for tag in inside):
                continue
            used = {
                at
                for tag in inside
                for part in (tag, tag.source)
                if part is not None
                for at in range(part.address, part.end)
            }
            yield BlockReport(
                area=area,
                address=address,
                count=count,
                tags=len(inside),
                holes=count - len(used),
                error=fault_text(fault) if fault else None,
            )

    def _reports(self, tags: Sequence[ScannedTag]) -> Iterator[TagReport]:
        errors = dict(self._device.undecoded)
        for area, address, count, _, fault, _ in self._device.health.blocks:
            if fault:
                inside = self._places.inside(area, address, count)
                errors |= dict.fromkeys((tag.id for tag in inside), fault_text(fault))
        for tag in tags:
            yield TagReport(
                id=tag.id,
                address=tag.address,
                function_code=CODE_OF_AREA[tag.area],
                datatype=tag.requested_type,
                byte_order=tag.order,
                encoding=tag.encoding,
                writable=unwritable(self._device, tag) is None,
                description=self._device.description(tag.id),
                profile=tag.profile,
                unit="" if tag.profile_tag is None else tag.profile_tag.unit,
                error=errors.get(tag.id),
            )


def _milliseconds(seconds: float | None) -> int | None:
    return None if seconds is None else int(seconds * 1000)
