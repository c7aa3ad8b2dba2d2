"""A broker that goes away in the middle of a step: what it has not confirmed is sent again."""

from __future__ import annotations

import contextlib
import socket
import threading
from concurrent.futures import ThreadPoolExecutor
from math import inf
from typing import TYPE_CHECKING, Any

import msgspec
import pytest

from holdfast.config.models.outputs import MqttOutputConfig
from holdfast.net.mqtt.packet_splitter import PacketSplitter
from holdfast.net.mqtt.packets import parse_publish
from holdfast.outputs import sender
from holdfast.outputs.mqtt import MqttOutput, session
from holdfast.runtime.stop import Stop
from support import wire
from support.mqtt_peer import CONNECT, DISCONNECT, PUBACK, PUBLISH, FakeBroker, Peer, acknowledge
from support.readings import TIME, numbered, reading, tag

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from holdfast.polling import Reading
    from holdfast.tags import Tag


LARGEST = 65_536
"""Bytes: no packet of these tests has more."""


class Broker:
    """Confirms a number of values in each connection, then closes it."""

    def __init__(self, *confirms: int) -> None:
        self._confirms = confirms
        self.seen: list[list[Any]] = []
        self.availability: list[bytes] = []
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port = self._server.getsockname()[1]
        self.thread = threading.Thread(target=self._run)
        self.thread.start()

    def _run(self) -> None:
        with self._server:
            for most in self._confirms:
                connection, _ = self._server.accept()
                with connection:
                    self._serve(connection, most)
                    connection.shutdown(socket.SHUT_WR)
                    # What is left unread would reset the connection, and confirmations be lost.
                    while connection.recv(65536):
                        pass

    def _serve(self, connection: socket.socket, most: int) -> None:
        packets, confirmed = PacketSplitter(LARGEST, LARGEST), 0
        seen: list[Any] = []
        self.seen.append(seen)
        while data := connection.recv(65536):
            for first, body, size in packets.feed(data):
                if first >> 4 == 1:
                    connection.sendall(b"\x20\x03\x00\x00\x00")
                if first >> 4 != 3:
                    continue
                message = parse_publish(first, body, size, five=True)
                is_value = message.topic.endswith("/t")
                if is_value and confirmed == most:
                    return
                if is_value:
                    seen.append(msgspec.json.decode(message.payload))
                    confirmed += 1
                elif message.topic.endswith("/pump"):
                    self.availability.append(bytes(message.payload))
                connection.sendall(b"\x40\x02" + message.identifier.to_bytes(2))


class Site:
    """A site without devices."""

    revision = answering_revision = 0

    def __init__(self) -> None:
        self.refreshed = 0
        self.standby: frozenset[str] = frozenset()
        self.retained: dict[tuple[str, str], str] = {}

    def tags(self) -> dict[str, Any]:
        return {}

    def devices(self) -> dict[str, Any]:
        return {}

    def answering(self) -> dict[str, bool]:
        return {}

    def latest(self) -> list[Reading]:
        return []

    def refresh(self) -> None:
        self.refreshed += 1

    def write(self, *_: object, **__: object) -> None:
        raise AssertionError("no test of this file writes")


class Reloaded(Site):
    """A site whose tags change."""

    def __init__(self, **tags: list[Tag]) -> None:
        super().__init__()
        self._tags = tags

    def tags(self) -> dict[str, Any]:
        return self._tags

    def reload(self, **tags: list[Tag]) -> None:
        self.revision += 1
        self._tags = tags


class Pump(Site):
    """A site with one device, which can stop answering right after a look at it."""

    def __init__(self) -> None:
        super().__init__()
        self.is_answering, self.is_ending = True, False

    @property
    def answering_revision(self) -> int:  # type: ignore[override]
        found = 1 if self.is_answering else 2
        self.is_answering = self.is_answering and not self.is_ending
        return found

    def answering(self) -> dict[str, bool]:
        return {"pump": self.is_answering}


@pytest.fixture
def stop() -> Iterator[Stop]:
    made = Stop()
    yield made
    made.set()


