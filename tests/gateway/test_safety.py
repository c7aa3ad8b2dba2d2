"""The gateway against those who mean harm: whom it talks to, who may ask, and how much."""

from __future__ import annotations

import asyncio
import hashlib
import json
import re
import signal
import socket
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from ipaddress import ip_network
from typing import TYPE_CHECKING, Any, cast

import pytest
from click.testing import CliRunner

import holdfast
from holdfast.cli import main
from holdfast.cli.services.gateway import _greeting_text
from holdfast.client.url import NetworkTarget
from holdfast.config.values.allow_entries import parse_allowed
from holdfast.gateway import GatewayLimits, Settings, token_file
from support import cli, gateways, web, wire
from support.fake_device import FakeDevice, exception, registers
from support.gateways import PLC, Dialed, Names
from support.machine import needs_127_0_0_2

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from holdfast.types import Transport

SECRET = "correct-horse-battery-staple"
TOKENS = (("edge", hashlib.sha256(SECRET.encode()).digest()),)

WRITES: dict[str, dict[str, Any]] = {
    "/write/coil": {"address": 0, "value": True},
    "/write/coils": {"address": 0, "values": [True]},
    "/write/register": {"address": 0, "value": 1},
    "/write/registers": {"address": 0, "values": [1]},
    "/write/mask": {"address": 0, "andMask": 0, "orMask": 1},
    "/readwrite": {"readAddress": 0, "readQuantity": 1, "writeAddress": 0, "values": [1]},
    "/diagnostics": {"subFunction": 1},
}

LONG_MS = 60_000
"""The timeout of a request that is pending until its device is stopped."""


def read(device: FakeDevice, **more: Any) -> dict[str, Any]:
    """The body of a read of a device."""
    return {"host": "127.0.0.1", "port": device.port, "functionCode": 3, "address": 0, **more}


def write(device: FakeDevice) -> dict[str, Any]:
    """The body of a write to a device."""
    return {"host": "127.0.0.1", "port": device.port, "address": 0, "value": 1}


# The egress list.


@pytest.mark.parametrize(
    ("text", "means"),
    [
        ("10.0.0.0/8", "10.0.0.0/8"),
        ("10.0.0.5", "10.0.0.5"),
        ("10.0.0.5:5020", "10.0.0.5:5020"),
        ("10.0.0.0/24:502-510", "10.0.0.0/24:502-510"),
        ("10.0.0.5:*", "10.0.0.5:*"),
        ("0.0.0.0/0:*", "0.0.0.0/0:*"),
        ("[fd00::]/8", "[fd00::]/8"),
        ("[fd00::5]:502", "[fd00::5]:502"),
        ("[fd00::5]:1502", "[fd00::5]:1502"),
        ("[::]/0:*", "[::]/0:*"),
    ],
)
def test_an_entry_is_a_network_and_ports(text: str, means: str) -> None:
    assert str(parse_allowed(text)) == means
    assert parse_allowed(means) == parse_allowed(text)


@pytest.mark.parametrize(
    "text",
    [
        *("", "plc.local", "10.0.0.0/8:", "10.0.0.0/8:0", "10.0.0.5:65536", "10.0.0.5:9-8"),
        *("10.0.0.5/8", "10.0.0.256", "10.0.0.0/33", "10.0.0.5:502,503", "10.0.0.5:-1", "*"),
        *("fd00::/8", "fd00::5:502", "[fd00::]/129", "[fd00::1]/8", "[10.0.0.5]", "[fe80::1%0]"),
        *("::ffff:10.0.0.5", "[::ffff:10.0.0.5]:502", "127.1", "0x7f.1", "10.0.0.0/8:５０２"),
    ],
)
def test_what_is_no_entry_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="found"):
        parse_allowed(text)


@pytest.mark.parametrize(
    "host",
    [
        *("192.168.7.7", "127.0.0.1", "::1", "[::1]", "::ffff:127.0.0.1", "[::ffff:c0a8:707]"),
        *("0.0.0.0", "localhost", PLC, "evil.example"),
    ],
)
@pytest.mark.parametrize("path", ["/connect", "/write/coil", "/map", "/watch"])
def test_a_target_outside_is_refused_before_a_socket_is_opened(host: str, path: str) -> None:
    dialed = Dialed()
    names: Any = Names(plc_factory_local=[["192.0.2.1", "::1"]], evil_example=[["127.0.0.1"]])
    with gateways.running(
        allow=["10.0.0.0/8"],
        resolve=names if host in (PLC, "evil.example") else None,
        dialed=dialed,
    ) as running:
        if path == "/watch":
            query = f"?host={host}&functionCode=3&address=0"
            answer = running.client().get(gateways.API + path + query)
        else:
            answer = running.ask(path, {"host": host, **WRITES.get(path, {})})
    assert (answer.status, answer.headers["holdfast-reason"]) == (403, "refused_target")
    assert answer.json["success"] is False
    assert "egress list" in answer.json["error"]
    assert dialed.calls == []


