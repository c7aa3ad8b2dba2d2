"""Who the scanner is at NATS, and that nothing goes there in the clear that should not."""

from __future__ import annotations

import asyncio
import socket
from typing import TYPE_CHECKING, Any

import pytest

import wire
from certificates import Certificates
from holdfast import logs
from holdfast.scanner import Servers
from nats_bus import NatsServer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from nats_bus import Run, Running

    Serve = Callable[..., NatsServer]


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Certificates:
    return Certificates(tmp_path_factory.mktemp("authority"))


@pytest.fixture
def serve_nats(tmp_path: Path) -> Iterator[Serve]:
    started: list[NatsServer] = []

    def start(*options: str) -> NatsServer:
        started.append(NatsServer(tmp_path, *options, jetstream=False))
        return started[-1]

    yield start
    for server in started:
        server.kill()


@pytest.fixture(autouse=True)
def _fresh_throttle(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(logs, "_REFUSALS", logs.Throttle())


def failure(caplog: pytest.LogCaptureFixture) -> str:
    """Why it can't connect, when it says so."""

    def reasons() -> list[str]:
        return [
            vars(record)["fields"]["reason"]
            for record in caplog.records
            if record.getMessage() == "nats_connect_failed"
        ]

    wire.until(reasons, "it is told")
    return reasons()[0]


def certified(authority: Certificates, name: str) -> list[str]:
    certificate, key = authority.issue(name, "IP:127.0.0.1")
    return ["--tlscert", str(certificate), "--tlskey", str(key)]


@pytest.mark.parametrize("scheme", ["nats", "tls"])
def test_tls_is_spoken_with_a_server_that_the_authority_vouches_for(
    run_scanner: Run, serve_nats: Serve, authority: Certificates, scheme: str
) -> None:
    server = serve_nats("--tls", *certified(authority, "nats"))
    url = server.url.replace("nats", scheme)
    assert run_scanner(servers=Servers((url,), ca_file=authority.ca)).serves


def test_a_server_that_the_authority_does_not_vouch_for_is_refused(
    run_scanner: Run,
    serve_nats: Serve,
    authority: Certificates,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    stranger = Certificates(tmp_path, "stranger")
    server = serve_nats("--tls", *certified(stranger, "nats"))
    scanner = run_scanner(wait=False, servers=Servers((server.url,), ca_file=authority.ca))
    assert "CERTIFICATE_VERIFY_FAILED" in failure(caplog)
    assert not scanner.serves


def test_a_server_wants_our_certificate(
    run_scanner: Run, serve_nats: Serve, authority: Certificates
) -> None:
    certificate, key = authority.issue("scan", "DNS:scan")
    options = ["--tlsverify", "--tlscacert", str(authority.ca), *certified(authority, "nats")]
    server = serve_nats(*options)
    servers = Servers((server.url,), ca_file=authority.ca, cert_file=certificate, key_file=key)
    assert run_scanner(servers=servers).serves


@pytest.mark.parametrize("scheme", ["nats", "tls"])
def test_a_server_without_tls_is_refused_where_tls_is_asked_for(
    run_scanner: Run,
    serve_nats: Serve,
    authority: Certificates,
    scheme: str,
    caplog: pytest.LogCaptureFixture,
) -> None:
    server = serve_nats()
    url = server.url.replace("nats", scheme)
    ca = authority.ca if scheme == "nats" else None
    scanner = run_scanner(wait=False, servers=Servers((url,), ca_file=ca))
    assert failure(caplog) == "the server does not use TLS"
    assert not scanner.serves


def test_no_secret_goes_to_a_server_without_tls(run_scanner: Run, tmp_path: Path) -> None:
    token = tmp_path / "token"
    token.write_text("s3cret")
    with socket.create_server(("127.0.0.1", 0)) as listening:
        url = f"tls://127.0.0.1:{listening.getsockname()[1]}"
        run_scanner(wait=False, servers=Servers((url,), token_file=token))
        listening.settimeout(wire.DEADLINE)
        connection = listening.accept()[0]
        with connection:
            connection.settimeout(wire.DEADLINE)
            connection.sendall(b'INFO {"server_id":"x","version":"2.11.0","max_payload":1000}\r\n')
            assert connection.recv(1000) == b""


def test_a_token_opens_the_door(run_scanner: Run, serve_nats: Serve, tmp_path: Path) -> None:
    server = serve_nats("--auth", "s3cret")
    token = tmp_path / "token"
    token.write_text("s3cret\n")
    assert run_scanner(servers=Servers((server.url,), token_file=token)).serves


def test_a_right_that_is_missing_is_told_and_the_rest_works(
    run_scanner: Run, serve_nats: Serve, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    config = tmp_path / "nats.conf"
    config.write_text(
        "authorization {users: [{user: a, password: b,"
        ' permissions: {subscribe: {deny: ["modbus.shutdown"]}}}]}'
    )
    server = serve_nats("-c", str(config))
    url = server.url.replace("//", "//a:b@")
    running: Running = run_scanner(servers=Servers((url,)))

    def told() -> bool:
        fields: list[dict[str, Any]] = [vars(each).get("fields", {}) for each in caplog.records]
        return any("ermissions" in str(each.get("reason")) for each in fields)

    wire.until(told, "it is told")
    assert running.serves


def test_files_are_read_when_it_starts(tmp_path: Path) -> None:
    from holdfast.scanner import Scanner, Settings

    async def run(servers: Servers) -> None:
        await Scanner(Settings(servers)).run()

    for servers in (
        Servers(token_file=tmp_path / "missing"),
        Servers(credentials=tmp_path / "missing"),
        Servers(ca_file=tmp_path / "missing"),
    ):
        with pytest.raises(OSError, match="No such file"):
            asyncio.run(run(servers))
