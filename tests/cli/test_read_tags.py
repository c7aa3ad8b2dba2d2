"""`holdfast read` with several values: AREA:ADDRESS, tag lists and devices of a configuration."""

from __future__ import annotations

import csv
import json
import signal
import struct
import subprocess
import sys
from pathlib import Path

import pytest

import holdfast
from holdfast import values
from holdfast.cli.tags import recording
from holdfast.config.tag_files.read import load_tags
from holdfast.simulation import playback
from support import cli, wire
from support.cli import answer, done, failure, invoke, usage_error
from support.commands import Command
from support.fake_device import FakeDevice, exception, registers

LIST = """
order: CDAB
tags:
  voltage: {area: holding_registers, address: 0, type: float32, unit: V}
  power: {area: holding_registers, address: 2, type: int16, scale: 0.1, unit: kW}
  state: {area: holding_registers, address: 3, states: {0: off, 1: running, 2: fault}}
  level: {area: input_registers, address: 7, "null": [65535]}
  pump: {area: coils, address: 3}
"""


@pytest.fixture
def plant(memory: holdfast.Memory) -> holdfast.Memory:
    """A memory with a value for each tag."""
    memory.write("holding_registers", 0, holdfast.values.encode(230.1, "float32", "CDAB"))
    memory.write("holding_registers", 2, [1210, 2])
    memory.write("input_registers", 7, [65535])
    memory.write("coils", 3, [1])
    return memory


@pytest.fixture
def tags(tmp_path: Path) -> str:
    file = tmp_path / "plant.yaml"
    file.write_text(LIST)
    return str(file)


@pytest.mark.usefixtures("plant")
def test_several_values_of_several_types_are_read(server: holdfast.Server) -> None:
    words = ("hr:0:float32:CDAB", "hr:2:int16", "HR:0x3", "coil:3", "hr:3:bit:1")
    assert done("read", cli.url(server), *words) == [
        "name         value  address",
        "hr:0         230.1  holding_registers 0 float32 CDAB",
        "hr:2          1210  holding_registers 2 int16",
        "hr:3:uint16      2  holding_registers 3 uint16",
        "co:3          true  coils 3 bool",
        "hr:3:bit:1    true  holding_registers 3 bit:1",
    ]
    assert server.counters()["requests"] == {1: 1, 3: 1}


@pytest.mark.usefixtures("plant")
def test_an_array_is_a_value_for_each_element(server: holdfast.Server) -> None:
    found = answer("read", cli.url(server), "hr:0:float32[2]:CDAB", "co:2:bool[2]")
    assert found == {
        "ok": True,
        "target": cli.url(server),
        "unit": 1,
        "values": {"hr:0": 230.1, "hr:2": found["values"]["hr:2"], "co:2": False, "co:3": True},
        "states": {},
        "errors": {},
    }


def test_a_request_reads_whole_elements_of_a_long_array(tmp_path: Path) -> None:
    tags = tmp_path / "long.yaml"
    tags.write_text(
        "tags:\n"
        "  curve: {area: input_registers, address: 7, type: 'float64[60]'}\n"
        "  words: {area: input_registers, address: 7, type: 'uint32[120]'}\n"
        "  text: {area: input_registers, address: 300, type: 'string:260'}\n"
    )
    with FakeDevice(registers) as device:
        found = answer("read", device.url, "--tags", str(tags))["values"]
        asked = [struct.unpack(">BHH", pdu) for pdu in device.asked]
    assert (found["curve"], found["words"], found["text"]) == ([0] * 60, [0] * 120, "")
    assert asked == [(4, 7, 124), (4, 131, 116), (4, 300, 125), (4, 425, 5)]


def test_modicon_numbers_have_types_as_well(
    server: holdfast.Server, memory: holdfast.Memory
) -> None:
    memory.write("holding_registers", 9, [65535])
    found = answer("read", cli.url(server), "40010:int16", "40010:uint16")
    assert found["values"] == {"hr:9:int16": -1, "hr:9:uint16": 65535}