@pytest.mark.parametrize(
    "host",
    [
        *("2130706433", "0x7f000001", "127.1", "017700000001", "999.1.1.1", "1.2.3.4."),
        *("127.0.0.1:502", "[::1]:502", "::1:", "plc.7"),
    ],
)
def test_what_is_neither_an_address_nor_a_name_is_refused(host: str) -> None:
    dialed = Dialed()
    with gateways.running(dialed=dialed) as running:
        answer = running.ask("/connect", {"host": host})
    assert (answer.status, answer.headers["holdfast-reason"]) == (400, "malformed")
    allowed = "a name or an IP address; the port is a field of its own"
    assert answer.json["error"] == f'host is "{host}", allowed: {allowed}'
    assert dialed.calls == []


def test_a_port_outside_is_refused() -> None:
    dialed = Dialed()
    with gateways.running(allow=["127.0.0.0/8"], dialed=dialed) as running:
        answer = running.ask("/connect", {"host": "127.0.0.1", "port": 22})
    assert (answer.status, dialed.calls) == (403, [])


def test_of_several_addresses_only_those_in_the_list_are_used(
    server: holdfast.Server,
) -> None:
    names = Names(plc_factory_local=[["192.0.2.1", "fd00::1", "127.0.0.1", "::ffff:127.0.0.1"]])
    dialed = Dialed()
    with gateways.running(resolve=names, dialed=dialed) as running:
        answer = running.ask("/connect", {"host": PLC, "port": server.address[1]})
    assert answer.json["success"] is True
    assert dialed.calls == [NetworkTarget("tcp", "127.0.0.1", server.address[1])]


@pytest.mark.parametrize("transport", ["tcp", "udp", "rtu+tcp"])
def test_the_address_that_was_checked_is_the_one_that_is_connected_to(
    server: holdfast.Server, transport: Transport
) -> None:
    names = Names(plc_factory_local=[["127.0.0.1"], ["192.0.2.1"]])
    dialed = Dialed()
    port = server.address[1]
    asked = {"host": PLC, "port": port, "transport": transport}
    if transport != "tcp":  # The device does not answer.
        asked["timeout"] = 200
    with gateways.running(resolve=names, dialed=dialed) as running:
        first = running.ask("/connect", asked)
        assert first.status == (200 if transport == "tcp" else 500)
        assert dialed.calls == [NetworkTarget(transport, "127.0.0.1", port)]
        assert names.asked == [PLC]
        second = running.ask("/connect", asked)
    assert (second.status, second.headers["holdfast-reason"]) == (403, "refused_target")
    assert dialed.calls == [NetworkTarget(transport, "127.0.0.1", port)]


