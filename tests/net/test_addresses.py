"""Addresses: mapped ones, networks, and how a host is written."""

from __future__ import annotations

from ipaddress import ip_address, ip_network

import pytest

import holdfast
from holdfast.net.addresses import (
    address_in,
    bracketed,
    certificate_name,
    covers,
    holds,
    joined,
    reachable,
    unbracketed,
    unmapped,
)
from support import wire


@pytest.mark.parametrize(
    ("text", "plain"),
    [
        ("10.0.0.7", "10.0.0.7"),
        ("::ffff:10.0.0.7", "10.0.0.7"),
        ("::ffff:0:0", "0.0.0.0"),
        ("::10.0.0.7", "::a00:7"),
        ("64:ff9b::10.0.0.7", "64:ff9b::a00:7"),
        ("fd00::1", "fd00::1"),
    ],
)
def test_a_mapped_address_is_its_ipv4_address(text: str, plain: str) -> None:
    assert unmapped(ip_address(text)) == ip_address(plain)


@pytest.mark.parametrize(
    ("text", "plain"),
    [
        ("::ffff:10.0.0.0/104", "10.0.0.0/8"),
        ("::ffff:0:0/96", "0.0.0.0/0"),
        ("::ffff:10.0.0.7/128", "10.0.0.7/32"),
        ("::fffe:0:0/95", "::fffe:0:0/95"),
        ("::/0", "::/0"),
        ("10.0.0.0/8", "10.0.0.0/8"),
    ],
)
def test_a_mapped_network_is_its_ipv4_network(text: str, plain: str) -> None:
    assert unmapped(ip_network(text)) == ip_network(plain)


def test_networks_hold_a_mapped_address_as_its_ipv4_address() -> None:
    assert holds([ip_network("10.0.0.0/8")], ip_address("::ffff:10.1.1.1"))
    assert not holds([ip_network("::/0")], ip_address("::ffff:10.1.1.1"))
    assert not holds([], ip_address("10.1.1.1"))


@pytest.mark.usefixtures("ipv6")
@pytest.mark.parametrize(("source", "is_held"), [("127.0.0.0/8", True), ("::/0", False)])
def test_the_native_side_takes_a_mapped_address_for_the_same(source: str, is_held: bool) -> None:
    """A listener on `::` sees an IPv4 peer mapped."""
    assert holds([ip_network(source)], ip_address("::ffff:127.0.0.1")) is is_held
    memory = holdfast.Memory(holding_registers=1)
    with holdfast.Server({1: memory}, bind="[::]:0", access="read-only", sources=[source]) as one:
        url = f"tcp://127.0.0.1:{one.address[1]}"
        with holdfast.SyncClient(url, timeout=wire.DEADLINE) as client:
            if is_held:
                assert client.read_holding_registers(0, 1) == [0]
            else:
                with pytest.raises(holdfast.ConnectionLost):
                    client.read_holding_registers(0, 1)


def test_covers_is_about_all_addresses_of_a_network() -> None:
    halves = [ip_network("10.0.0.0/9"), ip_network("10.128.0.0/9")]
    assert covers(halves, ip_network("10.0.0.0/8"))
    assert not covers(halves[:1], ip_network("10.0.0.0/8"))
    assert not covers([ip_network("::/0")], ip_network("10.0.0.0/8"))


@pytest.mark.parametrize(
    ("host", "name"),
    [
        ("PLC.Factory.local.", "plc.factory.local"),
        ("[FD00::1]", "fd00::1"),
        ("fd00:0::1", "fd00::1"),
        ("::ffff:10.0.0.7", "10.0.0.7"),
        ("10.0.0.7", "10.0.0.7"),
    ],
)
def test_a_certificate_names_an_address_without_brackets_and_a_name_in_lower_case(
    host: str, name: str
) -> None:
    assert certificate_name(host) == name


def test_ipv6_has_brackets_before_a_port() -> None:
    hosts = "fd00::1", "[fd00::1]", "10.0.0.7", "plc"
    assert [bracketed(each) for each in hosts] == [
        "[fd00::1]",
        "[fd00::1]",
        "10.0.0.7",
        "plc",
    ]
    assert (joined("::1", 502), joined("plc", 802)) == ("[::1]:502", "plc:802")
    assert (unbracketed("[::1]"), unbracketed("plc")) == ("::1", "plc")


def test_a_host_is_an_address_or_a_name() -> None:
    assert address_in("[::1]") == ip_address("::1")
    assert [address_in(host) for host in ("plc", "", "10.0.0", "[]", "10.0.0.7:502")] == [None] * 5


def test_what_listens_everywhere_is_reached_on_this_machine() -> None:
    assert [reachable(host) for host in ("0.0.0.0", "::", "10.0.0.7")] == [
        "127.0.0.1",
        "127.0.0.1",
        "10.0.0.7",
    ]


@pytest.mark.parametrize(
    ("sources", "host"),
    [
        (["127.0.0.0/8"], "127.0.0.1"),
        (["::1/128"], "::1"),
        (["::/0"], "::1"),
        (["::1/128", "127.0.0.1/32"], "127.0.0.1"),
        (["10.0.0.0/8"], "127.0.0.1"),
    ],
)
def test_what_listens_everywhere_is_reached_from_a_source_that_it_admits(
    sources: list[str], host: str
) -> None:
    networks = [ip_network(each) for each in sources]
    assert reachable("::", networks) == host
    assert reachable("0.0.0.0", networks) == "127.0.0.1"
    assert reachable("fd00::9", networks) == "fd00::9"
