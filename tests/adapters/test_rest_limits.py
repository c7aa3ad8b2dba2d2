"""REST against clients that are slow, broken, too many, too large, or mean harm."""

from __future__ import annotations

import gc
import itertools
import json
import os
import random
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING, Any, Protocol

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import holdfast
from holdfast.adapters import Stop
from holdfast.net.http import server as http_server
from holdfast.net.http.port import listen
from support import web, wire
from support.cases import examples
from support.machine import missing

if TYPE_CHECKING:
    from collections.abc import Iterator

LIMIT = 8 * 2**20
SOON = 1.0
"""The request timeout of tests that wait for it. A request must begin before it ends."""

HEALTH = web.head("GET", "/api/v1/health")
GOOD = b'{"memory":"plant_a","area":"coils","address":0,"values":[1]}'
CLOSE = "Connection: close"


class Start(Protocol):
    """Starts a service that is stopped when the test ends."""

    def __call__(self, **settings: Any) -> web.Service: ...


class Connect(Protocol):
    """Opens a connection that is closed when the test ends."""

    def __call__(
        self, service: web.Service, sends: bytes = b"", **options: Any
    ) -> wire.Connection: ...


@pytest.fixture
def start() -> Iterator[Start]:
    with ExitStack() as running:

        def started(**given: Any) -> web.Service:
            plant = holdfast.Memory(coils=1000, holding_registers=65536)
            service = web.Service({"plant_a": plant}, **given)
            running.enter_context(web.supervised(service.supervisor, service.listener))
            return service

        yield started


@pytest.fixture
def service(start: Start) -> web.Service:
    return start()


@pytest.fixture
def hasty(start: Start) -> web.Service:
    return start(request_timeout=SOON)


@pytest.fixture
def connect() -> Iterator[Connect]:
    with ExitStack() as opened:

        def connected(service: web.Service, sends: bytes = b"", **options: Any) -> wire.Connection:
            connection = wire.Connection(service.address, **options)
            opened.enter_context(connection)
            connection.send(sends)
            return connection

        yield connected


def coil(service: web.Service) -> int:
    """The coil that `GOOD` sets."""
    return service.memories["plant_a"].read("coils", 0, 1)[0]


def is_well(service: web.Service) -> bool:
    """Whether a new client is served."""
    client = web.Client(service.address)
    try:
        return bool(client.get("/api/v1/health").json == {"status": "ok"})
    except ConnectionError:
        return False
    finally:
        client.close()


def exchange(connection: wire.Connection, sends: bytes) -> bytes:
    """Sends and receives at once; all that came until the connection was closed."""
    with ThreadPoolExecutor(1) as threads:
        sending = threads.submit(connection.send, sends)
        received = connection.rest()
        sending.result()
    return received


def padded(size: int) -> bytes:
    """A command with this many bytes."""
    return GOOD + b" " * (size - len(GOOD))


def chunked(body: bytes, size: int) -> bytes:
    pieces = [body[at : at + size] for at in range(0, len(body), size)]
    return b"".join(b"%x\r\n%b\r\n" % (len(piece), piece) for piece in pieces) + b"0\r\n\r\n"


def post_chunked(body: bytes, size: int, *headers: str) -> bytes:
    kind, coding = "Content-Type: application/json", "Transfer-Encoding: chunked"
    return web.head("POST", web.INGEST, kind, coding, *headers) + chunked(body, size)


# Large bodies.


@pytest.mark.parametrize("limit", [1024, 65536, 100_000, LIMIT])
def test_a_body_at_the_limit_is_taken_and_one_above_is_not(start: Start, limit: int) -> None:
    service = start(max_body=limit)
    for body, status in [(padded(limit), 200), (padded(limit + 1), 413), (padded(limit), 200)]:
        client = web.Client(service.address)
        answer = client.ingest(body)
        client.close()
        assert answer.status == status
    assert service.refusals() == {"too_large": 1}
    assert service.memory_access.counts()["accepted"] == 2