def test_a_name_is_looked_up_once_by_a_request(
    server: holdfast.Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the real resolver's place taken: it would lead elsewhere when asked again."""
    real = socket.getaddrinfo
    asked: list[str] = []

    def changing(host: Any, *arguments: Any, **options: Any) -> Any:
        if host != PLC:
            return real(host, *arguments, **options)
        asked.append(host)
        return real("127.0.0.1" if len(asked) == 1 else "192.0.2.1", *arguments, **options)

    monkeypatch.setattr(socket, "getaddrinfo", changing)
    with gateways.running() as running:
        target = {"host": PLC, "port": server.address[1]}
        assert running.ask("/connect", target).json["success"] is True
        assert asked == [PLC]
        assert running.ask("/connect", target).status == 403
    assert asked == [PLC, PLC]


def test_a_name_that_takes_too_long_is_a_timeout_and_nothing_is_sent() -> None:
    async def slow(_: str) -> list[str]:
        never: asyncio.Future[list[str]] = asyncio.get_running_loop().create_future()
        return await never

    with gateways.running(resolve=slow) as running:
        for path, body in (("/connect", {}), ("/write/register", {"address": 0, "value": 1})):
            answer = running.ask(path, {"host": PLC, "timeout": 50, **body})
            told = f"Connection timeout: can't resolve {PLC}: no answer within 0.05 s"
            assert (answer.status, answer.json["error"]) == (500, told)
            assert answer.headers["holdfast-reason"] == "no_such_name"
        assert running.gateway.status()["writes"] == 0


def test_what_holds_a_watch_is_checked_at_every_poll(server: holdfast.Server) -> None:
    names = Names(plc_factory_local=[["127.0.0.1"], ["192.0.2.1"]])
    with gateways.running(resolve=names, limits={"interval": 0.01}) as running:
        query = f"host={PLC}&port={server.address[1]}&functionCode=3&address=0&interval=10"
        stream = running.stream("GET", f"/watch?{query}")
        assert stream.next("values")["values"] == [0]
        assert stream.next("problem")["reason"] == "refused_target"


# Writes.


@pytest.mark.parametrize("path", WRITES)
def test_without_writes_nothing_is_written(path: str) -> None:
    with FakeDevice(registers) as device, gateways.running(writes=False) as running:
        answer = running.ask(path, {"host": "127.0.0.1", "port": device.port, **WRITES[path]})
        assert (answer.status, answer.headers["holdfast-reason"]) == (403, "writes_off")
        assert answer.json["success"] is False
        assert running.ask("/read", read(device)).status == 200
        assert [pdu[0] for pdu in device.asked] == [3]


@pytest.mark.parametrize("number", [0, 2, 11, 18])
def test_diagnostics_that_change_nothing_are_no_writes(number: int) -> None:
    with FakeDevice(lambda pdu: pdu) as device, gateways.running(writes=False) as running:
        asked = {"host": "127.0.0.1", "port": device.port, "subFunction": number}
        assert running.ask("/diagnostics", asked).json["data"] == [0]


@pytest.mark.parametrize("number", [1, 3, 4, 10, 19, 20, 21, 65535])
def test_diagnostics_that_change_something_are_writes(number: int) -> None:
    with gateways.running(writes=False) as running:
        answer = running.ask("/diagnostics", {"host": "127.0.0.1", "subFunction": number})
        assert answer.headers["holdfast-reason"] == "writes_off"


def test_a_write_is_logged_without_its_value(server: holdfast.Server, log: web.Records) -> None:
    with gateways.running(tokens=TOKENS) as running:
        body = {"host": "127.0.0.1", "port": server.address[1], "address": 5, "values": [54321]}
        assert running.ask("/write/registers", body, SECRET).status == 200
        body["address"] = 5000
        assert running.ask("/write/registers", body, SECRET).json["success"] is False
    written = log.of("gateway_write")
    assert [(line["who"], line["outcome"]) for line in written] == [
        ("edge", "done"),
        ("edge", "exception 02"),
    ]
    assert written[0]["target"] == f"127.0.0.1:{server.address[1]}"
    assert "54321" not in "".join(log.lines)


def test_a_write_that_is_refused_is_logged_without_its_value(log: web.Records) -> None:
    with gateways.running() as running:
        body = {"host": "127.0.0.1", "address": 5}
        for path, value in (
            ("/write/registers", {"values": [70001]}),
            ("/write/registers", {"values": [70001], "datatype": "uint16"}),
            ("/write/register", {"value": 70001}),
            ("/write/registers", {"values": ["70001"]}),
        ):
            assert running.ask(path, {**body, **value}).status == 400
        assert running.gateway.status()["writes"] == 0
    assert len(log.of("gateway_refused")) == 4
    assert "70001" not in "".join(log.lines)


@pytest.mark.parametrize("host", ["::1", "[::1]"])
def test_an_ipv6_address_has_brackets_before_the_port(host: str, log: web.Records) -> None:
    with FakeDevice(registers) as gone:
        dialed = Dialed({("::1", 502): ("127.0.0.1", gone.port)})
    with gateways.running(allow=["[::1]/128:502"], dialed=dialed) as running:
        answer = running.ask("/write/register", {"host": host, "address": 0, "value": 1})
    assert answer.json["error"] == "can't connect to [::1]:502: Connection refused"
    assert [each["target"] for each in log.of("gateway_write")] == ["[::1]:502"]


def test_a_write_that_was_not_sent_is_told_apart(server: holdfast.Server, log: web.Records) -> None:
    with FakeDevice(registers) as gone:
        port = gone.port
    with (
        FakeDevice(lambda _: None) as mute,
        gateways.running(allow=["127.0.0.0/8:1024-65535"], resolve=Names()) as running,
    ):
        body = {"host": "127.0.0.1", "address": 0, "value": 1}
        answers = []
        for each in (port, 502, mute.port, server.address[1]):
            short = {"timeout": 500} if each == mute.port else {}
            answers.append(running.ask("/write/register", {**body, "port": each, **short}))
        answers.append(running.ask("/write/register", {**body, "host": "no-such-name.invalid"}))
        assert running.gateway.status()["writes"] == 2
    outcomes = [each["outcome"] for each in log.of("gateway_write")]
    assert outcomes == ["not sent", "refused", "failed", "done", "not sent"]
    maybe = [each.headers.get("holdfast-maybe-written") for each in answers]
    assert maybe == ["false", "false", "true", None, "false"]


@pytest.mark.parametrize(("code", "maybe"), [(2, "false"), (5, "true"), (6, "false"), (11, "true")])
def test_an_exception_says_whether_the_write_may_be_carried_out(code: int, maybe: str) -> None:
    with FakeDevice(lambda pdu: exception(pdu, code)) as device, gateways.running() as running:
        where = {"host": "127.0.0.1", "port": device.port, "address": 0}
        written = running.ask("/write/register", {**where, "value": 1}).headers
        read = running.ask("/read", {**where, "functionCode": 3, "quantity": 1}).headers
    assert written["holdfast-exception"] == read["holdfast-exception"] == str(code)
    assert written["holdfast-maybe-written"] == maybe
    assert "holdfast-maybe-written" not in read


# Tokens.


@pytest.mark.parametrize(
    ("path", "method"),
    [
        ("/api/modbus/connect", "POST"),
        ("/api/modbus/write/coil", "POST"),
        ("/api/modbus/map", "POST"),
        ("/api/modbus/watch?host=127.0.0.1&functionCode=3&address=0", "GET"),
        ("/api/gateway", "GET"),
    ],
)
@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"Authorization": f"Bearer {SECRET}x"},
        {"Authorization": f"Basic {SECRET}"},
        {"Authorization": SECRET},
        {"Authorization": "Bearer"},
        {"Cookie": f"token={SECRET}"},
    ],
)
def test_without_its_token_nobody_gets_an_answer(
    path: str, method: str, headers: dict[str, str], log: web.Records
) -> None:
    with gateways.running(tokens=TOKENS) as running:
        answer = running.client().ask(method, path, b"{}", {**web.JSON, **headers})
    assert (answer.status, answer.headers["www-authenticate"]) == (401, "Bearer")
    assert answer.json["success"] is False
    assert SECRET not in answer.body.decode() + "".join(log.lines)


