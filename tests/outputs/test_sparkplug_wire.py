"""Sparkplug outputs on the wire: what a broker receives and may refuse."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

import pytest

from holdfast.outputs.mqtt import session
from holdfast.outputs.sparkplug.definition import parsed
from support import mqtt_peer as mqtt
from support import wire
from support.mqtt_peer import FakeBroker
from support.mqtt_plant import Plant
from support.sparkplug_watch import SETTINGS

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@pytest.fixture
def plant(tmp_path: Path) -> Iterator[Plant]:
    with Plant(tmp_path) as started:
        yield started


@pytest.fixture(params=["5", "3.1.1"])
def fake(request: pytest.FixtureRequest) -> Iterator[FakeBroker]:
    with FakeBroker(request.param) as broker:
        yield broker


def test_the_session_is_clean_and_its_will_is_the_death(
    plant: Plant, fake: FakeBroker, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session, "STOP_TIMEOUT_S", 0.05)
    plant.device()
    plant.run(**SETTINGS, url=fake.url, version=fake.version)
    with fake.accept() as peer:
        connect = peer.expect(mqtt.CONNECT).body
        assert connect[7] & 0b111110 == 0b001110, "a will, of service 1, not retained; clean"
        topic = b"spBv1.0/plant/NDEATH/edge"
        _, _, rest = connect.partition(len(topic).to_bytes(2) + topic)
        [metric] = parsed(rest[2 : 2 + int.from_bytes(rest[:2])]).metrics
        assert (metric.name, metric.datatype, metric.long_value) == ("bdSeq", 4, 0)
        peer.connack()
        asked = peer.expect(mqtt.SUBSCRIBE)
        assert b"spBv1.0/plant/NCMD/edge" in asked.body
        assert asked.body[-1] & 3 == 1
        plant.stop()
        packets = []
        with suppress(EOFError):
            while True:
                packets.append(peer.receive())
    ends = [packet.body[:1] for packet in packets if packet.kind == mqtt.DISCONNECT]
    with_will = b"\x04"
    # Nothing was confirmed, and an orderly end of MQTT 3.1.1 drops the will.
    assert ends == ([with_will] if fake.version == "5" else [])


def test_a_refused_subscription_is_logged(
    plant: Plant, fake: FakeBroker, caplog: pytest.LogCaptureFixture
) -> None:
    plant.device()
    plant.run(**SETTINGS, url=fake.url, version=fake.version)

    def refused() -> list[str]:
        return [
            entry.fields["topic"]  # type: ignore[attr-defined]
            for entry in caplog.records
            if "subscription_refused" in entry.getMessage()
        ]

    with fake.accept() as peer:
        peer.expect(mqtt.CONNECT)
        peer.connack()
        peer.suback(peer.expect(mqtt.SUBSCRIBE).identifier, 0x80)
        wire.until(refused, "the refusal is logged")
        assert refused() == ["spBv1.0/plant/NCMD/edge"]