@pytest.mark.parametrize(("limit", "size"), [(1024, 7), (LIMIT, 65521), (LIMIT, 10**6)])
def test_a_chunked_body_at_the_limit_is_taken_and_one_above_is_not(
    start: Start, connect: Connect, limit: int, size: int
) -> None:
    service = start(max_body=limit)
    for length, status in [(limit, 200), (limit + 1, 413)]:
        connection = connect(service, post_chunked(padded(length), size, CLOSE))
        [answer] = web.answers(connection.rest())
        assert answer.status == status
        assert answer.headers["connection"] == "close"
    assert service.refusals() == {"too_large": 1}


def test_a_length_above_the_limit_is_refused_before_the_body_is_read(
    start: Start, connect: Connect
) -> None:
    service = start(max_body=1024)
    connection = connect(service, web.post(GOOD).replace(b": 60", b": 999999999999")[:-5])
    [answer] = web.answers(connection.rest())
    assert (answer.status, answer.json["reason"]) == (413, "too_large")
    assert answer.json["detail"] == "the body has more than 1024 bytes"
    assert service.refusals() == {"too_large": 1}


@pytest.mark.parametrize("length", ["-1", "1e3", "0x10", "99999999999999999999999", "", "1 1"])
def test_a_length_that_is_no_number_is_not_http(
    service: web.Service, connect: Connect, length: str
) -> None:
    sent = web.post(GOOD).replace(b": 60", b": " + length.encode())
    answers = web.answers(connect(service, sent).rest())
    assert answers[0].status == 400
    assert coil(service) == 0


def test_an_endless_chunked_body_is_cut_off(start: Start, connect: Connect) -> None:
    service = start(max_body=1024)
    connection = connect(service, post_chunked(b"", 1)[:-5])
    chunk = b"1000\r\n" + b" " * 4096 + b"\r\n"

    def is_closed() -> bool:
        try:
            connection.send(chunk)
        except (ConnectionError, TimeoutError):
            return True
        return False

    wire.until(is_closed, "the connection closed")
    assert service.refusals() == {"too_large": 1}


def test_a_client_that_asks_first_is_told_to_go_on(service: web.Service, connect: Connect) -> None:
    top, _, body = web.post(GOOD, CLOSE, "Expect: 100-continue").partition(b"\r\n\r\n")
    connection = connect(service, top + b"\r\n\r\n")
    go_on = b"HTTP/1.1 100 Continue\r\n\r\n"
    assert connection.socket.recv(len(go_on)) == go_on
    connection.send(body)
    assert web.answers(connection.rest())[0].status == 200


@pytest.mark.parametrize(
    ("old", "new", "status"),
    [(b": 60", b": 999999999", 413), (b"application/json", b"text/plain", 415)],
)
def test_a_client_that_asks_first_is_told_no_at_once(
    service: web.Service, connect: Connect, old: bytes, new: bytes, status: int
) -> None:
    top, _, _ = web.post(GOOD, "Expect: 100-continue").partition(b"\r\n\r\n")
    connection = connect(service, top.replace(old, new) + b"\r\n\r\n")
    [answer] = web.answers(connection.rest())
    assert (answer.status, answer.headers["connection"]) == (status, "close")


@pytest.mark.parametrize(
    "headers",
    [
        ["X-Long: " + "x" * 100_000],
        [f"X-{number}: x" for number in range(10_000)],
        ["X-Empty:" + " " * 100_000],
    ],
    ids=["one", "many", "empty"],
)
def test_a_header_has_an_end(service: web.Service, connect: Connect, headers: list[str]) -> None:
    connection = connect(service)
    try:
        connection.send(web.head("GET", "/api/v1/health", *headers))
        answers = web.answers(connection.rest())
    except ConnectionError:
        answers = []
    assert [answer.status for answer in answers] in ([431], [])
    service.until_counted("broken_request")
    wire.until(lambda: is_well(service), "it serves")


def test_a_header_below_the_limit_is_taken(service: web.Service, connect: Connect) -> None:
    sent = web.head("GET", "/api/v1/health", "X-Long: " + "x" * 60_000, CLOSE)
    assert web.answers(connect(service, sent).rest())[0].status == 200