def test_with_its_token_one_does(server: holdfast.Server, log: web.Records) -> None:
    with gateways.running(tokens=TOKENS) as running:
        body = {"host": "127.0.0.1", "port": server.address[1]}
        assert running.ask("/connect", body, SECRET).json["success"] is True
        assert running.client(SECRET).get("/api/gateway").json["tokens"] is True
        running.ask("/connect", {"host": "192.0.2.1"}, SECRET)
    [refused] = log.of("gateway_refused")
    assert refused["who"] == "edge"
    assert SECRET not in "".join(log.lines)


@pytest.mark.parametrize("path", ["/", "/docs", "/openapi.json", "/console/main.js"])
def test_what_holds_no_secret_needs_no_token(path: str) -> None:
    with gateways.running(tokens=TOKENS) as running:
        assert running.client().get(path).status == 200


def test_a_token_file_has_a_name_and_a_hash_on_a_line(tmp_path: Path) -> None:
    made = CliRunner().invoke(main, ["token", "--line", "--name", "edge"])
    assert made.stdout.count("\n") == 1
    file = tmp_path / "tokens"
    bare = hashlib.sha256(b"other").hexdigest()
    file.write_text(f"# who may ask\n\n{made.stdout}{bare} # no name\n")
    edge = hashlib.sha256(made.stderr.split()[-1].encode()).digest()
    assert token_file.load(file) == [("edge", edge), ("token-4", bytes.fromhex(bare))]


def test_a_token_file_may_begin_with_a_byte_order_mark(tmp_path: Path) -> None:
    file = tmp_path / "tokens"
    file.write_text(f"edge {hashlib.sha256(b'secret').hexdigest()}\n", encoding="utf-8-sig")
    assert token_file.load(file) == [("edge", hashlib.sha256(b"secret").digest())]


def test_a_token_line_shows_its_secret_once() -> None:
    made = cli.invoke("token", "--line")
    secret = made.stderr.split()[-1]
    assert made.stdout == f"edge-gateway {hashlib.sha256(secret.encode()).hexdigest()}\n"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "no token"),
        ("# nothing\n", "no token"),
        ("edge\n", ":1: no token"),
        ("edge " + "a" * 63, ":1: no token"),
        ("edge one " + "a" * 64, ":1: no token"),
        (f"{SECRET}\n", ":1: no token"),
        ("a b " + "a" * 64, ":1: no token"),
        ("/x " + "a" * 64, "name"),
        ("- " + "a" * 64, "name"),
        ("x " + hashlib.sha256(b"").hexdigest(), ":1: found the SHA-256 of an empty text"),
        ("x " + "a" * 64 + "\nx " + "b" * 64, ":2: duplicate name or token"),
        ("x " + "a" * 64 + "\ny " + "A" * 64, ":2: duplicate name or token"),
    ],
)
def test_what_is_no_token_file_is_refused(tmp_path: Path, text: str, says: str) -> None:
    file = tmp_path / "tokens"
    file.write_text(text)
    with pytest.raises(token_file.WrongTokens) as raised:
        token_file.load(file)
    assert says in str(raised.value)
    assert SECRET not in str(raised.value)


# Pages of other sites, and peers from elsewhere.


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://127.0.0.1:1"},
        {"Sec-Fetch-Site": "cross-site"},
        {"Sec-Fetch-Site": "same-site"},
        {"Host": "evil.example"},
        {"Host": "127.0.0.1.evil.example:8090"},
    ],
)
@pytest.mark.parametrize("kind", ["application/json", "application/x-www-form-urlencoded"])
def test_a_page_of_another_site_can_do_nothing(headers: dict[str, str], kind: str) -> None:
    dialed = Dialed()
    with gateways.running(dialed=dialed) as running:
        body = json.dumps({"host": "127.0.0.1", "address": 0, "value": True}).encode()
        headers = {"Content-Type": kind, **headers}
        answer = running.client().ask("POST", "/api/modbus/write/coil", body, headers)
    assert (answer.status, answer.headers["holdfast-reason"]) == (403, "foreign_page")
    assert "access-control-allow-origin" not in answer.headers
    assert dialed.calls == []


