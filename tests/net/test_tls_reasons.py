"""Why TLS handshakes of OpenSSL failed, in the words of the core."""

from __future__ import annotations

import ssl
from typing import TYPE_CHECKING, NamedTuple

import pytest

from holdfast import _core
from holdfast.net import tls_reasons
from holdfast.net.tls import Tls, broker_context
from holdfast.net.tls_reasons import failure_text, tls_reason
from support.certificates import FUTURE, PAST, Certificates, self_signed
from support.paths import DOCS

if TYPE_CHECKING:
    from pathlib import Path

    from support.certificates import Issued


class Side(NamedTuple):
    """One side of a handshake in memory."""

    tls: ssl.SSLObject
    received: ssl.MemoryBIO
    sent: ssl.MemoryBIO


def side(context: ssl.SSLContext, server_name: str | None = None) -> Side:
    received, sent = ssl.MemoryBIO(), ssl.MemoryBIO()
    is_server = context.protocol == ssl.PROTOCOL_TLS_SERVER
    tls = context.wrap_bio(received, sent, server_side=is_server, server_hostname=server_name)
    return Side(tls, received, sent)


def step(one: Side, other: Side) -> ssl.SSLError | None:
    """Lets one side go on as far as it can. Returns why it can't at all."""
    try:
        one.tls.do_handshake()
        one.tls.read()
    except ssl.SSLWantReadError:
        return None
    except ssl.SSLError as error:
        return error
    finally:
        other.received.write(one.sent.read())
    return None


def client_failure(client: ssl.SSLContext, server: ssl.SSLContext) -> ssl.SSLError:
    """Why the client ends a handshake with a broker at 127.0.0.1."""
    here, there = side(client, "127.0.0.1"), side(server)
    for _ in range(5):
        if error := step(here, there):
            return error
        step(there, here)
    raise AssertionError("the handshake succeeds")


def broker(issued: Issued, ca: Path | None = None) -> ssl.SSLContext:
    made = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    made.load_cert_chain(issued.certificate, issued.key)
    if ca is not None:
        made.verify_mode = ssl.CERT_REQUIRED
        made.load_verify_locations(ca)
    return made


@pytest.fixture
def authority(tmp_path: Path) -> Certificates:
    return Certificates(tmp_path)


def test_certificates_of_brokers_that_are_refused(authority: Certificates, tmp_path: Path) -> None:
    here = "IP:127.0.0.1"
    (tmp_path / "other").mkdir()
    stranger = Certificates(tmp_path / "other")
    cases = {
        "expired": authority.issue("a", here, dates=PAST),
        "not_yet_valid": authority.issue("b", here, dates=FUTURE),
        "wrong_name": authority.issue("c", "DNS:broker.example"),
        "wrong_purpose": authority.issue("d", here, extensions=["extendedKeyUsage=clientAuth"]),
        "unknown_issuer": stranger.issue("e", here),
    }
    context = broker_context(Tls.of(authority.ca))
    for word, issued in cases.items():
        assert tls_reason(client_failure(context, broker(issued))) == word
    alone = self_signed(tmp_path, "alone", f"subjectAltName={here}")
    assert tls_reason(client_failure(context, broker(alone))) == "unknown_issuer"


@pytest.mark.parametrize("version", [ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3])
def test_brokers_that_refuse_our_certificate(
    authority: Certificates, tmp_path: Path, version: ssl.TLSVersion
) -> None:
    (tmp_path / "other").mkdir()
    stranger = Certificates(tmp_path / "other").issue("me", "DNS:me")
    late = authority.issue("me", "DNS:me", dates=PAST)
    server = broker(authority.issue("broker", "IP:127.0.0.1"), authority.ca)
    server.maximum_version = version
    cases = [Tls.of(authority.ca, *own) for own in (stranger, late)]
    told = {tls_reason(client_failure(broker_context(case), server)) for case in cases}
    assert told == {"peer_refused_certificate"}
    alone = tls_reason(client_failure(broker_context(Tls.of(authority.ca)), server))
    has_alert = version == ssl.TLSVersion.TLSv1_3
    assert alone == ("peer_requires_certificate" if has_alert else "peer_refused_handshake")


def test_brokers_with_other_versions_and_without_tls(authority: Certificates) -> None:
    context = broker_context(Tls.of(authority.ca))
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    old = broker(authority.issue("broker", "IP:127.0.0.1"))
    old.maximum_version = ssl.TLSVersion.TLSv1_2
    assert tls_reason(client_failure(context, old)) == "no_common_version_or_cipher"

    plain = side(context, "127.0.0.1")
    plain.received.write(b'INFO {"server_id": "x", "tls_required": false}\r\n')
    error = step(plain, side(old))
    assert error is not None
    assert tls_reason(error) == "not_tls"


def test_a_broker_that_closes_the_connection_during_the_handshake(authority: Certificates) -> None:
    here, there = (side(broker_context(Tls.of(authority.ca)), "127.0.0.1") for _ in range(2))
    here.received.write_eof()
    error = step(here, there)
    assert isinstance(error, ssl.SSLEOFError)
    assert tls_reason(error) == "closed_during_handshake"


def test_every_word_is_one_of_the_core() -> None:
    tables = (tls_reasons._CERTIFICATE, tls_reasons._ERRORS, tls_reasons._ALERTS)
    words = {word for table in tables for word in table.values()}
    rest = {"untrusted_certificate", "closed_during_handshake", "peer_ended", "other"}
    assert words | rest <= set(_core.TLS_REASONS)
    assert tls_reason(ssl.SSLError(1, "unknown")) == "other"


def test_the_page_explains_every_word_of_the_core() -> None:
    page = (DOCS / "modbus-tls.md").read_text(encoding="utf-8")
    assert [word for word in _core.TLS_REASONS if f"`{word}`" not in page] == []


def test_the_text_of_a_failure_begins_with_the_reason(authority: Certificates) -> None:
    server = broker(authority.issue("broker", "DNS:broker.example"))
    error = client_failure(broker_context(Tls.of(authority.ca)), server)
    assert failure_text(error) == f"wrong_name: {error}"
    assert failure_text(ConnectionRefusedError(111, "refused")) == "[Errno 111] refused"
    assert failure_text(TimeoutError()) == "TimeoutError"
    assert failure_text(ended := ssl.SSLEOFError(8, "EOF occurred")) == str(ended)
