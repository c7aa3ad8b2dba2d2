"""Modbus inside TLS: whom it trusts, what a role grants, and what becomes of what goes wrong."""

from __future__ import annotations

import contextlib
import re
import select
import ssl
import struct
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import pytest
from pymodbus.client import ModbusTlsClient

from holdfast.appliance import Appliance
from holdfast.cli.configuration import load_whole
from holdfast.config import ConfigError, load
from holdfast.events import log_lines
from holdfast.types import AREAS
from support import wire
from support.certificates import (
    FUTURE,
    PAST,
    ROLE,
    Certificates,
    Issued,
    named,
    openssl,
    self_signed,
)
from support.machine import resident, tool
from support.running import log_events
from support.tls_peer import (
    READ,
    ZERO,
    Peer,
    Refused,
    address,
    configuration,
    connections,
    context,
    reasons,
    verdict,
)
from support.vectors import cases, overlay

if TYPE_CHECKING:
    from collections.abc import Iterator

    from support.running import Run

WRITE = bytes.fromhex("0600070001")
FORBIDDEN = bytes.fromhex("8601")
MAX_READ = struct.pack(">BHH", 3, 0, 125)
CLIENT = "extendedKeyUsage=clientAuth"

versions = pytest.mark.parametrize("version", ["1.2", "1.3"])


class Party(NamedTuple):
    """An authority, a server that it vouches for, and clients with a role and without."""

    folder: Path
    authority: Certificates
    server: Issued
    engineer: Issued
    operator: Issued
    nobody: Issued

    def files(self, **more: Path) -> dict[str, Path]:
        """The `tls` section of the server."""
        return {
            "cert_file": self.server.certificate,
            "key_file": self.server.key,
            "ca_file": self.authority.ca,
            **more,
        }

    def client(self, name: str, *extensions: str, **more: Any) -> Issued:
        """A certificate of a client."""
        return self.authority.issue(name, f"DNS:{name}", extensions=extensions, **more)


@pytest.fixture(scope="module")
def party(tmp_path_factory: pytest.TempPathFactory) -> Party:
    folder = tmp_path_factory.mktemp("party")
    authority = Certificates(folder)

    def client(name: str, *extensions: str) -> Issued:
        return authority.issue(name, f"DNS:{name}", extensions=(CLIENT, *extensions))

    return Party(
        folder,
        authority,
        authority.issue("server", "DNS:localhost,IP:127.0.0.1"),
        client("engineer", named("engineer")),
        client("operator", named("operator")),
        client("nobody"),
    )


BY_ROLE: list[dict[str, Any]] = [
    {"sources": ["127.0.0.1"], "roles": ["engineer"], "access": "read-write"},
    {"sources": ["127.0.0.1"], "roles": ["operator", "guest"], "access": "read-only"},
]
ANYONE: list[dict[str, Any]] = [{"sources": ["127.0.0.1"], "access": "read-write"}]


PLACES: dict[str, Any] = {"max_connections_per_source": None}
HANDSHAKES = 256
"""The handshakes that a listener for few connections has room for."""
"""All peers of these tests have one address, which may take all places."""


@pytest.fixture
def secure(run: Run, party: Party) -> Appliance:
    """The engineer writes, the operator reads, nobody else comes in."""
    return run(configuration(party.files(), BY_ROLE))


def peer(appliance: Appliance, trust: ssl.SSLContext, **options: Any) -> Peer:
    return Peer(address(appliance), trust, **options)


# Roles


@versions
def test_a_role_grants_what_its_rule_says(secure: Appliance, party: Party, version: str) -> None:
    engineer = context(party.authority.ca, party.engineer, version)
    operator = context(party.authority.ca, party.operator, version)
    with peer(secure, engineer) as writer, peer(secure, operator) as reader:
        assert writer.shake().ask(WRITE) == WRITE
        assert reader.shake().ask(WRITE) == FORBIDDEN
        assert reader.ask(bytes.fromhex("0300070001")) == bytes.fromhex("03020001")
        assert writer.tls.version() == f"TLSv{version}"


@versions
def test_a_role_that_no_rule_names_keeps_its_session_without_rights(
    run: Run, party: Party, version: str, caplog: pytest.LogCaptureFixture
) -> None:
    appliance = run(configuration(party.files(), BY_ROLE))
    stranger = party.client("stranger", named("Engineer"))
    for issued in (stranger, party.nobody):
        with peer(appliance, context(party.authority.ca, issued, version)) as client:
            client.shake()
            assert [client.ask(pdu) for pdu in (READ, WRITE, b"\x11", READ)] == [
                *(bytes([pdu[0] | 0x80, 1]) for pdu in (READ, WRITE, b"\x11", READ))
            ]

    counted = connections(appliance)
    assert (counted["refused_role"], counted["tls_failed"], counted["accepted"]) == (2, 0, 2)
    log_events(appliance)
    fields = [
        record.fields  # type: ignore[attr-defined]
        for record in caplog.records
        if record.message == "refused_role"
    ]
    assert [each["role"] for each in fields] == ["Engineer", ""]
    assert all(each["listener"] == "secure" and "reason" not in each for each in fields)
    wire.until(lambda: connections(appliance)["open"] == 0, "their places are free")


