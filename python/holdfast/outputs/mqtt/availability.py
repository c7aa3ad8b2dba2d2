"""What an MQTT output says of itself and of devices: online, or offline."""

from __future__ import annotations

import threading
import time
from math import inf
from typing import TYPE_CHECKING

from holdfast.outputs.mqtt.delivery import Message, packed_topic

if TYPE_CHECKING:
    from collections.abc import Set

    from holdfast.config.values.mqtt_output_topics import TopicNames
    from holdfast.outputs.device_access import Site

ONLINE, OFFLINE = b"online", b"offline"

MIN_REPEAT_INTERVAL_S = 1.0
"""Seconds between two repetitions of `online`: another program may answer each with `offline`."""


class Availability:
    """What was published of one output and its devices."""

    def __init__(self, names: TopicNames, site: Site, *, retain: bool) -> None:
        self._names, self._site, self._retain = names, site, retain
        self._answering: dict[str, bool] = {}
        """Of each device, whether it answered when that was published last."""
        self._answering_revision = -1
        """That of the site when all was published."""
        self._is_due = threading.Event()
        """Set until `ONLINE` of the output is published, for the first time or again."""
        self._repeated_at = -inf

    def of_output(self, payload: bytes) -> Message:
        """The message about the output itself; with `OFFLINE` it is also the will."""
        return Message(packed_topic(self._names.status), payload, self._retain)

    def heard(self, payload: memoryview) -> None:
        """Takes what was published of the output itself. Called by the thread of the connection.

        Another output with this topic may have published it, or a late will of this output.
        """
        if payload != ONLINE:
            self._is_due.set()

    def online(self) -> Message | None:
        """`ONLINE` of the output: at first, and if somebody else has published that it is not."""
        now = time.monotonic()
        if not self._is_due.is_set() or now < self._repeated_at + MIN_REPEAT_INTERVAL_S:
            return None
        self._is_due.clear()
        self._repeated_at = now
        return self.of_output(ONLINE)

    def begin(self) -> None:
        """Forgets what was published: a broker may have lost it."""
        self._answering, self._answering_revision = {}, -1
        self._repeated_at = -inf
        self._is_due.set()

    def forget(self, topics: Set[str]) -> None:
        """Forgets what was published to these topics: the broker refused it."""
        if self._names.status in topics:
            self._is_due.set()
        for device in [*self._answering]:
            if self._names.of_availability(device) in topics:
                del self._answering[device]
                self._answering_revision = -1

    def forget_except(self, devices: Set[str]) -> None:
        """Forgets all devices but these."""
        for device in self._answering.keys() - devices:
            del self._answering[device]

    def changed(self, *, answering: bool) -> list[Message]:
        """Messages of devices that have begun to answer, or stopped, since the last.

        Those of devices that have stopped belong before values, the others after them.
        """
        now = self._site.answering_revision
        if now == self._answering_revision:
            return []
        found = self._site.answering()
        changed = [
            device
            for device, answers in found.items()
            if answers is answering and self._answering.get(device) is not answers
        ]
        self._answering.update(dict.fromkeys(changed, answering))
        # A device that has just stopped answering is for the next call, before its values.
        if all(self._answering.get(device) is answers for device, answers in found.items()):
            self._answering_revision = now
        payload = ONLINE if answering else OFFLINE
        topics = map(self._names.of_availability, changed)
        return [Message(packed_topic(topic), payload, self._retain) for topic in topics]