@pytest.mark.usefixtures("plant")
def test_a_tag_list_gives_names_units_and_states(server: holdfast.Server, tags: str) -> None:
    assert done("read", cli.url(server), "--tags", tags) == [
        "name         value  unit  address",
        "voltage      230.1  V     holding_registers 0 float32 CDAB",
        "power        121.0  kW    holding_registers 2 int16",
        "state    fault (2)        holding_registers 3 uint16",
        "level     no value        input_registers 7 uint16",
        "pump          true        coils 3 bool",
    ]
    found = answer("read", cli.url(server), "--tags", tags)
    assert found["values"] == {
        "voltage": 230.1,
        "power": 121.0,
        "state": 2,
        "level": None,
        "pump": True,
    }
    assert found["states"] == {"state": "fault"}


@pytest.mark.usefixtures("plant")
def test_only_some_tags_are_read(server: holdfast.Server, tags: str) -> None:
    only = ("--only", "p*", "--only", "state")
    found = answer("read", cli.url(server), "--tags", tags, *only)
    assert list(found["values"]) == ["power", "state", "pump"]
    wrong = usage_error("read", cli.url(server), "--tags", tags, "--only", "powr")
    assert "No tag has the name 'powr'; did you mean 'power'?" in wrong


@pytest.mark.usefixtures("plant")
def test_a_device_of_a_configuration_is_read_by_its_name(
    server: holdfast.Server, tmp_path: Path
) -> None:
    file = tmp_path / "site.yaml"
    profiles = "\n".join(f"    {line}" for line in LIST.splitlines())
    device = f"meter: {{url: '{cli.url(server)}', unit: 1, profile: kind, interval: 1}}"
    file.write_text(f"profiles:\n  kind:\n{profiles}\ndevices:\n  {device}\n")
    config = ("--config", str(file))
    assert answer("read", "meter", *config, "--only", "power")["values"] == {"power": 121.0}
    assert "has no device 'metre'" in usage_error("read", "metre", *config)
    profile = ("--tags", str(file), "--profile", "kind", "--only", "pump")
    assert answer("read", cli.url(server), *profile)["values"] == {"pump": True}
    alone = usage_error("read", cli.url(server), "--tags", str(file))
    assert f"{file} is a configuration, not a tag list: add --profile NAME" in alone
    wrong = usage_error("read", cli.url(server), "--tags", str(file), "--profile", "kin")
    assert "has no profile 'kin', allowed: kind; did you mean 'kind'?" in wrong


def without_register_1(pdu: bytes) -> bytes:
    address, count = struct.unpack(">HH", pdu[1:])
    return exception(pdu, 2) if address <= 1 < address + count else registers(pdu, 7)


def test_a_refused_register_costs_only_its_tag() -> None:
    with FakeDevice(without_register_1) as device:
        result = invoke("read", device.url, "hr:0", "hr:1", "hr:2")
        hint = f"hint: 'holdfast describe map {device.url}' finds the addresses that exist\n"
        assert (result.exit_code, result.stderr) == (1, hint)
        assert [line.split()[1] for line in result.stdout.splitlines()[1:]] == ["7", "?", "7"]
        assert result.stdout.splitlines()[2] == (
            "hr:1      ?  holding_registers 1 uint16  exception 02 (Illegal Data Address)"
        )
        found = answer("read", device.url, "hr:0", "hr:1", code=1)
        assert (found["ok"], found["values"]) == (False, {"hr:0": 7, "hr:1": None})
        detail = "exception 02 (Illegal Data Address)"
        assert found["errors"] == {"hr:1": {"reason": "exception", "code": 2, "detail": detail}}
        result = invoke("read", device.url, "hr:0", "hr:1", "--csv")
        assert result.exit_code == 1
        assert result.stdout.splitlines()[1].endswith("Z,7,")
        assert result.stderr == f"holdfast: hr:1: {detail}\n{hint}"


def test_a_tag_whose_address_is_a_modicon_number_has_a_hint(
    server: holdfast.Server, tmp_path: Path
) -> None:
    file = tmp_path / "device.csv"
    file.write_text("flow,hr,41001,,,,,,yes\n")
    url, hint = cli.url(server), "addresses count from 0; as a Modicon number 41001 is hr:1000"
    then = f"'holdfast describe map {url}'", "the address does not exist, or may not be written"
    for arguments, more in zip((("read", url), ("write", url, "flow=1")), then, strict=True):
        result = invoke(*arguments, "--tags", str(file))
        assert result.exit_code == 1
        assert f"hint: {hint}\nhint: {more}" in result.stderr