@pytest.mark.parametrize("kind", ["extension", "trailer"])
def test_what_comes_beside_a_chunked_body_has_an_end(
    service: web.Service, connect: Connect, kind: str
) -> None:
    start = post_chunked(GOOD, 30)
    extended = start.replace(b"\r\n1e\r\n", b"\r\n1e;" + b"x" * 200_000 + b"\r\n", 1)
    trailed = start[:-2] + b"X-Long: " + b"x" * 200_000 + b"\r\n\r\n"
    connection = connect(service)
    try:
        connection.send(extended if kind == "extension" else trailed)
        connection.rest()
    except ConnectionError:
        pass
    service.until_counted("broken_request")
    assert coil(service) == 0


# Slow clients.


def test_a_header_has_to_come_in_time(hasty: web.Service, connect: Connect) -> None:
    late = [connect(hasty, sent) for sent in (b"", b"\r\n", b"POST", HEALTH[:-2])]
    assert [connection.rest() for connection in late] == [b""] * len(late)
    hasty.until_counted("request_timeout", len(late))
    assert hasty.refusals() == {}


def drip(connection: wire.Connection, piece: bytes) -> bytes:
    """Sends a byte now and then, until the connection is closed; what came back."""

    def is_closed() -> bool:
        try:
            connection.send(next(pieces))
        except ConnectionError:
            return True
        return False

    pieces = (bytes([byte]) for byte in itertools.cycle(piece))
    wire.until(is_closed, "the connection closed")
    return connection.rest()


def test_neither_a_dripping_header_nor_empty_lines_are_a_way_to_stay(
    hasty: web.Service, connect: Connect
) -> None:
    connections, pieces = (connect(hasty, HEALTH[:-2]), connect(hasty)), (b"X-Slow: x\r\n", b"\r\n")
    with ThreadPoolExecutor(2) as threads:
        assert list(threads.map(drip, connections, pieces)) == [b"", b""]
    hasty.until_counted("request_timeout", 2)


def test_a_body_has_to_come_in_time(hasty: web.Service, connect: Connect) -> None:
    cut = (web.post(GOOD)[:-1], post_chunked(GOOD, 30)[:-5])
    late = [connect(hasty, before + sent) for before in (b"", HEALTH) for sent in cut]
    refused = connect(hasty, cut[0].replace(b"application/json", b"text/plain"))
    for connection in late:
        *_, answer = web.answers(connection.rest())
        assert (answer.status, answer.json["reason"]) == (408, "timeout")
        assert answer.headers["connection"] == "close"
    [answer] = web.answers(refused.rest())
    assert answer.status == 415
    assert coil(hasty) == 0
    assert hasty.refusals() == {"timeout": 4, "not_json": 1}
    assert hasty.connections()["request_timeout"] == 5


def test_a_body_that_drips_has_to_come_in_time_too(hasty: web.Service, connect: Connect) -> None:
    connection = connect(hasty, web.post(padded(100_000))[:1000])
    with suppress(ConnectionError):
        drip(connection, b" ")
    hasty.until_counted("request_timeout")
    wire.until(lambda: hasty.refusals() == {"timeout": 1}, "the refusal")


def test_a_connection_may_be_idle_between_requests(hasty: web.Service, connect: Connect) -> None:
    client = web.Client(hasty.address)
    client.get("/api/v1/health")
    for times in (1, 2):
        connect(hasty).rest()
        hasty.until_counted("request_timeout", times)
    assert client.ingest(GOOD).status == 200
    client.close()


@pytest.mark.parametrize("refused", [False, True])
def test_a_connection_may_not_be_idle_for_ever(
    start: Start, connect: Connect, monkeypatch: pytest.MonkeyPatch, refused: bool
) -> None:
    monkeypatch.setattr(http_server, "KEEP_ALIVE_S", 0.1)
    service = start()
    sent = web.post(GOOD)
    connection = connect(service, sent.replace(b"/json", b"/x") if refused else sent)
    assert len(web.answers(connection.rest())) == 1
    service.until_counted("idle")


