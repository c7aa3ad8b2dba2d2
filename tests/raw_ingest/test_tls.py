"""Raw Ingest over TLS: certificates, rights of roles, and the errors that senders get."""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
import ssl
import threading
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import pytest

from holdfast import raw_ingest
from holdfast.appliance import Appliance
from holdfast.cli.configuration import load_whole
from holdfast.client.url import Receiver, parse_receiver
from holdfast.config import ConfigError, load
from support import wire
from support.certificates import PAST, Certificates, Issued, named, openssl
from support.cli import invoke
from support.config_folder import written
from support.running import endpoint
from support.tls_peer import Peer as TlsPeer
from support.tls_peer import Refused, configuration, context, reasons, secure_reply

if TYPE_CHECKING:
    from pathlib import Path

    from support.running import Run

DONE, REFUSED = b"\x00", b"\x01"
CLIENT = "extendedKeyUsage=clientAuth"
AREAS = ["coils", "holding_registers"]
FLOOR = 256
"""The fewest handshakes that a listener has room for."""
PACKET = raw_ingest.encode("holding_registers", 0, [7], unit=1)
LONG = raw_ingest.encode("holding_registers", 0, range(65535), unit=1)
BY_ROLE: list[dict[str, Any]] = [
    {"sources": ["127.0.0.1"], "roles": ["line"], "areas": ["holding_registers"]},
    {"sources": ["127.0.0.1"], "roles": ["panel", ""], "areas": ["coils"]},
]

versions = pytest.mark.parametrize("version", ["1.2", "1.3"])
ways = pytest.mark.parametrize("way", ["sync", "async"])


class Party(NamedTuple):
    """An authority, a receiver that it vouches for, and senders with roles."""

    folder: Path
    authority: Certificates
    server: Issued
    line: Issued
    panel: Issued
    guest: Issued

    @property
    def files(self) -> dict[str, Any]:
        """The `tls` section of a listener."""
        return {
            "cert_file": self.server.certificate,
            "key_file": self.server.key,
            "ca_file": self.authority.ca,
        }

    def trust(self, issued: Issued | None, version: str | None = None) -> ssl.SSLContext:
        return context(self.authority.ca, issued, version)

    def tls(self, issued: Issued | None, **more: str) -> raw_ingest.Tls:
        own = ("", "") if issued is None else (str(issued.certificate), str(issued.key))
        return raw_ingest.Tls(str(self.authority.ca), own[0] or None, own[1] or None, **more)


@pytest.fixture(scope="module")
def party(tmp_path_factory: pytest.TempPathFactory) -> Party:
    folder = tmp_path_factory.mktemp("party")
    authority = Certificates(folder)

    def client(name: str, *extensions: str) -> Issued:
        return authority.issue(name, f"DNS:{name}", extensions=(CLIENT, *extensions))

    server = authority.issue("server", "DNS:localhost,IP:127.0.0.1")
    line, panel = client("line", named("line")), client("panel", named("panel"))
    return Party(folder, authority, server, line, panel, client("guest", named("guest")))


def secured(
    party: Party,
    rules: list[dict[str, Any]] = BY_ROLE,
    crl_file: Path | None = None,
    **settings: Any,
) -> str:
    """A configuration with one listener for packets, `secure`, for the memory `plant`."""
    files = party.files if crl_file is None else {**party.files, "crl_file": crl_file}
    listener = {
        "type": "raw-ingest",
        "bind": "127.0.0.1:0",
        "tls": {key: str(path) for key, path in files.items()},
        "rules": [{"units": {1: "plant"}, **rule} for rule in rules],
        **settings,
    }
    memories = {"plant": {"coils": 1000, "holding_registers": 65536}}
    return written({"memories": memories, "listeners": {"secure": listener}})


@pytest.fixture
def plant(run: Run, party: Party) -> Appliance:
    return run(secured(party))


def address(appliance: Appliance) -> tuple[str, int]:
    return endpoint(appliance, "secure")


def counted(appliance: Appliance, of: str = "packets") -> dict[str, Any]:
    counters: dict[str, Any] = appliance.diagnostics.stats()["listeners"]["secure"][of]
    return counters


