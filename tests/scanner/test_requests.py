"""What the scanner refuses: whole, with a reason, and without any change."""

from __future__ import annotations

import json
import socket
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import jsonschema_rs
import pytest

from holdfast.client.serial_settings import SerialTarget
from holdfast.client.url import NetworkTarget
from holdfast.config.values.scanner_settings import parse_pollable
from holdfast.scanner.errors import Refused
from holdfast.scanner.messages.schema import json_schema
from holdfast.scanner.polling.allowed_devices import AllowedDevices
from holdfast.scanner.subscriptions.conflicts import check_settings
from holdfast.scanner.subscriptions.request_rules import ScannerLimits
from support.brokers import free_port
from support.nats_bus import leaving, subscription, tag
from support.paths import ROOT

if TYPE_CHECKING:
    import holdfast
    from support.nats_bus import Caller, Run, Running


WRONG: list[tuple[dict[str, Any], str]] = [
    ({"deviceId": None}, "Expected `str`, got `null` - at `$.deviceId`"),
    ({"deviceId": ""}, "Expected `str` of length >= 1 - at `$.deviceId`"),
    ({"deviceId": "a\r\nPUB x 0"}, "deviceId is 'a\\r\\nPUB x 0', allowed: printable"),
    ({"port": "502.5"}, "Expected `int | null`, got `"),
    ({"port": "0x1f6"}, "Expected `int | null`, got `str` - at `$.port`"),
    ({"port": "1e99"}, "Expected `int"),
    ({"unitId": True}, "Expected `int | null`, got `bool` - at `$.unitId`"),
    ({"unitId": "one"}, "Expected `int | null`, got `str` - at `$.unitId`"),
    ({"byteOrder": "Big"}, "tags[0]: order 'Big' is unknown, allowed: ABCD"),
    ({"byteOrder": "middle"}, "tags[0]: order 'middle' is unknown, allowed: ABCD"),
    ({"tags": [tag("a", 0, "string:2", functionCode="coil")]}, "functionCode coil reads boolean"),
    ({"tags": [tag("a", 0, "uint16[2]", functionCode="coil")]}, "functionCode coil reads boolean"),
    ({"tags": [tag("a", 0, writable="false")]}, "got `str` - at `$.tags[0].writable`"),
    ({"subscriberId": 7}, "Expected `str`, got `int` - at `$.subscriberId`"),
    ({"host": None}, "host is missing: give host or url"),
    ({"host": "10.0.0.010"}, "host is '10.0.0.010', allowed: a host name, an IPv4 address of"),
    ({"host": 5}, "Expected `str | null`, got `int` - at `$.host`"),
    ({"port": 0}, "Expected `int` >= 1 - at `$.port`"),
    ({"url": "tcp://127.0.0.1"}, "both url and host are given, allowed: only one"),
    (
        {"host": None, "port": None, "url": "http://127.0.0.1"},
        "url: 'http://127.0.0.1' is not the URL",
    ),
    ({"host": None, "port": None, "url": "tls://127.0.0.1?ca=/etc/passwd"}, "url: ca is given, al"),
    ({"host": None, "port": None, "url": "tls://127.0.0.1?cert=a&key=b"}, "url: cert is given, al"),
    ({"host": None, "port": None, "url": "tls://127.0.0.1?sni=a"}, "url: sni is given, allo"),
    ({"host": None, "port": None, "unitId": 0, "url": "rtu:///dev/ttyS0"}, "unitId is 0, which is"),
    ({"plan": {"forbidden": [[0, 1]] * 33}}, "Expected `array` of length <= 32"),
    ({"unitId": 256}, "Expected `int` <= 255 - at `$.unitId`"),
    ({"transport": "rtu+tcp", "unitId": 0}, "unitId is 0, which is the broadcast of a serial line"),
    (
        {"transport": "can"},
        "at `$.transport`, allowed: tcp, tls, udp, rtu+tcp, ascii+tcp, rtu+udp",
    ),
    ({"byteOrder": "ABDC"}, "tags[0]: order 'ABDC' is unknown, allowed: ABCD"),
    ({"scanRate": 86_400_001}, "scanRate is 86400001, allowed: "),
    ({"scanRate": 100.5}, "Expected `int | null`, got `float` - at `$.scanRate`"),
    ({"timeout": 5}, "timeout is 5, allowed: 10 to 30000 ms"),
    ({"publish": "always"}, "at `$.publish`, allowed: scan, change"),
    ({"deadband": 1}, 'deadband requires "publish": "change"'),
    ({"deadband": -1, "publish": "change"}, "Expected `float` >= 0.0 - at `$.deadband`"),
    ({"plan": {"max_registers": 126}}, "Expected `int` <= 125 - at `$.plan.max_registers`"),
    ({"plan": {"maxGap": 1}}, "Object contains unknown field `maxGap` - at `$.plan`"),
    ({"plan": {"readable": [[5, 4]]}}, "plan.readable[0] is [5, 4], allowed: [area,] first, last"),
    ({"plan": {"readable": [["coil", 4]]}}, "plan.readable[0] is ['coil', 4], allowed: "),
    ({"plan": {"readable": [[1, 2, 3]]}}, "plan.readable[0] is [1, 2, 3], allowed: "),
    ({"plan": {"forbidden": [[0, 9]]}}, "tag 'a' from address 5: plan.forbidden contains 0 to 9"),
    ({"tags": None}, "Expected `array`, got `null` - at `$.tags`"),
    (
        {"tags": [tag("a", 0) | {"address": 0.5}]},
        "Expected `int`, got `float` - at `$.tags[0].address`",
    ),
    (
        {"tags": [tag("a", 0, encoding="ascii")]},
        "tags[0]: encoding 'ascii' is for strings, not for uint16",
    ),
    ({"tags": [tag("a", 0, "string:2", encoding="x")]}, "tags[0]: encoding 'x' is unknown"),
    (
        {"tags": [tag("a", 0, "uint16[124]", writable=True)]},
        "tags[0]: uint16[124] has 124 registers, one request writes at most 123",
    ),
    (
        {"tags": [tag("a", 0, "boolean[1969]", functionCode="coil", writable=True)]},
        "tags[0]: boolean[1969] has 1969 coils, one request writes at most 1968",
    ),
    (
        {"tags": [tag("a", 0, "bit:3[2]", writable=True)]},
        "tags[0]: bit:3[2] can't be written, only one bit can",
    ),
    ({"tags": [{"id": "a"}]}, "Object missing required field `address` - at `$.tags[0]`"),
    ({"tags": [tag("", 0)]}, "Expected `str` of length >= 1 - at `$.tags[0].id`"),
    ({"tags": [tag("a", -1)]}, "Expected `int` >= 0 - at `$.tags[0].address`"),
    (
        {"tags": [tag("a", 65535, "int32")]},
        "tags[0]: int32 from address 65535: the last address is",
    ),
    ({"tags": [tag("a", 0, "int8")]}, "tags[0]: type 'int8' is unknown, allowed:"),
    *(
        ({"tags": [tag("a", 0) | {key: "x" * (most + 1)}]}, f"of length <= {most} - at `$.tags[0]")
        for key, most in (("datatype", 64), ("byteOrder", 64), ("description", 4096))
    ),
    ({"byteOrder": "x" * 65}, "of length <= 64 - at `$.byteOrder`"),
    ({"tags": [tag("a", 0, "string:252")]}, "tag 'a': string:252 has 126 registers, one request"),
    ({"tags": [tag("a", 0, functionCode="coils")]}, "allowed: coil, discrete, holding, input"),
    ({"tags": [tag("a", 0, byteOrder="CDABGHEF")]}, "order CDABGHEF is for 8 bytes"),
    ({"tags": [tag("a", 0, null=[70000])]}, "tags[0].null: 70000 is outside 0 to 65535 of uint16"),
    ({"tags": [tag("a", 0, null=["nan"])]}, "tags[0].null: 'nan'"),
    ({"tags": [tag("a", 0, "bytes:2", null=["AA=="])]}, "tags[0].null: not supported for bytes:2"),
]