@pytest.mark.parametrize(
    "host", ["0.0.0.0", "[::]", "[::ffff:127.0.0.1]", "192.168.1.5", "[fd00::2]"]
)
def test_a_get_that_browsers_do_not_mark_asks_no_device(host: str) -> None:
    """Over HTTP, a GET of another site's page to these has no header that says so."""
    dialed = Dialed()
    query = "host=127.0.0.1&functionCode=3&address=0"
    with gateways.running(dialed=dialed) as running:
        headers = {"Host": f"{host}:{running.address[1]}"}
        answer = running.client().ask("GET", f"/api/modbus/watch?{query}", headers=headers)
    assert (answer.status, answer.headers["holdfast-reason"]) == (403, "foreign_page")
    assert dialed.calls == []


def test_its_own_page_may_watch_under_the_address_of_a_network(server: holdfast.Server) -> None:
    with gateways.running() as running:
        host = f"192.168.1.5:{running.address[1]}"
        headers = {**web.JSON, "Host": host, "Origin": f"http://{host}"}
        parts = [{"functionCode": 3, "address": 0}]
        asked = {"host": "127.0.0.1", "port": server.address[1], "parts": parts, "once": True}
        body = json.dumps(asked).encode()
        answer = running.client().ask("POST", "/api/modbus/watch/view", body, headers)
    assert (answer.status, b"event: view" in answer.body) == (200, True)


def test_its_own_page_may_ask(server: holdfast.Server) -> None:
    with gateways.running() as running:
        headers = {**web.JSON, "Origin": running.url, "Sec-Fetch-Site": "same-origin"}
        body = {"host": "127.0.0.1", "port": server.address[1]}
        assert running.client().ask("POST", "/api/modbus/connect", body, headers).status == 200


def test_with_tokens_its_name_does_not_matter() -> None:
    with gateways.running(tokens=TOKENS) as running:
        answer = running.client(SECRET).ask("GET", "/api/gateway", headers={"Host": "gw.plant"})
        assert answer.status == 200


def test_a_peer_from_elsewhere_gets_not_one_byte() -> None:
    with (
        gateways.running(sources=(ip_network("10.0.0.0/8"),)) as running,
        wire.Connection(running.address) as stranger,
    ):
        stranger.send(web.head("GET", "/"))
        assert stranger.rest() == b""
        status = running.gateway.status
        wire.until(
            lambda: cast("Any", status()["connections"])["refused_source"] == 1, "it is counted"
        )


@needs_127_0_0_2
def test_one_source_can_not_take_all_places() -> None:
    with gateways.running() as running:
        places = GatewayLimits().connections
        assert web.status_for_another(running.address, "/api/gateway", places) == 200


@pytest.mark.parametrize("path", ["/", "/console/main.js", "/console/vendor/uplot/uPlot.esm.js"])
def test_the_console_may_load_nothing_from_elsewhere(path: str) -> None:
    with gateways.running() as running:
        answer = running.client().get(path)
    policy = answer.headers["content-security-policy"]
    assert policy.startswith("default-src 'none'; ")
    assert set(re.findall(r"-src ([^;]+)", policy)) == {"'none'", "'self'"}
    assert "frame-ancestors 'none'" in policy
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers["cache-control"] == "no-store"


# Limits.


def test_a_body_that_is_too_large_is_refused() -> None:
    with gateways.running() as running:
        answer = running.ask("/connect", b" " * 65537)
        assert (answer.status, answer.headers["holdfast-reason"]) == (413, "too_large")
        assert answer.headers["connection"] == "close"


def test_a_body_that_does_not_come_is_not_waited_for() -> None:
    with gateways.running(limits={"request_timeout": 0.1}) as running:
        head = web.head("POST", "/api/modbus/connect", *["Content-Length: 9"])
        with wire.Connection(running.address) as connection:
            connection.send(head + b"{")
            [answer] = web.answers(connection.rest())
        assert (answer.status, answer.headers["holdfast-reason"]) == (408, "timeout")


def test_too_many_requests_are_told_to_come_again(server: holdfast.Server) -> None:
    asked = threading.Semaphore(0)

    def mute(_: bytes) -> None:
        asked.release()

    with (
        FakeDevice(mute) as device,
        gateways.running(limits={"requests": 1}) as running,
        ThreadPoolExecutor(1) as threads,
    ):
        waiting = threads.submit(running.ask, "/read", read(device, timeout=LONG_MS))
        assert asked.acquire(timeout=wire.DEADLINE)
        answer = running.ask("/connect", {"host": "127.0.0.1", "port": server.address[1]})
        assert (answer.status, answer.headers["retry-after"]) == (503, "1")
        assert answer.headers["holdfast-reason"] == "busy"
        device.stop()
        assert waiting.result(wire.DEADLINE).status == 500
        answer = running.ask("/connect", {"host": "127.0.0.1", "port": server.address[1]})
        assert answer.status == 200


