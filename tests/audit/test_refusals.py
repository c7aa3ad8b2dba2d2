"""Refusals in the log and in the audit log, of noisy sources and of others."""

from __future__ import annotations

import socket
from collections import Counter
from contextlib import closing
from hashlib import sha256
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.events import log_lines
from holdfast.events.audit.refusal_summaries import MAX_ORIGINS, WHOLE_WRITES, Refusals
from holdfast.events.throttle import NOBODY, Throttle, origin
from support import web, wire
from support.audits import lines, writes
from support.certificates import Certificates
from support.config_folder import written
from support.running import endpoint
from support.tls_peer import context, reasons, verdict

if TYPE_CHECKING:
    from pathlib import Path

    from support.running import Run

NOISY, QUIET = "127.0.0.2", "127.0.0.3"
NOISE = 200


@pytest.fixture(autouse=True)
def fresh(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log_lines, "_REFUSALS", Throttle())
    monkeypatch.setattr("holdfast.appliance.appliance.CHECK_INTERVAL_S", 0.0)


def configured(**more: Any) -> str:
    rule = {"sources": ["127.0.0.1"], "units": {1: "plant"}, "access": "read-only"}
    scada = {"type": "modbus-tcp", "bind": "127.0.0.1:0", "rules": [rule]}
    whole = {
        "memories": {"plant": {"holding_registers": 8}},
        "listeners": {"scada": scada},
        "audit": {"file": "audit.log"},
    }
    return written({**whole, **more})


def refused(folder: Path) -> list[dict[str, Any]]:
    """The refusals in the audit log, without the port of their peer, and their place."""
    apart = ("start", "stop", "chain")
    found = [line for line in lines(folder / "audit.log") if line.get("event", "stop") not in apart]
    for line in found:
        for key in ("time", "seq", "prev", "serial"):
            line.pop(key, None)
        line["peer"] = str(origin("", line).source)
    return found


