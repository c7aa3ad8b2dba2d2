"""What a wrong configuration is told: where, what was found, what is allowed; all of it at once."""

from __future__ import annotations

import copy
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.config import Config, ConfigError, Problem, load
from holdfast.config.loader import checked
from holdfast.config.text import yaml_document
from holdfast.config.text.yaml_document import parse, table
from support.config_folder import Folder
from support.paths import EXAMPLES

if TYPE_CHECKING:
    from collections.abc import Iterator


MEMORIES = """\
memories:
  plant: {coils: 8, discrete_inputs: {start: 100, size: 8}, holding_registers: 10}
"""
LISTENERS = """\
listeners:
  scada:
    type: modbus-tcp
    bind: 127.0.0.1:5020
    rules:
      - sources: [10.0.0.0/8]
        units: {1: plant}
        access: read-only
"""
GOOD = MEMORIES + LISTENERS


@pytest.fixture
def folder(tmp_path: Path) -> Folder:
    return Folder(tmp_path)


def changed(old: str, new: str, text: str = GOOD) -> str:
    assert text.count(old) == 1, old
    return text.replace(old, new)


AREA = "an integer from 1 to 65536 or a mapping with the keys start, size"
SOURCE = "a network or an address, as in 10.0.0.0/24, 10.0.0.7 or fd00::/64"
BRACKETS = "text that begins with [, { or a quote needs quotes around the whole, as in '[::1]:502'"
BIND = "address:port with an IP address, as in 127.0.0.1:502 or, with quotes, '[::1]:502'"
CODES = "1, 2, 3, 4, 5, 6, 7, 8, 11, 12, 15, 16, 17, 20, 21, 22, 23, 24 or 43"
TOP = (
    "memories, logs, identity, listeners, profiles, devices, links, rest, mqtt, nats, gateway, "
    "outputs, adapters, metrics, audit, log, reload, workers"
)
TYPES = (
    "modbus-tcp, modbus-tls, modbus-rtu-over-tcp, modbus-ascii-over-tcp, raw-ingest, modbus-udp, "
    "modbus-rtu-over-udp, modbus-rtu or modbus-ascii"
)
NAME = "1 to 64 letters, digits, '_', '.' and '-'"
UNIT = "a unit id from 0 to 255, or a range, as in 20-40"
RULE = "listeners.scada.rules[0]"


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("coils: 8", "coils: 0", f"2: memories.plant.coils: found 0, allowed: {AREA}"),
        ("coils: 8", "coils: 65537", f"2: memories.plant.coils: found 65537, allowed: {AREA}"),
        ("coils: 8", "coils: true", f"2: memories.plant.coils: found true, allowed: {AREA}"),
        ("coils: 8", "coils: 8.0", f"2: memories.plant.coils: found 8.0, allowed: {AREA}"),
        ("coils: 8", "coils: '8'", f"2: memories.plant.coils: found '8', allowed: {AREA}"),
        ("coils: 8", "coils: ", f"2: memories.plant.coils: found nothing, allowed: {AREA}"),
        (
            "coils: 8",
            "coils: {start: 1}",
            "2: memories.plant.coils.size: missing, allowed: an integer from 1 to 65536",
        ),
        (
            "start: 100, size: 8",
            "start: 65530, size: 8",
            "2: memories.plant.discrete_inputs: found start 65530 and size 8, "
            "allowed: a sum up to 65536",
        ),
        (
            "coils: 8",
            "coils: 8, id: 65536",
            "2: memories.plant.id: found 65536, allowed: an integer from 0 to 65535",
        ),
        (
            "coils: 8",
            "coils: 8, id: ",
            "2: memories.plant.id: found nothing, allowed: an integer from 0 to 65535",
        ),
        (
            "coils: 8",
            "coils: 8, seal: {area: holding_registers, address: 1}",
            "2: memories.plant.seal.area: found 'holding_registers', "
            "allowed: coils or discrete_inputs",
        ),
        (
            "coils: 8",
            "coils: 8, seal: {area: discrete_inputs, address: 8}",
            "2: memories.plant.seal.address: found 8, allowed in discrete_inputs: 100 to 107",
        ),
        (
            "coils: 8",
            "seal: {area: coils, address: 8}",
            "2: memories.plant.seal.area: found 'coils', an area that this memory does not have, "
            "allowed: discrete_inputs",
        ),
        (
            "coils: 8",
            "coils: 8, seal: {area: coils, address: 1, mode: twice}",
            "2: memories.plant.seal.mode: found 'twice', allowed: once or level",
        ),
        (
            "coils: 8",
            "coils: 8, files: {0: 1}",
            "2: memories.plant.files.0: found 0, allowed: a file number from 1 to 65535",
        ),
        (
            "coils: 8",
            "coils: 8, files: {4: 10001}",
            "2: memories.plant.files.4: found 10001, allowed: an integer from 1 to 10000",
        ),
        (
            "coils: 8",
            "coils: 8, fifo: [9]",
            "2: memories.plant.fifo[0]: found 9, allowed: those of a count and a register after "
            "it, of 0 to 9",
        ),
        (
            "coils: 8",
            "coils: 8, fifo: [3, 3]",
            "2: memories.plant.fifo[1]: found 3 again, allowed: once",
        ),
        (
            "holding_registers: 10",
            "fifo: [3]",
            "2: memories.plant.fifo[0]: found 3, allowed: none: the memory has no "
            "holding_registers",
        ),
        (
            "coils: 8",
            "coils: 8, initial: v.txt",
            "2: memories.plant.initial: found 'v.txt', "
            "allowed: a file with one of .csv, .yaml, .yml",
        ),
        (
            "coils: 8",
            "coils: 8, initial: none.csv",
            "2: memories.plant.initial: found 'none.csv', which can't be read: "
            "No such file or directory",
        ),
        ("coils: 8", "coils: 8, initial: 7", "2: memories.plant.initial: found 7, allowed: text"),
    ],
)
def test_a_memory_is_checked(folder: Folder, old: str, new: str, problem: str) -> None:
    assert folder.problems(changed(old, new)) == [f"p.yaml:{problem}"]


