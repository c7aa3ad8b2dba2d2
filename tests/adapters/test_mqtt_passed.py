"""Messages for ranges that are written through to a device (`writes: pass`).

A stale command must not move a machine. Memory takes it.
"""

from __future__ import annotations

import contextlib
import json
import signal
import threading
from typing import TYPE_CHECKING, Any

import pytest

from support import mqtt_peer as mqtt
from support import wire
from support.audits import writes
from support.cli import RunCommand
from support.config_folder import written
from support.fake_device import Stream
from support.mqtt_peer import FakeBroker, publish
from support.mqtt_rig import Rig, command, settings, subscription, text
from support.polled import configuration, counters, device, read

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from holdfast.appliance import Appliance
    from support.fake_device import Asked
    from support.running import Run

VERSIONS = ["5", "3.1.1"]
READS = [read("holding_registers", 500, 3, ("holding_registers", 10))]
"""The device's registers 500 to 502 are 10 to 12 of the mirror."""


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with Rig(tmp_path) as rig:
        yield rig


@pytest.fixture
def plc() -> Iterator[Stream]:
    with Stream("tcp") as plc:
        yield plc


def plant(broker: str, plc: Stream, **more: Any) -> str:
    entry = subscription(memories=["mirror"], areas=["holding_registers"])
    client = settings(broker, entry, version=more.pop("version", "5"))
    meter = device(plc.url, *READS, interval=3600, writes="pass")
    data = json.loads(client.model_dump_json(exclude_none=True))
    return configuration({"meter": meter}, mqtt=data, **more)


def started(run: Run, broker: str, plc: Stream, **more: Any) -> Appliance:
    """Runs an appliance until it has read the device."""
    appliance = run(plant(broker, plc, **more))
    wire.until(lambda: counters(appliance, "meter")["reads"] >= 1, "all is read")
    return appliance


def state(appliance: Appliance) -> dict[str, Any]:
    found = appliance.diagnostics.adapter("mqtt")
    assert found is not None
    return found


def until_handled(appliance: Appliance, count: int) -> None:
    def handled() -> int:
        found = state(appliance)
        return int(found["accepted"] + sum(found["refused"].values()))

    wire.until(lambda: handled() >= count, f"{count} messages")


def writes_of(plc: Stream) -> list[bytes]:
    return [asked.pdu for asked in plc.requests if asked.pdu[0] > 4]


def to(address: int, value: int) -> str:
    return text(command([value], address, memory="mirror"))


@pytest.mark.parametrize("version", VERSIONS)
def test_a_retained_command_is_not_sent_to_a_device(
    rig: Rig, run: Run, plc: Stream, version: str, tmp_path: Path
) -> None:
    broker, audit = rig.broker(), tmp_path / "audit.log"
    probe = rig.probe(broker)
    probe.subscribe("answers")
    probe.publish("plant/ingest", to(10, 42), retain=True, ResponseTopic="answers")
    appliance = started(run, broker.url, plc, version=version, audit={"file": str(audit)})
    until_handled(appliance, 1)
    assert state(appliance)["refused"] == {"stale_command": 1}
    wire.until(lambda: bool(writes(audit)), "it is recorded")
    assert [line["outcome"] for line in writes(audit)] == ["stale_command"]
    if version == "5":
        assert json.loads(probe.get().payload) == {
            "status": "rejected",
            "reason": "stale_command",
            "detail": "not sent to meter: the message is retained, so its command may be old",
        }

    # A new one is sent, also if the broker retains it for others.
    probe.publish("plant/ingest", to(11, 43), retain=True)
    until_handled(appliance, 2)
    assert writes_of(plc) == [b"\6\1\xf5\0\x2b"]
    assert appliance.memories["mirror"].read("holding_registers", 10, 3) == [500, 43, 502]


def test_memory_takes_a_retained_command(rig: Rig, run: Run, plc: Stream) -> None:
    broker = rig.broker()
    broker.publish("plant/ingest", to(0, 42), "-r", "-q", "1")
    appliance = started(run, broker.url, plc)
    until_handled(appliance, 1)
    assert appliance.memories["mirror"].read("holding_registers", 0, 1) == [42]


