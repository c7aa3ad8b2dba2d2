"""Allow lists: which addresses, ports and serial devices may be connected to."""

from __future__ import annotations

import asyncio
from ipaddress import ip_address
from typing import TYPE_CHECKING

import pytest

from holdfast.config.values.allow_entries import parse_allowed
from holdfast.config.values.scanner_settings import parse_pollable
from holdfast.net.allow_list import AllowList, NotAllowed
from holdfast.net.resolver import NoSuchName
from holdfast.types import TRANSPORTS

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable


@pytest.mark.parametrize(
    ("address", "port", "allowed"),
    [
        ("10.1.2.3", 502, True),
        ("10.1.2.3", 503, False),
        ("11.0.0.1", 502, False),
        ("::ffff:10.1.2.3", 502, True),
        ("::ffff:11.0.0.1", 502, False),
        ("192.168.1.7", 5029, True),
        ("192.168.1.7", 5030, False),
        ("fd12::1", 502, True),
        ("fe80::1", 502, False),
        ("::1", 502, False),
        ("64:ff9b::a01:203", 502, False),
    ],
)
def test_the_list_says_which_addresses(address: str, port: int, allowed: bool) -> None:
    entries = ["10.0.0.0/8", "192.168.1.0/24:5020-5029", "[fd00::]/8"]
    listed = AllowList(map(parse_allowed, entries))
    assert listed.allows(ip_address(address), port, "tcp") is allowed


@pytest.mark.parametrize(
    ("entry", "port", "transports"),
    [
        ("10.0.0.0/8", 502, {"tcp", "udp", "rtu+tcp", "ascii+tcp", "rtu+udp", "tls"}),
        ("10.0.0.0/8", 802, {"tls"}),
        ("10.0.0.0/8:502", 802, set()),
        ("10.0.0.0/8:802", 802, {"tcp", "udp", "rtu+tcp", "ascii+tcp", "rtu+udp", "tls"}),
        ("10.0.0.0/8:802", 502, set()),
    ],
)
def test_without_ports_only_tls_may_go_to_802(entry: str, port: int, transports: set[str]) -> None:
    listed, address = AllowList([parse_allowed(entry)]), ip_address("10.1.2.3")
    assert {each for each in TRANSPORTS if listed.allows(address, port, each)} == transports


@pytest.mark.parametrize("port", [1, 502, 802, 65535])
def test_a_network_of_the_scanner_has_all_its_ports(port: int) -> None:
    listed = AllowList([parse_pollable("10.0.0.0/8")])
    assert all(listed.allows(ip_address("10.1.2.3"), port, each) for each in TRANSPORTS)
    assert not any(listed.allows(ip_address("11.1.2.3"), port, each) for each in TRANSPORTS)


EVERYTHING = (
    AllowList(map(parse_allowed, ["0.0.0.0/0:*", "[::]/0:*"])),
    AllowList(map(parse_pollable, ["0.0.0.0/0", "::/0"])),
)


@pytest.mark.parametrize("address", ["0.0.0.0", "::", "224.0.0.1", "ff02::1", "::ffff:0.0.0.0"])
@pytest.mark.parametrize("everything", EVERYTHING, ids=["gateway", "scanner"])
def test_no_list_lets_one_to_everybody_or_nobody(everything: AllowList, address: str) -> None:
    assert everything.allows(ip_address("10.0.0.1"), 502, "tcp")
    assert not everything.allows(ip_address(address), 502, "tcp")


def test_a_serial_device_is_allowed_by_its_path_only() -> None:
    listed = AllowList(map(parse_pollable, ["/dev/ttyUSB0", "COM3", "10.0.0.0/8"]))
    paths = ["/dev/ttyUSB0", "/dev/ttyUSB1", "/dev/../dev/ttyUSB0", "COM3", "com3", "10.0.0.0/8"]
    assert [path for path in paths if listed.allows_device(path)] == ["/dev/ttyUSB0", "COM3"]


def naming(**names: list[str]) -> Callable[[str], Awaitable[list[str]]]:
    """A resolver that knows these names."""

    async def resolve(host: str) -> list[str]:
        if host not in names:
            raise NoSuchName(host, "Name or service not known")
        return names[host]

    return resolve


PLANT = AllowList(map(parse_allowed, ["10.0.0.0/8", "[fd00::]/8"]))


def test_the_addresses_of_a_name_are_those_in_the_list_ipv4_first_and_each_once() -> None:
    found = ["fd00::1", "8.8.8.8", "10.0.0.2", "::ffff:10.0.0.1", "10.0.0.1", "::1"]
    addresses = asyncio.run(PLANT.addresses("plc", 502, "tcp", naming(plc=found)))
    assert addresses == ("10.0.0.2", "10.0.0.1", "fd00::1")


@pytest.mark.parametrize(
    ("host", "address"),
    [
        ("10.0.0.7", "10.0.0.7"),
        ("::ffff:10.0.0.7", "10.0.0.7"),
        ("[fd00::7]", "fd00::7"),
        ("fd00:0:0::7", "fd00::7"),
    ],
)
def test_an_address_is_not_looked_up(host: str, address: str) -> None:
    assert asyncio.run(PLANT.addresses(host, 502, "tcp", naming())) == (address,)


def test_what_is_not_allowed_tells_the_addresses_of_a_name() -> None:
    resolve = naming(plc=["8.8.8.8", "::1"])
    for host, found in (("plc", ("8.8.8.8", "::1")), ("8.8.8.8", ()), ("::ffff:8.8.8.8", ())):
        with pytest.raises(NotAllowed) as refused:
            asyncio.run(PLANT.addresses(host, 502, "tcp", resolve))
        assert (refused.value.host, refused.value.found) == (host, found)
    with pytest.raises(NotAllowed):
        asyncio.run(PLANT.addresses("10.0.0.7", 503, "tcp", resolve))