def events(
    appliance: Appliance, caplog: pytest.LogCaptureFixture, event: str
) -> list[dict[str, Any]]:
    """The fields of the logged events of a kind, once there is one."""

    def logged() -> list[dict[str, Any]]:
        appliance.log_events(0.0)
        found = [record for record in caplog.records if record.message == event]
        return [record.fields for record in found]  # type: ignore[attr-defined]

    wire.until(logged, event)
    return logged()


def send(
    way: str,
    to: tuple[str, int],
    packet: bytes,
    tls: raw_ingest.Tls,
    timeout: float = wire.DEADLINE,
) -> None:
    if way == "sync":
        raw_ingest.send_packet_sync(to[0], to[1], packet, tls=tls, timeout=timeout)
    else:
        asyncio.run(raw_ingest.send_packet(to[0], to[1], packet, tls=tls, timeout=timeout))


@contextlib.contextmanager
def connected(party: Party, appliance: Appliance, issued: Issued) -> Any:
    """A TLS connection of a sender."""
    with (
        socket.create_connection(address(appliance), wire.DEADLINE) as plain,
        party.trust(issued).wrap_socket(plain, server_hostname="localhost") as client,
    ):
        yield client


# Listeners


@versions
@pytest.mark.parametrize("packet", [PACKET, LONG], ids=["short", "long"])
def test_a_packet_is_written_and_the_connection_ends_in_order(
    plant: Appliance, party: Party, version: str, packet: bytes
) -> None:
    assert secure_reply(address(plant), party.trust(party.line, version), packet) == DONE
    count = (len(packet) - 10) // 2
    expected = [7] if count == 1 else list(range(65535))
    assert plant.memories["plant"].read("holding_registers", 0, count) == expected
    assert counted(plant)["accepted"] == 1


def test_a_role_decides_what_may_be_written(plant: Appliance, party: Party) -> None:
    coil = raw_ingest.encode("coils", 0, [1], unit=1)
    replies = {
        (issued, packet): secure_reply(address(plant), party.trust(issued), packet)
        for issued in (party.line, party.panel)
        for packet in (PACKET, coil)
    }
    allowed = [(party.line, PACKET), (party.panel, coil)]
    assert [who for who, reply in replies.items() if reply == DONE] == allowed
    assert counted(plant)["refused"] == {"not_granted": 2}


def test_packets_of_a_role_that_no_rule_names_are_refused(
    plant: Appliance, party: Party, caplog: pytest.LogCaptureFixture
) -> None:
    assert secure_reply(address(plant), party.trust(party.guest), PACKET) == REFUSED
    assert counted(plant)["refused"] == {"not_granted": 1}
    assert counted(plant, "connections")["refused_role"] == 1
    [told] = events(plant, caplog, "refused_role")
    assert (told["role"], told["subject"]) == ("guest", "CN=guest")


