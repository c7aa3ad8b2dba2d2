"""Faults of a simulated device, as Modbus clients see them."""

from __future__ import annotations

import contextlib
import socket
from ipaddress import ip_network
from random import Random
from typing import TYPE_CHECKING

import pytest

import holdfast
from holdfast.errors import ConnectionLost, ModbusException, RequestTimeout
from holdfast.simulation.faults import FaultProxy, Faults
from support import wire
from support.machine import has_ipv6

if TYPE_CHECKING:
    from collections.abc import Iterator

EVERYONE = [ip_network("127.0.0.0/8")]


@contextlib.contextmanager
def front(
    server: holdfast.Server, faults: Faults, sources: list[str] | None = None
) -> Iterator[str]:
    networks = EVERYONE if sources is None else [ip_network(each) for each in sources]
    behind = FaultProxy(("127.0.0.1", 0), server.address, faults, Random("1"), networks)
    with behind as running:
        yield f"tcp://127.0.0.1:{running.address[1]}"


def outcomes(url: str, count: int, timeout: float) -> list[object]:
    found: list[object] = []
    for _ in range(count):
        with holdfast.SyncClient(url, timeout=timeout) as client:
            try:
                found.append(client.read_holding_registers(7, 1))
            except ModbusException as error:
                found.append(error.code)
            except RequestTimeout:
                found.append(None)
    return found


def test_requests_without_a_fault_are_answered(
    server: holdfast.Server, memory: holdfast.Memory
) -> None:
    memory.write("holding_registers", 7, [4711])
    with (
        front(server, Faults(latency=(0, 0.001))) as url,
        holdfast.SyncClient(url, timeout=5) as client,
    ):
        for _ in range(3):
            assert client.read_holding_registers(7, 1) == [4711]
        client.write_register(0, 5)
        with pytest.raises(ModbusException, match="exception 02"):
            client.read_holding_registers(1000, 1)
    assert memory.read("holding_registers", 0, 1) == [5]


def test_some_requests_are_refused(server: holdfast.Server) -> None:
    with front(server, Faults(refuse=0.5, code=6)) as url:
        found = outcomes(url, 30, 5)
    assert {str(each) for each in found} == {"6", "[0]"}


def test_some_requests_have_no_reply(server: holdfast.Server) -> None:
    def has_some_replies(timeout: float) -> bool:
        found = outcomes(url, 12, timeout)
        assert None in found
        return [0] in found

    with front(server, Faults(drop=0.5)) as url:
        wire.until_long_enough(has_some_replies, "some replies come")


def test_replies_are_late(server: holdfast.Server) -> None:
    with front(server, Faults(latency=(30, 30))) as url:
        assert outcomes(url, 1, 0.05) == [None]


def test_peers_of_other_networks_are_disconnected(server: holdfast.Server) -> None:
    with (
        front(server, Faults(drop=0.1), ["10.0.0.0/8"]) as url,
        holdfast.SyncClient(url, timeout=5) as client,
        pytest.raises(ConnectionLost),
    ):
        client.read_holding_registers(0, 1)


@pytest.mark.parametrize(
    "data",
    [b"GET / HTTP/1.1\r\n\r\n", bytes([0, 1, 0, 0, 0, 1, 1]), bytes([0, 1, 0, 0, 255, 0, 1])],
)
def test_bytes_that_are_no_frame_end_the_connection(server: holdfast.Server, data: bytes) -> None:
    with front(server, Faults(latency=(0, 0.001))) as url:
        port = int(url.rpartition(":")[2])
        with socket.create_connection(("127.0.0.1", port), timeout=wire.DEADLINE) as peer:
            peer.sendall(data)
            with contextlib.suppress(ConnectionResetError):
                assert peer.recv(100) == b""
        assert outcomes(url, 1, 5) == [[0]]


@pytest.mark.skipif(not has_ipv6(), reason="needs IPv6")
def test_all_addresses_include_those_of_ipv4(server: holdfast.Server) -> None:
    everywhere = FaultProxy(("::", 0), server.address, Faults(drop=0.01), Random("1"), EVERYONE)
    with everywhere as running:
        assert outcomes(f"tcp://127.0.0.1:{running.address[1]}", 1, 5) == [[0]]


def test_an_address_in_use_is_an_error(server: holdfast.Server) -> None:
    taken = FaultProxy(server.address, server.address, Faults(drop=1), Random(1), EVERYONE)
    with pytest.raises(OSError, match="in use"):
        taken.start()
