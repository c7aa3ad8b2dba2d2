"""Requirements of Modbus/TCP Security that no test of a part shows."""

from __future__ import annotations

import socket
import struct
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import pytest

import holdfast
from support import wire
from support.secured import Authority

if TYPE_CHECKING:
    from pathlib import Path

CURVES, POINT_FORMATS = 10, 11
P_256, UNCOMPRESSED = 23, 0


def test_a_client_names_its_curves_and_point_format(tmp_path: Path) -> None:
    authority = Authority(tmp_path)
    with socket.create_server(("127.0.0.1", 0)) as listening, ThreadPoolExecutor(1) as threads:
        url = f"tls://127.0.0.1:{listening.getsockname()[1]}?ca={authority.ca}"
        client = holdfast.SyncClient(url, timeout=wire.DEADLINE)
        call = threads.submit(client.read_coils, 0, 1)
        peer, _ = listening.accept()
        with peer, peer.makefile("rb") as stream:
            peer.settimeout(wire.DEADLINE)
            _, _, length = struct.unpack(">BHH", stream.read(5))
            found = extensions(stream.read(length))
        with pytest.raises(holdfast.ModbusError):
            call.result()

    curves = found[CURVES][2:]
    assert P_256 in struct.unpack(f">{len(curves) // 2}H", curves)
    assert found[POINT_FORMATS] == bytes([1, UNCOMPRESSED])


def extensions(hello: bytes) -> dict[int, bytes]:
    """The extensions of a ClientHello (RFC 5246, 7.4.1.2)."""
    at = 4 + 2 + 32
    for size in (1, 2, 1):
        at += size + int.from_bytes(hello[at : at + size])
    at, found = at + 2, {}
    while at < len(hello):
        kind, length = struct.unpack_from(">HH", hello, at)
        found[kind] = hello[at + 4 : at + 4 + length]
        at += 4 + length
    return found
