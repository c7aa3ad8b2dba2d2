"""Commands: NCMD for the node, DCMD for writable tags."""

from __future__ import annotations

import base64
import logging
import threading
from functools import partial
from typing import TYPE_CHECKING, Any

import msgspec

from holdfast import logs
from holdfast.outputs.site import NotWritten
from holdfast.outputs.sparkplug.datatypes import value_of
from holdfast.outputs.sparkplug.definition import parsed
from holdfast.outputs.sparkplug.node import REBIRTH

if TYPE_CHECKING:
    from collections.abc import Callable

    from holdfast.mqtt.packets import Publish
    from holdfast.outputs.site import Site
    from holdfast.outputs.sparkplug.metrics import Entry

    Find = Callable[[str, str, int | None], Entry | None]
    """Finds a metric by its device, and by its alias or else its name."""


MAX_NAME = 100
"""Characters of the name of an unknown metric that are logged."""


class Commands:
    """Carries out commands. A host sees the outcome of a write as the next value of the tag."""

    def __init__(self, output: str, broker: str, site: Site, find: Find, *, writes: bool) -> None:
        self._output, self._broker, self._site = output, broker, site
        self._find, self._writes = find, writes
        self._lock = threading.Lock()
        self.rebirth = threading.Event()
        """Set when a host has requested a rebirth."""
        self.written = self.refused = self.ignored = 0

    def take(self, message: Publish, device: str | None, *, is_retained: bool) -> None:
        """Carries out a message for a device, or for the node.

        A stale command must never be carried out, so retained messages are ignored.
        """
        try:
            if is_retained:
                raise ValueError("retained")
            if message.problem is not None:
                raise ValueError(message.problem)
            for metric in parsed(bytes(message.payload)).metrics:
                if device is None:
                    self._control(metric, message.topic)
                else:
                    self._write(metric, device, message.topic)
        except ValueError as error:
            self._ignore(message.topic, str(error))

    def _control(self, metric: Any, topic: str) -> None:
        """Carries out a command for the node."""
        if metric.name != REBIRTH:
            self._ignore(topic, f"unknown metric {metric.name[:MAX_NAME]!r}")
        elif metric.boolean_value:
            self.rebirth.set()

    def _write(self, metric: Any, device: str, topic: str) -> None:
        alias = metric.alias if metric.HasField("alias") else None
        entry = self._find(device, metric.name, alias)
        name = str(metric.name or metric.alias)[:MAX_NAME] if entry is None else entry.name
        done = partial(self._done, device, name)
        try:
            if not self._writes:
                raise NotWritten("not_writable", "writes are not enabled")
            if entry is None:
                raise NotWritten("unknown_tag", "no such metric")
            if entry.item is not None:
                raise NotWritten("not_writable", "one item of an array")
            try:
                text = _text(value_of(metric, entry.datatype))
            except ValueError as error:
                raise NotWritten("invalid_value", str(error)) from None
            self._site.write(device, entry.tag.name, text, f"{self._broker} {topic}", done)
        except NotWritten as refused:
            done(refused)

    def _done(self, device: str, tag: str, refused: NotWritten | None) -> None:
        """Logs and counts an outcome. Called by any thread."""
        fields = {"output": self._output, "device": device, "tag": tag}
        with self._lock:
            self.written += refused is None
            self.refused += refused is not None
        if refused is None:
            logs.write(logging.INFO, "output_command_written", **fields)
        else:
            logs.refused(
                "output_command_refused", kind=self._output, **fields, reason=refused.reason
            )

    def _ignore(self, topic: str, reason: str) -> None:
        with self._lock:
            self.ignored += 1
        logs.refused(
            "output_command_ignored",
            kind=self._output,
            output=self._output,
            topic=topic,
            reason=reason,
        )


def _text(value: Any) -> str:
    """A value as text, exactly."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, bytes):
        return base64.b64encode(value).decode()
    if isinstance(value, list):
        return msgspec.json.encode(value).decode()
    return str(value)
