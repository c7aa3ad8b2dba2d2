"""Who the scanner is at NATS, and that nothing goes there in the clear that should not."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import socket
import time
from typing import TYPE_CHECKING

import pytest
from nats.aio.client import Client
from nats.errors import FlushTimeoutError, NoRespondersError

from holdfast.net.nats import connection as broker
from holdfast.net.nats import tolerant_client
from holdfast.net.nats.connection import Servers
from holdfast.net.tls import Tls
from holdfast.scanner.service import Scanner
from holdfast.scanner.settings import Settings
from support import wire
from support.brokers import NatsServer
from support.certificates import Certificates
from support.nats_bus import Caller, logged, subscription, tag
from support.nats_keys import ACCOUNT, Key, Operator, User, written
from support.scanner_parts import broker_of, client_of, presence_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    import holdfast
    from support.nats_bus import Run, Running

    Serve = Callable[..., NatsServer]


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Certificates:
    return Certificates(tmp_path_factory.mktemp("authority"))


@pytest.fixture
def serve_nats(tmp_path: Path) -> Iterator[Serve]:
    started: list[NatsServer] = []

    def start(*options: str, jetstream: bool = False) -> NatsServer:
        started.append(NatsServer(tmp_path, *options, jetstream=jetstream))
        return started[-1]

    yield start
    for server in started:
        server.kill()


def reasons(caplog: pytest.LogCaptureFixture, event: str) -> list[str]:
    """What an event was logged with, each time."""
    found = [record for record in caplog.records if record.getMessage() == event]
    return [vars(record)["fields"].get("reason", "") for record in found]


def failure(caplog: pytest.LogCaptureFixture) -> str:
    """Why it can't connect, when it says so."""
    wire.until(lambda: reasons(caplog, "nats_connect_failed"), "it is logged")
    return reasons(caplog, "nats_connect_failed")[0]


def until_logged(caplog: pytest.LogCaptureFixture, event: str, text: str) -> None:
    """Waits until an event is logged with a reason that has a text in it."""
    wire.until(lambda: text in str(reasons(caplog, event)), f"{event} tells {text!r}")


def certified(authority: Certificates, name: str) -> list[str]:
    certificate, key = authority.issue(name, "IP:127.0.0.1")
    return ["--tlscert", str(certificate), "--tlskey", str(key)]


@pytest.mark.parametrize("scheme", ["nats", "tls"])
def test_tls_is_spoken_with_a_server_that_the_authority_vouches_for(
    run_scanner: Run, serve_nats: Serve, authority: Certificates, scheme: str
) -> None:
    server = serve_nats("--tls", *certified(authority, "nats"))
    url = server.url.replace("nats", scheme)
    assert run_scanner(servers=Servers((url,), tls=Tls.of(authority.ca))).serves


