"""Line protocol over HTTP, against an HTTP server that reads it strictly."""

from __future__ import annotations

import contextlib
import gzip
import http.client
import socket
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.client.tcp_connect import connected_sync
from holdfast.config.models.outputs import InfluxConfig
from holdfast.outputs import Buffer, OutputSender, Refused
from holdfast.outputs import influx as influx_module
from holdfast.outputs import sender as module
from holdfast.outputs.buffer_file import BufferFile
from holdfast.outputs.influx import Influx
from holdfast.runtime.stop import Stop
from support import wire
from support.brokers import free_port
from support.line_protocol import Point, parsed
from support.readings import numbered, polls, reading, tag
from support.secured import Authority, Relay, context

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


class Database(ThreadingHTTPServer):
    """Takes points; answers with `status`."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.points: list[Point] = []
        self.requests: list[tuple[str, dict[str, str]]] = []
        self.connections = 0
        self.status, self.answer = 204, b""
        self.closes = self.says_so = False
        self.max_bytes = 1 << 30

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: Database

    def setup(self) -> None:
        super().setup()
        self.server.connections += 1

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        if self.headers.get("Content-Encoding") == "gzip":
            body = gzip.decompress(body)
        self.server.requests.append((self.path, dict(self.headers)))
        points, status = parsed(body), self.server.status
        if len(body) > self.server.max_bytes:
            status = 413
        if status == 204:
            self.server.points += points
        self.send_response(status)
        self.send_header("Content-Length", str(len(self.server.answer)))
        if self.server.says_so:
            self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(self.server.answer)
        self.close_connection = self.server.closes

    def log_message(self, *_: Any) -> None:
        pass


@pytest.fixture
def database() -> Iterator[Database]:
    with Database() as server:
        thread = threading.Thread(target=server.serve_forever, args=[0.01])
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def influx(url: str, **more: Any) -> Influx:
    return Influx(InfluxConfig.model_validate({"type": "influx", "url": url} | more))


@pytest.mark.parametrize("compressed", [True, False])
def test_points_arrive_over_one_connection(database: Database, compressed: bool) -> None:
    output = influx(
        database.url,
        org="my org",
        bucket="b/1",
        measurement="m",
        tags={"site": "n"},
        gzip=compressed,
    )
    for start in range(3):
        output.send(numbered(2, 2 * start))
    output.send([reading(None)])
    output.close()
    assert [point.fields["t"] for point in database.points] == list(range(6))
    assert database.points[0].tags == {"device": "pump", "site": "n"}
    assert database.connections == 1
    [path, *others] = [path for path, _ in database.requests]
    assert path == "/api/v2/write?org=my+org&bucket=b%2F1&precision=ns"
    assert others == [path] * 2


def test_a_time_that_gzip_has_no_room_for(
    database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    output = influx(database.url, bucket="b", gzip=True)
    monkeypatch.setattr(time, "time", lambda: 2.0**32)
    output.send(numbered(1))
    output.close()
    assert len(database.points) == 1


def test_another_receiver_has_its_own_path(database: Database, tmp_path: Path) -> None:
    (tmp_path / "p").write_text("secret\n")
    output = influx(
        f"{database.url}/write?db=x",
        username="me",
        password_file=str(tmp_path / "p"),
    )
    output.send(numbered(1))
    output.close()
    [(path, headers)] = database.requests
    assert path == "/write?db=x"
    assert headers["Authorization"] == "Basic bWU6c2VjcmV0"


def test_a_token_is_read_for_each_request(database: Database, tmp_path: Path) -> None:
    file = tmp_path / "t"
    output = influx(database.url, bucket="b", token_file=str(file))
    for token in ("one", "two"):
        file.write_text(f"{token}\n")
        output.send(numbered(1))
    output.close()
    tokens = [headers["Authorization"] for _, headers in database.requests]
    assert tokens == ["Token one", "Token two"]


@pytest.mark.parametrize("token", ["tokén", "to‑ken", "one\ntwo"])
def test_a_token_that_no_header_can_have_is_an_error_of_its_file(
    database: Database, tmp_path: Path, token: str
) -> None:
    (tmp_path / "t").write_text(token, encoding="utf-8")
    output = influx(database.url, bucket="b", token_file=str(tmp_path / "t"))
    with pytest.raises(OSError, match=r"t is not one line of printable ASCII"):
        output.send(numbered(1))
    output.close()


@pytest.mark.parametrize(
    ("status", "error"),
    [
        (400, Refused),
        (413, Refused),
        (422, Refused),
        (401, OSError),
        (404, OSError),
        (503, OSError),
    ],
)
def test_what_is_not_taken_says_why(
    database: Database, status: int, error: type[Exception]
) -> None:
    database.status, database.answer = status, b'{"message":"unable to parse"}'
    output = influx(database.url, bucket="b")
    with pytest.raises(error, match=rf"HTTP {status}: .*unable to parse"):
        output.send(numbered(1))
    database.status = 204
    output.send(numbered(1))
    output.close()
    assert len(database.points) == 1


def test_what_is_too_large_is_sent_in_parts(database: Database) -> None:
    database.max_bytes = 200
    output = influx(database.url, bucket="b")
    output.send(numbered(100))
    assert [point.fields["t"] for point in database.points] == list(range(100))
    text = reading("x" * 300, tag=tag("text", type="string:150"))
    with pytest.raises(Refused, match="HTTP 413") as caught:
        output.send([*numbered(9, 100), text, *numbered(9, 109)])
    output.close()
    assert caught.value.readings == [text]
    assert [point.fields["t"] for point in database.points] == list(range(118))


def test_a_value_that_is_too_large_costs_few_requests(database: Database) -> None:
    database.max_bytes = 600
    output = influx(database.url, bucket="b", gzip=False)
    text = reading("x" * 700, tag=tag("text", type="string:350"))
    with pytest.raises(Refused) as caught:
        output.send([text, *numbered(1000)])
    assert caught.value.readings == [text]
    assert len(database.requests) < 300
    database.max_bytes = 1 << 30
    output.send(numbered(1000, 1000))
    database.requests.clear()
    output.send(numbered(1000, 2000))
    output.close()
    assert len(database.requests) == 1


@pytest.mark.parametrize("status", [400, 413, 422])
def test_a_receiver_that_takes_nothing_gets_few_requests(database: Database, status: int) -> None:
    database.status = status
    output = influx(database.url, bucket="b")
    for _ in range(3):
        database.requests.clear()
        with pytest.raises(Refused, match=f"HTTP {status}") as caught:
            output.send(numbered(1000))
        assert len(caught.value.readings) == 1000
        assert len(database.requests) <= 20
    output.close()


@pytest.mark.parametrize("shown", ["Authorization: {}", "x" * 190 + "{}"])
def test_an_answer_that_repeats_the_credentials_is_shown_without_them(
    database: Database, tmp_path: Path, shown: str
) -> None:
    (tmp_path / "s").write_text("one-secret\n")
    file = str(tmp_path / "s")
    database.status = 401
    for credentials, header in (
        ({"bucket": "b", "token_file": file}, "Token one-secret"),
        ({"username": "me", "password_file": file}, "Basic bWU6b25lLXNlY3JldA=="),
        ({"username": "me", "password_file": file}, "me:one-secret"),
    ):
        database.answer = shown.format(header).encode()
        output = influx(f"{database.url}/write", **credentials)
        with pytest.raises(OSError, match=r"HTTP 401: .*\*\*\*") as refused:
            output.send(numbered(1))
        output.close()
        assert not any(part in str(refused.value) for part in ("one-", "bWU6"))


@pytest.mark.parametrize(
    ("password", "answer", "shown"),
    [
        ("p/a+s?>>>~~w", '{"got": "Basic bWU6cC9hK3M\\/Pj4+fn53"}', '{"got": "Basic ***"}'),
        ("one-secret", "bad header: Basic bWU6b25lLXNl...", "bad header: Basic ***"),
        ("two words and 2 more", "me:two words and 2 more", "me:***"),
        ('pass word"s', '{"password": "pass word\\"s"}', '{"password": "***"}'),
        ("a", "database is available again later", "database is available again later"),
    ],
)
def test_credentials_are_not_shown_in_part_and_the_rest_is(
    database: Database, tmp_path: Path, password: str, answer: str, shown: str
) -> None:
    (tmp_path / "s").write_text(password)
    database.status, database.answer = 401, answer.encode()
    given = {"username": "me", "password_file": str(tmp_path / "s")}
    output = influx(f"{database.url}/write", **given)
    with pytest.raises(OSError, match="HTTP 401: ") as refused:
        output.send(numbered(1))
    output.close()
    assert str(refused.value).endswith(f"HTTP 401: {shown}")


@pytest.mark.parametrize("says_so", [False, True])
def test_a_connection_that_was_closed_meanwhile_is_opened_again(
    database: Database, says_so: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    timeouts: list[float | None] = []
    getresponse = http.client.HTTPConnection.getresponse

    def noted(connection: http.client.HTTPConnection) -> http.client.HTTPResponse:
        timeouts.append(connection.sock.gettimeout())
        return getresponse(connection)

    monkeypatch.setattr(http.client.HTTPConnection, "getresponse", noted)
    output = influx(database.url, bucket="b", timeout=60)
    database.closes, database.says_so = True, says_so
    for start in range(3):
        output.send(numbered(1, start))
    assert set(timeouts) == {60}
    output.close()
    assert [point.fields["t"] for point in database.points] == [0, 1, 2]
    assert database.connections == 3


def test_a_receiver_that_can_not_be_reached_is_an_error() -> None:
    output = influx(f"http://127.0.0.1:{free_port()}", bucket="b")
    with pytest.raises(ConnectionRefusedError):
        output.send(numbered(1))


def test_connecting_does_not_hold_up_a_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "STOP_TIMEOUT_S", 0.2)
    answers = threading.Event()

    def slow(*_: object, **__: object) -> None:
        answers.wait(wire.DEADLINE)
        raise socket.gaierror(socket.EAI_AGAIN, "Temporary failure in name resolution")

    monkeypatch.setattr(socket, "getaddrinfo", slow)
    output, stop = influx("http://influx.example:1", bucket="b"), Stop()
    output.use_stop(stop)
    stop.set()
    # On a busy machine, the time may be over before it begins.
    with pytest.raises(OSError, match=r"no connection to influx.* within 0\.\d s|stopped"):
        output.send(numbered(1))
    answers.set()


def test_nothing_is_sent_if_connecting_took_the_time_after_a_stop(
    database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "STOP_TIMEOUT_S", 0.0)
    output, stop, interrupted = influx(database.url, bucket="b"), Stop(), threading.Event()

    def late(host: str, port: int, deadline: float) -> socket.socket:
        connection = connected_sync(host, port, deadline)
        stop.set()
        assert interrupted.wait(wire.DEADLINE)
        return connection

    monkeypatch.setattr(influx_module, "connected_sync", late)
    monkeypatch.setattr(output, "_interrupt", interrupted.set)
    output.use_stop(stop)
    with pytest.raises(OSError, match="stopped"):
        output.send(numbered(1))
    assert not database.requests


def test_a_receiver_without_values_shows_whether_it_can_be_reached(database: Database) -> None:
    output = influx(database.url, bucket="b")
    assert output.idle()
    assert output.idle()
    output.send(numbered(1))
    output.close()
    assert database.connections == 1
    nobody = influx(f"http://127.0.0.1:{free_port()}", bucket="b")
    with pytest.raises(ConnectionRefusedError):
        nobody.idle()


@pytest.mark.parametrize("scheme", ["http", "https"])
def test_a_receiver_without_values_shows_that_its_connection_has_ended(
    database: Database, tmp_path: Path, scheme: str
) -> None:
    authority = Authority(tmp_path)
    owner = authority.issue("db", "IP:127.0.0.1")
    secure = {"tls": {"ca_file": str(authority.ca)}} if scheme == "https" else {}
    to = ("127.0.0.1", database.server_port)
    with Relay(to, context(owner) if secure else None) as relay:
        output = influx(f"{scheme}://127.0.0.1:{relay.address[1]}", bucket="b", **secure)
        assert output.idle()
        output.send(numbered(1))
        assert output.idle()
        assert relay.connections == 1
        relay.cut()
        wire.until(lambda: output.idle() and relay.connections == 2, "it connects again")
        output.send(numbered(1))
        assert relay.connections == 2
    with pytest.raises(ConnectionRefusedError):
        wire.until(lambda: not output.idle(), "nobody listens")


def test_a_receiver_that_is_no_http_server_is_an_error(fake_server: int) -> None:
    output = influx(f"http://127.0.0.1:{fake_server}", bucket="b", gzip=False)
    with pytest.raises(OSError, match="not HTTP"):
        output.send(numbered(1))


@pytest.fixture
def fake_server() -> Iterator[int]:
    """Answers anything with something else."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            connection, _ = listener.accept()
            with connection:
                connection.recv(65536)
                connection.sendall(b"SSH-2.0-dropbear\r\n\r\n")

        thread = threading.Thread(target=serve)
        thread.start()
        yield listener.getsockname()[1]
        thread.join()


