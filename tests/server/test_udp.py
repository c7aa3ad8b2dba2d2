"""Modbus over UDP: one request a datagram, one reply, and nothing at all for anything else."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import struct
import sys
import threading
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from support import wire
from support.cases import examples
from support.machine import needs_127_0_0_2
from support.transports import (
    ALL,
    Datagrams,
    address,
    await_count,
    configuration,
    counters,
    is_stranger,
    rule,
    running,
)
from support.vectors import cases
from support.wire import rounds

if TYPE_CHECKING:
    from collections.abc import Iterator

    from holdfast.appliance import Appliance
    from support.running import Run

READ = bytes.fromhex("0300000001")
ZERO = bytes.fromhex("03020000")
UDP_SEGMENT = 103
"""The length of the datagrams that one call of Linux sends (linux/udp.h)."""
WRITE = bytes.fromhex("0600001234")


@pytest.fixture
def appliance(run: Run) -> Appliance:
    """Unit 1 is the memory plant, for peers on the loopback addresses proper."""
    return run(configuration("udp"))


@pytest.fixture
def client(appliance: Appliance) -> Iterator[Datagrams]:
    with Datagrams(address(appliance)) as made:
        yield made


# Vectors


REQUESTS = [case for case in cases("frames.json") if int(case["pdu"][:2], 16) < 0x80]


@pytest.mark.parametrize("case", REQUESTS, ids=lambda case: case["pdu"])
def test_the_header_of_a_vector_comes_back_with_the_reply(case: dict[str, Any], run: Run) -> None:
    appliance = run(configuration("udp", rules=[rule(["127.0.0.1"], case["unit"])]))
    with Datagrams(address(appliance)) as client:
        client.send(bytes.fromhex(case["mbap"]))
        reply = client.receive()

    assert (reply.transaction, reply.unit) == (0x1A2B, case["unit"])
    assert reply.pdu[0] & 0x7F == int(case["pdu"][:2], 16) & 0x7F


@pytest.mark.parametrize("transaction", [0, 1, 0x00FF, 0x7FFF, 0xFFFF])
@pytest.mark.parametrize("unit", [0, 1, 247, 255])
def test_transaction_id_and_unit_id_come_back(
    transaction: int, unit: int, client: Datagrams
) -> None:
    client.send(wire.frame(READ, unit, transaction))

    reply = client.receive()
    assert (reply.transaction, reply.unit) == (transaction, unit)
    assert reply.pdu == (ZERO if unit == 1 else b"\x83\x0b")


# Datagrams that are no request


@pytest.mark.parametrize(
    "datagram",
    [
        wire.frame(READ) * 2,
        wire.frame(WRITE) + wire.frame(READ)[:3],
        wire.frame(READ) + b"\x00",
        wire.frame(READ)[:-1],
        wire.frame(READ)[:8],
        wire.frame(READ)[:7],
        wire.frame(READ)[:6],
        b"\x00",
        b"",
        b"GET / HTTP/1.1\r\n\r\n",
        wire.frame(READ, length=0),
        wire.frame(READ, length=1),
        wire.frame(READ, length=7),
        wire.frame(READ, length=255) + bytes(250),
        wire.frame(READ, length=0xFFFF),
        wire.frame(bytes.fromhex("080000") + bytes(250)) + b"\x00",
        wire.frame(READ) + bytes(65_000),
        bytes(65_000),
    ],
    ids=lambda datagram: f"{len(datagram)}-{datagram[:8].hex()}",
)
def test_what_is_not_one_whole_frame_is_discarded(
    datagram: bytes, appliance: Appliance, client: Datagrams
) -> None:
    client.send(datagram)

    assert client.ask(READ) == ZERO
    assert client.is_quiet()
    assert counters(appliance)["frames"]["broken"] == 1
    assert counters(appliance)["requests"] == {3: 1}
    assert appliance.memories["plant"].read("holding_registers", 0, 1) == [0]


@pytest.mark.parametrize("protocol", [1, 0x0100, 0xFFFF])
def test_a_frame_of_a_foreign_protocol_is_discarded(
    protocol: int, appliance: Appliance, client: Datagrams
) -> None:
    client.send(wire.frame(WRITE, protocol=protocol))

    assert client.ask(READ) == ZERO
    assert client.is_quiet()
    assert counters(appliance)["frames"]["foreign"] == 1


@pytest.fixture(scope="module")
def sturdy(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Appliance]:
    """An appliance for many datagrams, none of which can silence a unit."""
    text = configuration("udp", rules=[rule(["127.0.0.1"], deny=[8])])
    with running(tmp_path_factory.mktemp("udp"), text) as appliance:
        yield appliance


datagrams = st.one_of(
    st.binary(max_size=300),
    st.builds(
        lambda pdu, unit, protocol, length: wire.frame(pdu, unit, protocol=protocol, length=length),
        st.binary(max_size=260),
        st.integers(0, 255),
        st.sampled_from([0, 0, 0, 1]),
        st.none() | st.integers(0, 0xFFFF),
    ),
)


@settings(max_examples=examples(200), suppress_health_check=[HealthCheck.too_slow])
@given(garbage=st.lists(datagrams, max_size=20))
def test_no_datagram_ends_the_service(garbage: list[bytes], sturdy: Appliance) -> None:
    with Datagrams(address(sturdy)) as client:
        for datagram in garbage:
            client.send(datagram)
        client.send(wire.frame(READ, 1, 0xABCD))
        while (reply := client.receive()).transaction != 0xABCD:
            continue
    assert reply.unit == 1
    assert reply.pdu[:2] == ZERO[:2]


# Who may ask


@needs_127_0_0_2
def test_each_datagram_is_judged_by_its_own_source(run: Run) -> None:
    rules = [
        rule(["127.0.0.1"]),
        rule(["127.0.0.2"], memory="other", access="read-only"),
    ]
    appliance = run(configuration("udp", rules=rules, memories={"plant": ALL, "other": ALL}))
    appliance.memories["other"].write("holding_registers", 0, [7])
    to = address(appliance)

    with Datagrams(to) as trusted, Datagrams(to, source="127.0.0.2") as guest:
        for _ in range(10):
            assert trusted.ask(WRITE) == WRITE
            assert guest.ask(WRITE) == b"\x86\x01"
            assert trusted.ask(READ) == bytes.fromhex("03021234")
            assert guest.ask(READ) == bytes.fromhex("03020007")


def test_a_sealed_memory_is_busy_until_it_is_opened(run: Run) -> None:
    plant = {**ALL, "seal": {"area": "coils", "address": 5}}
    appliance = run(configuration("udp", memories={"plant": plant}))
    with Datagrams(address(appliance)) as client:
        assert client.ask(READ) == b"\x83\x06"
        appliance.memories["plant"].write("coils", 5, [1])
        assert client.ask(READ) == ZERO


# Addresses


@pytest.mark.usefixtures("ipv6")
def test_an_ipv6_address_is_served(run: Run) -> None:
    appliance = run(configuration("udp", bind="[::1]:0"))

    with Datagrams(address(appliance)) as client:
        assert client.ask(READ) == ZERO


@pytest.mark.usefixtures("ipv6")
def test_a_listener_on_every_address_knows_an_ipv4_peer_by_its_ipv4_address(run: Run) -> None:
    appliance = run(configuration("udp", bind="[::]:0", rules=[rule(["127.0.0.1"])]))
    port = address(appliance)[1]

    with Datagrams(("127.0.0.1", port)) as client:
        assert client.ask(READ) == ZERO
    assert is_stranger("udp", appliance, ("::1", port), None)


@needs_127_0_0_2
@pytest.mark.parametrize("bind", ["0.0.0.0:0", "[::]:0"])
def test_a_reply_comes_from_the_address_that_was_asked(run: Run, bind: str) -> None:
    """A connected socket takes datagrams of no other address."""
    _, port = address(run(configuration("udp", bind=bind)))
    with Datagrams(("127.0.0.2", port), source="127.0.0.1") as client:
        assert client.ask(READ) == ZERO


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux takes several datagrams at once")
def test_datagrams_that_the_system_hands_over_at_once_are_answered_each(
    client: Datagrams,
) -> None:
    requests = [wire.frame(READ, transaction=number) for number in range(1, 30)]
    client.socket.setsockopt(socket.SOL_UDP, UDP_SEGMENT, len(requests[0]))
    client.send(b"".join(requests) + b"cut")
    assert [client.receive().transaction for _ in requests] == list(range(1, 30))


def test_tcp_and_udp_may_have_the_same_port(run: Run) -> None:
    for _ in range(10):
        to = address(run(configuration("udp")))
        # A port that is free for UDP may be taken for TCP, by whoever.
        with contextlib.suppress(OSError):
            run(configuration("tcp", bind=f"{to[0]}:{to[1]}"))
            break

    with Datagrams(to) as datagrams, wire.Connection(to) as stream:
        assert datagrams.ask(READ) == stream.ask(READ) == ZERO


def test_a_port_that_is_taken_is_an_os_error_that_names_it(run: Run, appliance: Appliance) -> None:
    taken = f"127.0.0.1:{address(appliance)[1]}"

    with pytest.raises(OSError, match=f"scada.*{taken}"):
        run(configuration("udp", bind=taken))


# Many peers


def test_many_peers_are_served_at_once(appliance: Appliance) -> None:
    number, each = 50, 20
    appliance.memories["plant"].write("holding_registers", 0, range(1000))
    with ExitStack() as opened:
        peers = [opened.enter_context(Datagrams(address(appliance))) for _ in range(number)]
        for request in range(each):
            for peer, client in enumerate(peers):
                asked = struct.pack(">BHH", 3, peer * each + request, 1)
                client.send(wire.frame(asked, 1, request))
            for peer, client in enumerate(peers):
                value = struct.pack(">BBH", 3, 2, peer * each + request)
                assert client.receive() == (request, 1, value)
        assert all(client.is_quiet() for client in peers)


def test_peers_that_are_gone_before_their_reply_harm_nobody(
    appliance: Appliance, client: Datagrams
) -> None:
    for _ in range(100):
        with Datagrams(address(appliance)) as gone:
            gone.send(wire.frame(READ))
    await_count(appliance, "requests", 3, 100)

    assert client.ask(READ) == ZERO


def test_a_peer_that_takes_no_replies_holds_up_nobody(
    appliance: Appliance, client: Datagrams
) -> None:
    longest = wire.frame(bytes.fromhex("030000007d"))
    with Datagrams(address(appliance)) as deaf:
        for number in range(1, 2001):
            deaf.send(longest)
            if number % 100 == 0:
                assert client.ask(READ) == ZERO


# Stop


def test_a_stop_under_load_ends_and_frees_the_port(appliance: Appliance, run: Run) -> None:
    host, port = address(appliance)
    ended, loaded = threading.Event(), threading.Event()

    def load() -> None:
        with Datagrams((host, port)) as client:
            while not ended.is_set():
                # Once the socket is closed, the system says so.
                with contextlib.suppress(OSError):
                    client.send(wire.frame(READ))
                    loaded.set()

    threads = [threading.Thread(target=load) for _ in range(os.cpu_count() or 2)]
    for thread in threads:
        thread.start()
    try:
        for _ in rounds(loaded):
            loaded.wait(0.01)
        appliance.stop()
        again = run(configuration("udp", bind=f"{host}:{port}"))
    finally:
        ended.set()
        for thread in threads:
            thread.join()
    with Datagrams(address(again)) as client:

        def is_answered() -> bool:
            client.send(wire.frame(READ, 1, 0xABCD))
            return bool(select.select([client.socket], [], [], 0.1)[0])

        # While the buffer of the new socket is full of the load, datagrams are lost.
        wire.until(is_answered, "the new socket answers")
        assert client.receive().transaction == 0xABCD