SLOPPY: list[tuple[dict[str, Any], str]] = [
    ({"scanRate": 49}, "scanRate is 49, allowed: 50 to 86400000 ms"),
    ({"scanRate": 0}, "scanRate is 0, allowed: 50 to 86400000 ms"),
    ({"port": "502"}, "Expected `int | null`, got `str` - at `$.port`"),
    ({"unitId": "1"}, "Expected `int | null`, got `str` - at `$.unitId`"),
    ({"scanrate": 100}, "Object contains unknown field `scanrate`"),
    ({"tags": [tag("a", 0), tag("a", 1)]}, "tags[1]: duplicate id 'a'"),
    (
        {"tags": [tag("a", 0, functionCode="coil")]},
        "datatype is uint16, functionCode coil reads boolean",
    ),
    (
        {"tags": [tag("a", 0, functionCode="input", writable=True)]},
        "functionCode input is not writable",
    ),
    ({"tags": [tag("a", 0, unit="V")]}, "Object contains unknown field `unit` - at `$.tags[0]`"),
]
"""Requests that only a strict scanner refuses."""


@pytest.mark.parametrize("strict", [False, True])
@pytest.mark.parametrize("known", [False, True])
def test_a_request_with_anything_wrong_is_refused_and_changes_nothing(
    run_scanner: Run, caller: Caller, server: holdfast.Server, strict: bool, known: bool
) -> None:
    run_scanner(strict=strict)
    if known:
        first = subscription(server, tag("known", 9), scanRate=60_000)
        assert caller.request("modbus.subscribe", first)["success"]
    before = _browsed(caller)
    for change, error in [*WRONG, *(SLOPPY if strict else [])]:
        right = subscription(server, tag("a", 5), tag("b", 6))
        answer = caller.request("modbus.subscribe", right | change)
        assert answer["success"] is False
        assert error in answer["error"], (change, answer)
    nested = f'{{"deviceId": {"[" * 600}1{"]" * 600}}}'
    for text in ("", "{", "[]", "7", "\xff", '{"deviceId": "plc1"}', nested):
        assert caller.request("modbus.subscribe", text)["success"] is False
        refused = caller.request("modbus.unsubscribe", text)
        assert (refused["success"], "internal" in refused["error"]) == (False, False)
    long = "x" * 257
    for change in ({"deviceId": long[:129]}, {"subscriberId": long}):
        refused = caller.request("modbus.unsubscribe", leaving("known") | change)
        assert f"`str` of length <= {128 if 'deviceId' in change else 256}" in refused["error"]
    if strict:
        unknown = caller.request("modbus.unsubscribe", leaving("known", all=True))
        assert unknown == {"success": False, "error": "Object contains unknown field `all`"}
    assert _browsed(caller) == before