@pytest.mark.parametrize("path", ["/read", "/watch/view"])
def test_a_dead_device_leaves_places_for_others(server: holdfast.Server, path: str) -> None:
    asked = threading.Semaphore(0)

    def mute(_: bytes) -> None:
        asked.release()

    with (
        FakeDevice(mute) as device,
        gateways.running(
            limits={"requests": 3, "requests_of_device": 2, "in_flight": 2}
        ) as running,
        ThreadPoolExecutor(2) as threads,
    ):
        body = read(device, timeout=LONG_MS)
        if path == "/watch/view":
            part = {"functionCode": body.pop("functionCode"), "address": body.pop("address")}
            body |= {"parts": [part], "once": True}
        waiting = [threads.submit(running.ask, path, body) for _ in range(2)]
        for _ in waiting:
            assert asked.acquire(timeout=wire.DEADLINE)
        answer = running.ask(path, body)
        assert answer.headers["holdfast-reason"] == "busy"
        assert f"too many requests to 127.0.0.1:{device.port}: 2 are active" in answer.json["error"]
        live = {"host": "127.0.0.1", "port": server.address[1]}
        assert running.ask("/connect", live).status == 200
        device.stop()
        assert [each.result(wire.DEADLINE).status for each in waiting] == [500, 500]
        assert running.ask(path, body).status == 500


def test_a_request_that_had_no_turn_says_that_it_was_not_sent() -> None:
    asked = threading.Semaphore(0)

    def mute(_: bytes) -> None:
        asked.release()

    with (
        FakeDevice(mute) as device,
        gateways.running() as running,
        ThreadPoolExecutor(1) as threads,
    ):
        waiting = threads.submit(running.ask, "/read", read(device, timeout=LONG_MS))
        assert asked.acquire(timeout=wire.DEADLINE)
        answer = running.ask("/read", read(device, timeout=50))
        assert (answer.status, answer.headers["holdfast-reason"]) == (500, "timeout")
        assert answer.json["error"] == (
            "Connection timeout: the request was not sent: there was no connection, or it waited "
            "behind other requests to this device"
        )
        device.stop()
        assert waiting.result(wire.DEADLINE).headers["holdfast-reason"] == "connection_lost"
        assert len(device.asked) == 1


@pytest.mark.parametrize(
    ("path", "ending"), [("/read", 0.05), ("/write/register", 0.05), ("/read", 1.5)]
)
def test_a_request_under_way_is_answered_when_the_gateway_ends(path: str, ending: float) -> None:
    asked = threading.Semaphore(0)

    def mute(_: bytes) -> None:
        asked.release()

    with (
        FakeDevice(mute) as device,
        gateways.running(limits={"ending": ending}) as running,
        ThreadPoolExecutor(1) as threads,
    ):
        body = {"/read": read(device), "/write/register": write(device)}[path]
        waiting = threads.submit(running.ask, path, {**body, "timeout": LONG_MS})
        assert asked.acquire(timeout=wire.DEADLINE)
        running.stop.set()
        answer = waiting.result(wire.DEADLINE)
    assert (answer.status, answer.headers["holdfast-reason"]) == (503, "stopping")
    fate, maybe = {
        "/read": ("", None),
        "/write/register": ("; the write may have been carried out", "true"),
    }[path]
    assert answer.json["error"] == f"the gateway is stopping{fate}"
    assert answer.headers.get("holdfast-maybe-written") == maybe


def test_a_write_that_has_not_had_its_turn_when_the_gateway_ends_was_not_sent() -> None:
    asked = threading.Semaphore(0)

    def mute(_: bytes) -> None:
        asked.release()

    with (
        FakeDevice(mute) as device,
        gateways.running(limits={"ending": 0.05}) as running,
        ThreadPoolExecutor(2) as threads,
    ):
        body = {**write(device), "timeout": LONG_MS}
        threads.submit(running.ask, "/write/register", body)
        assert asked.acquire(timeout=wire.DEADLINE)
        waiting = threads.submit(running.ask, "/write/register", body)
        wire.until(lambda: running.gateway.status()["requests"] == 2, "the second has come")
        running.stop.set()
        answer = waiting.result(wire.DEADLINE)
        assert len(device.asked) == 1
    assert answer.headers["holdfast-maybe-written"] == "false"
    assert answer.json["error"] == "the gateway is stopping; the write was not sent"


def test_a_request_that_can_still_be_done_when_the_gateway_ends_is_done() -> None:
    asked, go_on = threading.Semaphore(0), threading.Event()

    def answer(pdu: bytes) -> bytes:
        asked.release()
        assert go_on.wait(wire.DEADLINE)
        return registers(pdu, 7)

    with (
        FakeDevice(answer) as device,
        gateways.running(limits={"ending": 60}) as running,
        ThreadPoolExecutor(1) as threads,
    ):
        waiting = threads.submit(running.ask, "/read", read(device))
        assert asked.acquire(timeout=wire.DEADLINE)
        running.stop.set()
        go_on.set()
        assert waiting.result(wire.DEADLINE).json["values"] == [7]


# Requests that are none.


def received(connection: wire.Connection) -> bytes:
    """What one answer has at least."""
    connection.socket.settimeout(wire.DEADLINE)
    data = b""
    while b"}" not in data:
        piece = connection.socket.recv(65536)
        assert piece, data
        data += piece
    return data


