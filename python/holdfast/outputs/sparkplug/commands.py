"""Commands: NCMD for the node, DCMD for writable tags."""

from __future__ import annotations

import base64
import threading
from functools import partial
from typing import TYPE_CHECKING, Any

import msgspec

from holdfast.outputs.device_access import CommandOutcomes, NotWritten
from holdfast.outputs.mqtt.connection import MAX_PAYLOAD_BYTES
from holdfast.outputs.sparkplug.datatypes import value_of
from holdfast.outputs.sparkplug.definition import parsed
from holdfast.outputs.sparkplug.node import REBIRTH

if TYPE_CHECKING:
    from collections.abc import Callable

    from holdfast.net.mqtt.packets import Publish
    from holdfast.outputs.device_access import Site
    from holdfast.outputs.sparkplug.metrics import Entry

    Find = Callable[[str, str, int | None], Entry | None]
    """Finds a metric by its device, and by its alias or else its name."""


MAX_LOGGED_NAME_CHARS = 100
"""Characters of the name of an unknown metric that are logged."""


class Commands(CommandOutcomes):
    """Carries out commands. A host sees the outcome of a write as the next value of the tag."""

    def __init__(self, output: str, broker: str, site: Site, find: Find, *, writes: bool) -> None:
        super().__init__(output)
        self._broker, self._site = broker, site
        self._find, self._writes = find, writes
        self.rebirth = threading.Event()
        """Set when a host has requested a rebirth."""

    def take(self, message: Publish, device: str | None) -> None:
        """Carries out a message for a device, or for the node.

        A stale command must never be carried out: retained and late messages are ignored, and
        those that are delivered again, which can only be over the same connection.
        """
        try:
            if message.staleness is not None:
                raise ValueError(message.staleness)
            if message.problem is not None:
                raise ValueError(message.problem)
            if message.size > MAX_PAYLOAD_BYTES:
                raise ValueError(f"{message.size} bytes, allowed: {MAX_PAYLOAD_BYTES}")
            for metric in parsed(bytes(message.payload)).metrics:
                if device is None:
                    self._control(metric, message.topic)
                else:
                    self._write(metric, device, message.topic)
        except ValueError as error:
            self.ignore(message.topic, str(error))

    def _control(self, metric: Any, topic: str) -> None:
        """Carries out a command for the node."""
        if metric.name != REBIRTH:
            self.ignore(topic, f"unknown metric {metric.name[:MAX_LOGGED_NAME_CHARS]!r}")
        elif metric.boolean_value:
            self.rebirth.set()

    def _write(self, metric: Any, device: str, topic: str) -> None:
        alias = metric.alias if metric.HasField("alias") else None
        entry = self._find(device, metric.name, alias)
        name = (
            str(metric.name or metric.alias)[:MAX_LOGGED_NAME_CHARS]
            if entry is None
            else entry.name
        )
        done = partial(self.ended, device, name)
        try:
            if not self._writes:
                raise NotWritten("not_writable", "writes are not enabled")
            if entry is None:
                raise NotWritten("unknown_tag", "no such metric")
            if entry.item is not None:
                raise NotWritten("not_writable", "one item of an array")
            if metric.is_historical:
                raise NotWritten("historical", "it is a value of the past")
            try:
                text = _text(value_of(metric, entry.datatype))
            except ValueError as error:
                raise NotWritten("invalid_value", str(error)) from None
            # A metric is a number where a tag has names for its values.
            peer = f"{self._broker} {topic}"
            self._site.write(device, entry.tag.name, text, peer, done, states=False)
        except NotWritten as refused:
            done(refused)


def _text(value: Any) -> str:
    """A value as text, exactly."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, bytes):
        return base64.b64encode(value).decode()
    if isinstance(value, list):
        return msgspec.json.encode(value).decode()
    return str(value)
