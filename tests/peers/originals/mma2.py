"""The Modbus Memory Appliance, second generation (Go): `HOLDFAST_ORIGINAL_MMA2`.

The command gets the path of a configuration. The program has no licence, so nobody may pass it
on: it is compared only where somebody has it. It serves Modbus and Raw Ingest at the same port.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from holdfast.appliance import Appliance
from holdfast.config import load
from holdfast.config.dump import to_yaml
from holdfast.importing import read_mma
from peers.originals.comparison import Difference, Original, Reason
from support import wire
from support.exchanges import play
from support.running import endpoint

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from peers.originals.comparison import Answers, Command, Launch

PAGE = "moving-from-mma.md"
OPERATOR, READER, STRANGER = "127.0.0.1", "127.0.0.2", "127.0.0.9"
CONFIGURATION = """\
listeners:
  - id: main
    listen: "127.0.0.1:PORT"
    memory:
      - unit_id: 1
        coils: {start: 0, count: 2000}
        discrete_inputs: {start: 0, count: 16}
        holding_registers: {start: 100, count: 300}
        input_registers: {start: 0, count: 8}
        policy:
          rules:
            - {id: operator, source_ip: [127.0.0.1], allow_fc: [1, 2, 3, 4, 5, 6, 15, 16]}
            - {id: reader, source_ip: [127.0.0.2/31], allow_fc: [3, 4]}
            - {id: words, source_ip: [127.0.0.4], allow: ro}
            - {id: late, source_ip: [127.0.0.4], allow_fc: [1]}
      - unit_id: 2
        coils: {start: 0, count: 16}
        holding_registers: {start: 0, count: 8}
        state_sealing: {area: coil, address: 15}
        policy:
          rules:
            - {id: operator, source_ip: [127.0.0.1], allow_fc: [1, 2, 3, 5, 6, 15, 16]}
      - unit_id: 3
        holding_registers: {start: 0, count: 8}
