"""Commands of outputs on the wire: which of those that a broker delivers are carried out."""

from __future__ import annotations

import socket
import time
from math import inf
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.net.mqtt import client
from holdfast.outputs import sender
from holdfast.outputs.mqtt import connection, pings
from holdfast.outputs.mqtt.connection import MAX_PAYLOAD_BYTES
from holdfast.outputs.mqtt.receiver import default_client_id
from holdfast.outputs.sparkplug.definition import Payload
from support import mqtt_peer as mqtt
from support import wire
from support.mqtt_peer import FakeBroker, Peer
from support.mqtt_plant import Plant
from support.sparkplug_watch import SETTINGS

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from support.mqtt_peer import Packet


@pytest.fixture(autouse=True)
def short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("FIRST_PAUSE_S", "MAX_PAUSE_S", "CHECK_INTERVAL_S"):
        monkeypatch.setattr(sender, name, 0.05)


@pytest.fixture
def plant(tmp_path: Path) -> Iterator[Plant]:
    with Plant(tmp_path) as started:
        yield started


@pytest.fixture(params=["5", "3.1.1"])
def fake(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeBroker]:
    # It answers pings only while a test looks at its packets.
    monkeypatch.setattr(pings, "MAX_COMMAND_AGE_S", 60)
    with FakeBroker(request.param) as broker:
        yield broker


def until(peer: Peer, kind: int, part: bytes) -> Packet:
    """Serves the output until it sends a packet of this type that contains `part`."""
    while True:
        packet = peer.receive()
        match packet.kind:
            case mqtt.CONNECT:
                peer.connack()
            case mqtt.SUBSCRIBE:
                peer.suback(packet.identifier, 1)
            case mqtt.PINGREQ:
                peer.send(mqtt.packet(mqtt.PINGRESP))
            case mqtt.PUBLISH if packet.flags & 2:
                start = 2 + int.from_bytes(packet.body[:2])
                identifier = int.from_bytes(packet.body[start : start + 2])
                peer.send(mqtt.acknowledge(mqtt.PUBACK, identifier))
        if packet.kind == kind and part in packet.body:
            return packet


def command(value: bool) -> bytes:
    """The payload of a DCMD for the valve."""
    made = Payload()
    made.metrics.add(name="valve", datatype=11, boolean_value=value)
    data: bytes = made.SerializeToString()
    return data


IDENTITIES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "status": ({"status": "north/status"}, {"status": "south/status"}),
    "topic": ({"topic": "north/{device}/{tag}"}, {}),
    "edge node": (SETTINGS, SETTINGS | {"edge_node": "other"}),
    "group": (SETTINGS, SETTINGS | {"group": "other"}),
}
"""Outputs of one name that can be at one broker, as those of two appliances of one machine."""


@pytest.mark.parametrize("way", IDENTITIES)
def test_outputs_that_differ_have_client_ids_that_differ(plant: Plant, way: str) -> None:
    plant.device()

    def client_id(output: dict[str, Any]) -> object:
        plant.run(**output)
        wire.until(lambda: "client_id" in plant.status(), "the output has begun")
        found = plant.status()["client_id"]
        plant.stop()
        return found

    first, second = map(client_id, IDENTITIES[way])
    assert first != second
    assert client_id(IDENTITIES[way][0]) == first, "it stays the same over restarts"


@pytest.mark.parametrize("host", ["pi", "raspberry", "plant-7.example.com"])
def test_a_default_client_id_is_not_made_too_long(
    monkeypatch: pytest.MonkeyPatch, host: str
) -> None:
    monkeypatch.setattr(socket, "gethostname", lambda: host)
    plain = default_client_id("home", "")
    assert plain == f"holdfast-home-{host}"
    own = default_client_id("home", "north/status")
    assert own.startswith("holdfast-home-")
    assert (len(own) <= 23) == (len(plain) <= 23)
    monkeypatch.setattr(socket, "gethostname", lambda: f"{host[:-1]}_")
    assert default_client_id("home", "north/status") != own, "also of two hosts that begin alike"


@pytest.mark.parametrize("output", [{}, SETTINGS], ids=["mqtt", "sparkplug"])
def test_connections_that_are_early_cuts_have_a_likely_cause(
    plant: Plant, fake: FakeBroker, output: dict[str, Any]
) -> None:
    plant.device()
    plant.run(**output, url=fake.url, version=fake.version, client_id="plant-a")

    def error() -> str:
        return str(plant.status()["last_error"])

    for _ in range(2):
        with fake.accept() as peer:
            until(peer, mqtt.SUBSCRIBE if output else mqtt.PUBLISH, b"")
        wire.until(lambda: "connection" in error(), "it noticed")
        assert "another client" not in error()
    with fake.accept() as peer:
        until(peer, mqtt.SUBSCRIBE if output else mqtt.PUBLISH, b"")
    wire.until(
        lambda: error().endswith("; perhaps another client has client_id plant-a"), "the cause"
    )


