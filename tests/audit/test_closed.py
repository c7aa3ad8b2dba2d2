"""`audit.fail: closed`: what can't be recorded is refused."""

from __future__ import annotations

import json
import logging
import socket
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.events.audit import Audit, Unrecorded, verify
from holdfast.ingest import Grant, MemoryAccess, Refused
from support import routed, wire
from support.audits import await_writes, full, lines, writes
from support.fake_device import Stream
from support.running import endpoint

if TYPE_CHECKING:
    from collections.abc import Callable
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
    rules: [{sources: [127.0.0.0/8], units: {1: plant}, access: read-write}]
  raw:
    type: raw-ingest
    format: crc
    compat: {crc: none}
    bind: 127.0.0.1:0
    rules: [{sources: [127.0.0.0/8], memories: [plant], areas: [coils, holding_registers]}]
"""
CLOSED = "audit: {file: audit.log, fail: closed}\n"
FULL = "audit: {file: /dev/full, fail: %s}\n"

WRITE = bytes.fromhex("06000101f4")
READ = bytes.fromhex("0300010001")
WRITES = [
    "06000101f4",
    "050003ff00",
    "0f0000000a02cd01",
    "10000200020400070008",
    "16000400f20025",
    "1700000001000900010200ff",
]
FAILED = 0x04

GRANT = Grant("gateway", ("plant",), ("coils", "holding_registers"))
COMMAND: dict[str, Any] = {
    "memory": "plant",
    "area": "holding_registers",
    "address": 1,
    "values": [500],
}


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("holdfast.appliance.parts.audit.RETRY_S", 0.01)


def contents(appliance: Appliance) -> list[int]:
    memory = appliance.memories["plant"]
    return [*memory.read("holding_registers", 0, 10), *memory.read("coils", 0, 16)]


def audit_of(appliance: Appliance) -> Audit:
    audit = appliance._require_running().audit.log
    assert audit is not None
    return audit


def failing(appliance: Appliance, *, is_so: bool = True) -> None:
    wire.until(lambda: audit_of(appliance).failing == is_so, f"failing: {is_so}")


# Modbus and Raw Ingest


@pytest.mark.parametrize("pdu", WRITES)
def test_modbus_writes_are_refused_while_the_disk_is_full(
    run: Run, connect: Connect, pdu: str
) -> None:
    appliance = run(CONFIGURATION + FULL % "closed")
    client = connect(endpoint(appliance, "scada"))
    request = bytes.fromhex(pdu)
    assert client.ask(request) == bytes([request[0] | 0x80, FAILED])
    assert client.ask(READ) == bytes.fromhex("03020000")
    with socket.socket(type=socket.SOCK_DGRAM) as sender:
        sender.settimeout(wire.DEADLINE)
        sender.sendto(wire.frame(request), endpoint(appliance, "datagrams"))
        assert sender.recv(300)[7:] == bytes([request[0] | 0x80, FAILED])
    assert not any(contents(appliance))


def test_by_default_writes_are_carried_out_while_the_disk_is_full(
    run: Run, connect: Connect
) -> None:
    appliance = run(CONFIGURATION + FULL % "open")
    client = connect(endpoint(appliance, "scada"))
    failing(appliance)
    for pdu in WRITES:
        assert client.ask(bytes.fromhex(pdu))[0] < 0x80
    assert MemoryAccess("rest", appliance.memories, audit_of(appliance)).write(
        [COMMAND], GRANT, "127.0.0.1:9"
    )


def test_other_refusals_go_first(run: Run, connect: Connect) -> None:
    """A peer without rights does not learn about the log."""
    rules = CONFIGURATION.replace("access: read-write", "access: read-only", 1)
    client = connect(endpoint(run(rules + FULL % "closed"), "scada"))
    assert client.ask(WRITE) == b"\x86\x01"
    assert client.ask(WRITE, unit=9) == b"\x86\x01"


@pytest.mark.parametrize("keep", ["", ", keep: {file: plant.keep, sync: 0}"])
def test_a_malformed_write_is_refused_as_such(run: Run, connect: Connect, keep: str) -> None:
    memory = f"holding_registers: 10{keep}}}"
    appliance = run(CONFIGURATION.replace("holding_registers: 10}", memory) + FULL % "closed")
    client = connect(endpoint(appliance, "scada"))
    assert client.ask(WRITE) == bytes([0x86, FAILED])
    assert client.ask(bytes.fromhex("1000010002030007")) == b"\x90\x03"


def test_packets_are_refused_while_the_disk_is_full(run: Run) -> None:
    appliance = run(CONFIGURATION + FULL % "closed")
    for _ in range(2):
        with socket.create_connection(endpoint(appliance, "raw"), wire.DEADLINE) as sender:
            sender.sendall(bytes.fromhex("524901000300000300080002000a000b"))
            assert sender.recv(1) == b"\x01"
    refused = appliance.diagnostics.stats()["listeners"]["raw"]["packets"]["refused"]
    assert refused == {"unrecorded": 2}
    assert not any(contents(appliance))


def test_no_record_of_a_write_is_lost_when_the_disk_becomes_full(
    run: Run, connect: Connect, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A write that was carried out before the log failed is recorded when there is room."""
    log = tmp_path / "audit.log"
    appliance = run(CONFIGURATION + CLOSED)
    client = connect(endpoint(appliance, "scada"))
    make_room = full(monkeypatch)
    assert client.ask(WRITE) == WRITE
    failing(appliance)
    assert client.ask(WRITE) == bytes([0x86, FAILED])
    assert writes(log) == []
    make_room()
    failing(appliance, is_so=False)
    assert client.ask(WRITE) == WRITE
    outcomes = [line["outcome"] for line in await_writes(log, 3)]
    assert outcomes == ["done", "server_device_failure", "done"]
    appliance.stop()
    findings = verify([log])
    assert (findings.error, findings.gaps) == (None, False)


