"""REST: what is asked for over real sockets, and what is answered."""

from __future__ import annotations

import contextlib
import json
import re
from contextlib import ExitStack
from ipaddress import ip_network
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Protocol

import pytest

import holdfast
from holdfast.adapters import Grant, MemoryAccess, Stop
from holdfast.adapters.rest.operations import document as document_of
from holdfast.events import log_lines
from holdfast.events.audit import Audit
from holdfast.events.throttle import Throttle
from holdfast.net.http.port import listen
from holdfast.net.http.server import ConnectionLimits, WebServer
from support import web, wire
from support.audits import writes

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from holdfast.net.http.requests import Request, Response

ADMIN, READER, NARROW, OTHER = "secret-admin", "secret-reader", "secret-narrow", "secret-other"
TOKENS = [
    web.token("admin", ADMIN, memories=("plant_a", "plant_b"), manage=True),
    web.token("reader", READER, access="read-only"),
    web.token("narrow", NARROW, areas=("input_registers",)),
    web.token("other", OTHER, memories=("plant_b",)),
]


class Start(Protocol):
    """Starts a service that is stopped when the test ends."""

    def __call__(self, **settings: Any) -> web.Service: ...


@pytest.fixture
def memories() -> dict[str, holdfast.Memory]:
    return {
        "plant_a": holdfast.Memory(
            coils=1000, discrete_inputs=1000, holding_registers=65536, input_registers=(1000, 200)
        ),
        "plant_b": holdfast.Memory(holding_registers=100),
        "gated": holdfast.Memory(discrete_inputs=8, seal=("discrete_inputs", 7, "once")),
    }


@pytest.fixture
def start(memories: dict[str, holdfast.Memory]) -> Iterator[Start]:
    with ExitStack() as running:

        def started(**settings: Any) -> web.Service:
            service = web.Service(memories, **settings)
            running.enter_context(web.supervised(service.supervisor, service.listener))
            return service

        yield started


@pytest.fixture
def service(start: Start) -> web.Service:
    """Without tokens."""
    return start()


@pytest.fixture
def secured(start: Start) -> web.Service:
    return start(tokens=TOKENS)


class Connect(Protocol):
    """Opens a client that is closed when the test ends."""

    def __call__(self, service: web.Service, secret: str | None = None) -> web.Client: ...


@pytest.fixture
def connect() -> Iterator[Connect]:
    with ExitStack() as opened:

        def connected(service: web.Service, secret: str | None = None) -> web.Client:
            client = web.Client(service.address, secret)
            opened.callback(client.close)
            return client

        yield connected


@pytest.fixture
def client(service: web.Service, connect: Connect) -> web.Client:
    return connect(service)


@pytest.fixture
def log(monkeypatch: pytest.MonkeyPatch) -> Iterator[web.Records]:
    """All that the project logs, nothing held back."""
    monkeypatch.setattr(log_lines, "_REFUSALS", Throttle(burst=10**6))
    records = web.Records()
    level = log_lines.LOGGER.level
    log_lines.LOGGER.addHandler(records)
    log_lines.LOGGER.setLevel("DEBUG")
    yield records
    log_lines.LOGGER.removeHandler(records)
    log_lines.LOGGER.setLevel(level)


# Writing.


@pytest.mark.parametrize(
    ("area", "address", "values"),
    [
        ("coils", 3, [1, 0, 1]),
        ("discrete_inputs", 999, [1]),
        ("holding_registers", 0, [100, 200, 300]),
        ("input_registers", 1000, [65535] * 200),
    ],
)
def test_a_command_is_written_and_read_back(
    client: web.Client, area: str, address: int, values: list[int]
) -> None:
    answer = client.ingest(web.command(area, address, values))
    assert answer.status == 200
    assert answer.json == {"status": "accepted", "memory": "plant_a", "written": len(values)}
    assert client.read(area, address, len(values)).json == {"values": values}


def test_bits_may_be_booleans_and_be_called_bools(client: web.Client) -> None:
    command = {"memory": "plant_a", "area": "coils", "address": 0, "bools": [True, 0, False, 1]}
    assert client.ingest(command).status == 200
    assert client.read("coils", 0, 4).json == {"values": [1, 0, 0, 1]}


def test_a_batch_is_answered_with_its_numbers(client: web.Client) -> None:
    batch = [
        web.command("holding_registers", 5, [1, 2]),
        web.command("holding_registers", 6, [3]),
        web.command("holding_registers", 0, [4, 5], "plant_b"),
    ]
    answer = client.ingest(batch)
    assert answer.json == {"status": "accepted", "commands": 3, "written": 5}
    assert client.read("holding_registers", 5, 2).json == {"values": [1, 3]}
    assert client.read("holding_registers", 0, 2, "plant_b").json == {"values": [4, 5]}


def test_a_batch_of_one_is_a_batch(client: web.Client) -> None:
    answer = client.ingest([web.command("coils", 0, [1])])
    assert answer.json == {"status": "accepted", "commands": 1, "written": 1}


def test_an_area_is_written_and_read_as_a_whole(client: web.Client) -> None:
    values = [(7 * place) & 0xFFFF for place in range(65536)]
    assert client.ingest(web.command("holding_registers", 0, values)).status == 200
    assert client.read("holding_registers", 0, 65536).json == {"values": values}


