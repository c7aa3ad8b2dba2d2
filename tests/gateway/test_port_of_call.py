"""Callers of Port of Call: its document's examples as printed, and `compat: port-of-call`."""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import re
import shlex
import socket
import subprocess
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from holdfast.cli.services.gateway import _greeting_text
from holdfast.config.values.allow_entries import parse_allowed
from holdfast.gateway import Settings
from support import gateways, web, wire
from support.fake_device import FakeDevice, Stream
from support.gateways import API, Dialed, Names
from support.machine import tool

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from support.fake_device import Asked
    from support.gateways import Running

NAME = "gateway.plant.example"
TEXT = {"Content-Type": "text/plain"}

# The command lines of its document, and the answers of the device below.

CURL = [
    """\
curl -s -X POST https://portofcall.ross.gg/api/modbus/connect \\
  -H 'Content-Type: application/json' \\
  -d '{"host":"plc.factory.local","unitId":1}' | jq .""",
    """\
curl -s -X POST https://portofcall.ross.gg/api/modbus/read \\
  -H 'Content-Type: application/json' \\
  -d '{"host":"plc.factory.local","functionCode":3,"address":100,"quantity":10}' | jq .""",
    """\
curl -s -X POST https://portofcall.ross.gg/api/modbus/read \\
  -H 'Content-Type: application/json' \\
  -d '{"host":"plc.factory.local","functionCode":1,"address":0,"quantity":16}' | jq .values""",
    """\
curl -s -X POST https://portofcall.ross.gg/api/modbus/write/coil \\
  -H 'Content-Type: application/json' \\
  -d '{"host":"plc.factory.local","address":17,"value":true}' | jq .""",
    """\
curl -s -X POST https://portofcall.ross.gg/api/modbus/write/registers \\
  -H 'Content-Type: application/json' \\
  -d '{"host":"plc.factory.local","address":100,"values":[1000,2000,3000]}' | jq .""",
    """\
curl -s -X POST https://portofcall.ross.gg/api/modbus/connect \\
  -H 'Content-Type: application/json' \\
  -d '{"host":"192.168.1.50","port":5020,"unitId":3}' | jq .""",
    """\
curl -s -X POST .../api/modbus/read \\
  -d '{"host":"192.168.1.50","functionCode":3,"address":0,"quantity":10}'""",
    """\
curl -s -X POST .../api/modbus/read \\
  -d '{"host":"192.168.1.50","functionCode":3,"address":0,"quantity":1}'""",
]
ANSWERS = [
    """{"success":true,"message":"Modbus server reachable","host":"plc.factory.local",\
"port":502,"unitId":1,"testRegister":42}""",
    """{"success":true,"host":"plc.factory.local","port":502,"unitId":1,"functionCode":3,\
"functionName":"READ_HOLDING_REGISTERS","address":100,"quantity":10,"format":"registers",\
"values":[1234,0,65535,42,7,0,0,0,0,0]}""",
    """{"success":true,"host":"plc.factory.local","port":502,"unitId":1,"functionCode":1,\
"functionName":"READ_COILS","address":0,"quantity":16,"format":"coils",\
"values":[true,false,true,true,false,false,false,false,false,false,false,false,false,false,false,\
false]}""",
    """{"success":true,"host":"plc.factory.local","port":502,"unitId":1,"address":17,\
"coilValue":65280,"written":true,"rtt":12}""",
    """{"success":true,"host":"plc.factory.local","port":502,"unitId":1,"startAddress":100,\
"quantity":3,"rtt":12}""",
    """{"success":true,"message":"Modbus server reachable","host":"192.168.1.50",\
"port":5020,"unitId":3,"testRegister":42}""",
    """{"success":true,"host":"192.168.1.50","port":502,"unitId":1,"functionCode":3,\
"functionName":"READ_HOLDING_REGISTERS","address":0,"quantity":10,"format":"registers",\
"values":[42,0,0,0,0,0,0,0,0,0]}""",
    """{"success":true,"host":"192.168.1.50","port":502,"unitId":1,"functionCode":3,\
"functionName":"READ_HOLDING_REGISTERS","address":0,"quantity":1,"format":"registers",\
"values":[42]}""",
]

