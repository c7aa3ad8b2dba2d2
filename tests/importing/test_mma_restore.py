"""What imported configurations let senders do, as the sources ran: restore, grants, refusals."""

from __future__ import annotations

import json
import socket
from contextlib import closing
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.config.dump import to_yaml
from support import wire
from support.brokers import Mosquitto
from support.imported import imported
from support.machine import needs_127_0_0_2
from support.mqtt_rig import Probe
from support.running import endpoint
from support.web import Client

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from holdfast.appliance import Appliance
    from support.running import Connect, Run

FIRST = """\
memory:
  memories:
    plant_a:
      default: true
      coils: {start: 0, size: 1024}
      discrete_inputs: {start: 0, size: 1024}
      holding_registers: {start: 0, size: 4096}
      input_registers: {start: 0, size: 4096}
      state_sealing:
        enable: true
        gate: {area: discrete_inputs, address: 127}
routing: {unit_id_map: {1: plant_a}}
ports: {15020: {unit_ids: all, memories: all, access: read-write}}
"""
SECOND = """\
listeners:
  - id: main
    listen: 127.0.0.1:15020
    memory:
      - unit_id: 1
        holding_registers: {start: 0, count: 32}
        policy:
          rules:
            - {id: here, source_ip: [127.0.0.1], allow_fc: [3]}
            - {id: lan, source_ip: [127.0.0.2], allow: ro}
"""
READ = b"\x03\x00\x00\x00\x02"
REGISTERS, ZEROS = b"\x03\x04\x00\x64\x00\xc8", b"\x03\x04\x00\x00\x00\x00"
FORBIDDEN, BUSY = b"\x83\x01", b"\x83\x06"


class Source:
    """Imports a configuration and runs it, on free ports."""

    def __init__(self, run: Run, folder: Path) -> None:
        self._run, self._folder = run, folder

    def start(self, text: str, **options: Any) -> Appliance:
        return self._run(to_yaml(imported(text, self._folder, **options)))


@pytest.fixture
def source(run: Run, tmp_path: Path) -> Source:
    return Source(run, tmp_path)


def command(area: str, address: int, **values: list[int]) -> str:
    return json.dumps({"memory": "plant_a", "area": area, "address": address, **values})


def commands(bit: int, value: int) -> list[str]:
    """A command for each area."""
    return [
        command("coils", 0, bools=[bit, 0, 1]),
        command("discrete_inputs", 0, bools=[bit]),
        command("holding_registers", 0, values=[value, 200]),
        command("input_registers", 0, values=[value]),
    ]


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Mosquitto]:
    started = Mosquitto(tmp_path)
    yield started
    started.kill()


def test_messages_restore_all_areas_before_the_gate_opens_and_two_after_it(
    source: Source, connect: Connect, broker: Mosquitto
) -> None:
    mqtt = f"mqtt: {{enabled: true, broker: 'tcp://127.0.0.1:{broker.port}', topic: ingest}}\n"
    appliance = source.start(FIRST + mqtt)

    def counted() -> dict[str, Any]:
        found: dict[str, Any] = appliance.diagnostics.adapter("mqtt") or {}
        return found

    wire.until(lambda: counted()["topics"][0]["granted"] == 0, "it has subscribed")
    client = connect(endpoint(appliance, "port-15020"))
    assert client.ask(READ) == BUSY
    with Probe(broker.port) as probe:
        for message in [*commands(1, 100), command("discrete_inputs", 127, bools=[1])]:
            probe.publish("ingest", message)
        wire.until(lambda: counted()["accepted"] == 5, "all are written")
        assert client.ask(READ) == REGISTERS
        assert appliance.memories["plant_a"].read("coils", 0, 3) == [1, 0, 1]
        for message in commands(0, 5):
            probe.publish("ingest", message)
        wire.until(lambda: counted()["accepted"] == 7, "inputs are written")
    wire.until(lambda: counted()["refused"] == {"not_granted": 2}, "others are refused")
    assert client.ask(READ) == REGISTERS
    assert appliance.memories["plant_a"].read("coils", 0, 3) == [1, 0, 1]


REST = """\
rest:
  enabled: true
  address: 127.0.0.1:8080
  auth: {enabled: true, type: bearer, bearer: {tokens: [{name: gate, token: long-enough-secret}]}}
"""
OF_THE_README = {
    "memory": "plant_a",
    "area": "holding_registers",
    "address": 0,
    "values": [100, 200, 300],
}


@pytest.mark.parametrize(
    ("options", "status"), [({}, 403), ({"grant_rest": ["holding_registers"]}, 200)]
)
@pytest.mark.parametrize("sealed", [True, False])
def test_rest_writes_holding_registers_only_where_an_option_grants_them(
    source: Source, options: dict[str, Any], status: int, sealed: bool
) -> None:
    """The source has them in the example of its README, and refused them, sealed or not."""
    text = FIRST if sealed else FIRST.replace("enable: true", "enable: false")
    appliance = source.start(text + REST, **options)
    with closing(Client(endpoint(appliance, "rest"), "long-enough-secret")) as client:
        assert client.ingest(OF_THE_README).status == status
    written = [100, 200, 300] if status == 200 else [0, 0, 0]
    assert appliance.memories["plant_a"].read("holding_registers", 0, 3) == written


@needs_127_0_0_2
@pytest.mark.parametrize("as_meant", [False, True])
def test_a_rule_with_allow_refuses_its_peers_unless_it_is_to_have_the_effect_that_was_meant(
    source: Source, connect: Connect, as_meant: bool
) -> None:
    appliance = source.start(SECOND, as_meant=as_meant)
    address = endpoint(appliance, "main")
    assert connect(address).ask(READ) == ZEROS
    assert connect(address, source="127.0.0.2").ask(READ) == (ZEROS if as_meant else FORBIDDEN)


@pytest.mark.parametrize("start", [b"RI\x02\x03", b"RI\x01\x05", b"RI\x00\x03", b"RI\x01\x00"])
def test_a_packet_with_a_wrong_version_or_area_is_answered_at_an_imported_port(
    source: Source, start: bytes
) -> None:
    appliance = source.start(SECOND)
    address = endpoint(appliance, "main")
    with socket.create_connection(address, wire.DEADLINE) as sender:
        sender.sendall(start + bytes.fromhex("0001 0000 0001 0007"))
        assert (sender.recv(2), sender.recv(1)) == (b"\x01", b"")
    with socket.create_connection(address, wire.DEADLINE) as client:
        client.sendall(wire.frame(READ, 1, 0x5249))
        assert client.recv(100) == wire.frame(ZEROS, 1, 0x5249)