def test_a_write_opens_the_seal(client: web.Client) -> None:
    def shown() -> tuple[bool, int]:
        gated = client.get("/api/v1/diagnostics/memory").json["memories"]["gated"]
        return gated["sealed"], gated["opened"]

    assert shown() == (True, 0)
    assert client.ingest(web.command("discrete_inputs", 6, [1, 0], "gated")).status == 200
    assert shown() == (True, 0)
    assert client.ingest(web.command("discrete_inputs", 7, [1], "gated")).status == 200
    assert shown() == (False, 1)


# What is refused.


def test_a_refusal_names_the_value(client: web.Client) -> None:
    answer = client.ingest(web.command("holding_registers", 0, [1, 2, 70000]))
    assert answer.status == 400
    assert answer.json == {
        "status": "rejected",
        "reason": "invalid_value",
        "index": 2,
        "detail": "values[2] is 70000, outside 0..65535",
    }


def test_a_refusal_of_a_batch_names_the_command(client: web.Client) -> None:
    batch = [web.command("coils", 0, [1]), web.command("coils", 0, [1, 2])]
    answer = client.ingest(batch)
    assert answer.status == 400
    assert (answer.json["command"], answer.json["index"]) == (1, 1)
    assert client.read("coils", 0, 2).json == {"values": [0, 0]}


HUGE = "1" + "0" * 30
BAD_REGISTERS = [
    *("1.0", "-0.0", "1e2", '"1"', "true", "false", "null", "[1]", "{}", "65536", "-1", HUGE),
]
BAD_BITS = ["2", "-1", "1.0", "0.0", '"1"', '"true"', "null", "[1]", "{}", HUGE]


@pytest.mark.parametrize("place", [0, 1, 2])
@pytest.mark.parametrize(
    ("area", "value"),
    [
        *(("holding_registers", value) for value in BAD_REGISTERS),
        *(("input_registers", value) for value in BAD_REGISTERS[:3]),
        *(("coils", value) for value in BAD_BITS),
        *(("discrete_inputs", value) for value in BAD_BITS[:3]),
    ],
)
def test_a_value_of_the_wrong_kind_refuses_the_command(
    client: web.Client, service: web.Service, area: str, value: str, place: int
) -> None:
    values = ["1", "1", "1"]
    values[place] = value
    address = 1000 if area == "input_registers" else 0
    body = (
        f'{{"memory":"plant_a","area":"{area}","address":{address},"values":[{",".join(values)}]}}'
    )
    answer = client.ingest(body.encode())
    assert answer.status == 400
    assert answer.json["reason"] == "invalid_value"
    assert answer.json["index"] == place
    assert client.read(area, address, 3).json == {"values": [0, 0, 0]}
    assert service.refusals() == {"invalid_value": 1}


GOOD = b'{"memory":"plant_a","area":"coils","address":0,"values":[1]}'


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b" ",
        b"null",
        b"1",
        b'"text"',
        b"[]",
        b"[[]]",
        b"{}",
        b"[1]",
        GOOD[:-1],
        GOOD + b",",
        GOOD + GOOD,
        b"\xef\xbb\xbf" + GOOD,
        GOOD.decode().encode("utf-16"),
        GOOD.replace(b"plant_a", b"plant\xff"),
        GOOD.replace(b"plant_a", b"plant\\ud800"),
        GOOD.replace(b"[1]", b"[NaN]"),
        GOOD.replace(b"[1]", b"[Infinity]"),
        GOOD.replace(b"[1]", b"[1e400]"),
        GOOD.replace(b"[1]", b"[" + b"9" * 5000 + b"]"),
        GOOD.replace(b"[1]", b"[01]"),
        GOOD.replace(b"[1]", b"[1,]"),
        GOOD.replace(b"[1]", b"[]"),
        GOOD.replace(b"[1]", b"1"),
        GOOD.replace(b"[1]", b'"1"'),
        GOOD.replace(b"[1]", b"null"),
        GOOD.replace(b"[1]", b'{"0":1}'),
        GOOD.replace(b"[1]", b"[" * 100_000),
        GOOD.replace(b"[1]", b"[" * 900 + b"]" * 900) + b"}",
        b"[" * 100_000 + b"]" * 100_000,
        GOOD.replace(b":0", b":0.0"),
        GOOD.replace(b":0", b':"0"'),
        GOOD.replace(b":0", b":true"),
        GOOD.replace(b":0", b":null"),
        GOOD.replace(b'"plant_a"', b"1"),
        GOOD.replace(b'"plant_a"', b'["plant_a"]'),
        GOOD.replace(b'"coils"', b"null"),
        GOOD.replace(b'"coils"', b"{}"),
        GOOD.replace(b'"address":0,', b""),
        GOOD.replace(b'"values"', b'"Values"'),
        GOOD.replace(b"}", b',"bools":[1]}'),
        GOOD.replace(b"}", b',"note":"x"}'),
        b"[" + GOOD + b",1]",
        b"[" + GOOD + b",[]]",
        b"memory=plant_a",
    ],
)
def test_what_is_not_a_command_is_malformed(
    client: web.Client, service: web.Service, body: bytes
) -> None:
    answer = client.ingest(body)
    assert answer.status == 400
    assert answer.json["reason"] == "malformed"
    assert answer.json["status"] == "rejected"
    assert len(answer.json["detail"]) < 300
    assert service.refusals() == {"malformed": 1}
    assert client.read("coils", 0, 1).json == {"values": [0]}