def test_a_noisy_source_hides_nobody(
    run: Run, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    appliance = run(configured())
    address = endpoint(appliance, "scada")
    for source in [NOISY] * NOISE + [QUIET]:
        with wire.Connection(address, source=source) as client:
            assert client.rest() == b""
    appliance.stop()

    logged = Counter(
        origin("", record.fields).source  # type: ignore[attr-defined]
        for record in caplog.records
        if record.message == "refused_source"
    )
    assert logged == {NOISY: 20, QUIET: 1}
    found = refused(tmp_path)
    common = {"event": "refused_source", "listener": "scada"}
    assert found == [
        {**common, "peer": NOISY, "count": 1},
        {**common, "peer": QUIET, "count": 1},
        {**common, "peer": NOISY, "count": NOISE - 1},
    ]


def test_failed_handshakes_are_recorded_by_subject(
    run: Run, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    own, stranger = Certificates(tmp_path, "own"), Certificates(tmp_path, "stranger")
    server = own.issue("server", "DNS:localhost")
    clients = [stranger.issue(name, "DNS:client") for name in ("a", "b")]
    tls = {"cert_file": server.certificate, "key_file": server.key, "ca_file": own.ca}
    rule = {"sources": ["127.0.0.1"], "units": {1: "plant"}, "access": "read-only"}
    secure = {
        "type": "modbus-tls",
        "bind": "127.0.0.1:0",
        "tls": {key: str(file) for key, file in tls.items()},
        "rules": [rule],
    }
    appliance = run(configured(listeners={"secure": secure}))
    for client in (clients[0], clients[1], clients[0]):
        assert "ALERT" in verdict(appliance, context(own.ca, client))
    assert reasons(appliance, caplog, 3) == ["unknown_issuer"] * 3
    appliance.stop()
    common = {
        "event": "tls_failed",
        "listener": "secure",
        "peer": "127.0.0.1",
        "reason": "unknown_issuer",
    }
    assert refused(tmp_path) == [
        {**common, "subject": "CN=a", "count": 1},
        {**common, "subject": "CN=b", "count": 1},
        {**common, "subject": "CN=a", "count": 1},
    ]


def test_requests_without_the_right_are_recorded(run: Run, tmp_path: Path) -> None:
    rest = {
        "bind": "127.0.0.1:0",
        "sources": ["127.0.0.1"],
        "tokens": [
            {
                "name": "panel",
                "sha256": "0" * 64,
                "memories": ["plant"],
                "areas": ["holding_registers"],
                "access": "read-only",
            }
        ],
    }
    appliance = run(configured(rest=rest))
    reading = "/api/v1/memory/read?memory=plant&area=holding_registers&address=0&count=1"
    with closing(web.Client(endpoint(appliance, "rest"))) as client:
        for _ in range(3):
            assert client.get(reading).status == 401
            assert client.ingest([web.command("holding_registers", 0, [7])]).status == 401
    # The first refused writes have lines of their own, and are not counted.
    with wire.Connection(endpoint(appliance, "scada")) as client:
        assert client.ask(bytes.fromhex("0600000001")) == bytes.fromhex("8601")
        assert client.ask(bytes.fromhex("03ff000001")) == bytes.fromhex("8302")
    appliance.stop()
    assert [line["outcome"] for line in writes(tmp_path / "audit.log")] == ["illegal_function"]
    common = {"event": "ingest_refused", "adapter": "rest", "peer": "127.0.0.1"}
    found = refused(tmp_path)
    of_rest = [line for line in found if line["event"] == "ingest_refused"]
    assert [line["count"] for line in of_rest] == [1, 5]
    assert all(line | common == line and line["reason"] == "unauthorized" for line in of_rest)
    assert [line for line in found if line not in of_rest] == [
        {
            "event": "refused_address",
            "listener": "scada",
            "peer": "127.0.0.1",
            "unit": 1,
            "function": 3,
            "count": 1,
        }
    ]


@pytest.mark.parametrize("way", ["modbus", "packets", "rest"])
def test_refused_writes_neither_fill_the_log_nor_refuse_others(
    run: Run, tmp_path: Path, way: str
) -> None:
    reader = {"sources": ["127.0.0.1"], "units": {1: "plant"}, "access": "read-only"}
    writer = {**reader, "sources": [QUIET], "access": "read-write"}
    raw = {"sources": ["127.0.0.1"], "units": {1: "plant"}, "areas": ["coils"]}
    token = {"name": "panel", "sha256": sha256(b"secret").hexdigest(), "memories": ["plant"]}
    access = {"areas": ["holding_registers"], "access": "read-only"}
    at = {"bind": "127.0.0.1:0"}
    appliance = run(
        configured(
            listeners={
                "scada": {"type": "modbus-tcp", **at, "rules": [reader, writer]},
                "raw": {"type": "raw-ingest", "format": "v1", **at, "rules": [raw]},
            },
            rest={**at, "sources": ["127.0.0.1"], "tokens": [{**token, **access}]},
            audit={"file": "audit.log", "fail": "closed"},
        )
    )
    count = WHOLE_WRITES + 5
    command = {**web.command("holding_registers", 0, [7]), "memory": "plant"}
    if way == "modbus":
        with wire.Connection(endpoint(appliance, "scada")) as client:
            for _ in range(count):
                assert client.ask(bytes.fromhex("0600000001")) == bytes.fromhex("8601")
    elif way == "packets":
        for _ in range(count):
            with socket.create_connection(endpoint(appliance, "raw"), wire.DEADLINE) as sender:
                sender.sendall(bytes.fromhex("5249010300010000000100070000"))
                assert sender.recv(1) == b"\x01"
    else:
        with closing(web.Client(endpoint(appliance, "rest"), "secret")) as client:
            for _ in range(count):
                assert client.ingest(command).status == 403
    with wire.Connection(endpoint(appliance, "scada"), source=QUIET) as other:
        assert other.ask(bytes.fromhex("0600000001")) == bytes.fromhex("0600000001")
    appliance.stop()
    outcomes = Counter(line["outcome"] for line in writes(tmp_path / "audit.log"))
    assert outcomes.pop("done") == 1
    [outcome] = outcomes
    assert outcomes[outcome] == WHOLE_WRITES
    [found] = [line for line in refused(tmp_path) if line["event"] == "refused_write"]
    listener = {"modbus": "scada", "packets": "raw", "rest": "rest"}[way]
    common = {"event": "refused_write", "listener": listener, "outcome": outcome}
    assert {**common, "peer": "127.0.0.1", "count": 5}.items() <= found.items()


def test_refused_writes_of_many_sources_are_counted() -> None:
    refusals = Refusals(interval=3600)

    def write(number: int) -> dict[str, object]:
        return {"listener": "scada", "peer": f"10.0.0.{number}:1", "outcome": "illegal_function"}

    assert all(refusals.has_line(write(1)) for _ in range(WHOLE_WRITES))
    assert not refusals.has_line(write(1), 7)
    assert refusals.has_line(write(2), 3)
    refusals.note_others(9)
    common = {"event": "refused_write", "listener": "scada", "outcome": "illegal_function"}
    others = {"event": "refused_write", "peer": "others"}
    assert refusals.take() == [{**others, "count": 1}]
    assert refusals.rest() == [
        {**others, "count": 8},
        {**common, "peer": "10.0.0.1", "count": 7},
        {**common, "peer": "10.0.0.2", "count": 2},
    ]


def test_an_attacker_can_not_fill_the_audit_log() -> None:
    refusals = Refusals(interval=3600)

    def attacked() -> list[dict[str, object]]:
        for number in range(2_000):
            fields = {"listener": "scada", "peer": f"[2001:db8:0:{number:x}::1]:1"}
            refusals.note("refused_source", fields, origin("refused_source", fields))
        return refusals.take()

    assert len(attacked()) == MAX_ORIGINS + 1
    assert attacked() == []
    rest = refusals.rest()
    assert len(rest) == MAX_ORIGINS + 1
    assert rest[-1] == {
        "event": "refused_source",
        "listener": "scada",
        "peer": "others",
        "count": 2 * (2_000 - MAX_ORIGINS) - 1,
    }


def test_a_source_with_many_subjects_leaves_room_for_others() -> None:
    refusals = Refusals(interval=3600)

    def fields(number: int) -> dict[str, object]:
        return {"listener": "scada", "peer": "10.0.0.9:1", "subject": f"CN={number}"}

    for number in range(100):
        found = fields(number)
        refusals.note("tls_failed", found, origin("tls_failed", found))
    expected = [{"event": "tls_failed", **fields(number), "count": 1} for number in range(17)]
    assert refusals.take() == expected  # The last one stands for all others.
    assert [(line["subject"], line["count"]) for line in refusals.rest()] == [("others", 83)]


def test_other_events_are_not_recorded() -> None:
    refusals = Refusals()
    for event in ("secured", "slow_reader", "packet_refused", "ingest_refused"):
        refusals.note(event, {"reason": "malformed"}, NOBODY)
    refusals.note("refused_unit", {"function": 6}, NOBODY)
    assert refusals.rest() == []
