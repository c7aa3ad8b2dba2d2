"""A broker that goes away in the middle of a step: what it has not confirmed is sent again."""

from __future__ import annotations

import socket
import threading
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.config.models.outputs import MqttOutputConfig
from holdfast.net.mqtt.packets import parse_publish
from holdfast.net.mqtt.stream import Packets
from holdfast.outputs.mqtt import MqttOutput
from holdfast.outputs.mqtt.connection import MAX_PACKET_BYTES
from holdfast.runtime.stop import Stop
from support.readings import numbered

if TYPE_CHECKING:
    from collections.abc import Iterator

    from holdfast.polling import Reading


class Broker:
    """Confirms a number of values in each connection, then closes it."""

    def __init__(self, *confirms: int) -> None:
        self._confirms = confirms
        self.seen: list[list[int]] = []
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
        packets, confirmed = Packets(MAX_PACKET_BYTES), 0
        seen: list[int] = []
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
                    seen.append(int(float(bytes(message.payload))))
                    confirmed += 1
                elif message.topic.endswith("/pump"):
                    self.availability.append(bytes(message.payload))
                connection.sendall(b"\x40\x02" + message.identifier.to_bytes(2))


class Site:
    """A site without devices."""

    revision = answers = 0

    def __init__(self) -> None:
        self.refreshed = 0

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

    def write(self, *_: object) -> None:
        raise AssertionError("no test of this file writes")


class Pump(Site):
    """A site with one device, which can stop answering right after a look at it."""

    def __init__(self) -> None:
        super().__init__()
        self.is_answering, self.is_ending = True, False

    @property
    def answers(self) -> int:  # type: ignore[override]
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


def made(broker: Broker, site: Site, stop: Stop) -> MqttOutput:
    url = f"mqtt://127.0.0.1:{broker.port}"
    output = MqttOutput("home", MqttOutputConfig.model_validate({"type": "mqtt", "url": url}), site)
    output.until(stop)
    return output


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
