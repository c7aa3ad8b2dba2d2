"""The server of HTTP services: the event loop that calls its handlers."""

from __future__ import annotations

import asyncio
import socket
import sys
import threading
from contextlib import ExitStack, closing
from ipaddress import ip_network
from typing import TYPE_CHECKING, Any

import pytest

from holdfast._core import HttpServer
from holdfast.events import log_lines
from holdfast.net.http.port import listen
from holdfast.net.http.requests import Request, Response
from holdfast.net.http.server import (
    LARGE_BODY_BYTES,
    ConnectionLimits,
    WebServer,
)
from support import web, wire

if TYPE_CHECKING:
    from collections.abc import Coroutine, Iterator


def loop_of_a_handler() -> str:
    """The package that has the event loop in which a server calls its handler."""

    def answer(_: Request) -> Response:
        loop = type(asyncio.get_running_loop())
        return Response(200, loop.__module__.partition(".")[0].encode())

    sources, limits = [ip_network("127.0.0.0/8")], ConnectionLimits(1)
    with closing(listen("127.0.0.1", 0)) as listener:
        server = WebServer("x", answer, listener, sources=sources, limits=limits, request_timeout=9)
        with web.in_a_thread(server), closing(web.Client(listener.getsockname())) as client:
            return client.get("/").body.decode()


def test_the_server_runs_in_uvloop_where_it_is_installed() -> None:
    pytest.importorskip("uvloop", reason="there is none for Windows")
    assert loop_of_a_handler() == "uvloop"


def test_the_server_runs_without_uvloop(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "uvloop", None)
    assert loop_of_a_handler() == "asyncio"


def test_a_grace_that_is_no_time_is_refused() -> None:
    options: dict[str, Any] = {"sources": [], "max_connections": 1, "refusals": []}
    with closing(listen("127.0.0.1", 0)) as listener:
        for grace in (-1, float("nan")):
            with pytest.raises(ValueError, match="grace"):
                HttpServer("x", listener, grace=grace, request_timeout=1, idle_timeout=1, **options)


def test_a_server_that_could_not_start_starts_later() -> None:
    resource = pytest.importorskip("resource", reason="Windows has no limit of open files")
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with closing(listen("127.0.0.1", 0)) as listener:
        server = HttpServer(
            "x",
            listener,
            sources=["127.0.0.0/8"],
            max_connections=1,
            grace=0,
            request_timeout=wire.DEADLINE,
            idle_timeout=wire.DEADLINE,
            refusals=[(name, [], b"no") for name in ("not_http", "header_too_large", "not_tls")],
        )
        with closing(server):
            resource.setrlimit(resource.RLIMIT_NOFILE, (4, hard))
            try:
                with pytest.raises(OSError, match="Too many open files"):
                    server.start()
            finally:
                resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
            server.start()
            with socket.create_connection(listener.getsockname(), wire.DEADLINE) as client:
                client.sendall(b"\0\r\n\r\n")
                assert client.recv(1000).endswith(b"no")


def test_the_log_says_why_a_connection_can_not_be_accepted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    resource = pytest.importorskip("resource", reason="Windows has no limit of open files")
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    faults: list[dict[str, object]] = []
    monkeypatch.setattr(log_lines, "refused", lambda _, **fields: faults.append(fields))
    sources, limits = [ip_network("127.0.0.0/8")], ConnectionLimits(1)
    with closing(listen("127.0.0.1", 0)) as listener, socket.socket() as client:
        server = WebServer(
            "x",
            lambda _: Response(200),
            listener,
            sources=sources,
            limits=limits,
            request_timeout=wire.DEADLINE,
        )
        with web.in_a_thread(server):
            with closing(web.Client(listener.getsockname())) as first:
                assert first.get("/").status == 200
            resource.setrlimit(resource.RLIMIT_NOFILE, (4, hard))
            try:
                client.connect(listener.getsockname())
                wire.until(lambda: faults, "it was logged")
            finally:
                resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert faults[0]["message"] == "the system can't accept a connection"
    assert "Too many open files" in str(faults[0]["error"])


def test_a_failed_request_has_an_answer_of_the_service(
    address: tuple[str, int],
) -> None:
    with closing(web.Client(address)) as client:
        answer = client.get("/fail")
    assert (answer.status, answer.body) == (500, b"internal_error: internal error, see the log")


class Reader:
    """A handler that reads a body, and notes its path and the round of the event loop."""

    def __init__(self) -> None:
        self.begun: list[str] = []
        self.read: list[tuple[str, int]] = []
        self.resume = threading.Event()
        self._round = 0
        self._counting: asyncio.Task[None] | None = None

    def __call__(self, request: Request) -> Response | Coroutine[Any, Any, Response]:
        self._counting = self._counting or asyncio.create_task(self._count())
        self.begun.append(request.path)
        if request.path == "/fail":
            raise RuntimeError
        if request.path == "/block":
            self.resume.wait(wire.DEADLINE)
            return Response(200)
        return self._answer(request)

    def has_read(self, path: str) -> bool:
        return any(path == each for each, _ in self.read)

    async def _answer(self, request: Request) -> Response:
        await request.body(LARGE)
        self.read.append((request.path, self._round))
        return Response(200)

    async def _count(self) -> None:
        while True:
            self._round += 1
            await asyncio.sleep(0)


LARGE = LARGE_BODY_BYTES + 1


@pytest.fixture
def reader() -> Reader:
    return Reader()


@pytest.fixture
def address(reader: Reader) -> Iterator[tuple[str, int]]:
    """The address of a server with this handler."""
    sources, limits = [ip_network("127.0.0.0/8")], ConnectionLimits(20)
    with closing(listen("127.0.0.1", 0)) as listener:
        server = WebServer(
            "x",
            reader,
            listener,
            sources=sources,
            limits=limits,
            request_timeout=wire.DEADLINE,
            stop_timeout=0,
            rejection=lambda status, reason, text: Response(status, f"{reason}: {text}".encode()),
        )
        with web.in_a_thread(server):
            yield listener.getsockname()


def sent(address: tuple[str, int], path: str, size: int) -> wire.Connection:
    """A connection that has sent a request but the last byte of its body."""
    connection = wire.Connection(address)
    connection.send(web.head("POST", path, f"Content-Length: {size}") + b" " * (size - 1))
    return connection


def test_the_loop_does_other_work_between_large_bodies(
    reader: Reader, address: tuple[str, int]
) -> None:
    with ExitStack() as opened:
        connections = [
            opened.enter_context(sent(address, f"/{number}", LARGE)) for number in range(6)
        ]
        wire.until(lambda: len(reader.begun) == 6, "all are being received")
        blocking = opened.enter_context(wire.Connection(address))
        blocking.send(web.head("GET", "/block"))
        wire.until(lambda: "/block" in reader.begun, "the loop does nothing")
        for connection in connections:
            connection.send(b" ")
            wire.until_taken(connection.socket)
        reader.resume.set()
        wire.until(lambda: len(reader.read) == 6, "all were read")
    assert len({turn for _, turn in reader.read}) == 6