def test_initial_values_in_another_encoding_are_found_at_their_line(folder: Folder) -> None:
    (folder.path / "v.csv").write_bytes(b"area,address,value\ncoils,1,\xb9\n")
    assert folder.problems(changed("coils: 8", "coils: 8, initial: v.csv")) == [
        "v.csv:2: not UTF-8, allowed: YAML or CSV in UTF-8"
    ]


def test_a_memory_has_an_area(folder: Folder) -> None:
    assert folder.problems("memories:\n  plant: {}\n" + LISTENERS) == [
        "p.yaml:2: memories.plant: no area, allowed: at least one of "
        "coils, discrete_inputs, holding_registers, input_registers"
    ]


def test_ids_of_memories_differ(folder: Folder) -> None:
    memories = "memories:\n  a: {id: 7, coils: 1}\n  plant:\n    id: 7\n    coils: 1\n"
    assert folder.problems(memories + LISTENERS) == [
        "p.yaml:4: memories.plant.id: found 7, which is the id of memories.a in line 2, "
        "allowed: a different one"
    ]


@pytest.mark.parametrize(
    ("name", "spelled", "problem"),
    [
        ("'bad name'", "'bad name'", f"found 'bad name', allowed: {NAME}"),
        ("''", "''", f"found '', allowed: {NAME}"),
        ("7", "7", f"found 7, allowed: {NAME}; quote it to make it text"),
    ],
)
def test_names_are_plain_text(folder: Folder, name: str, spelled: str, problem: str) -> None:
    memories = f"{MEMORIES}  {name}: {{coils: 1}}\n"
    assert folder.problems(memories + LISTENERS) == [f"p.yaml:3: memories.{spelled}: {problem}"]


def test_a_memory_with_a_number_as_its_name_is_reported_only_there(folder: Folder) -> None:
    listeners = LISTENERS.replace("1: plant", "1: '7'")
    [problem] = folder.problems(f"{MEMORIES}  7: {{coils: 1}}\n{listeners}")
    assert problem.startswith("p.yaml:3: memories.7: found 7, ")


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        (
            "type: modbus-tcp",
            "type: modbus-upd",
            f"5: type: found 'modbus-upd', allowed: {TYPES}; did you mean 'modbus-udp'?",
        ),
        ("type: modbus-tcp", "type: 5", f"5: type: found 5, allowed: {TYPES}"),
        ("type: modbus-tcp", "type: ", f"5: type: found nothing, allowed: {TYPES}"),
        (
            "type: modbus-tcp",
            "typ: modbus-tcp",
            "5: typ: unknown key, allowed: type; did you mean 'type'?",
        ),
        ("type: modbus-tcp", "event_log: true", f"4: type: missing, allowed: {TYPES}"),
        ("127.0.0.1:5020", "localhost:502", f"6: bind: found 'localhost:502', allowed: {BIND}"),
        ("127.0.0.1:5020", "502", f"6: bind: found 502, allowed: {BIND}"),
        ("127.0.0.1:5020", "1.2.3.4:65536", f"6: bind: found '1.2.3.4:65536', allowed: {BIND}"),
        ("127.0.0.1:5020", "::1:502", f"6: bind: found '::1:502', allowed: {BIND}"),
        ("127.0.0.1:5020", '"[1.2.3.4]:502"', f"6: bind: found '[1.2.3.4]:502', allowed: {BIND}"),
        (
            "127.0.0.1:5020",
            '"[::ffff:1.2.3.4]:502"',
            "6: bind: found '[::ffff:1.2.3.4]:502', write its IPv4 form 1.2.3.4:502",
        ),
        (
            "127.0.0.1:5020",
            '"[fe80::1%eth0]:502"',
            "6: bind: found '[fe80::1%eth0]:502', allowed after '%': an interface number",
        ),
    ],
)
def test_a_listener_is_checked(folder: Folder, old: str, new: str, problem: str) -> None:
    line, _, rest = problem.partition(" ")
    assert folder.problems(changed(old, new)) == [f"p.yaml:{line} listeners.scada.{rest}"]