def test_a_client_has_to_take_its_replies(hasty: web.Service, connect: Connect) -> None:
    everything = f"{web.READ}?memory=plant_a&area=holding_registers&address=0&count=65536"
    connection = connect(hasty, receive_buffer=4096)
    connection.send(web.head("GET", everything) * 200)
    hasty.until_counted("slow_reader")
    wire.until(lambda: hasty.connections()["open"] == 0, "the connection closed")
    wire.until(lambda: is_well(hasty), "it serves")


def test_a_client_that_closes_without_taking_its_reply_is_forgotten(
    hasty: web.Service, connect: Connect
) -> None:
    everything = f"{web.READ}?memory=plant_a&area=holding_registers&address=0&count=65536"
    connection = connect(hasty, receive_buffer=4096)
    connection.send(web.head("GET", everything, CLOSE) * 1)
    connection.reset()
    wire.until(lambda: hasty.connections()["open"] == 0, "the connection closed")


def test_a_large_reply_comes_whole(service: web.Service, connect: Connect) -> None:
    values = [place & 0xFFFF for place in range(65536)]
    service.memories["plant_a"].write("holding_registers", 0, values)
    everything = f"{web.READ}?memory=plant_a&area=holding_registers&address=0&count=65536"
    connection = connect(service, receive_buffer=4096)
    sends = web.head("GET", everything) * 3 + web.head("GET", everything, CLOSE)
    answers = web.answers(exchange(connection, sends))
    assert [answer.json["values"] for answer in answers] == [values] * 4


# Broken clients.


@pytest.mark.parametrize("length", range(0, len(web.post(GOOD)), 7))
@pytest.mark.parametrize("how", ["close", "reset", "finish"])
def test_half_a_request_does_nothing(
    service: web.Service, connect: Connect, length: int, how: str
) -> None:
    connection = connect(service, web.post(GOOD)[:length])
    service.until_counted("accepted")
    getattr(connection, how)()
    wire.until(lambda: service.connections()["open"] == 0, "the connection closed")
    assert coil(service) == 0
    assert service.refusals() == {}


GARBAGE = [
    b"\x00",
    b"\xff" * 100,
    b"\r\n\r\n\x00",
    b"hello\r\n\r\n",
    b"GET\r\n\r\n",
    b"GET / HTTP/9.9\r\n\r\n",
    b"GET / HTTP/2.0\r\n\r\n",
    b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
    b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(range(200)),
    bytes.fromhex("000100000006010300000001"),
    b"GET / HTTP/1.1\r\nNo colon\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost : x\r\n\r\n",
    b"GET / HTTP/1.1\r\nX: a\x00b\r\n\r\n",
    b"GET /\xff HTTP/1.1\r\n\r\n",
    b"GET http:// HTTP/1.1\r\n\r\n",
    web.head("POST", web.INGEST, "Content-Length: 1", "Content-Length: 2") + b"xx",
    web.head("POST", web.INGEST, "Content-Length: 5", "Transfer-Encoding: chunked") + b"0\r\n\r\n",
    web.head("POST", web.INGEST, "Transfer-Encoding: chunked", "Content-Length: 5") + b"0\r\n\r\n",
    web.head("POST", web.INGEST, "Transfer-Encoding: gzip, chunked") + b"0\r\n\r\n",
    web.head("POST", web.INGEST, *2 * ["Transfer-Encoding: chunked"]) + b"0\r\n\r\n",
    web.head("POST", web.INGEST, "Transfer-Encoding: gzip") + b"x",
    web.head("POST", web.INGEST, "Transfer-Encoding: chunked, gzip") + b"x",
    web.head("POST", web.INGEST, "Transfer-Encoding: xchunked") + b"0\r\n\r\n",
    web.head("POST", web.INGEST, "Content-Type: application/json", "Transfer-Encoding: chunked")
    + b"x\r\n",
    web.head("POST", web.INGEST, "Content-Type: application/json", "Transfer-Encoding: chunked")
    + b"-1\r\n",
    web.head("POST", web.INGEST, "Content-Type: application/json", "Transfer-Encoding: chunked")
    + b"fffffffffffffffffff\r\n",
]


