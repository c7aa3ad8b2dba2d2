"""One judgement of certificates: every face gives the same answer to every certificate.

Devices show them to the blocking client, the asyncio client and the native poller; clients show
them to the listener, and to the HTTP services. So do receivers and senders of Raw Ingest packets.
The right answers are in the table of `support/certificate_cases.py`.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from holdfast import _core, raw_ingest
from holdfast.client.endpoint import endpoint, receiver_endpoint
from holdfast.client.url import Receiver, parse
from holdfast.events import log_lines
from holdfast.events.throttle import Throttle
from holdfast.net.tls import Tls
from support import native_poller, wire
from support.certificate_cases import ACCEPTED, CASES, KEYS, OWN_KEYS, SERVED, made
from support.certificates import Issued, openssl
from support.config_folder import written
from support.faces import FACES
from support.polled import Fake, data
from support.running import endpoint as endpoint_of
from support.secured import Relay, context
from support.tls_peer import (
    configuration,
    reasons,
    rest_configuration,
    rest_verdict,
    secure_reply,
    verdict,
)
from support.tls_peer import context as peer_context

if TYPE_CHECKING:
    from pathlib import Path

    from support.certificate_cases import Case, Mint, Shown
    from support.running import Run

    Address = tuple[str, int]

ANYONE: list[dict[str, Any]] = [{"sources": ["127.0.0.1"], "access": "read-only"}]
REFUSED = 0x8002


OPENSSL_REFUSES_WITH_TLS_1_2 = {
    "own, CA:TRUE and keyCertSign",
    "keyUsage nonRepudiation",
    "keyUsage keyCertSign",
}
"""A device with OpenSSL does not use these certificates of its own."""


@pytest.fixture(autouse=True)
def every_refusal_is_logged(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log_lines, "_REFUSALS", Throttle())


def read(face: str, url: str) -> str:
    """The answer of a client: `accepted`, or why TLS failed."""
    if face == "poller":
        return polled(url)
    client: Any = FACES[face](url, timeout=wire.DEADLINE)
    try:
        assert client.read_holding_registers(0, 1) == [7]
    except holdfast.TlsFailed as failed:
        return f"{failed.reason}, maybe sent" if failed.maybe_sent else failed.reason
    finally:
        client.end() if face == "asyncio" else client.close()
    return ACCEPTED


def refusal(url: str) -> str:
    """What is wrong with a device, in words."""
    with (
        holdfast.SyncClient(url, timeout=wire.DEADLINE) as client,
        pytest.raises(holdfast.TlsFailed) as raised,
    ):
        client.read_holding_registers(0, 1)
    return raised.value.detail


def polled(url: str) -> str:
    reads: Any = [("holding_registers", 0, 1, None)]
    options: dict[str, Any] = {"interval": 60, "timeout": wire.DEADLINE, "start_within": 0}
    poller = _core.Poller([])
    results = poller.new_receiver()
    device = _core.PolledDevice(
        "plc", endpoint(parse(url)), unit=1, reads=reads, receiver=results, **options
    )
    try:
        poller.add(device)
        taken = results.take(2 * wire.DEADLINE)
        assert taken is not None
        [(_, _, [(_, _, _, data, fault, _)])], _ = taken
    finally:
        poller.stop()
    if data is not None:
        assert data == b"\0\7"
        return ACCEPTED
    assert fault == REFUSED
    return "refused"


@pytest.fixture
def device(server: holdfast.Server, memory: holdfast.Memory) -> Address:
    """What is behind the TLS: a server of ours."""
    memory.write("holding_registers", 0, [7])
    return server.address


def expect(face: str, answer: str, reason: str) -> None:
    """The poller tells that it was refused, not why."""
    refused = "refused" if face == "poller" else reason
    assert answer == (ACCEPTED if reason == ACCEPTED else refused)


# Devices


@pytest.mark.parametrize("face", [*FACES, "poller"])
@pytest.mark.parametrize("case", CASES, ids=str)
def test_a_device_is_judged_alike_by_every_client(
    case: Case, face: str, mint: Mint, shown: dict[str, Shown], device: Address
) -> None:
    show = made(case, mint, shown)
    with Relay(device, context((show.chain, show.key), weak=True)) as relay:
        expect(face, read(face, relay.url(ca=show.trusted)), case.device)


def test_the_cases_that_openssl_refuses_are_in_the_table() -> None:
    assert {case.name for case in CASES} >= OPENSSL_REFUSES_WITH_TLS_1_2


@pytest.mark.parametrize(
    "case",
    [
        case
        for case in CASES
        if "RSA-PSS" not in case.name and case.name not in OPENSSL_REFUSES_WITH_TLS_1_2
    ],
    ids=str,
)
def test_a_device_is_judged_alike_with_tls_1_2(
    case: Case, mint: Mint, shown: dict[str, Shown], device: Address
) -> None:
    show = made(case, mint, shown)
    with Relay(device, context((show.chain, show.key), "TLS 1.2", weak=True)) as relay:
        expect("sync", read("sync", relay.url(ca=show.trusted)), case.device)


def test_rsa_pss_keys_need_tls_1_3(mint: Mint, device: Address) -> None:
    show = mint.signed(key="RSA-PSS")
    with Relay(device, context((show.chain, show.key), "TLS 1.2")) as relay:
        answer = refusal(relay.url(ca=show.trusted))
    assert "the certificate is not supported" in answer
    assert answer.endswith("RSA-PSS keys require TLS 1.3")


def test_the_salt_of_a_signature_is_told(mint: Mint, device: Address) -> None:
    [case] = [case for case in CASES if case.name == "signed by RSA-PSS with the longest salt"]
    show = case.show(mint)
    with Relay(device, context((show.chain, show.key))) as relay:
        answer = refusal(relay.url(ca=show.trusted))
    assert "RSASSA-PSS" in answer
    assert answer.endswith("a salt as long as the hash")


def packet_sent(face: str, address: Address, tls: Tls) -> str:
    """The answer of a sender of Raw Ingest packets, as that of `read`."""
    packet = raw_ingest.encode("coils", 0, [1], unit=1)
    options: dict[str, Any] = {"tls": tls, "timeout": wire.DEADLINE}
    try:
        if face == "sync":
            raw_ingest.send_packet_sync(*address, packet, **options)
        else:
            asyncio.run(raw_ingest.send_packet(*address, packet, **options))
    except raw_ingest.RawTlsFailed as failed:
        return f"{failed.reason}, maybe written" if failed.maybe_written else failed.reason
    return ACCEPTED


def forwarded(fake: Fake, receiver: Receiver) -> str:
    """The answer of a device whose reads are forwarded, as that of `read`."""
    to: Any = (receiver_endpoint(receiver), ("v1", "required", 1, wire.DEADLINE, [], None))
    reads: Any = [("coils", 0, 1, None)]
    poller = native_poller.ReportingPoller()
    try:
        poller.add(native_poller.device(fake, "plc", reads=reads, forward=[to]))

        def counted() -> dict[str, Any]:
            counters: dict[str, Any] = poller.counters()["plc"]["forward"][0]
            return counters

        wire.until(lambda: counted()["sent"] or counted()["failed"], "the packet has an outcome")
        return ACCEPTED if counted()["sent"] else str(counted()["reason"])
    finally:
        poller.stop()


@pytest.mark.parametrize("face", ["sync", "async", "forward"])
@pytest.mark.parametrize("case", CASES, ids=str)
def test_a_receiver_is_judged_alike_by_every_sender(
    case: Case, face: str, mint: Mint, shown: dict[str, Shown], run: Run
) -> None:
    show = made(case, mint, shown)
    rule = {"sources": ["127.0.0.1"], "units": {1: "plant"}, "areas": ["coils"]}
    raw = {"type": "raw-ingest", "bind": "127.0.0.1:0", "rules": [rule]}
    plain = run(written({"memories": {"plant": {"coils": 1}}, "listeners": {"raw": raw}}))
    with Relay(endpoint_of(plain, "raw"), context((show.chain, show.key), weak=True)) as relay:
        receiver = Receiver(*relay.address, Tls(ca=str(show.trusted)))
        if face == "forward":
            with Fake(data) as fake:
                answer = forwarded(fake, receiver)
        else:
            assert receiver.tls is not None
            answer = packet_sent(face, relay.address, receiver.tls)
    assert answer == case.device


# Clients


@pytest.fixture(scope="module")
def own(mint: Mint) -> Shown:
    """What the listener shows."""
    leaf = mint.make(by=mint.authority, extensions=["subjectAltName=DNS:localhost"])
    return mint.shown([leaf], [mint.authority])


def listener(own: Shown, trusted: Path) -> str:
    files = {"cert_file": own.chain, "key_file": own.key, "ca_file": trusted}
    return configuration(files, ANYONE)


def packets(own: Shown, trusted: Path) -> str:
    """As `listener`, for Raw Ingest packets."""
    files = {"cert_file": own.chain, "key_file": own.key, "ca_file": trusted}
    rules: list[dict[str, Any]] = [{"sources": ["127.0.0.1"], "areas": ["coils"]}]
    return configuration(files, rules, type="raw-ingest")


def listener_cases(version: str) -> list[Any]:
    return [
        pytest.param(case, version, id=f"{case}-{version}")
        for case in CASES
        if version == "1.3" or "RSA-PSS" not in case.name
    ]


@pytest.mark.parametrize(
    ("case", "version"), [each for version in ("1.2", "1.3") for each in listener_cases(version)]
)
def test_a_client_is_judged_alike_by_the_listener(
    case: Case,
    version: str,
    mint: Mint,
    shown: dict[str, Shown],
    own: Shown,
    run: Run,
    caplog: pytest.LogCaptureFixture,
) -> None:
    show = made(case, mint, shown)
    appliance = run(listener(own, show.trusted))
    client = Issued(show.chain, show.key)
    answer = verdict(appliance, peer_context(own.trusted, client, version, weak=True))
    if case.client == SERVED:
        assert answer == SERVED
    else:
        assert answer != SERVED
        assert reasons(appliance, caplog) == [case.client]


@pytest.mark.parametrize(
    ("case", "version"), [each for version in ("1.2", "1.3") for each in listener_cases(version)]
)
def test_a_sender_is_judged_alike_by_the_listener_for_packets(
    case: Case,
    version: str,
    mint: Mint,
    shown: dict[str, Shown],
    own: Shown,
    run: Run,
    caplog: pytest.LogCaptureFixture,
) -> None:
    show = made(case, mint, shown)
    appliance = run(packets(own, show.trusted))
    trust = peer_context(own.trusted, Issued(show.chain, show.key), version, weak=True)
    packet = raw_ingest.encode("coils", 0, [1], unit=1)
    reply = secure_reply(endpoint_of(appliance, "secure"), trust, packet)
    assert reply == (b"\0" if case.client == SERVED else b"")
    if case.client != SERVED:
        assert reasons(appliance, caplog) == [case.client]


def rest(own: Shown, trusted: Path) -> str:
    """As `listener`, for the REST service."""
    return rest_configuration(
        {"cert_file": own.chain, "key_file": own.key, "client_ca_file": trusted}
    )


@pytest.mark.parametrize(
    ("case", "version"), [each for version in ("1.2", "1.3") for each in listener_cases(version)]
)
def test_a_client_is_judged_alike_by_https(
    case: Case, version: str, mint: Mint, shown: dict[str, Shown], own: Shown, run: Run
) -> None:
    show = made(case, mint, shown)
    appliance = run(rest(own, show.trusted))
    trust = peer_context(own.trusted, Issued(show.chain, show.key), version, weak=True)
    assert rest_verdict(appliance, trust) == case.client


# What this side shows


@pytest.mark.parametrize("kind", OWN_KEYS)
@pytest.mark.parametrize("face", [*FACES, "poller"])
def test_a_client_shows_a_key_of_any_kind(
    face: str, kind: str, mint: Mint, device: Address
) -> None:
    plc, own = mint.signed(), mint.signed(key=kind)
    asking = context((plc.chain, plc.key), asks=mint.authority.certificate)
    with Relay(device, asking) as relay:
        url = relay.url(ca=plc.trusted, cert=own.chain, key=own.key)
        assert read(face, url) == ACCEPTED


@pytest.mark.parametrize("version", ["1.2", "1.3"])
@pytest.mark.parametrize("kind", OWN_KEYS)
def test_a_listener_shows_a_key_of_any_kind(kind: str, version: str, mint: Mint, run: Run) -> None:
    own = mint.signed("subjectAltName=DNS:localhost", key=kind)
    appliance = run(listener(own, own.trusted))
    client = peer_context(own.trusted, Issued(own.chain, own.key), version)
    if version == "1.2" and kind.startswith("RSA-PSS"):
        assert "ALERT" in verdict(appliance, client)
    else:
        assert verdict(appliance, client) == SERVED


@pytest.mark.parametrize("kind", OWN_KEYS)
def test_the_key_of_another_certificate_is_told(kind: str, mint: Mint, tmp_path: Path) -> None:
    own = mint.signed(key=kind)
    other = tmp_path / "other.key"
    algorithm, *options = KEYS[kind]
    openssl("genpkey", "-algorithm", algorithm, *options, "-out", other)
    for key, says in (
        (other, f"it is not the key of the certificate in {own.chain}"),
        (
            mint.root(key="P-256" if kind != "P-256" else "RSA").key,
            "it is not the key of|a key of ",
        ),
    ):
        with pytest.raises(ValueError, match=f"{key}: {says}"):
            holdfast.SyncClient(f"tls://plc?cert={own.chain}&key={key}")