@pytest.mark.parametrize(
    ("setting", "problem"),
    [
        ("max_connections: 0", "found 0, allowed: an integer from 1 to 65535"),
        ("max_connections: yes", "found 'yes', allowed: an integer from 1 to 65535"),
        (
            "max_connections_per_source: 0",
            "found 0, allowed: an integer from 1 to 65535 or null",
        ),
        ("when_full: wait", "found 'wait', allowed: refuse or evict"),
        ("idle_timeout: -1", "found -1, allowed: a number from 0 to 31622400 seconds"),
        ("idle_timeout: .inf", "found inf, allowed: a number from 0 to 31622400 seconds"),
        ("idle_timeout: .nan", "found nan, allowed: a number from 0 to 31622400 seconds"),
        ("idle_timeout: true", "found true, allowed: a number from 0 to 31622400 seconds"),
        ("idle_timeout: 1e-5", "found 1e-05, allowed: 0, or 0.001 to 31622400 seconds"),
        ("request_timeout: 0", "found 0, allowed: a number from 0.001 to 31622400 seconds"),
        (
            "request_timeout: '5'",
            "found '5', allowed: a number from 0.001 to 31622400 seconds; did you mean 5?",
        ),
    ],
)
def test_limits_and_times_are_checked(folder: Folder, setting: str, problem: str) -> None:
    text = changed("    rules:", f"    {setting}\n    rules:")
    key = setting.partition(":")[0]
    assert folder.problems(text) == [f"p.yaml:7: listeners.scada.{key}: {problem}"]


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("[10.0.0.0/8]", "[]", "8: sources: found an empty list, allowed: a list with at least "
         "one entry"),
        ("[10.0.0.0/8]", "10.0.0.0/8", "8: sources: found '10.0.0.0/8', allowed: a list with at "
         "least one entry"),
        ("10.0.0.0/8", "host", f"8: sources[0]: found 'host', allowed: {SOURCE}"),
        ("10.0.0.0/8", "10", f"8: sources[0]: found 10, allowed: {SOURCE}"),
        ("10.0.0.0/8", "10.0.0.0/33", f"8: sources[0]: found '10.0.0.0/33', allowed: {SOURCE}"),
        ("10.0.0.0/8", "10.0.0.0/255.0.0.0",
         f"8: sources[0]: found '10.0.0.0/255.0.0.0', allowed: {SOURCE}"),
        ("10.0.0.0/8", "10.0.0.1/8",
         "8: sources[0]: found '10.0.0.1/8', which has host bits set: the network is 10.0.0.0/8"),
        ("10.0.0.0/8", '"::ffff:10.0.0.0/104"',
         "8: sources[0]: found '::ffff:10.0.0.0/104', write its IPv4 form 10.0.0.0/8"),
        ("10.0.0.0/8", '"::ffff:10.0.0.7"',
         "8: sources[0]: found '::ffff:10.0.0.7', write its IPv4 form 10.0.0.7/32"),
        ("{1: plant}", "{}",
         "9: units: found an empty mapping, allowed: a mapping with at least one entry"),
        ("{1: plant}", "{256: plant}", f"9: units.256: found 256, allowed: {UNIT}"),
        ("{1: plant}", "{'1': plant}", f"9: units.1: found '1', allowed: {UNIT}; write 1 "
         "without quotes"),
        ("{1: plant}", "{1: plan}",
         "9: units.1: found 'plan', allowed: plant; did you mean 'plant'?"),
        ("{1: plant}", "{1: 5}",
         f"9: units.1: found 5, allowed: {NAME}; quote it to make it text"),
        ("{1: plant}", "{1: plant, true: plant}",
         "9: units: found the key true, allowed: text or an integer; quote it to make it text"),
        ("read-only", "rw", "10: access: found 'rw', allowed: read-only or read-write"),
        ("read-only", "read-only\n        functions: []",
         "11: functions: found an empty list, allowed: a list with at least one entry"),
        ("read-only", "read-only\n        functions: [3, 4, 3]",
         "11: functions[2]: found 3 again, allowed: once"),
        ("read-only", "read-only\n        deny: [9]", f"11: deny[0]: found 9, allowed: {CODES}"),
        ("read-only", "read-only\n        deny: [true]",
         f"11: deny[0]: found true, allowed: {CODES}"),
        ("read-only", "read-only\n        deny: [1.0]",
         f"11: deny[0]: found 1.0, allowed: {CODES}"),
        ("read-only", "read-only\n        functions: [3]\n        deny: [4]",
         "12: deny: found together with functions, allowed: only one of them"),
    ],
)  # fmt: skip
def test_a_rule_is_checked(folder: Folder, old: str, new: str, problem: str) -> None:
    line, _, rest = problem.partition(" ")
    assert folder.problems(changed(old, new)) == [f"p.yaml:{line} {RULE}.{rest}"]


