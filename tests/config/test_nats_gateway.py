"""The sections `nats` and `gateway`: what they hold, and what wrong ones are told."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from holdfast.appliance.services.gateway import gateway_settings
from holdfast.appliance.services.scanner import scanner_settings
from holdfast.client.url import Tls
from holdfast.config.values.scanner_settings import written_pollable
from holdfast.gateway import GatewayLimits
from holdfast.net.nats.connection import Ping, Servers
from holdfast.scanner.subscriptions.request_rules import Defaults, ScannerLimits
from support.config_folder import Folder

if TYPE_CHECKING:
    from pathlib import Path

    from holdfast.config.models.services import GatewayConfig, NatsConfig

HASH = "0123456789abcdef" * 4
NATS = """\
nats:
  servers: [tls://nats.example]
  devices: [10.0.0.0/8]
"""
GATEWAY = f"""\
gateway:
  bind: 127.0.0.1:8090
  sources: [10.0.0.0/8]
  allow: [10.0.0.0/8]
  access: read-only
  tokens:
    - name: panel
      sha256: {HASH}
"""
LISTENER = """\
listeners:
  line:
    type: modbus-rtu
    serial: {device: /dev/ttyUSB0}
    rules: [{units: {1: plant}, access: read-only}]
"""
HOST_NAME = "a host name without a port, as in gateway.plant.example"
NAME = "1 to 64 letters, digits, '_', '.' and '-'"
SOME = "a list with at least one entry"
URL = "nats://host:port or tls://host:port"
POLLABLE = (
    "a network or an address, as in 10.0.0.0/24, 10.0.0.7 or fd00::/64, or a serial device, as in "
    "/dev/ttyUSB0 or COM3"
)
EGRESS = (
    "NETWORK[:PORTS], as in 10.0.0.0/8, 10.0.0.5:502, 10.0.0.0/24:502-510, 10.0.0.5:* or, "
    "with quotes, '[fd00::]/8:502'; default ports: 502, with TLS also 802"
)
ONE = "only one of username, token_file, credentials_file"
NO_FILE = "which can't be read: No such file or directory"
FORM = "letters, digits, '_' and '-', separated by dots"


@pytest.fixture
def folder(tmp_path: Path) -> Folder:
    return Folder(tmp_path)


def changed(text: str, old: str, new: str) -> str:
    assert text.count(old) == 1, old
    return text.replace(old, new)


def nats_of(folder: Folder, text: str) -> NatsConfig:
    nats = folder.config(text).nats
    assert nats is not None
    return nats


def gateway_of(folder: Folder, text: str) -> GatewayConfig:
    gateway = folder.config(text).gateway
    assert gateway is not None
    return gateway


# What they come to.


def test_the_scanner_is_told_what_the_file_says(folder: Folder, tmp_path: Path) -> None:
    (tmp_path / "secret").write_text("s3cret")
    (tmp_path / "ca.pem").touch()
    text = (
        "nats:\n  servers: [nats://a, 'tls://[fd00::1]:4443']\n"
        "  devices: [10.0.0.7, 'fd00::/8', /dev/ttyUSB0, COM3]\n"
        "  username: scanner\n  password_file: secret\n"
        "  tls: {ca_file: p.yaml, cert_file: p.yaml, key_file: p.yaml}\n"
        "  device_tls: {ca_file: ca.pem, cert_file: p.yaml, key_file: secret}\n"
        "  prefix: plant.modbus-1\n  limits: {devices: 7, tags: 8}\n  dialect: tentacle\n"
        "  defaults: {timeout: 500, publish: change, deadband: 0.5, scan_rate: 100}\n"
        "  writes: explicit\n  strict: true\n  ping: {interval: 0.5, outstanding: 7}\n"
        "  publish_logs: false\n  keep_subscriptions: false\n"
    )
    nats = nats_of(folder, text)
    settings = scanner_settings(nats)
    file = tmp_path / "p.yaml"
    assert settings.servers == Servers(
        ("nats://a", "tls://[fd00::1]:4443"),
        user="scanner",
        password_file=tmp_path / "secret",
        tls=Tls(str(file), str(file), str(file)),
    )
    written = [written_pollable(entry) for entry in settings.allow]
    assert written == ["10.0.0.7/32", "fd00::/8", "/dev/ttyUSB0", "COM3"]
    assert settings.prefix == "plant.modbus-1"
    assert settings.defaults == Defaults(500, "change", 0.5, 100)
    assert (settings.writes, settings.strict) == ("explicit", True)
    assert settings.ping == Ping(0.5, 7)
    assert (settings.publish_logs, settings.keep_subscriptions) == (False, False)
    assert settings.limits == ScannerLimits(devices=7, tags=8)
    assert settings.device_tls == Tls(str(tmp_path / "ca.pem"), str(file), str(tmp_path / "secret"))
    assert "s3cret" not in repr(nats) + repr(settings)


@pytest.mark.parametrize("key", ["token", "credentials"])
def test_the_scanner_has_another_identity(folder: Folder, tmp_path: Path, key: str) -> None:
    servers = scanner_settings(nats_of(folder, f"{NATS}  {key}_file: p.yaml\n")).servers
    file = {"token": servers.token_file, "credentials": servers.credentials}[key]
    assert (file, servers.user) == (tmp_path / "p.yaml", None)


def test_the_scanner_has_the_documented_defaults(folder: Folder) -> None:
    nats = nats_of(folder, NATS)
    assert (nats.prefix, nats.limits.devices, nats.limits.tags) == ("modbus", 5000, 500_000)
    assert (nats.username, nats.tls) == (None, None)
    assert scanner_settings(nats).limits == ScannerLimits()
    assert scanner_settings(nats).device_tls == Tls()
    assert scanner_settings(nats).defaults == Defaults(3000, "scan", 0.0, 1000)
    assert scanner_settings(nats).ping == Ping()
    assert (nats.writes, nats.strict) == ("tags", False)
    assert (nats.publish_logs, nats.keep_subscriptions) == (True, True)
    assert scanner_settings(nats).dialect == "tentacle"


def test_the_scanner_serves_the_programs_of_tentacle_next(folder: Folder) -> None:
    settings = scanner_settings(nats_of(folder, NATS + "  dialect: tentacle-next\n"))
    assert settings.dialect == "tentacle-next"


def test_the_gateway_is_told_what_the_file_says(folder: Folder, tmp_path: Path) -> None:
    text = changed(GATEWAY, "[10.0.0.0/8]\n  access: read-only", "['10.0.0.5:*', '[fd00::]/8']\n"
                   "  in_flight: 4\n  device_tls: {ca_file: p.yaml}\n"
                   "  access: read-write")  # fmt: skip
    settings = gateway_settings(gateway_of(folder, text))
    assert [str(entry) for entry in settings.allow] == ["10.0.0.5:*", "[fd00::]/8"]
    assert [str(network) for network in settings.sources] == ["10.0.0.0/8"]
    assert settings.tokens == (("panel", bytes.fromhex(HASH)),)
    assert settings.writes
    assert settings.limits == GatewayLimits(in_flight=4)
    assert settings.tls == Tls(ca=str(tmp_path / "p.yaml"))


@pytest.mark.parametrize(
    ("keys", "places"),
    [
        ("max_connections: 300", (300, 150)),
        ("max_connections: 300, max_connections_per_source: 200", (300, 200)),
        ("max_connections_per_source:", (128, None)),
    ],
)
def test_an_address_has_half_of_the_places_of_the_gateway_unless_the_file_says_otherwise(
    folder: Folder, keys: str, places: tuple[int, int | None]
) -> None:
    lines = "".join(f"  {key}\n" for key in keys.split(", "))
    limits = gateway_settings(gateway_of(folder, GATEWAY + lines)).limits
    assert (limits.connections, limits.connections_per_source) == places


@pytest.mark.parametrize("source", ["127.0.0.0/8", "127.0.0.1", "::1"])
def test_the_gateway_needs_no_tokens_for_this_machine(folder: Folder, source: str) -> None:
    text = GATEWAY[: GATEWAY.index("  tokens:")].replace("sources: [10.0.0.0/8]", "sources: [%s]")
    settings = gateway_settings(gateway_of(folder, text % f"'{source}'" + "  tokens: none\n"))
    assert (settings.tokens, settings.writes, settings.limits.in_flight) == ((), False, 1)


def test_the_gateway_has_names_without_tokens(folder: Folder) -> None:
    text = changed(WITHOUT, "sources: [10.0.0.0/8]", "sources: ['::1']")
    more = "  tokens: none\n  hosts: [gw, Gateway.Plant.example]\n  compat: port-of-call\n"
    settings = gateway_settings(gateway_of(folder, text + more))
    assert settings.hosts == {"gw", "gateway.plant.example"}
    assert settings.compat == "port-of-call"
    assert folder.warnings(text + more) == []
    assert gateway_settings(gateway_of(folder, GATEWAY)).compat is None


def test_with_tokens_names_have_no_effect(folder: Folder) -> None:
    [warning] = folder.warnings(GATEWAY + "  hosts: [gw]\n")
    assert warning.endswith("gateway.hosts: has no effect with tokens")


def test_the_effective_configuration_shows_every_default(folder: Folder) -> None:
    dump = folder.config(NATS + GATEWAY).dump()
    assert dump[dump.index("nats:") : dump.index("adapters:")] == (
        "nats:\n"
        "  servers: [tls://nats.example]\n"
        "  devices: [10.0.0.0/8]\n"
        "  prefix: modbus\n"
        "  dialect: tentacle\n"
        "  defaults: {timeout: 3000, publish: scan, deadband: 0, scan_rate: 1000}\n"
        "  writes: tags\n"
        "  strict: false\n"
        "  ping: {interval: 1, outstanding: 3}\n"
        "  publish_logs: true\n"
        "  keep_subscriptions: true\n"
        "  limits: {devices: 5000, tags: 500000}\n"
        "gateway:\n"
        "  bind: 127.0.0.1:8090\n"
        "  sources: [10.0.0.0/8]\n"
        "  allow: [10.0.0.0/8]\n"
        "  access: read-only\n"
        "  tokens:\n"
        f"    - {{name: panel, sha256: {HASH}}}\n"
        "  in_flight: 1\n"
        "  max_connections: 128\n"
        "  max_connections_per_source: 64\n"
        "  hosts: []\n"
        "outputs: {}\n"
    )
    assert folder.config(dump) == folder.config(NATS + GATEWAY)


# Memories.


@pytest.mark.parametrize("text", [NATS, GATEWAY, NATS + GATEWAY, "memories: {}\n" + NATS])
@pytest.mark.parametrize("more", ["", "metrics: {bind: '127.0.0.1:80'}\n", "audit: {file: a}\n"])
def test_where_nothing_needs_memories_there_may_be_none(
    folder: Folder, text: str, more: str
) -> None:
    assert folder.config(text + more).memories == {}


REST = "rest: {bind: '127.0.0.1:80', sources: [127.0.0.1], tokens: none}\n"
READS = "reads: [{area: coils, address: 0, count: 1}]"
FORWARDED = (
    f"{{url: 'tcp://plc', unit: 1, interval: 1, {READS}, forward: [{{url: 'raw://a:1', unit: 1}}]"
)


def test_devices_that_are_only_forwarded_need_no_memories(folder: Folder) -> None:
    assert folder.warnings(f"devices: {{a: {FORWARDED}}}}}\n") == []


@pytest.mark.parametrize(
    "more",
    [
        "",
        "metrics: {bind: '127.0.0.1:80'}\n",
        REST,
        NATS + REST,
        LISTENER.replace("1: plant", "1: a"),
        f"devices: {{a: {{url: 'tcp://plc', unit: 1, interval: 1, {READS}}}}}\n" + GATEWAY,
        f"devices: {{a: {FORWARDED}, status: {{memory: a, area: input_registers, slot: 0}}}}}}\n",
        f"devices: {{a: {FORWARDED.replace('1}]', '1, into: {memory: a, area: coils}}]')}}}}}\n",
        "adapters: {a: {type: b, memories: [c], areas: [coils], access: read-only}}\n" + NATS,
    ],
)
@pytest.mark.parametrize(
    ("memories", "found"), [("", "missing"), ("memories: {}\n", "found an empty mapping")]
)
def test_everything_else_needs_memories(
    folder: Folder, memories: str, found: str, more: str
) -> None:
    assert folder.problems(memories + (more or "workers: 1\n"))[0] == (
        f"p.yaml:1: memories: {found}, allowed: a mapping with at least one entry "
        "(optional when only nats, gateway, routes and devices that are forwarded or have tags are "
        "configured)"
    )


# What is wrong.


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("  servers: [tls://nats.example]\n", "", f"1: servers: missing, allowed: {SOME}"),
        ("  devices: [10.0.0.0/8]\n", "", f"1: devices: missing, allowed: {SOME}"),
        ("[tls://nats.example]", "[]", f"2: servers: found an empty list, allowed: {SOME}"),
        ("[tls://nats.example]", "nats://a",
         f"2: servers: found text of 8 characters, allowed: {SOME}"),
        ("[10.0.0.0/8]", "[]", f"3: devices: found an empty list, allowed: {SOME}"),
        ("10.0.0.0/8", "10.0.0.1/8", "3: devices[0]: found '10.0.0.1/8', which has host bits set: "
         "the network is 10.0.0.0/8"),
        ("10.0.0.0/8", "'::ffff:10.0.0.1'",
         "3: devices[0]: found '::ffff:10.0.0.1', write its IPv4 form 10.0.0.1/32"),
        ("10.0.0.0/8", "plc", f"3: devices[0]: found 'plc', allowed: {POLLABLE}"),
        ("10.0.0.0/8", "COMPANY", f"3: devices[0]: found 'COMPANY', allowed: {POLLABLE}"),
        ("10.0.0.0/8", "dev/ttyS0", f"3: devices[0]: found 'dev/ttyS0', allowed: {POLLABLE}"),
        ("10.0.0.0/8", "10.0.0.5:502", "3: devices[0]: found '10.0.0.5:502', allowed: a network "
         "or an address, as in 10.0.0.0/24, 10.0.0.7 or fd00::/64"),
        ("10.0.0.0/8", "5", f"3: devices[0]: found 5, allowed: {POLLABLE}"),
        ("  devices", "  username: ''\n  devices",
         "3: username: found text of 0 bytes, allowed: text of 1 to 65535 bytes"),
        ("  devices", "  password_file: p.yaml\n  devices",
         "3: password_file: found without username, allowed: both or neither"),
        ("  devices", "  username: a\n  password_file: none\n  devices",
         f"4: password_file: found text of 4 characters, {NO_FILE}"),
        ("  devices", "  token_file: none\n  devices",
         f"3: token_file: found text of 4 characters, {NO_FILE}"),
        ("  devices", "  credentials_file: /\n  devices",
         "3: credentials_file: found '/', which can't be read: Is a directory"),
        ("  devices", "  username: a\n  token_file: p.yaml\n  devices",
         f"4: token_file: found together with username, allowed: {ONE}"),
        ("  devices", "  credentials_file: p.yaml\n  token_file: p.yaml\n  devices",
         f"3: credentials_file: found together with token_file, allowed: {ONE}"),
        ("  devices", "  tls: {ca_file: none}\n  devices",
         f"3: tls.ca_file: found 'none', {NO_FILE}"),
        ("  devices", "  tls: {key_file: p.yaml}\n  devices",
         "3: tls.key_file: found without cert_file, allowed: both or neither"),
        ("  devices", "  device_tls: {ca_file: none}\n  devices",
         f"3: device_tls.ca_file: found 'none', {NO_FILE}"),
        ("  devices", "  device_tls: {cert_file: p.yaml}\n  devices",
         "3: device_tls.cert_file: found without key_file, allowed: both or neither"),
        ("  devices", "  prefix: a b\n  devices", f"3: prefix: found 'a b', allowed: {FORM}"),
        ("  devices", "  prefix: a.>\n  devices", f"3: prefix: found 'a.>', allowed: {FORM}"),
        ("  devices", "  prefix: \n  devices", f"3: prefix: found nothing, allowed: {FORM}"),
        ("  devices", "  limits: {devices: 0}\n  devices",
         "3: limits.devices: found 0, allowed: an integer of at least 1"),
        ("  devices", "  limits: {tags: 1.0}\n  devices",
         "3: limits.tags: found 1.0, allowed: an integer of at least 1"),
        ("  devices", "  limits: {tag: 1}\n  devices",
         "3: limits.tag: unknown key, allowed: devices, tags; did you mean 'tags'?"),
        ("  devices", "  embedded: true\n  devices", "3: embedded: unknown key, allowed: servers, "
         "username, password_file, token_file, credentials_file, tls, devices, device_tls, prefix, "
         "dialect, defaults, writes, strict, ping, publish_logs, keep_subscriptions, limits, "
         "fleet"),
        ("  devices", "  fleet: {name: plant}\n  devices", "3: fleet.node: missing, allowed: text"),
        ("  devices", "  fleet: {name: a.b, node: x}\n  devices",
         "3: fleet.name: found 'a.b', allowed: 1 to 32 letters, digits, - and _"),
        ("  devices", "  fleet: {name: a_wants, node: x}\n  devices",
         "3: fleet.name: found 'a_wants', allowed: a name that does not end in _wants, as the "
         "bucket of another fleet does"),
        ("  devices", "  fleet: {name: a, node: x}\n  dialect: tentacle-next\n  devices",
         "4: dialect: found tentacle-next together with fleet, allowed: tentacle"),
        ("  devices", "  fleet: {name: a, node: x}\n  keep_subscriptions: false\n  devices",
         "4: keep_subscriptions: found false together with fleet, allowed: true"),
        ("  devices", "  defaults: {timeout: 3}\n  devices",
         "3: defaults.timeout: found 3, allowed: an integer from 10 to 30000 milliseconds"),
        ("  devices", "  defaults: {scan_rate: 49}\n  devices",
         "3: defaults.scan_rate: found 49, allowed: an integer from 50 to 86400000 milliseconds"),
        ("  devices", "  defaults: {publish: always}\n  devices",
         "3: defaults.publish: found 'always', allowed: scan or change"),
        ("  devices", "  defaults: {deadband: 1}\n  devices",
         "3: defaults.deadband: found without publish: change, allowed: only with it"),
        ("  devices", "  dialect: next\n  devices",
         "3: dialect: found 'next', allowed: tentacle or tentacle-next"),
        ("  devices", "  dialect: tentacle-next\n  prefix: a.b\n  devices",
         "4: prefix: found 'a.b', allowed with dialect tentacle-next: no dots"),
        ("  devices", "  writes: all\n  devices",
         "3: writes: found 'all', allowed: tags, explicit or none"),
        ("  devices", "  ping: {interval: 0}\n  devices",
         "3: ping.interval: found 0, allowed: a number from 0.1 to 3600.0 seconds"),
        ("  devices", "  ping: {outstanding: 0}\n  devices",
         "3: ping.outstanding: found 0, allowed: an integer from 1 to 100"),
    ],
)  # fmt: skip
def test_nats_is_checked(folder: Folder, old: str, new: str, problem: str) -> None:
    line, _, rest = problem.partition(" ")
    assert folder.problems(changed(NATS, old, new)) == [f"p.yaml:{line} nats.{rest}"]


@pytest.mark.parametrize(
    ("url", "found"),
    [
        ("http://a", "neither nats:// nor tls://"),
        ("a:4222", "neither nats:// nor tls://"),
        ("nats://", "no host"),
        ("nats://a/b", "more than host and port"),
        ("5", "a number"),
    ],
)
def test_the_url_of_a_server_is_checked(folder: Folder, url: str, found: str) -> None:
    assert folder.problems(changed(NATS, "tls://nats.example", url)) == [
        f"p.yaml:2: nats.servers[0]: found {found}, allowed: {URL}"
    ]


@pytest.mark.parametrize("url", ["nats://a:s3cret", "nats://me:s3cret@a", "tls://s3cret@a:1"])
def test_a_secret_in_a_url_is_refused_and_not_repeated(folder: Folder, url: str) -> None:
    for value in (f"[{url}]", url, f"[[{url}]]"):
        (problem,) = folder.problems(changed(NATS, "[tls://nats.example]", value))
        assert "s3cret" not in problem


def test_certificates_need_a_server_with_tls(folder: Folder) -> None:
    tls = "  tls: {ca_file: p.yaml}\n"
    assert folder.problems(NATS.replace("tls://", "nats://") + tls) == [
        "p.yaml:4: nats.tls: found with servers that begin with nats://, allowed: only with tls://"
    ]
    both = changed(NATS, "[tls://nats.example]", "[nats://a, tls://b]")
    assert scanner_settings(nats_of(folder, both + tls)).servers.secure


def test_a_line_of_a_listener_or_a_device_is_not_polled_for_subscribers(folder: Folder) -> None:
    memories = "memories: {plant: {coils: 8}}\n"
    device = (
        "devices:\n  meter: {url: 'rtu:///dev/ttyUSB1', unit: 1, interval: 1, "
        f"{READS[:-2]}, into: {{memory: plant, area: coils, address: 0}}}}]}}\n"
    )
    nats = changed(NATS, "[10.0.0.0/8]", "[/dev/ttyUSB0, /dev/ttyUSB1, /dev/ttyUSB2]")
    assert folder.problems(memories + LISTENER + device + nats) == [
        "p.yaml:11: nats.devices[0]: found '/dev/ttyUSB0', which is the device of listeners.line "
        "in line 3, allowed: a different one",
        "p.yaml:11: nats.devices[1]: found '/dev/ttyUSB1', which is the device of devices.meter "
        "in line 8, allowed: a different one",
    ]


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("  bind: 127.0.0.1:8090\n", "",
         "1: bind: missing, allowed: text, as in 0.0.0.0:502, 127.0.0.1:5020 or [::]:502"),
        ("  sources: [10.0.0.0/8]\n", "", f"1: sources: missing, allowed: {SOME}"),
        ("  allow: [10.0.0.0/8]\n", "", f"1: allow: missing, allowed: {SOME}"),
        ("  access: read-only\n", "", "1: access: missing, allowed: read-only or read-write"),
        ("127.0.0.1:8090", "8090", "2: bind: found 8090, allowed: address:port with an IP "
         "address, as in 127.0.0.1:502 or, with quotes, '[::1]:502'"),
        ("sources: [10.0.0.0/8]", "sources: []",
         f"3: sources: found an empty list, allowed: {SOME}"),
        ("sources: [10.0.0.0/8]", "sources: [me]", "3: sources[0]: found 'me', allowed: a network "
         "or an address, as in 10.0.0.0/24, 10.0.0.7 or fd00::/64"),
        ("allow: [10.0.0.0/8]", "allow: []", f"4: allow: found an empty list, allowed: {SOME}"),
        ("allow: [10.0.0.0/8]", "allow: ['*']", f"4: allow[0]: found '*', allowed: {EGRESS}"),
        ("allow: [10.0.0.0/8]", "allow: [502]", f"4: allow[0]: found 502, allowed: {EGRESS}"),
        ("allow: [10.0.0.0/8]", "allow: ['fd00::/8']",
         f"4: allow[0]: found 'fd00::/8', allowed: {EGRESS}"),
        ("allow: [10.0.0.0/8]", "allow: ['10.0.0.1/8:*']", "4: allow[0]: found '10.0.0.1/8', "
         "which has host bits set: the network is 10.0.0.0/8"),
        ("allow: [10.0.0.0/8]", "allow: ['10.0.0.1:9-8']",
         "4: allow[0]: found '10.0.0.1:9-8', allowed: ports 1 to 65535, the lower port first"),
        (
            "read-only",
            "writes",
            "5: access: found 'writes', allowed: read-only or read-write; did you mean "
            "'read-write'?",
        ),
        ("  access", "  in_flight: 65\n  access",
         "5: in_flight: found 65, allowed: an integer from 1 to 64"),
        ("  access", "  writes: true\n  access", "5: writes: unknown key, allowed: bind, sources, "
         "allow, access, tokens, tls, device_tls, in_flight, max_connections, "
         "max_connections_per_source, hosts, compat"),
        ("  access", "  compat: tentacle\n  access",
         "5: compat: found 'tentacle', allowed: port-of-call"),
        ("  access", "  compat:\n  access", "5: compat: found nothing, allowed: port-of-call"),
        ("  access", "  hosts: gateway\n  access",
         "5: hosts: found 'gateway', allowed: a list"),
        ("  access", "  hosts: [10.0.0.5]\n  access",
         f"5: hosts[0]: found '10.0.0.5', allowed: {HOST_NAME}"),
        ("  access", "  hosts: ['a b']\n  access",
         f"5: hosts[0]: found 'a b', allowed: {HOST_NAME}"),
        ("  access", "  hosts: ['plant:80']\n  access",
         f"5: hosts[0]: found 'plant:80', allowed: {HOST_NAME}"),
        ("  access", "  hosts: [.plant]\n  access",
         f"5: hosts[0]: found '.plant', allowed: {HOST_NAME}"),
        ("  access", "  hosts: ['*']\n  access", f"5: hosts[0]: found '*', allowed: {HOST_NAME}"),
        ("  access", "  hosts: [7]\n  access", f"5: hosts[0]: found 7, allowed: {HOST_NAME}"),
        ("panel", "''", f"7: tokens[0].name: found '', allowed: {NAME}, not '-' alone"),
        ("    - name: panel\n      sha256", "    - sha256",
         "7: tokens[0].name: missing, allowed: text"),
        (HASH, "my-secret", "8: tokens[0].sha256: found text of 9 characters, allowed: the "
         "SHA-256 of the token, 64 hexadecimal digits"),
        (HASH, f"{HASH}\n      access: read-only",
         "9: tokens[0].access: unknown key, allowed: name, sha256"),
    ],
)  # fmt: skip
def test_the_gateway_is_checked(folder: Folder, old: str, new: str, problem: str) -> None:
    line, _, rest = problem.partition(" ")
    assert folder.problems(changed(GATEWAY, old, new)) == [f"p.yaml:{line} gateway.{rest}"]


WITHOUT = GATEWAY[: GATEWAY.index("  tokens:")]


def test_tokens_of_the_gateway_are_said(folder: Folder) -> None:
    assert folder.problems(WITHOUT) == [
        f"p.yaml:1: gateway.tokens: missing, allowed: {SOME} or none"
    ]


@pytest.mark.parametrize(
    ("tokens", "problem"),
    [
        ("my-secret", f"tokens: found text of 9 characters, allowed: {SOME} or none"),
        ("[my-secret]", "tokens[0]: found text of 9 characters, allowed: a mapping with the keys "
         "name, sha256"),
        ("[]", f"tokens: found an empty list, allowed: {SOME} or none"),
    ],
)  # fmt: skip
def test_a_secret_in_the_place_of_tokens_is_not_repeated(
    folder: Folder, tokens: str, problem: str
) -> None:
    assert folder.problems(f"{WITHOUT}  tokens: {tokens}\n") == [f"p.yaml:6: gateway.{problem}"]


def test_tokens_of_the_gateway_differ_in_name_and_hash(folder: Folder) -> None:
    token = GATEWAY[GATEWAY.index("    - name") :].replace(HASH, HASH.upper())
    assert folder.problems(GATEWAY + token) == [
        "p.yaml:9: gateway.tokens[1].name: found 'panel', which is the name of gateway.tokens[0] "
        "in line 7, allowed: a different one",
        "p.yaml:10: gateway.tokens[1].sha256: found a hash, which is the sha256 of "
        "gateway.tokens[0] in line 7, allowed: a different one",
    ]


def test_without_tokens_the_gateway_is_for_this_machine_only(folder: Folder) -> None:
    text = changed(WITHOUT, "127.0.0.1:8090", "0.0.0.0:8090") + "  tokens: none\n"
    more = changed(text, "sources: [10.0.0.0/8]", "sources: [127.0.0.0/8, '::/0', 10.0.0.0/8]")
    allowed = "allowed with tokens none: loopback addresses, as in 127.0.0.0/8"
    assert folder.problems(more) == [
        f"p.yaml:3: gateway.sources[1]: found '::/0', {allowed}",
        f"p.yaml:3: gateway.sources[2]: found '10.0.0.0/8', {allowed}",
        "p.yaml:6: gateway.tokens: found 'none' with bind 0.0.0.0:8090, allowed: none only on "
        "a loopback address",
    ]


def test_the_gateway_needs_a_socket_of_its_own(folder: Folder) -> None:
    metrics = "metrics: {bind: '0.0.0.0:8090'}\n"
    assert folder.problems(GATEWAY + metrics) == [
        "p.yaml:9: metrics.bind: found '0.0.0.0:8090', which overlaps 127.0.0.1:8090 of gateway "
        "in line 2, allowed: an unused address and port"
    ]