@pytest.mark.parametrize("qos", [1, 2])
@pytest.mark.parametrize("version", VERSIONS)
def test_a_command_that_is_delivered_again_is_not_sent_to_a_device(
    run: Run, plc: Stream, version: str, qos: int
) -> None:
    with FakeBroker(version) as fake:
        appliance = started(run, fake.url, plc, version=version)
        with fake.accept() as peer:
            peer.welcome()
            for address, identifier in ((10, 7), (0, 8)):
                message = to(address, 42)
                peer.send(
                    publish("plant/ingest", message, qos, identifier, version=version, again=True)
                )
                peer.expect(mqtt.PUBACK if qos == 1 else mqtt.PUBREC)
            assert writes_of(plc) == []
            assert state(appliance)["refused"] == {"stale_command": 1}
            assert appliance.memories["mirror"].read("holding_registers", 0, 1) == [42]


@pytest.mark.parametrize("qos", [1, 2])
def test_a_device_gets_a_command_once_though_the_process_was_killed_before_it_acknowledged(
    rig: Rig, tmp_path: Path, plc: Stream, qos: int
) -> None:
    broker, audit = rig.broker(), tmp_path / "audit.log"
    probe = rig.probe(broker)
    probe.subscribe("answers")
    has_it = threading.Event()

    def answer(asked: Asked) -> None:
        if asked.pdu[0] > 4:
            has_it.set()  # And the answer does not come.
        else:
            asked.answer()

    plc.then = answer
    entry = subscription(qos=qos, memories=["mirror"], areas=["holding_registers"])
    scada = {"sources": ["127.0.0.1"], "units": {1: "mirror"}, "access": "read-only"}
    meter = device(plc.url, *READS, interval=3600, timeout=wire.DEADLINE, writes="pass")
    file = tmp_path / "plant.yaml"
    file.write_text(
        written(
            {
                "memories": {"mirror": {"holding_registers": 100}},
                "devices": {"meter": meter},
                "listeners": {
                    "scada": {"type": "modbus-tcp", "bind": "127.0.0.1:0", "rules": [scada]}
                },
                "mqtt": {"url": broker.url, "client_id": "killed", "subscriptions": [entry]},
                "audit": {"file": str(audit)},
            }
        )
    )
    with contextlib.ExitStack() as stack:
        first = RunCommand(file)
        stack.callback(first.process.kill)
        first.wait_until_it_serves()
        wire.until(lambda: "Sending SUBACK to killed" in broker.log, "subscribed")
        probe.publish("plant/ingest", to(10, 42), qos, ResponseTopic="answers")
        assert has_it.wait(wire.DEADLINE)
        first.end(signal.SIGKILL)

        again = RunCommand(file)
        stack.callback(again.end, signal.SIGTERM)
        again.wait_until_it_serves()
        answered = json.loads(probe.get().payload)
        assert (answered["reason"], answered["detail"]) == (
            "stale_command",
            "not sent to meter: the broker delivers the message again, "
            "and its command may be carried out already",
        )
        assert len(writes_of(plc)) == 1
        assert [line["outcome"] for line in writes(audit)] == ["stale_command"]


def test_a_broker_keeps_commands_for_a_device_only_with_a_quality_of_service(
    rig: Rig, run: Run, plc: Stream
) -> None:
    """As the documentation says: nothing tells them from new ones."""
    broker = rig.broker()
    entries = [
        subscription(f"qos{qos}", qos, memories=["mirror"], areas=["holding_registers"])
        for qos in (0, 1)
    ]
    config = settings(broker.url, *entries, client_id="away")
    before = rig.run(config)
    before.wait_until_connected()
    before.stop()
    data = json.loads(config.model_dump_json(exclude_none=True))
    for address, topic in enumerate(("qos0", "qos1"), 10):
        broker.publish(topic, to(address, 42), "-q", "1")
    meter = device(plc.url, *READS, interval=3600, writes="pass")
    appliance = run(configuration({"meter": meter}, mqtt=data))
    until_handled(appliance, 1)
    broker.publish("qos0", to(12, 43), "-q", "1")
    until_handled(appliance, 2)
    mirror = appliance.memories["mirror"]
    assert mirror.read("holding_registers", 10, 3) == [500, 42, 43]