def test_what_is_passed_on_is_refused_while_the_disk_is_full(run: Run, connect: Connect) -> None:
    with Stream("tcp") as to:
        appliance = run(routed.configuration(to.url, audit={"file": "/dev/full", "fail": "closed"}))
        client = connect(endpoint(appliance, "scada"))
        assert client.ask(WRITE) == bytes([0x86, FAILED])
        assert client.ask(bytes.fromhex("4101")) == b"\xc1\x01"
        assert client.ask(READ)[0] == 3
        assert [asked.pdu for asked in to.requests] == [READ]


# REST, MQTT and adapters


@pytest.fixture
def access(run: Run) -> Callable[[str], tuple[Appliance, MemoryAccess]]:
    def started(audit: str) -> tuple[Appliance, MemoryAccess]:
        appliance = run(CONFIGURATION + audit)
        return appliance, MemoryAccess("rest", appliance.memories, audit_of(appliance))

    return started


def refusal(access: MemoryAccess, *commands: dict[str, Any]) -> Refused:
    with pytest.raises(Refused) as caught:
        access.write(commands, GRANT, "127.0.0.1:9")
    return caught.value


def test_the_first_write_that_does_not_fit_is_refused_and_changes_nothing(
    access: Callable[[str], tuple[Appliance, MemoryAccess]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    appliance, rest = access(CLOSED)
    make_room = full(monkeypatch)
    body = json.dumps(COMMAND).encode()
    with pytest.raises(Refused) as caught:
        rest.ingest(body, GRANT, "127.0.0.1:9")
    assert caught.value.reason == "unrecorded"
    assert caught.value.where == {"memory": "plant", "area": "holding_registers", "address": 1}
    assert refusal(rest, COMMAND, COMMAND | {"address": 2}).reason == "unrecorded"
    assert not any(contents(appliance))
    make_room()
    failing(appliance, is_so=False)
    rest.write([COMMAND], GRANT, "127.0.0.1:9")
    assert contents(appliance)[1] == 500
    appliance.stop()
    log = tmp_path / "audit.log"
    outcomes = [line.get("lost", line.get("outcome")) for line in writes(log)]
    assert outcomes == ["unrecorded", "unrecorded", "done"]
    findings = verify([log])
    assert (findings.error, findings.gaps) == (None, False)


def test_the_record_of_a_write_that_failed_halfway_waits_for_room(
    access: Callable[[str], tuple[Appliance, MemoryAccess]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    _, rest = access(CLOSED)
    make_room = full(monkeypatch)
    rest.refuse(Refused("internal_error", "see the log"), "gateway", "127.0.0.1:9")
    make_room()
    [line] = await_writes(tmp_path / "audit.log", 1)
    assert line["outcome"] == "internal_error"


def test_writes_that_are_refused_anyway_are_not_recorded_as_done(
    access: Callable[[str], tuple[Appliance, MemoryAccess]], tmp_path: Path
) -> None:
    _, rest = access(CLOSED)
    wrong: list[tuple[dict[str, Any], str]] = [
        ({"address": 10}, "out_of_range"),
        ({"values": [65536]}, "invalid_value"),
        ({"values": ["1"]}, "invalid_value"),
        ({"values": []}, "malformed"),
        ({"area": "input_registers"}, "not_granted"),
    ]
    for change, reason in wrong:
        assert refusal(rest, COMMAND, COMMAND | change).reason == reason
    outcomes = [line["outcome"] for line in writes(tmp_path / "audit.log")]
    assert outcomes == [reason for _, reason in wrong]


def test_a_batch_is_recorded_whole_or_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where it does not fit into the file, which is put aside first."""
    log = tmp_path / "audit.log"
    audit = Audit(log, max_bytes=2000, keep=5, fail_closed=True)
    for _ in range(4):
        audit.write_group(audit.queue([{"number": number} for number in range(8)]))
    assert len(list(tmp_path.iterdir())) == 4
    make_room = full(monkeypatch, room=1000)
    with pytest.raises(Unrecorded):
        audit.write_group(audit.queue([{"number": number} for number in range(8)]))
    make_room()
    audit.close()
    files = list(tmp_path.iterdir())
    assert sum(len(writes(file)) for file in files) == 32
    assert verify(files).error is None


@pytest.mark.parametrize("has_room", [True, False])
def test_writes_that_begin_together_are_recorded_before_the_first_is_carried_out(
    access: Callable[[str], tuple[Appliance, MemoryAccess]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    has_room: bool,
) -> None:
    appliance, rest = access(CLOSED)
    log, commands = tmp_path / "audit.log", [COMMAND, COMMAND | {"address": 2}]
    begun = [rest.begin(json.dumps(each).encode(), GRANT, "127.0.0.1:9") for each in commands]
    assert (writes(log), any(contents(appliance))) == ([], False)
    if has_room:
        rest.finish(begun[0])
        assert [line["address"] for line in writes(log)] == [1, 2]
        assert contents(appliance)[1:3] == [500, 0]
        rest.finish(begun[1])
        assert len(writes(log)) == 2
        assert contents(appliance)[1:3] == [500, 500]
        return
    full(monkeypatch, room=200)
    for each in begun:
        with pytest.raises(Refused) as caught:
            rest.finish(each)
        assert caught.value.reason == "unrecorded"
    assert not any(contents(appliance))


def test_a_full_disk_at_the_stop_is_reported(
    run: Run, connect: Connect, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    appliance = run(CONFIGURATION + CLOSED)
    client = connect(endpoint(appliance, "scada"))
    full(monkeypatch, room=0)
    assert client.ask(WRITE) == WRITE
    failing(appliance)
    audit = audit_of(appliance)
    appliance.stop()
    assert audit.counts()["failed"] == 2
    assert [line["event"] for line in lines(tmp_path / "audit.log")] == ["chain", "start"]


def test_a_file_that_is_full_does_not_seem_to_work_before_it_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    log = tmp_path / "audit.log"
    audit = Audit(log, max_bytes=10_000, keep=1, fail_closed=True)
    make_room = full(monkeypatch)
    with pytest.raises(Unrecorded):
        audit.write_group(audit.queue([{"number": 1}]))
    for _ in range(3):
        audit.retry()
        with pytest.raises(Unrecorded):
            audit.require()
    assert audit.failing
    assert [record.message for record in caplog.records] == ["audit_failed"]
    make_room()
    audit.require()
    assert not audit.failing
    audit.write_group(audit.queue([{"number": 2}]))
    audit.close()
    assert writes(log) == [{"lost": 0}, {"number": 2}]
    assert verify([log]).lost == 0


@pytest.mark.parametrize("fail_closed", [False, True])
def test_what_can_not_be_written_until_the_end_is_logged(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    fail_closed: bool,
) -> None:
    audit = Audit(tmp_path / "a", max_bytes=10_000, keep=1, fail_closed=fail_closed)
    make_room = full(monkeypatch, room=0)
    for number in range(3):
        audit.write(number=number)
    audit.close()
    make_room()
    audit.close()
    failed, lost = caplog.records
    assert (failed.message, lost.message) == ("audit_failed", "audit_lost")
    assert vars(lost)["fields"] == {"count": 3}


def test_a_file_that_can_not_be_opened_is_named_with_its_setting(run: Run, tmp_path: Path) -> None:
    file = tmp_path / "audit.log"
    audit = Audit(file, max_bytes=65536, keep=1)
    with pytest.raises(OSError, match=f"^audit.file: {file}: another process writes this audit"):
        run(CONFIGURATION + CLOSED)
    audit.close()
