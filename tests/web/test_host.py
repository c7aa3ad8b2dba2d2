"""The host of HTTP services: the event loop that calls its handlers."""

from __future__ import annotations

import asyncio
import socket
import sys
from contextlib import closing
from ipaddress import ip_network

import pytest

from holdfast._core import HttpServer
from holdfast.events import log_lines
from holdfast.net.http.host import ConnectionLimits, Host
from holdfast.net.http.port import listen
from holdfast.net.http.requests import Request, Response
from support import web, wire


def loop_of_a_handler() -> str:
    """The package that has the event loop in which a host calls its handler."""

    def answer(_: Request) -> Response:
        loop = type(asyncio.get_running_loop())
        return Response(200, loop.__module__.partition(".")[0].encode())

    sources, limits = [ip_network("127.0.0.0/8")], ConnectionLimits(1)
    with closing(listen("127.0.0.1", 0)) as listener:
        host = Host("x", answer, listener, sources=sources, limits=limits, request_timeout=9)
        with web.in_a_thread(host), closing(web.Client(listener.getsockname())) as client:
            return client.get("/").body.decode()


def test_a_host_runs_in_uvloop_where_it_is_installed() -> None:
    pytest.importorskip("uvloop", reason="there is none for Windows")
    assert loop_of_a_handler() == "uvloop"


def test_a_host_runs_without_uvloop(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "uvloop", None)
    assert loop_of_a_handler() == "asyncio"


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
        host = Host(
            "x",
            lambda _: Response(200),
            listener,
            sources=sources,
            limits=limits,
            request_timeout=wire.DEADLINE,
        )
        with web.in_a_thread(host):
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