def test_refusals_sessions_and_the_audit_log_name_the_sender(
    run: Run, party: Party, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    audit = tmp_path / "audit.jsonl"
    text = secured(party, compat={"packets": "many", "after_refusal": "continue"})
    plant = run(f'{text[:-1]}, "audit": {{"file": "{audit}"}}}}')
    with connected(party, plant, party.line) as client:
        client.sendall(raw_ingest.encode("coils", 0, [1], unit=1) + PACKET)
        replies = b""
        while len(replies) < 2:
            replies += client.recv(2)
        assert replies == REFUSED + DONE
        [refused] = events(plant, caplog, "packet_refused")
        [session] = plant.sessions()
        wire.until(lambda: audit.read_text().count('"secure"') == 2, "both are recorded")
    records = [json.loads(line) for line in audit.read_text().splitlines()]
    writes = [record for record in records if record.get("listener") == "secure"]
    for told in (refused, session, *writes):
        assert {key: told[key] for key in ("role", "subject")} == {
            "role": "line",
            "subject": "CN=line",
        }
        assert told["serial"]
    assert writes


def test_half_a_packet_and_half_a_record_end_in_time(
    run: Run, party: Party, caplog: pytest.LogCaptureFixture
) -> None:
    plant = run(secured(party, request_timeout=2, compat={"packets": "many"}))
    with (
        TlsPeer(address(plant), party.trust(party.line)) as half,
        connected(party, plant, party.line) as client,
    ):
        half.shake()
        half.wire.send(half.seal(PACKET)[:-3])
        client.sendall(PACKET[:5])
        assert client.recv(2) == REFUSED
        events(plant, caplog, "request_timeout")
    assert [told["reason"] for told in events(plant, caplog, "packet_refused")] == ["late"]
    assert counted(plant)["accepted"] == 0


def test_several_packets_are_answered_in_order_however_they_are_cut(run: Run, party: Party) -> None:
    plant = run(secured(party, compat={"packets": "many"}))
    with connected(party, plant, party.line) as client:
        client.sendall(PACKET * 3 + LONG)
        client.sendall(LONG[:70_000])
        client.sendall(LONG[70_000:] + PACKET[:3])
        client.sendall(PACKET[3:])
        replies = b""
        while len(replies) < 6:
            replies += client.recv(6)
        assert replies == DONE * 6
    wire.until(lambda: counted(plant, "connections")["open"] == 0, "it is gone")
    assert counted(plant)["held_bytes"] == 0


@versions
def test_bytes_behind_a_packet_are_counted_in_whatever_record_they_are(
    plant: Appliance, party: Party, version: str
) -> None:
    for records in ([PACKET + b"123"], [PACKET, b"123"], [PACKET[:5], PACKET[5:] + b"1", b"23"]):
        before = counted(plant)["surplus_bytes"]
        with TlsPeer(address(plant), party.trust(party.line, version)) as client:
            client.shake()
            for record in records:
                client.send(record)
            assert client.rest() == DONE
            # After the reply, which is the last one.
            client.send(b"45")
            client.wire.finish()
            wire.until(lambda: counted(plant, "connections")["open"] == 0, "it has ended")
        assert counted(plant)["surplus_bytes"] - before == 5
    assert counted(plant)["accepted"] == 3


@pytest.mark.parametrize("when_full", ["evict", "refuse"])
def test_silent_connections_displace_each_other_and_no_sender(
    run: Run, party: Party, when_full: str
) -> None:
    limits = {"max_connections": 4, "max_connections_per_source": None}
    settings: dict[str, Any] = {"compat": {"packets": "many"}, "when_full": when_full, **limits}
    plant = run(secured(party, **settings))
    with contextlib.ExitStack() as opened:
        client = opened.enter_context(connected(party, plant, party.line))
        client.sendall(PACKET)
        assert client.recv(1) == DONE
        silent = [opened.enter_context(wire.Connection(address(plant))) for _ in range(FLOOR + 7)]
        assert [each.rest() for each in silent[:7]] == [b""] * 7
        client.sendall(PACKET)
        assert client.recv(1) == DONE
        assert counted(plant, "connections")["evicted_handshakes"] == 7


def test_a_sender_that_no_rule_names_is_closed_before_a_byte(run: Run, party: Party) -> None:
    rules = [{"sources": ["127.0.0.9"], "areas": AREAS}]
    plant = run(secured(party, rules))
    with wire.Connection(address(plant)) as client:
        assert client.rest() == b""
    assert counted(plant, "connections")["refused_source"] == 1


def test_refusals_have_the_words_of_modbus_over_tls(
    party: Party, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Everything but certificates; those are in tests/tls/test_certificates.py."""
    stranger = Certificates(tmp_path, "stranger").issue("line", "DNS:line", extensions=[CLIENT])
    rules = [{"sources": ["127.0.0.1"], "access": "read-only"}]
    files: Any = party.files
    found: list[list[str]] = []
    for made in (partial(configuration, files, rules), partial(secured, party)):
        caplog.clear()
        with Appliance(_loaded(tmp_path, made(request_timeout=0.2))) as hasty:
            with wire.Connection(address(hasty)) as client:
                client.rest()
            told = reasons(hasty, caplog)
        caplog.clear()
        with Appliance(_loaded(tmp_path, made())) as appliance:
            to = address(appliance)
            with wire.Connection(to) as client:
                client.send(b"GET / HTTP/1.1\r\n\r\n")
                client.rest()
            told.append(reasons(appliance, caplog)[-1])
            with wire.Connection(to) as client:
                client.send(b"\x16\x03\x01")
                client.finish()
                client.rest()
            told.append(reasons(appliance, caplog, 2)[-1])
            for number, issued in enumerate((None, stranger), 3):
                secure_reply(to, party.trust(issued), PACKET)
                told.append(reasons(appliance, caplog, number)[-1])
            with TlsPeer(to, party.trust(party.line)) as altered:
                altered.shake()
                altered.wire.send(b"\x17\x03\x03\x00\x20" + bytes(32))
                with contextlib.suppress(Refused, ConnectionError):
                    altered.wire.rest()
            told.append(reasons(appliance, caplog, 5)[-1])
        found.append(told)
    assert (
        found[0]
        == found[1]
        == [
            "timeout",
            "not_tls",
            "closed_during_handshake",
            "no_certificate",
            "unknown_issuer",
            "bad_record",
        ]
    )


def _loaded(folder: Path, text: str) -> Any:
    file = folder / "appliance.yaml"
    file.write_text(text)
    return load(file)


# Reload


def test_a_reload_takes_new_certificates_and_ends_senders_that_are_revoked(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    authority = Certificates(tmp_path, "own")
    issued = [
        authority.issue(name, "DNS:localhost,IP:127.0.0.1", extensions=[named("line")])
        for name in ("one", "two", "server", "renewed")
    ]
    one, two, server, renewed = issued
    own = Party(tmp_path, authority, server, one, two, two)
    text = secured(own, compat={"packets": "many"})
    with Appliance(_loaded(tmp_path, text)) as plant, contextlib.ExitStack() as opened:
        first, second = (opened.enter_context(connected(own, plant, each)) for each in (one, two))
        for client in (first, second):
            client.sendall(PACKET)
            assert client.recv(1) == DONE
        revoked = authority.revoke(two)
        changed = Party(tmp_path, authority, renewed, one, two, two)
        text = secured(changed, compat={"packets": "many"}, crl_file=revoked)
        plant.reload(_loaded(tmp_path, text))
        assert second.recv(1) == b""
        first.sendall(PACKET)
        assert first.recv(1) == DONE
        assert counted(plant, "tls_failures") == {"revoked": 1}
        with connected(own, plant, one) as third:
            shown = ssl.DER_cert_to_PEM_cert(third.getpeercert(binary_form=True) or b"")
            assert shown.strip() in renewed.certificate.read_text()
        assert [told["reason"] for told in events(plant, caplog, "tls_failed")] == ["revoked"]


def test_the_same_files_with_other_contents_are_a_change(tmp_path: Path) -> None:
    authority = Certificates(tmp_path, "own")
    alternative = "DNS:localhost,IP:127.0.0.1"
    server, renewed = (authority.issue(name, alternative) for name in ("server", "renewed"))
    line = authority.issue("line", "DNS:line", extensions=[named("line")])
    own = Party(tmp_path, authority, server, line, line, line)
    config = _loaded(tmp_path, secured(own))
    with Appliance(config) as plant:
        server.certificate.write_bytes(renewed.certificate.read_bytes())
        server.key.write_bytes(renewed.key.read_bytes())
        assert plant.reload(_loaded(tmp_path, secured(own))) == ["listeners.secure"]


# Senders


@ways
def test_a_sender_over_tls_writes(plant: Appliance, party: Party, way: str) -> None:
    for packet in (PACKET, LONG):
        send(way, address(plant), packet, party.tls(party.line))
    assert counted(plant)["accepted"] == 2


def test_a_sender_over_tls_writes_in_uvloop(plant: Appliance, party: Party) -> None:
    uvloop = pytest.importorskip("uvloop", reason="there is none for Windows")
    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        for packet in (PACKET, LONG):
            to = address(plant)
            runner.run(raw_ingest.send_packet(*to, packet, tls=party.tls(party.line)))
    assert counted(plant)["accepted"] == 2


@ways
def test_a_sender_is_told_why_nothing_was_written(plant: Appliance, party: Party, way: str) -> None:
    to = address(plant)
    with pytest.raises(raw_ingest.RawRefused):
        send(way, to, PACKET, party.tls(party.guest))
    other = raw_ingest.Tls(str(party.line.certificate))
    for tls, reason in (
        (party.tls(party.line, name="elsewhere"), "wrong_name"),
        (other, "unknown_issuer"),
        (party.tls(None), "peer_requires_certificate"),
    ):
        with pytest.raises(raw_ingest.RawTlsFailed) as raised:
            send(way, to, PACKET, tls)
        assert (raised.value.reason, raised.value.maybe_written) == (reason, False)
        assert str(raised.value).endswith("; nothing was written")
    assert counted(plant)["accepted"] == 0


@ways
def test_a_receiver_that_is_silent_in_the_handshake_was_not_connected(
    party: Party, way: str
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        host, port = silent.getsockname()
        with pytest.raises(raw_ingest.RawTimeout, match="no connection within") as raised:
            send(way, (host, port), PACKET, party.tls(party.line), timeout=0.2)
    assert not raised.value.maybe_written


@ways
def test_a_receiver_that_leaves_before_its_reply_may_have_written(party: Party, way: str) -> None:
    """In order, without a closing message, or in the middle of the handshake."""
    trust = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    trust.load_cert_chain(*party.server)

    def serve(listening: socket.socket) -> None:
        connection, _ = listening.accept()
        with trust.wrap_socket(connection, server_side=True) as secured:
            secured.recv(100)
        connection, _ = listening.accept()
        with connection:
            connection.recv(100)

    with socket.create_server(("127.0.0.1", 0)) as listening:
        thread = threading.Thread(target=serve, args=(listening,))
        thread.start()
        with pytest.raises(raw_ingest.RawError) as raised:
            send(way, listening.getsockname(), PACKET, party.tls(None))
        assert raised.value.maybe_written
        with pytest.raises(raw_ingest.RawTlsFailed) as failed:
            send(way, listening.getsockname(), PACKET, party.tls(None))
        assert (failed.value.reason, failed.value.maybe_written) == (
            "closed_during_handshake",
            False,
        )
        thread.join()


@ways
def test_a_key_with_a_passphrase_and_files_that_can_not_be_used(
    plant: Appliance, party: Party, way: str, tmp_path: Path
) -> None:
    locked, secret = tmp_path / "locked.key", tmp_path / "secret"
    openssl("pkey", "-in", party.line.key, "-aes128", "-passout", "pass:sesame", "-out", locked)
    secret.write_text("sesame\n")
    own = Issued(party.line.certificate, locked)
    send(way, address(plant), PACKET, party.tls(own, key_passphrase_file=str(secret)))
    secret.write_text("simsim\n")
    with pytest.raises(ValueError, match=r"locked\.key"):
        send(way, address(plant), PACKET, party.tls(own, key_passphrase_file=str(secret)))
    with pytest.raises(OSError, match="absent"):
        send(way, address(plant), PACKET, raw_ingest.Tls(ca=str(tmp_path / "absent")))


def test_raw_send_takes_a_url(plant: Appliance, party: Party) -> None:
    port = address(plant)[1]
    query = party.tls(party.line).query
    url = f"raw+tls://127.0.0.1:{port}?{query}"
    arguments = ("holding_registers", "0", "41", "--unit", "1")
    done = invoke("raw-send", url, *arguments)
    assert (done.exit_code, done.stdout[:8]) == (0, "Written:")
    assert plant.memories["plant"].read("holding_registers", 0, 1) == [41]
    refused = invoke("raw-send", f"{url}&name=elsewhere", *arguments, "--json")
    told = json.loads(refused.stdout)
    assert refused.exit_code == 1
    assert (told["reason"], told["tls"], told["maybe_written"]) == (
        "connection",
        "wrong_name",
        False,
    )
    wrong = invoke("raw-send", f"raw+tls://127.0.0.1:{port}?ca=absent.pem", *arguments)
    assert (wrong.exit_code, "absent.pem" in wrong.stderr) == (2, True)


@pytest.mark.parametrize(
    ("url", "found"),
    [
        ("raw://10.0.2.9:9000", Receiver("10.0.2.9", 9000)),
        ("raw://[fd00::9]:9000", Receiver("fd00::9", 9000)),
        ("raw+tls://plant:9000", Receiver("plant", 9000, raw_ingest.Tls())),
        (
            "raw+tls://plant:9000?ca=a%20b.pem&cert=c&key=k&key_passphrase_file=p&name=n",
            Receiver("plant", 9000, raw_ingest.Tls("a b.pem", "c", "k", "n", "p")),
        ),
    ],
)
def test_urls_of_receivers(url: str, found: Receiver) -> None:
    assert parse_receiver(url) == found


@pytest.mark.parametrize(
    ("url", "wrong"),
    [
        ("raw+tls://plant", "allowed: raw://10.0.2.9:9000 or"),
        ("raw+tls://plant:0", "port 0, allowed: 1 to 65535"),
        ("raw+tls://plant:", "port '', allowed: 1 to 65535"),
        ("raw://10.0.2.09:9000", "the host is '10.0.2.09', allowed: a host name"),
        ("raw://plant:9000 ", "allowed: raw://10.0.2.9:9000 or"),
        ("raw+tls://plant:9000/x?ca=a", "allowed: raw://10.0.2.9:9000 or"),
        ("raw+tls://u@plant:9000", "allowed: raw://10.0.2.9:9000 or"),
        ("tls://plant:9000", "allowed: raw://10.0.2.9:9000 or"),
        ("raw://plant:9000?ca=a", "unknown option 'ca'"),
        ("raw+tls://plant:9000?unit=1", "unknown option 'unit', allowed: ca, cert, key"),
        ("raw+tls://plant:9000?pause=1", "unknown option 'pause', allowed: ca, cert, key"),
        ("raw+tls://plant:9000?cert=c", "cert without key"),
        ("raw+tls://plant:9000?key_passphrase_file=c", "key_passphrase_file without key"),
    ],
)
def test_urls_that_name_no_receiver(url: str, wrong: str) -> None:
    with pytest.raises(ValueError, match=r"raw|tls") as raised:
        parse_receiver(url)
    assert wrong in str(raised.value)
    assert "--unit" not in str(raised.value)


# What is checked before anything starts


def test_files_of_listeners_and_receivers_are_checked(party: Party, tmp_path: Path) -> None:
    expired = party.authority.issue("expired", "DNS:old", dates=PAST)
    device: dict[str, Any] = {
        "url": "tcp://127.0.0.1:9",
        "unit": 1,
        "interval": 1,
        "reads": [{"area": "coils", "address": 0, "count": 1}],
    }
    file = tmp_path / "plant.yaml"

    def forward_to(ca: object) -> None:
        forward = [{"url": f"raw+tls://127.0.0.1:9?ca={ca}", "unit": 1}]
        file.write_text(written({"devices": {"plc": {**device, "forward": forward}}}))

    forward_to(party.line.key)
    with pytest.raises(ConfigError, match=r"devices.plc.forward\[0\].url: .*certificate"):
        load_whole(file)
    forward_to("absent.pem")
    with pytest.raises(ConfigError, match=r"ca='absent\.pem', which can't be read"):
        load(file)
    forward_to(expired.certificate)
    [warning] = [str(each) for each in load_whole(file).warnings if "expired" in str(each)]
    assert "devices.plc.forward[0].url" in warning

    file.write_text(secured(party).replace(str(party.server.key), str(party.line.key)))
    with pytest.raises(ConfigError, match=r"listeners.secure.tls: .* is not the key"):
        load_whole(file)


def test_keys_of_tls_without_tls_are_errors(party: Party, tmp_path: Path) -> None:
    text = secured(party).replace('"tls":', '"not_tls":')
    file = tmp_path / "plant.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError) as raised:
        load(file)
    problems = [str(problem) for problem in raised.value.problems]
    for place in ("rules[0].roles", "rules[1].roles"):
        wrong = f"listeners.secure.{place}: found without tls, allowed: only with it"
        assert any(wrong in problem for problem in problems)


def test_check_as_tells_what_a_role_may_write(party: Party, tmp_path: Path) -> None:
    file = tmp_path / "plant.yaml"
    file.write_text(secured(party))
    found = {
        role: invoke("check", str(file), "--as", "127.0.0.1", "--role", role).stdout
        for role in ("line", "guest")
    }
    assert "holding registers" in found["line"]
    assert "every packet is refused" in found["guest"]