def test_of_equal_keys_the_last_holds(client: web.Client) -> None:
    body = GOOD.replace(b'"address":0', b'"address":0,"address":4')
    assert client.ingest(body).status == 200
    assert client.read("coils", 0, 5).json == {"values": [0, 0, 0, 0, 1]}


@pytest.mark.parametrize(
    ("command", "status", "reason"),
    [
        (web.command("coils", 0, [1], "plant_z"), 404, "unknown_memory"),
        (web.command("coils", 0, [1], "x" * 100_000), 404, "unknown_memory"),
        (web.command("coil", 0, [1]), 400, "invalid_area"),
        (web.command("c" * 100_000, 0, [1]), 400, "invalid_area"),
        (web.command("coils", 1000, [1]), 400, "out_of_range"),
        (web.command("coils", 999, [1, 1]), 400, "out_of_range"),
        (web.command("coils", -1, [1]), 400, "out_of_range"),
        (web.command("coils", 10**30, [1]), 400, "out_of_range"),
        (web.command("input_registers", 0, [1]), 400, "out_of_range"),
        (web.command("coils", 0, [1], "plant_b"), 400, "out_of_range"),
    ],
)
def test_a_command_that_can_not_be(
    client: web.Client,
    service: web.Service,
    log: web.Records,
    command: dict[str, Any],
    status: int,
    reason: str,
) -> None:
    answer = client.ingest(command)
    assert (answer.status, answer.json["reason"]) == (status, reason)
    assert service.refusals() == {reason: 1}
    assert len(log.of("ingest_refused")) == 1
    assert len(answer.body) + len(log.lines[0]) < 2000, "what a peer sends must not fill the log"


@pytest.mark.parametrize(
    ("kind", "fits"),
    [
        ("application/json", True),
        ("APPLICATION/JSON", True),
        ("application/json; charset=utf-8", True),
        ('application/json;charset="UTF-8"', True),
        ("application/json ;charset=utf8", True),
        ("application/json; charset=latin-1", False),
        ("application/json; charset=utf-16", False),
        ("application/json; profile=x", False),
        ("application/jsonx", False),
        ("application/problem+json", False),
        ("text/json", False),
        ("text/plain", False),
        ("application/x-www-form-urlencoded", False),
        ("multipart/form-data", False),
        ("", False),
    ],
)
def test_only_json_is_taken(
    client: web.Client, service: web.Service, kind: str, fits: bool
) -> None:
    answer = client.ask("POST", web.INGEST, GOOD, {"Content-Type": kind})
    if fits:
        assert answer.status == 200
        return
    assert (answer.status, answer.json["reason"]) == (415, "not_json")
    assert service.refusals() == {"not_json": 1}
    assert client.ingest(GOOD).status == 200, "the connection goes on"


def test_without_a_content_type_it_is_not_json(client: web.Client) -> None:
    assert client.ask("POST", web.INGEST, GOOD, {}).status == 415


@pytest.mark.parametrize("coding", ["gzip", "deflate", "br", "gzip, identity"])
def test_a_compressed_body_is_not_taken(client: web.Client, coding: str) -> None:
    answer = client.ask("POST", web.INGEST, GOOD, web.JSON | {"Content-Encoding": coding})
    assert (answer.status, answer.json["reason"]) == (415, "not_json")


def test_identity_is_no_coding(client: web.Client) -> None:
    headers = web.JSON | {"Content-Encoding": "identity"}
    assert client.ask("POST", web.INGEST, GOOD, headers).status == 200


# Reading.


@pytest.mark.parametrize(
    ("query", "says"),
    [
        ("", ["memory is missing"]),
        ("memory=plant_a&area=coils&address=0", ["count is missing"]),
        ("memory=plant_a&area=coils&address=0&count=1&count=2", ["count", "more than once"]),
        (
            "memory=plant_a&area=coils&address=0&count=1&offset=2",
            ['"offset"', "allowed: memory"],
        ),
        ("memory=plant_a&area=coils&address=0&count=1&x", ['"x"']),
        ("memory=plant_a&area=coils&address=0&count=" + "1&a=" * 9, ["more than 8"]),
        ("memory=plant_a&area=coils&address=&count=1", ['address is ""', "0 to 65535"]),
        ("memory=plant_a&area=coils&address=-1&count=1", ['address is "-1"', "0 to 65535"]),
        ("memory=plant_a&area=coils&address=%2B1&count=1", ['address is "+1"']),
        ("memory=plant_a&area=coils&address=0x1&count=1", ['address is "0x1"']),
        ("memory=plant_a&area=coils&address=1_0&count=1", ['address is "1_0"']),
        ("memory=plant_a&area=coils&address=1.0&count=1", ['address is "1.0"']),
        ("memory=plant_a&area=coils&address=65536&count=1", ['address is "65536"']),
        ("memory=plant_a&area=coils&address=%D9%A1&count=1", ["address is"]),
        ("memory=plant_a&area=coils&address=0&count=0", ['count is "0"', "1 to 65536"]),
        ("memory=plant_a&area=coils&address=0&count=65537", ['count is "65537"', "1 to 65536"]),
        ("memory=plant_a&area=coils&address=0&count=" + "9" * 5000, ["count is", "1 to 65536"]),
        ("memory=plant_a&area=coils&address=0&count=1%0A", ["count is"]),
    ],
)
def test_a_wrong_parameter_is_named(
    client: web.Client, service: web.Service, query: str, says: list[str]
) -> None:
    answer = client.get(f"{web.READ}?{query}")
    assert (answer.status, answer.json["reason"]) == (400, "malformed")
    for words in says:
        assert words in answer.json["detail"]
    assert len(answer.json["detail"]) < 200
    assert service.refusals() == {"malformed": 1}