# The requests of its document with the answers that it prints for them, or for one like them.

PRINTED = [
    (
        "/connect",
        """\
{
  "host":    "plc.factory.local",
  "port":    502,
  "unitId":  1,
  "timeout": 10000
}
""",
        """\
{
  "success": true,
  "message": "Modbus server reachable",
  "host": "plc.factory.local",
  "port": 502,
  "unitId": 1,
  "testRegister": 42
}
""",
    ),
    (
        "/connect",
        '{"host": "plc.factory.local", "unitId": 2}',
        """\
{
  "success": true,
  "message": "Modbus server reachable (responded with exception)",
  "host": "plc.factory.local",
  "port": 502,
  "unitId": 2,
  "exception": "Illegal Data Address"
}
""",
    ),
    (
        "/read",
        """\
{
  "host":         "plc.factory.local",
  "port":         502,
  "unitId":       1,
  "functionCode": 3,
  "address":      0,
  "quantity":     10,
  "timeout":      10000
}
""",
        """\
{
  "success": true,
  "host": "plc.factory.local",
  "port": 502,
  "unitId": 1,
  "functionCode": 3,
  "functionName": "READ_HOLDING_REGISTERS",
  "address": 0,
  "quantity": 10,
  "format": "registers",
  "values": [42, 0, 0, 0, 0, 0, 0, 0, 0, 0]
}
""",
    ),
    (
        "/read",
        '{"host": "plc.factory.local", "functionCode": 1, "address": 0, "quantity": 16}',
        """\
{
  "success": true,
  "host": "plc.factory.local",
  "port": 502,
  "unitId": 1,
  "functionCode": 1,
  "functionName": "READ_COILS",
  "address": 0,
  "quantity": 16,
  "format": "coils",
  "values": [true, false, true, true, false, false, false, false,
             false, false, false, false, false, false, false, false]
}
""",
    ),
    (
        "/read",
        '{"host": "plc.factory.local", "functionCode": 3, "address": 100, "quantity": 5}',
        """\
{
  "success": true,
  "host": "plc.factory.local",
  "port": 502,
  "unitId": 1,
  "functionCode": 3,
  "functionName": "READ_HOLDING_REGISTERS",
  "address": 100,
  "quantity": 5,
  "format": "registers",
  "values": [1234, 0, 65535, 42, 7]
}
""",
    ),
    (
        "/read",
        '{"host": "plc.factory.local", "functionCode": 3, "address": 9999}',
        """\
{
  "success": false,
  "error": "Modbus exception: Illegal Data Address (code 0x2)",
  "functionCode": 3,
  "address": 9999,
  "quantity": 1
}
""",
    ),
    (
        "/write/coil",
        """\
{
  "host":    "plc.factory.local",
  "port":    502,
  "unitId":  1,
  "address": 17,
  "value":   true,
  "timeout": 5000
}
""",
        """\
{
  "success": true,
  "host": "plc.factory.local",
  "port": 502,
  "unitId": 1,
  "address": 17,
  "coilValue": 65280,
  "written": true,
  "rtt": 12
}
""",
    ),
    (
        "/write/registers",
        """\
{
  "host":    "plc.factory.local",
  "port":    502,
  "unitId":  1,
  "address": 100,
  "values":  [1000, 2000, 3000],
  "timeout": 5000
}
""",
        """\
{
  "success": true,
  "host": "plc.factory.local",
  "port": 502,
  "unitId": 1,
  "startAddress": 100,
  "quantity": 3,
  "rtt": 14
}
""",
    ),
    (
        "/write/registers",
        '{ "host": "plc.factory.local", "address": 5, "values": [1234] }',
        """\
{
  "success": true,
  "host": "plc.factory.local",
  "port": 502,
  "unitId": 1,
  "startAddress": 5,
  "quantity": 1,
  "rtt": 14
}
""",
    ),
]


def alike(found: Any, printed: str) -> None:
    """Compares an answer with a printed one: keys in their order, and all values but times."""
    expected = json.loads(printed)
    if isinstance(found, dict) and "rtt" in expected:
        assert type(found["rtt"]) is int
        found = {**found, "rtt": expected["rtt"]}
    assert json.dumps(found) == json.dumps(expected)