def test_the_null_role_has_a_name_in_rules(run: Run, party: Party) -> None:
    rules = [{"sources": ["127.0.0.1"], "roles": [""], "access": "read-only"}]
    appliance = run(configuration(party.files(), rules))

    assert verdict(appliance, context(party.authority.ca, party.nobody)) == "served"
    empty = party.client("empty", f"{ROLE}=DER:0c00")
    assert verdict(appliance, context(party.authority.ca, empty)) == "served"
    assert verdict(appliance, context(party.authority.ca, party.operator)) == "without rights"


def test_a_rule_without_roles_holds_any_and_the_first_that_holds_settles(
    run: Run, party: Party
) -> None:
    source: dict[str, Any] = {"sources": ["127.0.0.1"]}
    rules: list[dict[str, Any]] = [
        {"sources": ["10.0.0.0/8"], "access": "read-write"},
        {**source, "roles": ["operator"], "access": "read-only"},
        {**source, "access": "read-write", "deny": [3]},
        {**source, "roles": ["nobody"], "access": "read-write"},
    ]
    appliance = run(configuration(party.files(), rules))
    answers = {}
    for name in ("engineer", "operator", "nobody"):
        with peer(appliance, context(party.authority.ca, getattr(party, name))) as client:
            client.shake()
            answers[name] = (client.ask(READ), client.ask(WRITE))

    denied = bytes.fromhex("8301")
    assert answers["operator"] == (ZERO, FORBIDDEN)
    assert answers["engineer"] == answers["nobody"] == (denied, WRITE)


@versions
@pytest.mark.parametrize(
    "extension",
    [
        f"{ROLE}=ASN1:PRINTABLESTRING:engineer",
        f"{ROLE}=ASN1:OCTETSTRING:engineer",
        f"{ROLE}=DER:0c08656e67696e656572ff",
        f"{ROLE}=DER:0c09656e67696e656572",
        f"{ROLE}=DER:0c02c328",
    ],
)
def test_a_role_that_can_not_be_read_is_refused(
    run: Run, party: Party, extension: str, version: str, caplog: pytest.LogCaptureFixture
) -> None:
    appliance = run(configuration(party.files(), ANYONE))
    malformed = party.client("malformed", extension)

    trust = context(party.authority.ca, malformed, version)
    assert verdict(appliance, trust).endswith("ALERT_BAD_CERTIFICATE")
    assert reasons(appliance, caplog) == ["role_type"]
    assert logged_subjects(caplog) == ["CN=malformed"]


def resumable(appliance: Appliance, trust: ssl.SSLContext) -> ssl.SSLSession:
    """A session of a connection that was served."""
    with peer(appliance, trust) as first:
        assert first.shake().ask(READ) == ZERO
        assert not first.tls.session_reused
        assert first.tls.session is not None
        return first.tls.session


@versions
def test_a_resumed_session_has_the_role_of_its_certificate(
    secure: Appliance, party: Party, version: str
) -> None:
    trust = context(party.authority.ca, party.operator, version)
    session: ssl.SSLSession | None = resumable(secure, trust)
    for _ in range(2):
        with peer(secure, trust, session=session) as again:
            assert again.shake().ask(WRITE) == FORBIDDEN
            assert again.ask(READ) == ZERO
            assert again.tls.session_reused
            session = again.tls.session
    assert connections(secure)["tls_failed"] == 0


