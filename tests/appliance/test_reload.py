"""A reload changes what the new configuration changes, and nothing else."""

from __future__ import annotations

import hashlib
import http.client
import json
import logging
import socket
import termios
import threading
import urllib.error
import urllib.request
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from holdfast import _core, raw_ingest
from holdfast.appliance import Appliance, reload
from holdfast.appliance.parts.mirrors import Mirrors
from holdfast.appliance.reload import (
    ReloadIncomplete,
    ReloadRefused,
    differences,
    fingerprints,
    restart_reasons,
)
from holdfast.config import Config, load
from support import web, wire
from support.certificates import Certificates, Issued, named
from support.config_folder import written
from support.fake_device import Stream, registers, silent
from support.lines import Terminal
from support.routed import Held
from support.running import endpoint, log_events
from support.tls_peer import Peer, Refused, context

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from holdfast.config import Config
    from support.fake_device import Behaviour
    from support.running import Connect, Serve

READ = bytes.fromhex("0300070001")
WRITE = bytes.fromhex("060007002a")
READ_42 = bytes.fromhex("0302002a")
FORBIDDEN = bytes.fromhex("8601")

Settings = dict[str, Any]


def rule(*sources: str, **more: Any) -> Settings:
    return {"sources": list(sources), "units": {1: "plant"}, "access": "read-write", **more}


def listener(*rules: Settings, **more: Any) -> Settings:
    return {"type": "modbus-tcp", "bind": "127.0.0.1:0", "rules": list(rules), **more}


def plant(**more: Any) -> Settings:
    """A memory that one listener serves."""
    return {
        "memories": {"plant": {"holding_registers": 100, "coils": 8}},
        "listeners": {"scada": listener(rule("127.0.0.0/8"))},
        **more,
    }


class Rig:
    """An appliance, and the file of its configuration."""

    def __init__(self, folder: Path) -> None:
        self.file = folder / "plant.yaml"
        self.appliance: Appliance

    def load(self, settings: Settings) -> Any:
        self.file.write_text(written(settings))
        return load(self.file)

    def start(self, settings: Settings) -> Appliance:
        self.appliance = Appliance(self.load(settings)).start()
        return self.appliance

    def reload(self, settings: Settings) -> list[str]:
        return self.appliance.reload(self.load(settings))

    def address(self, name: str = "scada") -> tuple[str, int]:
        return endpoint(self.appliance, name)

    def counted(self, name: str = "scada") -> dict[str, Any]:
        counters: dict[str, Any] = self.appliance.diagnostics.stats()["listeners"][name]
        return counters


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    made = Rig(tmp_path)
    yield made
    if hasattr(made, "appliance"):
        made.appliance.stop()


def is_closed(client: wire.Connection) -> bool:
    """Waits for the end of a connection."""
    try:
        return client.rest() == b""
    except ConnectionResetError:
        return True


def test_an_open_connection_has_its_new_rights_before_its_next_request(
    rig: Rig, connect: Connect
) -> None:
    rig.start(plant())
    with connect(rig.address()) as client:
        assert client.ask(WRITE) == WRITE
        less = listener(rule("127.0.0.0/8", access="read-only"))
        assert rig.reload(plant(listeners={"scada": less})) == ["listeners.scada"]
        assert client.ask(WRITE) == FORBIDDEN
        assert client.ask(READ) == READ_42
        rig.reload(plant())
        assert client.ask(WRITE) == WRITE
    assert rig.counted()["connections"]["accepted"] == 1


def test_connections_without_rights_are_ended_and_the_others_stay(
    rig: Rig, connect: Connect, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "holdfast")
    rig.start(plant(listeners={"scada": listener(rule("127.0.0.1"), rule("127.0.0.2"))}))
    stays, goes = connect(rig.address()), connect(rig.address(), source="127.0.0.2")
    assert stays.ask(WRITE) == goes.ask(WRITE) == WRITE
    goes.send(wire.frame(READ, 1, 1)[:5])
    rig.reload(plant(listeners={"scada": listener(rule("127.0.0.1"))}))
    assert is_closed(goes)
    assert stays.ask(READ) == READ_42
    connections = rig.counted()["connections"]
    assert (connections["open"], connections["rights_revoked"]) == (1, 1)
    with connect(rig.address(), source="127.0.0.2") as again:
        assert is_closed(again)
    rig.appliance.log_events(0)
    (ended,) = [record for record in caplog.records if record.message == "rights_revoked"]
    assert vars(ended)["fields"]["peer"].startswith("127.0.0.2:")


def test_timeouts_and_limits_change(rig: Rig, connect: Connect) -> None:
    rig.start(plant())
    first = connect(rig.address())
    assert first.ask(WRITE) == WRITE
    short = listener(rule("127.0.0.0/8"), max_connections=1, idle_timeout=0.05)
    rig.reload(plant(listeners={"scada": short}))
    with connect(rig.address()) as second:
        assert is_closed(second), "the limit holds for new connections"
    assert first.ask(READ) == READ_42
    assert is_closed(first), "after its next request, the new idle timeout holds"


