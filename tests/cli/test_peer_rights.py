"""`holdfast check --as`: what is printed, and that it is what a listener does."""

from __future__ import annotations

import json
import socket
import struct
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

from holdfast.cli import main
from holdfast.protocol import ILLEGAL_ADDRESS, ILLEGAL_FUNCTION, PATH_UNAVAILABLE, TARGET_SILENT
from holdfast.types import AREAS, WRITABLE_AREAS
from support.cases import examples
from support.config_folder import written
from support.machine import needs_127_0_0_2
from support.transports import address, client, is_stranger, running

if TYPE_CHECKING:
    from collections.abc import Iterator

    from click.testing import Result

TEXT = """\
memories: {plant: {coils: 8, holding_registers: 100}}
links: {bus: {url: "rtu:///dev/none"}}
listeners:
  scada:
    type: modbus-tcp
    bind: 127.0.0.1:5020
    rules:
      - sources: [10.0.0.0/24]
        access: read-write
        units:
          1: plant
          2-3: {memory: plant, access: read-only, functions: [3, 4]}
          4: {memory: plant, read: [{area: coils, start: 0, end: 3}], write: [{area: coils,
            start: 1, end: 2}]}
      - {sources: [10.0.0.0/8], access: read-only, units: {1-2: plant, 9: {route: bus}}}
  meters: {type: modbus-udp, bind: "127.0.0.1:5020", rules: [{sources: [10.1.0.0/16], access:
    read-only, units: {1: plant}}]}
  line: {type: modbus-rtu, serial: {device: /dev/other}, rules: [{access: read-only, units: {1:
    plant}}]}
  raw: {type: raw-ingest, bind: "127.0.0.1:5021", rules: [{sources: [10.0.0.0/8], areas: [coils],
    units: {7: plant}}]}
"""
ALL = "1-6, 8, 11, 15-17, 22-23, 43"
READING = "1-4, 8, 11, 17, 43"


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "p.yaml"
    path.write_text(TEXT)
    return path


def check(file: Path, *arguments: str) -> Result:
    return CliRunner().invoke(main, ["check", str(file), *arguments])