@pytest.mark.parametrize(
    "sent",
    [
        b"FOO / HTTP/1.1\r\nHost 127.0.0.1\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: a\r\nContent-Length: 1\r\nContent-Length: 2\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost 127.0.0.1\r\n\r\n",
        b"GET / HTTP/1.1\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nHost: 127.0.0.1\r\n\r\n",
        b"GET / HTTP/1.0\r\nHost: 127.0.0.1\r\nHost: 127.0.0.1\r\n\r\n",
    ],
)
def test_what_is_no_request_is_answered_as_all_errors_are(sent: bytes) -> None:
    with gateways.running() as running, wire.Connection(running.address) as connection:
        connection.send(sent)
        [answer] = web.answers(received(connection))
    assert (answer.status, answer.headers["holdfast-reason"]) == (400, "malformed")
    assert set(answer.json) == {"success", "error"}
    assert answer.json["success"] is False


@pytest.mark.parametrize("wish", ["", "Connection: keep-alive\r\n"])
def test_a_request_of_http_1_0_needs_no_host_and_is_the_last_one(wish: str) -> None:
    with gateways.running() as running, wire.Connection(running.address) as connection:
        connection.send(f"GET /api/gateway HTTP/1.0\r\n{wish}\r\n".encode())
        [answer] = web.answers(connection.rest())
    assert (answer.status, answer.headers["connection"]) == (200, "close")


def test_too_many_streams_are_told_to_come_again(server: holdfast.Server) -> None:
    query = f"/watch?host=127.0.0.1&port={server.address[1]}&functionCode=3&address=0"
    with gateways.running(limits={"streams": 1}) as running:
        first = running.stream("GET", query)
        first.next("values")
        assert running.stream("GET", query).status == 503
        first.close()

        def is_free() -> bool:
            stream = running.stream("GET", query)
            stream.close()
            return stream.status == 200

        wire.until(is_free, "there is a place again")


def test_connections_that_nobody_uses_give_way(server: holdfast.Server) -> None:
    mute, asked = threading.Event(), threading.Semaphore(0)

    def answer(pdu: bytes) -> bytes | None:
        asked.release()
        return None if mute.is_set() else registers(pdu)

    other = {"host": "127.0.0.1", "port": server.address[1], "functionCode": 3, "address": 0}
    with (
        FakeDevice(answer) as device,
        gateways.running(limits={"devices": 1}) as running,
        ThreadPoolExecutor(1) as threads,
    ):
        for body in (read(device), other, read(device)):
            assert running.ask("/read", body).status == 200
            assert asked.acquire(timeout=0) or body is other
        mute.set()
        waiting = threads.submit(running.ask, "/read", read(device, timeout=LONG_MS))
        assert asked.acquire(timeout=wire.DEADLINE)
        assert running.ask("/read", other).status == 503
        device.stop()
        assert waiting.result(wire.DEADLINE).status == 500


# A client that goes away.


def test_a_body_that_is_no_http_is_refused_and_is_no_error_of_the_gateway(
    caplog: pytest.LogCaptureFixture,
) -> None:
    kind, chunked = "Content-Type: application/json", "Transfer-Encoding: chunked"
    head = web.head("POST", f"{gateways.API}/read", kind, chunked)
    for pieces in ([head + b"x\r\n"], [head, b"x\r\n"]):
        with gateways.running() as running, wire.Connection(running.address) as connection:
            for piece in pieces:
                connection.send(piece)
                wire.until_taken(connection.socket)
            [answer] = web.answers(connection.rest())
            assert (answer.status, answer.headers["connection"]) == (400, "close")
    assert "request_failed" not in [record.getMessage() for record in caplog.records]


def ask_and_leave(running: gateways.Running, path: str, body: Any) -> wire.Connection:
    """A request on a connection of its own, to be reset."""
    text = json.dumps(body).encode()
    connection = wire.Connection(running.address)
    length = f"Content-Length: {len(text)}"
    connection.send(web.head("POST", gateways.API + path, length) + text)
    return connection


@pytest.mark.parametrize("leave", [wire.Connection.close, wire.Connection.reset])
def test_a_client_that_goes_away_cancels_its_request(
    leave: Callable[[wire.Connection], None],
) -> None:
    asked = threading.Semaphore(0)

    def answer(pdu: bytes) -> bytes | None:
        asked.release()
        return None if pdu[2] == 1 else registers(pdu, 9)

    with FakeDevice(answer) as device, gateways.running() as running:
        gone = ask_and_leave(running, "/read", read(device, address=1, timeout=60000))
        assert asked.acquire(timeout=wire.DEADLINE)
        leave(gone)
        # It would have to wait for a minute, were the one before it still under way.
        assert running.ask("/read", read(device)).json["values"] == [9]