def plc_memory() -> holdfast.Memory:
    memory = holdfast.Memory(coils=100, holding_registers=1000)
    memory.write("coils", 0, [1, 0, 1, 1])
    memory.write("holding_registers", 0, [42])
    memory.write("holding_registers", 100, [1234, 0, 65535, 42, 7])
    return memory


@pytest.fixture
def gateway() -> Iterator[Running]:
    """Knows the device of the document under its name and its address, and has a name itself."""
    units = {1: plc_memory(), 2: holdfast.Memory(coils=1), 3: plc_memory()}
    with holdfast.Server(units, bind="127.0.0.1:0", access="read-write") as server:
        ports = (("10.1.2.3", 502), ("192.168.1.50", 502), ("192.168.1.50", 5020))
        with gateways.running(
            allow=["10.0.0.0/8", "192.168.1.50:502", "192.168.1.50:5020"],
            resolve=Names(plc_factory_local=[["10.1.2.3"]]),
            dialed=Dialed(dict.fromkeys(ports, server.address)),
            hosts=frozenset({NAME}),
        ) as running:
            yield running


@pytest.fixture
def lenient() -> Iterator[Running]:
    """A gateway that takes requests as Port of Call does, and reaches devices of this machine."""
    with gateways.running(hosts=frozenset({NAME}), compat="port-of-call") as running:
        yield running


@pytest.fixture
def device() -> Iterator[int]:
    """The port of a device."""
    with holdfast.Server({1: plc_memory()}, bind="127.0.0.1:0", access="read-write") as server:
        yield server.address[1]


def here(gateway: Running, command: str, host: str = NAME) -> str:
    """A printed command line with another host in its URL."""
    url = f"http://{host}:{gateway.address[1]}"
    found = re.sub(r"https://portofcall\.ross\.gg|(?<= )\.\.\.(?=/api)", url, command)
    assert found.count(url) == 1
    return found


@pytest.mark.parametrize("number", range(len(CURL)))
def test_a_printed_command_line_works_with_the_name_of_the_gateway(
    gateway: Running, tmp_path: Path, number: int
) -> None:
    tool("curl")
    resolve = f"resolve = {NAME}:{gateway.address[1]}:127.0.0.1\n"
    (tmp_path / ".curlrc").write_text(resolve)
    command, _, _ = here(gateway, CURL[number]).partition(" | jq")
    done = subprocess.run(
        [tool("sh"), "-c", command],
        env={**os.environ, "CURL_HOME": str(tmp_path), "no_proxy": "*"},
        capture_output=True,
        check=True,
        timeout=wire.DEADLINE,
    )
    alike(json.loads(done.stdout), ANSWERS[number])


@pytest.mark.parametrize("host", [NAME, "127.0.0.1", "localhost"])
@pytest.mark.parametrize("number", range(len(CURL)))
def test_the_bytes_of_a_printed_command_line_are_answered(
    gateway: Running, number: int, host: str
) -> None:
    """What curl sends, without curl."""
    command, _, _ = here(gateway, CURL[number], host).partition(" | jq")
    words = shlex.split(command.replace("\\\n", ""))
    url, body = words[4], words[words.index("-d") + 1]
    _, _, rest = url.partition("://")
    its_host, _, path = rest.partition("/")
    kind = "application/json" if "-H" in words else "application/x-www-form-urlencoded"
    sent = (
        f"POST /{path} HTTP/1.1\r\nHost: {its_host}\r\nUser-Agent: curl/8.5.0\r\nAccept: */*\r\n"
        f"Content-Type: {kind}\r\nContent-Length: {len(body)}\r\nConnection: close\r\n\r\n{body}"
    )
    with socket.create_connection(gateway.address, wire.DEADLINE) as connection:
        connection.sendall(sent.encode())
        with connection.makefile("rb") as received:
            [answer] = web.answers(received.read())
    assert (answer.status, answer.headers["content-type"]) == (200, "application/json")
    alike(answer.json, ANSWERS[number])