@pytest.mark.parametrize("sent", GARBAGE, ids=[str(number) for number in range(len(GARBAGE))])
def test_what_is_not_http_is_refused(service: web.Service, connect: Connect, sent: bytes) -> None:
    connection = connect(service, sent)
    [answer] = web.answers(connection.rest())
    # The type of the body may be refused before the body is seen.
    assert answer.status == 415 or (answer.status, answer.headers["connection"]) == (400, "close")
    assert answer.json["status"] == "rejected"
    assert "x-content-type-options" in answer.headers
    service.until_counted("broken_request")
    assert service.memories["plant_a"].read("coils", 0, 1000) == [0] * 1000
    wire.until(lambda: is_well(service), "it serves")


@pytest.mark.parametrize("method", ["BREW", "CONNECT", "TRACE"])
def test_a_method_that_no_resource_has_is_refused(
    service: web.Service, connect: Connect, method: str
) -> None:
    [answer] = web.answers(connect(service, web.head(method, "/pot", CLOSE)).rest())
    assert answer.status in (400, 404)
    [answer] = web.answers(connect(service, web.head(method, web.INGEST, CLOSE)).rest())
    assert answer.status in (400, 405)


@settings(
    max_examples=examples(100),
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
@given(st.data())
def test_bytes_of_any_kind_do_no_harm(hasty: web.Service, data: st.DataObject) -> None:
    whole = bytearray(web.post(GOOD, CLOSE))
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(whole) - 1))
        whole[at : at + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=3))
    with wire.Connection(hasty.address) as connection:
        connection.send(bytes(whole))
        connection.finish()
        for answer in web.answers(connection.rest()):
            assert answer.status < 500
    wire.until(lambda: is_well(hasty), "it serves")