def test_a_receiver_that_answers_byte_by_byte_is_given_up_after_the_timeout() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        url = f"http://127.0.0.1:{listener.getsockname()[1]}"
        output = influx(url, bucket="b", timeout=0.2)
        gone = threading.Event()

        def drip() -> None:
            connection, _ = listener.accept()
            with connection, contextlib.suppress(OSError):
                connection.recv(65536)
                connection.sendall(b"HTTP/1.1 ")
                while not gone.wait(0.05):
                    connection.sendall(b" ")

        thread = threading.Thread(target=drip)
        thread.start()
        with pytest.raises(OSError, match=r"no answer within 0\.2 s"):
            output.send(numbered(1))
        gone.set()
        thread.join(wire.DEADLINE)


def test_a_receiver_that_never_answers_does_not_hold_up_a_stop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its timeout is an hour; what it has not confirmed is in the file."""
    monkeypatch.setattr(module, "STOP_TIMEOUT_S", 0.05)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        url = f"http://127.0.0.1:{listener.getsockname()[1]}"
        output = influx(url, bucket="b", timeout=3600)
        buffer, stop = Buffer(), Stop()
        find = {"t": tag()}
        opened = BufferFile(tmp_path / "b.db", 2**30, lambda _, name: find[name])
        sender = OutputSender("db", output, buffer, lambda: opened)
        thread = threading.Thread(target=sender.run, args=[stop])
        thread.start()
        buffer.offer(polls(3))
        connection, _ = listener.accept()
        with connection:
            assert connection.recv(65536).startswith(b"POST")
            stop.set()
            thread.join(wire.DEADLINE)
            assert not thread.is_alive()
    stored = BufferFile(tmp_path / "b.db", 2**30, lambda _, name: find[name])
    assert [each.value for each in stored.first(1)] == [0, 1, 2]
    stored.close()