@pytest.mark.parametrize(("path", "body", "answer"), PRINTED, ids=range(len(PRINTED)))
def test_a_printed_request_gets_the_printed_answer(
    gateway: Running, path: str, body: str, answer: str
) -> None:
    got = gateway.client().ask("POST", API + path, body.encode())
    assert got.status == 200
    alike(got.json, answer)


def test_a_device_that_does_not_reply_has_the_printed_error(lenient: Running) -> None:
    with FakeDevice(lambda _: None) as mute:
        body = f'{{"host":"127.0.0.1","port":{mute.port},"timeout":50}}'
        answer = ask(lenient, "/connect", body, web.JSON)
    assert answer.status == 500
    alike(
        answer.json,
        """\
{
  "success": false,
  "error": "Connection timeout"
}
""",
    )


# Names of the gateway.


def status(running: Running, **headers: str) -> int:
    return running.client().ask("GET", "/api/gateway", headers=headers).status


@pytest.mark.parametrize("host", [NAME, "GATEWAY.plant.Example", f"{NAME}:80", f"{NAME}:65535"])
def test_a_gateway_is_reached_under_its_names(gateway: Running, host: str) -> None:
    assert status(gateway, Host=host) == 200
    assert status(gateway, Host=host, Origin=f"http://{host}") == 200


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "plant.example"},
        {"Host": f"www.{NAME}"},
        {"Host": f"{NAME}.evil.example"},
        {"Host": f"{NAME}."},
        {"Host": f"evil.example:{NAME}"},
        {"Host": NAME, "Origin": "http://evil.example"},
        {"Host": NAME, "Origin": f"http://www.{NAME}"},
        {"Host": NAME, "Origin": f"http://{NAME}:8080"},
        {"Host": NAME, "Origin": "null"},
        {"Host": NAME, "Sec-Fetch-Site": "cross-site"},
        {"Host": NAME, "Sec-Fetch-Site": "same-site"},
    ],
)
def test_a_name_opens_the_gateway_to_no_page_of_another_site(
    gateway: Running, headers: dict[str, str]
) -> None:
    assert status(gateway, **headers) == 403


def test_under_a_name_no_get_asks_a_device(lenient: Running, device: int) -> None:
    """A browser may send it for a page of another site without a header that says so."""
    query = f"host=127.0.0.1&port={device}&functionCode=3&address=0"
    connection = http.client.HTTPConnection(*lenient.address, timeout=wire.DEADLINE)
    with contextlib.closing(connection):
        connection.request("GET", f"{API}/watch?{query}", headers={"Host": NAME})
        answer = connection.getresponse()
        assert (answer.status, answer.headers["Holdfast-Reason"]) == (403, "foreign_page")
        error = json.loads(answer.read())["error"]
    assert error.endswith("or use POST /api/modbus/watch/view")
    assert lenient.client().get("/api/gateway").json["connections"] == 0
    part = '"once":true,"parts":[{"functionCode":3,"address":0}]'
    body = f'{{"host":"127.0.0.1","port":{device},{part}}}'
    assert ask(lenient, "/watch/view", body, {**web.JSON, "Host": NAME}).status == 200


def test_without_names_an_error_says_how_to_add_one() -> None:
    with gateways.running() as running:
        answer = running.client().ask("GET", "/api/gateway", headers={"Host": NAME})
    assert (answer.status, answer.headers["holdfast-reason"]) == (403, "foreign_page")
    assert answer.json["error"] == (
        "Host is a name, allowed without tokens: an IP address, localhost, or a name in --host, "
        "or hosts in the configuration"
    )


def test_the_greeting_says_names_and_compatibility() -> None:
    settings = Settings(
        (parse_allowed("10.0.0.0/8"),), hosts=frozenset({NAME, "gw"}), compat="port-of-call"
    )
    lines = _greeting_text("http", "127.0.0.1", 8090, settings).splitlines()
    assert lines[3:6] == [
        "  clients: 127.0.0.0/8, ::1/128; no tokens",
        f"  names: {NAME}, gw",
        "  compatible with: port-of-call",
    ]


# Requests in its form.


