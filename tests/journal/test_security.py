"""How a node shows the servers who it is, and how it knows them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from holdfast._core import Log, LogError
from support import wire
from support.brokers import NatsServer
from support.certificates import Certificates
from support.nats_keys import Operator, User

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    Serve = Callable[..., NatsServer]


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Certificates:
    return Certificates(tmp_path_factory.mktemp("authority"))


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Serve]:
    started: list[NatsServer] = []

    def start(*options: str) -> NatsServer:
        started.append(NatsServer(tmp_path, *options))
        return started[-1]

    yield start
    for server in started:
        server.kill()


def works(url: str, **options: Any) -> bool:
    """Whether a node writes to a log. Raises `LogError`."""
    memory = holdfast.Memory(holding_registers=1)
    log = Log("site", "a", [url], [("plant", memory)], write_timeout=wire.DEADLINE, **options)
    log.start(wire.DEADLINE)
    memory.write("holding_registers", 0, [1])
    log.stop()
    return memory.read("holding_registers", 0, 1) == [1]


def failure(url: str, reason: str, **options: Any) -> str:
    """The error of a node that does not start, which contains the reason.

    A loaded machine may need longer to find it.
    """
    error = ""
    for timeout in (0.25, 1, 4, 16):
        log = Log("site", "a", [url], [("plant", holdfast.Memory(coils=1))], **options)
        with pytest.raises(LogError) as raised:
            log.start(timeout)
        assert raised.value.kind == "no_connection"
        error = str(raised.value)
        if reason in error:
            return error
    raise AssertionError(f"not {reason}, but {error}")


@pytest.mark.parametrize("streams", [1, 2, 3])
def test_an_account_with_too_few_streams_is_named(
    serve: Serve, tmp_path: Path, streams: int
) -> None:
    limits = f"max_file: 100MB, max_streams: {streams}"
    account = f"jetstream {{ {limits} }}, users: [{{ user: node, password: secret }}]"
    file = tmp_path / "nats.conf"
    file.write_text(f"accounts {{ PLANT {{ {account} }} }}\nno_auth_user: node")
    started = serve("-c", str(file))
    failure(started.url, "maximum number of streams reached")


def certified(authority: Certificates, name: str) -> list[str]:
    certificate, key = authority.issue(name, "IP:127.0.0.1")
    return ["--tlscert", str(certificate), "--tlskey", str(key)]


def test_a_user_and_a_password(serve: Serve, tmp_path: Path) -> None:
    server = serve("--user", "plant", "--pass", "secret")
    (tmp_path / "right").write_text("secret\n")
    (tmp_path / "wrong").write_text("Secret\n")
    assert works(server.url, user="plant", password_file=tmp_path / "right")
    wrong = failure(server.url, "authorization", user="plant", password_file=tmp_path / "wrong")
    assert "ecret" not in wrong


def test_a_token(serve: Serve, tmp_path: Path) -> None:
    server = serve("--auth", "secret")
    (tmp_path / "token").write_text("secret\n")
    assert works(server.url, token_file=tmp_path / "token")
    failure(server.url, "authorization")


def test_credentials(serve: Serve, tmp_path: Path) -> None:
    operator = Operator()
    account = operator.account(mem_storage=-1, disk_storage=-1, streams=-1, consumer=-1)
    server = serve("-c", str(operator.configure(tmp_path / "nats.conf")))
    file = User(account).write(tmp_path / "node.creds")
    assert works(server.url, credentials_file=file)
    failure(server.url, "authorization")


@pytest.mark.parametrize("scheme", ["nats", "tls"])
def test_tls(serve: Serve, authority: Certificates, tmp_path: Path, scheme: str) -> None:
    server = serve("--tls", *certified(authority, "nats"))
    url = server.url.replace("nats", scheme)
    assert works(url, tls=(authority.ca, None, None))
    stranger = Certificates(tmp_path, "stranger")
    failure(url, "invalid peer certificate", tls=(stranger.ca, None, None))


def test_a_certificate_of_the_node(serve: Serve, authority: Certificates) -> None:
    certificate, key = authority.issue("node", "DNS:node")
    options = ["--tlsverify", "--tlscacert", str(authority.ca), *certified(authority, "nats")]
    server = serve(*options)
    assert works(server.url, tls=(authority.ca, certificate, key))
    failure(server.url, "CertificateRequired", tls=(authority.ca, None, None))


@pytest.mark.parametrize("scheme", ["nats", "tls"])
def test_a_server_without_tls_is_refused(
    serve: Serve, authority: Certificates, scheme: str
) -> None:
    server = serve()
    url = server.url.replace("nats", scheme)
    failure(url, "corrupt message", tls=(authority.ca, None, None))
