"""Requests and writes per second from one source: more are delayed, or dropped over UDP.

The limits are so low that a source above its limit waits for longer than a test runs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from holdfast import raw_ingest
from holdfast.appliance import Appliance
from holdfast.config import load
from support import lines, wire
from support.certificates import Certificates, named
from support.config_folder import written
from support.machine import needs_127_0_0_2
from support.running import endpoint
from support.tls_peer import Peer, context
from support.transports import Datagrams, address, client, configuration, counters

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    import holdfast
    from support.running import Connect, Run, Serve

READ = bytes.fromhex("0300000001")
ZERO = bytes.fromhex("03020000")
WRITE = bytes.fromhex("0600001234")
MANY = 100
"""Requests that are sent at once: one read of the server has them all."""


def exceed(client: wire.Connection, pdu: bytes = READ) -> None:
    """Sends many requests, and checks that none of their replies is missing or changed."""
    client.send(b"".join(wire.frame(pdu, 1, number) for number in range(MANY)))
    reply = pdu if pdu == WRITE else ZERO
    assert [client.receive() for _ in range(MANY)] == [
        wire.Frame(number, 1, reply) for number in range(MANY)
    ]


def events(appliance: Appliance, caplog: pytest.LogCaptureFixture) -> list[dict[str, Any]]:
    """The events about exceeded limits so far."""
    appliance.log_events(0)
    return [vars(each)["fields"] for each in caplog.records if each.message == "rate_limited"]


@needs_127_0_0_2
def test_a_source_above_its_limit_waits_and_others_are_served(
    run: Run, connect: Connect, caplog: pytest.LogCaptureFixture
) -> None:
    rules = [{"sources": ["127.0.0.0/8"], "units": {1: "plant"}, "access": "read-write"}]
    appliance = run(configuration("tcp", rules=rules, max_requests_per_source=1))
    greedy, other = (connect(address(appliance), source=f"127.0.0.{last}") for last in (1, 2))
    exceed(greedy)
    greedy.send(wire.frame(READ))
    assert other.ask(READ) == ZERO
    with connect(address(appliance), source="127.0.0.1") as again:
        again.send(wire.frame(READ))
        wire.until(
            lambda: counters(appliance)["rate_limited"]["paused"]["requests"] == 2, "both wait"
        )
        assert other.ask(READ) == ZERO
    assert counters(appliance)["requests"] == {3: MANY + 2}, "nothing was read from the first"

    [told] = events(appliance, caplog)
    assert told["reason"] == "requests"
    assert told["peer"] == "{}:{}".format(*greedy.socket.getsockname())


def test_what_is_delayed_is_answered_in_the_end(
    memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    server = serve({1: memory}, max_requests_per_source=2 * MANY)
    client = connect(server)

    def is_delayed() -> bool:
        exceed(client)
        return server.counters()["rate_limited"]["paused"]["requests"] > 1

    wire.until(is_delayed, "two pauses have begun")
    assert server.counters()["connections"]["idle"] == 0


def test_writes_have_a_limit_of_their_own(
    memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    server = serve({1: memory}, max_writes_per_source=1)
    reader, writer = connect(server), connect(server)
    assert reader.ask(READ) == ZERO
    exceed(writer, WRITE)
    writer.send(wire.frame(WRITE))
    for _ in range(9):
        assert reader.ask(READ) == bytes.fromhex("03021234")
    assert server.counters()["requests"] == {3: 10, 6: MANY}
    assert server.counters()["rate_limited"]["paused"] == {"requests": 0, "writes": 1}


def test_without_a_limit_nothing_is_delayed(
    memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    server = serve({1: memory})
    client = connect(server)
    for _ in range(20):
        exceed(client, WRITE)
    assert server.counters()["rate_limited"] == {
        "paused": {"requests": 0, "writes": 0},
        "dropped": {"requests": 0, "writes": 0},
    }


def test_a_stopping_server_waits_for_no_limit(
    memory: holdfast.Memory, serve: Serve, connect: Connect
) -> None:
    server = serve({1: memory}, max_requests_per_source=1)
    client = connect(server)
    exceed(client)
    client.send(wire.frame(READ, 1, 7))
    server.stop()
    assert client.receive() == wire.Frame(7, 1, ZERO), "what has arrived is answered"
    assert client.rest() == b""


@pytest.mark.parametrize(("kind", "frame"), [("rtu", lines.rtu), ("ascii", lines.ascii_frame)])
def test_frames_of_serial_lines_are_limited_too(kind: str, frame: Any, run: Run) -> None:
    appliance = run(configuration(kind, max_requests_per_source=1))
    with client(kind, address(appliance)) as made:
        made.send(frame(READ, 1) * MANY)
        assert made.replies(MANY) == [(1, ZERO)] * MANY  # type: ignore[union-attr]
    wire.until(
        lambda: counters(appliance)["rate_limited"]["paused"]["requests"] == 1, "it is counted"
    )


def test_an_authenticated_session_is_limited_too(run: Run, tmp_path: Path) -> None:
    authority = Certificates(tmp_path)
    server = authority.issue("server", "DNS:localhost,IP:127.0.0.1")
    extensions = ("extendedKeyUsage=clientAuth", named("operator"))
    operator = authority.issue("operator", "DNS:operator", extensions=extensions)
    secure = {
        "type": "modbus-tls",
        "bind": "127.0.0.1:0",
        "tls": {
            "cert_file": str(server.certificate),
            "key_file": str(server.key),
            "ca_file": str(authority.ca),
        },
        "rules": [{"sources": ["127.0.0.1"], "units": {1: "plant"}, "access": "read-only"}],
        "max_requests_per_source": 1,
    }
    memories = {"plant": {"holding_registers": 10}}
    appliance = run(written({"memories": memories, "listeners": {"scada": secure}}))
    with Peer(address(appliance), context(authority.ca, operator)) as session:
        session.shake()
        for _ in range(2):
            assert session.ask(READ) == ZERO
        wire.until(
            lambda: counters(appliance)["rate_limited"]["paused"]["requests"] == 1, "it is slowed"
        )


@pytest.mark.parametrize(
    ("limit", "pdu", "excess"),
    [
        ("max_requests_per_source", READ, "requests"),
        ("max_writes_per_source", WRITE, "writes"),
    ],
)
def test_datagrams_above_the_limit_are_dropped_and_counted(
    limit: str, pdu: bytes, excess: str, run: Run, caplog: pytest.LogCaptureFixture
) -> None:
    limits: dict[str, Any] = {limit: 1}
    appliance = run(configuration("udp", **limits))
    with Datagrams(address(appliance)) as sender:
        for _ in range(MANY):
            sender.send(wire.frame(pdu))
        wire.until(
            lambda: (
                counters(appliance)["rate_limited"]["dropped"][excess]
                + sum(counters(appliance)["requests"].values())
                == MANY
            ),
            "all have arrived",
        )
        assert counters(appliance)["rate_limited"]["dropped"][excess] > 0
        if excess == "writes":
            assert sender.receive().pdu == WRITE
            while not sender.is_quiet():
                sender.receive()
            assert sender.ask(READ) == bytes.fromhex("03021234"), "reads are not limited"
    [told] = events(appliance, caplog)
    assert told["reason"] == excess


# Raw Ingest


def raw(**more: Any) -> dict[str, Any]:
    rules = [{"sources": ["127.0.0.1"], "units": {1: "plant"}, "areas": ["holding_registers"]}]
    return {
        "memories": {"plant": {"holding_registers": 10}},
        "listeners": {
            "scada": {"type": "raw-ingest", "bind": "127.0.0.1:0", "rules": rules, **more}
        },
    }


PACKET = raw_ingest.encode("holding_registers", 0, [42], unit=1)


def accepted(appliance: Appliance) -> int:
    count: int = counters(appliance)["packets"]["accepted"]
    return count


def test_packets_of_one_connection_count_as_writes(run: Run, connect: Connect) -> None:
    appliance = run(written(raw(packets="many", max_writes_per_source=1)))
    with connect(address(appliance)) as sender:
        sender.send(PACKET * MANY)
        wire.until(
            lambda: counters(appliance)["rate_limited"]["paused"]["writes"] > 0, "it is slowed"
        )
        wire.until(lambda: accepted(appliance) > 0, "one is written")
        assert accepted(appliance) < MANY


def test_packets_of_many_connections_count_as_writes(run: Run, connect: Connect) -> None:
    appliance = run(written(raw(max_writes_per_source=1)))
    clients = [connect(address(appliance)) for _ in range(16)]
    for each in clients:
        each.send(PACKET)
    wire.until(lambda: counters(appliance)["rate_limited"]["paused"]["writes"] > 0, "some wait")
    wire.until(lambda: accepted(appliance) > 0, "one is written")
    assert accepted(appliance) < len(clients)


# Reload


@pytest.fixture
def limited(tmp_path: Path) -> Iterator[tuple[Appliance, Any]]:
    """An appliance, and a function that loads it again with another limit."""
    file = tmp_path / "plant.yaml"

    def settings(limit: int | None) -> Any:
        file.write_text(configuration("tcp", max_requests_per_source=limit))
        return load(file)

    with Appliance(settings(1)) as started:
        yield started, lambda limit: started.reload(settings(limit))


@pytest.mark.parametrize("limit", [None, 1_000_000])
def test_a_reload_ends_the_pauses_of_limits_that_it_raises(
    limit: int | None, limited: tuple[Appliance, Any], connect: Connect
) -> None:
    appliance, reload = limited
    client = connect(endpoint(appliance, "scada"))
    exceed(client)
    client.send(wire.frame(READ, 1, 7))
    assert reload(limit) == ["listeners.scada"]
    assert client.receive() == wire.Frame(7, 1, ZERO)
    exceed(client)


def test_a_reload_lowers_the_limits_of_open_connections(
    limited: tuple[Appliance, Any], connect: Connect
) -> None:
    appliance, reload = limited
    reload(None)
    client = connect(endpoint(appliance, "scada"))
    exceed(client)
    assert counters(appliance)["rate_limited"]["paused"]["requests"] == 0
    reload(1)
    exceed(client)
    wire.until(lambda: counters(appliance)["rate_limited"]["paused"]["requests"] == 1, "it waits")
