"""The MQTT adapter byte by byte: when it acknowledges, and what it does with a broker gone mad."""

from __future__ import annotations

import logging
import random
import socket
import struct
import threading
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.adapters.mqtt import adapter, connection, inbox, response_topics, sessions
from holdfast.ingest import MemoryAccess
from holdfast.net.mqtt import client
from holdfast.net.mqtt.broker_socket import BrokerSocket
from holdfast.net.mqtt.dial import dial
from support import mqtt_peer as mqtt
from support import wire
from support.mqtt_peer import FakeBroker, publish
from support.mqtt_rig import Rig, command, settings, subscription, text

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from holdfast.ingest import Grant, Written
    from support.mqtt_peer import Peer
    from support.mqtt_rig import Running

VERSIONS = ["5", "3.1.1"]
ACKNOWLEDGEMENTS = {1: mqtt.PUBACK, 2: mqtt.PUBREC}


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with Rig(tmp_path) as rig:
        yield rig


@pytest.fixture(params=VERSIONS)
def fake(request: pytest.FixtureRequest) -> Iterator[FakeBroker]:
    with FakeBroker(request.param) as fake:
        yield fake


@pytest.fixture
def fake5() -> Iterator[FakeBroker]:
    with FakeBroker() as fake:
        yield fake


def run(
    rig: Rig, fake: FakeBroker, memory_access: MemoryAccess | None = None, **more: Any
) -> Running:
    return rig.run(settings(fake.url, version=fake.version, **more), memory_access)


def works(rig: Rig, peer: Peer, version: str, address: int = 0) -> None:
    """The connection takes a message and acknowledges it."""
    value = rig.registers(address, 1)[0] + 1
    peer.send(publish("plant/ingest", text(command([value], address)), 1, 99, version=version))
    assert peer.expect(mqtt.PUBACK).identifier == 99
    assert rig.registers(address, 1) == [value]


# Acknowledgements


class Gate(MemoryAccess):
    """A door whose writes wait until they are let through."""

    def __init__(self, rig: Rig) -> None:
        super().__init__("mqtt", {"plant": rig.memory})
        self.entered = threading.Event()
        self.open = threading.Event()

    def ingest(
        self,
        body: bytes | bytearray | memoryview,
        grant: Grant,
        peer: str,
        *,
        stale: str | None = None,
    ) -> Written:
        self.entered.set()
        assert self.open.wait(wire.DEADLINE)
        return super().ingest(body, grant, peer, stale=stale)


@pytest.mark.parametrize("qos", [1, 2])
def test_the_acknowledgement_comes_after_the_write(rig: Rig, fake: FakeBroker, qos: int) -> None:
    gate = Gate(rig)
    run(rig, fake, gate)
    with fake.accept() as peer:
        peer.welcome()
        try:
            message = text(command([1]))
            peer.send(publish("plant/ingest", message, qos, 7, version=fake.version))
            assert gate.entered.wait(wire.DEADLINE)
            assert peer.silent()
            assert rig.registers(0, 1) == [0]
        finally:
            gate.open.set()

        acknowledgement = peer.expect(ACKNOWLEDGEMENTS[qos])
        assert rig.registers(0, 1) == [1]
        assert acknowledgement.identifier == 7
        if qos == 2:
            peer.send(mqtt.acknowledge(mqtt.PUBREL, 7))
            assert peer.expect(mqtt.PUBCOMP).identifier == 7


@pytest.mark.parametrize("qos", [1, 2])
def test_a_refused_message_is_acknowledged_too(rig: Rig, fake: FakeBroker, qos: int) -> None:
    run(rig, fake)
    with fake.accept() as peer:
        peer.welcome()
        peer.send(publish("plant/ingest", "{", qos, 7, version=fake.version))
        assert peer.expect(ACKNOWLEDGEMENTS[qos]).identifier == 7
        assert rig.memory_access.counts()["refused"] == {"malformed": 1}