def test_a_hint_is_printed_once_for_all_tags_and_readings() -> None:
    often = ("--every", "0.01", "--times", "2")
    with FakeDevice(lambda pdu: exception(pdu, 11)) as device:
        hint = f"hint: 'holdfast find {device.url}' finds the unit ids that answer"
        one = "exception 0B (Gateway Target Device Failed To Respond)"
        for items in (("hr:0", "hr:9"), ("hr", "0")):
            result = invoke("read", device.url, *items, *often)
            assert result.output.count(one) == 2, result.output
            assert result.stderr.splitlines().count(hint) == 1
            assert result.stderr.count("hint: ") == 1


def test_an_error_of_all_tags_is_one_line(unused: str) -> None:
    assert failure("read", unused, "hr:0", "hr:9")[0].startswith(f"holdfast: {unused}: can't")


def test_registers_that_hold_no_value_are_an_error_of_their_tag() -> None:
    with FakeDevice(lambda pdu: registers(pdu, 0xABCD)) as device:
        found = answer("read", device.url, "hr:0:bcd16", "hr:1", code=1)
        assert found["values"] == {"hr:0": None, "hr:1": 0xABCD}
        assert found["errors"]["hr:0"]["reason"] == "undecodable"


@pytest.mark.usefixtures("plant")
def test_readings_are_repeated_and_recorded(
    server: holdfast.Server, tags: str, tmp_path: Path
) -> None:
    record = tmp_path / "values.csv"
    often = ("--every", "0.01", "--record", str(record))
    arguments = ("read", cli.url(server), "--tags", tags)
    shown = invoke(*arguments, *often, "--times", "2", "--csv").stdout.splitlines()
    assert shown == record.read_text().splitlines()
    head, *rows = csv.reader(shown)
    assert head == ["time", "voltage", "power", "state", "level", "pump"]
    assert [row[1:] for row in rows] == [["230.1", "121.0", "2", "", "true"]] * 2
    result = invoke(*arguments, *often, "--times", "1", "--json")
    assert json.loads(result.stdout)["values"]["power"] == 121.0
    assert len(record.read_text().splitlines()) == 4


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"time,other\n1,2\n", "found 'time,other' in the first line, allowed: 'time,hr:0'"),
        (b"time,hr:0,hr:1\n", "found 'time,hr:0,hr:1' in the first line, allowed"),
        (b"\x1b" * 100, r"\x1b\x1b'… in the first line, allowed"),
        (
            b"\xef\xbb\xbftime,hr:0\r\n",
            r"found '\ufefftime,hr:0\r' in the first line, as a spreadsheet has saved it, allowed",
        ),
        (b"time;hr:0\r\n", r"found 'time;hr:0\r' in the first line, as a spreadsheet has saved it"),
        (b"time\thr:0\r\n", "in the first line, as a spreadsheet has saved it, allowed"),
        (b"time,hr:0 \n", "found 'time,hr:0 ' in the first line, allowed: 'time,hr:0'"),
    ],
)
def test_a_recording_with_other_columns_is_not_touched(
    server: holdfast.Server, tmp_path: Path, content: bytes, told: str
) -> None:
    record = tmp_path / "values.csv"
    record.write_bytes(content)
    assert told in usage_error("read", cli.url(server), "hr:0", "--record", str(record))
    assert record.read_bytes() == content


@pytest.mark.parametrize("torn", ["2026-01-01T00:00:00.000Z,23", "2"])
def test_an_incomplete_line_of_a_recording_is_removed(
    server: holdfast.Server, tmp_path: Path, torn: str
) -> None:
    record = tmp_path / "values.csv"
    record.write_text(f"time,hr:0\n2026-01-01T00:00:00.000Z,230\n{torn}")
    result = invoke("read", cli.url(server), "hr:0", "--record", str(record))
    assert (result.exit_code, result.stderr) == (0, f"{record}: removed an incomplete last line\n")
    head, first, second = record.read_text().splitlines()
    assert (head, first) == ("time,hr:0", "2026-01-01T00:00:00.000Z,230")
    assert second.endswith("Z,0")


