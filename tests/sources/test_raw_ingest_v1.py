"""What the locked specification of Raw Ingest v1 prints, sent to both ports that accept it.

One is a listener for packets only, with the defaults. The other is a Modbus port that also takes
packets, as the import of a configuration of the second generation makes it: `compat` lets a
connection carry many packets, and go on after a refusal. The mistakes of senders that the
specification describes show the same values as there.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any, get_args

import pytest

from holdfast import raw_ingest
from holdfast.types import Area
from support import wire
from support.config_folder import written
from support.running import content, endpoint

if TYPE_CHECKING:
    from collections.abc import Callable

    import holdfast
    from holdfast.appliance import Appliance
    from sources.conftest import RunImported
    from support.running import Run

SOURCE = """\
listeners:
  - id: plant
    listen: 127.0.0.1:502
    memory:
      - unit_id: 1
        coils: {start: 0, count: 1000}
        discrete_inputs: {start: 0, count: 1000}
        holding_registers: {start: 0, count: 1000}
        input_registers: {start: 0, count: 1000}
        policy:
          rules: [{id: local, source_ip: [127.0.0.1, "::1"], allow_fc: [3, 16]}]
"""
DONE, REFUSED = b"\x00", b"\x01"
PORTS = ["packets only", "imported"]


class Port:
    """A port that takes packets for unit 1."""

    def __init__(self, appliance: Appliance, listener: str, memory: str) -> None:
        self.appliance = appliance
        self.address = endpoint(appliance, listener)
        self.memory: holdfast.Memory = appliance.memories[memory]
        self._listener = listener

    def replies(self, *packets: bytes, finish: bool = True) -> bytes:
        """All that comes back on a connection with these packets."""
        with wire.Connection(self.address) as sender:
            sender.send(b"".join(packets))
            if finish:
                sender.finish()
            return sender.rest()

    def registers(self, count: int) -> list[int]:
        return self.memory.read("holding_registers", 0, count)

    @property
    def surplus_bytes(self) -> int:
        stats: Any = self.appliance.diagnostics.stats()["listeners"][self._listener]
        return int(stats["packets"]["surplus_bytes"])


@pytest.fixture
def alone(run: Run) -> Port:
    """A listener for packets only, with the defaults of its format."""
    areas = list(get_args(Area))
    rule = {"sources": ["127.0.0.0/8"], "units": {1: "plant"}, "areas": areas}
    plant: dict[str, Any] = {"id": 1} | dict.fromkeys(areas, 1000)
    listener = {"type": "raw-ingest", "format": "v1", "bind": "127.0.0.1:0", "rules": [rule]}
    text = written({"memories": {"plant": plant}, "listeners": {"raw": listener}})
    return Port(run(text), "raw", "plant")


@pytest.fixture
def imported(run_imported: RunImported) -> Port:
    """The port of an imported configuration."""
    port = Port(run_imported(SOURCE), "plant", "plant-1")
    assert port.appliance.config.listeners["plant"].type == "modbus-tcp"
    return port


@pytest.fixture(params=PORTS)
def port(request: pytest.FixtureRequest) -> Port:
    """Each of both ports."""
    name = "alone" if request.param == "packets only" else "imported"
    found: Port = request.getfixturevalue(name)
    return found


def packet(area: int, address: int, count: int, payload: bytes, version: int = 1) -> bytes:
    """Builds a packet by the table of the layout: 10 bytes, then the payload."""
    magic = bytes([0x52, 0x49])
    return magic + struct.pack(">BBHHH", version, area, 1, address, count) + payload


LAYOUT: list[tuple[int, Area, int, str, list[int]]] = [
    # Bits: ceil(count / 8) bytes, LSB first.
    (0x01, "coils", 5, "0D", [1, 0, 1, 1, 0]),
    (0x02, "discrete_inputs", 9, "0D 01", [1, 0, 1, 1, 0, 0, 0, 0, 1]),
    # Registers: count x 2 bytes, [ HIGH BYTE ][ LOW BYTE ].
    (0x03, "holding_registers", 3, "00 64 00 C8 01 2C", [100, 200, 300]),
    (0x04, "input_registers", 1, "FF FE", [0xFFFE]),
]


def test_each_area_is_written_as_its_bytes_arrive_and_answered_with_one_byte(port: Port) -> None:
    for code, area, count, payload, values in LAYOUT:
        sent = packet(code, 7, count, bytes.fromhex(payload))
        assert port.replies(sent) == DONE
        assert port.memory.read(area, 7, count) == values
        assert port.memory.read(area, 7 + count, 1) == [0]
        assert sent == raw_ingest.encode(area, 7, values, unit=1)


WRONG: dict[str, bytes] = {
    "magic": b"IR" + packet(3, 0, 1, b"\x00\x07")[2:],
    "version 0": packet(3, 0, 1, b"\x00\x07", version=0),
    "version 2": packet(3, 0, 1, b"\x00\x07", version=2),
    "version 255": packet(3, 0, 1, b"\x00\x07", version=255),
    "area 0": packet(0, 0, 1, b"\x00\x07"),
    "area 5": packet(5, 0, 1, b"\x00\x07"),
    "count 0": packet(3, 0, 0, b""),
    "address": packet(3, 1000, 1, b"\x00\x07"),
    "address and count": packet(3, 999, 2, b"\x00\x07\x00\x07"),
    "unit id": packet(3, 0, 1, b"\x00\x07").replace(b"\x00\x01", b"\x00\x02", 1),
    "payload": packet(3, 0, 2, b"\x00\x07"),
}
NOT_A_PACKET = {"magic"}
"""On a port with two protocols, these bytes are Modbus."""


@pytest.mark.parametrize("fault", WRONG)
def test_a_refused_packet_is_answered_with_one_byte_and_changes_nothing(
    port: Port, fault: str
) -> None:
    port.memory.write("holding_registers", 0, [9] * 1000)
    before = content(port.memory)
    [listener] = port.appliance.config.listeners.values()
    is_modbus = fault in NOT_A_PACKET and listener.type == "modbus-tcp"
    assert port.replies(WRONG[fault]) == (b"" if is_modbus else REFUSED)
    assert content(port.memory) == before


def test_a_connection_carries_one_packet_and_is_closed_after_its_reply(alone: Port) -> None:
    first, second = packet(3, 0, 1, b"\x00\x07"), packet(3, 1, 1, b"\x00\x08")
    assert alone.replies(first, finish=False) == DONE
    assert alone.replies(first, second, finish=False) == DONE
    assert alone.registers(2) == [7, 0]


def test_an_imported_port_carries_one_packet_where_that_is_set(run_imported: RunImported) -> None:
    """The program kept connections open, against its specification: `compat` of the import."""

    def one_packet(data: dict[str, Any]) -> None:
        del data["listeners"]["plant"]["raw_ingest"]["compat"]

    port = Port(run_imported(SOURCE, change=one_packet), "plant", "plant-1")
    first, second = packet(3, 0, 1, b"\x00\x07"), packet(3, 1, 1, b"\x00\x08")
    assert port.replies(first, second, finish=False) == DONE
    assert port.registers(2) == [7, 0]


@pytest.mark.parametrize(("count", "phantom"), [(125, 250), (250, 500)])
@pytest.mark.parametrize("size", [">H", ">I"], ids=["2 bytes", "4 bytes"])
def test_a_field_for_the_length_of_the_payload_is_in_the_first_registers(
    alone: Port, count: int, phantom: int, size: str
) -> None:
    """The outcome of the specification, and a sign of it: the bytes left over are counted."""
    values = range(1, count + 1)
    length = struct.pack(size, 2 * count)
    assert alone.replies(packet(3, 0, count, length + struct.pack(f">{count}H", *values))) == DONE
    shifted = [0, phantom, *values] if size == ">I" else [phantom, *values]
    assert alone.registers(count) == shifted[:count]
    wire.until(lambda: alone.surplus_bytes == len(length), "the surplus bytes are counted")


@pytest.mark.parametrize("value", [1, 250])
def test_registers_packed_little_endian_are_multiplied_by_256(port: Port, value: int) -> None:
    assert port.replies(packet(3, 0, 1, struct.pack("<H", value))) == DONE
    assert port.registers(1) == [256 * value]


def node_red(area: int, address: int, values: list[int]) -> bytes:
    """The bytes of a function node: `Buffer.alloc(10 + 2 * n)`, `writeUInt16BE` and so on."""
    buffer = bytearray(10 + 2 * len(values))
    buffer[0:4] = 0x52, 0x49, 0x01, area
    for at, number in ((4, 1), (6, address), (8, len(values))):
        buffer[at : at + 2] = number.to_bytes(2, "big")
    for index, value in enumerate(values):
        buffer[10 + 2 * index : 12 + 2 * index] = value.to_bytes(2, "big")
    return bytes(buffer)


def go_replicator(area: int, address: int, values: list[int]) -> bytes:
    """The bytes of a Go client: `PutUint16` into a header, then `append` for the payload."""
    header = b"RI" + bytes([1, area]) + struct.pack(">HHH", 1, address, len(values))
    return header + b"".join(struct.pack(">H", value) for value in values)


SENDERS: dict[str, Callable[[int, int, list[int]], bytes]] = {
    "Node-RED": node_red,
    "Go": go_replicator,
    "Holdfast": lambda area, address, values: raw_ingest.encode(
        "holding_registers" if area == 3 else "input_registers", address, values, unit=1
    ),
}


@pytest.mark.parametrize("area", [3, 4])
def test_all_senders_produce_identical_packets_and_the_replica_matches_exactly(
    port: Port, area: int
) -> None:
    source = [0, 1, 250, 500, 0x0102, 0xFF00, 0xFFFE, 65535] * 100
    packets = {send(area, 0, source) for send in SENDERS.values()}
    assert len(packets) == 1
    assert port.replies(*packets) == DONE
    name: Area = "holding_registers" if area == 3 else "input_registers"
    assert port.memory.read(name, 0, 1000) == [*source, *[0] * 200]
