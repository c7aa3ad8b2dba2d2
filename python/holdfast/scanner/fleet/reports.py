"""Answers `browse` and `variables` with the devices of all nodes.

All nodes know all devices. What a device has is asked of the node that polls it.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from itertools import chain, islice
from typing import TYPE_CHECKING

import msgspec

from holdfast.scanner.fleet.nodes import ENVELOPE_BYTES
from holdfast.scanner.messages.types import BrowseRequest, DeviceReport, VariablesRequest
from holdfast.scanner.reports.variables import fitting

if TYPE_CHECKING:
    from collections.abc import Iterable

    from nats.aio.msg import Msg

    from holdfast.scanner.fleet.nodes import OtherNodes
    from holdfast.scanner.messages.types import BrowseAnswer
    from holdfast.scanner.placement import LocalReports
    from holdfast.scanner.subscriptions.device import ScannedDevice
    from holdfast.scanner.subscriptions.registry import Registry

DEVICES_PER_QUESTION = 100
"""Devices that other nodes are asked for at once."""


@dataclass(eq=False)
class FleetReports:
    """Reports devices of all nodes."""

    _registry: Registry
    _own: LocalReports
    _nodes: OtherNodes

    async def browse(self, message: Msg) -> BrowseAnswer:
        """Reports devices. Raises `Refused`."""
        request = self._own.request(message, BrowseRequest)
        ids = sorted(self._registry.devices)
        if request.device_id is not None:
            ids = [id for id in ids if id == request.device_id]
        offset = request.offset or 0
        page = ids[offset : offset + DEVICES_PER_QUESTION]
        devices = [self._registry.devices[id] for id in page]
        found, ends = await self._nodes.reports("browse", devices)
        answer = self._own.browsed(msgspec.structs.replace(request, offset=None), page)
        answer.count = len(self._registry.devices)
        shown: list[DeviceReport] = []
        room = self._own.max_bytes - ENVELOPE_BYTES - len(msgspec.json.encode(answer.service))
        is_page = request.tag_offset is not None or answer.next_tag is not None
        for report in answer.devices:
            if report.device_id in found:
                with contextlib.suppress(msgspec.ValidationError):
                    polled = msgspec.convert(found[report.device_id], DeviceReport)
                    if is_page:  # Its tags are those of this node: the others send no pages.
                        polled.blocks, polled.tags = report.blocks, report.tags
                        polled.subscribers = report.subscribers
                    report = polled
            room -= len(msgspec.json.encode(report)) + 1
            if room < 0 and shown:
                break
            shown.append(report)
            if report.device_id in ends:
                break
        if answer.next is not None or len(shown) < len(answer.devices):
            answer.next = offset + len(shown)
        elif offset + len(page) < len(ids):
            answer.next = offset + len(page)
        answer.devices = shown
        return answer

    async def variables(self, message: Msg) -> bytes:
        """Returns the latest values as JSON. Raises `Refused`."""
        request = self._own.request(message, VariablesRequest)
        left, texts = request.offset or 0, list[bytes]()
        room = most = self._own.max_bytes - ENVELOPE_BYTES
        ids = sorted(self._registry.devices)
        for at in range(0, len(ids), DEVICES_PER_QUESTION):
            page = self._page(ids[at : at + DEVICES_PER_QUESTION], request.device_id)
            skipped = 0
            while skipped < len(page) and left >= len(page[skipped].tags):
                left -= len(page[skipped].tags)
                skipped += 1
            page = page[skipped:]
            found, ends = await self._nodes.reports("variables", page, left)
            for device in page:
                values: Iterable[bytes]
                if device.id in found:  # Without those that the offset skips.
                    values = map(msgspec.json.encode, found[device.id])
                else:
                    known = self._own.device_variables([device.id])
                    own = chain.from_iterable(each for _, each in known)
                    values = (fitting(each, most - 1) for each in islice(own, left, None))
                for text in values:
                    room -= len(text) + 1
                    if room < 0:
                        return b"[" + b",".join(texts) + b"]"
                    texts.append(text)
                if device.id in ends:
                    return b"[" + b",".join(texts) + b"]"
                left = 0
        return b"[" + b",".join(texts) + b"]"

    def _page(self, ids: list[str], device_id: str | None) -> list[ScannedDevice]:
        """Returns the devices with these ids that are still known, and are asked for."""
        known = self._registry.devices
        return [known[id] for id in ids if device_id in (None, id) and id in known]
