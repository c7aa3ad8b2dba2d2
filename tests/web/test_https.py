"""HTTPS: certificates of both sides, limits around the handshake, and renewed files."""

from __future__ import annotations

import contextlib
import http.client
import shutil
import ssl
import warnings
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import pytest

import holdfast
from holdfast.events import log_lines
from holdfast.net.certificates.pem import UnusableFile
from holdfast.net.http.https import Https, HttpsFiles
from support import web, wire
from support.certificates import PAST, Certificates, Issued, named
from support.secured import Authority
from support.tls_peer import VERSIONS, Peer, Refused, context

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

HEALTH = web.head("GET", "/api/v1/health", "Connection: close")
SOON = 0.25
"""The request timeout of tests that wait for it."""
SERVER = "DNS:localhost,IP:127.0.0.1"
CLIENT = "DNS:panel"


class Files(NamedTuple):
    """An authority, and what it has issued."""

    authority: Certificates
    server: Issued
    client: Issued

    def https(self, **more: Any) -> Https:
        return Https(HttpsFiles(self.server.certificate, self.server.key, **more))

    def mutual(self, **more: Any) -> Https:
        return self.https(client_ca_file=self.authority.ca, **more)

    def trust(self, issued: Issued | None = None, version: str | None = None) -> ssl.SSLContext:
        return context(self.authority.ca, issued, version)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Files:
    authority = Certificates(tmp_path_factory.mktemp("authority"))
    return Files(authority, authority.issue("server", SERVER), authority.issue("panel", CLIENT))


class Start(Protocol):
    def __call__(self, https: Https, **settings: Any) -> web.Service: ...


@pytest.fixture
def start() -> Iterator[Start]:
    with ExitStack() as running:

        def started(https: Https, **settings: Any) -> web.Service:
            plant = holdfast.Memory(coils=1000, holding_registers=65536)
            service = web.Service({"plant_a": plant}, https=https, **settings)
            running.enter_context(web.supervised(service.supervisor, service.listener))
            return service

        yield started


@pytest.fixture
def log() -> Iterator[web.Records]:
    records = web.Records()
    log_lines.LOGGER.addHandler(records)
    yield records
    log_lines.LOGGER.removeHandler(records)


def answer(service: web.Service, trust: ssl.SSLContext) -> web.Answer:
    client = web.Client(service.address, tls=trust)
    try:
        return client.get("/api/v1/health")
    finally:
        client.close()


def is_served(service: web.Service, trust: ssl.SSLContext) -> bool:
    return bool(answer(service, trust).json == {"status": "ok"})


def refusal(service: web.Service, trust: ssl.SSLContext, log: web.Records) -> str:
    """The logged reason why a client is refused."""
    before = service.connections()["tls_failed"]
    with Peer(service.address, trust) as peer, contextlib.suppress(Refused):
        peer.shake()
        peer.send(HEALTH)
        assert peer.rest() == b""
    service.until_counted("tls_failed", before + 1)
    reason = str(log.of("tls_failed")[-1]["reason"])
    assert service.diagnostics.stats()["adapters"]["rest"]["tls_failures"][reason] >= 1
    return reason


# What is served.


@pytest.mark.parametrize("version", VERSIONS)
def test_clients_are_served_over_tls_1_2_and_1_3(start: Start, files: Files, version: str) -> None:
    assert is_served(start(files.https()), files.trust(version=version))


def test_requests_of_one_connection_are_large_and_many(start: Start, files: Files) -> None:
    service = start(files.https())
    client = web.Client(service.address, tls=files.trust())
    values = [index % 65536 for index in range(65536)]
    assert client.ingest(web.command("holding_registers", 0, values)).status == 200
    assert client.read("holding_registers", 0, 65536).json["values"] == values
    assert client.get("/api/v1/health").status == 200
    client.close()
    assert service.connections()["accepted"] == 1


