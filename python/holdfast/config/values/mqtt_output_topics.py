"""Which topics an MQTT output publishes to: of values, commands, replies and availability."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast.config.values.topics import DEVICE, TAG

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

BASE = "plant"

SET, REPLY = "set", "reply"
"""The levels after the topic of a tag for commands, and for replies to them."""


STATUS = "holdfast/status"
"""The end of the topic of an output, by default."""

DEFAULT_STATUS = f"{BASE}/{STATUS}"


class TopicNames:
    """The names of topics, from a template. Names of devices and tags are safe in topics."""

    def __init__(self, template: str | None, status: str | None, *, whole_device: bool) -> None:
        if template is None:
            template = f"{BASE}/{DEVICE}" if whole_device else f"{BASE}/{DEVICE}/{TAG}"
        self.template = template
        self._whole_device = whole_device
        first = template.partition("{")[0].rstrip("/")
        self.status = status or "/".join([*([first] if first else []), STATUS])
        """The topic of the output itself."""

    def of_device(self, device: str) -> str:
        """The topic of a device, for templates without tag."""
        return self.template.replace(DEVICE, device)

    def of_tag(self, device: str, tag: str) -> str:
        """The topic of a tag."""
        topic = self.of_device(device)
        return topic.replace(TAG, tag) if TAG in self.template else f"{topic}/{tag}"

    def of_commands(self, device: str, tag: str) -> str:
        """The topic that commands for a tag are sent to."""
        return f"{self.of_tag(device, tag)}/{SET}"

    def of_availability(self, device: str) -> str:
        """The topic that is online while a device answers."""
        return f"{self.status}/{device}"

    def of_values(self, device: str, tags: Iterable[str]) -> Iterator[str]:
        """The topics of the values of a device."""
        if self._whole_device:
            yield self.of_device(device)
        else:
            yield from (self.of_tag(device, tag) for tag in tags)
