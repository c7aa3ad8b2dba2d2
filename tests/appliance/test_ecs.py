"""The log as ECS documents: the fields of each event, and the documents of a running appliance."""

from __future__ import annotations

import json
import logging
import signal
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.events import ecs, ecs_categories, log_lines
from support import wire
from support.cli import RunCommand

if TYPE_CHECKING:
    from pathlib import Path


def document(event: str, **fields: object) -> Any:
    return ecs.document("2026-01-31T12:00:00.000Z", "warning", event, fields, "the line")


@pytest.mark.parametrize(
    ("peer", "source"),
    [
        ("10.0.0.9:51200", {"address": "10.0.0.9", "ip": "10.0.0.9", "port": 51200}),
        ("[fd00::9]:502", {"address": "fd00::9", "ip": "fd00::9", "port": 502}),
        ("mqtt.plant:1883", {"address": "mqtt.plant:1883"}),
    ],
)
def test_a_peer_is_the_source(peer: str, source: dict[str, object]) -> None:
    made = document("refused_source", peer=peer)
    assert made["source"] == source
    assert ("related" in made) is ("ip" in source)


def test_what_is_not_known_is_left_out() -> None:
    made = document("secured", listener="scada", peer="-", role="", who="-", reason=None)
    assert {"source", "user"} & made.keys() == set()
    assert "reason" not in made["event"]


def test_a_tls_client_has_its_certificate_and_its_role() -> None:
    made = document("secured", peer="10.0.0.9:1", role="engineer", subject="CN=e-1", serial="0a")
    assert made["user"] == {"roles": ["engineer"]}
    assert made["tls"] == {"client": {"subject": "CN=e-1", "x509": {"serial_number": "0a"}}}
    assert made["event"]["outcome"] == "success"


def test_the_subject_of_a_message_is_not_that_of_a_certificate() -> None:
    made = document("request_refused", subject="modbus.subscribe", reason="too many tags")
    assert made["holdfast"] == {"subject": "modbus.subscribe"}
    assert "tls" not in made


def test_an_unknown_token_is_a_failed_authentication_and_other_refusals_are_not() -> None:
    unknown = document("ingest_refused", reason="unauthorized", source="-")
    assert unknown["event"]["category"] == ["authentication", "api"]
    known = document("ingest_refused", reason="not_granted", source="edge")
    assert known["event"]["category"] == ["api"]
    assert known["user"] == {"name": "edge"}


@pytest.mark.parametrize(
    ("outcome", "told"),
    [
        ("done", "success"),
        ("sent", "success"),
        ("exception 02", "failure"),
        ("exception 05", "unknown"),
        ("exception 0B", "unknown"),
        ("refused", "failure"),
        ("not sent", "failure"),
        ("failed", "unknown"),
    ],
)
def test_a_write_of_the_gateway_has_the_outcome_that_the_device_gave_it(
    outcome: str, told: str
) -> None:
    assert document("gateway_write", outcome=outcome)["event"]["outcome"] == told


@pytest.mark.parametrize(
    ("event", "fields", "kind", "told"),
    [
        ("request_refused", {}, "denied", "failure"),
        ("request_refused", {"outcome": "not_confirmed"}, "change", "unknown"),
        ("ingest_refused", {"reason": "not_confirmed"}, "change", "unknown"),
        ("ingest_refused", {"reason": "internal_error"}, "change", "unknown"),
        ("ingest_refused", {"outcome": "exception 0B"}, "change", "unknown"),
        ("ingest_refused", {"outcome": "exception 0A"}, "denied", "failure"),
    ],
)
def test_what_may_have_been_carried_out_was_not_denied(
    event: str, fields: dict[str, str], kind: str, told: str
) -> None:
    made = document(event, **fields)["event"]
    assert (made["type"], made["outcome"]) == ([kind], told)


def test_a_field_has_one_type_in_all_documents() -> None:
    # The address of an item, of a listener, and what a client sent as one.
    for address in (7, "127.0.0.1:502", [1]):
        made = document("ingest_refused", address=address, count=3)
        assert made["holdfast"] == {"address": str(address), "count": 3}


def test_other_events_are_in_another_dataset_and_have_no_category() -> None:
    made = document("device_health", device="pump")
    assert made["event"] == {
        "kind": "event",
        "module": "holdfast",
        "dataset": "holdfast.log",
        "action": "device_health",
    }
    assert "device_health" not in ecs_categories.EVENTS


def test_an_exception_is_an_error_message() -> None:
    try:
        raise OSError("no space left")
    except OSError as error:
        info = (OSError, error, None)
    record = logging.LogRecord("holdfast", logging.ERROR, "", 0, "audit_failed", (), info)
    record.fields = {"file": "/var/log/audit.log"}
    made = json.loads(log_lines.LineFormatter("ecs").format(record))
    assert made["error"] == {"message": "OSError: no space left"}
    assert made["file"] == {"path": "/var/log/audit.log"}
    assert made["event"]["outcome"] == "failure"


CONFIGURATION = """
memories: {plant: {holding_registers: 100}}
listeners:
  scada:
    type: modbus-tcp
    bind: 127.0.0.1:0
    rules:
      - {sources: [127.0.0.0/8], units: {1: plant}, access: read-only}
      - {sources: [127.0.0.0/8], units: {1: plant}, access: read-only}
log: {format: ecs}
"""


def test_the_log_of_an_appliance_has_one_document_for_each_event(tmp_path: Path) -> None:
    file = tmp_path / "plant.yaml"
    file.write_text(CONFIGURATION)
    command = RunCommand(file)
    try:
        address = command.wait_until_it_serves()
        with wire.Connection(address) as client:
            assert client.ask(bytes.fromhex("0600070001")) == b"\x86\x01"
            code, log = command.end(signal.SIGTERM)
    finally:
        command.process.kill()
        command.process.communicate()
    assert code == 0
    documents = {line["event"]["action"]: line for line in map(json.loads, log.splitlines())}
    assert list(documents) == [
        "config_warning",
        "started",
        "listening",
        "refused_function",
        "stopped",
    ]
    assert "plant.yaml:9: " in documents["config_warning"]["holdfast"]["warning"]
    refused = documents["refused_function"]
    assert refused["destination"] == {"port": address[1]}
    assert refused["source"]["ip"] == "127.0.0.1"
    assert refused["holdfast"] == {"listener": "scada", "unit": 1, "function": 6}
    assert refused["event"]["dataset"] == "holdfast.security"
    assert len(documents["started"]["file"]["hash"]["sha256"]) == 64
