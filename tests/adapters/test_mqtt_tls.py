"""The MQTT adapter over TLS: whom it trusts, and what it shows of itself."""

from __future__ import annotations

import logging
import socket
import ssl
from typing import TYPE_CHECKING, Any

import pytest

from support import wire
from support.certificates import Certificates
from support.mqtt_rig import Rig, command, settings, text
from support.secured import Relay, context

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from support.brokers import Mosquitto
    from support.mqtt_rig import Running


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with Rig(tmp_path) as rig:
        yield rig


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Certificates:
    return Certificates(tmp_path_factory.mktemp("authority"))


@pytest.fixture(scope="module")
def stranger(tmp_path_factory: pytest.TempPathFactory) -> Certificates:
    return Certificates(tmp_path_factory.mktemp("stranger"), "stranger")


def secure(rig: Rig, authority: Certificates, name: str, *options: str) -> Mosquitto:
    """A broker with a certificate for this alternative name."""
    certificate, key = authority.issue("broker", name)
    return rig.broker(
        *("allow_anonymous true", f"cafile {authority.ca}"),
        *(f"certfile {certificate}", f"keyfile {key}", *options),
    )


def connect(rig: Rig, broker: Mosquitto, host: str = "127.0.0.1", **tls: Path) -> Running:
    url = f"mqtts://{host}:{broker.port}"
    return rig.run(settings(url, **({"tls": tls} if tls else {})))


def error(running: Running) -> str:
    """What it fails with, over and over."""
    wire.until(lambda: running.status()["last_error"] is not None, "it fails")
    assert not running.status()["connected"]
    assert running.alive
    return str(running.status()["last_error"])


@pytest.mark.parametrize(
    ("name", "host"), [("IP:127.0.0.1", "127.0.0.1"), ("DNS:localhost", "localhost")]
)
def test_a_broker_that_the_authority_vouches_for(
    rig: Rig, authority: Certificates, name: str, host: str
) -> None:
    broker = secure(rig, authority, name)
    running = connect(rig, broker, host, ca_file=authority.ca)
    running.wait_until_connected()

    broker.publish(
        *("plant/ingest", text(command([1])), "-q", "1"),
        *("--cafile", str(authority.ca), "--insecure"),
    )
    running.wait_until_received(1)

    assert rig.registers(0, 1) == [1]


def test_messages_of_many_records(rig: Rig, authority: Certificates) -> None:
    broker = secure(rig, authority, "IP:127.0.0.1")
    running = connect(rig, broker, ca_file=authority.ca)
    running.wait_until_connected()

    large = text(command([2], 1)).ljust(100_000)
    for payload in (large, text(command([3], 2))):
        broker.publish(
            *("plant/ingest", payload, "-q", "1"),
            *("--cafile", str(authority.ca), "--insecure"),
        )
    running.wait_until_received(2)

    assert rig.registers(0, 3) == [0, 2, 3]


def test_another_authority_is_not_trusted(
    rig: Rig, authority: Certificates, stranger: Certificates
) -> None:
    broker = secure(rig, authority, "IP:127.0.0.1")

    assert "the issuer of the certificate is unknown" in error(
        connect(rig, broker, ca_file=stranger.ca)
    )
    assert "New client connected" not in broker.log


def test_without_ca_file_only_those_that_the_system_trusts_are(
    rig: Rig, authority: Certificates
) -> None:
    broker = secure(rig, authority, "IP:127.0.0.1")

    assert "the issuer of the certificate is unknown" in error(connect(rig, broker))


@pytest.mark.parametrize(
    ("name", "host"),
    [("DNS:broker.example", "127.0.0.1"), ("IP:127.0.0.2", "127.0.0.1"), ("DNS:a.b", "localhost")],
)
def test_a_certificate_for_another_name_is_refused(
    rig: Rig, authority: Certificates, name: str, host: str
) -> None:
    broker = secure(rig, authority, name)

    assert "the certificate is for" in error(connect(rig, broker, host, ca_file=authority.ca))
    assert "New client connected" not in broker.log


