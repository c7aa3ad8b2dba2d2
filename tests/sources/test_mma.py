"""Each literal example of the readme of the Modbus Memory Appliance, sent after the import.

Packets are printed there without their CRC; its layout of a packet has one. So each is sent both
ways: without, as the program took them, and with it, where the new configuration requires it.
"""

from __future__ import annotations

import zlib
from contextlib import closing
from typing import TYPE_CHECKING, Any

import pytest

from holdfast._core import Follower
from holdfast.types import AREAS
from support import wire
from support.brokers import Mosquitto
from support.mqtt_rig import Probe
from support.running import content, endpoint
from support.web import Client

if TYPE_CHECKING:
    from pathlib import Path

    from holdfast.appliance import Appliance
    from sources.conftest import RunImported

SOURCE = """\
memory:
  memories:
    "1":
      coils: {start: 0, size: 1000}
      discrete_inputs: {start: 0, size: 1000}
      holding_registers: {start: 0, size: 1000}
      input_registers: {start: 0, size: 1000}
routing: {unit_id_map: {1: "1"}}
ports:
  502: {unit_ids: all, memories: all, access: read-write}
raw_ingest: {enabled: true, listen: "127.0.0.1:9000", max_packet_bytes: 600, read_timeout_ms: 2000}
"""
READ_TIMEOUT_MS = "read_timeout_ms: 2000"

HOLDING_REGISTERS = """
52 49 01 00 03 00 00 01 00 00 00 03
00 64 00 C8 01 2C
"""
DISCRETE_INPUTS = """
52 49 01 00 02 00 00 01 00 00 00 05
0D
"""
COMMAND = b"""\
{
"memory": "plant_a",
"area": "holding_registers",
"address": 0,
"values": [100, 200, 300]
}"""
REST = """\
rest:
  enabled: true
  address: 127.0.0.1:8080
  auth: {enabled: true, type: bearer, bearer: {tokens: [{name: gate, token: long-enough-secret}]}}
"""
MQTT = "mqtt: {enabled: true, broker: 'tcp://127.0.0.1:%d', client_id: mma, topic: ingest}\n"
GRANTS: dict[str, Any] = {"grant_rest": ["holding_registers"], "grant_mqtt": ["holding_registers"]}
"""The options of the import for this example, which its program refused."""
DONE, REFUSED = b"\x00", b"\x01"


def crc(packet: bytes) -> bytes:
    """Appends the CRC-32 of the layout."""
    return packet + zlib.crc32(packet).to_bytes(4, "big")


def require_crc(data: dict[str, Any]) -> None:
    """What the page says for senders that send the CRC of the documentation."""
    del data["listeners"]["raw-ingest"]["compat"]["crc"]


def reply(appliance: Appliance, packet: bytes) -> bytes:
    """All that comes back for a packet whose sender then sends nothing more."""
    with wire.Connection(endpoint(appliance, "raw-ingest")) as sender:
        sender.send(packet)
        sender.finish()
        return sender.rest()


def ask(appliance: Appliance, pdu: str) -> str:
    """The reply of Modbus to a request for unit 1."""
    with wire.Connection(endpoint(appliance, "port-502")) as client:
        return client.ask(bytes.fromhex(pdu)).hex()


@pytest.mark.parametrize("with_crc", [False, True], ids=["CRC omitted", "CRC32"])
@pytest.mark.parametrize(
    ("printed", "request_pdu", "read"),
    [
        # [100, 200, 300] starting at address 0
        (HOLDING_REGISTERS, "0300000003", "0306 0064 00c8 012c"),
        # [1,0,1,1,0] starting at address 0
        (DISCRETE_INPUTS, "0200000005", "0201 0d"),
    ],
    ids=["holding registers", "discrete inputs"],
)
def test_a_printed_packet_is_written_and_read_by_modbus(
    run_imported: RunImported, printed: str, request_pdu: str, read: str, with_crc: bool
) -> None:
    packet = bytes.fromhex(printed)
    appliance = run_imported(SOURCE, change=require_crc if with_crc else None)
    assert reply(appliance, crc(packet) if with_crc else packet) == DONE
    assert ask(appliance, request_pdu) == bytes.fromhex(read).hex()


@pytest.fixture
def plant_a() -> str:
    """The configuration with the name of a memory that the command has."""
    return SOURCE.replace('"1":', "plant_a:").replace('1: "1"', "1: plant_a")


