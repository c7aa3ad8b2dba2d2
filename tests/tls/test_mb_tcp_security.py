"""Requirements of MB-TCP-Security that other tests do not show; docs/conformance.md has all."""

from __future__ import annotations

import ssl
import struct
import subprocess
from typing import TYPE_CHECKING, Any

import pytest

from support import wire
from support.certificate_cases import CA, NAME, SIGNS, Mint
from support.certificates import Issued
from support.machine import tool
from support.tls_peer import Peer, address, configuration, context, reasons, verdict

if TYPE_CHECKING:
    from pathlib import Path

    from holdfast.appliance import Appliance
    from support.running import Run

ANYONE: list[dict[str, Any]] = [{"sources": ["127.0.0.1"], "access": "read-only"}]
LOCALHOST = "subjectAltName=DNS:localhost"


@pytest.fixture(scope="module")
def client(mint: Mint) -> Issued:
    return mint.make(by=mint.authority, name="client", extensions=[NAME])


def served(run: Run, mint: Mint, own: Issued, chain: Path | None = None) -> Appliance:
    files = {
        "cert_file": chain or own.certificate,
        "key_file": own.key,
        "ca_file": mint.authority.certificate,
    }
    return run(configuration(files, ANYONE))


def server(run: Run, mint: Mint, key: str = "P-256") -> Appliance:
    own = mint.make(by=mint.authority, name="server", extensions=[LOCALHOST], key=key)
    return served(run, mint, own)


def openssl_client(appliance: Appliance, client: Issued, *options: str, say: bytes = b"") -> str:
    host, port = address(appliance)
    shown = ("-cert", str(client.certificate), "-key", str(client.key))
    arguments = [tool("openssl"), "s_client", "-connect", f"{host}:{port}", *shown, *options]
    done = subprocess.run(arguments, input=say, capture_output=True, timeout=60, check=False)
    return (done.stdout + done.stderr).decode(errors="replace")


@pytest.mark.parametrize(
    ("key", "suite"),
    [("RSA", "ECDHE-RSA-AES128-GCM-SHA256"), ("P-256", "ECDHE-ECDSA-AES128-GCM-SHA256")],
)
def test_the_required_cipher_suites_and_the_curve_p_256(
    key: str, suite: str, run: Run, mint: Mint, client: Issued
) -> None:
    trust = context(mint.authority.certificate, client, "1.2")
    trust.set_ciphers(suite)
    trust.set_ecdh_curve("prime256v1")
    with Peer(address(server(run, mint, key)), trust) as peer:
        used = peer.shake().tls.cipher()
        assert used is not None
        assert used[0] == suite


@pytest.mark.parametrize(
    "suites",
    ["eNULL", "aNULL", "ECDHE-RSA-AES128-SHA:ECDHE-RSA-AES128-SHA256", "AES128-GCM-SHA256", "MD5"],
)
def test_suites_without_encryption_and_with_old_hashes_or_key_exchange_are_refused(
    suites: str, run: Run, mint: Mint, client: Issued, caplog: pytest.LogCaptureFixture
) -> None:
    appliance = server(run, mint, "RSA")
    trust = context(mint.authority.certificate, client, "1.2")
    try:
        trust.set_ciphers(f"{suites}:@SECLEVEL=0")
    except ssl.SSLError:
        pytest.skip("this OpenSSL has none of them either")
    assert verdict(appliance, trust).endswith("ALERT_HANDSHAKE_FAILURE")
    assert reasons(appliance, caplog) == ["no_common_version_or_cipher"]


@pytest.mark.parametrize("version", [0x0300, 0x0301, 0x0302])
def test_no_version_below_tls_1_2_is_negotiated(
    version: int, run: Run, mint: Mint, client: Issued, caplog: pytest.LogCaptureFixture
) -> None:
    appliance = server(run, mint)
    with Peer(address(appliance), context(mint.authority.certificate, client, "1.2")) as peer:
        hello = bytearray(peer.hello())
        hello[9:11] = struct.pack(">H", version)
        peer.wire.send(bytes(hello))
        alert = peer.wire.rest()
    assert alert == bytes([21, 3, 3, 0, 2, 2, 70])
    assert reasons(appliance, caplog) == ["no_common_version_or_cipher"]


def test_a_hello_of_ssl_2_is_refused(
    run: Run, mint: Mint, caplog: pytest.LogCaptureFixture
) -> None:
    appliance = server(run, mint)
    hello = b"\x01\x03\x03\0\x06\0\0\0\x10" + b"\0\xc0\x2b\0\x13\x01" + bytes(16)
    with wire.Connection(address(appliance)) as peer:
        peer.send(bytes([0x80, len(hello)]) + hello)
        peer.rest()
    assert reasons(appliance, caplog) == ["not_tls"]


@pytest.mark.parametrize("version", ["-tls1_2", "-tls1_3"])
def test_the_whole_chain_up_to_the_root_is_sent(
    version: str, run: Run, mint: Mint, client: Issued, tmp_path: Path
) -> None:
    between = mint.make(by=mint.authority, name="between", extensions=(CA, SIGNS))
    own = mint.make(by=between, name="server", extensions=[LOCALHOST])
    chain = tmp_path / "chain.pem"
    links = (own.certificate, between.certificate, mint.authority.certificate)
    chain.write_bytes(b"".join(link.read_bytes() for link in links))
    told = openssl_client(served(run, mint, own, chain), client, version, "-showcerts")
    assert told.count("BEGIN CERTIFICATE") == 3


def test_a_certificate_is_requested_and_the_accepted_authorities_are_named(
    run: Run, mint: Mint, client: Issued
) -> None:
    told = openssl_client(server(run, mint), client, "-tls1_2")
    assert "Acceptable client certificate CA names" in told
    assert "CN = authority" in told


def test_secure_renegotiation_is_indicated_and_renegotiation_is_refused(
    run: Run, mint: Mint, client: Issued
) -> None:
    appliance = server(run, mint)
    told = openssl_client(appliance, client, "-tls1_2")
    assert "Secure Renegotiation IS supported" in told
    assert "Compression: NONE" in told
    assert "no renegotiation" in openssl_client(appliance, client, "-tls1_2", say=b"R\n")
