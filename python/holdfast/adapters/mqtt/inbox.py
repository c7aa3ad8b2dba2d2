"""Handles a message: the memory access writes it, or it is refused."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast import logs
from holdfast.adapters.mqtt.values import BadValue
from holdfast.ingest import Grant, Refused

if TYPE_CHECKING:
    from holdfast.adapters.mqtt.filters import Filters
    from holdfast.adapters.mqtt.values import Values
    from holdfast.ingest import MemoryAccess
    from holdfast.mqtt.packets import Publish

MAX_BYTES = 8 * 2**20
"""The largest accepted payload, in bytes."""

MAX_TOPIC = 200
"""Characters of a topic that are logged."""

BAD_VALUE_SILENCE = 600.0
"""Seconds before another bad value of the same topic is logged."""

_NOBODY = Grant("no subscription", (), (), writes=False)


class Inbox:
    """Handles messages one by one. An error in one does not affect the next."""

    def __init__(
        self, memory_access: MemoryAccess, filters: Filters, values: Values, broker: str
    ) -> None:
        self._memory_access = memory_access
        self._filters, self._values = filters, values
        self._broker = broker
        self._bad_values = logs.Throttle(burst=0, window=BAD_VALUE_SILENCE)
        self.received = 0

    def take(self, message: Publish) -> dict[str, object]:
        """Carries out a message. Returns the answer for its sender."""
        self.received += 1
        topic = message.topic
        shown = topic if len(topic) <= MAX_TOPIC else f"{topic[:MAX_TOPIC]}…"
        peer = f"{self._broker} {shown}"
        value = self._values.get(topic)
        grant = value.grant if value else self._filters.grant(topic) or _NOBODY
        try:
            refused = _refused_unread(message, grant)
            if refused is None and value is not None:
                command = value.command(message.payload)
                return self._memory_access.write([command], grant, peer).answer()
            if refused is None:
                return self._memory_access.ingest(message.payload, grant, peer).answer()
            self._memory_access.refuse(refused, grant.name, peer)
        except BadValue as error:
            refused = Refused("invalid_value", str(error), **error.where)
            self._memory_access.refuse(refused, grant.name, peer, throttle=self._bad_values)
        except Refused as error:
            refused = error
        except Exception:  # An error in one message must not stop the adapter.
            logs.problem("mqtt_message_failed", broker=self._broker, topic=shown)
            refused = Refused("internal_error", "the message could not be carried out")
            self._memory_access.refuse(refused, grant.name, peer)
        return refused.answer()


def _refused_unread(message: Publish, grant: Grant) -> Refused | None:
    if grant is _NOBODY:
        return Refused("not_granted", "no configured subscription matches this topic")
    if message.size > MAX_BYTES:
        return Refused("too_large", f"{message.size} bytes, allowed: {MAX_BYTES}")
    if message.problem is not None:
        return Refused("malformed", message.problem)
    return None
