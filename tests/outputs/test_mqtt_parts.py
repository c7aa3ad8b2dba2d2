"""Parts of MQTT outputs: packets from the network, packets to it, confirmations, topics."""

from __future__ import annotations

import random
import socket
from typing import TYPE_CHECKING

import pytest

from holdfast.config.values.mqtt_output_topics import TopicNames
from holdfast.net.mqtt.broker_socket import BrokerSocket
from holdfast.net.mqtt.packet_splitter import PacketSplitter
from holdfast.net.mqtt.packets import parse_publish
from holdfast.net.mqtt.waiter import Waiter
from holdfast.outputs.mqtt.delivery import Delivery, Message, packed, packed_topic
from holdfast.runtime.stop import Stop
from support.config_folder import Folder

if TYPE_CHECKING:
    from pathlib import Path


LARGEST = 65_536
"""Bytes: no packet of these tests has more."""


def message(payload: bytes = b"1", *, retain: bool = False) -> Message:
    return Message(packed_topic("plant/pump/n"), payload, retain)


@pytest.mark.parametrize("five", [True, False])
@pytest.mark.parametrize("size", [0, 1, 100, 127, 128, 16_384, 60_000])
def test_what_is_sent_is_what_is_parsed(size: int, five: bool) -> None:
    sent = [message(bytes([at]) * size, retain=at == 1) for at in range(3)]
    data = packed(sent, [7, 8, 9], qos=1, five=five)
    found = list(PacketSplitter(LARGEST, LARGEST).feed(data))
    assert [first & 1 for first, _, _ in found] == [0, 1, 0]
    parsed = [parse_publish(first, body, size, five=five) for first, body, size in found]
    assert [each.identifier for each in parsed] == [7, 8, 9]
    assert [bytes(each.payload) for each in parsed] == [each.payload for each in sent]
    assert {each.topic for each in parsed} == {"plant/pump/n"}


def test_packets_are_found_in_pieces_of_any_size() -> None:
    chance = random.Random(7)
    sent = [message(bytes(chance.randrange(300))) for _ in range(50)]
    data = packed(sent, range(1, 51), qos=1, five=True)
    whole = list(PacketSplitter(LARGEST, LARGEST).feed(data))
    packets, found = PacketSplitter(LARGEST, LARGEST), []
    while data:
        size = chance.randrange(1, 40)
        found += list(packets.feed(data[:size]))
        data = data[size:]
    assert found == whole


@pytest.mark.parametrize("piece", [1, 7, 1000, 2**20])
def test_a_packet_that_is_too_large_can_be_cut(piece: int) -> None:
    packets = PacketSplitter(1000, kept_bytes=100)
    large, small = message(bytes(range(256)) * 8), message(b"next")
    data = packed([small, large, large, small], range(1, 5), qos=1, five=True)
    found = []
    for at in range(0, len(data), piece):
        found += [(bytes(body), size) for _, body, size in packets.feed(data[at : at + piece])]
        assert len(packets._left) + len(packets._body) <= 1000
    whole = [body for _, body, _ in PacketSplitter(LARGEST, LARGEST).feed(data)]
    cut = [whole[0], whole[1][:100], whole[2][:100], whole[3]]
    assert found == [(body, len(full)) for body, full in zip(cut, whole, strict=True)]


def test_packets_keep_their_order_while_the_broker_takes_little() -> None:
    mine, peer = socket.socketpair()
    with mine, peer:
        mine.setblocking(False)
        mine.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
        broker = BrokerSocket(mine)
        sent = [bytes([number]) * 3000 for number in range(100)]
        for number, packet in enumerate(sent):
            assert (broker.send if number % 2 else broker.send_to_broker)(packet) in (None, 3000)
        assert broker.unsent > 10
        got = b""
        while len(got) < 300_000:
            got += peer.recv(2**16)
            broker.flush()
        assert got == b"".join(sent)
        assert not broker.unsent


def test_a_length_of_five_bytes_is_malformed() -> None:
    with pytest.raises(ValueError, match="more than 4 bytes"):
        list(PacketSplitter(LARGEST, LARGEST).feed(b"\x30\xff\xff\xff\xff\x01"))


