"""Publishes the values and the states of all devices."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import msgspec

from holdfast.net.nats import batch
from holdfast.scanner.messages.types import Status
from holdfast.scanner.publish.publisher import Publisher
from holdfast.scanner.subscriptions.groups import grouped

if TYPE_CHECKING:
    from collections.abc import Collection

    from holdfast.net.nats.outbox import Outbox
    from holdfast.scanner.dialects import Dialect
    from holdfast.scanner.placement import Placement
    from holdfast.scanner.subscriptions.device import ScannedDevice
    from holdfast.types import PolledBlock


class Publishers:
    """The publishers of devices, by id."""

    def __init__(self, prefix: str, dialect: Dialect, outbox: Outbox, placement: Placement) -> None:
        self._prefix = prefix
        self._dialect = dialect
        self._outbox = outbox
        self._placement = placement
        self._publishers: dict[str, Publisher] = {}
        self.scans = 0
        """Polls that were published."""

    def update(self, device: ScannedDevice, fresh: Collection[str] = ()) -> None:
        """Applies changes of a device, and publishes the next value of `fresh` tags in any case."""
        publisher = self._publishers.get(device.id)
        if publisher is None:
            publisher = self._begin(device)
        publisher.update(lambda: grouped(device), fresh)

    def restart(self, device: ScannedDevice) -> None:
        """Publishes a device that another node has published until now."""
        self._begin(device).update(lambda: grouped(device), device.tags)

    def remove(self, device: ScannedDevice) -> None:
        """Publishes a device no more."""
        del self._publishers[device.id]

    def repeat_values(self) -> None:
        """Publishes the next value of every tag, even if it is unchanged."""
        for publisher in self._publishers.values():
            publisher.repeat_all()

    def repeat(self, device: ScannedDevice) -> None:
        """Publishes the state and all values of a device again, over a new connection.

        Messages that were sent before a disconnect may be lost.
        """
        self._publishers[device.id].repeat_all(self._placement.lease(device))
        self.publish_state(device)

    def publish_values(self, device: ScannedDevice, due: float, blocks: list[PolledBlock]) -> None:
        """Publishes the results of a poll that are due."""
        id = device.id
        publisher = self._publishers[id]
        messages = publisher.messages(due, blocks)
        self._outbox.put(messages, of=id)
        if (other := publisher.second_subject) is not None:
            again = [(tag, batch.readdressed(text, other)) for tag, text in messages]
            self._outbox.put(again, of=(id, other))

    def publish_state(self, device: ScannedDevice) -> None:
        """Publishes and stores the state of a device, if this scanner polls it."""
        if not self._placement.is_own(device):
            return
        health = device.health
        status = Status(
            device_id=device.id,
            state=health.state,
            failures=health.failures,
            error=health.error,
            timestamp=int(time.time() * 1000),
        )
        # Stored as well as published: a program that starts later reads the last state.
        device.status = msgspec.json.encode(status)
        self._placement.on_state_changed(device.id)
        lease = self._placement.lease(device)
        self._put_status(device.id, device.status, lease)

    def publish_given_up(self, device_id: str, reason: str) -> None:
        """Publishes that a device is offline that is not known any more."""
        status = Status(device_id, "offline", 0, int(time.time() * 1000), reason)
        self._put_status(device_id, msgspec.json.encode(status))

    def _put_status(self, device_id: str, status: bytes, lease: int | None = None) -> None:
        for subject in self._dialect.status_subjects(self._prefix, device_id):
            text = batch.text(subject, status)
            if lease is not None:
                text = batch.leased(text, lease)
            self._outbox.put([(subject, text)], of=device_id)

    def _begin(self, device: ScannedDevice) -> Publisher:
        lease = self._placement.lease(device)
        publisher = Publisher(self._prefix, device.id, self._dialect, lease)
        self._publishers[device.id] = publisher
        device.undecoded = publisher.undecoded
        return publisher
