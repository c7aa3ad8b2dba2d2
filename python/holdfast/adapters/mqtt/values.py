"""Topics with plain values, such as 21.5: what their messages write."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holdfast.ingest import Grant
from holdfast.ingest.memory_access import MAX_SHOWN
from holdfast.tags.text import value_from
from holdfast.values import ConversionError, codec_for

if TYPE_CHECKING:
    from collections.abc import Mapping

    from holdfast.config import MappedTag

MAX_BYTES = 4096
"""The largest accepted payload: more than the text of any tag has."""


class BadValue(Exception):
    """A payload that is no value of its tag.

    `where` is the place in memory, the tag, the payload as text with a limited length, and the
    cause.
    """

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
            value = value_from(self._tag, text)
            values = self._codec.encode(self._tag.raw(value, default_round="nearest"))
        except UnicodeDecodeError:
            raise self._bad(payload, "the payload is not UTF-8") from None
        except (ConversionError, ValueError, TypeError, OverflowError) as error:
            raise self._bad(payload, str(error)) from None
        return {**self._where, "values": list(values)}

    def _bad(self, payload: memoryview, cause: str) -> BadValue:
        shown = bytes(payload[: 4 * MAX_SHOWN]).decode(errors="replace")
        shown = shown if len(shown) <= MAX_SHOWN else f"{shown[:MAX_SHOWN]}…"
        scale = self._tag.scale
        assert isinstance(scale, int | float), "a map has no tag whose scale is in a register"
        step = {"step": abs(scale)} if self._tag.is_stepped else {}
        where = {**self._where, "tag": self._tag.name, "value": shown, **step, "cause": cause}
        return BadValue(f"{self._tag.name}: {cause}", where)


class Values:
    """What is written by the messages of each topic with plain values."""

    def __init__(self, mapped: Mapping[str, MappedTag]) -> None:
        self._values = {topic: Value(topic, each.memory, each) for topic, each in mapped.items()}

    def __contains__(self, topic: str) -> bool:
        return topic in self._values

    def get(self, topic: str) -> Value | None:
        """What the messages of a topic write; `None` if it has no plain values."""
        return self._values.get(topic)