def made(broker: Broker | FakeBroker, site: Site, stop: Stop, **more: Any) -> MqttOutput:
    url = broker.url if isinstance(broker, FakeBroker) else f"mqtt://127.0.0.1:{broker.port}"
    settings = MqttOutputConfig.model_validate({"type": "mqtt", "url": url} | more)
    output = MqttOutput("home", settings, site)
    output.use_stop(stop)
    return output


def test_what_waits_is_not_published_while_another_node_polls_the_device(stop: Stop) -> None:
    broker, site = Broker(2, 100), Site()
    output = made(broker, site, stop)
    readings = [*numbered(3), reading(7, device="fan")]
    with pytest.raises(OSError, match="connection"):
        output.send(readings)
    site.standby = frozenset({"pump"})
    output.send(readings)
    output.send(numbered(1, 3))
    site.standby = frozenset()
    output.send(numbered(1, 4))
    output.close()
    broker.thread.join()
    assert broker.seen == [[0, 1], [7, 4]]


def test_a_step_goes_on_where_it_was(stop: Stop) -> None:
    broker = Broker(4, 3, 100)
    output = made(broker, Site(), stop)
    readings = numbered(20)
    for _ in range(2):
        with pytest.raises(OSError, match="connection"):
            output.send(readings)
    output.send(readings)
    output.close()
    broker.thread.join()
    assert broker.seen == [list(range(4)), list(range(4, 7)), list(range(7, 20))]


def test_what_waits_of_a_tag_that_is_removed_is_not_published(stop: Stop) -> None:
    """Its retained message was removed; the value of a removed tag must not replace it."""
    broker = Broker(0, 100)
    site = Reloaded(pump=[tag()], fan=[tag()])
    output = made(broker, site, stop, retain=False)
    readings = [reading(1), reading(2, device="fan"), reading(3)]
    with pytest.raises(OSError, match="connection"):
        output.send(readings)
    site.reload(pump=[tag()])
    output.send(readings)
    output.close()
    broker.thread.join()
    assert broker.seen == [[], [1, 3]]


def test_an_object_for_a_device_has_no_tag_that_was_removed(stop: Stop) -> None:
    broker = Broker(1, 100)
    site = Reloaded(pump=[tag("a"), tag("b")])
    output = made(broker, site, stop, retain=False, payload="device", topic="plant/{device}/t")
    output.send([reading(1, tag=tag("a")), reading(2, tag=tag("b"))])
    readings = [reading(3, TIME + 5, tag=tag("a")), reading(4, TIME + 5, tag=tag("b"))]
    with pytest.raises(OSError, match="connection"):
        output.send(readings)
    site.reload(pump=[tag("a")])
    output.send(readings)
    output.send([reading(5, TIME + 10, tag=tag("a"))])
    output.close()
    broker.thread.join()
    values = [[message["values"] for message in seen] for seen in broker.seen]
    assert values == [[{"a": 1, "b": 2}], [{"a": 3}, {"a": 5}]]


def test_a_device_that_is_removed_while_its_values_wait_is_forgotten(stop: Stop) -> None:
    broker = Broker(0, 100)
    site = Reloaded(pump=[tag()], fan=[tag()])
    output = made(broker, site, stop, retain=False, payload="device", topic="plant/{device}/t")
    with pytest.raises(OSError, match="connection"):
        output.send([reading(1)])
    site.reload(fan=[tag()])
    output.send([reading(2, device="fan")])
    output.close()
    broker.thread.join()
    assert [[message["values"] for message in seen] for seen in broker.seen] == [[], [{"t": 2}]]