def test_listeners_come_go_and_move(rig: Rig, connect: Connect) -> None:
    rig.start(plant())
    other = listener(rule("127.0.0.0/8", access="read-only"))
    client = connect(rig.address())
    changed = rig.reload(plant(listeners={"other": other, **plant()["listeners"]}))
    assert changed == ["listeners.other"]
    assert client.ask(WRITE) == WRITE
    second = connect(rig.address("other"))
    assert second.ask(WRITE) == FORBIDDEN
    assert [each.name for each in rig.appliance.endpoints()] == ["other", "scada"]
    rig.reload(plant())
    assert is_closed(second)
    assert client.ask(READ) == READ_42

    with socket.create_server(("127.0.0.1", 0)) as taken:
        host, port = taken.getsockname()
    before = rig.address()
    moved = listener(rule("127.0.0.0/8"), bind=f"{host}:{port}")
    rig.reload(plant(listeners={"scada": moved}))
    assert is_closed(client)
    assert connect(rig.address()).ask(READ) == READ_42
    assert rig.address() == (host, port)
    with pytest.raises(ConnectionRefusedError):
        connect(before)


def test_an_address_in_use_leaves_everything_as_it_was(rig: Rig, connect: Connect) -> None:
    rig.start(plant())
    client = connect(rig.address())
    with socket.create_server(("127.0.0.1", 0)) as taken:
        host, port = taken.getsockname()
        new = {
            "scada": listener(rule("127.0.0.0/8", access="read-only")),
            "second": listener(rule("127.0.0.0/8")),
            "third": listener(rule("127.0.0.0/8"), bind=f"{host}:{port}"),
        }
        with pytest.raises(OSError, match=f"listener third: can't listen on {host}:{port}"):
            rig.reload(plant(listeners=new))
    assert client.ask(WRITE) == WRITE
    assert [each.name for each in rig.appliance.endpoints()] == ["scada"]
    assert list(rig.appliance.config.listeners) == ["scada"]


def test_a_refused_reload_leaves_a_serial_line_as_it_was(rig: Rig, tmp_path: Path) -> None:
    terminal = Terminal(tmp_path / "line")

    def line(**serial: Any) -> Settings:
        rules = [{"units": {1: "plant"}, "access": "read-write"}]
        settings = {"device": str(terminal.device), "parity": "none", **serial}
        return {"type": "modbus-rtu", "serial": settings, "rules": rules}

    rig.start(plant(listeners={"line": line(baud=19200, stop_bits=2)}))
    before = termios.tcgetattr(terminal.end)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        host, port = taken.getsockname()
        other = listener(rule("127.0.0.0/8"), bind=f"{host}:{port}")
        with pytest.raises(OSError, match=f"listener scada: can't listen on {host}:{port}"):
            rig.reload(plant(listeners={"line": line(baud=9600, stop_bits=1), "scada": other}))
    assert termios.tcgetattr(terminal.end) == before
    rig.reload(plant(listeners={"line": line(baud=9600, stop_bits=1)}))
    assert termios.tcgetattr(terminal.end) != before
    rig.appliance.stop()
    terminal.close()


def test_another_framing_ends_the_connections(rig: Rig, connect: Connect) -> None:
    rig.start(plant())
    client = connect(rig.address())
    assert client.ask(WRITE) == WRITE
    rtu = listener(rule("127.0.0.0/8")) | {"type": "modbus-rtu-over-tcp"}
    rig.reload(plant(listeners={"scada": rtu}))
    assert is_closed(client)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (
            {"memories": {"plant": {"holding_registers": 101, "coils": 8}}},
            "memories.plant: areas or seal changed; requires a restart",
        ),
        (
            {
                "memories": {"other": {"holding_registers": 100}},
                "listeners": {"scada": listener(rule("127.0.0.0/8", units={1: "other"}))},
            },
            "memories.plant: removed; its values would be lost; requires a restart",
        ),
        ({"workers": 2}, "workers: changed; requires a restart"),
    ],
)
def test_what_requires_a_restart_is_refused(
    rig: Rig, connect: Connect, change: Settings, reason: str
) -> None:
    rig.start(plant())
    client = connect(rig.address())
    with pytest.raises(ReloadRefused) as refused:
        rig.reload(plant() | change)
    assert refused.value.reasons == [reason]
    assert client.ask(WRITE) == WRITE


LINK_CHANGED = "links.line: settings of a connection in use changed"
DEVICE_CHANGED = (
    "devices.pump: in_flight, retry, tolerance or serial settings of a connection in use changed"
)


def test_each_section_is_replaced_or_compared_by_a_reload() -> None:
    replaced = {*reload.SECTIONS, *reload.NAMED_SECTIONS}
    assert replaced | {"logs", "workers", "audit", "profiles"} == Config.model_fields.keys()


def test_each_reason_for_a_restart_is_told_in_the_order_of_the_docs(rig: Rig) -> None:
    def config(number: int) -> Config:
        kept = {"coils": 8, "keep": {"file": f"{number}.hfm"}}
        device = {"url": "tcp://10.0.0.2", "interval": 1, "in_flight": number}
        settings = {
            "memories": {"plant": {"coils": 8 * number}, "kept": kept, f"only{number}": kept},
            "listeners": {"scada": listener(rule("127.0.0.0/8"))},
            "workers": number,
            "audit": {"file": f"{number}.log"},
            "links": {"line": {"url": "tcp://10.0.0.1", "queue": number}},
            "devices": {"pump": device},
        }
        found: Config = rig.load(settings)
        return found

    assert list(restart_reasons(config(1), config(1))) == []
    assert list(restart_reasons(config(1), config(2))) == [
        "memories.plant: areas or seal changed",
        "memories.kept: keep changed",
        "memories.only1: removed; its values would be lost",
        "memories.only2: added with keep or replicate",
        "workers: changed",
        "audit: changed",
        LINK_CHANGED,
        DEVICE_CHANGED,
    ]