@pytest.mark.parametrize(
    ("query", "status", "reason"),
    [
        ("memory=plant_z&area=coils&address=0&count=1", 404, "unknown_memory"),
        ("memory=&area=coils&address=0&count=1", 404, "unknown_memory"),
        ("memory=plant%FF&area=coils&address=0&count=1", 404, "unknown_memory"),
        ("memory=plant_a&area=Coils&address=0&count=1", 400, "invalid_area"),
        ("memory=plant_a&area=coils&address=1000&count=1", 400, "out_of_range"),
        ("memory=plant_a&area=coils&address=0&count=1001", 400, "out_of_range"),
        ("memory=plant_b&area=coils&address=0&count=1", 400, "out_of_range"),
    ],
)
def test_a_read_that_can_not_be(
    client: web.Client, service: web.Service, query: str, status: int, reason: str
) -> None:
    answer = client.get(f"{web.READ}?{query}")
    assert (answer.status, answer.json["reason"]) == (status, reason)
    assert service.refusals() == {reason: 1}


def test_names_may_be_quoted_as_in_any_url(client: web.Client) -> None:
    answer = client.get(f"{web.READ}?memory=plant%5Fa&area=%63oils&address=00&count=02")
    assert answer.json == {"values": [0, 0]}


# The rest of HTTP.


@pytest.mark.parametrize(
    "path", ["/", "/api", "/api/v1/ingest/", "/api/v1/Ingest", "/%00", "/docs/", "/" + "x" * 9000]
)
@pytest.mark.parametrize("method", ["GET", "POST", "DELETE", "OPTIONS"])
def test_nothing_else_is_there(
    client: web.Client, service: web.Service, method: str, path: str
) -> None:
    answer = client.ask(method, path)
    assert (answer.status, answer.json["reason"]) == (404, "not_found")
    assert len(answer.body) < 200
    assert service.refusals() == {"not_found": 1}


ROUTES = {
    "/api/v1/ingest": "POST",
    "/api/v1/memory/read": "GET",
    "/api/v1/memory/changes": "GET",
    "/api/v1/health": "GET",
    "/api/v1/diagnostics/memory": "GET",
    "/api/v1/diagnostics/stats": "GET",
    "/api/v1/diagnostics/mqtt": "GET",
    "/api/v1/sessions": "GET",
    "/api/v1/sessions/end": "POST",
    "/openapi.json": "GET",
    "/docs": "GET",
}


@pytest.mark.parametrize(("path", "right"), ROUTES.items())
@pytest.mark.parametrize("method", ["GET", "POST", "PUT", "PATCH", "DELETE", "TRACE"])
def test_another_method_is_told_which_is_allowed(
    client: web.Client, path: str, right: str, method: str
) -> None:
    if method == right:
        return
    answer = client.ask(method, path)
    assert (answer.status, answer.json["reason"]) == (405, "method_not_allowed")
    allowed = "POST, OPTIONS" if right == "POST" else "GET, HEAD, OPTIONS"
    assert answer.headers["allow"] == allowed
    options = client.ask("OPTIONS", path)
    assert (options.status, options.body) == (204, b"")
    assert "content-length" not in options.headers
    assert options.headers["allow"] == allowed


def test_head_is_get_without_its_body(client: web.Client) -> None:
    whole, top = client.get("/api/v1/health"), client.ask("HEAD", "/api/v1/health")
    assert (top.status, top.body) == (200, b"")
    assert top.headers["content-length"] == whole.headers["content-length"] == "15"


@pytest.mark.parametrize("path", [*ROUTES, "/nowhere"])
def test_every_answer_is_not_to_be_kept_and_names_no_server(client: web.Client, path: str) -> None:
    headers = client.get(path).headers
    assert headers["cache-control"] == "no-store"
    assert headers["x-content-type-options"] == "nosniff"
    assert "server" not in headers
    assert "access-control-allow-origin" not in headers


def test_a_fault_is_answered_without_a_detail_and_logged(log: web.Records) -> None:
    def fail(_: Request) -> Response:
        raise RuntimeError("the secret of the house")

    listener = listen("127.0.0.1", 0)
    loopback = [ip_network("127.0.0.0/8")]
    server = WebServer(
        "x", fail, listener, sources=loopback, limits=ConnectionLimits(1), request_timeout=9
    )
    with (
        contextlib.closing(listener),
        web.in_a_thread(server),
        contextlib.closing(web.Client(listener.getsockname())) as client,
    ):
        for _ in range(2):
            answer = client.get("/")
            assert answer.status == 500
            assert answer.json == {
                "status": "failed",
                "reason": "internal_error",
                "detail": "internal error, see the log",
            }
    assert [entry["event"] for entry in log.fields] == ["request_failed"] * 2


