"""Topics with plain values, such as 21.5: what their messages write."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holdfast.ingest import Grant
from holdfast.tags.text import value_from
from holdfast.values import ConversionError, codec_for

if TYPE_CHECKING:
    from collections.abc import Mapping

    from holdfast.config import MappedTag

MAX_BYTES = 4096
"""The largest accepted payload: more than the text of any tag has."""


class BadValue(Exception):
    """A payload that is no value of its tag. `where` is the place in memory."""

    def __init__(self, detail: str, where: dict[str, Any]) -> None:
        super().__init__(detail)
        self.where = where


class Value:
    """What the messages of one topic write."""

    def __init__(self, topic: str, memory: str, mapped: MappedTag) -> None:
        tag = self._tag = mapped.tag
        self._where = {"memory": memory, "area": tag.area, "address": tag.address}
        self._codec = codec_for(tag.area, tag.type, tag.order, tag.encoding)
        self.grant = Grant(topic, frozenset({memory}), frozenset({tag.area}))

    def command(self, payload: memoryview) -> dict[str, Any]:
        """The command that writes a payload. Raises `BadValue`."""
        try:
            if len(payload) > MAX_BYTES:
                raise ValueError(f"{len(payload)} bytes, allowed: {MAX_BYTES}")
            text = bytes(payload).decode()
            values = self._codec.encode(self._tag.raw(value_from(self._tag, text)))
        except UnicodeDecodeError:
            raise BadValue("the payload is not UTF-8", self._where) from None
        except (ConversionError, ValueError, TypeError, OverflowError) as error:
            raise BadValue(str(error), self._where) from None
        return {**self._where, "values": list(values)}


class Values:
    """What is written by the messages of each topic with plain values."""

    def __init__(self, mapped: Mapping[str, MappedTag]) -> None:
        self._values = {topic: Value(topic, each.memory, each) for topic, each in mapped.items()}

    def __contains__(self, topic: str) -> bool:
        return topic in self._values

    def get(self, topic: str) -> Value | None:
        """What the messages of a topic write; `None` if it has no plain values."""
        return self._values.get(topic)