def peer(file: Path, *arguments: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(check(file, "--json", *arguments).stdout)["peer"]
    return found


def test_rights_are_a_table_for_each_listener(file: Path) -> None:
    result = check(file, "--as", "10.0.0.7")

    assert (result.exit_code, result.stderr) == (0, "")
    lines = [" | ".join(part.split("  ")) for part in result.stdout.splitlines()]
    cells = [[cell.strip() for cell in line.split(" | ") if cell.strip()] for line in lines]
    everything = ["everything", "everything"]
    assert cells == [
        ["scada", "modbus-tcp", "127.0.0.1:5020"],
        ["unit", "to", "access", "functions", "reads", "writes"],
        ["1", "memory plant", "read-write", ALL, *everything],
        ["2-3", "memory plant", "read-only", "3-4", "everything", "nothing"],
        ["4", "memory plant", "read-write", ALL, "coils 0 to 3", "coils 1 to 2"],
        ["9", "route bus", "read-only", "1-4, 7-8, 11-12, 17, 20, 24, 43", "everything", "nothing"],
        [],
        ["meters", "modbus-udp", "127.0.0.1:5020"],
        ["no rule names 10.0.0.7: it gets no reply"],
        [],
        ["line", "modbus-rtu", "/dev/other"],
        ["a serial line has no addresses"],
        [],
        ["raw", "raw-ingest", "127.0.0.1:5021"],
        ["unit", "to", "writes"],
        ["7", "memory plant", "coils"],
    ]


def test_a_peer_that_no_rule_names_is_told_so(file: Path) -> None:
    lines = check(file, "--as", "192.0.2.1").stdout.splitlines()
    assert lines.count("  no rule names 192.0.2.1: it is disconnected at once") == 2
    assert lines.count("  no rule names 192.0.2.1: it gets no reply") == 1


def test_packets_on_a_modbus_port_are_rights_too(file: Path) -> None:
    part = """    raw_ingest:
      rules: [{sources: [10.0.0.0/24, 192.0.2.1], areas: [coils], units: {300: plant}}]
"""
    file.write_text(TEXT.replace("  meters:", f"{part}  meters:"))
    both = check(file, "--as", "10.0.0.7").stdout.splitlines()
    at = both.index("  Raw Ingest packets:")
    assert both[at - 1].split()[:3] == ["9", "route", "bus"]
    assert both[at + 2].split() == ["300", "memory", "plant", "coils"]
    only = check(file, "--as", "192.0.2.1").stdout.splitlines()
    assert only[1:3] == [
        "  no rule names 192.0.2.1: every request gets exception 01",
        "  Raw Ingest packets:",
    ]
    found = peer(file, "--as", "192.0.2.1")["listeners"]
    assert (found["scada"]["outcome"], found["scada"]["units"]) == ("only_packets", [])
    assert found["scada"]["packets"] == [{"unit": 300, "memory": "plant", "areas": ["coils"]}]
    assert "packets" not in peer(file, "--as", "10.1.0.7")["listeners"]["scada"]


def test_programs_get_the_rights(file: Path) -> None:
    found = peer(file, "--as", "::ffff:10.1.0.7")
    listeners = found["listeners"]

    assert (found["address"], found["role"]) == ("10.1.0.7", "")
    assert {name: each["outcome"] for name, each in listeners.items()} == {
        "scada": "served",
        "meters": "served",
        "line": "no_addresses",
        "raw": "served",
    }
    assert [each["unit"] for each in listeners["scada"]["units"]] == [1, 2, 9]
    assert listeners["scada"]["units"][0] == {
        "unit": 1,
        "memory": "plant",
        "access": "read-only",
        "functions": [1, 2, 3, 4, 8, 11, 17, 43],
        "read": None,
        "write": None,
    }
    assert listeners["raw"]["units"] == [{"unit": 7, "memory": "plant", "areas": ["coils"]}]
    ranges = peer(file, "--as", "10.0.0.7")["listeners"]["scada"]["units"][3]
    assert ranges["read"] == [{"area": "coils", "start": 0, "end": 3}]
    assert ranges["write"] == [{"area": "coils", "start": 1, "end": 2}]


@pytest.mark.parametrize("found", ["10.0.0.0/24", "plc.local", ""])
def test_only_an_address_is_a_peer(file: Path, found: str) -> None:
    result = check(file, "--as", found)
    assert (result.exit_code, result.stdout) == (2, "")
    assert f"found {found!r}, allowed: an IP address" in result.stderr


def test_a_role_needs_an_address(file: Path) -> None:
    result = check(file, "--role", "operator")
    assert (result.exit_code, result.stdout) == (2, "")
    assert "--role requires --as." in result.stderr


# What is printed is what a listener does.

SIZE = 12
"""The addresses of each area."""

UNITS = (0, 1, 2, 9)
SOURCES = [f"127.0.0.{last}" for last in (1, 2, 3)]
CODES = [1, 2, 3, 4, 5, 6, 8, 11, 15, 16, 17, 22, 23, 43]
READS = {1: "coils", 2: "discrete_inputs", 3: "holding_registers", 4: "input_registers"}
WRITES = {5: "coils", 6: "holding_registers", 15: "coils", 16: "holding_registers"}
WRITES |= {22: "holding_registers", 23: "holding_registers"}


def some(values: list[Any]) -> st.SearchStrategy[list[Any]]:
    return st.lists(st.sampled_from(values), min_size=1, unique=True)


@st.composite
def ranges(draw: st.DrawFn, areas: tuple[str, ...]) -> list[dict[str, Any]]:
    found = []
    for area in draw(st.lists(st.sampled_from(areas), min_size=1, max_size=4)):
        start = draw(st.integers(0, SIZE - 1))
        found.append({"area": area, "start": start, "end": draw(st.integers(start, SIZE - 1))})
    return found


@st.composite
def rules(draw: st.DrawFn) -> dict[str, Any]:
    rule: dict[str, Any] = {
        "sources": draw(st.one_of(some(SOURCES), st.just(["127.0.0.0/30"]))),
        "access": draw(st.sampled_from(["read-only", "read-write"])),
    }
    limit = draw(st.sampled_from([None, "functions", "deny"]))
    if limit is not None:
        rule[limit] = draw(some(CODES))
    units: dict[int, Any] = {}
    for unit in draw(some(list(UNITS))):
        units[unit] = draw(targets(rule))
    return {**rule, "units": units}


@st.composite
def targets(draw: st.DrawFn, rule: dict[str, Any]) -> str | dict[str, Any]:
    kind = draw(st.sampled_from(["short", "memory", "route"]))
    if kind == "short":
        return "plant"
    unit: dict[str, Any] = {"memory": "plant"} if kind == "memory" else {"route": "gone"}
    if draw(st.booleans()):
        unit["access"] = "read-only"
    allowed = [code for code in rule.get("functions", CODES) if code not in rule.get("deny", ())]
    limit = draw(st.sampled_from([None, "functions", "deny"]))
    if limit is not None and allowed:
        unit[limit] = draw(some(allowed))
    if kind == "memory" and draw(st.booleans()):
        unit["read"] = draw(ranges(AREAS))
    if kind == "memory" and draw(st.booleans()):
        unit["write"] = draw(ranges(WRITABLE_AREAS))
    return unit


def requests() -> Iterator[tuple[bytes, list[int], list[int]]]:
    """Requests, each with the addresses that it reads and that it writes."""
    for at, count in ((0, 1), (0, SIZE), (5, 3), (SIZE - 1, 1)):
        span = list(range(at, at + count))
        for code in READS:
            yield struct.pack(">BHH", code, at, count), span, []
        yield struct.pack(">BHH", 5, at, 0xFF00), [], span[:1]
        yield struct.pack(">BHH", 6, at, 1), [], span[:1]
        yield (
            struct.pack(">BHHB", 15, at, count, (count + 7) // 8) + bytes((count + 7) // 8),
            [],
            span,
        )
        yield struct.pack(">BHHB", 16, at, count, 2 * count) + bytes(2 * count), [], span
        yield struct.pack(">BHHH", 22, at, 0xFFFF, 0), [], span[:1]
        yield struct.pack(">BHHHHBH", 23, 3, 2, at, 1, 2, 7), [3, 4], span[:1]
    for text in ("080000a537", "0b", "11", "2b0e0100", "07", "41"):
        yield bytes.fromhex(text), [], []


def is_inside(ranges: list[dict[str, Any]] | None, area: str, addresses: list[int]) -> bool:
    return ranges is None or all(
        any(each["area"] == area and each["start"] <= address <= each["end"] for each in ranges)
        for address in addresses
    )


def expected(
    rights: dict[int, dict[str, Any]], unit: int, request: tuple[bytes, list[int], list[int]]
) -> set[int]:
    """The exceptions that the printed rights allow as a reply; 0 is none."""
    pdu, read, written_to = request
    code = pdu[0]
    own = rights.get(unit)
    # Functions that only devices know are unknown for a unit that the peer does not have.
    of_any = {each for one in rights.values() for each in one["functions"]}.intersection(CODES)
    if code not in (of_any if own is None else own["functions"]):
        return {ILLEGAL_FUNCTION}
    if own is None:
        return {TARGET_SILENT}
    if "route" in own:
        return {PATH_UNAVAILABLE}
    reads = is_inside(own["read"], READS.get(code, "holding_registers"), read)
    writes = is_inside(own["write"], WRITES.get(code, ""), written_to)
    return {0} if reads and writes else {ILLEGAL_ADDRESS}


@needs_127_0_0_2
@settings(max_examples=examples(12))
@given(listed=st.lists(rules(), min_size=1, max_size=4))
def test_a_listener_does_what_is_printed(listed: list[dict[str, Any]]) -> None:
    scada = {"type": "modbus-tcp", "bind": "127.0.0.1:0", "rules": listed}
    with tempfile.TemporaryDirectory() as name, socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        gone = {"url": f"tcp://127.0.0.1:{closed.getsockname()[1]}"}
        text = written(
            {
                "memories": {"plant": dict.fromkeys(AREAS, SIZE)},
                "links": {"gone": gone},
                "listeners": {"scada": scada},
            }
        )
        with running(Path(name), text) as appliance:
            for source in SOURCES:
                printed = peer(Path(name) / "appliance.yaml", "--as", source)["listeners"]["scada"]
                if printed["outcome"] == "disconnected":
                    assert is_stranger("tcp", appliance, address(appliance), source)
                    continue
                rights = {each["unit"]: each for each in printed["units"]}
                with client("tcp", address(appliance), source) as asking:
                    for unit in UNITS:
                        for request in requests():
                            reply = asking.ask(request[0], unit)
                            found = reply[1] if reply[0] & 0x80 else 0
                            assert {found} == expected(rights, unit, request), (unit, request)
