"""The audit log: a line for every write, done or refused, by whichever way it came."""

from __future__ import annotations

import json
import socket
import threading
from hashlib import sha256
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from holdfast import _core
from holdfast.appliance.parts.audit import WriteRecorder
from holdfast.events.audit import Audit, verify
from holdfast.ingest import Grant, MemoryAccess, Refused
from support import wire
from support.audits import await_writes, lines, writes
from support.running import endpoint

if TYPE_CHECKING:
    from pathlib import Path

    from support.running import Connect, Run

CONFIGURATION = """
memories:
  plant: {id: 3, coils: 16, holding_registers: 10}
listeners:
  scada:
    type: modbus-tcp
    bind: 127.0.0.1:0
    rules: [{sources: [127.0.0.0/8], units: {1: plant}, access: read-write}]
  datagrams:
    type: modbus-udp
    bind: 127.0.0.1:0
    rules: [{sources: [127.0.0.0/8], units: {1: plant}, access: read-only}]
  raw:
    type: raw-ingest
    format: crc
    compat: {crc: none}
    bind: 127.0.0.1:0
    rules: [{sources: [127.0.0.0/8], memories: [plant], areas: [coils, holding_registers]}]
audit: {file: audit.log}
"""


def audited(folder: Path, count: int) -> list[dict[str, Any]]:
    """The first lines, without what changes from run to run."""
    found = await_writes(folder / "audit.log", count)
    for line in found:
        assert line.pop("peer").startswith("127.0.0.1:")
    return found


def test_modbus_writes_are_audited_with_their_values(
    run: Run, connect: Connect, tmp_path: Path
) -> None:
    appliance = run(CONFIGURATION)
    client = connect(endpoint(appliance, "scada"))
    for pdu in (
        "0300000001",  # a read is no write
        "06000101f4",
        "0500030000",
        "050003ff00",
        "0f0000000a02cd01",
        "10000200020400070008",
        "16000400f20025",
        "1700000001000900010200ff",
        "0600ff0001",
        "10000200000400070008",
    ):
        client.ask(bytes.fromhex(pdu))
    assert client.ask(bytes.fromhex("0600010001"), unit=9)[0] == 0x86
    scada = {"listener": "scada", "unit": 1, "memory": "plant"}
    registers, coils = {"area": "holding_registers"}, {"area": "coils"}
    done = {"outcome": "done"}
    assert audited(tmp_path, 10) == [
        {**scada, "function": 6, **registers, "address": 1, "values": [500], **done},
        {**scada, "function": 5, **coils, "address": 3, "values": [0], **done},
        {**scada, "function": 5, **coils, "address": 3, "values": [1], **done},
        {
            **scada,
            "function": 15,
            **coils,
            "address": 0,
            "values": [1, 0, 1, 1, 0, 0, 1, 1, 1, 0],
            **done,
        },
        {**scada, "function": 16, **registers, "address": 2, "values": [7, 8], **done},
        {
            **scada,
            "function": 22,
            **registers,
            "address": 4,
            "and_mask": 0xF2,
            "or_mask": 0x25,
            **done,
        },
        {**scada, "function": 23, **registers, "address": 9, "values": [255], **done},
        {
            **scada,
            "function": 6,
            **registers,
            "address": 255,
            "values": [1],
            "outcome": "illegal_data_address",
        },
        {**scada, "function": 16, "pdu": "10000200000400070008", "outcome": "illegal_data_value"},
        {
            "listener": "scada",
            "unit": 9,
            "function": 6,
            **registers,
            "address": 1,
            "values": [1],
            "outcome": "gateway_target_device_failed_to_respond",
        },
    ]


def test_datagrams_and_packets_are_audited(run: Run, tmp_path: Path) -> None:
    appliance = run(CONFIGURATION)
    with socket.socket(type=socket.SOCK_DGRAM) as sender:
        sender.settimeout(wire.DEADLINE)
        sender.sendto(wire.frame(bytes.fromhex("06000101f4")), endpoint(appliance, "datagrams"))
        assert sender.recv(300)[7:] == b"\x86\x01"
    for packet in (
        "524901000300000300080002000a000b",
        "5249010001000003000000030d",
        "524901000300000300090002000a000b",
        "5249010004000003",
    ):
        with socket.create_connection(endpoint(appliance, "raw"), wire.DEADLINE) as sender:
            sender.sendall(bytes.fromhex(packet))
            sender.shutdown(socket.SHUT_WR)
            sender.recv(1)
    raw = {"listener": "raw", "function": "raw-ingest"}
    registers = {"memory_id": 3, "area": "holding_registers"}
    expected = [
        {
            "listener": "datagrams",
            "unit": 1,
            "function": 6,
            "memory": "plant",
            "area": "holding_registers",
            "address": 1,
            "values": [500],
            "outcome": "illegal_function",
        },
        {**raw, **registers, "address": 8, "values": [10, 11], "outcome": "done"},
        {
            **raw,
            "memory_id": 3,
            "area": "coils",
            "address": 0,
            "values": [1, 0, 1],
            "outcome": "done",
        },
        {**raw, **registers, "address": 9, "count": 2, "outcome": "range"},
        {**raw, "outcome": "short"},
    ]
    # The order of refused writes among those that were done is open.
    assert sorted(audited(tmp_path, 5), key=str) == sorted(expected, key=str)