@pytest.mark.parametrize("strict", [False, True])
def test_ids_that_no_tag_can_have_are_ignored_by_an_unsubscribe(
    run_scanner: Run, caller: Caller, server: holdfast.Server, strict: bool
) -> None:
    run_scanner(strict=strict)
    for wrong in ("", "x" * 257):
        assert caller.request("modbus.subscribe", subscription(server, tag("a", 5)))["success"]
        assert caller.request("modbus.unsubscribe", leaving(wrong, "a")) == {"success": True}
        assert caller.request("modbus.browse", b"")["count"] == 0


def _browsed(caller: Caller) -> Any:
    """All that browsing tells apart from what moves by itself."""
    answer = caller.request("modbus.browse", b"")
    del answer["service"]
    for device in answer["devices"]:
        for key in ("scans", "missed", "roundTrip", "lastAnswer", "state", "stateSince"):
            device.pop(key, None)
        del device["blocks"]
    return answer


@pytest.mark.usefixtures("scanner")
@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"port": 1}, "plc1 is known as tcp://127.0.0.1:{port} unit 1, not as tcp://127.0.0.1:1"),
        ({"unitId": 2}, "plc1 is known as"),
        ({"transport": "udp"}, "plc1 is known as"),
        ({"host": "localhost"}, "plc1 is known as"),
        ({"timeout": 2000}, "timeout of plc1 is "),
        ({"release": True}, "release of plc1 is "),
        ({"plan": {"max_gap": 0}}, "plan of plc1 is "),
        ({"tags": [tag("b", 0), tag("a", 6)]}, "tag 'a' of plc1 already has another definition"),
        ({"tags": [tag("b", 0), tag("a", 5, "int16")]}, "tag 'a' of plc1 already has another"),
        ({"tags": [tag("a", 5, functionCode="input")]}, "tag 'a' of plc1 already has another"),
        ({"tags": [tag("a", 5, null=[0])]}, "tag 'a' of plc1 already has another"),
        ({"byteOrder": "DCBA"}, "tag 'a' of plc1 already has another"),
    ],
)
def test_what_another_subscriber_uses_is_not_replaced(
    caller: Caller, server: holdfast.Server, change: dict[str, Any], error: str
) -> None:
    who = "historian"
    right = subscription(server, tag("a", 5), scanRate=60_000)
    assert caller.request("modbus.subscribe", right) == {"success": True, "count": 1}
    before = _browsed(caller)
    answer = caller.request("modbus.subscribe", right | {"subscriberId": who} | change)
    assert not answer["success"]
    assert error.format(port=server.address[1]) in answer["error"]
    assert answer["error"].endswith("; hmi must unsubscribe first")
    assert _browsed(caller) == before
    again = right | {"subscriberId": who, "byteOrder": "ABCD", "transport": "tcp"}
    assert caller.request("modbus.subscribe", again) == {"success": True, "count": 1}