@pytest.mark.parametrize(
    ("before", "now", "is_refused"),
    [
        ("rtu:///dev/ttyS9?baud=9600", "rtu:///dev/ttyS9?baud=19200", True),
        ("rtu:///dev/ttyS9", "rtu:///dev/ttyS9?parity=none", True),
        ("rtu:///dev/ttyS9", "ascii:///dev/ttyS9", True),
        ("rtu:///dev/ttyS9", "rtu:///dev/ttyS9?pad=1", True),
        ("tcp://plc.local", "tcp://plc.local?pause=1", True),
        ("tcp://plc.local", "tcp://PLC.local:502?retries=1", True),
        ("tcp://plc.local", "tcp://PLC.local:502", False),
        ("rtu:///dev/ttyS9", "rtu:///dev/ttyS9?baud=19200&parity=even", False),
        ("rtu:///dev/ttyS9", "rtu:///dev/ttyS8?baud=9600", False),
        ("tcp://plc.local:802", "tls://plc.local:802?pause=1", False),
    ],
)
def test_options_in_the_url_of_a_connection_in_use_require_a_restart(
    rig: Rig, before: str, now: str, *, is_refused: bool
) -> None:
    def reasons(before: Settings, now: Settings) -> list[str]:
        return list(restart_reasons(rig.load(plant(**before)), rig.load(plant(**now))))

    def device(url: str, **more: Any) -> Settings:
        return {"devices": {"pump": {"url": url, "interval": 1, **more}}}

    def link(url: str) -> Settings:
        return {"links": {"line": {"url": url}}}

    refused = [DEVICE_CHANGED] if is_refused else []
    assert reasons(device(before), device(now)) == refused
    assert reasons(link(before), device(now)) == refused
    assert reasons(device(before, enabled=False), device(now)) == []
    assert reasons(device(before), device(now, enabled=False)) == []
    refused = [LINK_CHANGED] if is_refused else []
    assert reasons(link(before), link(now)) == refused
    assert reasons(device(before), link(now)) == refused
    # A device at the address of a link has the settings of the link.
    assert reasons(link(before) | device(before), link(before) | device(before)) == []


def test_another_name_of_a_serial_line_in_use_requires_a_restart(rig: Rig, tmp_path: Path) -> None:
    line, by_id, other = (tmp_path / name for name in ("line", "by-id", "other"))
    line.touch()
    other.touch()
    by_id.symlink_to(line)

    def config(path: Path, kind: str = "devices") -> Config:
        device = {"url": f"rtu://{path}", **({"interval": 1} if kind == "devices" else {})}
        found: Config = rig.load(plant(**{kind: {"pump": device}}))
        return found

    for kind in ("devices", "links"):
        reasons = list(restart_reasons(config(line), config(by_id, kind)))
        assert reasons == [f"{kind}.pump: another name of a serial line in use"]
        assert list(restart_reasons(config(line), config(other, kind))) == []
    by_id.unlink()
    by_id.symlink_to(other)  # The adapters have exchanged their names.
    assert list(restart_reasons(config(by_id), config(by_id))) == []


@pytest.mark.parametrize(
    "setting",
    [
        {"queue": 7},
        {"priority": {"10.0.0.9": "high"}},
        {"coalesce": False},
        {"cache": 60},
    ],
    ids=lambda setting: next(iter(setting)),
)
def test_routes_in_use_keep_the_settings_of_their_link(rig: Rig, setting: Settings) -> None:
    url = "tcp://10.0.0.1"

    def config(link: Settings | None, *routes: str) -> Config:
        links = {} if link is None else {"links": {"line": {"url": url, **link}}}
        units = {1: "plant", **{at: {"route": name} for at, name in enumerate(routes, 2)}}
        found: Config = rig.load(
            plant(
                listeners={"scada": listener(rule("127.0.0.0/8", units=units))},
                devices={"pump": {"url": url, "interval": 1}},
                **links,
            )
        )
        return found

    alone, linked = config(None, "pump"), config(setting, "pump")
    defaults, unrouted = config({}, "pump"), config(None)
    for before, now in [(alone, linked), (linked, alone), (defaults, linked), (linked, defaults)]:
        assert list(restart_reasons(before, now)) == [LINK_CHANGED]
    for before, now in [(alone, defaults), (defaults, alone), (unrouted, linked)]:
        assert list(restart_reasons(before, now)) == []
    assert list(restart_reasons(linked, unrouted)) == []
    assert list(restart_reasons(linked, config(setting))) == []


def test_options_that_move_from_the_url_to_the_tolerance_change_nothing(rig: Rig) -> None:
    def config(url: str, **more: Any) -> Any:
        return rig.load(plant(devices={"pump": {"url": url, "interval": 1, **more}}))

    before = config("tcp://plc.local?pause=1")
    now = config("tcp://plc.local", tolerance={"pause": 1})
    assert list(restart_reasons(before, now)) == []