def test_a_removal_is_repeated_until_it_is_confirmed(stop: Stop) -> None:
    """Also by another output of the same name, as after a reload."""
    site = Reloaded(pump=[tag()], fan=[tag()])

    def idle() -> None:
        with contextlib.suppress(OSError):
            output.idle()

    def is_forgotten() -> bool:
        output.idle()
        return len(site.retained) == 3

    with FakeBroker() as broker, ThreadPoolExecutor(1) as threads:
        output = made(broker, site, stop)
        for confirms in (False, False, True):
            begun = threads.submit(idle)
            with broker.accept() as peer:
                peer.expect(CONNECT)
                peer.connack()
                begun.result()
                if len(site.tags()) > 1:
                    site.reload(pump=[tag()])
                    output.idle()
                removed = {b"plant/fan/t", b"plant/holdfast/status/fan"}
                while removed:
                    packet = peer.receive()
                    removed = {topic for topic in removed if topic not in packet.body}
                assert packet.kind == PUBLISH
                if confirms:
                    start = 2 + packet.body[1]
                    count = int.from_bytes(packet.body[start : start + 2])
                    for each in range(count - 5, count + 1):
                        peer.send(acknowledge(PUBACK, each))
                    wire.until(is_forgotten, "confirmed")
            output.close()
            output = made(broker, site, stop)
    assert {topic for _, topic in site.retained} == {
        "plant/holdfast/status",
        "plant/holdfast/status/pump",
        "plant/pump/t",
    }


def kinds_until_closed(peer: Peer) -> set[int]:
    """The types of all packets up to the end of the connection."""
    kinds = set()
    with contextlib.suppress(EOFError, ConnectionError):
        while True:
            kinds.add(peer.receive().kind)
    return kinds


@pytest.mark.parametrize("version", ["5", "3.1.1"])
@pytest.mark.parametrize("ends", [False, True])
def test_a_broker_that_confirms_nothing_publishes_the_will(
    stop: Stop, version: str, ends: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A DISCONNECT would remove the will, and the retained `online` would stay."""
    monkeypatch.setattr(session, "CONFIRM_TIMEOUT_S", 0.0)
    monkeypatch.setattr(session, "STOP_TIMEOUT_S", 0.0)
    with FakeBroker(version) as broker, ThreadPoolExecutor(1) as threads:
        output = made(broker, Site(), stop, version=version)
        sent = threads.submit(output.idle) if ends else threads.submit(output.send, numbered(1))
        with broker.accept() as peer:
            peer.expect(CONNECT)
            peer.connack()
            if ends:
                sent.result()
                sent = threads.submit(output.close)
            kinds = kinds_until_closed(peer)
        if ends:
            sent.result()
        else:
            with pytest.raises(TimeoutError, match="did not confirm"):
                sent.result()
    assert DISCONNECT not in kinds


def test_a_broker_that_confirms_slowly_holds_no_stop(
    stop: Stop, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is left must be stored in time: confirmations do not extend the wait."""
    monkeypatch.setattr(session, "STOP_TIMEOUT_S", inf)
    monkeypatch.setattr(sender, "STOP_TIMEOUT_S", 0.0)
    with FakeBroker() as broker, ThreadPoolExecutor(1) as threads:
        output = made(broker, Site(), stop)
        sent = threads.submit(output.send, numbered(2))
        with broker.accept() as peer:
            peer.expect(CONNECT)
            peer.connack()
            while peer.receive().kind != PUBLISH:
                pass
            stop.set()
            with pytest.raises(TimeoutError, match="did not confirm all"):
                sent.result(wire.DEADLINE)


def test_a_password_that_is_too_long_is_an_error_of_its_file(stop: Stop, tmp_path: Path) -> None:
    (tmp_path / "p").write_bytes(b"x" * 65_536)
    options = {"username": "me", "password_file": str(tmp_path / "p")}
    with FakeBroker() as broker:
        output = made(broker, Site(), stop, **options)
        with pytest.raises(OSError, match="p holds more than 65535 bytes"):
            output.idle()


def test_a_device_that_stops_answering_between_two_looks_becomes_offline(stop: Stop) -> None:
    site, broker = Pump(), Broker(1)
    output = made(broker, site, stop)
    output.idle()
    site.is_ending = True
    output.idle()
    assert not site.is_answering
    output.send(numbered(1))
    output.close()
    broker.thread.join()
    assert broker.availability == [b"online", b"offline"]
