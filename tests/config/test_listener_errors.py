"""What wrong listeners are told, beside those of Modbus TCP: UDP, serial lines, raw ingest."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from holdfast.config.models.listeners import LISTENER_TYPES
from holdfast.runtime.text import either
from support.config_folder import Folder

if TYPE_CHECKING:
    from pathlib import Path

MEMORIES = """\
memories:
  plant: {id: 1, coils: 8, input_registers: 10}
  other: {coils: 8}
listeners:
"""
UDP = """\
  udp:
    type: modbus-udp
    bind: 127.0.0.1:5020
    rules:
      - {sources: [10.0.0.0/8], units: {1: plant}, access: read-only}
"""
RTU = """\
  rtu:
    type: modbus-rtu
    serial: {device: /dev/ttyUSB0}
    rules:
      - {units: {1: plant}, access: read-only}
"""
ASCII = RTU.replace("rtu", "ascii")
V1 = """\
  raw:
    type: raw-ingest
    bind: 127.0.0.1:9000
    rules:
      - {sources: [10.0.0.0/8], units: {1: plant}, areas: [coils]}
"""
CRC = """\
  raw:
    type: raw-ingest
    format: crc
    bind: 127.0.0.1:9000
    rules:
      - {sources: [10.0.0.0/8], memories: [plant], areas: [coils]}
"""
NAME = "1 to 64 letters, digits, '_', '.' and '-'"
TLS = """\
  tls:
    type: modbus-tls
    bind: 127.0.0.1:8020
    tls: {cert_file: c.pem, key_file: k.pem, ca_file: a.pem}
    rules:
      - {sources: [10.0.0.0/8], roles: [engineer], units: {1: plant}, access: read-write}
