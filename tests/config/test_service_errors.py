"""What wrong services are told: REST, MQTT, adapters, metrics, audit; and seals without a key."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

import pytest

from support.config_folder import Folder

if TYPE_CHECKING:
    from pathlib import Path

MEMORIES = """\
memories:
  plant: {id: 1, coils: 8, input_registers: 10}
  other: {coils: 8}
"""
HASH = "0123456789abcdef" * 4
REST = f"""\
rest:
  bind: 127.0.0.1:8080
  sources: [127.0.0.0/8]
  tokens:
    - name: edge
      sha256: {HASH}
      memories: [plant]
      areas: [coils]
      access: read-write
"""
MQTT = """\
mqtt:
  url: mqtts://broker
  client_id: plant
  subscriptions:
    - {topic: plant/+/in/#, memories: [plant], areas: [coils]}
"""
EXTRAS = """\
adapters:
  weather: {type: weather, memories: [plant], areas: [coils], access: read-only}
metrics: {bind: 127.0.0.1:9464}
audit: {file: audit.log}
"""
NAME = "1 to 64 letters, digits, '_', '.' and '-'"
TOKEN = f"{NAME}, not '-' alone"
OTHER = "a name other than rest, mqtt, nats, gateway or metrics"
SOME = "a list with at least one entry"
DIGEST = "the SHA-256 of the token, 64 hexadecimal digits"
URL = "mqtt://host:port or mqtts://host:port"
HOST = (
    "a host name, an IPv4 address of four numbers without leading zeros, or an IPv6 address in "
    "brackets, and a port from 1 to 65535"
)


@pytest.fixture
def folder(tmp_path: Path) -> Folder:
    return Folder(tmp_path)


def changed(text: str, old: str, new: str) -> str:
    assert text.count(old) == 1, old
    return MEMORIES + text.replace(old, new)


@pytest.mark.parametrize(
    ("text", "found"),
    [("", "missing"), ("listeners: {}\n", "found an empty mapping"), (EXTRAS, "missing")],
)
def test_an_appliance_serves_something(folder: Folder, text: str, found: str) -> None:
    (problem,) = folder.problems(MEMORIES + text)
    assert problem.partition(": ")[2] == (
        f"listeners: {found}, allowed: a mapping with at least one entry "
        "(optional with rest, mqtt, nats, gateway or devices)"
    )


def test_listeners_are_not_empty_text(folder: Folder) -> None:
    assert folder.problems(MEMORIES + "listeners:\n" + REST) == [
        "p.yaml:4: listeners: found nothing, allowed: a mapping"
    ]


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("  bind: 127.0.0.1:8080\n", "",
         "4: bind: missing, allowed: text, as in 0.0.0.0:502, 127.0.0.1:5020 or [::]:502"),
        ("  sources: [127.0.0.0/8]\n", "", f"4: sources: missing, allowed: {SOME}"),
        ("[127.0.0.0/8]", "[]", f"6: sources: found an empty list, allowed: {SOME}"),
        ("127.0.0.0/8", "any", "6: sources[0]: found 'any', allowed: a network or an address, "
         "as in 10.0.0.0/24, 10.0.0.7 or fd00::/64"),
        ("  tokens:", "  max_body: 1023\n  tokens:",
         "7: max_body: found 1023, allowed: an integer from 1024 to 1073741824"),
        ("  tokens:", "  max_connections: 0\n  tokens:",
         "7: max_connections: found 0, allowed: an integer from 1 to 65535"),
        ("  tokens:", "  max_connections_per_source: 0\n  tokens:",
         "7: max_connections_per_source: found 0, allowed: an integer from 1 to 65535 or null"),
        ("  tokens:", "  when_full: wait\n  tokens:",
         "7: when_full: found 'wait', allowed: refuse or evict"),
        ("  tokens:", "  request_timeout: 0\n  tokens:",
         "7: request_timeout: found 0, allowed: a number from 0.001 to 31622400 seconds"),
        ("  tokens:", "  token: []\n  tokens:",
         "7: token: unknown key, allowed: bind, sources, tokens, max_body, max_connections, "
         "max_connections_per_source, when_full, request_timeout, tls, hosts; did you mean "
         "'tokens'?"),
        ("name: edge", "name: ''", f"8: tokens[0].name: found '', allowed: {TOKEN}"),
        ("name: edge", "name: '-'", f"8: tokens[0].name: found '-', allowed: {TOKEN}"),
        ("[plant]", "[]", f"10: tokens[0].memories: found an empty list, allowed: {SOME}"),
        ("[plant]", "[plan]", "10: tokens[0].memories[0]: found 'plan', allowed: plant, other; "
         "did you mean 'plant'?"),
        ("[plant]", "[plant, other, plant]",
         "10: tokens[0].memories[2]: found 'plant' again, allowed: once"),
        ("[coils]", "[]", f"11: tokens[0].areas: found an empty list, allowed: {SOME}"),
        ("read-write", "read-only\n      while_sealed: [holding_registers]",
         "13: tokens[0].while_sealed: found with access: read-only, allowed: only with "
         "read-write"),
        ("read-write", "all",
         "12: tokens[0].access: found 'all', allowed: read-only or read-write"),
        ("      access: read-write\n", "",
         "8: tokens[0].access: missing, allowed: read-only or read-write"),
    ],
)  # fmt: skip
def test_rest_is_checked(folder: Folder, old: str, new: str, problem: str) -> None:
    line, _, rest = problem.partition(" ")
    assert folder.problems(changed(REST, old, new)) == [f"p.yaml:{line} rest.{rest}"]


@pytest.mark.parametrize(
    ("digest", "found"),
    [
        ("my-secret-token", "text of 15 characters"),
        (HASH[1:], "text of 63 characters"),
        (f"{HASH}0", "text of 65 characters"),
        ("g" * 64, "text of 64 characters"),
        ("''", "text of 0 characters"),
        ("[my-secret-token]", "a list"),
    ],
)
def test_a_secret_in_the_place_of_its_hash_is_not_repeated(
    folder: Folder, digest: str, found: str
) -> None:
    (problem,) = folder.problems(changed(REST, HASH, digest))
    quote = "" if found.startswith("text") else ", as text"
    assert problem == f"p.yaml:9: rest.tokens[0].sha256: found {found}, allowed: {DIGEST}{quote}"


@pytest.mark.parametrize("text", [b"", b"\n"])
def test_the_hash_of_nothing_is_that_of_no_token(folder: Folder, text: bytes) -> None:
    digest = hashlib.sha256(text).hexdigest().upper()
    assert folder.problems(changed(REST, HASH, digest)) == [
        "p.yaml:9: rest.tokens[0].sha256: found the SHA-256 of an empty text, perhaps of an "
        "unset variable, allowed: that of a token, as from `holdfast token`"
    ]


def test_a_number_in_the_place_of_a_hash_is_not_repeated(folder: Folder) -> None:
    assert folder.problems(changed(REST, HASH, "123456")) == [
        f"p.yaml:9: rest.tokens[0].sha256: found a number, allowed: {DIGEST}, as text"
    ]


@pytest.mark.parametrize(
    ("tokens", "problem"),
    [
        ("my-secret-token", f"found text of 15 characters, allowed: {SOME} or none"),
        ("12345", f"found a number, allowed: {SOME} or none"),
        ("[]", f"found an empty list, allowed: {SOME} or none"),
        ("{}", f"found an empty mapping, allowed: {SOME} or none"),
        ("", f"found nothing, allowed: {SOME} or none"),
    ],
)
def test_tokens_are_a_list_or_none(folder: Folder, tokens: str, problem: str) -> None:
    text = MEMORIES + REST[: REST.index("tokens:")] + f"tokens: {tokens}\n"
    assert folder.problems(text) == [f"p.yaml:7: rest.tokens: {problem}"]


def test_a_secret_in_the_place_of_a_token_is_not_repeated(folder: Folder) -> None:
    text = MEMORIES + REST[: REST.index("tokens:")] + "tokens: [my-secret-token, 12345]\n"
    keys = "name, sha256, memories, areas, access, while_sealed, manage"
    assert folder.problems(text) == [
        f"p.yaml:7: rest.tokens[0]: found text of 15 characters, allowed: a mapping with the keys "
        f"{keys}",
        f"p.yaml:7: rest.tokens[1]: found a number, allowed: a mapping with the keys {keys}",
    ]


def test_tokens_are_said(folder: Folder) -> None:
    assert folder.problems(MEMORIES + REST[: REST.index("  tokens:")]) == [
        f"p.yaml:4: rest.tokens: missing, allowed: {SOME} or none"
    ]


@pytest.mark.parametrize("bind", ["0.0.0.0:80", "10.0.0.7:80", "[::]:80", "[fd00::1]:80"])
def test_rest_without_tokens_stays_on_loopback(folder: Folder, bind: str) -> None:
    rest = f"rest:\n  bind: '{bind}'\n  sources: [127.0.0.1]\n  tokens: none\n"
    assert folder.problems(MEMORIES + rest) == [
        f"p.yaml:7: rest.tokens: found 'none' with bind {bind}, "
        "allowed: none only on a loopback address"
    ]


@pytest.mark.parametrize("bind", ["127.0.0.1:80", "127.9.9.9:80", "[::1]:80"])
def test_rest_without_tokens_serves_loopback(folder: Folder, bind: str) -> None:
    rest = f"rest:\n  bind: '{bind}'\n  sources: [127.0.0.1]\n  tokens: none\n"
    config = folder.config(MEMORIES + rest).rest
    assert config is not None
    assert config.tokens == "none"


def test_tokens_differ_in_name_and_hash(folder: Folder) -> None:
    token = REST[REST.index("    - name") :].replace(HASH, HASH.upper())
    assert folder.problems(MEMORIES + REST + token) == [
        "p.yaml:13: rest.tokens[1].name: found 'edge', which is the name of rest.tokens[0] "
        "in line 8, allowed: a different one",
        "p.yaml:14: rest.tokens[1].sha256: found a hash, which is the sha256 of rest.tokens[0] "
        "in line 8, allowed: a different one",
    ]


@pytest.mark.parametrize(
    ("url", "problem"),
    [
        ("tcp://broker", f"found neither mqtt:// nor mqtts://, allowed: {URL}"),
        ("broker:1883", f"found neither mqtt:// nor mqtts://, allowed: {URL}"),
        ("MQTT://broker", f"found neither mqtt:// nor mqtts://, allowed: {URL}"),
        ("mqtt://", f"found no host, allowed: {URL}"),
        ("1883", f"found a number, allowed: {URL}"),
        ("mqtt://broker/", f"found more than host and port, allowed: {URL}"),
        ("mqtt://broker?password=secret", f"found more than host and port, allowed: {URL}"),
        ("mqtt://broker#secret", f"found more than host and port, allowed: {URL}"),
        ("mqtt://broker:0", f"found an invalid host or port, allowed: {HOST}"),
        ("mqtt://broker:65536", f"found an invalid host or port, allowed: {HOST}"),
        ("mqtt://user:secret", f"found an invalid host or port, allowed: {HOST}"),
        ("mqtt://bro ker", f"found an invalid host or port, allowed: {HOST}"),
        ("mqtt://[fd00::g]", f"found an invalid host or port, allowed: {HOST}"),
        ("mqtt://fd00::1", f"found an invalid host or port, allowed: {HOST}"),
        ("mqtt://10.0.0.010", f"found an invalid host or port, allowed: {HOST}"),
        ("mqtt://broker:+1", f"found an invalid host or port, allowed: {HOST}"),
        ("mqtt://user:secret@broker", f"found a user in the URL, allowed: {URL}; set username "
         "and password_file instead"),
        ("mqtt://user:se/cr#et@broker", f"found a user in the URL, allowed: {URL}; "
         "set username and password_file instead"),
    ],
)  # fmt: skip
def test_the_url_of_a_broker_is_checked_and_not_repeated(
    folder: Folder, url: str, problem: str
) -> None:
    assert folder.problems(changed(MQTT, "mqtts://broker", url)) == [
        f"p.yaml:5: mqtt.url: {problem}"
    ]


@pytest.mark.parametrize(
    ("topic", "problem"),
    [
        ("''", "found text of 0 bytes, allowed: a topic filter of 1 to 65535 bytes"),
        ("7", "found 7, allowed: a topic filter of 1 to 65535 bytes"),
        ("ü" * 32768, "found text of 65536 bytes, allowed: a topic filter of 1 to 65535 bytes"),
        ('"a\\0"', "found 'a\\x00', allowed: a topic filter without NUL or surrogates"),
        ("'a/#/b'", "found 'a/#/b', allowed: '#' only alone in the last level"),
        ("'a#'", "found 'a#', allowed: '#' only alone in the last level"),
        ("'##'", "found '##', allowed: '#' only alone in the last level"),
        ("'a/+b'", "found 'a/+b', allowed: '+' only alone in its level"),
        ("'++'", "found '++', allowed: '+' only alone in its level"),
    ],
)
def test_a_topic_filter_is_checked(folder: Folder, topic: str, problem: str) -> None:
    text = changed(MQTT, "plant/+/in/#", topic)
    assert folder.problems(text) == [f"p.yaml:8: mqtt.subscriptions[0].topic: {problem}"]


@pytest.mark.parametrize("topic", ["'#'", "'+'", "'+/#'", "/", "a//b", "'/+/'", "$share/g/a"])
def test_a_topic_filter_that_mqtt_allows_is_right(folder: Folder, topic: str) -> None:
    config = folder.config(changed(MQTT, "plant/+/in/#", topic)).mqtt
    assert config is not None
    assert config.subscriptions[0].topic == topic.strip("'")


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("  url: mqtts://broker\n", "",
         "4: url: missing, allowed: text, as in mqtt://127.0.0.1:1883 or mqtts://broker.example"),
        ("  client_id: plant\n", "", "4: client_id: missing, allowed: text"),
        ("client_id: plant", "client_id: ''",
         "6: client_id: found text of 0 bytes, allowed: text of 1 to 65535 bytes"),
        ("client_id: plant", "client_id: 5", "6: client_id: found 5, allowed: text of 1 to 65535 "
         "bytes; quote it to make it text"),
        ("  client", "  version: 4\n  client", "6: version: found 4, allowed: 5 or 3.1.1"),
        ("  client", "  version: 5.0\n  client", "6: version: found 5.0, allowed: 5 or 3.1.1"),
        ("  client", "  keep_alive: 0\n  client",
         "6: keep_alive: found 0, allowed: an integer from 1 to 65535 seconds"),
        ("  client", "  username: ''\n  client",
         "6: username: found text of 0 bytes, allowed: text of 1 to 65535 bytes"),
        ("  client", "  password_file: p.yaml\n  client",
         "6: password_file: found without username, allowed: both or neither"),
        ("  client", "  username: a\n  password_file: none.txt\n  client",
         "7: password_file: found 'none.txt', which can't be read: No such file or directory"),
        ("  client", "  username: a\n  password_file: /\n  client",
         "7: password_file: found '/', which can't be read: Is a directory"),
        ("  client", '  username: a\n  password_file: "\\0"\n  client',
         "7: password_file: found text of 1 characters, allowed: the path of a file, without "
         "'\\x00'; write a path in single quotes, or with /"),
        ("  client", "  username: a\n  password_file: hunter2\n  client", "7: password_file: found "
         "text of 7 characters, which can't be read: No such file or directory"),
        ("  client", "  username: a\n  password_file: |\n    hunter2\n  client",
         "8: password_file: found text of 8 characters, allowed: the path of a file, "
         "without '\\n'; write a path in single quotes, or with /"),
        ("  client", "  tls: {ca_file: none.pem}\n  client",
         "6: tls.ca_file: found 'none.pem', which can't be read: No such file or directory"),
        ("  client", "  tls: {cert_file: p.yaml}\n  client",
         "6: tls.cert_file: found without key_file, allowed: both or neither"),
        ("  client", "  tls: {key_file: p.yaml}\n  client",
         "6: tls.key_file: found without cert_file, allowed: both or neither"),
        ("  client", "  tls: {}\n  client",
         "6: tls: found with a url that begins with mqtt://, allowed: only with mqtts://"),
        ("topic:", "qos: 3, topic:", "8: subscriptions[0].qos: found 3, allowed: 0, 1 or 2"),
        ("topic:", "qos: true, topic:", "8: subscriptions[0].qos: found true, allowed: 0, 1 or 2"),
        ("[plant]", "[plnt]", "8: subscriptions[0].memories[0]: found 'plnt', "
         "allowed: plant, other; did you mean 'plant'?"),
        (", areas: [coils]", "", f"8: subscriptions[0].areas: missing, allowed: {SOME}"),
        ("[coils]}", "[coils], while_sealed: []}",
         f"8: subscriptions[0].while_sealed: found an empty list, allowed: {SOME}"),
        ("[coils]}", "[coils], while_sealed: [input_registers, input_registers]}",
         "8: subscriptions[0].while_sealed[1]: found 'input_registers' again, allowed: once"),
        ("[coils]}", "[coils], while_sealed: [coils]}",
         "8: subscriptions[0].while_sealed[0]: found 'coils', allowed: an area that is not in "
         "areas"),
        ("    - {topic: plant/+/in/#, memories: [plant], areas: [coils]}\n", "    []\n",
         f"7: subscriptions: found an empty list, allowed: {SOME} (optional with map)"),
    ],
)  # fmt: skip
def test_mqtt_is_checked(folder: Folder, old: str, new: str, problem: str) -> None:
    line, _, rest = problem.partition(" ")
    text = changed(MQTT, old, new)
    text = text.replace("mqtts", "mqtt") if rest.startswith("tls: ") else text
    assert folder.problems(text) == [f"p.yaml:{line} mqtt.{rest}"]


def test_a_password_in_the_file_is_an_unknown_key_and_not_repeated(folder: Folder) -> None:
    (problem,) = folder.problems(MEMORIES + MQTT + "  password: my-secret\n")
    assert problem.startswith("p.yaml:9: mqtt.password: unknown key, allowed: url, ")
    assert "my-secret" not in problem


def test_a_topic_is_subscribed_once(folder: Folder) -> None:
    again = MQTT[MQTT.index("    - {topic") :].replace("[plant]", "[other]")
    assert folder.problems(MEMORIES + MQTT + again) == [
        "p.yaml:9: mqtt.subscriptions[1].topic: found 'plant/+/in/#', which is the topic of "
        "mqtt.subscriptions[0] in line 8, allowed: a different one"
    ]


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("weather:", "rest:",
         f"5: adapters.rest: found 'rest', allowed: {OTHER}"),
        ("weather:", "mqtt:",
         f"5: adapters.mqtt: found 'mqtt', allowed: {OTHER}"),
        ("weather:", "gateway:", f"5: adapters.gateway: found 'gateway', allowed: {OTHER}"),
        ("weather:", "7:", f"5: adapters.7: found 7, allowed: {NAME}; quote it to make it text"),
        ("type: weather, ", "", "5: adapters.weather.type: missing, allowed: text"),
        ("type: weather", "type: a b", f"5: adapters.weather.type: found 'a b', allowed: {NAME}"),
        ("[plant]", "[othr]", "5: adapters.weather.memories[0]: found 'othr', "
         "allowed: plant, other; did you mean 'other'?"),
        ("[coils]", "[]", f"5: adapters.weather.areas: found an empty list, allowed: {SOME}"),
        (", access: read-only", "",
         "5: adapters.weather.access: missing, allowed: read-only or read-write"),
        ("read-only", "read-only, options: [1]",
         "5: adapters.weather.options: found a list, allowed: a mapping"),
        ("read-only", "read-only, options: {a: {b: [.nan]}}",
         "5: adapters.weather.options.a: found nan, allowed: finite numbers"),
        ("read-only", "read-only, options: {7: 1}", "5: adapters.weather.options.7: found 7, "
         "allowed: text; quote it to make it text"),
        ("{bind: 127.0.0.1:9464}", "{}", "6: metrics.bind: missing, allowed: text, as in "
         "0.0.0.0:502, 127.0.0.1:5020 or [::]:502"),
        ("{bind: 127.0.0.1:9464}", "{bind: '127.0.0.1:9464', sources: []}",
         f"6: metrics.sources: found an empty list, allowed: {SOME}"),
        ("file: audit.log", "fail: open", "7: audit.file: missing, "
         "allowed: text (optional with syslog or journald: true)"),
        ("file: audit.log", "journald: false", "7: audit.file: missing, "
         "allowed: text (optional with syslog or journald: true)"),
        ("file: audit.log", "journald: true, fail: closed",
         "7: audit.fail: found 'closed' without file, allowed: only with it"),
        ("file: audit.log", "journald: true, keep: 2",
         "7: audit.keep: found without file, allowed: only with it"),
        ("audit.log", "audit.log, fail: shut",
         "7: audit.fail: found 'shut', allowed: open or closed"),
        ("audit.log", "audit.log, syslog: {url: 'udp://a', facility: auth}", "7: audit.syslog: "
         "found a mapping, allowed: its url alone; the facility is always local0"),
        ("audit.log", "audit.log, syslog: 5",
         "7: audit.syslog: found a number, allowed: udp://host:port, tcp://host:port or "
         "unix:///path"),
        ("audit.log", "audit.log, syslog: 'tls://a'", "7: audit.syslog: found neither "
         "udp:// nor tcp://, allowed: udp://host:port, tcp://host:port or unix:///path"),
        ("audit.log", "audit.log, syslog: 'unix://log'",
         "7: audit.syslog: found 'unix://log', allowed: udp://host:port, tcp://host:port or "
         "unix:///path, with an absolute path"),
        ("audit.log", "none/audit.log", "7: audit.file: found 'none/audit.log', "
         "whose folder does not exist, allowed: a file in an existing folder"),
        ("audit.log", ".", "7: audit.file: found '.', which is a folder, "
         "allowed: a file in an existing folder"),
        ("audit.log", '"today\\new.log"', "7: audit.file: found 'today\\new.log', allowed: the "
         "path of a file, without '\\n'; write a path in single quotes, or with /"),
        ("audit.log", "audit.log, max_bytes: 65535",
         "7: audit.max_bytes: found 65535, allowed: an integer of at least 65536"),
        ("audit.log", "audit.log, keep: 1001",
         "7: audit.keep: found 1001, allowed: an integer from 1 to 1000"),
    ],
)  # fmt: skip
def test_adapters_metrics_and_audit_are_checked(
    folder: Folder, old: str, new: str, problem: str
) -> None:
    assert folder.problems(changed(EXTRAS, old, new) + REST) == [f"p.yaml:{problem}"]


def test_rest_and_metrics_need_sockets_of_their_own(folder: Folder) -> None:
    listener = (
        "listeners:\n  raw:\n    type: raw-ingest\n    bind: 0.0.0.0:8080\n    rules:\n"
        "      - {sources: [10.0.0.7], units: {1: plant}, areas: [coils]}\n"
    )
    metrics = "metrics: {bind: '[::]:8080'}\n"
    own = "allowed: an unused address and port"
    assert folder.problems(MEMORIES + listener + metrics + REST) == [
        f"p.yaml:10: metrics.bind: found '[::]:8080', which overlaps 0.0.0.0:8080 of "
        f"listeners.raw in line 7, {own}",
        f"p.yaml:10: metrics.bind: found '[::]:8080', which overlaps 127.0.0.1:8080 of "
        f"rest in line 12, {own}",
        f"p.yaml:12: rest.bind: found '127.0.0.1:8080', which overlaps 0.0.0.0:8080 of "
        f"listeners.raw in line 7, {own}",
    ]


def test_a_udp_listener_and_rest_share_a_port_number(folder: Folder) -> None:
    listener = (
        "listeners:\n  udp:\n    type: modbus-udp\n    bind: 127.0.0.1:8080\n    rules:\n"
        "      - {sources: [10.0.0.7], units: {1: plant}, access: read-only}\n"
    )
    assert folder.warnings(MEMORIES + listener + REST) == []


@pytest.mark.parametrize(
    ("text", "place"),
    [
        (REST, "11: rest.tokens[0].areas"),
        (MQTT, "8: mqtt.subscriptions[0].areas"),
        (MQTT + EXTRAS, "10: adapters.weather.areas"),
    ],
)
def test_an_area_that_no_memory_of_a_grant_has_is_a_warning(
    folder: Folder, text: str, place: str
) -> None:
    changed = text.replace("[coils]", "[coils, discrete_inputs]")
    message = "discrete_inputs has no effect: plant has no such area"
    assert folder.warnings(MEMORIES + changed)[-1] == f"p.yaml:{place}[1]: {message}"


SEALED = MEMORIES.replace("10}", "10, seal: {area: coils, address: 0}}")
OTHER_MQTT = MQTT.replace("[plant]", "[other]")
RAW = """\
listeners:
  raw:
    type: raw-ingest
    bind: 127.0.0.1:9000
    rules:
      - {sources: [10.0.0.7], units: {1: plant}, areas: [coils]}
"""
MODBUS = """\
listeners:
  modbus:
    type: modbus-tcp
    bind: 127.0.0.1:9000
    rules:
      - {sources: [10.0.0.7], units: {1: plant}, access: read-write}
"""
DEVICE = """\
devices:
  source:
    url: tcp://10.0.0.9
    unit: 1
    interval: 1
    reads:
      - area: discrete_inputs
        address: 9
        count: 2
        into: {memory: plant, area: coils, address: 0}
"""


def test_a_right_while_sealed_without_a_seal_is_a_warning(folder: Folder) -> None:
    mqtt = MQTT.replace("[coils]}", "[coils], while_sealed: [input_registers]}")
    no_effect = "has no effect: none of its memories with a seal has this area"
    at = "mqtt.subscriptions[0].while_sealed[0]"
    assert folder.warnings(MEMORIES + mqtt) == [f"p.yaml:8: {at}: input_registers {no_effect}"]
    assert folder.warnings(SEALED + mqtt) == []


@pytest.mark.parametrize(
    "text",
    [
        MODBUS,
        OTHER_MQTT,
        RAW.replace("[coils]", "[input_registers]"),
        REST.replace("read-write", "read-only"),
        OTHER_MQTT + EXTRAS,
        DEVICE.replace("address: 0}", "address: 1}"),
        DEVICE.replace("    unit", "    enabled: false\n    unit"),
    ],
)
def test_a_seal_that_nothing_can_open_is_a_warning(folder: Folder, text: str) -> None:
    assert folder.warnings(SEALED + text) == [
        "p.yaml:2: memories.plant.seal: can never be opened: no raw-ingest rule, token, "
        "subscription, adapter or device may write coils of plant"
    ]


@pytest.mark.parametrize(
    "text",
    [
        RAW,
        RAW.replace("{1: plant}", "{1: other, 2: plant}"),
        RAW.replace("bind", "format: crc\n    bind").replace(
            "units: {1: plant}", "memories: [plant]"
        ),
        REST,
        "rest: {bind: '127.0.0.1:80', sources: [127.0.0.1], tokens: none}\n",
        MQTT,
        OTHER_MQTT + EXTRAS.replace("read-only", "read-write"),
        DEVICE,
    ],
)
def test_a_seal_that_something_can_open_is_no_warning(folder: Folder, text: str) -> None:
    assert folder.warnings(SEALED + text) == []


def test_rest_and_metrics_have_names(folder: Folder) -> None:
    rest = "rest: {bind: '127.0.0.1:80', sources: [127.0.0.1], tokens: none, hosts: [A.Example]}\n"
    metrics = "metrics: {bind: '127.0.0.1:81', hosts: [holdfast, A.Example]}\n"
    config = folder.config(MEMORIES + rest + metrics)
    assert config.rest is not None
    assert config.metrics is not None
    assert config.rest.hosts == ("a.example",)
    assert config.metrics.hosts == ("holdfast", "a.example")
    [problem] = folder.problems(MEMORIES + rest + metrics.replace("holdfast", "'holdfast:9464'"))
    assert problem.startswith("p.yaml:5: metrics.hosts[0]: found 'holdfast:9464', allowed: ")


def test_with_tokens_names_of_rest_have_no_effect(folder: Folder) -> None:
    assert folder.warnings(MEMORIES + REST + "  hosts: [gw]\n") == [
        "p.yaml:13: rest.hosts: has no effect with tokens"
    ]


SHARED = """\
memories: {plant: {holding_registers: 10, replicate: {log: site}}, own: {holding_registers: 10}}
logs: {site: {node: a, SERVERS}}
mqtt:
  url: mqtt://broker
  client_id: plant
  subscriptions:
    - {topic: in, qos: QOS, memories: [own, plant], areas: [holding_registers]}
    - {topic: own, qos: 1, memories: [own], areas: [holding_registers]}
  map:
    - {topic: level, qos: QOS, memory: plant, tag: {area: holding_registers, address: 0}}
"""
KEPT = (
    "mqtt.{}[0].qos: found 1: messages that the broker keeps while this node is away are written "
    "to plant afterwards, over newer values of other nodes; with qos 0, it keeps none"
)


@pytest.mark.parametrize(
    ("servers", "qos", "told"),
    [
        ("servers: [nats://10.0.0.1:4222]", "1", ["subscriptions", "map"]),
        ("servers: [nats://10.0.0.1:4222]", "0", []),
        ("embedded: site", "1", []),
    ],
    ids=["kept", "not kept", "one machine"],
)
def test_messages_that_a_broker_keeps_for_one_of_several_nodes_are_a_warning(
    folder: Folder, servers: str, qos: str, told: list[str]
) -> None:
    found = folder.warnings(SHARED.replace("SERVERS", servers).replace("QOS", qos))
    assert [each.partition(": ")[2] for each in found] == [KEPT.format(each) for each in told]


@pytest.mark.parametrize("found", ["true", "1.0", "3.0", "2", '"3"'])
def test_replicas_of_a_log_are_one_of_three_numbers(folder: Folder, found: str) -> None:
    servers = f"servers: [nats://10.0.0.1:4222], replicas: {found}"
    [problem] = folder.problems(SHARED.replace("SERVERS", servers).replace("QOS", "0"))
    told = found.replace('"', "'")
    assert problem.endswith(f": logs.site.replicas: found {told}, allowed: 1, 3 or 5")


PASSED = """\
memories: {plant: {coils: 8, holding_registers: 100, input_registers: 10}}
devices:
  drive:
    url: tcp://10.0.0.9
    interval: 1
    writes: pass
    reads:
      - area: holding_registers
        address: 0
        count: 10
        into: {memory: plant, area: holding_registers, address: 20}
      - area: input_registers
        address: 0
        count: 4
        into: {memory: plant, area: input_registers, address: 0}
mqtt:
  url: mqtt://broker
  client_id: plant
"""
LATE = (
    "p.yaml:20: mqtt.subscriptions[0].qos: found 1: commands that the broker keeps while there is "
    "no connection are sent to drive afterwards, however old; with qos 0, it keeps none"
)


@pytest.mark.parametrize(
    ("qos", "area", "writes", "told"),
    [
        (1, "holding_registers", "pass", [LATE]),
        (2, "holding_registers", "pass", [LATE.replace("found 1", "found 2")]),
        (0, "holding_registers", "pass", []),
        (1, "coils", "pass", []),
        (1, "input_registers", "pass", []),
        (1, "holding_registers", "local", []),
    ],
)
def test_commands_for_a_device_that_a_broker_keeps_are_a_warning(
    folder: Folder, qos: int, area: str, writes: str, told: list[str]
) -> None:
    entry = f"{{topic: in, qos: {qos}, memories: [plant], areas: [{area}]}}"
    text = PASSED.replace("writes: pass", f"writes: {writes}")
    assert folder.warnings(f"{text}  subscriptions:\n    - {entry}\n") == told


@pytest.mark.parametrize(
    ("first", "second", "area", "warned"),
    [
        ("plant/commands", "plant/#", "holding_registers", True),
        ("plant/#", "plant", "holding_registers", True),
        ("plant/+/set", "plant/pump/+", "holding_registers", True),
        ("$share/group/plant/set", "plant/+", "holding_registers", True),
        ("plant/+", "plant", "holding_registers", False),
        ("plant/+/set", "plant/pump/get", "holding_registers", False),
        ("plant/commands", "plant/#", "coils", False),
    ],
)
def test_filters_that_deliver_a_command_for_a_device_twice_are_a_warning(
    folder: Folder, first: str, second: str, area: str, warned: bool
) -> None:
    entry = "    - {topic: '%s', qos: 0, memories: [plant], areas: [%s]}\n"
    text = PASSED + "  subscriptions:\n" + entry % (first, area)
    told = (
        f"p.yaml:21: mqtt.subscriptions[1].topic: found '{second}', which overlaps '{first}': a "
        "broker may deliver a message once for each of them, and its command is then sent to "
        "drive twice"
    )
    assert folder.warnings(text + entry % (second, "coils")) == [told] * warned


@pytest.mark.parametrize(
    ("address", "kind", "writes", "warned"),
    [
        (20, "uint16", "pass", True),
        (29, "uint16", "pass", True),
        (19, "float32", "pass", True),
        (19, "uint16", "pass", False),
        (30, "uint16", "pass", False),
        (20, "uint16", "local", False),
    ],
)
def test_plain_values_for_a_device_are_a_warning(
    folder: Folder, address: int, kind: str, writes: str, warned: bool
) -> None:
    tag = f"{{area: holding_registers, address: {address}, type: {kind}}}"
    text = PASSED.replace("writes: pass", f"writes: {writes}")
    entry = f"  map:\n    - {{topic: a, memory: plant, tag: {tag}}}\n"
    message = "its range mirrors drive, which is not sent plain values"
    told = [f"p.yaml:20: mqtt.map[0]: has no effect: {message}"] if warned else []
    assert folder.warnings(text + entry) == told