@pytest.mark.parametrize(
    ("line", "allowed"),
    [
        ("      - sources: [10.0.0.0/8]\n        units: {1: plant}\n", "access"),
        ("      - sources: [10.0.0.0/8]\n        access: read-only\n", "units"),
        ("      - units: {1: plant}\n        access: read-only\n", "sources"),
    ],
)
def test_what_bears_on_safety_must_be_said(folder: Folder, line: str, allowed: str) -> None:
    words = {
        "access": "read-only or read-write",
        "units": "a mapping with at least one entry",
        "sources": "a list with at least one entry",
    }
    text = GOOD[: GOOD.index("      - sources")] + line
    assert folder.problems(text) == [
        f"p.yaml:8: {RULE}.{allowed}: missing, allowed: {words[allowed]}"
    ]


def rule(sources: str) -> str:
    return f"      - {{sources: [{sources}], units: {{1: plant}}, access: read-only}}\n"


def test_a_rule_that_an_earlier_one_covers_is_a_warning(folder: Folder) -> None:
    assert folder.warnings(GOOD + rule("10.1.0.0/16, 10.2.0.3")) == [
        "p.yaml:11: listeners.scada.rules[1]: never matches: all its sources and units are covered "
        "by rules[0] in line 8"
    ]


def test_a_rule_that_earlier_ones_cover_together_is_a_warning(folder: Folder) -> None:
    text = GOOD + rule("11.0.0.0/9") + rule("11.128.0.0/9") + rule("11.0.0.0/8")
    assert folder.warnings(text) == [
        "p.yaml:13: listeners.scada.rules[3]: never matches: all its sources and units are covered "
        "by rules[1] in line 11 and rules[2] in line 12"
    ]


def test_a_function_that_writes_is_a_warning_where_access_is_read_only(folder: Folder) -> None:
    assert folder.warnings(changed("read-only", "read-only\n        functions: [3, 6]")) == [
        f"p.yaml:11: {RULE}.functions[1]: function 6 has no effect: it writes, and access is "
        f"read-only"
    ]


def test_a_limit_of_a_source_beyond_that_of_all_is_a_warning(folder: Folder) -> None:
    text = changed("    rules:", "    max_connections_per_source: 257\n    rules:")
    assert folder.warnings(text) == [
        "p.yaml:7: listeners.scada.max_connections_per_source: 257 has no effect: "
        "max_connections is 256"
    ]


@pytest.mark.parametrize(
    ("section", "more"),
    [("rest", ""), ("gateway", "allow: [10.0.0.0/8], access: read-only, ")],
    ids=["rest", "gateway"],
)
def test_a_limit_of_a_source_beyond_that_of_a_service_is_a_warning(
    folder: Folder, section: str, more: str
) -> None:
    keys = f"{more}max_connections_per_source: 129"
    text = f"{section}: {{bind: '127.0.0.1:80', sources: [127.0.0.1], tokens: none, {keys}}}\n"
    [warning] = folder.warnings(GOOD + text)
    assert warning.endswith(
        f"{section}.max_connections_per_source: 129 has no effect: max_connections is 128"
    )


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("127.0.0.1:502", "127.0.0.1:502"),
        ("0.0.0.0:502", "127.0.0.1:502"),
        ("127.0.0.1:502", "0.0.0.0:502"),
        ("[::]:502", "127.0.0.1:502"),
        ("0.0.0.0:502", "[::]:502"),
        ("[::]:502", "[::1]:502"),
        ("[::1]:502", "[0:0:0:0:0:0:0:1]:502"),
    ],
)
def test_listeners_need_sockets_of_their_own(folder: Folder, one: str, other: str) -> None:
    def listener(name: str, bind: str) -> str:
        return f"  {name}:\n    type: modbus-tcp\n    bind: '{bind}'\n    rules:\n{rule('::/0')}"

    text = MEMORIES + "listeners:\n" + listener("a", one) + listener("b", other)
    shown = other.replace("0:0:0:0:0:0:0:1", "::1")
    assert folder.problems(text) == [
        f"p.yaml:11: listeners.b.bind: found '{shown}', which overlaps {one} of listeners.a "
        "in line 6, allowed: an unused address and port"
    ]