def test_a_server_that_the_authority_does_not_vouch_for_is_refused(
    run_scanner: Run,
    serve_nats: Serve,
    authority: Certificates,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    stranger = Certificates(tmp_path, "stranger")
    server = serve_nats("--tls", *certified(stranger, "nats"))
    scanner = run_scanner(wait=False, servers=Servers((server.url,), tls=Tls.of(authority.ca)))
    assert "the issuer of the certificate is unknown" in failure(caplog)
    assert not scanner.serves


def test_a_server_wants_our_certificate(
    run_scanner: Run, serve_nats: Serve, authority: Certificates
) -> None:
    certificate, key = authority.issue("scan", "DNS:scan")
    options = ["--tlsverify", "--tlscacert", str(authority.ca), *certified(authority, "nats")]
    server = serve_nats(*options)
    servers = Servers((server.url,), tls=Tls.of(authority.ca, certificate, key))
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
    scanner = run_scanner(wait=False, servers=Servers((url,), tls=Tls.of(ca)))
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


def answered(listening: socket.socket, reply: bytes) -> socket.socket:
    """Accepts a connection, and replies to its first ping."""
    listening.settimeout(wire.DEADLINE)
    connection = listening.accept()[0]
    connection.settimeout(wire.DEADLINE)
    connection.sendall(
        b'INFO {"server_id":"x","version":"2.11.0","max_payload":1000,"headers":true}\r\n'
    )
    sent = b""
    while not sent.endswith(b"PING\r\n"):
        sent += connection.recv(4096)
    connection.sendall(reply)
    return connection


def test_connections_that_a_server_refuses_are_closed(run_scanner: Run) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        url = f"nats://127.0.0.1:{listening.getsockname()[1]}"
        run_scanner(wait=False, servers=Servers((url,)))
        with answered(listening, b"PONG\r\n") as first:
            first.shutdown(socket.SHUT_RDWR)
        for _ in range(3):
            with answered(listening, b"-ERR 'Authorization Violation'\r\n") as refused:
                assert refused.recv(1) == b"", "it is closed, though this side is still open"


def test_a_server_that_ends_the_connection_at_once_is_quoted(
    run_scanner: Run, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def flush(client: Client, _: float = 0) -> None:
        while not client.is_closed:
            await asyncio.sleep(0)
        raise FlushTimeoutError  # After 2 s, in nats-py.

    monkeypatch.setattr(Client, "flush", flush)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        url = f"nats://127.0.0.1:{listening.getsockname()[1]}"
        run_scanner(wait=False, servers=Servers((url,)))
        answered(listening, b"PONG\r\n-ERR 'too many friends'\r\n").close()
        wire.until(lambda: logged(caplog, "nats_disconnected"), "it is logged")
    [lost] = logged(caplog, "nats_disconnected")
    assert lost["reason"] == "the server ended the connection: too many friends"


def test_a_server_without_room_is_quoted(
    run_scanner: Run, serve_nats: Serve, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    config = tmp_path / "nats.conf"
    config.write_text("max_connections: 1")
    server = serve_nats("-c", str(config))
    with Caller(server.url):
        broker = broker_of(run_scanner(server, wait=False).scanner)
        wire.until(lambda: broker._failed_attempts > 5, "it is tried again")
    found = reasons(caplog, "nats_connect_failed")
    assert "nats: maximum connections exceeded" in found
    assert len(found) == len(set(found)), "each reason is logged once"


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

    until_logged(caplog, "nats_error", "ermissions")
    assert running.serves


def refusal(servers: Servers) -> str:
    """Why a scanner does not start."""

    async def run() -> None:
        await Scanner(Settings(servers)).run()

    with pytest.raises(OSError) as error:  # noqa: PT011
        asyncio.run(run())
    return str(error.value)


def test_files_are_read_when_it_starts(tmp_path: Path) -> None:
    for servers in (
        Servers(token_file=tmp_path / "missing"),
        Servers(credentials=tmp_path / "missing"),
        Servers(tls=Tls.of(tmp_path / "missing")),
    ):
        assert "No such file" in refusal(servers)


# Credentials: a server that trusts an operator, and of its accounts the one of the plant.


@pytest.fixture
def operator() -> Operator:
    return Operator()


@pytest.fixture
def plant(operator: Operator) -> Key:
    return operator.plant


@pytest.fixture
def trusting(serve_nats: Serve, operator: Operator, tmp_path: Path) -> NatsServer:
    """Trusts the operator, and has JetStream for those who may use it."""
    return serve_nats("-c", str(operator.configure(tmp_path / "nats.conf")), jetstream=True)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "scan.creds"


def at(server: NatsServer, file: Path) -> Servers:
    return Servers((server.url,), credentials=file)


def test_credentials_open_the_door_to_their_account_alone(
    run_scanner: Run,
    serve_nats: Serve,
    operator: Operator,
    plant: Key,
    file: Path,
    tmp_path: Path,
    server: holdfast.Server,
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.DEBUG)
    elsewhere = operator.account()
    trusting = serve_nats("-c", str(operator.configure(tmp_path / "nats.conf")))
    user = User(plant)
    run_scanner(servers=at(trusting, user.write(file)))
    with Caller(trusting.url, **User(plant).options) as caller:
        data = caller.listen("modbus.data.plc1")
        assert caller.request("modbus.subscribe", subscription(server, tag("a", 0)))["success"]
        data.next()
    with (
        Caller(trusting.url, **User(elsewhere).options) as stranger,
        pytest.raises(NoRespondersError),
    ):
        stranger.request("modbus.browse", b"")
    logged = str([vars(record) for record in caplog.records])
    assert "nats_connected" in logged
    assert user.key.seed not in logged
    assert user.jwt not in logged


@pytest.mark.parametrize("wrong", ["account", "expired", "operator"])
def test_credentials_that_are_refused_are_told_and_read_anew(
    run_scanner: Run,
    trusting: NatsServer,
    plant: Key,
    file: Path,
    wrong: str,
    caplog: pytest.LogCaptureFixture,
) -> None:
    users: dict[str, Callable[[], User]] = {
        "account": lambda: User(Key(ACCOUNT)),
        "expired": lambda: User(plant, exp=int(time.time()) - 1),
        "operator": lambda: User(Operator().account()),
    }
    scanner = run_scanner(wait=False, servers=at(trusting, users[wrong]().write(file)))
    until_logged(caplog, "nats_connect_failed", "Authorization Violation")
    assert not scanner.serves
    file.write_text("")
    until_logged(caplog, "nats_connect_failed", "block NATS USER JWT is missing")
    User(plant).write(file)
    wire.until(lambda: scanner.serves, "it is connected")


def test_credentials_that_expire_are_read_anew(
    run_scanner: Run,
    trusting: NatsServer,
    plant: Key,
    file: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    User(plant, exp=int(time.time()) + 2).write(file)
    scanner = run_scanner(wait=False, servers=at(trusting, file))
    failure(caplog)
    User(plant).write(file)
    wire.until(lambda: scanner.serves, "it is connected")


def test_a_client_that_ends_without_a_word_is_replaced(run_scanner: Run) -> None:
    scanner = run_scanner()
    client = client_of(scanner.scanner)
    # As when the server throws it out with something still to send, which it then fails to.
    client._disconnected_cb = client._closed_cb = None
    scanner.do(client.close())
    wire.until(lambda: broker_of(scanner.scanner).client is not client, "it is noticed")
    wire.until(lambda: scanner.serves, "there is another client")


def test_a_scanner_ends_while_its_client_has_ended_without_a_word(
    run_scanner: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(broker, "CHECK_INTERVAL_S", 2 * wire.DEADLINE)
    scanner = run_scanner()
    client = client_of(scanner.scanner)
    client._disconnected_cb = client._closed_cb = None
    scanner.do(client.close())
    scanner.stop()


def test_credentials_serve_again_when_the_server_does(
    run_scanner: Run,
    trusting: NatsServer,
    plant: Key,
    file: Path,
    server: holdfast.Server,
) -> None:
    scanner = run_scanner(servers=at(trusting, User(plant).write(file)))
    trusting.kill()
    wire.until(lambda: not scanner.serves, "it is noticed")
    trusting.start()
    wire.until(lambda: scanner.serves, "it is connected again")
    with Caller(trusting.url, **User(plant).options) as caller:
        data = caller.listen("modbus.data.plc1")
        assert caller.request("modbus.subscribe", subscription(server, tag("a", 0)))["success"]
        data.next()


def test_an_account_without_jetstream_has_no_heartbeat(
    run_scanner: Run,
    trusting: NatsServer,
    plant: Key,
    file: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    scanner = run_scanner(servers=at(trusting, User(plant).write(file)))
    until_logged(caplog, "no_heartbeat", "JetStream not enabled for account")
    for _ in range(3):
        scanner.do(presence_of(scanner.scanner).heartbeat.beat(broker_of(scanner.scanner).client))
    assert scanner.serves
    assert len(reasons(caplog, "no_heartbeat")) == 1


def test_a_refused_publish_is_told_and_the_rest_works(
    run_scanner: Run,
    trusting: NatsServer,
    plant: Key,
    file: Path,
    server: holdfast.Server,
    caplog: pytest.LogCaptureFixture,
) -> None:
    user = User(plant, {"pub": {"deny": ["modbus.data.>"]}})
    scanner = run_scanner(servers=at(trusting, user.write(file)))
    with Caller(trusting.url, **User(plant).options) as caller:
        status = caller.listen("modbus.status.plc1")
        assert caller.request("modbus.subscribe", subscription(server, tag("a", 0)))["success"]
        status.until(lambda message: message["state"] == "online", "it is online")
    until_logged(caplog, "nats_error", 'ermissions Violation for Publish to "modbus.data.plc1"')
    assert scanner.serves


def test_a_right_that_is_given_later_is_used(
    run_scanner: Run,
    serve_nats: Serve,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in ("FIRST_REPEAT_S", "MAX_REPEAT_S"):
        monkeypatch.setattr(tolerant_client, name, 0.05)
    config = tmp_path / "nats.conf"

    def write(*denied: str) -> None:
        rights = f"permissions: {{subscribe: {{deny: {json.dumps(denied)}}}}}"
        users = f"[{{user: a, password: a, {rights}}}, {{user: b, password: b}}]"
        config.write_text(f"authorization {{users: {users}}}")

    write("modbus.browse")
    server = serve_nats("-c", str(config))
    scanner = run_scanner(servers=Servers((server.url.replace("//", "//a:a@"),)))
    client = client_of(scanner.scanner)
    wire.until(lambda: server.log.count("Subscription Violation") > 3, "it is repeated")
    assert len(reasons(caplog, "nats_error")) == 1
    with Caller(server.url, user="b", password="b") as caller:

        def answers() -> bool:
            with contextlib.suppress(NoRespondersError):
                return bool(caller.request("modbus.browse", b"")["success"])
            return False

        assert not answers()
        write()
        server.reload()
        wire.until(answers, "the right is used")
        wire.until(lambda: not client._refused, "nothing more is repeated")
        write("modbus.browse")
        server.reload()
        wire.until(lambda: not answers(), "the right was taken away")
        wire.until(lambda: len(reasons(caplog, "nats_error")) == 2, "it is logged")
        write()
        server.reload()
        wire.until(answers, "it was given back")
    assert len(reasons(caplog, "nats_error")) == 2
    assert client_of(scanner.scanner) is client
    assert not reasons(caplog, "nats_disconnected"), "no connection has ended for that"


REQUESTS = ("subscribe", "unsubscribe", "browse", "variables", "shutdown", "scanner")
RIGHTS = {
    "sub": {"allow": [*(f"modbus.{name}" for name in REQUESTS), "modbus.command.>", "_INBOX.>"]},
    "pub": {
        "allow": [
            "modbus.data.>",
            "modbus.status.>",
            "modbus.scanner",
            "service.logs.modbus.modbus",
            "$JS.API.>",
            "$KV.service_heartbeats.modbus",
            "$KV.holdfast_scanner.modbus.>",
        ]
    },
    "resp": {"max": 1, "ttl": 60 * 10**9},
}
"""As docs/scanner.md has them."""


def test_the_rights_of_the_documentation_are_enough(
    run_scanner: Run,
    serve_nats: Serve,
    operator: Operator,
    file: Path,
    tmp_path: Path,
    server: holdfast.Server,
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "holdfast")
    account = operator.account(mem_storage=-1, disk_storage=-1)
    conf = operator.configure(tmp_path / "nats.conf")
    trusting = serve_nats("-c", str(conf), jetstream=True)
    scanner = run_scanner(servers=at(trusting, User(account, RIGHTS).write(file)))
    wire.until(lambda: reasons(caplog, "heartbeat"), "there is a heartbeat")
    with Caller(trusting.url, **User(account).options) as caller:
        data = caller.listen("modbus.data.plc1")
        status = caller.listen("modbus.status.plc1")
        wanted = subscription(server, tag("a", 0, writable=True))
        assert caller.request("modbus.subscribe", wanted)["success"]
        assert caller.request("modbus.command.a", "7")["success"]
        data.until(lambda message: message["value"] == 7, "the new value comes")
        status.next()
        wire.until(lambda: reasons(caplog, "subscriptions_kept"), "subscriptions are kept")
        assert len(caller.kept("holdfast_scanner")) == 2
    scanner.stop()
    assert reasons(caplog, "nats_error") == []


@pytest.mark.parametrize("other", ["plant.a", "plant.b"])
def test_a_reply_subject_does_not_stop_a_scanner(
    run_scanner: Run, caller: Caller, caplog: pytest.LogCaptureFixture, other: str
) -> None:
    """Who sends a request may have no right to publish to its reply subject."""
    scanners = [run_scanner(prefix=prefix) for prefix in ("plant.a", "plant.b")]
    caller.publish("plant.a.browse", reply=f"{other}.shutdown")
    until_logged(caplog, "message_malformed", "the answer to a request")
    [found] = logged(caplog, "message_malformed")
    assert found["subject"] == f"{other}.shutdown"
    assert caller.request(f"{other}.browse", b"")["success"]
    assert all(each.serves for each in scanners)


def damaged(seed: str) -> str:
    return seed[:20] + ("A" if seed[20] != "A" else "B") + seed[21:]


@pytest.mark.parametrize(
    ("jwt", "seed", "error"),
    [
        ("{jwt}", "", "block USER NKEY SEED is missing; a NATS credentials file has one"),
        ("", "{seed}", "block NATS USER JWT is missing; a NATS credentials file has one"),
        ("{jwt}", "{account}", "the seed belongs to an account, allowed: the seed of a user"),
        ("{jwt}", "{damaged}", "the seed is malformed"),
        ("{jwt}", "{user}", "the seed is malformed"),
        ("{jwt}", "{other}", "the seed and the JWT are of different users"),
        ("no.jwt", "{seed}", "the JWT is malformed"),
        ("e30.W10.e30", "{seed}", "the JWT is malformed"),
        ("e30.e30.e30", "{seed}", "the JWT is malformed"),
        ("\0", "\0", "block NATS USER JWT is missing; a NATS credentials file has one"),
    ],
)
def test_credentials_that_are_none_are_told(file: Path, jwt: str, seed: str, error: str) -> None:
    account = Key(ACCOUNT)
    user, other = User(account), User(account)
    texts = {
        "jwt": user.jwt,
        "seed": user.key.seed,
        "account": account.seed,
        "damaged": damaged(user.key.seed),
        "user": user.key.name,
        "other": other.key.seed,
    }
    written(file, jwt.format(**texts), seed.format(**texts))
    assert refusal(Servers(credentials=file)) == f"{file}: {error}"