def test_a_message_of_qos_2_is_written_once_until_it_is_released(
    rig: Rig, fake: FakeBroker
) -> None:
    running = run(rig, fake)
    one, two = (
        publish("plant/ingest", text(command([value])), 2, 7, version=fake.version)
        for value in (1, 2)
    )
    with fake.accept() as peer:
        peer.welcome()
        for _ in range(2):
            peer.send(one)
            assert peer.expect(mqtt.PUBREC).identifier == 7
        assert running.status()["received"] == 1

    with fake.accept() as peer:  # the session goes on: the message is known
        peer.expect(mqtt.CONNECT)
        peer.connack(resumed=True)
        peer.send(one)
        while (got := peer.receive()).kind == mqtt.SUBSCRIBE:
            peer.suback(got.identifier, 1)
        assert got == (mqtt.PUBREC, 0, b"\0\7")
        assert running.status()["received"] == 1
        peer.send(mqtt.acknowledge(mqtt.PUBREL, 7))
        peer.expect(mqtt.PUBCOMP)

        peer.send(two)  # released: it is another message
        peer.expect(mqtt.PUBREC)
        assert rig.registers(0, 1) == [2]

    with fake.accept() as peer:  # a new session: nothing is known
        peer.welcome()
        peer.send(one)
        peer.expect(mqtt.PUBREC)
        assert rig.registers(0, 1) == [1]
        assert running.status()["received"] == 3


def test_a_message_of_qos_2_is_written_once_also_if_the_adapter_is_replaced(
    rig: Rig, fake: FakeBroker
) -> None:
    """As a reload does, if the settings of MQTT have changed."""
    message = publish("plant/ingest", text(command([1])), 2, 7, version=fake.version)
    first = run(rig, fake)
    with fake.accept() as peer:
        peer.welcome()
        peer.send(message)
        assert peer.expect(mqtt.PUBREC).identifier == 7  # and the broker does not get it
    first.stop()
    rig.memory.write("holding_registers", 0, [2])

    run(rig, fake, keep_alive=30)
    with fake.accept() as peer:
        peer.expect(mqtt.CONNECT)
        peer.connack(resumed=True)
        if fake.version == "5":  # With 3.1.1, the retained message would come again.
            peer.suback(peer.expect(mqtt.SUBSCRIBE).identifier, 1)
        peer.send(message)
        assert peer.expect(mqtt.PUBREC).identifier == 7
        assert rig.registers(0, 1) == [2]


def test_a_release_of_something_unknown_is_answered(rig: Rig, fake: FakeBroker) -> None:
    run(rig, fake)
    with fake.accept() as peer:
        peer.welcome()
        peer.send(mqtt.acknowledge(mqtt.PUBREL, 1234))
        assert peer.expect(mqtt.PUBCOMP).identifier == 1234
        works(rig, peer, fake.version)


def test_an_identifier_can_be_used_again_after_its_release(rig: Rig, fake: FakeBroker) -> None:
    """Also if the broker does not set the flags of the release."""
    run(rig, fake)
    with fake.accept() as peer:
        peer.welcome()
        for value, release in enumerate((b"\x62\x02\x00\x07", b"\x60\x02\x00\x07", b""), 1):
            message = text(command([value]))
            peer.send(publish("plant/ingest", message, 2, 7, version=fake.version))
            assert peer.expect(mqtt.PUBREC).identifier == 7
            assert rig.registers(0, 1) == [value]
            if release:
                peer.send(release)
                assert peer.expect(mqtt.PUBCOMP).identifier == 7


# What it says


def test_it_asks_for_a_session_that_is_kept(rig: Rig, fake: FakeBroker, tmp_path: Path) -> None:
    secret = tmp_path / "secret"
    secret.write_text("word\n")
    run(rig, fake, username="plant", password_file=secret, keep_alive=17)
    with fake.accept() as peer:
        body = peer.expect(mqtt.CONNECT).body

    expiry = bytes([mqtt.SESSION_EXPIRY]) + struct.pack(">I", sessions.SESSION_EXPIRY_S)
    assert body == b"".join(
        [
            mqtt.string("MQTT"),
            bytes([5 if fake.version == "5" else 4, 0b11000000, 0, 17]),
            bytes([len(expiry)]) + expiry if fake.version == "5" else b"",
            *map(mqtt.string, ("holdfast-test", "plant", "word")),
        ]
    )