def test_memories_are_added_and_initial_values_are_not_written_again(
    rig: Rig, connect: Connect
) -> None:
    rig.start(plant())
    client = connect(rig.address())
    assert client.ask(WRITE) == WRITE
    (rig.file.parent / "values.csv").write_text("holding_registers,7,9\n")
    area = {"holding_registers": 100, "coils": 8, "initial": "values.csv"}
    both = listener(rule("127.0.0.0/8", units={1: "plant", 2: "new"}))
    new = {"memories": {"plant": area, "new": area}, "listeners": {"scada": both}}
    assert rig.reload(new) == ["listeners.scada", "memories.new", "memories.plant"]
    assert client.ask(READ) == READ_42
    assert client.ask(READ, unit=2) == bytes.fromhex("03020009")
    assert set(rig.appliance.diagnostics.memories()) == {"plant", "new"}


def test_the_identification_changes(rig: Rig, connect: Connect) -> None:
    rig.start(plant(identity={"vendor_name": "before"}))
    client = connect(rig.address())
    assert b"before" in client.ask(bytes.fromhex("2b0e0100"))
    assert rig.reload(plant(identity={"vendor_name": "after"})) == ["identity"]
    assert b"after" in client.ask(bytes.fromhex("2b0e0100"))


def test_rules_of_datagrams_change(rig: Rig) -> None:
    udp = listener(rule("127.0.0.1")) | {"type": "modbus-udp"}
    rig.start(plant(listeners={"scada": udp}))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.settimeout(wire.DEADLINE)
        client.connect(rig.address())
        client.send(wire.frame(WRITE, 1, 1))
        assert client.recv(300) == wire.frame(WRITE, 1, 1)
        less = listener(rule("127.0.0.1", access="read-only")) | {"type": "modbus-udp"}
        rig.reload(plant(listeners={"scada": less}))
        client.send(wire.frame(WRITE, 1, 2))
        assert client.recv(300) == wire.frame(FORBIDDEN, 1, 2)


def test_a_raw_ingest_connection_has_its_new_rights_before_its_next_packet(rig: Rig) -> None:
    def packets(*areas: str) -> Settings:
        grant = {"sources": ["127.0.0.1"], "units": {1: "plant"}, "areas": list(areas)}
        return {
            "raw": {
                "type": "raw-ingest",
                "bind": "127.0.0.1:0",
                "compat": {"packets": "many", "after_refusal": "continue"},
                "rules": [grant],
            }
        }

    rig.start(plant(listeners=packets("coils")))
    packet = raw_ingest.encode("coils", 0, [True], unit=1)
    with socket.create_connection(rig.address("raw"), wire.DEADLINE) as sender:
        sender.sendall(packet)
        assert sender.recv(1) == b"\0"
        rig.reload(plant(listeners=packets("holding_registers")))
        sender.sendall(packet)
        assert sender.recv(1) == b"\1"
        rig.reload(plant(listeners=packets("coils", "holding_registers")))
        sender.sendall(packet)
        assert sender.recv(1) == b"\0"


# TLS


class Party:
    def __init__(self, folder: Path) -> None:
        self.authority = Certificates(folder)
        self.server = self.authority.issue("server", "DNS:localhost,IP:127.0.0.1")
        self.engineer = self._client("engineer")
        self.laptop = self._client("laptop")
        self.lost = self._client("lost")
        self.crl = folder / "revoked.pem"
        self.crl.write_bytes(self.authority.revoke().read_bytes())

    def _client(self, name: str) -> Issued:
        extensions = ("extendedKeyUsage=clientAuth", named(name))
        return self.authority.issue(name, f"DNS:{name}", extensions=extensions)

    def settings(self, *roles: str) -> Settings:
        files = {
            "cert_file": self.server.certificate,
            "key_file": self.server.key,
            "ca_file": self.authority.ca,
            "crl_file": self.crl,
        }
        own = [rule("127.0.0.1", roles=[role]) for role in roles]
        tls = {key: str(file) for key, file in files.items()}
        return plant(listeners={"scada": listener(*own, tls=tls) | {"type": "modbus-tls"}})


@pytest.fixture(scope="module")
def party(tmp_path_factory: pytest.TempPathFactory) -> Party:
    return Party(tmp_path_factory.mktemp("party"))


def secured(rig: Rig, party: Party, issued: Issued) -> Peer:
    return Peer(rig.address(), context(party.authority.ca, issued)).shake()


def test_a_revoked_client_is_ended_and_the_others_stay(
    rig: Rig, party: Party, caplog: pytest.LogCaptureFixture
) -> None:
    rig.start(party.settings("engineer", "lost"))
    with secured(rig, party, party.engineer) as stays, secured(rig, party, party.lost) as goes:
        assert stays.ask(WRITE) == goes.ask(WRITE) == WRITE
        party.crl.write_bytes(party.authority.revoke(party.lost).read_bytes())
        assert rig.reload(party.settings("engineer", "lost")) == ["listeners.scada"]
        with pytest.raises((Refused, ConnectionError)):
            goes.ask(READ)
        assert stays.ask(READ) == READ_42
        trust = context(party.authority.ca, party.lost)
        with Peer(rig.address(), trust) as again, pytest.raises((Refused, ConnectionError)):
            again.shake().ask(READ)
    log_events(rig.appliance)
    fields = [vars(each)["fields"] for each in caplog.records if each.message == "tls_failed"]
    assert (fields[0]["reason"], fields[0]["role"]) == ("revoked", "lost")


