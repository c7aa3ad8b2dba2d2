"""The codec of MQTT packets: their headers, acknowledgements, and PUBLISH.

The time to parse a PUBLISH packet is linear in the size of its properties.
"""

from __future__ import annotations

from typing import NamedTuple

MAX_PROPERTIES_BYTES = 2**18
"""Bytes: enough for response topic, correlation data and content type of maximum length."""

MAX_HEAD_BYTES = MAX_PROPERTIES_BYTES + 2**17
"""Bytes of a PUBLISH packet that are enough for everything before its payload."""

_RETAIN, _DUP = 0x01, 0x08
"""Flags of PUBLISH."""

_FIXED = {1: 1, 2: 4, 35: 2}
"""Properties of a fixed size, in bytes: payload format, message expiry, topic alias."""

_LENGTHS = {3: 1, 8: 1, 9: 1, 38: 2}
"""The number of length-prefixed fields of a property: content type, response topic, correlation
data, and user property, which is a pair of strings."""

_SUBSCRIPTION_IDENTIFIER = 11
_RESPONSE_TOPIC = 8
_CORRELATION_DATA = 9


def head(first: int, size: int) -> bytes:
    """What precedes the body of a packet: the first byte, and the size of the body."""
    found = [first]
    while size > 127:
        found.append(size & 0x7F | 0x80)
        size >>= 7
    return bytes((*found, size))


def acknowledgement(first: int, identifier: int) -> bytes:
    """PUBACK, PUBREC or PUBCOMP."""
    return bytes((first, 2)) + identifier.to_bytes(2)


def variable_integer(data: bytes | memoryview, at: int) -> tuple[int, int] | None:
    """A variable byte integer (MQTT 5, 1.5.5), and where it ends; `None` if it is incomplete.

    Raises `ValueError`.
    """
    value = 0
    for place, digit in enumerate(data[at : at + 4]):
        value |= (digit & 0x7F) << 7 * place
        if digit < 0x80:
            return value, at + place + 1
    if len(data) < at + 4:
        return None
    raise ValueError("a variable byte integer has more than 4 bytes")


class Publish(NamedTuple):
    """A PUBLISH packet."""

    topic: str
    qos: int
    identifier: int
    """The packet identifier; 0 with QoS 0."""
    payload: memoryview
    size: int
    """The size of the payload in bytes; `payload` is shorter if it was cut."""
    response_topic: bytes | None = None
    correlation: bytes | None = None
    problem: str | None = None
    """Why the properties are malformed; `None` if they are valid."""
    is_retained: bool = False
    is_repeated: bool = False
    """Whether the broker delivers it again (DUP), because it was not acknowledged."""
    lateness: str | None = None
    """Why it may have been on its way for long; `None` if nothing says so."""

    @property
    def staleness(self) -> str | None:
        """Why the message may be old; `None` if nothing says so."""
        if self.is_retained:
            return "retained"
        return "delivered again" if self.is_repeated else self.lateness

    @property
    def answer_topic(self) -> str | None:
        """The response topic as text; `None` without one to which a message can be published.

        Topics that begin with `$` are the broker's own (MQTT 5, 4.7.2).
        """
        try:
            topic = (self.response_topic or b"").decode()
        except UnicodeDecodeError:
            return None
        is_usable = topic and not topic.startswith("$") and not set(topic) & set("+#\0")
        return topic if is_usable else None


def parse_publish(flags: int, body: bytes | bytearray, length: int, *, five: bool) -> Publish:
    """Parses a PUBLISH packet of MQTT 5 or 3.1.1. `length` is the size of the uncut body.

    Raises `ValueError` when the packet is too malformed to be acknowledged.
    """
    view = memoryview(body)
    qos = flags >> 1 & 3
    if qos == 3:
        raise ValueError("QoS 3")
    topic, at = _text(view, 0)
    identifier = 0
    if qos:
        identifier, at = _integer(view, at, 2)
        if identifier == 0:
            raise ValueError("packet identifier 0")
    found: dict[int, bytes] = {}
    problem = None
    if five:
        size, at = _variable(view, at)
        try:
            found = _properties(view[at : at + size], size)
        except ValueError as error:
            problem = f"properties: {error}"
        at += size
        if at > length:
            raise ValueError("properties: longer than the packet")
    return Publish(
        topic.decode(errors="replace"),
        qos,
        identifier,
        view[at:],
        length - at,
        found.get(_RESPONSE_TOPIC),
        found.get(_CORRELATION_DATA),
        problem,
        bool(flags & _RETAIN),
        bool(flags & _DUP),
    )


def _properties(view: memoryview, size: int) -> dict[int, bytes]:
    """Returns the last value of each length-prefixed property."""
    if size > MAX_PROPERTIES_BYTES:
        raise ValueError(f"{size} bytes, allowed: {MAX_PROPERTIES_BYTES}")
    if len(view) < size:
        raise ValueError("cut off")
    found = {}
    at = 0
    while at < size:
        kind, at = _variable(view, at)
        if kind == _SUBSCRIPTION_IDENTIFIER:
            _, at = _variable(view, at)
        elif kind in _FIXED:
            _, at = _integer(view, at, _FIXED[kind])
        elif kind in _LENGTHS:
            for _ in range(_LENGTHS[kind]):
                found[kind], at = _text(view, at)
        else:
            raise ValueError(f"property {kind} is not allowed in PUBLISH")
    return found


def _integer(view: memoryview, at: int, size: int) -> tuple[int, int]:
    piece = view[at : at + size]
    if len(piece) < size:
        raise ValueError("cut off")
    return int.from_bytes(piece, "big"), at + size


def _text(view: memoryview, at: int) -> tuple[bytes, int]:
    size, at = _integer(view, at, 2)
    piece = view[at : at + size]
    if len(piece) < size:
        raise ValueError("cut off")
    return bytes(piece), at + size


def _variable(view: memoryview, at: int) -> tuple[int, int]:
    found = variable_integer(view, at)
    if found is None:
        raise ValueError("cut off")
    return found