def test_it_subscribes_again_on_each_connection(rig: Rig, fake: FakeBroker) -> None:
    """With retained messages at the first time; later only as far as the session is a new one."""
    run(rig, fake)
    retain_handling = []
    for resumed in (False, True, False):
        with fake.accept() as peer:
            peer.expect(mqtt.CONNECT)
            peer.connack(resumed=resumed)
            if resumed and fake.version == "3.1.1":
                works(rig, peer, fake.version)
                continue
            request = peer.expect(mqtt.SUBSCRIBE)
            retain_handling.append(request.body[-1] >> 4)
            peer.suback(request.identifier, 1)
            works(rig, peer, fake.version)

    assert retain_handling == ([0, 1, 0] if fake.version == "5" else [0, 0])


def test_a_refused_subscription_is_logged_and_shown(
    rig: Rig, fake: FakeBroker, caplog: pytest.LogCaptureFixture
) -> None:
    running = rig.run(
        settings(fake.url, subscription("forbidden/#"), subscription(), version=fake.version)
    )
    with fake.accept() as peer:
        peer.expect(mqtt.CONNECT)
        peer.connack()
        peer.suback(peer.expect(mqtt.SUBSCRIBE).identifier, 0x80)
        peer.suback(peer.expect(mqtt.SUBSCRIBE).identifier, 0)
        works(rig, peer, fake.version)

        assert running.status()["topics"] == [
            {"topic": "forbidden/#", "qos": 1, "granted": None},
            {"topic": "plant/ingest", "qos": 1, "granted": 0},
        ]
        assert running.status()["last_error"] == (
            "subscription forbidden/# refused: Unspecified error"
        )
    refused = [entry for entry in caplog.records if "subscription_refused" in entry.getMessage()]
    assert [entry.fields["topic"] for entry in refused] == ["forbidden/#"]  # type: ignore[attr-defined]


# Broken brokers

REFUSALS = {
    "5": {0x80: "Unspecified", 0x86: "Bad user name or password", 0x87: "Not authorized"},
    "3.1.1": {
        1: "",
        2: "Client identifier not valid",
        3: "Server unavailable",
        4: "Bad user name or password",
        5: "Not authorized",
        77: "",
    },
}


@pytest.mark.parametrize(
    ("version", "code", "reason"),
    [(version, *entry) for version, codes in REFUSALS.items() for entry in codes.items()],
)
def test_a_refused_connection_is_tried_again(
    rig: Rig, version: str, code: int, reason: str
) -> None:
    with FakeBroker(version) as fake:
        running = run(rig, fake)
        with fake.accept() as peer:
            peer.expect(mqtt.CONNECT)
            peer.connack(code)
            peer.wait_until_closed()
        with fake.accept() as peer:
            assert reason in running.status()["last_error"]
            assert not running.status()["connected"]
            peer.welcome()
            works(rig, peer, version)


def test_a_broker_that_knows_only_3_1_1_is_named_as_the_reason(rig: Rig, fake5: FakeBroker) -> None:
    running = run(rig, fake5)
    with fake5.accept() as peer:
        peer.expect(mqtt.CONNECT)
        peer.send(mqtt.packet(mqtt.CONNACK, b"\0\1"))
        peer.wait_until_closed()
    wire.until(lambda: running.status()["last_error"], "it failed")

    assert "Unsupported protocol version" in running.status()["last_error"]


def test_a_second_connack_ends_the_connection(
    rig: Rig, fake: FakeBroker, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "holdfast")
    running = run(rig, fake)
    with fake.accept() as peer:
        peer.welcome()
        for _ in range(3):
            peer.connack()
        peer.wait_until_closed()
    with fake.accept() as peer:
        assert running.status()["last_error"] == "the broker sent a second CONNACK"
        assert [each.message for each in caplog.records].count("mqtt_connected") == 1
        peer.welcome()
        works(rig, peer, fake.version)