# Tokens.


@pytest.mark.parametrize(
    "headers",
    [
        (),
        ("Authorization: ",),
        ("Authorization: Bearer",),
        ("Authorization: Bearer ",),
        ("Authorization: Bearer wrong",),
        (f"Authorization: Bearer {ADMIN}x",),
        (f"Authorization: Bearer {ADMIN[:-1]}",),
        (f"Authorization: Bearer {ADMIN} {ADMIN}",),
        (f"Authorization: {ADMIN}",),
        (f"Authorization: Basic {ADMIN}",),
        (f"Authorization: Bearer {ADMIN}", f"Authorization: Bearer {ADMIN}"),
        (f"X-Authorization: Bearer {ADMIN}",),
    ],
)
@pytest.mark.parametrize(
    "request_", [web.post(GOOD), web.head("GET", "/api/v1/diagnostics/stats")], ids=["post", "get"]
)
def test_without_the_token_nothing_is_done(
    secured: web.Service, log: web.Records, headers: tuple[str, ...], request_: bytes
) -> None:
    top, _, body = request_.partition(b"\r\n\r\n")
    lines = [top, *(line.encode() for line in headers), b"Connection: close", b"", body]
    with wire.Connection(secured.address) as connection:
        connection.send(b"\r\n".join(lines))
        [answer] = web.answers(connection.rest())
    assert (answer.status, answer.json["reason"]) == (401, "unauthorized")
    assert answer.headers["www-authenticate"] == "bearer"
    assert secured.refusals() == {"unauthorized": 1}
    assert secured.memories["plant_a"].read("coils", 0, 1) == [0]
    assert log.of("ingest_refused")[0]["source"] == "-"


@pytest.mark.parametrize("form", ["Bearer {}", "bearer {}", "BEARER  {}"])
def test_the_scheme_is_written_in_any_case(
    secured: web.Service, connect: Connect, form: str
) -> None:
    headers = web.JSON | {"Authorization": form.format(ADMIN)}
    assert connect(secured).ask("POST", web.INGEST, GOOD, headers).status == 200


@pytest.mark.parametrize("path", ["/api/v1/health", "/openapi.json", "/docs"])
def test_what_needs_no_token(secured: web.Service, connect: Connect, path: str) -> None:
    assert connect(secured).get(path).status == 200


@pytest.mark.parametrize(
    ("secret", "command", "allowed"),
    [
        (ADMIN, web.command("holding_registers", 0, [1], "plant_b"), True),
        (READER, web.command("coils", 0, [1]), False),
        (NARROW, web.command("input_registers", 1000, [1]), True),
        (NARROW, web.command("holding_registers", 0, [1]), False),
        (NARROW, web.command("holding_registers", 0, [1], "plant_b"), False),
        (OTHER, web.command("holding_registers", 0, [1], "plant_b"), True),
        (OTHER, web.command("holding_registers", 0, [1]), False),
    ],
)
def test_a_token_writes_what_it_may_and_nothing_else(
    secured: web.Service, connect: Connect, secret: str, command: dict[str, Any], allowed: bool
) -> None:
    client = connect(secured, secret)
    before = secured.memories["plant_a"].read("holding_registers", 0, 1)
    answer = client.ingest(command)
    good = web.command("input_registers", 1000, [5])
    mixed = client.ingest([good, command])
    if allowed:
        assert answer.status == 200
        return
    for refusal in (answer, mixed):
        assert (refusal.status, refusal.json["reason"]) == (403, "not_granted")
    assert secured.memories["plant_a"].read("holding_registers", 0, 1) == before
    assert secured.memories["plant_a"].read("input_registers", 1000, 1) == [0]
    assert secured.refusals() == {"not_granted": 2}


@pytest.mark.parametrize("path", [web.INGEST, "/api/v1/sessions/end"])
def test_a_client_without_the_right_is_refused_without_reading_its_body(
    secured: web.Service, path: str
) -> None:
    more = "Content-Type: application/json", f"Authorization: Bearer {READER}", "Content-Length: 9"
    with wire.Connection(secured.address) as connection:
        connection.send(web.head("POST", path, *more))
        connection.finish()
        [answer] = web.answers(connection.rest())
    assert (answer.status, answer.json["reason"]) == (403, "not_granted")
    assert secured.refusals() == {"not_granted": 1}


@pytest.mark.parametrize(
    ("secret", "memory", "area", "status"),
    [
        (READER, "plant_a", "coils", 200),
        (READER, "plant_b", "holding_registers", 403),
        (NARROW, "plant_a", "coils", 403),
        (OTHER, "plant_a", "coils", 403),
        (OTHER, "plant_b", "holding_registers", 200),
    ],
)
def test_a_token_reads_what_it_reaches(
    secured: web.Service, connect: Connect, secret: str, memory: str, area: str, status: int
) -> None:
    assert connect(secured, secret).read(area, 0, 1, memory).status == status


@pytest.mark.parametrize(
    ("secret", "names"), [(ADMIN, {"plant_a", "plant_b"}), (OTHER, {"plant_b"})]
)
def test_a_token_is_shown_its_memories_only(
    secured: web.Service, connect: Connect, secret: str, names: set[str]
) -> None:
    shown = connect(secured, secret).get("/api/v1/diagnostics/memory").json["memories"]
    assert set(shown) == names