def test_confirmations_count_without_a_gap() -> None:
    delivery = Delivery([message() for _ in range(4)])
    for index, confirmed in ((1, 0), (3, 0), (0, 2), (2, 4)):
        delivery.confirm(index)
        assert delivery.confirmed == confirmed
    assert delivery.is_done


def test_a_closed_waiter_leaves_nothing_at_its_stop() -> None:
    """Each attempt to connect has a waiter, and an outage may have many."""
    stop = Stop()
    for _ in range(3):
        with Waiter(stop):
            pass
    assert stop._then == []


@pytest.mark.parametrize(
    ("template", "status"),
    [
        (None, "plant/holdfast/status"),
        ("site/7/{device}/{tag}", "site/7/holdfast/status"),
        ("{device}/{tag}", "holdfast/status"),
    ],
)
def test_the_status_topic_begins_as_the_others(template: str | None, status: str) -> None:
    assert TopicNames(template, None, whole_device=False).status == status


@pytest.mark.parametrize(
    ("devices", "given", "topic"),
    [
        (("holdfast", "value"), "topic: 'plant/{device}/{tag}/value'", "value"),
        (("holdfast", "set"), "payload: device, writes: true", "set"),
    ],
)
def test_the_availability_of_a_device_has_a_topic_of_its_own(
    tmp_path: Path, devices: tuple[str, ...], given: str, topic: str
) -> None:
    polled = ", ".join(
        f"{name}: {{url: 'tcp://127.0.0.1', interval: 1, tags: {{status: {{area: coils, "
        f"address: {at}}}}}}}"
        for at, name in enumerate(devices)
    )
    text = f"devices: {{{polled}}}\noutputs: {{home: {{type: mqtt, url: 'mqtt://h', {given}}}}}\n"
    [found] = Folder(tmp_path).problems(text)
    assert found.endswith(
        "outputs.home.status: found 'plant/holdfast/status', and below it "
        f"'plant/holdfast/status/{topic}', which is a topic of the device holdfast, allowed: "
        "another topic"
    )
    assert Folder(tmp_path).config(text.replace("holdfast:", "pump:"))
    # A topic that nothing is published to is free.
    assert Folder(tmp_path).config(text.replace("{status:", "{speed:").replace("true", "false"))


def test_with_an_object_for_a_device_commands_have_the_tag_in_their_topic() -> None:
    names = TopicNames("a/{device}/b", None, whole_device=True)
    assert names.of_device("pump") == "a/pump/b"
    assert names.of_commands("pump", "n") == "a/pump/b/n/set"


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        ("topic: 'a/{dev}/{tag}'", "topic: found 'a/{dev}/{tag}', allowed as placeholders: only"),
        ("topic: 'a/{device}-{tag}'", "each alone in its level"),
        ("topic: 'a/#/{device}/{tag}'", "'#' only alone in the last level"),
        ("topic: 'a/{tag}'", "allowed: {device} once, {tag} at most once"),
        ("topic: 'a/{device}'", "topic: found 'a/{device}', allowed: with {tag}"),
        ("topic: 'a/{device}/{tag}', payload: device", "payload: device, allowed: without {tag}"),
        ("status: plant/pump/n", "which is a topic of the device pump"),
        ("qos: 2", "qos: found 2, allowed: 0 or 1"),
        ("tls: {}", "tls: found with a url that begins with mqtt://"),
        ("password_file: none", "password_file: found without username"),
        ("discovery: hass", "discovery: found 'hass', allowed: homeassistant"),
    ],
)  # fmt: skip
def test_errors_are_named(tmp_path: Path, given: str, problem: str) -> None:
    text = (
        "devices: {pump: {url: 'tcp://127.0.0.1', interval: 1, "
        "tags: {n: {area: coils, address: 0}}}}\n"
        "outputs: {home: {type: mqtt, url: 'mqtt://127.0.0.1', " + given + "}}\n"
    )
    found = Folder(tmp_path).problems(text)
    assert found
    assert any(problem in each for each in found), found