GARBAGE = {
    "nothing": b"",
    "zeros": bytes(64),
    "a web server": b"HTTP/1.1 400 Bad Request\r\n\r\n",
    "a reserved kind": b"\xf0\x00",
    "kind 0": b"\x00\x00",
    "a length that does not end": b"\x30\xff\xff\xff\xff\xff\xff",
    "half a packet": b"\x30\x20\x00",
    "a CONNECT": mqtt.packet(mqtt.CONNECT, mqtt.string("MQTT") + b"\x05\x00\x00\x00\x00\x00\x00"),
    "an empty CONNACK": mqtt.packet(mqtt.CONNACK),
    "an empty SUBACK": mqtt.packet(mqtt.SUBACK),
    "a SUBACK of nothing": mqtt.packet(mqtt.SUBACK, b"\0\1\0"),
    "a SUBACK of another": mqtt.packet(mqtt.SUBACK, b"\x77\x77\0\0"),
    "an odd SUBACK": mqtt.packet(mqtt.SUBACK, b"\0\1\0\x55"),
    "an empty PUBLISH": mqtt.packet(mqtt.PUBLISH),
    "a PUBLISH cut in its topic": mqtt.packet(mqtt.PUBLISH, b"\xff\xffplant"),
    "a PUBLISH without identifier": mqtt.packet(mqtt.PUBLISH, mqtt.string("t"), 2),
    "a PUBLISH with identifier 0": publish("t", "", 1, 0),
    "a PUBLISH of QoS 3": publish("t", "", 3, 1),
    "properties that do not end": mqtt.packet(mqtt.PUBLISH, mqtt.string("t") + b"\xff\xff\xff\x7f"),
    "an empty PUBREL": mqtt.packet(mqtt.PUBREL, b"", 2),
    "a PUBACK of nothing": mqtt.acknowledge(mqtt.PUBACK, 4711),
    "a PUBREC of nothing": mqtt.acknowledge(mqtt.PUBREC, 4711),
    "an odd PUBACK": mqtt.packet(mqtt.PUBACK, b"\0\1\x01\xff\xff"),
    "an odd DISCONNECT": mqtt.packet(mqtt.DISCONNECT, b"\x01\xff\xff\xff\xff\xff"),
    "an UNSUBACK": mqtt.packet(mqtt.UNSUBACK, b"\0\1"),
    "a full PINGRESP": mqtt.packet(mqtt.PINGRESP, b"\0"),
    "an AUTH": mqtt.packet(15, b"\x18\0"),
}


@pytest.mark.parametrize("welcomed", [False, True])
def test_it_survives_garbage(rig: Rig, fake: FakeBroker, welcomed: bool) -> None:
    running = run(rig, fake)
    generator = random.Random(1)
    noise = {f"noise {number}": generator.randbytes(200) for number in range(30)}
    for name, data in (GARBAGE | noise).items():
        with fake.accept() as peer:
            if welcomed:
                peer.welcome()
            else:
                peer.expect(mqtt.CONNECT)
            peer.send(data)
            peer.finish()
            peer.wait_until_closed()
        assert running.alive, name
    with fake.accept() as peer:
        peer.welcome()
        works(rig, peer, fake.version)

    assert rig.registers(0, 2) == [1, 0]


def test_it_survives_packets_in_single_bytes(rig: Rig, fake: FakeBroker) -> None:
    run(rig, fake)
    with fake.accept() as peer:
        peer.welcome()
        message = publish("plant/ingest", text(command([1])), 1, 5, version=fake.version)
        for place in range(len(message)):
            peer.send(message[place : place + 1])
        assert peer.expect(mqtt.PUBACK).identifier == 5