def test_no_token_is_ever_logged_or_answered(
    secured: web.Service, connect: Connect, log: web.Records
) -> None:
    answers = []
    for secret in (ADMIN, READER, NARROW, OTHER, "secret-unknown"):
        client = connect(secured, secret)
        for body in (GOOD, b"{", web.command("coils", 0, [2]), web.command("x", 0, [1])):
            answers.append(client.ingest(body))
        answers += [client.read("coils", 0, 0), client.read("coils", 0, 1)]
        answers += [client.get(path) for path in (*ROUTES, f"/nowhere?token={secret}")]
    said = b"".join(answer.body + repr(answer.headers).encode() for answer in answers)
    text = "\n".join(log.lines)
    assert "ingest_refused" in text
    for word in ("secret-", *(entry["sha256"] for entry in TOKENS)):
        assert str(word) not in text
        assert str(word).encode() not in said


def test_the_log_says_who_what_and_why(
    secured: web.Service, connect: Connect, log: web.Records
) -> None:
    connect(secured, NARROW).ingest([web.command("input_registers", 1000, [1, 65536])])
    [line] = log.of("ingest_refused")
    peer = line.pop("peer")
    assert re.fullmatch(r"127\.0\.0\.1:\d+", peer)
    assert line == {
        "event": "ingest_refused",
        "adapter": "rest",
        "source": "narrow",
        "command": 0,
        "memory": "plant_a",
        "area": "input_registers",
        "address": 1000,
        "index": 1,
        "value": "65536",
        "reason": "invalid_value",
    }


def test_writes_are_audited_and_reads_are_not(
    start: Start, connect: Connect, tmp_path: Path
) -> None:
    file = tmp_path / "audit.jsonl"
    audit = Audit(file, max_bytes=10**6, keep=1)
    service = start(audit=audit, tokens=TOKENS)
    client, stranger = connect(service, ADMIN), connect(service)
    client.ingest(web.command("coils", 0, [1]))
    client.ingest(web.command("coils", 0, [2]))
    client.read("coils", 0, 1)
    client.read("coils", 0, 0)
    stranger.read("coils", 0, 1)
    stranger.get("/nowhere")
    stranger.ingest(GOOD)
    audit.close()
    assert [(line["source"], line["outcome"]) for line in writes(file)] == [
        ("admin", "done"),
        ("admin", "invalid_value"),
    ]


@pytest.mark.parametrize(
    ("host", "allowed"),
    [
        ("127.0.0.1", True),
        ("127.0.0.1:8080", True),
        ("localhost", True),
        ("LocalHost:8080", True),
        ("[::1]:8080", True),
        ("10.0.0.1", True),
        ("evil.example", False),
        ("evil.example:8080", False),
        ("127.0.0.1.evil.example", False),
        ("localhost.evil.example", False),
        ("\u00e9", False),
    ],
)
def test_without_tokens_a_page_of_the_web_reaches_nothing_by_its_own_name(
    service: web.Service, host: str, allowed: bool
) -> None:
    with wire.Connection(service.address) as connection:
        connection.send(
            web.post(GOOD, "Connection: close").replace(
                b"Host: 127.0.0.1", f"Host: {host}".encode("latin-1")
            )
        )
        [answer] = web.answers(connection.rest())
    assert answer.status == (200 if allowed else 403)


# Diagnostics.


def test_health(client: web.Client) -> None:
    assert client.get("/api/v1/health").json == {"status": "ok"}


def test_memories_with_areas_starts_sizes_and_seal(client: web.Client) -> None:
    shown = client.get("/api/v1/diagnostics/memory").json["memories"]
    assert shown["plant_a"] == {
        "areas": {
            "coils": {"start": 0, "size": 1000},
            "discrete_inputs": {"start": 0, "size": 1000},
            "holding_registers": {"start": 0, "size": 65536},
            "input_registers": {"start": 1000, "size": 200},
        },
        "sealed": False,
        "opened": 0,
        "closed": 0,
    }


def test_stats_count_what_came(client: web.Client, service: web.Service) -> None:
    web.stand_in(service.diagnostics).listeners["scada"] = {
        "requests": {3: 5},
        "exceptions": {2: 1},
    }
    client.ingest([web.command("coils", 0, [1, 1]), web.command("coils", 9, [1])])
    client.ingest(web.command("coils", 0, [2]))
    client.ingest(b"{")
    client.read("coils", 0, 1)
    stats = client.get("/api/v1/diagnostics/stats").json
    rest = stats["adapters"]["rest"]
    assert rest["state"] == "running"
    assert (rest["accepted"], rest["values"], rest["reads"]) == (1, 3, 1)
    assert rest["refused"] == {"invalid_value": 1, "malformed": 1}
    assert rest["connections"]["open"] == 1
    assert stats["listeners"]["scada"] == {"requests": {"3": 5}, "exceptions": {"2": 1}}


def test_mqtt_when_there_is_none(client: web.Client) -> None:
    answer = client.get("/api/v1/diagnostics/mqtt")
    assert (answer.status, answer.json["reason"]) == (404, "not_configured")