def test_limits_are_kept_and_told(
    run_scanner: Run, caller: Caller, server: holdfast.Server
) -> None:
    run_scanner(limits=ScannerLimits(devices=2, tags=5, device_tags=3, subscribers=2, request=2000))

    def ask(device: str, who: str, *ids: str) -> Any:
        tags = [tag(id, 0) for id in ids]
        request = subscription(server, *tags, deviceId=device, subscriberId=who, scanRate=60_000)
        return caller.request("modbus.subscribe", request)

    assert ask("d1", "a", "1", "2", "3", "4")["error"] == "d1 would have 4 tags, allowed: 3"
    assert ask("d1", "a", "1", "2")["success"]
    assert ask("d1", "b", "3")["success"]
    assert ask("d1", "b", "4")["error"] == "d1 would have 4 tags, allowed: 3"
    assert ask("d1", "c", "3")["error"] == "d1 already has 2 subscribers, which is the limit"
    assert ask("d2", "a", "1", "2", "3")["error"] == "there would be 6 tags, allowed: 5"
    assert ask("d2", "a", "1", "2")["success"]
    assert ask("d3", "a", "1")["error"] == "there are already 2 devices, which is the limit"
    assert "allowed: 2000" in ask("d2", "a", "x" * 2000)["error"]

    left = leaving("1", "2", deviceId="d2", subscriberId="a")
    assert caller.request("modbus.unsubscribe", left)["success"]
    assert ask("d3", "a", "1", "2")["success"]


