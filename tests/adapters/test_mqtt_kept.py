"""Messages for a memory whose file or log does not take them."""

from __future__ import annotations

import json
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import pytest

from holdfast._core import Log, MemoryFile
from support import wire
from support.brokers import NatsServer
from support.mqtt_rig import Rig, command, subscription, text

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    """The memory `plant` is in a file that is closed; writes are refused."""
    with Rig(tmp_path) as started:
        file = MemoryFile(tmp_path / "plant.redb", [("plant", started.memory)], 0)
        file.start()
        file.stop()
        yield started


@pytest.mark.parametrize("qos", [1, 2])
def test_a_message_is_delivered_until_it_is_kept(rig: Rig, qos: int) -> None:
    broker = rig.broker()
    running = rig.connected(broker, subscription(qos=qos))
    rig.probe(broker).publish("plant/ingest", text(command([7])), qos=qos)
    wire.until(lambda: running.status()["reconnects"] >= 2, "it is tried again")
    refused: Any = rig.memory_access.counts()["refused"]
    assert list(refused) == ["log_unavailable"]
    assert "can't be reached" in str(running.status()["last_error"])
    assert rig.registers(0, 1) == [0]


def test_a_message_without_acknowledgement_is_lost(rig: Rig) -> None:
    broker = rig.broker()
    running = rig.connected(broker, subscription(qos=0))
    rig.probe(broker).publish("plant/ingest", text(command([7])), qos=0)
    running.wait_until_received(1)
    assert rig.memory_access.counts()["refused"] == {"log_unavailable": 1}
    assert running.status()["reconnects"] == 0


def test_a_message_that_is_too_large_for_the_log_does_not_stop_those_behind_it(
    tmp_path: Path,
) -> None:
    with Rig(tmp_path) as rig, ExitStack() as stack:
        server = NatsServer(tmp_path)
        stack.callback(server.kill)
        log = Log("site", "a", [server.url], [("plant", rig.memory)], write_timeout=wire.DEADLINE)
        stack.callback(log.stop)
        log.start(wire.DEADLINE)
        broker = rig.broker()
        running = rig.connected(broker, subscription())
        probe = rig.probe(broker)
        probe.subscribe("answers")
        too_large = text(*[command([1] * 1000)] * 530)
        probe.publish("plant/ingest", too_large, ResponseTopic="answers")
        probe.publish("plant/ingest", text(command([7])))
        assert json.loads(probe.get().payload)["reason"] == "too_large"
        wire.until(lambda: rig.registers(0, 1) == [7], "the next message is written")
        assert rig.memory_access.counts()["refused"] == {"too_large": 1}
        assert running.status()["reconnects"] == 0