def test_mqtt_when_there_is_one(client: web.Client, service: web.Service) -> None:
    status = {"connected": True, "broker": "mqtt://b:1883", "topics": ["a"], "last_error": "x"}
    told: Any = SimpleNamespace(status=lambda: status)
    service.diagnostics.adapters["mqtt"] = told
    assert client.get("/api/v1/diagnostics/mqtt").json == status


# The document and the page.


@pytest.fixture(scope="module")
def document() -> dict[str, Any]:
    return document_of("1.0", 8 * 2**20, secured=True)


def resolve(document: dict[str, Any], reference: str) -> Any:
    found: Any = document
    for part in reference.removeprefix("#/").split("/"):
        found = found[part]
    return found


def nodes(value: Any) -> Iterator[dict[str, Any]]:
    if isinstance(value, dict):
        yield value
        for entry in value.values():
            yield from nodes(entry)
    elif isinstance(value, list):
        for entry in value:
            yield from nodes(entry)


TYPES = {"object": dict, "array": list, "string": str, "boolean": bool, "null": type(None)}
KNOWN = {
    *("$ref", "oneOf", "const", "enum", "type", "properties", "required", "items", "minItems"),
    *("minimum", "maximum", "additionalProperties", "propertyNames", "description", "default"),
}


def fits(document: dict[str, Any], schema: dict[str, Any], value: Any) -> bool:
    """Whether a value is as a schema has it; for the words of JSON Schema that are used here."""
    assert schema.keys() <= KNOWN
    if "$ref" in schema:
        return fits(document, resolve(document, schema["$ref"]), value)
    if "oneOf" in schema:
        return [fits(document, one, value) for one in schema["oneOf"]].count(True) == 1
    if "const" in schema and value != schema["const"]:
        return False
    if "enum" in schema and value not in schema["enum"]:
        return False
    kinds = schema.get("type", [])
    kinds = [kinds] if isinstance(kinds, str) else kinds
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if kinds and not any(
        number and (kind == "number" or isinstance(value, int))
        if kind in ("integer", "number")
        else isinstance(value, TYPES[kind])
        for kind in kinds
    ):
        return False
    if number and not schema.get("minimum", value) <= value <= schema.get("maximum", value):
        return False
    if isinstance(value, list):
        items = schema.get("items", {})
        return len(value) >= schema.get("minItems", 0) and all(
            fits(document, items, entry) for entry in value
        )
    if isinstance(value, dict):
        more = schema.get("additionalProperties", {})
        if set(schema.get("required", [])) - value.keys():
            return False
        for key, entry in value.items():
            own = schema.get("properties", {}).get(key, more)
            if own is False or not fits(document, own, entry):
                return False
            if not fits(document, schema.get("propertyNames", {}), key):
                return False
    return True


def test_the_document_is_served_and_names_every_route(
    client: web.Client, service: web.Service, document: dict[str, Any]
) -> None:
    served = client.get("/openapi.json").json
    assert served["openapi"] == "3.1.0"
    assert served["info"]["version"] == holdfast.__version__
    named = {
        path: method.upper() for path, methods in served["paths"].items() for method in methods
    }
    assert named == ROUTES
    app: Any = service.made()._app
    assert app.routes.keys() == named.keys()
    assert served["paths"].keys() == document["paths"].keys()


def test_every_reference_resolves_and_everything_is_used(document: dict[str, Any]) -> None:
    references = {node["$ref"] for node in nodes(document) if "$ref" in node}
    for reference in references:
        resolve(document, reference)
    made = {
        f"#/components/{kind}/{name}"
        for kind in ("schemas", "responses")
        for name in document["components"][kind]
    }
    assert references == made


def test_tokens_are_in_the_document_when_there_are_some(document: dict[str, Any]) -> None:
    open_to_all = document_of("1.0", 1024, secured=False)
    assert "securitySchemes" not in open_to_all["components"]
    assert not any(
        operation["security"]
        for methods in open_to_all["paths"].values()
        for operation in methods.values()
    )
    needs = {
        path
        for path, methods in document["paths"].items()
        for operation in methods.values()
        if operation["security"]
    }
    assert needs == set(ROUTES) - {"/api/v1/health", "/openapi.json", "/docs"}


def test_every_example_is_as_its_schema_has_it(document: dict[str, Any]) -> None:
    seen = 0
    for node in nodes(document):
        given = [entry["value"] for entry in node.get("examples", {}).values()]
        given += [node["example"]] if "example" in node else []
        for value in given:
            assert fits(document, node["schema"], value)
            seen += 1
    assert seen > 15


def test_every_example_command_is_accepted(document: dict[str, Any]) -> None:
    body = document["paths"]["/api/v1/ingest"]["post"]["requestBody"]["content"]
    plant = holdfast.Memory(coils=16, discrete_inputs=16, holding_registers=16, input_registers=16)
    memory_access = MemoryAccess("rest", {"plant_a": plant})
    grant = Grant("test", {"plant_a"}, web.AREAS)
    for example in body["application/json"]["examples"].values():
        memory_access.ingest(json.dumps(example["value"]).encode(), grant, "test")