"""
PEM = {"c_pem": "", "k_pem": "", "a_pem": ""}
AREAS = "coils, discrete_inputs, holding_registers or input_registers"
SERIAL_UNIT = (
    "a unit id from 1 to 247, or a range, as in 20-40; 0 is the broadcast, 248 to 255 are reserved"
)
SOME = "a list with at least one entry"
MOVED = "moved, allowed: no key for the strict protocol, otherwise compat"


@pytest.fixture
def folder(tmp_path: Path) -> Folder:
    return Folder(tmp_path)


def changed(text: str, old: str, new: str) -> str:
    assert text.count(old) == 1, old
    return MEMORIES + text.replace(old, new)


def test_a_listener_says_what_it_is(folder: Folder) -> None:
    text = MEMORIES + "  a: {bind: 127.0.0.1:1, rules: []}\n  b: 5\n  c: []\n"
    types = either(sorted(LISTENER_TYPES))
    assert folder.problems(text) == [
        f"p.yaml:5: listeners.a.type: missing, allowed: {either(LISTENER_TYPES)}",
        f"p.yaml:6: listeners.b: found 5, allowed: a mapping with the type {types}",
        f"p.yaml:7: listeners.c: found an empty list, allowed: a mapping with the type {types}",
    ]


def test_a_listener_has_no_name_of_a_service_in_logs(folder: Folder) -> None:
    assert folder.problems(changed(UDP, "  udp:", "  rest:")) == [
        "p.yaml:5: listeners.rest: found 'rest', allowed: a name other than rest, mqtt, nats, "
        "gateway or metrics"
    ]


def test_a_listener_of_an_unknown_type_has_its_memories_checked(folder: Folder) -> None:
    text = changed(UDP, "modbus-udp", "udp").replace("{1: plant}", "{1: plan}")
    assert folder.problems(text) == [
        f"p.yaml:6: listeners.udp.type: found 'udp', allowed: {either(LISTENER_TYPES)}",
        "p.yaml:9: listeners.udp.rules[0].units.1: found 'plan', allowed: plant, other; "
        "did you mean 'plant'?",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        (
            "    rules:",
            "    idle_timeout: 5\n    rules:",
            "8: idle_timeout: unknown key, allowed: type, bind, listen_only, event_log, rules",
        ),
        ("{1: plant}", "{256: plant}", "9: rules[0].units.256: found 256, allowed: a unit id from "
         "0 to 255, or a range, as in 20-40"),
        ("read-only", "rw", "9: rules[0].access: found 'rw', allowed: read-only or read-write"),
        ("read-only", "read-only, deny: [3, 3]", "9: rules[0].deny[1]: found 3 again, "
         "allowed: once"),
    ],
)  # fmt: skip
def test_a_udp_listener_is_checked(folder: Folder, old: str, new: str, problem: str) -> None:
    line, _, rest = problem.partition(" ")
    assert folder.problems(changed(UDP, old, new)) == [f"p.yaml:{line} listeners.udp.{rest}"]


def test_a_listener_for_rtu_over_tcp_is_checked_like_modbus_tcp(folder: Folder) -> None:
    text = changed(UDP, "modbus-udp", "modbus-rtu-over-tcp").replace("rules:", "when_full: no\n"
                                                                     "    rules: &r")  # fmt: skip
    assert folder.problems(text.replace("{1: plant}", "{1: nix}")) == [
        "p.yaml:8: listeners.udp.when_full: found 'no', allowed: refuse or evict",
        "p.yaml:10: listeners.udp.rules[0].units.1: found 'nix', allowed: plant, other",
    ]


@pytest.mark.parametrize(
    ("serial", "problem"),
    [
        ("{}", "serial.device: missing, allowed: text, as in /dev/ttyUSB0 or COM3"),
        ("{device: ''}", "serial.device: found text of 0 bytes, allowed: text of 1 to 4095 bytes"),
        ("{device: 3}", "serial.device: found 3, allowed: text of 1 to 4095 bytes; "
         "quote it to make it text"),
        ('{device: "a\\0"}', "serial.device: found 'a\\x00', allowed: text without '\\x00'"),
        ("{device: a, baud: 49}", "serial.baud: found 49, allowed: an integer from 50 to 4000000"),
        ("{device: a, baud: 4000001}",
         "serial.baud: found 4000001, allowed: an integer from 50 to 4000000"),
        ("{device: a, parity: mark}", "serial.parity: found 'mark', allowed: none, even or odd"),
        ("{device: a, stop_bits: 3}", "serial.stop_bits: found 3, allowed: 1 or 2"),
        ("{device: a, stop_bits: true}", "serial.stop_bits: found true, allowed: 1 or 2"),
        ("{device: a, stop_bits: 1.0}", "serial.stop_bits: found 1.0, allowed: 1 or 2"),
        ("{device: a, stop_bits: }", "serial.stop_bits: found nothing, allowed: 1 or 2"),
        ("{device: a, data_bits: 7}",
         "serial.data_bits: removed, RTU has 8 data bits: delete the key"),
        ("{device: a, silence: 0}",
         "serial.silence: found 0, allowed: a number from 0.0001 to 10 seconds"),
        ("{device: a, silence: }",
         "serial.silence: found nothing, allowed: a number from 0.0001 to 10 seconds"),
        ("{device: a, sillence: 1}", "serial.sillence: unknown key, allowed: device, baud, parity, "
         "stop_bits, rs485, silence; did you mean 'silence'?"),
        ("/dev/ttyUSB0", "serial: found '/dev/ttyUSB0', allowed: a mapping with the keys device, "
         "baud, parity, stop_bits, rs485, silence"),
    ],
)  # fmt: skip
def test_an_rtu_line_is_checked(folder: Folder, serial: str, problem: str) -> None:
    text = changed(RTU, "{device: /dev/ttyUSB0}", serial)
    assert folder.problems(text) == [f"p.yaml:7: listeners.rtu.{problem}"]


@pytest.mark.parametrize(
    ("serial", "problem"),
    [
        ("data_bits: 6", "data_bits: found 6, allowed: 7 or 8"),
        (
            "silence: 1",
            "silence: unknown key, allowed: device, baud, parity, stop_bits, rs485, data_bits",
        ),
    ],
)
def test_an_ascii_line_is_checked(folder: Folder, serial: str, problem: str) -> None:
    text = changed(ASCII, "ttyUSB0}", f"ttyUSB0, {serial}}}")
    assert folder.problems(text) == [f"p.yaml:7: listeners.ascii.serial.{problem}"]


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("{1: plant}", "{0: plant}", f"units.0: found 0, allowed: {SERIAL_UNIT}"),
        ("{1: plant}", "{248: plant}", f"units.248: found 248, allowed: {SERIAL_UNIT}"),
        ("{1: plant}", "{true: plant, 1: plant}",
         "units: found the key true, allowed: text or an integer; quote it to make it text"),
        ("{1: plant}", "{1: plan}",
         "units.1: found 'plan', allowed: plant, other; did you mean 'plant'?"),
        ("{units", "{sources: [10.0.0.0/8], units",
         "sources: not allowed on a serial line, allowed: units, access, functions, deny"),
        ("{units", "{sources: 5, units",
         "sources: not allowed on a serial line, allowed: units, access, functions, deny"),
        ("read-only", "read-only, areas: []",
         "areas: unknown key, allowed: units, access, functions, deny"),
        ("read-only", "read-only, functions: [3, 3]", "functions[1]: found 3 again, allowed: once"),
        ("read-only", "read-only, functions: [3], deny: [4]",
         "deny: found together with functions, allowed: only one of them"),
    ],
)  # fmt: skip
def test_a_rule_of_a_serial_line_is_checked(
    folder: Folder, old: str, new: str, problem: str
) -> None:
    assert folder.problems(changed(RTU, old, new)) == [
        f"p.yaml:9: listeners.rtu.rules[0].{problem}"
    ]


def test_a_second_rule_of_a_serial_line_is_a_warning(folder: Folder) -> None:
    text = MEMORIES + RTU + "      - {units: {1: other}, access: read-write}\n"
    assert folder.warnings(text) == [
        "p.yaml:10: listeners.rtu.rules[1]: never matches: all its units are "
        "covered by rules[0] in line 9"
    ]


@pytest.mark.parametrize("device", ["/dev/ttyUSB0", "/dev//ttyUSB0", "/dev/../dev/ttyUSB0"])
def test_serial_lines_need_ports_of_their_own(folder: Folder, device: str) -> None:
    assert folder.problems(MEMORIES + RTU + ASCII.replace("/dev/ttyUSB0", device)) == [
        f"p.yaml:12: listeners.ascii.serial.device: found '{device}', which is the device of "
        "listeners.rtu in line 5, allowed: a different one"
    ]


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("    bind", "    format: v2\n    bind", "7: format: found 'v2', allowed: v1 or crc"),
        ("    bind", "    compat: {crc: none}\n    bind",
         "7: compat.crc: found with format v1, allowed: only with format crc"),
        ("    bind", "    compat: {flags: ignore}\n    bind",
         "7: compat.flags: found with format v1, allowed: only with format crc"),
        ("    bind", "    compat: {after_refusal: continue}\n    bind",
         "7: compat.after_refusal: found without packets: many, allowed: only with it"),
        ("    bind", "    compat: {packets: one}\n    bind",
         "7: compat.packets: found 'one', allowed: many"),
        ("    bind", "    compat: \n    bind", "7: compat: found nothing, allowed: a mapping with "
         "the keys packets, after_refusal, crc, flags"),
        ("    bind", "    packets: many\n    bind",
         "7: packets: moved, allowed: compat: {packets: many}"),
        ("    bind", "    packets: one\n    bind", f"7: packets: {MOVED}: {{packets: many}}"),
        ("    bind", "    after_refusal: continue\n    bind",
         "7: after_refusal: moved, allowed: compat: {after_refusal: continue}"),
        ("    bind", "    crc: none\n    bind", "7: crc: moved, allowed: compat: {crc: none}"),
        ("    bind", "    flags: ignore\n    bind",
         "7: flags: moved, allowed: compat: {flags: ignore}"),
        ("    bind", "    when_full: wait\n    bind",
         "7: when_full: found 'wait', allowed: refuse or evict"),
        ("    bind", "    listen_only: true\n    bind", "7: listen_only: unknown key, allowed: "
         "type, bind, max_connections, max_connections_per_source, when_full, idle_timeout, "
         "request_timeout, format, tls, compat, rules"),
        ("    bind", "    tls: 1\n    bind", "7: tls: found 1, allowed: a mapping with the keys "
         "cert_file, key_file, key_passphrase_file, ca_file, crl_file, review"),
        ("    bind", "    max_requests_per_source: null\n    bind",
         "7: max_requests_per_source: removed, there is no limit per second: an address waits only "
         "while others do: delete the key"),
        ("    bind", "    max_writes_per_source: 20\n    bind",
         "7: max_writes_per_source: removed, there is no limit per second: an address waits only "
         "while others do: delete the key"),
        ("    bind", "    max_handshakes: 9\n    bind", "7: max_handshakes: removed, it is "
         "max_connections, at least 256: delete the key"),
        ("    bind", "    max_connections: 0\n    bind",
         "7: max_connections: found 0, allowed: an integer from 1 to 65535"),
        ("units: {1: plant}, ", "",
         "9: rules[0].units: missing with format v1, allowed: a mapping with at least one entry"),
        ("units: {1: plant}", "units: {}",
         "9: rules[0].units: found an empty mapping, allowed: a mapping with at least one entry"),
        ("{1: plant}", "{65536: plant}",
         "9: rules[0].units.65536: found 65536, allowed: a unit id from 0 to 65535"),
        ("{1: plant}", "{1: plan}", "9: rules[0].units.1: found 'plan', allowed: plant, other; "
         "did you mean 'plant'?"),
        ("{1: plant}", "{1: plant}, memories: [plant]",
         "9: rules[0].memories: found with format v1, allowed: units"),
        (", areas: [coils]", "", f"9: rules[0].areas: missing, allowed: {SOME}"),
        ("[coils]", "[]", f"9: rules[0].areas: found an empty list, allowed: {SOME}"),
        ("[coils]", "coils", f"9: rules[0].areas: found 'coils', allowed: {SOME}"),
        ("[coils]", "[coil]",
         f"9: rules[0].areas[0]: found 'coil', allowed: {AREAS}; did you mean 'coils'?"),
        ("[coils]", "[coils, input_registers, coils]",
         "9: rules[0].areas[2]: found 'coils' again, allowed: once"),
        ("sources: [10.0.0.0/8], ", "", f"9: rules[0].sources: missing, allowed: {SOME}"),
        ("areas: [coils]", "areas: [coils], access: read-write",
         "9: rules[0].access: unknown key, allowed: sources, units, memories, areas, roles"),
    ],
)  # fmt: skip
def test_raw_ingest_of_format_v1_is_checked(
    folder: Folder, old: str, new: str, problem: str
) -> None:
    line, _, rest = problem.partition(" ")
    assert folder.problems(changed(V1, old, new)) == [f"p.yaml:{line} listeners.raw.{rest}"]


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("    bind", "    compat: {crc: required}\n    bind",
         "8: compat.crc: found 'required', allowed: none"),
        ("    bind", "    compat: {crc: }\n    bind",
         "8: compat.crc: found nothing, allowed: none"),
        ("    bind", "    crc: if-present\n    bind", "8: crc: moved, allowed: no key, if all "
         "senders send a CRC, otherwise compat: {crc: none}"),
        ("    bind", "    crc: required\n    bind", f"8: crc: {MOVED}: {{crc: none}}"),
        ("    bind", "    flags: strict\n    bind", f"8: flags: {MOVED}: {{flags: ignore}}"),
        ("    bind", "    compat: {flags: any}\n    bind",
         "8: compat.flags: found 'any', allowed: ignore"),
        ("memories: [plant], ", "",
         f"10: rules[0].memories: missing with format crc, allowed: {SOME}"),
        ("[plant]", "[]", f"10: rules[0].memories: found an empty list, allowed: {SOME}"),
        ("[plant]", "[plan]", "10: rules[0].memories[0]: found 'plan', allowed: plant, other; "
         "did you mean 'plant'?"),
        ("[plant]", "[plant, other]", "10: rules[0].memories[1]: found 'other', which has no id, "
         "allowed: a memory with an id"),
        ("[plant]", "[plant, plant]",
         "10: rules[0].memories[1]: found 'plant' again, allowed: once"),
        ("[plant]", "[7]",
         f"10: rules[0].memories[0]: found 7, allowed: {NAME}; quote it to make it text"),
        ("[plant]", "[plant], units: {1: plant}",
         "10: rules[0].units: found with format crc, allowed: memories"),
    ],
)  # fmt: skip
def test_raw_ingest_of_format_crc_is_checked(
    folder: Folder, old: str, new: str, problem: str
) -> None:
    line, _, rest = problem.partition(" ")
    text = changed(CRC, old, new)
    assert folder.problems(text) == [f"p.yaml:{line} listeners.raw.{rest}"]


def test_packets_on_a_modbus_port_are_checked_as_those_of_a_listener(folder: Folder) -> None:
    text = """\
  both:
    type: modbus-tcp
    bind: 127.0.0.1:5020
    rules:
      - {sources: [10.0.0.0/8], units: {1: plant}, access: read-only}
    raw_ingest:
      flags: ignore
      compat: {crc: none, after_refusal: continue}
      rules:
        - {sources: [10.0.0.0/8], units: {1: plant}, areas: [coils]}