@pytest.mark.parametrize(
    ("extra", "problem"),
    [
        ("workers: 0", "workers: found 0, allowed: an integer from 1 to 64"),
        ("workers: 1.0", "workers: found 1.0, allowed: an integer from 1 to 64"),
        ("log: {level: loud}", "log.level: found 'loud', allowed: debug, info, warning or error"),
        ("log: {format: xml}", "log.format: found 'xml', allowed: text, json or ecs"),
        ("log:", "log: found nothing, allowed: a mapping with the keys level, format"),
        (
            "identity: {revision: 1.10}",
            "identity.revision: found 1.1, allowed: text of 1 to 244 bytes; "
            "quote it to make it text",
        ),
        (
            "identity: {vendor_name: ''}",
            "identity.vendor_name: found text of 0 bytes, allowed: text of 1 to 244 bytes",
        ),
        (
            f"identity: {{vendor_name: {'ü' * 123}}}",
            "identity.vendor_name: found text of 246 bytes, allowed: text of 1 to 244 bytes",
        ),
        (
            'identity: {vendor_name: "a\\nb"}',
            "identity.vendor_name: found 'a\\nb', allowed: text without '\\n'",
        ),
        (
            "identity: {unit_names: {256: x}}",
            "identity.unit_names.256: found 256, allowed: a unit id from 0 to 255",
        ),
        (
            "identity: {objects: {7: x}}",
            "identity.objects.7: found 7, allowed: an object id from 128 to 255",
        ),
        ("wrkers: 1", f"wrkers: unknown key, allowed: {TOP}; did you mean 'workers'?"),
        ("x.y: 1", f"'x.y': unknown key, allowed: {TOP}"),
        ("7: 1", f"7: unknown key, allowed: {TOP}"),
    ],
)
def test_the_rest_is_checked(folder: Folder, extra: str, problem: str) -> None:
    assert folder.problems(GOOD + extra + "\n") == [f"p.yaml:11: {problem}"]


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ("coils;1;1", "found 'coils;1;1', allowed: area,address,value"),
        ("coils,1,1,1", "found 'coils,1,1,1', allowed: area,address,value"),
        (
            "coil,1,1",
            "found area 'coil', allowed: coils, discrete_inputs, holding_registers; "
            "did you mean 'coils'?",
        ),
        (
            "input_registers,1,1",
            "found area 'input_registers', which this memory does not have, "
            "allowed: coils, discrete_inputs, holding_registers",
        ),
        ("coils,8,1", "found address 8, allowed in coils: 0 to 7"),
        ("coils,-1,1", "found address -1, allowed in coils: 0 to 7"),
        ("discrete_inputs,99,1", "found address 99, allowed in discrete_inputs: 100 to 107"),
        ("coils,one,1", "found address 'one', allowed in coils: 0 to 7"),
        ("coils,1,2", "found 2, allowed in coils: 0 or 1"),
        ("coils,1,true", "found 'true', allowed in coils: 0 or 1"),
        ("holding_registers,1,65536", "found 65536, allowed in holding_registers: 0 to 65535"),
        ("holding_registers,1,-1", "found -1, allowed in holding_registers: 0 to 65535"),
        ("holding_registers,1,1.5", "found '1.5', allowed in holding_registers: 0 to 65535"),
        ("coils,0,1", "duplicate coils 0, first in line 2"),
    ],
)
def test_initial_values_from_csv_are_checked(folder: Folder, line: str, problem: str) -> None:
    text = changed("coils: 8", "coils: 8, initial: v.csv")
    csv = f"area,address,value\ncoils,0,0\n\n{line}\n"
    assert folder.problems(text, v_csv=csv) == [f"v.csv:4: {problem}"]