TEXTS = "tags: {t: {area: holding_registers, address: 0, type: 'string:12', encoding: latin-1}}"


@pytest.mark.parametrize("text", ["A\nB", "A\rB", "A\0B", 'a"\n"b', " \\x0a,\x1b; "], ids=ascii)
def test_a_recorded_text_is_played_back(
    server: holdfast.Server, memory: holdfast.Memory, tmp_path: Path, text: str
) -> None:
    memory.write("holding_registers", 0, values.encode(text, "string:12", encoding="latin-1"))
    file, record = tmp_path / "texts.yaml", tmp_path / "values.csv"
    file.write_text(TEXTS)
    arguments = ("read", cli.url(server), "--tags", str(file), "--record", str(record))
    for _ in range(2):  # The second one finds the end of the first one's line.
        result = invoke(*arguments)
        assert (result.exit_code, result.stderr) == (0, "")
    assert invoke(*arguments[:4], "--csv").stdout.count(text.replace('"', '""')) == 1
    assert playback.load(record, load_tags(file)).values == {"t": [text, text]}


def test_an_item_has_the_form_that_write_takes(
    server: holdfast.Server, memory: holdfast.Memory
) -> None:
    words = values.encode(b"\x01\xf0\xff", "bytes:3")
    memory.write("holding_registers", 0, words)
    found = answer("read", cli.url(server), "hr:0:bytes:3", "hr:0:bytes:2")["values"]
    assert found == {"hr:0:bytes:3": "01f0ff", "hr:0:bytes:2": "01f0"}
    memory.write("holding_registers", 0, [0, 0])
    done("write", cli.url(server), "hr:0:bytes:3", found["hr:0:bytes:3"])
    assert memory.read("holding_registers", 0, 2) == words


def test_recorded_states_are_played_back_whatever_their_names(
    server: holdfast.Server, memory: holdfast.Memory, tmp_path: Path
) -> None:
    memory.write("holding_registers", 0, [1, 2])
    memory.write("coils", 0, [1])
    file, record = tmp_path / "states.yaml", tmp_path / "values.csv"
    file.write_text("""tags:
  gear: {area: holding_registers, address: 0, states: {0: "1", 1: "2", 2: "3"}}
  half: {area: holding_registers, address: 1, scale: 0.5, states: {0: "1", 1: "0.5"}}
  valve: {area: coils, address: 0, states: {0: "true", 1: "false"}}
""")
    arguments = ("read", cli.url(server), "--tags", str(file), "--record", str(record))
    assert invoke(*arguments).exit_code == 0
    with record.open("a") as rows:
        rows.write("later,0,0.5,false\n")
    found = playback.load(record, load_tags(file)).values
    assert found == {"gear": [1, 0], "half": [1, 0.5], "valve": [True, False]}


@pytest.mark.parametrize("torn", ['2026,"A\n', '2026,"A""\nB', '2026,"A\nB"', "2026,A"], ids=ascii)
@pytest.mark.parametrize("block", [1, 7, recording.BLOCK])
def test_a_line_break_in_a_text_is_no_end_of_a_line(
    server: holdfast.Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, torn: str, block: int
) -> None:
    monkeypatch.setattr(recording, "BLOCK", block)
    record = tmp_path / "values.csv"
    whole = 'time,hr:0\n2026,"A\n""B""\n"\n'
    record.write_text(whole + torn)
    result = invoke("read", cli.url(server), "hr:0", "--record", str(record))
    assert (result.exit_code, result.stderr) == (0, f"{record}: removed an incomplete last line\n")
    assert record.read_text().startswith(whole + "2")
    assert record.read_text().endswith("Z,0\n")


def test_a_recording_without_a_whole_first_line_begins_again(
    server: holdfast.Server, tmp_path: Path
) -> None:
    record = tmp_path / "values.csv"
    record.write_text("time,h")
    assert invoke("read", cli.url(server), "hr:0", "--record", str(record)).exit_code == 0
    assert record.read_text().splitlines()[0] == "time,hr:0"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="the system has no /dev/full")
def test_a_full_disk_ends_the_reading(server: holdfast.Server) -> None:
    wrong = usage_error("read", cli.url(server), "hr:0", "--record", "/dev/full")
    assert wrong == "Error: /dev/full: No space left on device."


