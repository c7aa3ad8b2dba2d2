"""The parts of the MQTT adapter by themselves: packets, filters, pauses."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from paho.mqtt.client import topic_matches_sub

from holdfast.adapters.mqtt import Mqtt
from holdfast.adapters.mqtt.inbox import Filters
from holdfast.ingest import MemoryAccess
from holdfast.net.mqtt.packets import parse_publish
from holdfast.runtime.stop import Stop
from support import mqtt_peer as mqtt
from support.mqtt_rig import settings, subscription

# Packets

texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=20)


def body(packet: bytes) -> tuple[int, bytes]:
    """The first byte of a packet, and what follows its length."""
    at = 1
    while packet[at] & 0x80:
        at += 1
    return packet[0], packet[at + 1 :]


@given(
    topic=texts,
    payload=st.binary(max_size=300),
    qos=st.integers(0, 2),
    identifier=st.integers(1, 65535),
    response=st.none() | texts,
    correlation=st.none() | st.binary(max_size=300),
    users=st.lists(st.tuples(texts, texts), max_size=3),
)
def test_a_message_is_read_as_it_was_made(
    topic: str,
    payload: bytes,
    qos: int,
    identifier: int,
    response: str | None,
    correlation: bytes | None,
    users: list[tuple[str, str]],
) -> None:
    properties = b"".join(b"\x26" + mqtt.string(one) + mqtt.string(two) for one, two in users)
    if response is not None:
        properties += b"\x08" + mqtt.string(response)
    if correlation is not None:
        properties += b"\x09" + mqtt.string(correlation)
    flags, rest = body(mqtt.publish(topic, payload, qos, identifier, properties=properties))

    message = parse_publish(flags, rest, len(rest), five=True)

    assert (message.topic, message.qos, message.problem) == (topic, qos, None)
    assert message.identifier == (identifier if qos else 0)
    assert bytes(message.payload) == payload
    assert message.size == len(payload)
    assert message.response_topic == (None if response is None else response.encode())
    assert message.correlation == correlation

    plain = mqtt.publish(topic, payload, qos, identifier, version="3.1.1")
    flags, rest = body(plain)
    message = parse_publish(flags, rest, len(rest), five=False)
    assert (message.topic, bytes(message.payload)) == (topic, payload)


@given(flags=st.integers(0x30, 0x3F), rest=st.binary(max_size=60), five=st.booleans())
def test_any_bytes_are_a_message_or_a_value_error(flags: int, rest: bytes, five: bool) -> None:
    try:
        message = parse_publish(flags, rest, len(rest), five=five)
    except ValueError:
        return
    assert message.size == len(message.payload)


@given(st.data())
def test_a_message_cut_short_is_a_value_error_or_says_so(data: st.DataObject) -> None:
    properties = b"\x08" + mqtt.string("answers") + b"\x09" + mqtt.string("1")
    flags, rest = body(mqtt.publish("topic", "", 1, 7, properties=properties))
    cut = rest[: data.draw(st.integers(0, len(rest) - 1))]

    with pytest.raises(ValueError, match=r"cut off|longer than the packet"):
        parse_publish(flags, cut, len(cut), five=True)


# Filters

levels = st.sampled_from(["a", "b", "", "$x", "+"])
topics = st.lists(levels.filter(lambda level: level != "+"), min_size=1, max_size=4).map("/".join)
filters = st.tuples(st.lists(levels, max_size=4), st.booleans()).map(
    lambda parts: "/".join([*parts[0], *(["#"] if parts[1] or not parts[0] else [])])
)


@given(names=st.lists(filters.filter(bool), min_size=1, max_size=6), topic=topics.filter(bool))
def test_the_first_filter_that_matches_gives_the_grant(names: list[str], topic: str) -> None:
    config = settings("mqtt://broker", *map(subscription, names))
    first = next((name for name in names if topic_matches_sub(name, topic)), None)

    grant = Filters(config.subscriptions).grant(topic)

    assert (grant.name if grant else None) == first


@pytest.mark.parametrize(
    ("name", "topic", "matches"),
    [
        ("#", "a/b", True),
        ("#", "$SYS/broker", False),
        ("+/broker", "$SYS/broker", False),
        ("$SYS/#", "$SYS/broker", True),
        ("a/#", "a", True),
        ("a/+", "a/", True),
        ("a/+", "a", False),
        ("A", "a", False),
        ("$share/group/a/#", "a/b", True),
        ("$share/group/a/#", "$share/group/a/b", False),
        ("$share/group/#", "$SYS/broker", False),
        ("$share/group", "$share/group", True),
        ("a", "", False),
    ],
)
def test_filters(name: str, topic: str, matches: bool) -> None:
    config = settings("mqtt://broker", subscription(name))

    assert (Filters(config.subscriptions).grant(topic) is not None) == matches


def test_of_two_subscriptions_to_the_same_filter_the_first_gives_the_grant() -> None:
    config = settings("mqtt://broker", subscription("a", areas=["coils"]), subscription("a"))

    grant = Filters(config.subscriptions).grant("a")

    assert grant is not None
    assert grant.areas == {"coils"}
    assert grant.writes


# Pauses


class Recorded(Stop):
    """Notes the pauses instead of waiting. Is set after some of them."""

    def __init__(self, count: int) -> None:
        super().__init__()
        self.pauses: list[float] = []
        self._count = count

    def wait(self, seconds: float | None = None) -> bool:
        assert seconds is not None
        self.pauses.append(seconds)
        return len(self.pauses) == self._count


def test_pauses_double_up_to_ten_seconds_and_begin_anew_after_a_connection_that_held(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    expected = [1, 2, 4, 8, 10, 10] * 2
    held = iter([10.0, *[9.9] * 5] * 2)
    monkeypatch.setattr(Mqtt, "_connection", lambda *_: next(held))
    stop = Recorded(len(expected))

    Mqtt(settings("mqtt://127.0.0.1:1883"), MemoryAccess("mqtt", {})).run(stop)

    for pause, longest in zip(stop.pauses, expected, strict=True):
        assert 0.75 * longest <= pause <= longest
    assert len(set(stop.pauses)) == len(expected), "with jitter"