def test_a_broker_that_says_nothing_is_left(
    rig: Rig, fake: FakeBroker, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(adapter, "CONNACK_TIMEOUT_S", 0.1)
    monkeypatch.setattr(adapter, "_CHECK_INTERVAL_S", 0.05)
    running = run(rig, fake)
    with fake.accept() as peer:
        peer.wait_until_closed()
    monkeypatch.setattr(adapter, "CONNACK_TIMEOUT_S", wire.DEADLINE)
    wire.until(lambda: "did not answer" in str(running.status()["last_error"]), "it gave up")
    with welcomed(fake) as peer:
        works(rig, peer, fake.version)


def welcomed(fake: FakeBroker) -> Peer:
    """The first connection that waits for the welcome. Those before began with a short patience."""
    while True:
        peer = fake.accept()
        try:
            peer.welcome()
        except (EOFError, ConnectionError):
            peer.socket.close()
        else:
            return peer


def test_a_broker_that_does_not_answer_a_ping_is_left(rig: Rig) -> None:
    with ExitStack() as opened:
        fakes = [opened.enter_context(FakeBroker(version)) for version in VERSIONS]
        running = [run(rig, fake, keep_alive=1) for fake in fakes]
        peers = [opened.enter_context(fake.accept()) for fake in fakes]
        for peer in peers:
            peer.welcome()
        for peer in peers:
            peer.expect(mqtt.PINGREQ)
            peer.wait_until_closed()
        reasons = ["Keep alive timeout"] * len(running)
        wire.until(lambda: [each.status()["last_error"] for each in running] == reasons, "reasons")


def test_a_broker_that_takes_leave_is_quoted(rig: Rig, fake5: FakeBroker) -> None:
    running = run(rig, fake5)
    with fake5.accept() as peer:
        peer.welcome()
        peer.send(mqtt.packet(mqtt.DISCONNECT, b"\x8e\0"))
        peer.wait_until_closed()

    wire.until(lambda: running.status()["last_error"], "it ended")
    assert running.status()["last_error"] == ("the broker ended the connection: Session taken over")


@pytest.mark.parametrize("sent", [b"", b"\x20", b"\x30\xff"])
def test_it_ends_at_once_while_the_broker_keeps_silent(
    rig: Rig, fake: FakeBroker, sent: bytes
) -> None:
    running = run(rig, fake)
    with fake.accept() as peer:
        peer.expect(mqtt.CONNECT)
        peer.send(sent)
        running.stop(1.0)


# Odd messages

LONG_TOPIC = "plant/" + "x" * 60_000


def test_odd_properties_are_skipped_or_refused(rig: Rig, fake5: FakeBroker) -> None:
    run(rig, fake5)
    good = [
        b"\x01\x01" + b"\x02\0\0\0\x05" + b"\x03" + mqtt.string("text/plain"),
        b"\x0b\x05\x0b\x83\x01",  # two subscription identifiers
        b"\x26" + mqtt.string("\ufeff") + mqtt.string(b"\xff"),
        b"\x26\0\0\0\0" * 50_000,
        b"\x08" + mqtt.string("answers/\ud7ff"),
    ]
    too_many = b"\x26\0\0\0\0" * 60_000
    bad = [
        too_many,
        b"\x55",
        b"\x26\0",
        b"\x08\xff\xff",
        b"\x11\0\0\0\0",
        b"\xff\xff\xff\xff\x01",
        b"\x0b",
    ]
    with fake5.accept() as peer:
        peer.welcome()
        for number, properties in enumerate([*good, *bad], 1):
            message = text(command([number], number))
            peer.send(publish("plant/ingest", message, 1, number, properties=properties))
            if properties is good[-1]:
                assert {peer.receive().kind, peer.receive().kind} == {mqtt.PUBLISH, mqtt.PUBACK}
            else:
                assert peer.expect(mqtt.PUBACK).identifier == number

    assert rig.registers(1, 12) == [1, 2, 3, 4, 5] + [0] * 7
    assert rig.memory_access.counts()["refused"] == {"malformed": len(bad)}


@pytest.mark.parametrize("topic", ["", "other", "plant", "plant/ingest/", b"\xff\xfe", LONG_TOPIC])
def test_a_topic_that_is_not_subscribed_is_refused(
    rig: Rig, fake: FakeBroker, topic: str | bytes, caplog: pytest.LogCaptureFixture
) -> None:
    run(rig, fake)
    with fake.accept() as peer:
        peer.welcome()
        peer.send(publish(topic, text(command([1])), 1, 3, version=fake.version))
        assert peer.expect(mqtt.PUBACK).identifier == 3
        works(rig, peer, fake.version)

    assert rig.memory_access.counts()["refused"] == {"not_granted": 1}
    assert all(len(str(record.__dict__)) < 2000 for record in caplog.records)


def test_a_packet_too_large_is_not_kept_while_it_comes(
    rig: Rig, fake: FakeBroker, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = []
    read = connection.BrokerConnection.read_more

    def spy(self: connection.BrokerConnection) -> None:
        read(self)
        kept.append(len(self._packets._body) + len(self._packets._left))

    monkeypatch.setattr(connection.BrokerConnection, "read_more", spy)
    run(rig, fake)
    with fake.accept() as peer:
        peer.welcome()
        size = 6 * inbox.MAX_PAYLOAD_BYTES
        peer.send(publish("plant/ingest", b"[" * size, 1, 3, version=fake.version))
        assert peer.expect(mqtt.PUBACK).identifier == 3
        works(rig, peer, fake.version)

    assert rig.memory_access.counts()["refused"] == {"too_large": 1}
    assert max(kept) < inbox.MAX_PAYLOAD_BYTES


def test_a_broker_that_sends_messages_lives_though_it_answers_no_ping(
    rig: Rig, fake: FakeBroker
) -> None:
    """Its answer may be behind many messages."""
    run(rig, fake, keep_alive=1)
    pings = 0
    with fake.accept() as peer:
        peer.welcome()
        while pings < 2:
            peer.send(publish("plant/ingest", text(command([1])), 1, 7, version=fake.version))
            while (got := peer.receive()).kind != mqtt.PUBACK:
                assert got.kind == mqtt.PINGREQ
                pings += 1


# Answers


def ask(number: int, qos: int = 0, topic: str = "answers") -> bytes:
    properties = bytes([mqtt.RESPONSE_TOPIC]) + mqtt.string(topic)
    return publish(
        "plant/ingest", text(command([number % 65536])), qos, number + 1, properties=properties
    )


@pytest.mark.parametrize("topic", ["", "#", "a/+", "a#", "a\0b", "$SYS/a", "plant/ingest"])
def test_a_response_topic_that_cannot_be_is_dropped(
    rig: Rig, fake5: FakeBroker, topic: str
) -> None:
    running = run(rig, fake5)
    with fake5.accept() as peer:
        peer.welcome()
        peer.send(ask(1, 1, topic))
        peer.expect(mqtt.PUBACK)
        works(rig, peer, "5", 9)

    assert running.status()["answers_dropped"] == 1
    assert rig.registers(0, 1) == [1]


@pytest.mark.parametrize("qos", [0, 1])
def test_a_connection_that_the_broker_ends_after_an_answer_is_logged_with_its_topic(
    rig: Rig, fake5: FakeBroker, monkeypatch: pytest.MonkeyPatch, qos: int
) -> None:
    monkeypatch.setattr(connection, "JUST_NOW_S", wire.DEADLINE)
    running = run(rig, fake5)
    with fake5.accept() as peer:
        peer.welcome()
        peer.send(ask(1, qos, "forbidden/me"))
        while peer.receive().kind != mqtt.PUBLISH:
            pass
    wire.until(lambda: running.status()["last_error"] is not None, "it ended")
    assert str(running.status()["last_error"]).endswith(", soon after a reply to 'forbidden/me'")


def test_another_reason_of_a_broker_has_nothing_of_an_answer(rig: Rig, fake5: FakeBroker) -> None:
    running = run(rig, fake5)
    with fake5.accept() as peer:
        peer.welcome()
        peer.send(ask(1, 0, "answers/me"))
        while peer.receive().kind != mqtt.PUBLISH:
            pass
        peer.send(b"\xe0\x01\x8e")
    wire.until(lambda: running.status()["last_error"] is not None, "it ended")
    assert running.status()["last_error"] == "the broker ended the connection: Session taken over"


def test_an_answer_comes_after_the_acknowledgement(rig: Rig, fake5: FakeBroker) -> None:
    run(rig, fake5)
    with fake5.accept() as peer:
        peer.welcome()
        for qos, acknowledgement in ACKNOWLEDGEMENTS.items():
            peer.send(ask(qos, qos))
            peer.expect(acknowledgement)
            assert peer.expect(mqtt.PUBLISH).flags == 1 << 1  # QoS 1


def test_the_limits_of_the_broker_are_kept(rig: Rig, fake5: FakeBroker) -> None:
    running = run(rig, fake5)
    limits = b"".join(
        [
            bytes([mqtt.RECEIVE_MAXIMUM]) + struct.pack(">H", 2),
            bytes([mqtt.MAXIMUM_PACKET_SIZE]) + struct.pack(">I", 300),
        ]
    )
    with fake5.accept() as peer:
        peer.welcome(properties=limits)
        for number in range(5):
            peer.send(ask(number, 1))
        got = [peer.receive() for _ in range(7)]
        assert [packet.kind for packet in got].count(mqtt.PUBLISH) == 2

        for packet in [packet for packet in got if packet.kind == mqtt.PUBLISH]:
            identifier = int.from_bytes(packet.body[9:11], "big")
            peer.send(mqtt.acknowledge(mqtt.PUBACK, identifier))
            peer.expect(mqtt.PUBLISH)

        peer.send(ask(7, 0, "answers/" + "x" * 200))
        wire.until(lambda: running.status()["answers_dropped"] == 1, "too large an answer")


def test_a_broker_that_takes_qos_0_only_gets_that(rig: Rig, fake5: FakeBroker) -> None:
    run(rig, fake5)
    with fake5.accept() as peer:
        peer.welcome(properties=bytes([mqtt.MAXIMUM_QOS, 0]))
        peer.send(ask(1, 1))
        peer.expect(mqtt.PUBACK)
        assert peer.expect(mqtt.PUBLISH).flags == 0


class Jammed(socket.socket):
    """A socket that takes nothing more while it is jammed."""

    jam = threading.Event()

    def send(self, *arguments: Any) -> int:
        if self.jam.is_set():
            raise BlockingIOError
        return super().send(*arguments)


@pytest.mark.parametrize("qos", [0, 1])
def test_nothing_piles_up_while_the_broker_does_not_read(
    rig: Rig, fake5: FakeBroker, monkeypatch: pytest.MonkeyPatch, qos: int
) -> None:
    read = connection.BrokerConnection.read_more
    most = {"packets": 0, "answers": 0}

    def dial_one_that_jams(*arguments: Any) -> BrokerSocket:
        dialed = dial(*arguments)
        dialed.connection = Jammed(fileno=dialed.connection.detach())
        dialed.connection.setblocking(False)
        return dialed

    def spy(self: connection.BrokerConnection) -> None:
        read(self)
        most["packets"] = max(most["packets"], self.connection.unsent)
        most["answers"] = max(most["answers"], len(self._on_the_way) + len(self._waiting))

    monkeypatch.setattr(client, "dial", dial_one_that_jams)
    monkeypatch.setattr(connection.BrokerConnection, "read_more", spy)
    monkeypatch.setattr(Jammed, "jam", threading.Event())
    running = run(rig, fake5)
    with fake5.accept() as peer:
        peer.welcome()
        running.wait_until_connected()
        Jammed.jam.set()
        messages = b"".join(ask(number, qos) for number in range(5000))
        sender = threading.Thread(target=peer.send, args=[messages])
        sender.start()  # apart, because the adapter may stop reading
        if qos:
            wire.until(lambda: most["packets"] >= connection.MAX_UNSENT_PACKETS, "it stops reading")
        else:
            wire.until(lambda: running.status()["received"] == 5000, "it goes on reading")

        assert running.status()["answers_dropped"] > 0
        assert (
            response_topics.MAX_WAITING_ANSWERS
            <= most["packets"]
            <= connection.MAX_UNSENT_PACKETS + response_topics.MAX_WAITING_ANSWERS
        )
        assert most["answers"] <= response_topics.MAX_WAITING_ANSWERS

        Jammed.jam.clear()  # the broker reads again, and things go on
        for _ in range(5000 if qos else 0):
            while peer.receive().kind != mqtt.PUBACK:
                pass
        sender.join()
        peer.send(publish("plant/ingest", text(command([7], 9)), 1, 65000))
        while (got := peer.receive()).kind != mqtt.PUBACK or got.identifier != 65000:
            pass
        assert rig.registers(9, 1) == [7]
        assert running.status()["reconnects"] == 0


def test_connections_that_are_cut_soon_have_a_likely_cause(rig: Rig, fake: FakeBroker) -> None:
    running = run(rig, fake)
    for _ in range(2):
        with fake.accept() as peer:
            peer.welcome()
        wire.until(lambda: running.status()["last_error"] == "the connection was lost", "it ended")
    with fake.accept() as peer:
        peer.welcome()
    cause = "the connection was lost; perhaps another client has client_id holdfast-test"
    wire.until(lambda: running.status()["last_error"] == cause, "the cause")
