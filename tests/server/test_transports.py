"""`holdfast.Server` over every transport: which one `bind` names, and what it may have."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from support import wire
from support.certificates import Certificates, named
from support.lines import Cable

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def memory() -> holdfast.Memory:
    return holdfast.Memory(holding_registers=100)


def exchange(url: str, memory: holdfast.Memory) -> None:
    """Writes and reads through a client."""
    with holdfast.SyncClient(url, timeout=wire.DEADLINE) as plc:
        plc.write_registers(2, [1234, 5678])
        assert plc.read_holding_registers(2, 2) == [1234, 5678]
    assert memory.read("holding_registers", 2, 2) == [1234, 5678]


@pytest.mark.parametrize("scheme", ["tcp", "udp", "rtu+tcp", "rtu+udp", "ascii+tcp"])
def test_a_server_serves_every_transport(scheme: str, memory: holdfast.Memory) -> None:
    with holdfast.Server(
        {1: memory}, bind=f"{scheme}://127.0.0.1:0", access="read-write"
    ) as server:
        host, port = server.address
        exchange(f"{scheme}://{host}:{port}", memory)
        assert server.counters()["requests"] == {3: 1, 16: 1}


def test_without_a_scheme_it_is_modbus_tcp(memory: holdfast.Memory) -> None:
    with holdfast.Server({1: memory}, bind="[::1]:0", sources=["::1"], access="read-write") as it:
        exchange(f"tcp://[::1]:{it.address[1]}", memory)


def test_tls_with_the_roles_of_certificates(tmp_path: Path, memory: holdfast.Memory) -> None:
    authority = Certificates(tmp_path)
    own = authority.issue("server", "IP:127.0.0.1")
    peer = authority.issue("operator", "DNS:operator", extensions=[named("operator")])
    tls = holdfast.ServerTls(cert_file=own.certificate, key_file=own.key, ca_file=authority.ca)
    rule = holdfast.Rule(
        {1: memory}, sources=["127.0.0.1"], access="read-write", roles=["operator"]
    )
    with holdfast.Server(rules=[rule], bind="tls://127.0.0.1:0", tls=tls) as it:
        files = f"ca={authority.ca}&cert={peer.certificate}&key={peer.key}"
        exchange(f"tls://127.0.0.1:{it.address[1]}?{files}", memory)


@pytest.mark.parametrize("mode", ["rtu", "ascii"])
def test_a_serial_line(mode: str, tmp_path: Path, memory: holdfast.Memory) -> None:
    with Cable(tmp_path) as cable:
        one, other = (f"{mode}://{device}?baud=115200&parity=none" for device in cable.devices)
        with holdfast.Server({1: memory}, bind=one, access="read-write") as server:
            exchange(other, memory)
            with pytest.raises(RuntimeError, match="a serial line has no address"):
                assert server.address


def test_a_rule_of_a_serial_line_serves_it(tmp_path: Path, memory: holdfast.Memory) -> None:
    rule = holdfast.Rule({1: memory}, access="read-write")
    with Cable(tmp_path) as cable:
        one, other = (f"rtu://{device}?baud=115200&parity=none" for device in cable.devices)
        with holdfast.Server(rules=[rule], bind=one):
            exchange(other, memory)


@pytest.mark.parametrize(
    ("bind", "options", "says"),
    [
        ("http://127.0.0.1:0", {}, "bind is 'http://127.0.0.1:0', allowed: 127.0.0.1:5020"),
        ("tcp://127.0.0.1:0/x", {}, "allowed: 127.0.0.1:5020, tcp://"),
        ("tcp://127.0.0.1:0?unit=1", {}, "allowed: 127.0.0.1:5020, tcp://"),
        ("tcp://localhost:0", {}, "localhost"),
        ("tls://127.0.0.1:0", {}, "tls:// requires tls, the certificates"),
        ("udp://127.0.0.1:0", {"max_connections": 4}, "max_connections has no effect with udp"),
        ("rtu+udp://127.0.0.1:0", {"idle_timeout": 4}, "idle_timeout has no effect with rtu+udp"),
        ("tcp://127.0.0.1:0", {"frame_timeout": 1}, "frame_timeout has no effect with tcp"),
        ("rtu:///dev/x", {"listen_only": True}, "listen_only has no effect with rtu"),
        ("ascii:///dev/x", {"sources": ["127.0.0.0/8"]}, "sources has no effect with ascii"),
        ("rtu:///dev/x", {"sources": ["127.0.0.0/8", "::1/128"]}, "sources has no effect with rtu"),
        ("rtu:///dev/x?retries=1", {}, "which has options of clients"),
        ("rtu:///dev/x?speed=1", {}, "unknown option 'speed'"),
        ("rtu://", {}, "has no device"),
    ],
)
def test_what_a_transport_can_not_be_or_have_is_refused(
    memory: holdfast.Memory, bind: str, options: dict[str, Any], says: str
) -> None:
    with pytest.raises(ValueError, match=re.escape(says)):
        holdfast.Server({1: memory}, bind=bind, access="read-only", **options)


@pytest.mark.parametrize("unit", [0, 248, 255])
def test_a_server_on_a_serial_line_has_no_other_unit_than_1_to_247(
    memory: holdfast.Memory, unit: int
) -> None:
    with pytest.raises(ValueError, match=f"unit id {unit}, allowed on a serial line: 1 to 247"):
        holdfast.Server({1: memory, unit: memory}, bind="rtu:///dev/x", access="read-only")


@pytest.mark.parametrize("unit", [0, 248, 255])
def test_a_rule_of_a_serial_line_has_no_other_unit_than_1_to_247(
    memory: holdfast.Memory, unit: int
) -> None:
    rule = holdfast.Rule({1: memory, unit: memory}, access="read-only")
    with pytest.raises(ValueError, match=f"unit id {unit}, allowed on a serial line: 1 to 247"):
        holdfast.Server(rules=[rule], bind="ascii:///dev/x")


@pytest.mark.parametrize("sources", [[], ["127.0.0.0/8"]])
def test_a_rule_of_a_serial_line_has_no_sources(
    memory: holdfast.Memory, sources: list[str]
) -> None:
    rule = holdfast.Rule({1: memory}, sources=sources, access="read-only")
    with pytest.raises(ValueError, match="sources has no effect with rtu: omit it"):
        holdfast.Server(rules=[rule], bind="rtu:///dev/x")


@pytest.mark.parametrize("scheme", ["tcp", "udp", "rtu+tcp", "rtu+udp", "ascii+tcp"])
def test_a_rule_of_a_network_requires_sources(memory: holdfast.Memory, scheme: str) -> None:
    rule = holdfast.Rule({1: memory}, access="read-only")
    with pytest.raises(ValueError, match=f"a rule requires sources with {re.escape(scheme)}, as"):
        holdfast.Server(rules=[rule], bind=f"{scheme}://127.0.0.1:0")


@pytest.mark.parametrize(
    "more", [{"sources": ["10.0.0.1"]}, {"functions": [3]}, {"deny": [6]}, {"access": "read-only"}]
)
@pytest.mark.parametrize("bind", ["tcp://127.0.0.1:0", "rtu:///dev/x"])
def test_rights_beside_rules_are_refused(
    memory: holdfast.Memory, bind: str, more: dict[str, Any]
) -> None:
    sources = None if bind.startswith("rtu:") else ["127.0.0.1"]
    rule = holdfast.Rule({1: memory}, sources=sources, access="read-write")
    with pytest.raises(TypeError, match=r"rules or rights \(units, access, .*\), not both"):
        holdfast.Server(rules=[rule], bind=bind, **more)


@pytest.mark.parametrize("bind", ["tcp://127.0.0.1:0", "udp://127.0.0.1:0", "rtu:///dev/x"])
def test_only_tls_has_roles(memory: holdfast.Memory, bind: str) -> None:
    sources = None if bind.startswith("rtu:") else ["127.0.0.1"]
    rule = holdfast.Rule({1: memory}, sources=sources, access="read-write", roles=["operator"])
    with pytest.raises(ValueError, match="roles has no effect with"):
        holdfast.Server(rules=[rule], bind=bind)


def test_a_serial_line_has_one_rule(memory: holdfast.Memory) -> None:
    rule = holdfast.Rule({1: memory}, access="read-only")
    with pytest.raises(ValueError, match="found 2 rules, a serial line has exactly one"):
        holdfast.Server(rules=[rule, rule], bind="rtu:///dev/x")


def test_what_is_no_text_is_refused(memory: holdfast.Memory) -> None:
    with pytest.raises(TypeError, match="bind is 502"):
        holdfast.Server({1: memory}, bind=502, access="read-only")  # type: ignore[arg-type]