def ask(running: Running, path: str, body: bytes | str, headers: dict[str, str]) -> web.Answer:
    sent = body if isinstance(body, bytes) else body.encode()
    return running.client().ask("POST", API + path, sent, headers)


def read_of(port: int, more: str = "") -> str:
    return f'{{"host":"127.0.0.1","port":{port},"functionCode":3,"address":0{more}}}'


@pytest.mark.parametrize(
    "headers",
    [
        {},
        TEXT,
        {"Content-Type": "text/plain;charset=UTF-8"},
        {"Content-Type": "application/octet-stream"},
        {"Content-Type": "application/json"},
    ],
)
def test_the_type_of_a_body_does_not_matter(
    lenient: Running, device: int, headers: dict[str, str]
) -> None:
    answer = ask(lenient, "/read", read_of(device), headers)
    assert (answer.status, answer.json.get("values")) == (200, [42])


@pytest.mark.parametrize(
    ("headers", "refused"),
    [
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "null"}, 403),
        ({"Sec-Fetch-Site": "cross-site"}, 403),
        ({"Sec-Fetch-Site": "same-site"}, 403),
        ({"Host": "evil.example"}, 403),
        ({"Host": NAME, "Origin": f"http://{NAME}"}, 415),
        ({"Sec-Fetch-Site": "none"}, 415),
        ({"Sec-Fetch-Site": "same-origin"}, 415),
        ({"Referer": "http://evil.example/"}, 415),
    ],
)
@pytest.mark.parametrize("kind", ["text/plain", "text/plain;charset=UTF-8", "multipart/form-data"])
def test_no_page_can_send_a_body_of_another_type(
    lenient: Running, device: int, headers: dict[str, str], refused: int, kind: str
) -> None:
    body = f'{{"host":"127.0.0.1","port":{device},"address":0,"value":false}}'
    answer = ask(lenient, "/write/coil", body, {"Content-Type": kind, **headers})
    assert answer.status == refused
    assert lenient.client().get("/api/gateway").json["connections"] == 0


def test_a_compressed_body_is_refused(lenient: Running) -> None:
    assert ask(lenient, "/connect", "{}", {"Content-Encoding": "gzip"}).status == 415


def test_unknown_keys_are_ignored_and_logged(
    lenient: Running, device: int, log: web.Records
) -> None:
    more = ',"unitid":9,"comment":{"by":"panel"},"quantity":1'
    answer = ask(lenient, "/read", read_of(device, more), TEXT)
    assert (answer.status, answer.json["unitId"], answer.json["values"]) == (200, 1, [42])
    [ignored] = log.of("keys_ignored")
    assert (ignored["listener"], ignored["path"]) == ("gateway", "/api/modbus/read")
    assert ignored["found"] == '"unitid", "comment"'


@pytest.mark.parametrize("path", ["/write/register", "/identify", "/map"])
def test_other_endpoints_stay_strict(lenient: Running, device: int, path: str) -> None:
    value = ',"address":0,"value":1' if path == "/write/register" else ""
    body = f'{{"host":"127.0.0.1","port":{device}{value},"comment":""}}'
    answer = ask(lenient, path, body, web.JSON)
    assert (answer.status, answer.json["success"]) == (400, False)
    assert '"comment" is not a parameter' in answer.json["error"]
    assert ask(lenient, path, body, TEXT).status == 415


def test_a_whole_number_with_a_fraction_is_an_integer(lenient: Running, device: int) -> None:
    body = f'{{"host":"127.0.0.1","port":{device}.0,"address":1e1,"values":[7.0,8]}}'
    answer = ask(lenient, "/write/registers", body, TEXT)
    assert (answer.status, answer.json["startAddress"], answer.json["quantity"]) == (200, 10, 2)
    typed = f'{{"host":"127.0.0.1","port":{device},"address":0,"values":[7.0],"datatype":"int16"}}'
    assert ask(lenient, "/write/registers", typed, TEXT).status == 400


def test_a_byte_order_mark_is_skipped(lenient: Running, device: int) -> None:
    answer = ask(lenient, "/read", b"\xef\xbb\xbf" + read_of(device).encode(), {})
    assert answer.status == 200