def test_the_documentation_has_https_in_its_commands(start: Start, files: Files) -> None:
    service = start(files.https())
    client = web.Client(service.address, tls=files.trust())
    page = client.get("/docs").body.decode()
    client.close()
    host, port = service.address
    assert f"https://{host}:{port}/" in page
    assert "http://" not in page


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize(
    ("offered", "chosen"), [(["h2", "http/1.1"], "http/1.1"), (["h2"], None), ([], None)]
)
def test_http_1_1_is_chosen_among_the_protocols_of_a_client(
    start: Start, files: Files, version: str, offered: list[str], chosen: str | None
) -> None:
    trust = files.trust(version=version)
    if offered:
        trust.set_alpn_protocols(offered)
    with Peer(start(files.https()).address, trust) as peer:
        assert peer.shake().tls.selected_alpn_protocol() == chosen
        peer.send(HEALTH)
        assert web.answers(peer.rest())[0].status == 200


def test_records_may_arrive_in_any_pieces(start: Start, files: Files) -> None:
    with Peer(start(files.https()).address, files.trust()) as peer:
        peer.drips = True
        peer.shake()
        peer.send(HEALTH)
        assert web.answers(peer.rest())[0].status == 200


def test_a_request_and_the_end_of_the_handshake_may_arrive_together(
    start: Start, files: Files
) -> None:
    with Peer(start(files.https()).address, files.trust()) as peer:
        sent, peer.flush = peer.flush, lambda: None  # type: ignore[method-assign]
        sent()
        peer.wire.send(peer.hello())
        peer.shake()
        peer.tls.write(HEALTH)
        sent()
        assert web.answers(peer.rest())[0].status == 200


def test_a_client_that_ends_its_side_still_gets_its_answer(start: Start, files: Files) -> None:
    with Peer(start(files.https()).address, files.trust()) as peer:
        peer.shake()
        peer.wire.send(peer.seal(web.head("GET", "/api/v1/health")) + peer.goodbye())
        peer.wire.finish()
        assert peer.wire.rest()


def test_the_end_is_announced(start: Start, files: Files) -> None:
    with Peer(start(files.https()).address, files.trust()) as peer:
        peer.shake()
        peer.send(HEALTH)
        assert peer.end() == "close_notify"


def test_a_service_that_stops_closes_its_connections(start: Start, files: Files) -> None:
    service = start(files.https())
    with Peer(service.address, files.trust()) as peer:
        peer.shake()
        service.supervisor.stop()
        assert peer.end() == "close_notify"


# What is refused.


@pytest.mark.parametrize("size", [0, 2_000_000])
def test_a_plain_http_request_is_told_to_use_https(
    start: Start, files: Files, log: web.Records, size: int
) -> None:
    service = start(files.https())
    client = web.Client(service.address)
    told = client.ask("POST", web.INGEST, b" " * size)
    client.close()
    assert told.status == 400
    assert told.json["detail"] == "this port takes HTTPS: use a URL that begins with https://"
    service.until_counted("tls_failed")
    assert log.of("tls_failed")[0]["reason"] == "not_tls"


def test_anything_else_than_tls_is_closed(start: Start, files: Files, log: web.Records) -> None:
    service = start(files.https())
    with wire.Connection(service.address) as connection:
        connection.send(wire.frame(b"\x03\0\0\0\1"))
        assert connection.rest() == b""
    service.until_counted("tls_failed")
    assert log.of("tls_failed")[0]["reason"] == "not_tls"