@versions
def test_a_session_from_before_a_revocation_is_not_resumed(
    run: Run, version: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    authority = Certificates(tmp_path)
    server, client = authority.issue("server", "DNS:localhost"), authority.issue("lost", "DNS:lost")
    files = {
        "cert_file": server.certificate,
        "key_file": server.key,
        "ca_file": authority.ca,
        "crl_file": authority.revoke(),
    }
    trust = context(authority.ca, client, version)
    before = run(configuration(files, ANYONE))
    session = resumable(before, trust)
    before.stop()
    authority.revoke(client)
    after = run(configuration(files, ANYONE))

    refusal = pytest.raises(Refused, match="ALERT_CERTIFICATE_REVOKED")
    with peer(after, trust, session=session) as again, refusal:
        again.shake().ask(READ)
    assert reasons(after, caplog) == ["revoked"]


# Trust


@versions
def test_a_client_without_a_certificate_is_refused(
    secure: Appliance, party: Party, version: str, caplog: pytest.LogCaptureFixture
) -> None:
    alert = {"1.2": "HANDSHAKE_FAILURE", "1.3": "CERTIFICATE_REQUIRED"}[version]
    assert verdict(secure, context(party.authority.ca, None, version)).endswith(f"ALERT_{alert}")
    assert reasons(secure, caplog) == ["no_certificate"]
    assert logged_subjects(caplog) == [None]


def test_a_listener_without_authorities_for_clients_is_no_listener(
    party: Party, tmp_path: Path
) -> None:
    whole = configuration(party.files(), ANYONE)
    entry = f'"ca_file": "{party.authority.ca}"'
    file = tmp_path / "plant.yaml"
    for instead in ('"ca_file": null', '"review": 0'):
        assert entry in whole
        file.write_text(whole.replace(entry, instead))
        with pytest.raises(ConfigError, match=r"listeners\.secure\.tls.*ca_file"):
            load(file)


def logged_subjects(caplog: pytest.LogCaptureFixture) -> list[str | None]:
    failures = [each for each in caplog.records if each.message == "tls_failed"]
    return [each.fields.get("subject") for each in failures]  # type: ignore[attr-defined]


@versions
def test_certificates_that_are_not_trusted(
    secure: Appliance,
    party: Party,
    version: str,
    caplog: pytest.LogCaptureFixture,
    tmp_path: Path,
) -> None:
    foreign, impostor = Certificates(tmp_path, "foreign"), Certificates(tmp_path)
    role = named("engineer")
    refused = [
        ("unknown_issuer", "UNKNOWN_CA", foreign.issue("a", "DNS:a", extensions=[role])),
        ("bad_signature", "BAD_CERTIFICATE", impostor.issue("b", "DNS:b", extensions=[role])),
        ("expired", "CERTIFICATE_EXPIRED", party.client("c", role, dates=PAST)),
        ("not_yet_valid", "CERTIFICATE_EXPIRED", party.client("d", role, dates=FUTURE)),
        (
            "wrong_purpose",
            "UNSUPPORTED_CERTIFICATE",
            party.client("e", role, "extendedKeyUsage=serverAuth"),
        ),
        (
            "wrong_key_usage",
            "UNSUPPORTED_CERTIFICATE",
            party.client("f", role, "keyUsage=keyAgreement"),
        ),
        (
            "unsupported_extension",
            "BAD_CERTIFICATE",
            party.client("g", role.replace("=", "=critical,")),
        ),
        ("unknown_issuer", "UNKNOWN_CA", self_signed(tmp_path, "h", role)),
    ]
    for _, alert, issued in refused:
        trust = context(party.authority.ca, issued, version)
        assert verdict(secure, trust).endswith(f"ALERT_{alert}")

    assert reasons(secure, caplog, len(refused)) == [reason for reason, _, _ in refused]
    assert logged_subjects(caplog) == [f"CN={name}" for name in "abcdefgh"]


@versions
def test_the_subject_of_a_refused_certificate_can_not_harm_the_log(
    secure: Appliance,
    party: Party,
    version: str,
    caplog: pytest.LogCaptureFixture,
    tmp_path: Path,
) -> None:
    issued = Issued(tmp_path / "x.pem", tmp_path / "x.key")
    subject = "/CN=\x1b[2J\nopened peer=1\u202e/O=" + "x" * 60 + ("/OU=" + "y" * 60) * 5
    openssl(
        *("req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes"),
        *("-keyout", issued.key, "-out", issued.certificate, "-days", "2", "-utf8"),
        *("-subj", subject),
    )
    assert "ALERT" in verdict(secure, context(party.authority.ca, issued, version))
    reasons(secure, caplog)
    [told] = logged_subjects(caplog)
    assert told is not None
    assert len(told) == 256
    [line] = [log_lines.message(each) for each in caplog.records if each.message == "tls_failed"]
    assert line.isprintable()


@versions
def test_a_self_signed_certificate_that_is_in_the_file_is_trusted_and_vouches_for_nobody(
    run: Run, party: Party, version: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    pinned = self_signed(tmp_path, "pinned", named("engineer"))
    other = self_signed(tmp_path, "pinned2", named("engineer"))
    both = tmp_path / "both.pem"
    both.write_bytes(party.authority.ca.read_bytes() + pinned.certificate.read_bytes())
    appliance = run(configuration(party.files(ca_file=both), BY_ROLE))

    for issued in (pinned, party.engineer):
        assert verdict(appliance, context(party.authority.ca, issued, version)) == "served"
    forged = forge(tmp_path, pinned)
    for issued in (other, forged):
        assert "ALERT" in verdict(appliance, context(party.authority.ca, issued, version))
    assert reasons(appliance, caplog, 2) == ["unknown_issuer"] * 2


def forge(folder: Path, by: Issued) -> Issued:
    """A certificate that one who is no authority has signed."""
    issued = Issued(folder / "forged.pem", folder / "forged.key")
    request, extensions = folder / "forged.csr", folder / "forged.ext"
    extensions.write_text(f"{named('engineer')}\n")
    openssl(
        *("req", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes"),
        *("-keyout", issued.key, "-out", request, "-subj", "/CN=forged"),
    )
    openssl(
        *("x509", "-req", "-in", request, "-CA", by.certificate, "-CAkey", by.key, "-days", "2"),
        *("-CAcreateserial", "-extfile", extensions, "-out", issued.certificate),
    )
    return issued


def test_self_signed_certificates_alone_and_their_dates(
    run: Run, party: Party, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    good = self_signed(tmp_path, "good", named("engineer"))
    old = self_signed(tmp_path, "old", named("engineer"), dates=PAST)
    both = tmp_path / "both.pem"
    both.write_bytes(good.certificate.read_bytes() + old.certificate.read_bytes())
    appliance = run(configuration(party.files(ca_file=both), BY_ROLE))

    assert verdict(appliance, context(party.authority.ca, good)) == "served"
    assert "ALERT" in verdict(appliance, context(party.authority.ca, old))
    assert "ALERT" in verdict(appliance, context(party.authority.ca, party.engineer))
    assert reasons(appliance, caplog, 2) == ["expired", "unknown_issuer"]


@versions
def test_a_revoked_certificate_is_refused(
    run: Run, version: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    authority = Certificates(tmp_path)
    server = authority.issue("server", "DNS:localhost")
    kept, lost = (
        authority.issue(name, f"DNS:{name}", extensions=[named("engineer")])
        for name in ("kept", "lost")
    )
    files = {
        "cert_file": server.certificate,
        "key_file": server.key,
        "ca_file": authority.ca,
        "crl_file": authority.revoke(lost),
    }
    appliance = run(configuration(files, BY_ROLE))

    assert verdict(appliance, context(authority.ca, kept, version)) == "served"
    assert "ALERT" in verdict(appliance, context(authority.ca, lost, version))
    assert reasons(appliance, caplog) == ["revoked"]


def test_an_authority_without_a_list_of_its_own_is_not_believed(
    run: Run, party: Party, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    other = Certificates(tmp_path, "other")
    both = tmp_path / "both.pem"
    both.write_bytes(party.authority.ca.read_bytes() + other.ca.read_bytes())
    files = party.files(ca_file=both, crl_file=other.revoke())
    appliance = run(configuration(files, BY_ROLE))

    assert "ALERT" in verdict(appliance, context(party.authority.ca, party.engineer))
    assert reasons(appliance, caplog) == ["unknown_revocation"]


def test_a_server_that_the_client_does_not_trust_is_told_so(
    secure: Appliance, party: Party, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    stranger = Certificates(tmp_path, "stranger")
    with peer(secure, context(stranger.ca, party.engineer)) as client:
        with pytest.raises(Refused):
            client.shake()
        client.flush()
    assert reasons(secure, caplog) in (["peer_refused_certificate"], ["closed_during_handshake"])


def test_a_peer_that_no_rule_names_is_closed_before_a_byte(run: Run, party: Party) -> None:
    rules = [{"sources": ["127.0.0.2"], "roles": ["engineer"], "access": "read-write"}]
    appliance = run(configuration(party.files(), rules))
    with wire.Connection(address(appliance)) as client:
        assert client.rest() == b""
    counted = connections(appliance)
    assert (counted["refused_source"], counted["tls_failed"], counted["accepted"]) == (1, 0, 0)


# Handshakes that go wrong


def test_plain_modbus_to_the_tls_port(
    secure: Appliance, party: Party, caplog: pytest.LogCaptureFixture
) -> None:
    with wire.Connection(address(secure)) as client:
        client.send(wire.frame(WRITE))
        client.rest()
    assert reasons(secure, caplog) == ["not_tls"]
    assert verdict(secure, context(party.authority.ca, party.engineer)) == "served"


def test_old_versions_are_refused(secure: Appliance, caplog: pytest.LogCaptureFixture) -> None:
    old = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    old.check_hostname, old.verify_mode = False, ssl.CERT_NONE
    with pytest.deprecated_call():
        old.minimum_version = old.maximum_version = ssl.TLSVersion.TLSv1_1
    old.set_ciphers("ALL:@SECLEVEL=0")
    assert "ALERT" in verdict(secure, old)
    assert reasons(secure, caplog) == ["no_common_version_or_cipher"]


def test_a_client_that_hangs_in_the_handshake_is_closed_in_time_and_holds_up_nobody(
    run: Run, party: Party, caplog: pytest.LogCaptureFixture
) -> None:
    appliance = run(configuration(party.files(), BY_ROLE, request_timeout=2))
    trust = context(party.authority.ca, party.engineer)
    with contextlib.ExitStack() as opened:
        silent = opened.enter_context(wire.Connection(address(appliance)))
        dripping = opened.enter_context(peer(appliance, trust))
        hello = dripping.hello()
        assert verdict(appliance, trust) == "served"
        for byte in hello:
            dripping.wire.send(bytes([byte]))
            if select.select([dripping.wire.socket], [], [], 0.02)[0]:
                break
        assert silent.rest() == b""
        dripping.wire.rest()
    assert reasons(appliance, caplog, 2) == ["timeout"] * 2
    wire.until(lambda: connections(appliance)["open"] == 0, "their places are free")


@versions
def test_a_handshake_that_is_cut_anywhere_leaves_the_server_well(
    secure: Appliance, party: Party, version: str
) -> None:
    trust = context(party.authority.ca, party.engineer, version)
    for cut in (0, 1, 4, 5, 6, 50):
        with peer(secure, trust) as client:
            client.wire.send(client.hello()[:cut])
            client.wire.reset()
    wire.until(lambda: connections(secure)["tls_failed"] == 6, "they are counted")
    wire.until(lambda: connections(secure)["open"] == 0, "their places are free")
    assert verdict(secure, trust) == "served"


def test_garbage_instead_of_a_handshake(secure: Appliance, party: Party) -> None:
    for garbage in (b"\x16\x03\x01\xff\xff" + bytes(70000), b"\x15\x03\x03\x00\x02\x01\x00" * 100):
        with wire.Connection(address(secure)) as client:
            with contextlib.suppress(ConnectionError):
                client.send(garbage)
            client.rest()
    wire.until(lambda: connections(secure)["tls_failed"] == 2, "they are counted")
    assert verdict(secure, context(party.authority.ca, party.engineer)) == "served"


# Records


@versions
def test_everything_may_arrive_byte_by_byte(secure: Appliance, party: Party, version: str) -> None:
    with peer(secure, context(party.authority.ca, party.engineer, version)) as client:
        client.drips = True
        assert client.shake().ask(WRITE) == WRITE
        assert client.ask(READ) == ZERO


def test_pdus_inside_tls_are_answered_as_their_vectors_say(run: Run, party: Party) -> None:
    text = configuration(party.files(), ANYONE)
    inputs = '"discrete_inputs": 1000, "input_registers": 1000, "coils": 1000'
    appliance = run(text.replace('"coils": 1000', inputs))
    memory = appliance.memories["plant"]
    with peer(appliance, context(party.authority.ca, party.engineer)) as client:
        client.shake()
        for case in cases("pdu.json"):
            expected = {area: [0] * 1000 for area in AREAS}
            overlay(expected, case["setup"])
            for area in AREAS:
                memory.write(area, 0, expected[area])

            assert client.ask(bytes.fromhex(case["request"])).hex() == case["response"]
            overlay(expected, case["after"])
            assert {area: memory.read(area, 0, 1000) for area in AREAS} == expected, case["name"]


@versions
def test_one_request_may_come_in_many_records_and_many_in_one(
    secure: Appliance, party: Party, version: str
) -> None:
    with peer(secure, context(party.authority.ca, party.engineer, version)) as client:
        client.shake()
        for byte in wire.frame(WRITE, 1, 7):
            client.send(bytes([byte]))
        assert client.receive_many(1) == [wire.Frame(7, 1, WRITE)]
        records = b"".join(client.seal(bytes([byte])) for byte in wire.frame(WRITE, 1, 8))
        client.wire.send(records)
        assert client.receive_many(1) == [wire.Frame(8, 1, WRITE)]
        # 16 KB are one record, and more than is read at once.
        replies = client.ask_many([READ] * 1365)
        assert replies == [ZERO] * 1365


def test_requests_with_the_longest_replies_are_answered_in_order(
    secure: Appliance, party: Party
) -> None:
    with peer(secure, context(party.authority.ca, party.engineer)) as client:
        client.shake()
        replies = client.ask_many([MAX_READ] * 1300)
        assert replies == [b"\x03\xfa" + bytes(250)] * 1300


@versions
def test_requests_before_the_end_are_answered_and_the_end_is_answered_too(
    secure: Appliance, party: Party, version: str
) -> None:
    with peer(secure, context(party.authority.ca, party.engineer, version)) as client:
        client.shake()
        client.wire.send(client.seal(wire.frames([READ] * 20)) + client.goodbye())
        assert len(client.receive_many(20)) == 20
        assert client.end() == "close_notify"
    wire.until(lambda: connections(secure)["open"] == 0, "it is closed")


def test_an_impossible_length_ends_the_connection_behind_what_came_before(
    secure: Appliance, party: Party
) -> None:
    with peer(secure, context(party.authority.ca, party.engineer)) as client:
        client.shake()
        client.send(wire.frame(READ) + wire.frame(READ, length=0) + wire.frame(WRITE))
        assert [reply.pdu for reply in client.receive_many(1)] == [ZERO]
        assert client.end() == "close_notify"


def test_a_record_that_was_changed_ends_the_connection(
    secure: Appliance, party: Party, caplog: pytest.LogCaptureFixture
) -> None:
    with peer(secure, context(party.authority.ca, party.engineer)) as client:
        client.shake()
        changed = bytearray(client.seal(wire.frame(WRITE)))
        changed[-1] ^= 1
        client.wire.send(bytes(changed))
        assert client.end().endswith("ALERT_BAD_RECORD_MAC")
    assert reasons(secure, caplog) == ["bad_record"]


# Deadlines, limits, stop


def test_half_a_request_and_half_a_record_end_the_connection_in_time(
    run: Run, party: Party
) -> None:
    appliance = run(configuration(party.files(), BY_ROLE, request_timeout=2, idle_timeout=0))
    trust = context(party.authority.ca, party.engineer)
    with peer(appliance, trust) as half_request, peer(appliance, trust) as half_record:
        for client in (half_request, half_record):
            assert client.shake().ask(READ) == ZERO
        whole = wire.frame(READ)
        half_request.wire.send(half_request.seal(whole[:5]))
        half_record.wire.send(half_record.seal(whole)[:9])
        assert [client.end() for client in (half_request, half_record)] == ["close_notify"] * 2
    wire.until(lambda: connections(appliance)["request_timeout"] == 2, "they are counted")


def test_a_connection_without_a_request_ends_after_the_idle_timeout(run: Run, party: Party) -> None:
    appliance = run(configuration(party.files(), BY_ROLE, idle_timeout=0.3))
    with peer(appliance, context(party.authority.ca, party.engineer)) as client:
        client.shake()
        while not select.select([client.wire.socket], [], [], 0.05)[0]:
            client.wire.send(client.seal(wire.frame(READ, protocol=1)))
        assert client.end() == "close_notify"
    wire.until(lambda: connections(appliance)["idle"] == 1, "it is counted")


def shaken(appliance: Appliance, party: Party, number: int, opened: contextlib.ExitStack) -> Any:
    """Returns clients with an open session that was used."""
    trust = context(party.authority.ca, party.engineer)
    clients = [opened.enter_context(peer(appliance, trust)) for _ in range(number)]
    for client in clients:
        assert client.shake().ask(READ) == ZERO
    return clients


@pytest.mark.parametrize("when_full", ["evict", "refuse"])
def test_silent_connections_displace_each_other_and_no_session(
    run: Run, party: Party, when_full: str, caplog: pytest.LogCaptureFixture
) -> None:
    limits = {**PLACES, "max_connections": 4, "when_full": when_full}
    appliance = run(configuration(party.files(), BY_ROLE, **limits))
    with contextlib.ExitStack() as opened:
        clients = shaken(appliance, party, 3, opened)
        silent = [
            opened.enter_context(wire.Connection(address(appliance)))
            for _ in range(HANDSHAKES + 15)
        ]
        assert [each.rest() for each in silent[:15]] == [b""] * 15
        assert all(client.ask(READ) == ZERO for client in clients)
        # The handshake of this one displaces another silent connection, and succeeds.
        clients += shaken(appliance, party, 1, opened)
        assert silent[15].rest() == b""
        assert all(client.ask(WRITE) == WRITE for client in clients)

        counted = connections(appliance)
        assert (counted["evicted"], counted["evicted_handshakes"]) == (0, 16)
        assert (counted["open"], counted["tls_failed"], counted["refused_full"]) == (
            4 + HANDSHAKES - 1,
            0,
            0,
        )
        log_events(appliance)
        logged = [each for each in caplog.records if each.message == "evicted"]
        assert {each.fields["reason"] for each in logged} == {"handshake"}  # type: ignore[attr-defined]


@pytest.mark.usefixtures("many_files")
def test_1500_half_open_handshakes_beside_sessions_that_notice_nothing(
    run: Run, party: Party
) -> None:
    limits = {**PLACES, "max_connections": 20, "when_full": "evict"}
    appliance = run(configuration(party.files(), BY_ROLE, **limits))
    with contextlib.ExitStack() as opened:
        clients = shaken(appliance, party, 19, opened)
        hello = Peer(address(appliance), context(party.authority.ca), source=None)
        begun = opened.enter_context(hello).hello()
        for number in range(1500):
            half_open = opened.enter_context(wire.Connection(address(appliance)))
            with contextlib.suppress(ConnectionError):
                half_open.send(begun[: 1 + number % len(begun)])
            if number % 50 == 0:
                assert clients[number % len(clients)].ask(READ) == ZERO
        assert all(client.ask(WRITE) == WRITE for client in clients)
        assert shaken(appliance, party, 1, opened)
        counted = connections(appliance)
        assert (counted["evicted"], counted["refused_full"]) == (0, 0)
        assert counted["evicted_handshakes"] > 1000


def test_a_new_session_displaces_the_one_that_is_idle_longest(run: Run, party: Party) -> None:
    limits = {**PLACES, "max_connections": 2, "when_full": "evict"}
    appliance = run(configuration(party.files(), BY_ROLE, **limits))
    with contextlib.ExitStack() as opened:
        first, second = shaken(appliance, party, 2, opened)
        assert first.ask(READ) == ZERO
        [third] = shaken(appliance, party, 1, opened)
        assert second.end() == "cut"
        assert first.ask(READ) == third.ask(READ) == ZERO
    assert connections(appliance)["evicted"] == 1


def test_a_full_listener_refuses_a_new_session(run: Run, party: Party) -> None:
    appliance = run(configuration(party.files(), BY_ROLE, **PLACES, max_connections=1))
    trust = context(party.authority.ca, party.engineer)
    with contextlib.ExitStack() as opened:
        early = opened.enter_context(peer(appliance, trust))
        hello = early.hello()
        early.wire.send(hello[:20])
        wire.until(lambda: connections(appliance)["open"] == 1, "its handshake has begun")
        [first] = shaken(appliance, party, 1, opened)
        late = opened.enter_context(wire.Connection(address(appliance)))
        assert late.rest() == b""
        early.wire.send(hello[20:])
        early.shake()
        assert early.end() == "close_notify"
        assert first.ask(READ) == ZERO
    assert connections(appliance)["refused_full"] == 2


def slow(client: Peer, number: int) -> None:
    """Sends requests until the server takes no more."""
    requests = client.seal(wire.frames([MAX_READ] * number))
    client.wire.socket.setblocking(False)
    sent = 0
    while sent < len(requests) and select.select([], [client.wire.socket], [], 0.2)[1]:
        sent += client.wire.socket.send(requests[sent:])
    assert sent < len(requests), "the server reads on though nobody takes its replies"


def test_a_peer_that_takes_no_replies_is_closed_and_holds_up_nobody(run: Run, party: Party) -> None:
    appliance = run(configuration(party.files(), BY_ROLE, request_timeout=2))
    trust = context(party.authority.ca, party.engineer)
    with peer(appliance, trust, receive_buffer=4096) as client, peer(appliance, trust) as other:
        other.shake()
        slow(client.shake(), 500_000)
        assert other.ask(READ) == ZERO
        wire.until(lambda: connections(appliance)["slow_reader"] == 1, "it is counted")


def test_a_slow_reader_gets_every_reply_when_it_reads_at_last(
    secure: Appliance, party: Party
) -> None:
    trust = context(party.authority.ca, party.engineer)
    number = 20_000
    with peer(secure, trust, receive_buffer=4096) as client:
        client.shake()
        unsent = memoryview(client.seal(wire.frames([MAX_READ] * number)))
        got = 0
        while got < number:
            readable, writable, _ = select.select(
                [client.wire.socket], [client.wire.socket] if unsent else [], [], wire.DEADLINE
            )
            assert readable or writable
            if writable:
                client.wire.socket.setblocking(False)
                unsent = unsent[client.wire.socket.send(unsent[:65536]) :]
            elif readable:
                got += len(client.receive_some())


@versions
def test_stop_answers_what_was_received_and_says_so(
    secure: Appliance, party: Party, version: str
) -> None:
    trust = context(party.authority.ca, party.engineer, version)
    with contextlib.ExitStack() as opened:
        clients = [opened.enter_context(peer(secure, trust)).shake() for _ in range(5)]
        shaking = opened.enter_context(wire.Connection(address(secure)))
        for client in clients:
            assert client.ask(READ) == ZERO
        for client in clients[1:]:
            client.send(wire.frames([READ] * 3))
        secure.stop()
        assert clients[0].end() == "close_notify"
        for client in clients[1:]:
            assert len(client.receive_many(3)) == 3
            assert client.end() == "close_notify"
        assert shaking.rest() == b""


# Clients of others


@versions
def test_pymodbus(secure: Appliance, party: Party, version: str) -> None:
    host, port = address(secure)
    trust = context(party.authority.ca, party.engineer, version)
    trust.check_hostname = False  # It has no way to say which name it wants.
    client = ModbusTlsClient(host, port=port, sslctx=trust, timeout=wire.DEADLINE)
    try:
        assert client.connect()  # type: ignore[no-untyped-call]
        assert not client.write_registers(3, [1, 2, 3], device_id=1).isError()
        assert client.read_holding_registers(3, count=3, device_id=1).registers == [1, 2, 3]
    finally:
        client.close()  # type: ignore[no-untyped-call]


@pytest.mark.parametrize("version", ["-tls1_2", "-tls1_3"])
def test_openssl_asks_for_short_fragments_and_is_served(
    secure: Appliance, party: Party, version: str
) -> None:
    host, port = address(secure)
    shown = ("-cert", str(party.operator.certificate), "-key", str(party.operator.key))
    client = subprocess.Popen(
        [
            *(tool("openssl"), "s_client", "-quiet", "-connect", f"{host}:{port}", version),
            *("-maxfraglen", "512", *shown),
        ],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        bufsize=0,
    )
    try:
        assert client.stdin is not None
        assert client.stdout is not None
        client.stdin.write(wire.frames([MAX_READ] * 10))
        received, replies = b"", list[wire.Frame]()
        while len(replies) < 10:
            piece = client.stdout.read(65536)
            assert piece
            received += piece
            replies = wire.split(received)[0]
        assert [reply.pdu for reply in replies] == [b"\x03\xfa" + bytes(250)] * 10
    finally:
        client.kill()
        client.communicate()


def test_openssl_changes_its_keys_and_a_flood_of_new_keys_ends_the_connection(
    secure: Appliance, party: Party, caplog: pytest.LogCaptureFixture
) -> None:
    host, port = address(secure)
    shown = ("-cert", str(party.operator.certificate), "-key", str(party.operator.key))
    client = subprocess.Popen(
        [tool("openssl"), "s_client", "-connect", f"{host}:{port}", "-tls1_3", *shown],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        bufsize=0,
    )
    assert client.stdin is not None
    assert client.stdout is not None

    def say(data: bytes, until: bytes) -> None:
        """A line that begins with K asks for new keys, if it comes alone."""
        assert client.stdin is not None
        assert client.stdout is not None
        client.stdin.write(data)
        told = b""
        while until not in told:
            piece = client.stdout.read(4096)
            if not piece:
                raise BrokenPipeError
            told += piece

    try:
        for number in range(1, 4):
            say(b"K\n", b"KEYUPDATE\n")
            say(wire.frame(READ, 1, number), wire.frame(ZERO, 1, number))
        with contextlib.suppress(BrokenPipeError):
            for _ in range(1000):
                say(b"K\n", b"KEYUPDATE\n")
    finally:
        client.kill()
        client.communicate()
    assert reasons(secure, caplog) == ["other"]


# Memory


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs /proc")
def test_idle_connections_cost_little_memory(party: Party, tmp_path: Path) -> None:
    file = tmp_path / "plant.yaml"
    limits = {**PLACES, "max_connections": 1000, "idle_timeout": 0}
    file.write_text(configuration(party.files(), BY_ROLE, **limits))
    trust = context(party.authority.ca, party.engineer)
    with serving(file) as (pid, at), contextlib.ExitStack() as opened:
        with Peer(at, trust) as first:
            assert first.shake().ask(READ) == ZERO
        before = resident(pid)
        clients = [opened.enter_context(Peer(at, trust)).shake() for _ in range(200)]
        assert all(client.ask(READ) == ZERO for client in clients)
        assert resident(pid) - before < 200 * 64 * 1024


@contextlib.contextmanager
def serving(file: Path) -> Iterator[tuple[int, tuple[str, int]]]:
    """A process that runs a configuration: its id, and where it listens."""
    process = subprocess.Popen(
        [sys.executable, "-m", "holdfast", "run", str(file)],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert process.stdout is not None
    try:
        greeting = ""
        while "Ctrl-C stops it." not in greeting:
            line = process.stdout.readline()
            assert line, greeting
            greeting += line
        match = re.search(r"modbus-tls +([0-9.]+):([0-9]+)", greeting)
        assert match, greeting
        assert "for 127.0.0.1/32 as engineer" in greeting
        yield process.pid, (match[1], int(match[2]))
    finally:
        process.kill()
        process.communicate()


# What is checked before anything starts


def test_files_that_can_not_be_used_are_told_with_their_place(party: Party, tmp_path: Path) -> None:
    nothing = tmp_path / "nothing.pem"
    nothing.write_text("nothing\n")
    locked = party.authority.issue("locked", "DNS:locked", "-passout", "pass:secret")
    odd = party.authority.issue("odd", "DNS:odd", curve="secp256k1")
    ca, key, server = party.authority.ca, party.server.key, party.server.certificate
    cases = [
        ({"cert_file": key}, key, "found no certificate, allowed: a certificate in PEM"),
        ({"key_file": server}, server, "found no key, allowed: a key in PEM"),
        (
            {"key_file": party.engineer.key},
            party.engineer.key,
            f"it is not the key of the certificate in {server}",
        ),
        (
            {"key_file": locked.key},
            locked.key,
            "the key is encrypted, and no passphrase is given",
        ),
        (
            {"cert_file": odd.certificate, "key_file": odd.key},
            odd.key,
            "found a key of another kind, allowed: RSA or RSA-PSS of 2048 to 8192 bits, P-256, "
            "P-384, P-521, Ed25519",
        ),
        ({"ca_file": nothing}, nothing, "found no certificate, allowed: a certificate in PEM"),
        (
            {"crl_file": ca},
            ca,
            "found no revocation list, allowed: X509 CRL in PEM",
        ),
    ]
    file = tmp_path / "plant.yaml"
    for files, wrong, message in cases:
        file.write_text(configuration({**party.files(), **files}, ANYONE))
        with pytest.raises(ConfigError) as caught:
            load_whole(file)
        [problem] = caught.value.problems
        assert str(problem) == f"{file}:1: listeners.secure.tls: {wrong}: {message}"
        with pytest.raises(ValueError, match=re.escape(message)):
            Appliance(load(file)).start()

    outcome = subprocess.run(
        [sys.executable, "-m", "holdfast", "run", str(file)],
        capture_output=True,
        check=False,
        text=True,
    )
    assert outcome.returncode == 2
    assert "found no revocation list" in outcome.stderr


def test_lists_without_an_authority_are_told(party: Party, tmp_path: Path) -> None:
    lonely = self_signed(tmp_path, "lonely")
    files = party.files(ca_file=lonely.certificate, crl_file=party.authority.revoke())
    (tmp_path / "plant.yaml").write_text(configuration(files, ANYONE))
    with pytest.raises(ConfigError, match="crl_file requires an authority"):
        load_whole(tmp_path / "plant.yaml")