"""
    at = "listeners.both.raw_ingest"
    assert folder.problems(MEMORIES + text) == [
        f"p.yaml:11: {at}.flags: moved, allowed: compat: {{flags: ignore}}",
        f"p.yaml:12: {at}.compat.crc: found with format v1, allowed: only with format crc",
        f"p.yaml:12: {at}.compat.after_refusal: found without packets: many, allowed: only with it",
    ]


def test_all_problems_of_a_raw_ingest_rule_are_told_at_once(folder: Folder) -> None:
    text = changed(CRC, "[10.0.0.0/8], memories: [plant]", "[x], units: {1: a}, memories: [plan]")
    found = [line.partition(": found")[0] for line in folder.problems(text.replace("[coils]", "5"))]
    rule = "p.yaml:10: listeners.raw.rules[0]"
    assert found == [
        f"{rule}.sources[0]",
        f"{rule}.units",
        f"{rule}.units.1",
        f"{rule}.memories[0]",
        f"{rule}.areas",
    ]


def test_a_raw_ingest_rule_that_an_earlier_one_covers_is_a_warning(folder: Folder) -> None:
    rule = "      - {sources: [10.1.0.0/16], units: {1: plant}, areas: [coils]}\n"
    assert folder.warnings(MEMORIES + V1 + rule) == [
        "p.yaml:10: listeners.raw.rules[1]: never matches: all its sources are covered by "
        "rules[0] in line 9"
    ]


@pytest.mark.parametrize(
    ("memories", "have"),
    [("{1: plant, 2: plant}", "plant has"), ("{1: plant, 2: other}", "plant, other have")],
)
def test_an_area_that_no_memory_of_a_rule_has_is_a_warning(
    folder: Folder, memories: str, have: str
) -> None:
    text = changed(V1, "{1: plant}", memories).replace("[coils]", "[coils, discrete_inputs]")
    assert folder.warnings(text) == [
        "p.yaml:9: listeners.raw.rules[0].areas[1]: discrete_inputs has no effect: "
        f"{have} no such area"
    ]


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("modbus-tcp", "modbus-rtu-over-tcp"),
        ("modbus-tcp", "modbus-ascii-over-tcp"),
        ("modbus-udp", "modbus-udp"),
        ("modbus-udp", "modbus-rtu-over-udp"),
        ("modbus-tcp", "raw-ingest"),
    ],
)
def test_sockets_of_one_protocol_do_not_overlap(folder: Folder, one: str, other: str) -> None:
    first = UDP.replace("modbus-udp", one)
    second = V1.replace("127.0.0.1:9000", "0.0.0.0:5020")
    if other != "raw-ingest":
        second = (
            UDP.replace("modbus-udp", other).replace("udp:", "raw:").replace("127.0.0.1", "0.0.0.0")
        )
    assert folder.problems(MEMORIES + first + second) == [
        "p.yaml:12: listeners.raw.bind: found '0.0.0.0:5020', which overlaps 127.0.0.1:5020 of "
        "listeners.udp in line 7, allowed: an unused address and port"
    ]


def test_tcp_and_udp_share_a_port_number(folder: Folder) -> None:
    tcp = UDP.replace("modbus-udp", "modbus-tcp").replace("udp:", "tcp:")
    assert list(folder.config(MEMORIES + UDP + tcp).listeners) == ["udp", "tcp"]


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("tls: {", "tlsx: {", "5: tls: missing, allowed: a mapping with the keys cert_file, "
         "key_file, key_passphrase_file, ca_file, crl_file, review"),
        ("key_file: k.pem, ", "", "8: tls.key_file: missing, allowed: text"),
        ("k.pem", "5", "8: tls.key_file: found 5, allowed: text"),
        ("k.pem", "''", "8: tls.key_file: found '', allowed: the path of a file"),
        ("k.pem", "x.pem", "8: tls.key_file: found 'x.pem', which can't be read: No such file or "
         "directory"),
        ("a.pem", "a.pem, crl_file: .", "8: tls.crl_file: found '.', which can't be read: Is a "
         "directory"),
        ("a.pem", "a.pem, crl_file: ", "8: tls.crl_file: found nothing, allowed: text"),
        ("a.pem", "a.pem, expired_crl: accept", "8: tls.expired_crl: removed, clients are refused "
         "after the nextUpdate of a list: delete the key, and fetch a list with a later nextUpdate "
         "for crl_file"),
        ("a.pem", "a.pem, ca: a.pem", "8: tls.ca: unknown key, allowed: cert_file, key_file, "
         "key_passphrase_file, ca_file, crl_file, review"),
        ("[engineer]", "engineer", f"10: rules[0].roles: found 'engineer', allowed: {SOME}"),
        ("[engineer]", "[]", f"10: rules[0].roles: found an empty list, allowed: {SOME}"),
        ("[engineer]", "", f"10: rules[0].roles: found nothing, allowed: {SOME}"),
        ("[engineer]", "[5]", "10: rules[0].roles[0]: found 5, allowed: text of 0 to 255 bytes; "
         "quote it to make it text"),
        ("[engineer]", "[a, a]", "10: rules[0].roles[1]: found 'a' again, allowed: once"),
    ],
)  # fmt: skip
def test_a_tls_listener_is_checked(folder: Folder, old: str, new: str, problem: str) -> None:
    line, _, rest = problem.partition(": ")
    found = folder.problems(changed(TLS, old, new), **PEM)
    assert f"p.yaml:{line}: listeners.tls.{rest}" in found


def test_roles_are_for_tls_only(folder: Folder) -> None:
    rule = "{sources: [10.0.0.0/8], roles: [a], units: {1: plant}, access: read-only}"
    plain = MEMORIES + f"  udp: {{type: modbus-udp, bind: '127.0.0.1:1', rules: [{rule}]}}\n"
    assert folder.problems(plain) == [
        "p.yaml:5: listeners.udp.rules[0].roles: unknown key, allowed: sources, units, access, "
        "functions, deny"
    ]


@pytest.mark.parametrize(
    ("roles", "never"),
    [
        ("roles: [engineer], ", "its sources, roles and units are covered by rules[0] in line 10"),
        ("roles: [engineer, operator], ", None),
        ("roles: [''], ", None),
        ("", None),
    ],
)
def test_a_rule_that_earlier_ones_cover_in_all_its_roles_is_a_warning(
    folder: Folder, roles: str, never: str | None
) -> None:
    for name in PEM:
        (folder.path / name.replace("_", ".")).touch()
    rule = f"      - {{sources: [10.1.0.0/16], {roles}units: {{1: plant}}, access: read-only}}\n"
    place = "p.yaml:11: listeners.tls.rules[1]: never matches: "
    assert folder.warnings(MEMORIES + TLS + rule) == ([place + never] if never else [])


def test_a_rule_for_any_role_covers_those_for_one(folder: Folder) -> None:
    for name in PEM:
        (folder.path / name.replace("_", ".")).touch()
    rules = (
        "      - {sources: [10.0.0.0/8], units: {1: plant}, access: read-only}\n"
        "      - {sources: [10.0.0.0/8], roles: [engineer, x], units: {1: plant}, "
        "access: read-only}\n"
    )
    assert folder.warnings(MEMORIES + TLS + rules) == [
        "p.yaml:12: listeners.tls.rules[2]: never matches: its sources, roles and units are "
        "covered by rules[0] in line 10 and rules[1] in line 11"
    ]