def test_tls_1_1_is_refused(start: Start, files: Files, log: web.Records) -> None:
    trust = context(files.authority.ca, weak=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        trust.minimum_version = ssl.TLSVersion.TLSv1
        trust.maximum_version = ssl.TLSVersion.TLSv1_1
    assert refusal(start(files.https()), trust, log) == "no_common_version_or_cipher"


def test_a_peer_from_elsewhere_gets_no_byte(start: Start, files: Files) -> None:
    service = start(files.https(), sources=["127.0.0.9"])
    with Peer(service.address, files.trust()) as peer:
        assert peer.wire.rest() == b""
    assert (service.connections()["refused_source"], service.connections()["tls_failed"]) == (1, 0)


def test_a_handshake_that_never_ends_is_given_up(
    start: Start, files: Files, log: web.Records
) -> None:
    service = start(files.https(), request_timeout=SOON)
    with Peer(service.address, files.trust()) as peer:
        peer.wire.send(peer.hello()[:-1])
        assert peer.wire.rest() == b""
    service.until_counted("tls_failed")
    assert log.of("tls_failed")[0]["reason"] == "timeout"


def test_a_client_that_leaves_in_the_handshake_is_counted(
    start: Start, files: Files, log: web.Records
) -> None:
    service = start(files.https())
    with Peer(service.address, files.trust()) as peer:
        peer.wire.send(peer.hello()[:-1])
    service.until_counted("tls_failed")
    assert log.of("tls_failed")[0]["reason"] == "closed_during_handshake"


def test_peers_without_a_handshake_lock_nobody_out(start: Start, files: Files) -> None:
    service = start(files.https(), max_connections=2)
    with ExitStack() as silent:
        for _ in range(5):
            silent.enter_context(wire.Connection(service.address))
        wire.until(lambda: service.connections()["accepted"] == 5, "all are accepted")
        assert is_served(service, files.trust())
        assert service.connections()["evicted"] >= 3


def test_a_client_that_reads_nothing_is_given_up(start: Start, files: Files) -> None:
    service = start(files.https(), request_timeout=1)
    path = f"{web.READ}?memory=plant_a&area=holding_registers&address=0&count=65536"

    def is_given_up() -> bool:
        """A loaded machine may be too slow for the handshake."""
        with Peer(service.address, files.trust(), receive_buffer=4096) as peer:
            with contextlib.suppress(Refused, ConnectionError):
                peer.shake()
                peer.send(web.head("GET", path) * 64)
            wire.until(lambda: service.connections()["open"] == 0, "its connection is closed")
        return service.connections()["slow_reader"] == 1

    wire.until(is_given_up, "its timeout is that of a slow reader")


def test_a_client_that_does_not_trust_the_server_is_counted(
    start: Start, files: Files, log: web.Records
) -> None:
    service = start(files.https())
    with Peer(service.address, context(files.client.certificate)) as peer:
        with pytest.raises(Refused):
            peer.shake()
        peer.flush()
        service.until_counted("tls_failed")
    assert log.of("tls_failed")[0]["reason"] == "peer_refused_certificate"


def test_an_altered_record_ends_the_connection(
    start: Start, files: Files, log: web.Records
) -> None:
    service = start(files.https())
    with Peer(service.address, files.trust()) as peer:
        peer.shake()
        record = bytearray(peer.seal(HEALTH))
        record[-1] ^= 1
        peer.wire.send(bytes(record))
        with pytest.raises(Refused):
            peer.rest()
    service.until_counted("tls_failed")
    assert log.of("tls_failed")[0]["reason"] == "bad_record"


# Certificates of clients.


@pytest.mark.parametrize("version", VERSIONS)
def test_clients_with_a_certificate_are_served(start: Start, files: Files, version: str) -> None:
    assert is_served(start(files.mutual()), files.trust(files.client, version))


@pytest.mark.parametrize("version", VERSIONS)
def test_clients_without_a_certificate_are_refused(
    start: Start, files: Files, log: web.Records, version: str
) -> None:
    assert refusal(start(files.mutual()), files.trust(version=version), log) == "no_certificate"


def test_other_certificates_are_refused_with_their_reason(
    start: Start, files: Files, log: web.Records, tmp_path: Path
) -> None:
    stranger = Authority(tmp_path, "stranger").issue("panel", CLIENT)
    late = files.authority.issue("late", CLIENT, dates=PAST)
    server_only = files.authority.issue("only", CLIENT, extensions=["extendedKeyUsage=serverAuth"])
    gone = files.authority.issue("gone", CLIENT)
    service = start(files.mutual(crl_file=files.authority.revoke(gone)))
    told = [
        refusal(service, files.trust(each), log) for each in (stranger, late, server_only, gone)
    ]
    assert told == ["unknown_issuer", "expired", "wrong_purpose", "revoked"]
    assert is_served(service, files.trust(files.client))


def test_an_authority_needs_a_revocation_list(
    start: Start, files: Files, log: web.Records, tmp_path: Path
) -> None:
    service = start(files.mutual(crl_file=Authority(tmp_path, "other").revoke()))
    assert refusal(service, files.trust(files.client), log) == "unknown_revocation"


def test_a_session_is_resumed_with_the_certificate_of_the_client(
    start: Start, files: Files
) -> None:
    service, trust = start(files.mutual()), files.trust(files.client, "1.2")
    with Peer(service.address, trust) as peer:
        peer.shake()
        session = peer.tls.session
    with Peer(service.address, trust, session=session) as peer:
        assert peer.shake().tls.session_reused
        peer.send(HEALTH)
        assert web.answers(peer.rest())[0].status == 200


def test_clients_are_refused_after_the_end_of_their_list(
    start: Start, files: Files, log: web.Records
) -> None:
    lists = files.authority.revoke(dates=PAST)
    service = start(files.mutual(crl_file=lists))
    assert refusal(service, files.trust(files.client), log) == "expired_revocation_list"


def test_only_clients_with_an_allowed_role_are_served(
    start: Start, files: Files, log: web.Records
) -> None:
    operator, engineer = (
        files.authority.issue(role, CLIENT, extensions=[named(role)])
        for role in ("operator", "engineer")
    )
    service = start(files.mutual(roles=("operator", "viewer")))
    assert is_served(service, files.trust(operator))
    for other in (engineer, files.client):
        assert refusal(service, files.trust(other), log) == "wrong_role"
    service = start(files.mutual(roles=("",)))
    assert is_served(service, files.trust(files.client))
    assert refusal(service, files.trust(operator), log) == "wrong_role"


# Renewed files.


def test_new_connections_get_renewed_certificates_and_open_ones_stay(
    start: Start, files: Files, tmp_path: Path
) -> None:
    other = Authority(tmp_path, "other")
    cert_file, key_file = tmp_path / "cert.pem", tmp_path / "key.pem"
    for old, new in zip((cert_file, key_file), files.server, strict=True):
        shutil.copy(new, old)
    https = Https(HttpsFiles(cert_file, key_file))
    service, trust = start(https), files.trust()
    open_one = web.Client(service.address, tls=trust)
    assert open_one.get("/api/v1/health").status == 200
    for old, new in zip((cert_file, key_file), other.issue("server", SERVER), strict=True):
        shutil.copy(new, old)
    assert is_served(service, trust)
    https.reload()
    with pytest.raises(ssl.SSLCertVerificationError):
        answer(service, trust)
    assert is_served(service, context(other.ca))
    assert open_one.get("/api/v1/health").status == 200
    open_one.close()


def test_an_authority_that_is_removed_is_not_trusted_any_more(
    start: Start, files: Files, log: web.Records, tmp_path: Path
) -> None:
    other = Authority(tmp_path, "other")
    https = files.mutual()
    service = start(https)
    assert is_served(service, files.trust(files.client))
    own = files.server
    https.adopt(Https(HttpsFiles(own.certificate, own.key, client_ca_file=other.ca)))
    assert refusal(service, files.trust(files.client), log) == "unknown_issuer"
    assert is_served(service, files.trust(other.issue("panel", CLIENT)))


def test_a_handshake_that_new_files_overtake_is_judged_by_them(
    start: Start, files: Files, tmp_path: Path
) -> None:
    other = Authority(tmp_path, "other")
    own, https = files.server, files.mutual()
    service = start(https)
    with Peer(service.address, files.trust(files.client, "1.3")) as peer:
        service.until_counted("accepted")
        unsent = peer.shake_unsent()
        https.adopt(Https(HttpsFiles(own.certificate, own.key, client_ca_file=other.ca)))
        peer.wire.send(unsent + peer.seal(HEALTH))
        with contextlib.suppress(Refused):
            assert peer.rest() == b""
    service.until_counted("tls_failed")


def test_connections_without_a_certificate_end_when_clients_begin_to_need_one(
    start: Start, files: Files, log: web.Records
) -> None:
    own = files.server
    https = Https(HttpsFiles(own.certificate, own.key))
    service = start(https)
    open_one = web.Client(service.address, tls=files.trust())
    assert open_one.get("/api/v1/health").status == 200
    with wire.Connection(service.address) as shaking:
        service.until_counted("accepted", 2)
        https.adopt(files.mutual())
        service.until_counted("tls_failed", 2)
        assert shaking.rest() == b""
    assert [each["reason"] for each in log.of("tls_failed")] == ["no_certificate"] * 2
    with pytest.raises((ConnectionError, http.client.HTTPException)):
        open_one.get("/api/v1/health")
    open_one.close()
    with_certificate = web.Client(service.address, tls=files.trust(files.client))
    assert with_certificate.get("/api/v1/health").status == 200
    https.reload()
    assert with_certificate.get("/api/v1/health").status == 200
    with_certificate.close()


def test_unusable_files_change_nothing(start: Start, files: Files, tmp_path: Path) -> None:
    own = tmp_path / "own.pem"
    own.write_bytes(files.server.certificate.read_bytes())
    https = Https(HttpsFiles(own, files.server.key))
    service = start(https)
    own.write_text("")
    with pytest.raises(UnusableFile, match=r"own\.pem: found no certificate"):
        https.reload()
    assert is_served(service, files.trust())


# Files.


@pytest.mark.parametrize("traditional", [False, True])
def test_a_key_may_have_a_passphrase(start: Start, tmp_path: Path, traditional: bool) -> None:
    authority = Authority(tmp_path)
    issued = authority.issue("server", SERVER)
    locked = authority.locked(issued.key, traditional=traditional)
    (tmp_path / "secret").write_text("secret\n")
    https = Https(HttpsFiles(issued.certificate, locked, tmp_path / "secret"))
    assert is_served(start(https), context(authority.ca))


def test_unusable_files_are_named(files: Files, tmp_path: Path) -> None:
    cert, key = files.server
    locked = Authority(tmp_path).locked(key, traditional=False)
    for name, text in {"wrong": "other\n", "two": "a\nb\n", "empty": ""}.items():
        (tmp_path / name).write_text(text)
    stranger = Authority(tmp_path, "stranger")
    crl = stranger.revoke()
    cases: dict[str, HttpsFiles] = {
        "none: No such file": HttpsFiles(tmp_path / "none", key),
        "empty: found no certificate": HttpsFiles(tmp_path / "empty", key),
        "empty: found no key": HttpsFiles(cert, tmp_path / "empty"),
        "it is not the key of the certificate in": HttpsFiles(cert, files.client.key),
        "the key is encrypted, and no passphrase": HttpsFiles(cert, locked),
        "the passphrase is wrong": HttpsFiles(cert, locked, tmp_path / "wrong"),
        "two: found 2 lines, allowed: one line": HttpsFiles(cert, locked, tmp_path / "two"),
        "a key without a passphrase, but": HttpsFiles(cert, key, tmp_path / "wrong"),
        "empty: found no certificate, allowed": HttpsFiles(
            cert, key, client_ca_file=tmp_path / "empty"
        ),
        "empty: found no revocation list": HttpsFiles(
            cert, key, None, files.authority.ca, tmp_path / "empty"
        ),
        "crl: crl_file requires an authority": HttpsFiles(
            cert, key, None, stranger.self_signed("panel", CLIENT, ca=False)[0], crl
        ),
        "crl: found without client_ca_file": HttpsFiles(cert, key, crl_file=crl),
        "found with roles and without client_ca_file": HttpsFiles(cert, key, roles=("operator",)),
    }
    for message, given in cases.items():
        with pytest.raises(UnusableFile, match=message):
            Https(given)