def test_hosts_beyond_private_and_loopback_addresses_are_refused_after_they_are_looked_up(
    scanner: Running, caller: Caller, server: holdfast.Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    del scanner
    real = socket.getaddrinfo

    def names(host: Any, *rest: Any, **more: Any) -> Any:
        known = {"plc.test": "127.0.0.1", "evil.test": "93.184.216.34"}
        if host == "nobody.test":
            raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")
        return real(known.get(host, host), *rest, **more)

    monkeypatch.setattr(socket, "getaddrinfo", names)
    for host in ("93.184.216.34", "evil.test", "169.254.169.254", "0.0.0.0", "::ffff:8.8.8.8"):
        answer = caller.request("modbus.subscribe", subscription(server, tag("a", 0), host=host))
        assert f"{host}" in answer["error"]
        assert "is not allowed, allowed: 127.0.0.0/8, 10.0.0.0/8" in answer["error"]
    missing = subscription(server, tag("a", 0), host="nobody.test")
    assert "host nobody.test: " in caller.request("modbus.subscribe", missing)["error"]

    data = caller.listen("modbus.data.plc1")
    named = subscription(server, tag("a", 0), host="plc.test")
    assert caller.request("modbus.subscribe", named)["success"]
    data.next()
    [found] = caller.request("modbus.browse", b"")["devices"]
    assert found["url"] == f"tcp://plc.test:{server.address[1]}"
    assert found["address"] == f"tcp://127.0.0.1:{server.address[1]}"


def test_networks_that_are_given_take_the_place_of_the_private_ones(
    run_scanner: Run, caller: Caller, server: holdfast.Server
) -> None:
    run_scanner(allow=("192.0.2.0/24", "2001:db8::/32"))
    answer = caller.request("modbus.subscribe", subscription(server, tag("a", 0)))
    assert answer["error"] == "127.0.0.1 is not allowed, allowed: 192.0.2.0/24, 2001:db8::/32"
    for host in ("192.0.2.7", "2001:db8::7", "::ffff:192.0.2.8"):
        request = subscription(server, tag("a", 0), host=host, deviceId=host)
        assert caller.request("modbus.subscribe", request)["success"]


def test_devices_on_one_serial_line_have_the_same_settings(
    run_scanner: Run, caller: Caller
) -> None:
    run_scanner(allow=("/dev/ttyNONE0", "/dev/ttyNONE1"))

    def ask(id: str, url: str, who: str = "x") -> Any:
        request = {"deviceId": id, "subscriberId": who, "url": url, "tags": [tag("a", 0)]}
        return caller.request("modbus.subscribe", request)

    assert ask("one", "rtu:///dev/ttyNONE0?baud=9600")["success"]
    for url, error in (
        ("rtu:///dev/ttyNONE0", "baud of rtu:///dev/ttyNONE0 is already 9600 for one, not 19200"),
        (
            "rtu:///dev/ttyNONE0?baud=9600&parity=none",
            "parity of rtu:///dev/ttyNONE0 is already even for one",
        ),
        ("ascii:///dev/ttyNONE0?baud=9600", "mode of rtu:///dev/ttyNONE0 is already rtu for one"),
        ("rtu:///dev/ttyNONE0?baud=9600&silence=0.1", "is already the default for one, not 0.1"),
        ("rtu:///dev/ttyNONE0?baud=9600&rs485=rts", "rs485 of rtu:///dev/ttyNONE0 is already"),
    ):
        assert error in ask("two", url)["error"]
    assert "baud 9600" in ask("one", "rtu:///dev/ttyNONE0", "y")["error"]
    assert ask("two", "rtu:///dev/ttyNONE0?baud=9600&parity=even")["success"]
    assert ask("three", "rtu:///dev/ttyNONE1")["success"]


@pytest.mark.parametrize(
    "place", ["tcp://127.0.0.1:{}", "rtu+udp://127.0.0.1:{}", "tls://127.0.0.1:{}"]
)
def test_devices_at_one_address_have_the_same_tolerance(
    run_scanner: Run, caller: Caller, place: str
) -> None:
    run_scanner()
    place = place.format(free_port())

    def ask(id: str, url: str, who: str = "x") -> Any:
        request = {"deviceId": id, "subscriberId": who, "url": url, "tags": [tag("a", 0)]}
        return caller.request("modbus.subscribe", request)

    assert ask("one", f"{place}?pad=1&retries=2")["success"]
    for url, error in (
        (place, "pad of {} is already True for one, not False; devices at one address have the"),
        (place.replace("127.0.0.1", "[::ffff:127.0.0.1]"), "pad of {} is already True for one"),
        (f"{place}?pad=1&retries=1", "retries of {} is already 2 for one, not 1"),
        (
            f"{place}?pad=1&retries=2&accept_unit=any",
            "accept_unit of {} is already the default for one",
        ),
    ):
        assert error.format(place) in ask("two", url)["error"]
    assert f"one is known as {place} (pad True, retries 2)" in ask("one", place, "y")["error"]
    assert ask("two", f"{place}?retries=2&pad=1")["success"]


def test_a_serial_device_is_refused_that_is_not_named(scanner: Running, caller: Caller) -> None:
    del scanner
    request = {
        "deviceId": "meter",
        "subscriberId": "x",
        "url": "rtu:///dev/ttyUSB7?baud=9600",
        "tags": [tag("a", 0)],
    }
    answer = caller.request("modbus.subscribe", request)
    assert answer["error"] == (
        "/dev/ttyUSB7 is not allowed; allow it with --allow, or in nats.devices of the "
        "configuration"
    )


def test_a_host_with_several_addresses_is_tried_at_one_after_the_other(
    caller: Caller, monkeypatch: pytest.MonkeyPatch
) -> None:
    def two(host: str, port: int, **_: Any) -> Any:
        del host
        return [
            (socket.AF_INET6, 1, 6, "", ("fd00::1", port, 0, 0)),
            (socket.AF_INET, 1, 6, "", ("10.0.0.1", port)),
            (socket.AF_INET, 1, 6, "", ("8.8.8.8", port)),
            (socket.AF_INET, 1, 6, "", ("10.0.0.2", port)),
        ]

    monkeypatch.setattr(socket, "getaddrinfo", two)
    allowed, asked = AllowedDevices(), NetworkTarget("tcp", "plc", 502)
    found = [caller.do(allowed.address(asked))]
    for _ in range(3):
        found.append(caller.do(allowed.address(asked, after=found[-1])))
    hosts = [each.host for each in found if isinstance(each, NetworkTarget)]
    assert hosts == ["10.0.0.1", "10.0.0.2", "fd00::1", "10.0.0.1"]


def test_a_serial_line_has_one_name() -> None:
    one: Any = SimpleNamespace(
        id="one", source=SimpleNamespace(target=SerialTarget("rtu", "/dev/ttyNONE0"))
    )
    check_settings(SerialTarget("rtu", "/dev/ttyNONE0"), one)
    with pytest.raises(
        Refused, match="are one serial line, and one uses /dev/ttyNONE0: use /dev/ttyN"
    ):
        check_settings(SerialTarget("rtu", "/dev/serial/by-id/none"), one)


def test_serial_devices_beside_networks(caller: Caller) -> None:
    line_only = [parse_pollable("/dev/ttyUSB0")]
    allowed = AllowedDevices([*line_only, parse_pollable("10.0.0.0/8")])
    line = SerialTarget("rtu", "/dev/ttyUSB0")
    assert caller.do(allowed.address(line)) == line
    with pytest.raises(Refused):
        caller.do(allowed.address(SerialTarget("rtu", "/etc/passwd")))
    device = NetworkTarget("tcp", "10.1.2.3", 502)
    assert caller.do(allowed.address(device)) == device
    with pytest.raises(Refused, match=r"10\.1\.2\.3 is not allowed, allowed: serial devices only"):
        caller.do(AllowedDevices(line_only).address(device))


@pytest.mark.parametrize("entry", ["10.0.0.1/8", "plc", "::ffff:10.0.0.1", "COMPANY"])
def test_what_is_no_device_can_not_be_allowed(entry: str) -> None:
    with pytest.raises(ValueError, match="found"):
        parse_pollable(entry)


def test_the_schema_of_the_docs_is_that_of_the_program() -> None:
    kept = json.loads((ROOT / "docs" / "scanner.schema.json").read_text())
    assert kept == json_schema(), "run `holdfast scan --schema > docs/scanner.schema.json`"


def test_the_schema_takes_what_the_program_takes(server: holdfast.Server) -> None:
    document = json_schema() | {"$ref": "#/$defs/SubscribeRequest"}
    validator = jsonschema_rs.validator_for(document)
    right = subscription(server, tag("a", 0, null=["nan", -9999]), plan={"readable": [[1, 2]]})
    assert validator.is_valid(right)
    assert validator.is_valid(right | {"port": None})
    wrong: list[dict[str, Any]] = [{"port": 0}, {"tags": 1}, {"more": 1}, {"transport": "can"}]
    for change in wrong:
        assert not validator.is_valid(right | change)
