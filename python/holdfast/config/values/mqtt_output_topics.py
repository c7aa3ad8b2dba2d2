"""Which topics an MQTT output publishes to: of values, commands, replies and availability."""

from __future__ import annotations

import re
from functools import cached_property

from holdfast.config.values.topics import DEVICE, TAG

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

    def device_of(self, topic: str) -> str | None:
        """The device for whose values, commands or replies the topic can be."""
        found = (pattern.fullmatch(topic) for pattern in self._forms)
        return next((each[1] for each in found if each is not None), None)

    @cached_property
    def _forms(self) -> list[re.Pattern[str]]:
        """The forms of all topics of devices."""
        commands = self.of_commands(DEVICE, TAG)
        return [
            re.compile(
                re.escape(form)
                .replace(re.escape(DEVICE), "([^/]+)")
                .replace(re.escape(TAG), "[^/]+")
            )
            for form in (self.template, commands, f"{commands}/{REPLY}")
        ]