def test_a_write_that_waits_is_not_done_for_a_client_that_is_gone() -> None:
    asked, go_on = threading.Semaphore(0), threading.Event()

    def answer(pdu: bytes) -> bytes:
        asked.release()
        assert go_on.wait(wire.DEADLINE)
        return registers(pdu)

    with (
        FakeDevice(answer) as device,
        gateways.running(limits={"requests": 2}) as running,
        ThreadPoolExecutor(1) as threads,
    ):
        first = threads.submit(running.ask, "/read", read(device))
        assert asked.acquire(timeout=wire.DEADLINE)
        write = {"host": "127.0.0.1", "port": device.port, "address": 0, "value": 1}
        gone = ask_and_leave(running, "/write/register", write)

        def is_full() -> bool:
            return running.ask("/read", {**read(device), "timeout": 1}).status == 503

        wire.until(is_full, "the write waits")
        gone.reset()
        wire.until(lambda: not is_full(), "the write has left")
        go_on.set()
        assert first.result(wire.DEADLINE).status == 200
        assert running.ask("/read", read(device)).status == 200
        assert {pdu[0] for pdu in device.asked} == {3}


# The command.


class Command:
    """A running `holdfast gateway`."""

    def __init__(self, *arguments: str) -> None:
        words = [sys.executable, "-m", "holdfast", "gateway", "--bind", "127.0.0.1:0", *arguments]
        self.process = subprocess.Popen(
            words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        assert self.process.stdout is not None
        self.greeting = ""
        while "Ctrl-C" not in self.greeting:
            line = self.process.stdout.readline()
            assert line, self.process.communicate()
            self.greeting += line
        match = re.search(r"http://([0-9.]+):([0-9]+)/", self.greeting)
        assert match is not None
        self.address = match[1], int(match[2])


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_with_exit_code_0(server: holdfast.Server, number: int) -> None:
    command = Command("--allow", "127.0.0.1:*")
    try:
        assert "reads devices at 127.0.0.1:*" in command.greeting
        with wire.Connection(command.address) as watching:
            query = f"host=127.0.0.1&port={server.address[1]}&functionCode=3&address=0"
            watching.send(web.head("GET", f"/api/modbus/watch?{query}"))
            stream = b""
            while b"event: values" not in stream:
                stream += watching.socket.recv(65536)
            command.process.send_signal(number)
            assert watching.rest().endswith(b"0\r\n\r\n"), "the stream is ended, not cut"
        _, log = command.process.communicate(timeout=wire.DEADLINE)
    finally:
        command.process.kill()
        command.process.communicate()
    assert command.process.returncode == 0
    events = [line.split()[2] for line in log.splitlines()]
    assert events == ["started", "listening", "stopped"]


@pytest.mark.parametrize(
    ("allow", "example"),
    [
        ("127.0.0.1:*", '{"host":"127.0.0.1","port":502}'),
        ("0.0.0.0/0", '{"host":"plc.local","port":502}'),
        ("0.0.0.0/0:5020-5030", '{"host":"plc.local","port":5020}'),
        ("[::]/0:802", '{"host":"plc.local","port":802}'),
        ("10.0.0.0/8", '{"host":"10.0.0.1","port":502}'),
        ("10.0.0.4/31:400-600", '{"host":"10.0.0.4","port":502}'),
    ],
)
def test_the_greeting_has_an_example_that_may_be(allow: str, example: str) -> None:
    settings = Settings((parse_allowed(allow),))
    assert f"-d '{example}'" in _greeting_text("http", "127.0.0.1", 8090, settings)


@pytest.mark.parametrize(
    ("scheme", "host", "url"),
    [
        ("http", "0.0.0.0", "http://127.0.0.1:8090"),
        ("https", "::", "https://127.0.0.1:8090"),
        ("http", "10.0.0.9", "http://10.0.0.9:8090"),
    ],
)
def test_the_greeting_names_an_address_that_can_be_opened(scheme: str, host: str, url: str) -> None:
    settings = Settings((parse_allowed("10.0.0.0/8"),))
    lines = _greeting_text(scheme, host, 8090, settings).splitlines()
    assert lines[0] == f"Console: {url}/, API documentation: {url}/docs"


def test_it_needs_an_egress_list() -> None:
    assert "'--allow'" in cli.usage_error("gateway")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--allow", "plc.local"), "NETWORK[:PORTS]"),
        (("--allow", "10.0.0.0/8", "--bind", "10.0.0.1:http"), "address:port"),
        (("--allow", "10.0.0.0/8", "--host", "10.0.0.5"), "a host name without a port"),
        (("--allow", "10.0.0.0/8", "--compat", "tentacle"), "port-of-call"),
        (("--allow", "10.0.0.0/8", "--source", "10.0.0.0/8"), "--tokens"),
        (("--allow", "10.0.0.0/8", "--bind", "0.0.0.0"), "clients that may connect with --source"),
        (("--allow", "10.0.0.0/8", "--tokens", "/nowhere"), "No such file"),
        (("--allow", "10.0.0.0/8", "--in-flight", "0"), "--in-flight"),
    ],
)
def test_wrong_usage_is_exit_code_2(arguments: tuple[str, ...], says: str) -> None:
    assert says in cli.usage_error("gateway", *arguments)


def test_a_port_that_is_taken_is_exit_code_1(server: holdfast.Server) -> None:
    bind = f"127.0.0.1:{server.address[1]}"
    [line] = cli.failure("gateway", "--allow", "10.0.0.0/8", "--bind", bind)
    assert line == f"holdfast: gateway: can't listen on {bind}: Address already in use"