@settings(
    max_examples=examples(50),
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
@given(cuts=st.lists(st.integers(0, 400), max_size=12), way=st.sampled_from(["plain", "chunked"]))
def test_a_request_may_come_in_any_pieces(service: web.Service, cuts: list[int], way: str) -> None:
    sent = web.post(GOOD, CLOSE) if way == "plain" else post_chunked(GOOD, 9, CLOSE)
    places = sorted({0, len(sent), *(cut for cut in cuts if cut < len(sent))})
    with wire.Connection(service.address) as connection:
        for begin, end in itertools.pairwise(places):
            connection.send(sent[begin:end])
        [answer] = web.answers(connection.rest())
    assert answer.json == {"status": "accepted", "memory": "plant_a", "written": 1}


def test_a_client_that_sends_no_more_still_gets_its_answers(
    service: web.Service, connect: Connect
) -> None:
    connection = connect(service, web.post(GOOD) * 500)
    connection.finish()
    assert [answer.status for answer in web.answers(connection.rest())] == [200] * 500


@pytest.mark.parametrize("version", ["1.0", "1.1"])
@pytest.mark.parametrize("header", ["X-None: x", CLOSE])
def test_when_a_connection_stays_open(
    service: web.Service, connect: Connect, version: str, header: str
) -> None:
    sent = web.head("GET", "/api/v1/health", header, version=version)
    stays = version == "1.1" and header != CLOSE
    connection = connect(service, sent)
    if stays:
        connection.send(web.head("GET", "/api/v1/health", CLOSE))
    answers = web.answers(connection.rest())
    assert len(answers) == (2 if stays else 1)
    assert answers[-1].headers["connection"] == "close"


# Requests one behind the other.


def test_requests_sent_ahead_are_answered_in_their_order(
    service: web.Service, connect: Connect
) -> None:
    requests = []
    for value in range(2000):
        body = json.dumps(web.command("holding_registers", 7, [value])).encode()
        requests.append(web.post(body) if value % 2 else post_chunked(body, 20))
        query = "memory=plant_a&area=holding_registers&address=7&count=1"
        requests.append(web.head("GET", f"{web.READ}?{query}"))
    last = web.head("GET", "/api/v1/health", CLOSE)
    answers = web.answers(exchange(connect(service), b"".join([*requests, last])))
    assert len(answers) == 4001
    read = [answer.json["values"] for answer in answers[1:-1:2]]
    assert read == [[value] for value in range(2000)]


def test_a_flood_of_requests_waits_as_bytes(service: web.Service, connect: Connect) -> None:
    last = web.head("GET", "/api/v1/health", CLOSE)
    answers = web.answers(exchange(connect(service), HEALTH * 10_000 + last))
    assert len(answers) == 10_001


def test_broken_bytes_behind_a_request_leave_it_its_answer(
    service: web.Service, connect: Connect
) -> None:
    connection = connect(service, web.post(GOOD) + b"\x00garbage")
    written, refused = web.answers(connection.rest())
    assert (written.status, refused.status, refused.headers["connection"]) == (200, 400, "close")
    assert coil(service) == 1
    assert service.connections()["broken_request"] == 1


def test_what_follows_the_last_request_is_not_one(service: web.Service, connect: Connect) -> None:
    connection = connect(service, web.head("GET", "/api/v1/health", CLOSE) + web.post(GOOD))
    [answer] = web.answers(connection.rest())
    assert answer.json == {"status": "ok"}
    assert coil(service) == 0


@pytest.mark.parametrize(
    "offer",
    [
        ["Connection: Upgrade, HTTP2-Settings", "Upgrade: h2c", "HTTP2-Settings: AAMAAABk"],
        ["Connection: Upgrade", "Upgrade: websocket", "Sec-WebSocket-Key: x"],
    ],
    ids=["h2c", "websocket"],
)
@pytest.mark.parametrize("pieces", [1, 7])
def test_an_offer_of_another_protocol_is_passed_over(
    service: web.Service, connect: Connect, offer: list[str], pieces: int
) -> None:
    big = padded(20_000)
    sent = web.post(GOOD, *offer) + web.post(big, *offer)
    sent += web.head("GET", "/api/v1/health", *offer) + web.post(GOOD, CLOSE)
    connection = connect(service)
    for at in range(0, len(sent), len(sent) // pieces + 1):
        connection.send(sent[at : at + len(sent) // pieces + 1])
    answers = web.answers(connection.rest())
    assert [answer.status for answer in answers] == [200] * 4


def test_a_trailer_is_not_a_header(start: Start, connect: Connect) -> None:
    service = start(tokens=[web.token("a", "secret")])
    sent = post_chunked(GOOD, 9, CLOSE)[:-2] + b"Authorization: Bearer secret\r\n\r\n"
    [answer] = web.answers(connect(service, sent).rest())
    assert answer.status == 401


def test_a_refused_body_does_not_disturb_the_next_request(start: Start, connect: Connect) -> None:
    service = start(tokens=[web.token("a", "secret")])
    big = padded(3_000_000)
    last = web.post(GOOD, "Authorization: Bearer secret", CLOSE)
    sends = web.post(big) + post_chunked(big, 70_000) + last
    answers = web.answers(exchange(connect(service), sends))
    assert [answer.status for answer in answers] == [401, 401, 200]


# Who may connect, and how many.

needs_127_0_0_2 = pytest.mark.skipif(
    sys.platform != "linux", reason="only Linux has all of 127.0.0.0/8"
)


def has_ipv6() -> bool:
    try:
        listen("::1", 0).close()
    except OSError:
        return False
    return True


@pytest.fixture
def ipv6() -> None:
    if not has_ipv6():
        missing("IPv6 on the loopback interface")


@needs_127_0_0_2
@pytest.mark.parametrize("sends", [b"", HEALTH, web.post(GOOD), b"\x00"])
def test_a_peer_from_elsewhere_gets_not_one_byte(
    start: Start, connect: Connect, sends: bytes
) -> None:
    service = start(sources=["127.0.0.1", "127.0.1.0/24"])
    connection = connect(service, source="127.0.0.2")
    with suppress(ConnectionError):
        connection.send(sends)
    assert connection.rest() == b""
    service.until_counted("refused_source")
    assert coil(service) == 0
    connections = service.connections()
    assert (connections["accepted"], connections["open"]) == (0, 0)
    own = connect(service, web.head("GET", "/api/v1/health", CLOSE), source="127.0.1.9")
    assert web.answers(own.rest())[0].status == 200


@pytest.mark.usefixtures("ipv6")
@pytest.mark.parametrize(
    ("sources", "four", "six"),
    [
        (["127.0.0.0/8"], True, False),
        (["::1"], False, True),
        (["127.0.0.1", "::1"], True, True),
        (["::/0"], False, True),
        (["0.0.0.0/0"], True, False),
    ],
)
def test_the_any_address_of_ipv6_takes_both_and_each_is_itself(
    start: Start, sources: list[str], four: bool, six: bool
) -> None:
    service = start(bind="[::]:0", sources=sources, tokens=[web.token("a", "secret")])
    port = service.address[1]
    sent = web.head("GET", "/api/v1/health", CLOSE)
    for host, allowed in [("127.0.0.1", four), ("::1", six)]:
        with wire.Connection((host, port)) as connection:
            with suppress(ConnectionError):
                connection.send(sent)
            assert bool(connection.rest()) is allowed
    assert service.connections()["refused_source"] == [four, six].count(False)


@pytest.mark.usefixtures("ipv6")
def test_ipv6_alone(start: Start, connect: Connect) -> None:
    service = start(bind="[::1]:0")
    sent = web.head("GET", "/api/v1/health", CLOSE, host=f"[::1]:{service.address[1]}")
    assert web.answers(connect(service, sent).rest())[0].status == 200


@pytest.mark.parametrize(
    ("host", "shown"),
    [
        ("10.0.0.9", "10.0.0.9:502"),
        ("::ffff:10.0.0.9", "10.0.0.9:502"),
        ("fd00::9", "[fd00::9]:502"),
        ("fe80::1%2", "[fe80::1%2]:502"),
    ],
)
def test_how_a_peer_is_shown(host: str, shown: str) -> None:
    assert http_server.address_of(host, 502) == shown


def test_there_are_only_so_many_connections(start: Start, connect: Connect) -> None:
    service = start(max_connections=2, when_full="refuse")
    first, second = connect(service, HEALTH), connect(service)
    service.until_counted("accepted", 2)
    third = connect(service)
    with suppress(ConnectionError):
        third.send(HEALTH)
    assert third.rest() == b""
    service.until_counted("refused_full")
    second.close()
    wire.until(lambda: service.connections()["open"] == 1, "a free place")
    fourth = connect(service, web.head("GET", "/api/v1/health", CLOSE))
    assert web.answers(fourth.rest())[0].status == 200
    first.close()


def refused(connection: wire.Connection) -> bool:
    """Whether the connection was closed without a byte."""
    with suppress(ConnectionError):
        connection.send(HEALTH)
    return connection.rest() == b""


def answered(connection: wire.Connection, sends: bytes = b"") -> int:
    """Sends the rest of a request that closes the connection. Returns the status."""
    connection.send(sends)
    [answer] = web.answers(connection.rest())
    return answer.status


LAST = web.head("GET", "/api/v1/health", CLOSE)


def test_the_connection_that_is_idle_longest_gives_way(start: Start, connect: Connect) -> None:
    service = start(max_connections=3)
    idle = [connect(service) for _ in range(3)]
    for connection in (idle[1], idle[2], idle[0]):
        connection.send(HEALTH)
        assert connection.socket.recv(65536)
    before = service.connections()
    assert answered(connect(service), LAST) == 200
    assert service.connections()["evicted"] == before["evicted"] + 1
    assert service.connections()["refused_full"] == 0
    assert idle[1].rest() == b""
    assert [answered(connection, LAST) for connection in (idle[0], idle[2])] == [200, 200]


def test_an_idle_connection_gives_way_before_one_in_a_request(
    start: Start, connect: Connect
) -> None:
    service = start(max_connections=2)
    begun = connect(service, LAST[:-4])
    idle = connect(service, HEALTH)
    assert idle.socket.recv(65536)
    service.until_counted("accepted", 2)
    assert answered(connect(service), LAST) == 200
    assert idle.rest() == b""
    assert answered(begun, LAST[-4:]) == 200


@pytest.mark.parametrize("sent", [b"", LAST[:9], web.post(GOOD)[:-1]], ids=["no", "head", "body"])
def test_silent_peers_do_not_lock_the_port(start: Start, connect: Connect, sent: bytes) -> None:
    service = start(max_connections=4)
    silent = [connect(service, sent) for _ in range(4)]
    service.until_counted("accepted", 4)
    if sent:
        assert refused(connect(service)), "each has a second for its request"
    wire.until(lambda: is_well(service), "a silent peer is evicted")
    assert service.connections()["evicted"] >= 1
    assert silent[0].rest() == b"", "the first one goes first"
    assert coil(service) == 0


def test_a_peer_that_takes_no_reply_gives_way(start: Start, connect: Connect) -> None:
    service = start(max_connections=1)
    everything = f"{web.READ}?memory=plant_a&area=holding_registers&address=0&count=65536"
    slow = connect(service, receive_buffer=4096)
    slow.send(web.head("GET", everything) * 50)
    service.until_counted("accepted")
    wire.until(lambda: is_well(service), "the slow peer is evicted")
    assert service.connections()["slow_reader"] == 0


def test_a_source_at_its_limit_gives_way_itself(start: Start, connect: Connect) -> None:
    service = start(max_connections=9, max_connections_per_source=2)
    other = connect(service, HEALTH, source="127.0.0.2")
    assert other.socket.recv(65536)
    first, second = connect(service, HEALTH), connect(service, HEALTH)
    assert second.socket.recv(65536)
    assert first.socket.recv(65536)
    assert answered(connect(service), LAST) == 200
    wire.until(lambda: service.connections()["open"] == 2, "one of three is closed")
    assert service.connections()["evicted"] == 1
    assert answered(other, LAST) == 200


def test_a_source_at_its_limit_is_refused(start: Start, connect: Connect) -> None:
    service = start(max_connections_per_source=1, when_full="refuse")
    first = connect(service, HEALTH)
    assert first.socket.recv(65536)
    assert refused(connect(service))
    assert answered(connect(service, source="127.0.0.2"), LAST) == 200
    first.close()
    wire.until(lambda: is_well(service), "the place is free")
    assert service.connections()["evicted"] == 0


@needs_127_0_0_2
def test_one_source_can_not_take_all_places(start: Start) -> None:
    service = start()
    places = service.settings.max_connections
    assert web.status_for_another(service.address, "/api/v1/health", places) == 200


def test_many_come_and_go(service: web.Service, connect: Connect) -> None:
    chance = random.Random(7)
    for _ in range(300):
        connection = connect(service, chance.choice([b"", HEALTH, web.post(GOOD)[:50], b"\x00"]))
        with suppress(OSError):  # The service may have closed it already.
            chance.choice([connection.close, connection.reset, connection.finish])()
    wire.until(lambda: is_well(service), "a free place")


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="needs /proc")  # noqa: PTH112
def test_stopping_leaves_nothing_open() -> None:
    def held() -> int:
        gc.collect()  # The error of a request that was cut off holds its frames, and they hold it.
        return len(os.listdir("/proc/self/fd"))  # noqa: PTH208

    before = held()
    service = web.Service({"plant_a": holdfast.Memory(coils=8)}, stop_timeout=0.1)
    with web.supervised(service.supervisor, service.listener), ExitStack() as opened:
        for sent in (b"", HEALTH, HEALTH[:9], web.post(GOOD)[:-1]):
            opened.enter_context(wire.Connection(service.address)).send(sent)
        service.until_counted("accepted", 4)
        service.supervisor.stop()
        service.supervisor.join()
    assert held() == before


def test_a_socket_that_is_gone_is_an_error_for_the_supervisor() -> None:
    service = web.Service({})
    service.listener.close()
    with pytest.raises(OSError, match="the socket is closed"):
        service.made().run(Stop())


def test_listening_takes_no_names() -> None:
    with pytest.raises(OSError, match="allowed: address:port"):
        listen("localhost", 0)
