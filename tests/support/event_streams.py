"""Reads server-sent events."""

from __future__ import annotations

import http.client
import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from support import wire

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping


@dataclass
class Event:
    """An event of a stream; a comment has the name `:`."""

    name: str
    data: Any
    number: int | None = None
    """Its id."""


class EventStream:
    """A response that is a stream of events."""

    def __init__(self, connection: http.client.HTTPConnection) -> None:
        self._connection = connection
        self.reply = connection.getresponse()
        self.status = self.reply.status
        self.kind = self.reply.headers["Content-Type"]

    def __iter__(self) -> Iterator[Event]:
        """Returns all events and comments until the end of the stream."""
        name, number = "", None
        for line in self.reply:
            text = line.decode().rstrip("\n")
            if text == ":":
                yield Event(":", None)
            elif text.startswith("id: "):
                number = int(text.removeprefix("id: "))
            elif text.startswith("event: "):
                name = text.removeprefix("event: ")
            elif text.startswith("data: "):
                yield Event(name, json.loads(text.removeprefix("data: ")), number)

    def next(self, name: str) -> Any:
        """Returns the data of the next event of this name."""
        for event in self:
            if event.name == name:
                return event.data
        raise AssertionError(f"the stream ended without {name}")

    def close(self) -> None:
        self.reply.close()
        self._connection.close()


def opened(
    address: tuple[str, int], path: str, headers: Mapping[str, str] | None = None
) -> EventStream:
    """Opens a stream with GET."""
    connection = http.client.HTTPConnection(*address, timeout=wire.DEADLINE)
    connection.request("GET", path, headers=dict(headers or {}))
    return EventStream(connection)