NO_FUNCTION = (
    "Allowed: 0x01 (Read Coils), 0x02 (Read Discrete Inputs), 0x03 (Read Holding Registers), "
    "0x04 (Read Input Registers)"
)
NO_VALUES = "Missing required parameters: address and values (non-empty array)"


def bare(error: str) -> str:
    return json.dumps({"error": error}, separators=(",", ":"))


def whole(error: str) -> str:
    return json.dumps({"success": False, "error": error}, separators=(",", ":"))


ERRORS = [
    ("/connect", "", 500, whole("Unexpected end of JSON input")),
    ("/connect", " \n", 500, whole("Unexpected end of JSON input")),
    ("/connect", "{}", 400, bare("Missing required parameter: host")),
    ("/connect", "[]", 400, bare("Missing required parameter: host")),
    ("/connect", "7", 400, bare("Missing required parameter: host")),
    ("/connect", '{"host":""}', 400, bare("Missing required parameter: host")),
    ("/connect", '{"host":"a","port":0}', 400, whole("Port must be between 1 and 65535")),
    ("/connect", '{"host":"a","port":"502"}', 400, whole("Port must be between 1 and 65535")),
    ("/connect", '{"host":"a","port":null}', 400, whole("Port must be between 1 and 65535")),
    ("/read", "{}", 400, bare("Missing required parameter: host")),
    (
        "/read",
        '{"host":"a","functionCode":3}',
        400,
        bare("Missing required parameters: functionCode and address"),
    ),
    (
        "/read",
        '{"host":"a","functionCode":16,"address":0}',
        400,
        bare(f"Invalid read function code: 0x10. {NO_FUNCTION}"),
    ),
    (
        "/read",
        '{"host":"a","functionCode":3,"address":0,"quantity":126,"port":0}',
        400,
        bare("Quantity must be between 1 and 125"),
    ),
    (
        "/read",
        '{"host":"a","functionCode":1,"address":0,"quantity":0}',
        400,
        bare("Quantity must be between 1 and 2000"),
    ),
    (
        "/write/coil",
        '{"host":"a","address":0}',
        400,
        bare("Missing required parameters: address and value"),
    ),
    (
        "/write/coil",
        '{"host":"a","address":65536,"value":1}',
        400,
        whole("Address must be an integer 0-65535"),
    ),
    ("/write/registers", '{"host":"a","address":0}', 400, bare(NO_VALUES)),
    ("/write/registers", '{"host":"a","address":0,"values":[]}', 400, bare(NO_VALUES)),
    ("/write/registers", '{"host":"a","address":0,"values":7}', 400, bare(NO_VALUES)),
    (
        "/write/registers",
        json.dumps({"host": "a", "address": 0, "values": [0] * 124}),
        400,
        bare("values array too large: maximum 123 registers per request"),
    ),
    (
        "/write/registers",
        '{"host":"a","address":-1,"values":[65536]}',
        400,
        whole("Address must be an integer 0-65535"),
    ),
    (
        "/write/registers",
        '{"host":"a","address":0,"values":[1,65536]}',
        400,
        whole("All register values must be integers 0-65535"),
    ),
    (
        "/write/registers",
        '{"host":"a","address":0,"values":[-1]}',
        400,
        whole("All register values must be integers 0-65535"),
    ),
]


@pytest.mark.parametrize(("path", "body", "status", "error"), ERRORS, ids=range(len(ERRORS)))
def test_an_error_has_its_status_and_its_bytes(
    lenient: Running, path: str, body: str, status: int, error: str
) -> None:
    answer = ask(lenient, path, body, TEXT)
    assert (answer.status, answer.body.decode()) == (status, error)
    assert answer.headers["content-type"] == "application/json"
    assert answer.headers["holdfast-reason"] == "malformed"


@pytest.mark.parametrize("body", ["{", '{"host":"a"}x', "null", "{'host':'a'}"])
def test_a_body_that_is_not_json_has_its_status(lenient: Running, body: str) -> None:
    answer = ask(lenient, "/connect", body, web.JSON)
    assert (answer.status, list(answer.json)) == (500, ["success", "error"])
    assert answer.json["success"] is False