def test_what_a_service_writes_is_audited_before_it_is_answered(run: Run, tmp_path: Path) -> None:
    appliance = run(CONFIGURATION)
    audit = appliance._require_running().audit.log
    assert audit is not None
    memory_access = MemoryAccess("rest", appliance.memories, audit)
    grant = Grant("gateway", ("plant",), ("coils",))
    good = {"memory": "plant", "area": "coils", "address": 1, "bools": [True, 0]}
    memory_access.write([good], grant, "127.0.0.1:9")
    assert len(writes(tmp_path / "audit.log")) == 1
    with pytest.raises(Refused):
        memory_access.write([good, good | {"bools": [2]}], grant, "127.0.0.1:9")
    rest = {"listener": "rest", "source": "gateway", "function": "write"}
    place = {"memory": "plant", "area": "coils", "address": 1}
    assert audited(tmp_path, 2) == [
        {**rest, **place, "values": [1, 0], "outcome": "done"},
        {**rest, **place, "index": 0, "value": "2", "command": 1, "outcome": "invalid_value"},
    ]


def test_a_write_of_values_that_become_stale_after_its_check_is_recorded_as_refused(
    tmp_path: Path,
) -> None:
    memory, age = holdfast.Memory(holding_registers=8), _core.MirrorAge(3600, refuses=False)
    memory.mirror([], [("holding_registers", 0, 4, age)])
    audit = Audit(tmp_path / "audit.log", max_bytes=65536, keep=1)
    memory_access = MemoryAccess("rest", {"plant": memory}, audit)
    grant = Grant("gateway", ("plant",), ("holding_registers",))
    command = {"memory": "plant", "area": "holding_registers", "address": 3, "values": [7]}
    begun = memory_access.begin(json.dumps(command).encode(), grant, "127.0.0.1:9")
    age.set(3600, refuses=True)
    with pytest.raises(Refused, match="too old"):
        memory_access.finish(begun)
    assert [line["outcome"] for line in audited(tmp_path, 1)] == ["stale"]
    age.set(3600, refuses=False)
    memory_access.write([command], grant, "127.0.0.1:9")
    assert [line["outcome"] for line in audited(tmp_path, 2)] == ["stale", "done"]


def test_a_record_is_written_without_waiting_for_a_timeout(
    run: Run, connect: Connect, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither does the stop. The thread waits longer than the test unless it is woken."""
    monkeypatch.setattr("holdfast.appliance.parts.audit.TIMEOUT_S", 2 * wire.DEADLINE)
    appliance = run(CONFIGURATION)
    client = connect(endpoint(appliance, "scada"))
    for count in range(1, 4):
        client.ask(bytes.fromhex("06000101f4"))
        assert len(await_writes(tmp_path / "audit.log", count)) == count
    stopping = threading.Thread(target=appliance.stop)
    stopping.start()
    wire.until(lambda: not stopping.is_alive(), "it has stopped")


def test_the_thread_ends_although_the_engine_has_stopped_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("holdfast.appliance.parts.audit.TIMEOUT_S", 2 * wire.DEADLINE)
    engine = _core.Engine([], identity=[(0, "a"), (1, "b"), (2, "c")], audit="open")
    engine.stop()
    assert engine.next_writes(0, 1) == []
    audit = Audit(tmp_path / "audit.log", max_bytes=65536, keep=1)
    recorder = WriteRecorder(audit, engine)
    assert engine.next_writes(0, 1) == []
    recorder.start()
    finishing = threading.Thread(target=recorder.finish)
    finishing.start()
    wire.until(lambda: not finishing.is_alive(), "it has finished")
    audit.close()


def test_start_and_stop_are_recorded_with_the_digest_of_the_configuration(
    run: Run, tmp_path: Path
) -> None:
    appliance = run(CONFIGURATION)
    appliance.stop()
    events = [line for line in lines(tmp_path / "audit.log") if line["event"] != "chain"]
    digests = {sha256(file.read_bytes()).hexdigest() for file in tmp_path.glob("*.yaml")}
    assert [line["event"] for line in events] == ["start", "stop"]
    assert {line["config_sha256"] for line in events} == digests
    assert {line["version"] for line in events} == {holdfast.__version__}
    assert verify([tmp_path / "audit.log"]).gaps is False


def test_a_start_that_fails_is_recorded_with_its_stop(run: Run, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(OSError, match="scada"):
            run(CONFIGURATION.replace("bind: 127.0.0.1:0", f"bind: 127.0.0.1:{port}", 1))
    events = [line["event"] for line in lines(tmp_path / "audit.log")]
    assert events == ["chain", "start", "stop"]


def test_writes_that_were_under_way_at_the_stop_are_audited(
    run: Run, connect: Connect, tmp_path: Path
) -> None:
    appliance = run(CONFIGURATION)
    client = connect(endpoint(appliance, "scada"))
    client.ask_many([bytes.fromhex("06000101f4")] * 5000)
    appliance.stop()
    assert len(writes(tmp_path / "audit.log")) == 5000