@pytest.mark.parametrize(
    ("method", "path", "body"),
    [
        ("POST", "/api/v1/ingest", GOOD),
        ("POST", "/api/v1/ingest", b"[" + GOOD + b"]"),
        ("POST", "/api/v1/ingest", b"{"),
        ("POST", "/api/v1/ingest", GOOD.replace(b"[1]", b"[1,2]")),
        ("POST", "/api/v1/ingest", b"[" + GOOD.replace(b"[1]", b"[1,2]") + b"]"),
        ("POST", "/api/v1/ingest", GOOD.replace(b"plant_a", b"plant_z")),
        ("POST", "/api/v1/ingest", b" " * 2000),
        ("GET", "/api/v1/memory/read?memory=plant_a&area=coils&address=0&count=8", None),
        ("GET", "/api/v1/memory/read?memory=plant_b&area=coils&address=0&count=8", None),
        ("GET", "/api/v1/memory/read", None),
        ("GET", "/api/v1/memory/changes", None),
        ("GET", "/api/v1/memory/changes?memory=plant_b&area=coils&address=0&count=8", None),
        ("GET", "/api/v1/health", None),
        ("GET", "/api/v1/diagnostics/memory", None),
        ("GET", "/api/v1/diagnostics/stats", None),
        ("GET", "/api/v1/diagnostics/mqtt", None),
        ("GET", "/api/v1/sessions", None),
        ("POST", "/api/v1/sessions/end", b'{"id":"scada/17"}'),
        ("POST", "/api/v1/sessions/end", b'{"id":"scada"}'),
        ("POST", "/api/v1/sessions/end", b"[" * 2000),
        ("GET", "/openapi.json", None),
    ],
)
@pytest.mark.parametrize("secret", [ADMIN, READER, None])
def test_answers_are_as_the_document_says(
    start: Start, connect: Connect, method: str, path: str, body: bytes | None, secret: str | None
) -> None:
    client = connect(start(tokens=TOKENS, max_body=1024), secret)
    document = client.get("/openapi.json").json
    answer = client.ask(method, path, body)
    operation = document["paths"][path.partition("?")[0]][method.lower()]
    told = operation["responses"][str(answer.status)]
    told = resolve(document, told["$ref"]) if "$ref" in told else told
    assert fits(document, told["content"]["application/json"]["schema"], answer.json)


@pytest.mark.parametrize("value", [*BAD_REGISTERS[1:], "70000"])
def test_the_schema_refuses_what_the_server_refuses(document: dict[str, Any], value: str) -> None:
    schema = {"$ref": "#/components/schemas/Command"}
    assert not fits(document, schema, web.command("holding_registers", 0, [json.loads(value)]))
    assert fits(document, schema, web.command("holding_registers", 0, [65535]))


def test_the_page_stands_alone(client: web.Client) -> None:
    answer = client.get("/docs")
    assert answer.headers["content-type"] == "text/html; charset=utf-8"
    text = answer.body.decode()
    for path in ROUTES:
        assert f" {path}</h2>" in text
    assert "<script" not in text
    assert not re.search(r"\b(src|action|style|on\w+)=", text)
    links = set(re.findall(r'href="([^"]*)"', text))
    assert all(link.startswith("#") or link == "/openapi.json" for link in links)
    assert "prefers-color-scheme: dark" in text
    policy = answer.headers["content-security-policy"]
    assert policy.startswith("default-src 'none'; style-src 'sha256-")


def test_the_curl_commands_of_the_page_do_what_they_say(
    client: web.Client, service: web.Service
) -> None:
    text = client.get("/docs").body.decode()
    host, port = service.address
    commands = re.findall(r"<pre>curl (.*?)</pre>", text)
    assert len(commands) == 3 + len(ROUTES) - 1
    assert all(f"http://{host}:{port}/" in command for command in commands)


# Start and stop.


def test_stop_ends_it_also_with_connections_that_are_open(start: Start, connect: Connect) -> None:
    service = start(stop_timeout=0.1)
    client = connect(service)
    client.get("/api/v1/health")
    with wire.Connection(service.address) as half:
        half.send(web.post(GOOD)[:-5])
        service.until_counted("accepted", 2)
        service.supervisor.stop()
        wire.until(lambda: service.supervisor.status()["state"] == "stopped", "stopped")


def test_stop_does_not_wait_for_the_rest_of_a_request(start: Start) -> None:
    service = start(stop_timeout=1000)
    request = web.post(GOOD, "Expect: 100-continue")
    with wire.Connection(service.address) as half:
        half.send(request[: request.index(b"\r\n\r\n") + 4])
        go_on = b"HTTP/1.1 100 Continue\r\n\r\n"
        assert half.socket.recv(len(go_on)) == go_on, "it waits for the body"
        service.supervisor.stop()
        wire.until(lambda: service.supervisor.status()["state"] == "stopped", "stopped")


def test_it_runs_again_on_the_same_socket(memories: dict[str, holdfast.Memory]) -> None:
    service = web.Service(memories)
    with contextlib.closing(service.listener):
        for _ in range(3):
            with (
                web.in_a_thread(service.made()),
                contextlib.closing(web.Client(service.address)) as client,
            ):
                assert client.get("/api/v1/health").status == 200


def test_it_may_run_in_the_main_thread(memories: dict[str, holdfast.Memory]) -> None:
    service = web.Service(memories)
    stop = Stop()
    stop.set()
    service.made().run(stop)
    service.listener.close()


def test_a_port_that_is_taken_is_an_error_at_once(service: web.Service) -> None:
    with pytest.raises(OSError, match="in use"):
        listen(*service.address)