def test_connections_that_have_lasted_are_not_early_cuts(
    plant: Plant, fake: FakeBroker, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(client, "EARLY_CUT_S", 0.0)
    plant.device()
    plant.run(url=fake.url, version=fake.version)
    for _ in range(4):
        with fake.accept() as peer:
            until(peer, mqtt.PUBLISH, b"")
    with fake.accept():
        assert "another client" not in str(plant.status()["last_error"])


COMMANDS: dict[str, tuple[dict[str, Any], str, bytes]] = {
    "set topic": ({}, "plant/pump/valve/set", b"true"),
    "DCMD": (SETTINGS, "spBv1.0/plant/DCMD/edge/pump", command(True)),
}
"""The output, and the topic and the payload that open the valve."""


@pytest.mark.parametrize("way", COMMANDS)
def test_a_command_that_is_delivered_again_is_not_carried_out_again(
    plant: Plant, fake: FakeBroker, way: str
) -> None:
    output, topic, payload = COMMANDS[way]
    valve = plant.device().memory
    plant.run(**output, writes=True, url=fake.url, version=fake.version)
    with fake.accept() as peer:
        until(peer, mqtt.SUBSCRIBE, topic.encode())
        if output:
            until(peer, mqtt.PUBLISH, b"DBIRTH")  # Before it, the device is not known.
        peer.send(mqtt.publish(topic, payload, 1, 7, version=fake.version))
        until(peer, mqtt.PUBACK, b"\0\x07")
        wire.until(lambda: valve.read("coils", 0, 1) == [1], "it is carried out")
        valve.write("coils", 0, [0])
        peer.send(mqtt.publish(topic, payload, 1, 7, version=fake.version, again=True))
        until(peer, mqtt.PUBACK, b"\0\x07")

        def ignored() -> bool:
            status = plant.status()
            counts = status.get("commands", status)
            return 1 in (counts.get("ignored"), counts.get("commands_ignored"))

        wire.until(ignored, "it is ignored")
        assert valve.read("coils", 0, 1) == [0]


def test_a_command_that_waited_while_the_network_stood_still_is_not_carried_out(
    plant: Plant, fake: FakeBroker, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "PING_INTERVAL_S", 0.05)
    monkeypatch.setattr(pings, "MAX_COMMAND_AGE_S", 0.2)
    valve = plant.device().memory
    topic = "plant/pump/valve/set"
    late = mqtt.publish(topic, "true", 1, 7, version=fake.version)
    plant.run(writes=True, url=fake.url, version=fake.version)
    with fake.accept() as peer:
        until(peer, mqtt.SUBSCRIBE, topic.encode())
        for _ in range(3):
            until(peer, mqtt.PINGREQ, b"")
        end = time.monotonic() + 0.2
        wire.until(lambda: time.monotonic() > end, "no ping was answered for long enough")
        peer.send(late)
        until(peer, mqtt.PUBACK, b"\0\x07")
        wire.until(lambda: plant.status()["commands"]["ignored"] == 1, "it is ignored")
        monkeypatch.setattr(pings, "MAX_COMMAND_AGE_S", inf)
        peer.send(mqtt.publish(topic, "false", 1, 8, version=fake.version))
        until(peer, mqtt.PUBLISH, b"accepted")
    assert plant.status()["commands"]["written"] == 1
    assert valve.read("coils", 0, 1) == [0]


@pytest.mark.parametrize("size", [MAX_PAYLOAD_BYTES + 1, 10 * MAX_PAYLOAD_BYTES])
@pytest.mark.parametrize("way", COMMANDS)
def test_a_command_that_is_too_large_is_acknowledged_and_refused(
    plant: Plant,
    fake: FakeBroker,
    caplog: pytest.LogCaptureFixture,
    way: str,
    size: int,
) -> None:
    """A broker that gets no acknowledgement sends no more commands when enough of them lack."""
    output, topic, payload = COMMANDS[way]
    valve = plant.device().memory
    plant.run(**output, writes=True, url=fake.url, version=fake.version)
    with fake.accept() as peer:
        until(peer, mqtt.SUBSCRIBE, topic.encode())
        if output:
            until(peer, mqtt.PUBLISH, b"DBIRTH")
        peer.send(mqtt.publish(topic, bytes(size), 1, 7, version=fake.version))
        until(peer, mqtt.PUBACK, b"\0\x07")
        if not output:
            until(peer, mqtt.PUBLISH, b"too_large")
        peer.send(mqtt.publish(topic, payload, 1, 8, version=fake.version))
        until(peer, mqtt.PUBACK, b"\0\x08")
        wire.until(lambda: valve.read("coils", 0, 1) == [1], "the next one is carried out")
    logged = [
        entry.fields["reason"]  # type: ignore[attr-defined]
        for entry in caplog.records
        if "output_command_" in entry.getMessage() and "written" not in entry.getMessage()
    ]
    assert logged in (["too_large"], [f"{size} bytes, allowed: {MAX_PAYLOAD_BYTES}"])