@pytest.mark.parametrize(
    ("values", "problem"),
    [
        ("coils: {6: [1, 1, 1]}", "1: coils.6[2]: found address 8, allowed in coils: 0 to 7"),
        ("coils: {0: [0, true]}", "1: coils.0[1]: found true, allowed in coils: 0 or 1"),
        ("coils:\n  0: [0, 1]\n  1: 1", "3: coils.1: duplicate coils 1, first in line 2"),
        ("coils:\n  0: 1\n  0: 1", "3: coils: 0 is given twice, first in line 2"),
        ("coils: {a: 1}", "1: coils.a: found address 'a', allowed in coils: 0 to 7"),
        ("coils: [1]", "1: coils: found a list, allowed: {address: value}"),
        ("[1]", "1: found a list, allowed: area: {address: value}"),
        ("coils: [1", "1: not YAML: expected ',' or ']', but got '<stream end>'"),
    ],
)
def test_initial_values_from_yaml_are_checked(folder: Folder, values: str, problem: str) -> None:
    text = changed("coils: 8", "coils: 8, initial: v.yaml")
    assert folder.problems(text, v_yaml=values) == [f"v.yaml:{problem}"]


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", f"1: found an empty file, allowed: a mapping with the keys {TOP}"),
        ("# nothing\n", f"1: found an empty file, allowed: a mapping with the keys {TOP}"),
        ("[]", f"1: found an empty list, allowed: a mapping with the keys {TOP}"),
        ("[agent]\n  [[inputs.modbus]]\n  name = 'm'\n",
         "2: found a configuration of Telegraf, allowed: one of Holdfast; to convert it: holdfast "
         "import telegraf FILE"),
        ("device,m,1\npoll,coil,0,8,BE_BE\nref,a,0,bool,r\n",
         "2: found a configuration of modpoll, allowed: one of Holdfast; to convert it: holdfast "
         "import modpoll FILE --url URL"),
        ("# all\r\ndevices:\r\n  # one\r\n  - modbus: {url: 'm:502'}\r\n    listen: {bind: '0:9'}",
         "2: found a configuration of modbus-proxy, allowed: one of Holdfast; to convert it: "
         "holdfast import modbus-proxy FILE"),
        ("mqtt: !secret a\nmodbus:\n  - {name: m, type: tcp, host: m, port: 502}\n",
         "2: found a configuration of Home Assistant, allowed: one of Holdfast; to convert it: "
         "holdfast import home-assistant FILE"),
        ("root:x:0:0:root\n",
         f"1: found text of 15 characters, allowed: a mapping with the keys {TOP}"),
        ("root:*:1::\ndaemon:*:2::\n",
         f"1: found a mapping with 2 unknown keys, allowed: a mapping with the keys {TOP}"),
        ("secret: 1\nother: 2\n",
         f"1: found a mapping with 2 unknown keys, allowed: a mapping with the keys {TOP}"),
        ("secret: 1\n",
         f"1: found a mapping with one unknown key, allowed: a mapping with the keys {TOP}"),
        ("a: 1\n b: 2", "2: not YAML: a `:` where no key can be: indented further than the keys "
         "above it, or a text with `: `, which needs quotes"),
        ('a: "D:\\data"', "1: not YAML: found unknown escape character 'd'; in double quotes, "
         "\\ begins an escape: write a path in single quotes, or with /"),
        ("a:\n\tb: 1", "2: not YAML: a tab indents this line, allowed: spaces"),
        ("a:\n  b: 1\n  \tc: 2", "3: not YAML: a tab indents this line, allowed: spaces"),
        ("a: 1\nb:\tc", "2: a tab before a value, allowed: spaces"),
        ("a: {unit: %}", "1: not YAML: text that begins with % needs quotes around the whole, "
         "as in unit: '%'"),
        ("a: @b", "1: not YAML: text that begins with @ needs quotes around the whole, "
         "as in unit: '@'"),
        ("a:\n  b: 1\n\xa0\u3000 c: 2\n  d: 3", "3: not YAML: found the character U+00A0 "
         "(no-break space), allowed: spaces"),
        ("a: 1\n\xa0b\nc: 2", "2: not YAML: found the character U+00A0 (no-break space), "
         "allowed: spaces"),
        ("a:\n  b: |\n    \u3000c\n  d: 1\n  - e", "5: not YAML: indented unlike the entries "
         "above it, allowed: those of a list begin in the same column"),
        ("a: *b #\xa0c", "1: not YAML: found undefined alias 'b'"),
        ('a: "b\n  \u3000c\\p"', "2: not YAML: found unknown escape character 'p', while scanning "
         "a double-quoted scalar that starts in line 1; in double quotes, \\ begins an escape: "
         "write a path in single quotes, or with /"),
        ("a:\n    b: 1\n  c: 2", "3: not YAML: indented unlike the keys above it, allowed: keys of "
         "one mapping begin in the same column"),
        (
            "a: [1,\nb\nc: 3\n",
            "3: not YAML: expected ',' or ']', but got ':', "
            "while parsing a flow sequence that starts in line 1",
        ),
        ("memories: {}".encode("utf-16"), " a file in UTF-16, allowed: YAML in UTF-8; save it as "
         "UTF-8"),
        ("bind: [::1]:502\n", f"1: not YAML: more text after the end of a value: {BRACKETS}"),
        ("a: {bind: [::1]:502}\n", f"1: not YAML: a comma is missing, or {BRACKETS}"),
        ("a: 1\n---\nb: 1\n", "2: not YAML: expected a single document in the stream, "
         "but found another document"),
        ("a: 1\nb: \x01\n", "2: the character U+0001 is not allowed in YAML"),
        (b"a: 1\nb: \xff\n", "2: not UTF-8, allowed: YAML in UTF-8"),
        (b"\x7fELF\x00\x00\xff", " a binary file, allowed: YAML in UTF-8"),
        ("a: *b\n", "1: not YAML: found undefined alias 'b'"),
        ("!x 1", "1: the tag '!x' is not allowed"),
    ],
)  # fmt: skip
def test_what_is_no_configuration_is_told_so(
    folder: Folder, text: str | bytes, problem: str
) -> None:
    assert folder.problems(text) == [f"p.yaml:{problem}"]