"""
AREAS = {1: "coils", 2: "discrete inputs", 3: "holding registers", 4: "input registers"}
BITS = (1, 2)


def modbus(pdu: str, *, unit: int = 1, source: str = OPERATOR) -> dict[str, str]:
    return _exchange(wire.frame(bytes.fromhex(pdu), unit, 7), source)


def packets(*each: bytes, source: str = OPERATOR) -> dict[str, str]:
    return _exchange(b"".join(each), source)


def _exchange(sent: bytes, source: str) -> dict[str, str]:
    return {"at": "main", "send": sent.hex(), "source": source}


def packet(
    area: int, address: int, count: int, payload: str, *, unit: int = 1, version: int = 1
) -> bytes:
    """Builds a packet of Raw Ingest as its replicator and its Node-RED flow send it."""
    header = struct.pack(">2sBBHHH", b"RI", version, area, unit, address, count)
    return header + bytes.fromhex(payload)


def exchanges() -> Iterator[tuple[str, dict[str, str]]]:
    """Returns the inputs in the order in which they are sent, each on a connection of its own."""
    yield from raw_ingest()
    yield from requests()
    yield from rights()
    yield from sealing()


def raw_ingest() -> Iterator[tuple[str, dict[str, str]]]:
    yield "raw: coils", packets(packet(1, 0, 5, "0d"))
    yield "raw: discrete inputs", packets(packet(2, 0, 9, "ff01"))
    yield "raw: holding registers", packets(packet(3, 100, 3, "006400c8012c"))
    yield "raw: input registers", packets(packet(4, 0, 2, "fa000007"))
    for area, name in AREAS.items():
        address = "0064" if area == 3 else "0000"
        yield f"raw: {name} read back", modbus(f"0{area}{address}0005")
    yield "raw: three packets", packets(*[packet(3, 100 + at, 1, f"000{at}") for at in range(3)])
    yield "raw: three packets read back", modbus("0300640003")
    yield (
        "raw: a refused packet between two",
        packets(
            packet(3, 110, 1, "0001"), packet(3, 399, 2, "00020002"), packet(3, 112, 1, "0003")
        ),
    )
    yield "raw: a refused packet between two, read back", modbus("03006e0003")
    yield "raw: another unit without memory", packets(packet(3, 100, 1, "0001", unit=9))
    yield "raw: unit 257", packets(packet(3, 100, 1, "0001", unit=257))
    yield "raw: a unit without a policy", packets(packet(3, 0, 1, "0001", unit=3))
    yield "raw: from anybody", packets(packet(3, 120, 1, "0009"), source=STRANGER)
    yield "raw: count 0", packets(packet(3, 100, 0, ""))
    yield "raw: version 2", packets(packet(3, 100, 1, "0001", version=2))
    yield "raw: area 0", packets(packet(0, 100, 1, "0001"))
    yield "raw: area 5", packets(packet(5, 100, 1, "0001"))
    yield "raw: an area that the unit does not have", packets(packet(2, 0, 1, "01", unit=2))
    yield "raw: half a header", packets(b"RI\1\3\0")
    yield "raw: half a payload", packets(packet(3, 130, 2, "0001"))
    yield "raw: half a payload read back", modbus("0300820002")
    yield "raw: the magic alone", packets(b"RI")
    yield "raw: a bit count with unused bits", packets(packet(1, 16, 3, "ff"))
    yield "raw: unused bits read back", modbus("0100100008")


def requests() -> Iterator[tuple[str, dict[str, str]]]:
    yield "reading 125 registers", modbus("030064007d")
    yield "reading 2000 coils", modbus("01000007d0")
    yield "reading no register", modbus("0300640000")
    yield "reading no coil", modbus("0100000000")
    yield "reading 126 registers", modbus("0300c8007e")
    yield "reading below the area", modbus("0300630001")
    yield "reading over the end", modbus("03018f0002")
    yield "writing a coil", modbus("050003ff00")
    yield "writing a coil with another value", modbus("0500030001")
    yield "writing a register", modbus("0600641234")
    yield "writing a register below the area", modbus("0600631234")
    yield "writing coils", modbus("0f0010000a02ffff")
    yield "writing coils, read back", modbus("0100100010")
    yield "writing registers", modbus("10006400020400010002")
    yield "writing registers over the end", modbus("10018f00020400010002")
    yield "writing no registers", modbus("100064000000")
    yield "writing with a wrong byte count", modbus("10006400020300010002")
    yield "everything read back", modbus("0300640008")


def rights() -> Iterator[tuple[str, dict[str, str]]]:
    yield "an unmapped unit", modbus("0300640001", unit=9)
    yield "a unit without a policy", modbus("0300000001", unit=3)
    yield "a reader reads", modbus("0300640001", source=READER)
    yield "a reader reads coils", modbus("0100000001", source=READER)
    yield "a reader writes", modbus("0600640001", source=READER)
    yield "a stranger", modbus("0300640001", source=STRANGER)
    yield "a peer whose rule has allow: ro", modbus("0300640001", source="127.0.0.4")
    yield "a later rule for that peer", modbus("0100000001", source="127.0.0.4")
    yield "function 22", modbus("160064ffff0001")
    yield "function 43", modbus("2b0e0100")


def sealing() -> Iterator[tuple[str, dict[str, str]]]:
    yield "sealed: read", modbus("0300000001", unit=2)
    yield "sealed: write of the coil", modbus("05000fff00", unit=2)
    yield "sealed: a function that no rule allows", modbus("0400000001", unit=2)
    yield "sealed: a stranger", modbus("0300000001", unit=2, source=STRANGER)
    yield (
        "restore",
        packets(
            packet(1, 0, 3, "05", unit=2),
            packet(3, 0, 2, "00640065", unit=2),
            packet(1, 15, 1, "01", unit=2),
        ),
    )
    yield "restored coils", modbus("0100000010", unit=2)
    yield "restored registers", modbus("0300000003", unit=2)
    yield "open: write", modbus("0600010007", unit=2)
    yield "open: an area that the unit does not have", modbus("0200000001", unit=2)
    yield "open: a function that no rule allows", modbus("0400000001", unit=2)
    yield "open: write of the coil", modbus("05000f0000", unit=2)
    yield "open: read after it", modbus("0300000002", unit=2)
    yield "sealed anew by Raw Ingest", packets(packet(1, 15, 1, "00", unit=2))
    yield "sealed anew: read", modbus("0300000001", unit=2)


def _reply(pdu: str, unit: int = 1) -> str:
    return wire.frame(bytes.fromhex(pdu), unit, 7).hex()


def theirs(command: Command, folder: Path) -> Answers:
    def configure(ports: Sequence[int]) -> Launch:
        (folder / "mma2.yaml").write_text(CONFIGURATION.replace("PORT", str(ports[0])))
        return ["mma2.yaml"], {}

    with command.serving(folder, 1, configure) as [port]:
        return answers(("127.0.0.1", port))


def ours(folder: Path) -> Answers:
    (folder / "mma2.yaml").write_text(CONFIGURATION.replace("PORT", "15020"))
    imported = read_mma(folder / "mma2.yaml").data
    imported["listeners"]["main"]["bind"] = "127.0.0.1:0"
    imported["identity"] = {"vendor_name": "V", "product_code": "P", "revision": "1"}
    (folder / "holdfast.yaml").write_text(to_yaml(imported))
    with Appliance(load(folder / "holdfast.yaml")) as appliance:
        return answers(endpoint(appliance, "main"))


def answers(address: tuple[str, int]) -> Answers:
    return {name: play(exchange, {"main": address}) for name, exchange in exchanges()}


UNMAPPED = Reason(
    "0x0B is the exception for a unit that is not there",
    PAGE,
    "A function that is not allowed returns 0x01, and an unmapped unit id 0x0B.",
)
QUANTITY = Reason(
    "the standard's exception for a wrong quantity",
    PAGE,
    "A quantity above the limit of its function returns 0x03, and is not carried out.",
)
NOTHING = Reason(
    "the standard's exception for a wrong quantity",
    PAGE,
    "Reading 0 registers returns 0x03, not 0x02.",
)
RIGHTS = Reason(
    "a right that is missing stays missing after the seal",
    PAGE,
    "What a peer may never do returns 0x01 also while the memory is sealed, not 0x06.",
)
GATE = Reason(
    "a Modbus client must not close the gate for all others",
    PAGE,
    "Modbus never writes a gate bit (0x02).",
)
START = Reason(
    "four bytes tell a packet from a Modbus request",
    PAGE,
    "A sender that closes its side within the first four bytes of a packet gets no byte",
)
DIFFERENCES = (
    Difference("raw: the magic alone", "01", "", START),
    Difference("reading no register", _reply("8302"), _reply("8303"), NOTHING),
    Difference("reading 126 registers", _reply("03fc" + "0000" * 126), _reply("8303"), QUANTITY),
    Difference("an unmapped unit", _reply("8301", 9), _reply("830b", 9), UNMAPPED),
    Difference("a unit without a policy", _reply("8301", 3), _reply("830b", 3), UNMAPPED),
    Difference(
        "sealed: a function that no rule allows", _reply("8406", 2), _reply("8401", 2), RIGHTS
    ),
    Difference("sealed: a stranger", _reply("8306", 2), _reply("8301", 2), RIGHTS),
    Difference("open: write of the coil", _reply("05000f0000", 2), _reply("8502", 2), GATE),
    Difference("open: read after it", _reply("8306", 2), _reply("030400640007", 2), GATE),
)
ORIGINAL = Original(
    name="MMA, second generation",
    variable="HOLDFAST_ORIGINAL_MMA2",
    differences=DIFFERENCES,
    theirs=theirs,
    ours=ours,
)