def test_a_client_certificate(rig: Rig, authority: Certificates, stranger: Certificates) -> None:
    broker = secure(rig, authority, "IP:127.0.0.1", "require_certificate true")
    certificate, key = authority.issue("plant", "DNS:plant")
    running = connect(rig, broker, ca_file=authority.ca, cert_file=certificate, key_file=key)
    running.wait_until_connected()
    running.stop()

    assert error(connect(rig, broker, ca_file=authority.ca))
    certificate, key = stranger.issue("plant", "DNS:plant")
    foreign = connect(rig, broker, ca_file=authority.ca, cert_file=certificate, key_file=key)
    assert error(foreign)
    assert broker.log.count("New client connected") == 1


def test_a_key_with_a_passphrase_is_refused_and_nobody_is_asked_for_it(
    rig: Rig, authority: Certificates
) -> None:
    broker = secure(rig, authority, "IP:127.0.0.1")
    certificate, key = authority.issue("locked", "DNS:plant", "-passout", "pass:secret")

    running = connect(rig, broker, ca_file=authority.ca, cert_file=certificate, key_file=key)

    assert error(running)
    running.stop(1.0)


def test_a_file_that_is_missing_is_a_failure_until_it_is_there(
    rig: Rig, authority: Certificates, tmp_path: Path
) -> None:
    broker = secure(rig, authority, "IP:127.0.0.1")
    running = connect(rig, broker, ca_file=tmp_path / "later.pem")
    assert "No such file" in error(running)

    (tmp_path / "copy.pem").write_bytes(authority.ca.read_bytes())
    (tmp_path / "copy.pem").rename(tmp_path / "later.pem")

    running.wait_until_connected()


@pytest.mark.filterwarnings("ignore:ssl.TLSVersion.TLSv1_1 is deprecated:DeprecationWarning")
def test_nothing_below_tls_1_2(rig: Rig, authority: Certificates) -> None:
    old = context(authority.issue("broker", "IP:127.0.0.1"), "TLS 1.2", weak=True)
    old.minimum_version = old.maximum_version = ssl.TLSVersion.TLSv1_1
    with Relay(("127.0.0.1", rig.broker().port), old) as relay:
        url = f"mqtts://127.0.0.1:{relay.address[1]}"
        running = rig.run(settings(url, tls={"ca_file": authority.ca}))
        assert "no TLS version or cipher suite in common" in error(running)
        assert relay.agreed == 0


def test_plain_mqtt_to_a_tls_port_and_the_other_way_round(
    rig: Rig, authority: Certificates, tmp_path: Path
) -> None:
    broker = secure(rig, authority, "IP:127.0.0.1")
    assert error(rig.run(settings(broker.url)))

    (tmp_path / "plain").mkdir()
    with Rig(tmp_path / "plain") as other:
        assert error(connect(rig, other.broker(), ca_file=authority.ca))


def test_it_ends_at_once_in_a_handshake_that_goes_nowhere(
    rig: Rig, authority: Certificates, monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"mqtts://127.0.0.1:{silent.getsockname()[1]}"
        running = rig.run(settings(url, tls={"ca_file": authority.ca}))
        with silent.accept()[0] as connection:
            connection.settimeout(wire.DEADLINE)
            assert connection.recv(1) == b"\x16"  # a handshake has begun
            running.stop(1.0)
            assert running.status()["last_error"] is None

        monkeypatch.setattr("holdfast.net.mqtt.dial.CONNECT_TIMEOUT_S", 0.1)
        assert "no answer" in error(rig.run(settings(url, tls={"ca_file": authority.ca})))


def test_nothing_is_logged_but_the_reason(
    rig: Rig, authority: Certificates, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    broker = secure(rig, authority, "DNS:broker.example")

    running = connect(rig, broker, ca_file=authority.ca)
    wire.until(lambda: broker.log.count("New connection") >= 4, "several attempts")
    running.stop()

    told: list[Any] = [
        (record.getMessage(), record.fields)  # type: ignore[attr-defined]
        for record in caplog.records
    ]
    assert len(told) == 1
    event, fields = told[0]
    assert event == "mqtt_connect_failed"
    assert fields["broker"] == f"127.0.0.1:{broker.port}"
    assert "not for '127.0.0.1'" in fields["reason"]
