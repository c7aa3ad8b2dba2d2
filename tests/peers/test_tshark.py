"""tshark as the judge of frames: it must decode everything that our clients and listeners send."""

from __future__ import annotations

import json
import os
import subprocess
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import pytest

from support import pymodbus_server, recording, wire
from support.faces import FACES, Dial, Face, dialling
from support.lines import rtu
from support.machine import tool
from support.recording import MODBUS_PORT, Piece, Recorder
from support.transports import address, configuration

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from support.running import Run


@dataclass(frozen=True)
class Transport:
    """A transport as the parts of the test call it."""

    scheme: str
    listener: str
    dissector: str

    @property
    def datagrams(self) -> bool:
        return "udp" in self.scheme


# tshark has no dissector for ASCII.
TRANSPORTS = [
    Transport("tcp", "tcp", "mbtcp"),
    Transport("udp", "udp", "mbudp"),
    Transport("rtu+tcp", "rtu", "mbrtu"),
    Transport("rtu+udp", "rtu-udp", "mbrtu"),
]
FUNCTIONS = {1, 2, 3, 4, 5, 6, 8, 11, 15, 16, 17, 22, 23, 43}
IDENTITY = {"vendor_name": "Acme", "product_code": "P1", "revision": "1.2"}

each_transport = pytest.mark.parametrize("transport", TRANSPORTS, ids=lambda each: each.scheme)


@pytest.fixture(params=FACES)
def dial(request: pytest.FixtureRequest) -> Iterator[Dial]:
    yield from dialling(request.param)


def decoded(pieces: list[Piece], transport: Transport, folder: Path) -> list[dict[str, Any]]:
    """The layers that tshark finds in each packet."""
    capture = folder / "recorded.pcap"
    recording.write(pieces, capture, datagrams=transport.datagrams)
    protocol = "udp" if transport.datagrams else "tcp"
    ran = subprocess.run(
        [
            *(tool("tshark"), "-n", "-r", str(capture), "-T", "json"),
            *("-d", f"{protocol}.port=={MODBUS_PORT},{transport.dissector}"),
            *("-o", "mbrtu.crc_verification:TRUE"),
        ],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        # No settings of the user.
        env=os.environ | {"HOME": str(folder), "XDG_CONFIG_HOME": str(folder)},
    )
    assert ran.returncode == 0, ran.stderr
    return [packet["_source"]["layers"] for packet in json.loads(ran.stdout)]


def complaints(value: Any, path: str = "") -> list[str]:
    """Where tshark reports a malformed frame, or remarks on one."""
    if isinstance(value, list):
        return [found for each in value for found in complaints(each, path)]
    if not isinstance(value, dict):
        return []
    found = [f"{path}: {value[key]}" for key in value if "_ws.expert" in key or "malformed" in key]
    return found + [more for key, each in value.items() for more in complaints(each, key)]


def everything(client: Face) -> None:
    """Calls every function, and provokes exceptions."""
    pymodbus_server.tour(client)
    assert client.identify().vendor_name == "Acme"
    assert client.report_server_id().running is True
    assert client.diagnostics(0, [0x1234]) == [0x1234]
    assert client.event_counter()[0] is False


@each_transport
def test_tshark_decodes_all_that_client_and_listener_send(
    transport: Transport, dial: Dial, run: Run, tmp_path: Path
) -> None:
    appliance = run(configuration(transport.listener, more={"identity": IDENTITY}))
    memory = appliance.memories["plant"]
    memory.write("input_registers", 0, range(1000))
    memory.write("discrete_inputs", 0, [int(at % 3 == 0) for at in range(1000)])

    with Recorder(address(appliance), datagrams=transport.datagrams) as recorder:
        everything(dial(f"{transport.scheme}://127.0.0.1:{recorder.port}", timeout=wire.DEADLINE))

    pieces = recorder.pieces
    if transport.dissector == "mbrtu":
        # tshark takes no frame of 4 bytes for RTU: the requests of functions 11 and 17.
        short = {piece.data[1] for piece in pieces if len(piece.data) == 4}
        assert short == {11, 17}
        pieces = [piece for piece in pieces if len(piece.data) > 4]
    packets = decoded(pieces, transport, tmp_path)
    assert [found for packet in packets for found in complaints(packet)] == []
    assert [list(packet)[-2:] for packet in packets] == [[transport.dissector, "modbus"]] * len(
        pieces
    )
    assert functions(packets) == FUNCTIONS


def functions(packets: list[dict[str, Any]]) -> set[int]:
    """The function codes of packets."""
    return {int(packet["modbus"]["modbus.func_code"]) for packet in packets}


REQUEST, REPLY = bytes.fromhex("10000000020412345678"), bytes.fromhex("1000000002")


@pytest.mark.parametrize(
    ("transport", "frames"),
    [
        (TRANSPORTS[0], [wire.frame(REQUEST), wire.frame(REPLY[:3])]),
        (TRANSPORTS[1], [wire.frame(REQUEST), wire.frame(REPLY[:3])]),
        (TRANSPORTS[2], [rtu(REQUEST), rtu(REPLY[:3])]),
        (TRANSPORTS[3], [rtu(REQUEST), rtu(REPLY[:3])]),
        (TRANSPORTS[2], [rtu(REQUEST), rtu(REPLY)[:-1] + b"\0"]),
        (TRANSPORTS[3], [rtu(REQUEST), rtu(REPLY)[:-1] + b"\0"]),
    ],
    ids=["short tcp", "short udp", "short rtu+tcp", "short rtu+udp", "crc rtu+tcp", "crc rtu+udp"],
)
def test_tshark_would_complain_of_a_damaged_frame(
    transport: Transport, frames: list[bytes], tmp_path: Path
) -> None:
    pieces = [Piece(True, frames[0]), Piece(False, frames[1])]

    request, reply = decoded(pieces, transport, tmp_path)

    assert complaints(request) == []
    assert complaints(reply) != []
