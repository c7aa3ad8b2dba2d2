"""A sealed memory: busy to Modbus until the gate bit is set, by each way that may set it."""

from __future__ import annotations

import hashlib
import http.client
import json
import logging
import socket
from typing import TYPE_CHECKING

import pytest

from support import wire
from support.running import endpoint

if TYPE_CHECKING:
    from holdfast.appliance import Appliance
    from support.running import Connect, Run

CONFIGURATION = """
memories:
  plant:
    id: 5
    coils: 16
    discrete_inputs: 16
    holding_registers: 10
    seal: {{area: discrete_inputs, address: 9, mode: {mode}}}
  open: {{holding_registers: 10}}
listeners:
  scada:
    type: modbus-tcp
    bind: 127.0.0.1:0
    rules: [{{sources: [127.0.0.0/8], units: {{1: plant, 2: open}}, access: read-write}}]
  raw:
    type: raw-ingest
    bind: 127.0.0.1:0
    rules:
      - {{sources: [127.0.0.0/8], units: {{1: plant}}, areas: [discrete_inputs, holding_registers]}}
  raw-crc:
    type: raw-ingest
    format: crc
    compat: {{crc: none}}
    bind: 127.0.0.1:0
    rules: [{{sources: [127.0.0.0/8], memories: [plant], areas: [discrete_inputs]}}]
rest:
  bind: 127.0.0.1:0
  sources: [127.0.0.0/8]
  tokens: none
"""

READ = bytes.fromhex("0300000002")
BUSY = bytes.fromhex("8306")
VALUES = bytes.fromhex("030400000000")


def by_raw(appliance: Appliance, bit: int, listener: str = "raw") -> None:
    packet = {
        "raw": f"52490102000100090001{bit:02x}",
        "raw-crc": f"524901000200000500090001{bit:02x}",
    }
    with socket.create_connection(endpoint(appliance, listener), wire.DEADLINE) as sender:
        sender.sendall(bytes.fromhex(packet[listener]))
        assert sender.recv(1) == b"\0"


def by_raw_crc(appliance: Appliance, bit: int) -> None:
    by_raw(appliance, bit, "raw-crc")


def post(appliance: Appliance, body: object, token: str = "") -> int:
    client = http.client.HTTPConnection(*endpoint(appliance, "rest"), timeout=wire.DEADLINE)
    try:
        headers = {"Content-Type": "application/json", "Authorization": f"Bearer {token}"}
        client.request("POST", "/api/v1/ingest", json.dumps(body), headers)
        return client.getresponse().status
    finally:
        client.close()


def by_rest(appliance: Appliance, bit: int) -> None:
    command = {"memory": "plant", "area": "discrete_inputs", "address": 9, "values": [bit]}
    assert post(appliance, command) == 200


def by_python(appliance: Appliance, bit: int) -> None:
    appliance.memories["plant"].write("discrete_inputs", 9, [bit])


WAYS = pytest.mark.parametrize("open_by", [by_raw, by_raw_crc, by_rest, by_python])


@WAYS
def test_the_gate_bit_opens_a_memory_for_good(run: Run, connect: Connect, open_by: object) -> None:
    assert callable(open_by)
    appliance = run(CONFIGURATION.format(mode="once"))
    client = connect(endpoint(appliance, "scada"))
    assert client.ask(READ) == BUSY
    assert client.ask(READ, unit=2) == VALUES
    open_by(appliance, 0)
    assert client.ask(READ) == BUSY
    open_by(appliance, 1)
    assert client.ask(READ) == VALUES
    open_by(appliance, 0)
    assert client.ask(READ) == VALUES
    memory = appliance.diagnostics.memories()["plant"]
    assert (memory["sealed"], memory["opened"], memory["closed"]) == (False, 1, 0)


@WAYS
def test_in_level_mode_the_bit_opens_and_closes(
    run: Run, connect: Connect, open_by: object
) -> None:
    assert callable(open_by)
    appliance = run(CONFIGURATION.format(mode="level"))
    client = connect(endpoint(appliance, "scada"))
    for bit in (1, 0, 1, 1, 0):
        open_by(appliance, bit)
        assert client.ask(READ) == (VALUES if bit else BUSY)
    memory = appliance.diagnostics.memories()["plant"]
    assert (memory["sealed"], memory["opened"], memory["closed"]) == (True, 2, 2)


def test_a_refused_ingest_leaves_a_memory_sealed(run: Run, connect: Connect) -> None:
    appliance = run(CONFIGURATION.format(mode="once"))
    client = connect(endpoint(appliance, "scada"))
    gate = {"memory": "plant", "area": "discrete_inputs", "address": 9, "values": [1]}
    assert post(appliance, [gate, gate | {"values": [2]}]) == 400
    assert post(appliance, [gate, {**gate, "memory": "open", "area": "coils"}]) == 400
    # The gate is judged as the whole of a batch leaves it.
    assert post(appliance, [gate, gate | {"values": [0]}]) == 200
    assert client.ask(READ) == BUSY
    assert post(appliance, [gate | {"values": [0]}, gate]) == 200
    assert client.ask(READ) == VALUES


def test_everything_is_busy_while_a_memory_is_sealed(run: Run, connect: Connect) -> None:
    appliance = run(CONFIGURATION.format(mode="once"))
    client = connect(endpoint(appliance, "scada"))
    for pdu in ("06000000ff", "0500000000", "16000000000000", "0b", "11", "2b0e0100", "0300090009"):
        reply = client.ask(bytes.fromhex(pdu))
        assert (reply[0], reply[1]) == (int(pdu[:2], 16) | 0x80, 6)


def test_what_a_seal_does_is_logged(run: Run, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "holdfast")
    appliance = run(CONFIGURATION.format(mode="level"))
    for bit in (1, 0, 1):
        by_raw(appliance, bit)
    appliance.log_events(timeout=0)
    [record] = [record for record in caplog.records if record.message == "seal"]
    assert vars(record)["fields"] == {"memory": "plant", "state": "open", "opened": 2, "closed": 1}


def test_a_token_restores_a_memory_while_it_is_sealed(run: Run, connect: Connect) -> None:
    text = CONFIGURATION.format(mode="once").replace(
        "  tokens: none\n",
        f"""\
  tokens:
    - name: restorer
      sha256: {hashlib.sha256(b"secret").hexdigest()}
      memories: [plant]
      areas: [discrete_inputs]
      access: read-write
      while_sealed: [holding_registers]
""",
    )
    appliance = run(text)
    client = connect(endpoint(appliance, "scada"))
    setpoint = {"memory": "plant", "area": "holding_registers", "address": 0, "values": [7]}
    assert post(appliance, setpoint, "secret") == 200
    gate = {"memory": "plant", "area": "discrete_inputs", "address": 9, "values": [1]}
    assert post(appliance, gate, "secret") == 200
    assert post(appliance, setpoint | {"values": [8]}, "secret") == 403
    assert client.ask(READ) == bytes.fromhex("030400070000")