def test_a_recording_that_can_not_be_continued_ends_the_command(
    server: holdfast.Server, tmp_path: Path
) -> None:
    limit = "import resource as r; r.setrlimit(r.RLIMIT_FSIZE, (200, 200))"
    code = f"{limit}; from holdfast.cli import main; main()"
    record = tmp_path / "values.csv"
    arguments = ["read", cli.url(server), "hr:0", "--every", "0.001", "--record", str(record)]
    process = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        timeout=wire.DEADLINE,
    )
    assert (process.returncode, process.stderr) == (1, f"holdfast: {record}: File too large\n")
    rows = record.read_text().splitlines()[1:]
    assert {row.partition("Z,")[2] for row in rows} == {"0"}
    assert record.read_text().endswith("\n")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_leaves_a_whole_recording(
    server: holdfast.Server, tmp_path: Path, number: signal.Signals
) -> None:
    record = tmp_path / "values.csv"
    arguments = ["read", cli.url(server), "hr:0", "--every", "0.001", "--record", str(record)]
    process = Command(*arguments)
    wire.until(lambda: record.exists() and record.read_text().count("\n") > 20, "rows are written")
    process.send_signal(number)
    _, log = process.communicate(timeout=wire.DEADLINE)
    assert (process.returncode, log) == (0, "")
    text = record.read_text()
    assert text.endswith("\n")
    assert {line.count(",") for line in text.splitlines()} == {1}


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("hr:0:float33",), "'hr:0:float33': type 'float33' is unknown"),
        (("hr:0:float32:ABDC",), "order 'ABDC' is unknown"),
        (("hr:0:float32:ABCD:x",), "is not AREA:ADDRESS[:TYPE[:ORDER]], as in hr:100:float32:CDAB"),
        (("hr:0:",), "is not AREA:ADDRESS[:TYPE[:ORDER]]"),
        (("hr:",), "ADDRESS is '', allowed: 0 to 65535"),
        (("hr:70000",), "ADDRESS is '70000', allowed: 0 to 65535"),
        (("xy:0",), "'xy' is not an area"),
        (("co:0:float32",), "bool"),
        (("hr:65535:float32",), "ends at 65536, allowed: up to 65535"),
        (("hr:0:uint16[9000]",), "more than 8192 values"),
        (("hr:0", "hr:0"), "two tags have the name 'hr:0:uint16'"),
        (("hr:0", "hr:2", "--type", "int16"), "can't be used with tags or several items"),
        (("hr:0:int16", "--type", "int16"), "can't be used with AREA:ADDRESS:TYPE."),
        (("hr:0", "--times", "2"), "--times requires --every."),
        (("hr", "0", "--csv"), "--csv requires --tags, or each value as an item, as in hr:0 hr:1"),
        (("hr:0", "2", "--record", "x.csv"), "--record requires --tags, or each value as an item"),
        (("hr:0", "--type", "int16", "--csv"), "--csv requires --tags, or each value as an item"),
        (("--profile", "x"), "--profile requires --tags."),
        (
            ("--config", __file__, "--profile", "x"),
            "--config can't be used with --tags or --profile.",
        ),
    ],
)
def test_wrong_usage_is_told(words: tuple[str, ...], told: str) -> None:
    assert told in usage_error("read", "tcp://127.0.0.1", *words)


def test_there_is_one_form_at_a_time() -> None:
    found = answer("read", "tcp://127.0.0.1", "hr:0", "--csv", code=2)
    assert found["detail"] == "--json and --csv can't be used together."


def test_problems_of_a_tag_list_are_told_with_their_places(tmp_path: Path) -> None:
    file = tmp_path / "bad.csv"
    file.write_text("name,area,address,type\na,hr,0,float33\nb,xx,1,uint16\n")
    result = invoke("read", "tcp://127.0.0.1", "--tags", str(file))
    assert result.exit_code == 2
    assert [line.split(": ")[0] for line in result.stderr.splitlines()] == [
        f"{file}:2",
        f"{file}:3",
        "2 problems",
    ]


@pytest.fixture
def unused() -> str:
    """A URL where nothing listens."""
    with FakeDevice(registers) as device:
        return device.url
