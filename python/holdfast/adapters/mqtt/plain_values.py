"""Messages with a plain value, such as 21.5: what they write, which are refused, what is logged."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from holdfast.events.throttle import Throttle
from holdfast.ingest import Grant, Refused
from holdfast.ingest.refusals import MAX_SHOWN
from holdfast.runtime.text import clip
from holdfast.tags.rounding import ROUNDING_OF_MESSAGES
from holdfast.tags.text import value_from
from holdfast.values import ConversionError, codec_for

if TYPE_CHECKING:
    from holdfast.config.models.root import MappedTag

MAX_VALUE_BYTES = 4096
"""The largest payload of a topic with plain values, in bytes: longer than the text of any tag."""

BAD_VALUE_LOG_INTERVAL_S = 600.0
"""Seconds before another bad value of the same topic is logged."""


class BadValue(Refused):
    """A payload that is no value of its tag.

    `where` is the place in memory, the tag, the payload as text with a limited length, and the
    cause.
    """


class PlainValue:
    """What the messages of one topic write."""

    def __init__(self, topic: str, mapped: MappedTag) -> None:
        memory, tag = mapped
        self._tag = tag
        self._where = {"memory": memory, "area": tag.area, "address": tag.address}
        self._codec = codec_for(tag.area, tag.type, tag.order, tag.encoding)
        self.grant = Grant(topic, frozenset({memory}), frozenset({tag.area}))

    def command(self, payload: memoryview) -> dict[str, Any]:
        """The command that writes a payload. Raises `BadValue`."""
        try:
            if not payload:  # Also removes a retained value, which is no reason to clear a text.
                raise ValueError("the payload is empty")
            if len(payload) > MAX_VALUE_BYTES:
                raise ValueError(f"{len(payload)} bytes, allowed: {MAX_VALUE_BYTES}")
            text = bytes(payload).decode()
            value = value_from(self._tag, text, is_measurement=True)
            values = self._codec.encode(self._tag.raw(value, default_round=ROUNDING_OF_MESSAGES))
        except UnicodeDecodeError:
            raise self._bad(payload, "the payload is not UTF-8") from None
        except (ConversionError, ValueError, TypeError, OverflowError) as error:
            raise self._bad(payload, str(error)) from None
        return {**self._where, "values": list(values)}

    def _bad(self, payload: memoryview, cause: str) -> BadValue:
        shown = clip(bytes(payload[: 4 * MAX_SHOWN]).decode(errors="replace"), MAX_SHOWN)
        scale = self._tag.scale
        assert isinstance(scale, int | float), "a map has no tag whose scale is in a register"
        step = {"step": abs(scale)} if self._tag.is_stepped else {}
        where = {**self._where, "tag": self._tag.name, "value": shown, **step, "cause": cause}
        return BadValue("invalid_value", f"{self._tag.name}: {cause}", **where)


def throttle_of_bad_values(topics: int) -> Throttle:
    """Logs the first bad value of each of so many topics in `BAD_VALUE_LOG_INTERVAL_S`."""
    return Throttle(burst=0, window=BAD_VALUE_LOG_INTERVAL_S, most=topics, of_source=topics)