@pytest.mark.parametrize("method", ["GET", "PUT", "DELETE"])
def test_another_method_has_its_error(lenient: Running, method: str) -> None:
    answer = lenient.client().ask(method, f"{API}/read", headers={})
    assert (answer.status, answer.body.decode()) == (405, whole("Method not allowed"))


@pytest.mark.parametrize(
    ("path", "fields"),
    [
        ("/write/coil", '"address":0,"value":2'),
        ("/write/coil", '"address":0,"value":"on"'),
        ("/write/coil", '"address":0,"value":null'),
        ("/write/registers", '"address":65535,"values":[1,2]'),
        ("/write/registers", '"address":0,"values":[1.5]'),
        ("/write/registers", '"address":0,"values":[1],"unitId":256'),
        ("/write/registers", '"address":0,"values":[1],"unitId":"1"'),
        ("/write/registers", '"address":0,"values":[1],"values":[2]'),
        ("/write/registers", '"address":0,"values":[1],"timeout":60001'),
        ("/read", '"functionCode":3,"address":65536'),
        ("/read", '"functionCode":3,"address":0,"quantity":1.5'),
    ],
)
def test_what_it_would_send_as_another_value_is_refused(
    lenient: Running, device: int, path: str, fields: str
) -> None:
    body = f'{{"host":"127.0.0.1","port":{device},{fields}}}'
    answer = ask(lenient, path, body, TEXT)
    assert (answer.status, answer.json["success"]) == (400, False)
    assert lenient.client().get("/api/gateway").json["connections"] == 0


def test_the_document_says_what_is_accepted(lenient: Running) -> None:
    document = lenient.client().get("/openapi.json").json
    [operation] = document["paths"][f"{API}/read"].values()
    content = operation["requestBody"]["content"]
    assert sorted(content) == ["*/*", "application/json"]
    assert all(each["schema"]["additionalProperties"] is True for each in content.values())
    assert document["components"]["schemas"]["Error"]["required"] == ["error"]
    [strict] = document["paths"][f"{API}/write/register"].values()
    assert list(strict["requestBody"]["content"]) == ["application/json"]


# What its document says of transaction ids, of unit 0, and of timeouts.


def test_transaction_ids_count_on_each_connection_by_itself(lenient: Running) -> None:
    with (
        FakeDevice(lambda _: b"\x03\x02\x00\x07") as one,
        FakeDevice(lambda _: b"\x03\x02\x00\x07") as other,
    ):
        for device in (one, other, other, one, one, other):
            assert ask(lenient, "/read", read_of(device.port), TEXT).json["values"] == [7]
        for device in (one, other):
            first, *rest = [asked.transaction for asked in device.requests]
            assert rest == [(first + 1) % 65536, (first + 2) % 65536]
            assert device.connections == 1


def test_a_reply_with_another_transaction_id_is_not_taken(lenient: Running) -> None:
    def wrong(asked: Asked) -> None:
        asked.answer(transaction=asked.transaction + 1)

    with Stream("tcp", then=wrong) as device:
        answer = ask(lenient, "/read", read_of(device.port, ',"timeout":200'), TEXT)
    assert (answer.status, answer.headers["holdfast-reason"]) == (500, "invalid_reply")
    assert "matches no request" in answer.json["error"]


def test_unit_0_over_tcp_is_asked_once_and_needs_a_reply(lenient: Running) -> None:
    body = '{{"host":"127.0.0.1","port":{},"unitId":0,"address":3,"value":true,"timeout":200}}'
    with FakeDevice(lambda pdu: pdu) as device:
        answer = ask(lenient, "/write/coil", body.format(device.port), TEXT)
        assert (answer.status, answer.json["written"]) == (200, True)
    with FakeDevice(lambda _: None) as mute:
        answer = ask(lenient, "/write/coil", body.format(mute.port), TEXT)
        assert [asked.pdu.hex() for asked in mute.requests] == ["050003ff00"]
    assert answer.status == 500
    assert answer.json["error"] == (
        "Connection timeout: unit id 0 is the broadcast of serial lines, which has no response"
    )