def test_the_printed_command_is_written_by_rest_or_refused_as_a_whole(
    run_imported: RunImported, plant_a: str
) -> None:
    appliance = run_imported(plant_a + REST, **GRANTS)
    with closing(Client(endpoint(appliance, "rest"), "long-enough-secret")) as client:
        assert client.ingest(COMMAND).status == 200
        assert ask(appliance, "0300000003") == "0306006400c8012c"
        before = content(appliance.memories["plant_a"])
        for wrong in (b"[1, 2, 70000]", b"[1, 2, -1]", b"[1, 2, 3.5]", b'[1, 2, "3"]'):
            assert client.ingest(COMMAND.replace(b"[100, 200, 300]", wrong)).status == 400
            assert content(appliance.memories["plant_a"]) == before


def test_the_printed_command_is_a_message_of_mqtt_too(
    run_imported: RunImported, plant_a: str, tmp_path: Path
) -> None:
    broker = Mosquitto(tmp_path)
    try:
        appliance = run_imported(plant_a + MQTT % broker.port, **GRANTS)

        def topic() -> dict[str, Any]:
            found: Any = appliance.diagnostics.adapter("mqtt")
            return dict(found["topics"][0])

        wire.until(lambda: topic()["granted"] == 0, "it has subscribed")
        with Probe(broker.port) as probe:
            probe.publish("ingest", COMMAND.decode())
            wire.until(lambda: ask(appliance, "0300000003") == "0306006400c8012c", "it is written")
    finally:
        broker.kill()


HEADER = bytes.fromhex(HOLDING_REGISTERS)[:12]
PAYLOAD = bytes.fromhex(HOLDING_REGISTERS)[12:]
WRONG = {
    "bounds check": crc(HEADER[:8] + b"\x03\xe6" + HEADER[10:] + PAYLOAD),
    "payload length: a register too few": crc(HEADER + PAYLOAD[:-2]),
    "payload length: a register too many": crc(HEADER + PAYLOAD + b"\x00\x07"),
    "CRC": crc(HEADER + PAYLOAD)[:-1] + b"\x00",
    "CRC omitted": HEADER + PAYLOAD,
    "structure: magic": crc(b"rI" + HEADER[2:] + PAYLOAD),
    "structure: version": crc(HEADER[:2] + b"\x02" + HEADER[3:] + PAYLOAD),
    "structure: area": crc(HEADER[:4] + b"\x05" + HEADER[5:] + PAYLOAD),
    "structure: memory id": crc(HEADER[:6] + b"\x00\x02" + HEADER[8:] + PAYLOAD),
    "structure: half a header": HEADER[:6],
}
"""Packets with one fault each, where a CRC is required."""


def test_a_packet_with_any_fault_is_answered_01_and_leaves_memory_unchanged(
    run_imported: RunImported,
) -> None:
    appliance = run_imported(SOURCE, change=require_crc)
    memory = appliance.memories["1"]
    memory.write("holding_registers", 0, list(range(1, 1001)))
    before = content(memory)
    for fault, packet in WRONG.items():
        assert (fault, reply(appliance, packet)) == (fault, REFUSED)
        assert content(memory) == before, fault


def test_only_writes_change_memory(run_imported: RunImported) -> None:
    """Neither reads, refusals nor the timeout of a packet, which is a timer, count as writes."""
    assert READ_TIMEOUT_MS in SOURCE
    appliance = run_imported(SOURCE.replace(READ_TIMEOUT_MS, "read_timeout_ms: 300"))
    assert reply(appliance, bytes.fromhex(HOLDING_REGISTERS)) == DONE
    follower = Follower(appliance.memories["1"], [(area, 0, 1000) for area in AREAS])
    writes, _ = follower.changes()
    with wire.Connection(endpoint(appliance, "raw-ingest")) as sender:
        sender.send(bytes.fromhex(DISCRETE_INPUTS)[:-1])
        assert sender.rest() == REFUSED
    assert reply(appliance, bytes.fromhex(DISCRETE_INPUTS)[:-1]) == REFUSED
    assert ask(appliance, "0300000003") == "0306006400c8012c"
    assert ask(appliance, "06ffff0007") == "8602"
    assert follower.changes() == (writes, [])
    assert reply(appliance, bytes.fromhex(DISCRETE_INPUTS)) == DONE
    assert follower.changes()[0] == writes + 1


def test_an_imported_appliance_has_no_more_than_its_source_and_is_not_changed_while_it_runs(
    run_imported: RunImported,
) -> None:
    """No polls, outputs, gateway or console; its file is read again only on request."""
    config = run_imported(SOURCE).config
    given = config.model_fields_set - {"identity"}
    assert given == {"memories", "listeners"}
    assert config.reload == "on-request"