def test_a_section_in_capitals_is_one_of_a_configuration(folder: Folder) -> None:
    first, *_ = folder.problems("GATEWAY:\n")
    assert first == f"p.yaml:1: GATEWAY: unknown key, allowed: {TOP}; did you mean 'gateway'?"


def test_a_merge_key_is_named_as_one(folder: Folder) -> None:
    assert folder.problems(changed("    rules:", "    <<: {when_full: evict}\n    rules:")) == [
        "p.yaml:7: listeners.scada.'<<': found a merge key, allowed: the keys themselves"
    ]


def test_values_without_end_are_refused(folder: Folder) -> None:
    endless = "[" * sys.getrecursionlimit()
    assert folder.problems(endless) == ["p.yaml: not a configuration: nested too deeply"]


def test_too_many_values_are_refused_before_they_take_memory(
    folder: Folder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(yaml_document, "MAX_WRITTEN", 30)
    text = MEMORIES + LISTENERS
    assert folder.problems(text) == ["p.yaml: more than 30 keys and values, the limit"]
    monkeypatch.undo()
    assert isinstance(folder.config(text), Config)


def test_aliases_can_not_multiply_without_end(folder: Folder) -> None:
    lines = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    for level in range(1, 20):
        lines.append(f"a{level}: &a{level} [{', '.join([f'*a{level - 1}'] * 10)}]")
    (problem,) = folder.problems("\n".join(lines))
    assert problem.endswith("values with aliases expanded, allowed: up to 1000000")


def test_an_alias_of_itself_is_refused(folder: Folder) -> None:
    text = changed("{1: plant}", "&u {1: *u}")
    assert f"p.yaml:9: {RULE}.units.1: an alias inside its own anchor is not allowed" in (
        folder.problems(text)
    )


def test_a_key_that_comes_twice_is_named_with_both_lines(folder: Folder) -> None:
    assert folder.problems(MEMORIES + "  plant: {coils: 1}\n" + LISTENERS) == [
        "p.yaml:3: memories: 'plant' is given twice, first in line 2"
    ]


def test_a_unit_id_that_comes_twice_in_two_notations_is_found(folder: Folder) -> None:
    assert folder.problems(changed("{1: plant}", "{1: plant, 0x1: plant}")) == [
        f"p.yaml:9: {RULE}.units: 1 is given twice, first in line 9"
    ]


def test_a_range_of_unit_ids_with_zeros_in_front_overlaps_like_any_other(folder: Folder) -> None:
    (problem,) = folder.problems(changed("{1: plant}", "{1-5: plant, 03-9: plant}"))
    assert problem.endswith(
        "units.03-9: found 03-9, which overlaps 1-5 in line 9, allowed: each unit id once"
    )


def test_an_invalid_key_costs_only_the_checks_that_need_it(folder: Folder) -> None:
    text = changed("holding_registers: 10", "holding_registers: {start: 1}, initial: v.csv")
    problems = folder.problems(text, v_csv="coils,9,1\n")
    assert [problem.partition(": found")[0] for problem in problems] == [
        "p.yaml:2: memories.plant.holding_registers.size: missing, "
        "allowed: an integer from 1 to 65536",
        "v.csv:1",
    ]


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        load(tmp_path / "none.yaml")
    assert str(caught.value) == f"{tmp_path}/none.yaml: can't be read: No such file or directory"


def test_a_folder_is_no_configuration(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="can't be read: Is a directory"):
        load(tmp_path)


def test_a_problem_has_its_parts(folder: Folder) -> None:
    (folder.path / "p.yaml").write_text(changed("read-only", "rw"))
    with pytest.raises(ConfigError) as caught:
        load(folder.path / "p.yaml")
    assert caught.value.problems == (
        Problem(
            file=str(folder.path / "p.yaml"),
            line=10,
            column=17,
            key="listeners.scada.rules[0].access",
            message="found 'rw', allowed: read-only or read-write",
        ),
    )


BROKEN = """\
memories:
  a:
    coil: 10
    coils: 16
    holding_registers: {start: 60000, size: 10000}
    seal: {area: coils, address: 16}
    initial: v.csv
  a: {coils: 1}
listeners:
  one:
    type: modbus-tcp
    bind: 0.0.0.0:502
    idle_timeout: never
    rules:
      - {sources: [10.0.0.0/8], units: {1: b}, access: rw}
      - {sources: [10.1.0.0/16, 1], units: {1: a}, access: read-only, functions: [9]}
  two: {type: modbus-tcp, bind: 127.0.0.1:502, rules: []}
  three: {type: modbus-tsl, port: 5}
  four: {type: modbus-rtu, serial: {}, rules: [{sources: [], units: {0: c}}]}
mqtt: {url: tcp://broker, password: x, subscriptions: [{topic: '', memories: [c], areas: [coil]}]}
rest: {bind: 0.0.0.0:502, sources: [], tokens: none}
nats: {servers: [nats], user: x}
gateway: {bind: '127.0.0.1:502', sources: [x], allow: [], access: all, tokens: all}
"""


def test_all_problems_of_all_kinds_are_told_at_once_in_the_order_of_lines(folder: Folder) -> None:
    keys = [
        problem.partition(": found")[0].partition(": unknown")[0]
        for problem in folder.problems(BROKEN, v_csv="coils,0,7\n")
    ]
    assert keys == [
        "p.yaml:3: memories.a.coil",
        "p.yaml:5: memories.a.holding_registers",
        "p.yaml:6: memories.a.seal.address",
        "p.yaml:8: memories: 'a' is given twice, first in line 2",
        "p.yaml:13: listeners.one.idle_timeout",
        "p.yaml:15: listeners.one.rules[0].units.1",
        "p.yaml:15: listeners.one.rules[0].access",
        "p.yaml:16: listeners.one.rules[1].sources[1]",
        "p.yaml:16: listeners.one.rules[1].functions[0]",
        "p.yaml:17: listeners.two.bind",
        "p.yaml:17: listeners.two.rules",
        "p.yaml:18: listeners.three.type",
        "p.yaml:19: listeners.four.serial.device: missing, allowed: text, as in /dev/ttyUSB0 or "
        "COM3",
        "p.yaml:19: listeners.four.rules[0].access: missing, allowed: read-only or read-write",
        "p.yaml:19: listeners.four.rules[0].sources: not allowed on a serial line, "
        "allowed: units, access, functions, deny",
        "p.yaml:19: listeners.four.rules[0].units.0",
        "p.yaml:19: listeners.four.rules[0].units.0",
        "p.yaml:20: mqtt.client_id: missing, allowed: text",
        "p.yaml:20: mqtt.url",
        "p.yaml:20: mqtt.password",
        "p.yaml:20: mqtt.subscriptions[0].topic",
        "p.yaml:20: mqtt.subscriptions[0].memories[0]",
        "p.yaml:20: mqtt.subscriptions[0].areas[0]",
        "p.yaml:21: rest.bind",
        "p.yaml:21: rest.bind",
        "p.yaml:21: rest.sources",
        "p.yaml:21: rest.tokens",
        "p.yaml:22: nats.devices: missing, allowed: a list with at least one entry",
        "p.yaml:22: nats.servers[0]",
        "p.yaml:22: nats.user",
        "p.yaml:23: gateway.bind",
        "p.yaml:23: gateway.bind",
        "p.yaml:23: gateway.bind",
        "p.yaml:23: gateway.sources[0]",
        "p.yaml:23: gateway.allow",
        "p.yaml:23: gateway.access",
        "p.yaml:23: gateway.tokens",
        "v.csv:1",
    ]


def places(data: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The paths of all values."""
    if path:
        yield path
    inside: Any = enumerate(data) if isinstance(data, list) else ()
    for key, value in data.items() if isinstance(data, dict) else inside:
        yield from places(value, (*path, key))


FULL = parse((EXAMPLES / "full.yaml").read_text(), "full.yaml")[0].data


def config_of(data: Any) -> Config:
    """The configuration of data, without YAML: most of the time of `load` goes there."""
    return checked(table("p.yaml", data, {}), [], EXAMPLES)


@pytest.mark.parametrize("section", FULL)
@pytest.mark.parametrize("wrong", [None, -5, [], [1], {"a": {"b": [None]}}])
def test_any_shape_anywhere_is_answered_with_problems_or_served(
    section: str, wrong: object
) -> None:
    for path in places(FULL[section], (section,)):
        inside = data = {**FULL, section: copy.deepcopy(FULL[section])}
        for part in path[:-1]:
            inside = inside[part]
        inside[path[-1]] = wrong
        try:
            config = config_of(data)
        except ConfigError as error:
            told = [str(problem) for problem in error.problems]
            assert told, path
            assert not any("allowed: nothing" in problem for problem in told), path
        else:
            assert config_of(config.effective()) == config, path