def test_an_expired_certificate_ends_its_open_session(
    rig: Rig, party: Party, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("holdfast.appliance.appliance.CHECK_INTERVAL_S", 0.0)
    extensions = ("extendedKeyUsage=clientAuth", named("laptop"))
    settings = party.settings("engineer", "laptop")
    settings["listeners"]["scada"]["tls"]["review"] = 0.01
    rig.start(settings)

    def open_roles() -> list[str]:
        rig.appliance.log_events(0.01)
        return [each["role"] for each in rig.appliance.sessions()]

    def is_ended_by_expiry(stack: ExitStack, life_s: int) -> bool:
        """Whether a session began before its certificate expired, and then was ended."""
        expiry = datetime.now(UTC).replace(microsecond=0) + timedelta(seconds=life_s)
        dates = ("20200101000000Z", expiry.strftime("%Y%m%d%H%M%SZ"))
        guest = party.authority.issue("guest", "DNS:guest", extensions=extensions, dates=dates)
        trust = context(party.authority.ca, guest)
        goes = stack.enter_context(Peer(rig.address(), trust))
        try:
            assert goes.shake().ask(WRITE) == WRITE
        except (Refused, ConnectionError):
            return False
        wire.until(lambda: open_roles() == ["engineer"], "the session is ended")
        assert datetime.now(UTC) >= expiry
        return True

    with secured(rig, party, party.engineer) as stays, ExitStack() as opened:
        assert stays.ask(WRITE) == WRITE
        # A loaded machine may begin the session too late.
        assert any(is_ended_by_expiry(opened, life_s) for life_s in (2, 4, 8, 16))
        assert stays.ask(READ) == READ_42


def test_a_role_that_loses_its_rule_ends_its_sessions(rig: Rig, party: Party) -> None:
    rig.start(party.settings("engineer", "laptop"))
    with secured(rig, party, party.engineer) as stays, secured(rig, party, party.laptop) as goes:
        assert stays.ask(WRITE) == goes.ask(WRITE) == WRITE
        rig.reload(party.settings("engineer"))
        with pytest.raises((Refused, ConnectionError)):
            goes.ask(READ)
        assert stays.ask(READ) == READ_42
        with secured(rig, party, party.laptop) as again:
            assert again.ask(READ) == bytes.fromhex("8301"), "a new session has no rights"
            rig.reload(party.settings("engineer"))
            assert again.ask(READ) == bytes.fromhex("8301"), "it has lost nothing"


def test_renewed_certificates_serve_the_next_connection(
    rig: Rig, party: Party, tmp_path: Path
) -> None:
    settings = party.settings("engineer")
    copies = {"cert_file": tmp_path / "own.pem", "key_file": tmp_path / "own.key"}
    tls = settings["listeners"]["scada"]["tls"]

    def install(issued: Issued) -> None:
        copies["cert_file"].write_bytes(issued.certificate.read_bytes())
        copies["key_file"].write_bytes(issued.key.read_bytes())

    install(party.server)
    tls |= {key: str(file) for key, file in copies.items()}
    rig.start(settings)
    with secured(rig, party, party.engineer) as open_before:
        before = open_before.tls.getpeercert(binary_form=True)
        install(party.authority.issue("renewed", "DNS:localhost,IP:127.0.0.1"))
        assert rig.reload(settings) == ["listeners.scada"]
        assert rig.reload(settings) == []
        assert open_before.ask(WRITE) == WRITE
        with secured(rig, party, party.engineer) as after:
            assert after.tls.getpeercert(binary_form=True) != before


BY = {"source": "test"}


def test_sessions_are_listed_with_their_certificates_and_ended(
    rig: Rig, party: Party, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "holdfast")
    rig.start(party.settings("engineer", "laptop"))
    with secured(rig, party, party.engineer) as stays, secured(rig, party, party.laptop) as goes:
        assert stays.ask(WRITE) == goes.ask(WRITE) == WRITE
        found = {each["role"]: each for each in rig.appliance.sessions()}
        assert set(found) == {"engineer", "laptop"}
        session = found["laptop"]
        assert session["subject"] == "CN=laptop"
        assert int(session["serial"], 16) > 0
        assert not rig.appliance.end_session("scada", 999, BY)
        assert not rig.appliance.end_session("other", session["id"], BY)
        assert rig.appliance.end_session("scada", session["id"], BY)
        with pytest.raises((Refused, ConnectionError)):
            goes.ask(READ)
        assert stays.ask(READ) == READ_42
        assert [each["role"] for each in rig.appliance.sessions()] == ["engineer"]
    assert rig.counted()["connections"]["ended"] == 1
    log_events(rig.appliance)
    # The end of the connection itself is only logged at level debug.
    assert [record for record in caplog.records if record.message == "ended"] == []
    (ended,) = [record for record in caplog.records if record.message == "session_ended"]
    assert vars(ended)["fields"]["session_subject"] == "CN=laptop"


def test_a_listener_that_is_added_is_logged_and_the_others_are_not_again(
    rig: Rig, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "holdfast")

    def listening() -> list[str]:
        found = [vars(each) for each in caplog.records if each.message == "listening"]
        caplog.clear()
        return [each["fields"]["listener"] for each in found]

    scada = listener(rule("127.0.0.0/8"))
    rig.start(plant(listeners={"scada": scada}))
    assert listening() == ["scada"]
    rig.reload(plant(listeners={"scada": scada, "other": scada}))
    assert listening() == ["other"]


# Devices


def polled(server: holdfast.Server, **more: Any) -> Settings:
    host, port = server.address
    into = {"memory": "plant", "area": "holding_registers", "address": 50}
    read = {"area": "holding_registers", "address": 0, "count": 2, "into": into}
    return {
        "url": f"tcp://{host}:{port}",
        "unit": 1,
        "interval": 0.02,
        "timeout": wire.DEADLINE,
        "reads": [read],
        **more,
    }


def test_devices_come_change_and_go(rig: Rig, serve: Serve, connect: Connect) -> None:
    one, two = (holdfast.Memory(holding_registers=10) for _ in range(2))
    one.write("holding_registers", 0, [1, 1])
    two.write("holding_registers", 0, [2, 2])
    first, second = serve({1: one}, access="read-only"), serve({1: two}, access="read-only")
    rig.start(plant())
    memory = rig.appliance.memories["plant"]
    client = connect(rig.address())
    into_mirrored = bytes.fromhex("0600320009")
    assert client.ask(into_mirrored) == into_mirrored

    assert rig.reload(plant(devices={"pump": polled(first)})) == ["devices.pump"]
    wire.until(lambda: memory.read("holding_registers", 50, 2) == [1, 1], "it is polled")
    assert client.ask(into_mirrored) == bytes.fromhex("8602"), "the range is mirrored"
    polls = rig.appliance.diagnostics.stats()["devices"]["pump"]["polls"]
    assert rig.reload(plant(devices={"pump": polled(first)})) == []
    rig.reload(plant(devices={"pump": polled(second)}))
    wire.until(lambda: memory.read("holding_registers", 50, 2) == [2, 2], "the other is polled")
    assert rig.appliance.diagnostics.stats()["devices"]["pump"]["polls"] >= polls
    rig.appliance.log_events(0)

    with pytest.raises(ReloadRefused, match=r"devices\.pump: in_flight, retry, tolerance or"):
        rig.reload(plant(devices={"pump": polled(second, in_flight=2)}))

    rig.reload(plant(devices={"pump": polled(second, enabled=False)}))
    assert rig.appliance.diagnostics.stats()["devices"] == {"pump": {"health": "disabled"}}
    rig.reload(plant())
    assert rig.appliance.diagnostics.stats()["devices"] == {}
    assert client.ask(into_mirrored) == into_mirrored


def values(number: int) -> Behaviour:
    """Answers with registers that all have this value."""
    return lambda asked: asked.answer(registers(asked.pdu, number))


def mirrored(device: Stream, address: int, interval: float) -> Settings:
    into = {"memory": "plant", "area": "holding_registers", "address": address}
    read = {"area": "holding_registers", "address": 0, "count": 2, "into": into}
    more = {"interval": interval, "timeout": wire.DEADLINE}
    return {"url": device.url, "unit": 1, "reads": [read], **more}


def test_devices_whose_places_change_are_polled_at_once(rig: Rig) -> None:
    with Stream("tcp", then=values(1)) as one, Stream("tcp", then=values(2)) as two:

        def places(first: int, second: int) -> Settings:
            pump, fan = mirrored(one, first, 3600), mirrored(two, second, 3600)
            return plant(devices={"pump": pump, "fan": fan})

        rig.start(places(50, 60))
        memory = rig.appliance.memories["plant"]

        def show(first: int, second: int) -> bool:
            read = memory.read("holding_registers", 50, 12)
            return (read[:2], read[10:]) == ([first] * 2, [second] * 2)

        wire.until(lambda: show(1, 2), "both are read")
        rig.reload(places(60, 50))
        wire.until(lambda: show(2, 1), "both are read again")


def test_a_poll_that_a_reload_overtakes_stores_nothing_at_its_former_place(rig: Rig) -> None:
    held = Held(7)
    with (
        Stream("tcp", values(1), held, then=values(8)) as one,
        Stream("tcp", then=silent) as two,
    ):

        def places(first: int, second: int) -> Settings:
            pump, fan = mirrored(one, first, 0.02), mirrored(two, second, 3600)
            return plant(devices={"pump": pump, "fan": fan})

        rig.start(places(50, 60))
        one.await_requests(2)
        rig.reload(places(60, 50))
        held.release()
        memory = rig.appliance.memories["plant"]
        wire.until(lambda: memory.read("holding_registers", 60, 2) == [8, 8], "it is polled")
        assert memory.read("holding_registers", 50, 2) == [1, 1]


def test_a_memory_that_can_not_be_written_now_ends_no_reload(
    rig: Rig, serve: Serve, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuses(*_: object) -> None:
        raise OSError("what keeps the memory can't be reached, and nothing was written")

    server = serve({1: holdfast.Memory(holding_registers=10)}, access="read-only")
    status = {"memory": "plant", "area": "holding_registers", "slot": 0}
    rig.start(plant())
    monkeypatch.setattr(_core, "write_disabled_status", refuses)
    rig.reload(plant(devices={"pump": polled(server, enabled=False, status=status)}))
    [told] = [vars(each)["fields"] for each in caplog.records if each.msg == "status_not_written"]
    assert (told["device"], told["memory"]) == ("pump", "plant")
    assert "can't be reached" in told["error"]


def test_links_are_added_and_used_ones_keep_their_settings(
    rig: Rig, serve: Serve, connect: Connect
) -> None:
    server = serve({1: holdfast.Memory(holding_registers=10)}, access="read-write")
    host, port = server.address
    rig.start(plant())
    client = connect(rig.address())

    def through(**link: Any) -> Settings:
        routed = listener(rule("127.0.0.0/8", units={1: "plant", 2: {"route": "line"}}))
        links = {"line": {"url": f"tcp://{host}:{port}", **link}}
        return plant(listeners={"scada": routed}, links=links)

    rig.reload(through())
    assert client.ask(WRITE) == WRITE
    wire.until(lambda: client.ask(WRITE, unit=2) == bytes.fromhex("860b"), "unit 2 is not there")
    assert rig.reload(through(timeout=2)) == ["links.line"]
    with pytest.raises(ReloadRefused) as refused:
        rig.reload(through(queue=7))
    assert refused.value.reasons == [
        "links.line: settings of a connection in use changed; requires a restart"
    ]
    rig.reload(plant())
    assert client.ask(WRITE, unit=2) == bytes.fromhex("860b")
    assert client.ask(READ) == READ_42


# Adapters and log


def health(rig: Rig) -> int:
    host, port = rig.address("rest")
    with urllib.request.urlopen(f"http://{host}:{port}/api/v1/health", timeout=10) as reply:
        status: int = reply.status
        return status


def answers(rig: Rig) -> bool:
    try:
        return health(rig) == 200
    except (urllib.error.URLError, OSError):
        return False


def test_services_come_change_and_go(rig: Rig) -> None:
    rest = {"bind": "127.0.0.1:0", "sources": ["127.0.0.1"], "tokens": "none"}
    rig.start(plant())
    assert rig.reload(plant(rest=rest)) == ["rest"]
    wire.until(lambda: answers(rig), "REST answers")
    address = rig.address("rest")
    assert rig.reload(plant(rest=rest)) == []
    rig.reload(plant(rest={**rest, "sources": ["127.0.0.9"]}))
    wire.until(lambda: not answers(rig), "the sources have changed")
    assert rig.address("rest") == address, "the port is the same"
    rig.reload(plant(rest=rest))
    wire.until(lambda: answers(rig), "REST answers again")
    rig.reload(plant())
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(address, 10)
    assert rig.appliance.diagnostics.stats()["adapters"] == {}


def test_a_profile_is_a_part_of_the_services_that_know_all(rig: Rig) -> None:
    def with_scale(scale: float) -> Settings:
        level = {"area": "holding_registers", "address": 5, "scale": scale}
        gateway = {
            "bind": "127.0.0.1:0",
            "sources": ["127.0.0.1"],
            "allow": ["127.0.0.1:*"],
            "access": "read-only",
            "tokens": "none",
        }
        return plant(gateway=gateway, profiles={"tank": {"tags": {"level": level}}})

    rig.start(with_scale(0.1))
    assert rig.reload(with_scale(0.01)) == ["gateway"]
    assert rig.reload(with_scale(0.01)) == []


@pytest.mark.parametrize("change", [{"name": "other", "secret": "new"}, {"areas": ("coils",)}])
def test_a_token_has_its_new_rights_before_the_next_request(
    rig: Rig, change: dict[str, Any]
) -> None:
    """Also where the server knows the head of the request, which is the same as before."""

    def rest(name: str = "scada", secret: str = "old", **more: Any) -> Settings:
        token = web.token(name, secret, **{"memories": ("plant",), **more})
        return {"bind": "127.0.0.1:0", "sources": ["127.0.0.1"], "tokens": [token]}

    areas = ("holding_registers",)
    rig.start(plant(rest=rest(areas=areas)))
    wire.until(lambda: answers(rig), "REST answers")
    body = json.dumps(web.command("holding_registers", 7, [42], "plant")).encode()
    request = web.post(body, "Authorization: Bearer old")

    def asked(line: socket.socket) -> int | None:
        """The status of the next request; `None` if the connection has ended."""
        try:
            line.sendall(request)
            reply = http.client.HTTPResponse(line)
            reply.begin()
            reply.read()
        except OSError:
            return None
        return reply.status

    with socket.create_connection(rig.address("rest"), wire.DEADLINE) as line:
        assert [asked(line) for _ in range(3)] == [200] * 3
        rig.reload(plant(rest=rest(**{"areas": areas, **change})))
        refused = 403 if "areas" in change else 401
        assert asked(line) in (refused, None)
    wire.until(lambda: answers(rig), "REST answers again")
    for _ in range(3):
        with socket.create_connection(rig.address("rest"), wire.DEADLINE) as line:
            assert asked(line) == refused


def test_a_new_memory_ends_no_stream_of_a_token(rig: Rig) -> None:
    def settings(*granted: str, **more: Settings) -> Settings:
        token = web.token("hmi", "secret", memories=granted)
        rest = {"bind": "127.0.0.1:0", "sources": ["127.0.0.1"], "tokens": [token]}
        return plant(memories={**plant()["memories"], **more}, rest=rest)

    rig.start(settings("plant"))
    wire.until(lambda: answers(rig), "REST answers")
    path = "/api/v1/memory/changes?memory=plant&area=holding_registers&address=7&count=1"
    request = web.head("GET", path, "Authorization: Bearer secret", "Accept: text/event-stream")
    with socket.create_connection(rig.address("rest"), wire.DEADLINE) as line:
        line.sendall(request)
        stream = line.makefile("rb")
        assert any(b"[0]" in received for received in stream)
        assert rig.reload(settings("plant", more={"coils": 8})) == ["memories.more"]
        rig.appliance.memories["plant"].write("holding_registers", 7, [42])
        assert any(b"[42]" in received for received in stream), "the stream goes on"
    rig.reload(settings("plant", "more", more={"coils": 8}))
    wire.until(lambda: answers(rig), "REST answers again")
    client = web.Client(rig.address("rest"), "secret")
    assert client.read("coils", 0, 1, "more").status == 200
    client.close()


def test_a_new_memory_may_be_read_by_everyone_without_tokens(rig: Rig) -> None:
    rest = {"bind": "127.0.0.1:0", "sources": ["127.0.0.1"], "tokens": "none"}
    rig.start(plant(rest=rest))
    rig.reload(plant(memories={**plant()["memories"], "more": {"coils": 8}}, rest=rest))
    wire.until(lambda: answers(rig), "REST answers")
    client = web.Client(rig.address("rest"))
    assert client.read("coils", 0, 1, "more").status == 200
    client.close()


def test_an_http_address_in_use_is_refused(rig: Rig, connect: Connect) -> None:
    rig.start(plant())
    with socket.create_server(("127.0.0.1", 0)) as taken:
        host, port = taken.getsockname()
        rest = {"bind": f"{host}:{port}", "sources": ["127.0.0.1"], "tokens": "none"}
        with pytest.raises(OSError, match=f"rest: can't listen on {host}:{port}"):
            rig.reload(plant(rest=rest))
    assert connect(rig.address()).ask(WRITE) == WRITE


def test_the_log_level_changes(
    rig: Rig, connect: Connect, caplog: pytest.LogCaptureFixture
) -> None:
    rig.start(plant())
    assert rig.reload(plant(log={"level": "debug"})) == ["log"]
    connect(rig.address()).ask(READ)
    rig.appliance.log_events(wire.DEADLINE)
    assert "opened" in [record.message for record in caplog.records]
    assert logging.getLogger("holdfast").level == logging.DEBUG
    rig.reload(plant())
    assert logging.getLogger("holdfast").level == logging.INFO


def test_reloads_under_load_lose_no_request(rig: Rig, connect: Connect) -> None:
    """Sessions of a rule that does not change notice nothing of changes to other rules."""
    other = rule("127.0.0.2", access="read-only")
    variants = [
        plant(listeners={"scada": listener(rule("127.0.0.1"), *more)}) for more in ([], [other])
    ]
    rig.start(variants[0])
    clients = [connect(rig.address()) for _ in range(20)]
    done, failures = threading.Event(), list[BaseException]()
    asked = [0] * len(clients)

    def work(own: range) -> None:
        try:
            while not done.is_set():
                for at in own:
                    assert clients[at].ask(WRITE) == WRITE
                    asked[at] += 1
        except BaseException as error:
            failures.append(error)

    workers = [threading.Thread(target=work, args=(range(at, 20, 4),)) for at in range(4)]
    for worker in workers:
        worker.start()
    for count in range(30):
        rig.reload(variants[(count + 1) % 2])
    wire.until(lambda: failures or min(asked) > 10, "all have asked")
    done.set()
    for worker in workers:
        worker.join()
    assert failures == []
    assert rig.counted()["connections"]["accepted"] == len(clients)
    assert json.dumps(rig.appliance.sessions())
    assert len(rig.appliance.sessions()) == len(clients)


def test_a_reload_is_recorded_and_reopens_a_renamed_audit_log(rig: Rig, connect: Connect) -> None:
    audit = {"audit": {"file": "audit.log"}}
    file = rig.file.parent / "audit.log"
    rig.start(plant(**audit))
    file.rename(file.with_name("kept.log"))
    rig.reload(plant(log={"level": "warning"}, **audit))
    (digest,) = {hashlib.sha256(rig.file.read_bytes()).hexdigest()}
    lines = [json.loads(line) for line in file.read_text().splitlines()]
    assert [(each["event"], each.get("config_sha256")) for each in lines][-1] == ("reload", digest)
    assert connect(rig.address()).ask(WRITE) == WRITE
    with pytest.raises(ReloadRefused, match="audit: changed; requires a restart"):
        rig.reload(plant(audit={"file": "audit.log", "fail": "closed"}))


def test_an_internal_error_is_not_told_as_a_refusal(
    rig: Rig, connect: Connect, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig.start(plant())

    def broken(*_: object) -> None:
        raise KeyError("pump")

    monkeypatch.setattr(Mirrors, "adopt", broken)
    less = listener(rule("127.0.0.0/8", access="read-only"))
    with pytest.raises(ReloadIncomplete, match="KeyError: 'pump'"):
        rig.reload(plant(listeners={"scada": less}))
    assert connect(rig.address()).ask(WRITE) == FORBIDDEN


def test_a_tag_that_only_a_topic_uses_changes_mqtt(rig: Rig) -> None:
    topic = {"topic": "a", "memory": "plant", "profile": "tank", "name": "level"}
    mqtt = {"url": "mqtt://127.0.0.1:1", "client_id": "a", "map": [topic]}

    def prints(address: int, other: int = 0) -> dict[str, str]:
        tags = {
            name: {"area": "holding_registers", "address": at}
            for name, at in (("level", address), ("other", other))
        }
        return fingerprints(rig.load(plant(mqtt=mqtt, profiles={"tank": {"tags": tags}})))

    assert differences(prints(1), prints(2)) == ["mqtt"]
    assert differences(prints(1), prints(1, other=2)) == []
