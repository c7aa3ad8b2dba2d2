"""The Node-RED flow that is published with the Modbus Memory Appliance, against its successor.

The flow reads a coil every second. While the memory is sealed, it gets exception 06, and sends
packets with what it has stored: holding registers, input registers, and twice the coil that opens
the seal. Its `tcp request` node writes all messages that come while it connects to one connection,
which it closes when replies have come. The bytes here are what its functions compute.
"""

from __future__ import annotations

import socket
import struct
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.importing import read_mma
from support import wire
from support.config_folder import written
from support.running import endpoint

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from holdfast.appliance import Appliance
    from support.running import Run

GATE = 19
START = 2
STORED = [16936, 1, 65535, 0, 300]

READ_A_COIL = bytes([0, 1, 0, 0, 0, 6, 1, 1, 0, 1, 0, 1])
SEALED = bytes([0, 1, 0, 0, 0, 3, 1, 129, 6])
COIL_IS_OFF = bytes([0, 1, 0, 0, 0, 4, 1, 1, 1, 0])
DONE, REFUSED = b"\x00", b"\x01"

SOURCE = """\
listeners:
  - id: plant
    listen: 127.0.0.1:504
    memory:
      - unit_id: 1
        state_sealing: {area: coil, address: 19}
        coils: {start: 0, count: 1000}
        holding_registers: {start: 0, count: 1000}
        input_registers: {start: 0, count: 1000}
        policy:
          rules: [{id: local-read, source_ip: [127.0.0.1, "::1"], allow_fc: [1, 2, 3, 4]}]
"""
INPUT_REGISTERS = "        input_registers: {start: 0, count: 1000}\n"


def header(area: int, start: int, count: int) -> bytes:
    return b"RI\x01" + struct.pack(">BHHH", area, 1, start, count)


def registers(area: int) -> bytes:
    return header(area, START, len(STORED)) + struct.pack(f">{len(STORED)}H", *STORED)


def gate(*, is_open: bool) -> bytes:
    return header(1, GATE, 1) + bytes([is_open])


RESTORED = [registers(3), registers(4), gate(is_open=True), gate(is_open=True)]


@pytest.fixture
def start(tmp_path: Path, run: Run) -> Callable[[str], Appliance]:
    """Starts what the importer makes of a configuration, on a free port."""

    def imported(text: str) -> Appliance:
        path = tmp_path / "mma2.yaml"
        path.write_text(text)
        data: dict[str, Any] = read_mma(path).data
        data["listeners"]["plant"]["bind"] = "127.0.0.1:0"
        return run(written(data))

    return imported


def dial(appliance: Appliance) -> socket.socket:
    return socket.create_connection(endpoint(appliance, "plant"), timeout=wire.DEADLINE)


def received(client: socket.socket, count: int) -> bytes:
    data = b""
    while len(data) < count and (piece := client.recv(count - len(data))):
        data += piece
    return data


def read_a_coil(appliance: Appliance) -> bytes:
    """What one round of the node gets; it closes the connection after the reply."""
    with dial(appliance) as client:
        client.sendall(READ_A_COIL)
        return client.recv(65536)


def held(appliance: Appliance, *areas: str) -> list[list[int]]:
    memory = appliance.memories["plant-1"]
    return [memory.read(area, START, len(STORED)) for area in areas]


def test_a_sealed_memory_is_restored_over_one_connection(
    start: Callable[[str], Appliance],
) -> None:
    appliance = start(SOURCE)
    assert read_a_coil(appliance) == SEALED
    with dial(appliance) as client:
        client.sendall(b"".join(RESTORED))
        assert received(client, 4) == DONE * 4
    assert read_a_coil(appliance) == COIL_IS_OFF
    assert held(appliance, "holding_registers", "input_registers") == [STORED, STORED]
    with dial(appliance) as client:
        client.sendall(gate(is_open=False))
        assert client.recv(65536) == DONE
    assert read_a_coil(appliance) == SEALED


def test_a_sealed_memory_is_restored_packet_by_packet(start: Callable[[str], Appliance]) -> None:
    appliance = start(SOURCE)
    with dial(appliance) as client:
        for number, sent in enumerate(RESTORED):
            assert (read_a_coil(appliance) == SEALED) == (number < 3)
            client.sendall(sent)
            assert client.recv(65536) == DONE
    assert read_a_coil(appliance) == COIL_IS_OFF


def test_a_sealed_memory_is_restored_though_the_flow_closes_after_the_first_reply(
    start: Callable[[str], Appliance],
) -> None:
    appliance = start(SOURCE)
    with dial(appliance) as client:
        client.sendall(b"".join(RESTORED))
        assert client.recv(1) == DONE
    wire.until(lambda: read_a_coil(appliance) == COIL_IS_OFF, "the memory is open")
    assert held(appliance, "holding_registers", "input_registers") == [STORED, STORED]


def test_the_seal_is_opened_where_the_memory_has_no_input_registers(
    start: Callable[[str], Appliance],
) -> None:
    assert INPUT_REGISTERS in SOURCE
    appliance = start(SOURCE.replace(INPUT_REGISTERS, ""))
    with dial(appliance) as client:
        client.sendall(b"".join(RESTORED))
        assert received(client, 4) == DONE + REFUSED + DONE * 2
    assert read_a_coil(appliance) == COIL_IS_OFF
    assert held(appliance, "holding_registers") == [STORED]
