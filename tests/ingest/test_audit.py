"""The audit log: a line for every write, done or refused, by whichever way it came."""

from __future__ import annotations

import errno
import json
import os
import socket
import stat
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.ingest import Grant, MemoryAccess, Refused
from holdfast.ingest.audit import Audit
from support import wire
from support.running import endpoint

if TYPE_CHECKING:
    from pathlib import Path

    from holdfast.appliance import Appliance
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
    crc: none
    bind: 127.0.0.1:0
    rules: [{sources: [127.0.0.0/8], memories: [plant], areas: [coils, holding_registers]}]
audit: {file: audit.log}
"""


def lines(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "audit.log").read_text().splitlines()]


def audited(appliance: Appliance, folder: Path, count: int) -> list[dict[str, Any]]:
    """The first lines, without what changes from run to run."""
    wire.until(lambda: appliance.diagnostics.stats()["audit"]["lines"] >= count, "all are audited")
    found = lines(folder)
    for line in found:
        assert line.pop("time").endswith("Z")
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
    scada = {"listener": "scada", "unit": 1}
    registers, coils = {"area": "holding_registers"}, {"area": "coils"}
    done = {"outcome": "done"}
    assert audited(appliance, tmp_path, 10) == [
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
        {**scada, "function": 16, "outcome": "illegal_data_value"},
        {
            **scada,
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
    assert audited(appliance, tmp_path, 5) == [
        {
            "listener": "datagrams",
            "unit": 1,
            "function": 6,
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


def test_what_comes_by_a_door_is_audited_before_it_is_answered(run: Run, tmp_path: Path) -> None:
    appliance = run(CONFIGURATION)
    audit = appliance.diagnostics.audit
    assert audit is not None
    memory_access = MemoryAccess("rest", appliance.memories, audit)
    grant = Grant("gateway", ("plant",), ("coils",))
    good = {"memory": "plant", "area": "coils", "address": 1, "bools": [True, 0]}
    memory_access.write([good], grant, "127.0.0.1:9")
    assert len(lines(tmp_path)) == 1
    with pytest.raises(Refused):
        memory_access.write([good, good | {"bools": [2]}], grant, "127.0.0.1:9")
    rest = {"listener": "rest", "source": "gateway", "function": "write"}
    place = {"memory": "plant", "area": "coils", "address": 1}
    assert audited(appliance, tmp_path, 2) == [
        {**rest, **place, "values": [1, 0], "outcome": "done"},
        {**rest, **place, "index": 0, "value": "2", "command": 1, "outcome": "invalid_value"},
    ]


def test_writes_that_were_under_way_at_the_stop_are_audited(
    run: Run, connect: Connect, tmp_path: Path
) -> None:
    appliance = run(CONFIGURATION)
    client = connect(endpoint(appliance, "scada"))
    client.ask_many([bytes.fromhex("06000101f4")] * 5000)
    appliance.stop()
    assert len(lines(tmp_path)) == 5000


def test_an_old_file_is_put_aside_and_none_is_lost(tmp_path: Path) -> None:
    audit = Audit(tmp_path / "audit.log", max_bytes=65536, keep=2)
    for number in range(3000):
        audit.write(number=number)
    audit.close()
    assert audit.counts() == {"lines": 3000, "failed": 0}
    files = sorted(tmp_path.iterdir(), reverse=True)
    assert [file.name for file in files] == ["audit.log.2", "audit.log.1", "audit.log"]
    kept = [json.loads(line)["number"] for file in files for line in file.read_text().splitlines()]
    assert kept == list(range(3000))
    assert all(file.stat().st_size <= 65536 for file in files)


def test_lines_that_could_not_be_written_are_counted_and_leave_a_mark(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    audit = Audit(tmp_path / "audit.log", max_bytes=65536, keep=1)
    audit.write(number=1)
    write, room = os.write, 10

    def written(descriptor: int, data: bytes) -> int:
        nonlocal room
        if room == 0:
            raise OSError(errno.ENOSPC, "no space left on device")
        data, room = data[:room], 0
        return write(descriptor, data)

    with monkeypatch.context() as full:
        full.setattr(os, "write", written)
        audit.write_all([{"number": 2}, {"number": 3}])
        audit.write(number=4)
        assert [line["number"] for line in lines(tmp_path)] == [1]
    audit.write(number=5)
    audit.write(number=6)
    audit.close()
    assert audit.counts() == {"lines": 3, "failed": 3}
    assert "audit_failed" in caplog.messages
    found = [{**line, "time": ""} for line in lines(tmp_path)]
    kept: list[dict[str, Any]] = [{"number": 1}, {"lost": 3}, {"number": 5}, {"number": 6}]
    assert found == [{"time": "", **each} for each in kept]


def test_a_file_that_can_not_be_renamed_goes_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "audit.log.1" / "in the way").mkdir(parents=True)
    audit = Audit(tmp_path / "audit.log", max_bytes=65536, keep=1)
    audit.write_all([{"number": number} for number in range(3000)])
    audit.close()
    assert audit.counts() == {"lines": 3000, "failed": 0}
    assert "audit_not_rotated" in caplog.messages
    assert [line["number"] for line in lines(tmp_path)] == list(range(3000))


def test_a_file_that_was_renamed_by_others_is_created_anew(tmp_path: Path) -> None:
    audit = Audit(tmp_path / "audit.log", max_bytes=65536, keep=1)
    audit.write(number=1)
    (tmp_path / "audit.log").rename(tmp_path / "audit-2026-11-22.log")
    audit.write(number=2)
    audit.close()
    assert [line["number"] for line in lines(tmp_path)] == [2]
    assert stat.S_IMODE((tmp_path / "audit.log").stat().st_mode) & ~0o640 == 0
