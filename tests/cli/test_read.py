"""`holdfast read`, as people and programs use it."""

from __future__ import annotations

import itertools
import json
import re
import signal
import struct
import time
from typing import TYPE_CHECKING

import pytest

from holdfast.cli.live import schedule
from support import cli, transports, wire
from support.cli import answer, done, failure, invoke, usage_error
from support.commands import Command
from support.fake_device import FakeDevice, Late, Stream, exception, registers
from support.paths import ROOT
from support.terminal import Terminal, plain

if TYPE_CHECKING:
    import holdfast
    from holdfast.types import Area
    from support.running import Run


def test_registers_are_shown_in_three_ways(
    server: holdfast.Server, memory: holdfast.Memory
) -> None:
    memory.write("holding_registers", 7, [215, 65535, 0])
    assert done("read", cli.url(server), "holding_registers", "7", "3") == [
        "holding_registers  decimal     hex               binary",
        "                7      215  0x00D7  0000 0000 1101 0111",
        "                8    65535  0xFFFF  1111 1111 1111 1111",
        "                9        0  0x0000  0000 0000 0000 0000",
    ]


def test_a_trace_shows_the_bytes_on_standard_error() -> None:
    with FakeDevice(registers) as device:
        result = invoke("read", device.url, "hr:7", "2", "--json", "--trace")
    assert json.loads(result.stdout)["registers"] == [0, 0]
    line = r"\d\d:\d\d:\d\d\.\d{6} (sent    |received) ([0-9a-f]{2} ?)+"
    sent, received = result.stderr.splitlines()
    assert re.fullmatch(line, sent)
    assert re.fullmatch(line, received)
    assert sent.endswith(" 00 00 00 06 01 03 00 07 00 02")
    assert received.endswith(" 00 00 00 07 01 03 04 00 00 00 00")


def test_a_request_reads_whole_numbers() -> None:
    with FakeDevice(registers) as device:
        found = answer("read", device.url, "hr:7", "60", "--type", "float64")
        asked = [struct.unpack(">BHH", pdu) for pdu in device.asked]
    assert found["values"] == [0.0] * 60
    assert asked == [(3, 7, 124), (3, 131, 116)]


def file_or_queue(pdu: bytes) -> bytes:
    """Records that have their own numbers, and a queue of three."""
    if pdu[0] == 24:
        return bytes.fromhex("18000800030007ffff0000")
    record, count = int.from_bytes(pdu[5:7]), int.from_bytes(pdu[7:9])
    records = b"".join(each.to_bytes(2) for each in range(record, record + count))
    return bytes([20, len(records) + 2, len(records) + 1, 6]) + records


def test_records_of_a_file_and_a_queue_are_read() -> None:
    with FakeDevice(file_or_queue) as device:
        assert done("read", device.url, "file:4:215", "2") == [
            "record  decimal     hex               binary",
            "   215      215  0x00D7  0000 0000 1101 0111",
            "   216      216  0x00D8  0000 0000 1101 1000",
        ]
        assert done("read", device.url, "fifo:1246") == [
            "place  decimal     hex               binary",
            "    0        7  0x0007  0000 0000 0000 0111",
            "    1    65535  0xFFFF  1111 1111 1111 1111",
            "    2        0  0x0000  0000 0000 0000 0000",
        ]
        about = {"ok": True, "target": device.url, "unit": 1}
        assert answer("read", device.url, "FILE:0x4:0") == about | {
            "file": 4,
            "record": 0,
            "count": 1,
            "registers": [0],
        }
        assert answer("read", device.url, "fifo:1246") == about | {
            "fifo": 1246,
            "registers": [7, 65535, 0],
        }
        many = answer("read", device.url, "file:4:0", "300")
        assert many["registers"] == list(range(300))
    asked = [pdu.hex() for pdu in device.asked]
    assert asked[:2] == ["1407060004" + "00d70002", "1804de"]
    assert [pdu[-2:] for pdu in asked[-3:]] == ["79", "79", "3a"]


def test_after_an_error_of_a_file_no_search_of_addresses_is_suggested() -> None:
    with FakeDevice(lambda pdu: exception(pdu, 2)) as device:
        told = f"holdfast: {device.url}: exception 02 (Illegal Data Address)"
        assert failure("read", device.url, "file:4:0") == [told]
        assert failure("read", device.url, "fifo:7") == [told]
        assert failure("write", device.url, "file:4:0", "1") == [told]
    with FakeDevice(lambda pdu: exception(pdu, 11)) as device:
        _, hint = failure("read", device.url, "file:4:0")
        assert hint == f"hint: 'holdfast find {device.url}' finds the unit ids that answer"


def test_a_file_that_does_not_exist_is_told() -> None:
    with FakeDevice(lambda pdu: exception(pdu, 2)) as device:
        told = answer("read", device.url, "file:4:0", "--unit", "3", code=1)
    assert told == {
        "ok": False,
        "target": device.url,
        "unit": 3,
        "file": 4,
        "record": 0,
        "count": 1,
        "reason": "exception",
        "code": 2,
        "detail": "exception 02 (Illegal Data Address)",
    }


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("file:4",), "'file:4' is not file:FILE:RECORD or fifo:ADDRESS"),
        (("file:4:x",), "'file:4:x' is not file:FILE:RECORD"),
        (("fifo:1:2",), "'fifo:1:2' is not"),
        (("fifo:65536",), "address is 65536"),
        (("fifo:1", "2"), "fifo:ADDRESS takes no COUNT"),
        (("file:0:1",), "file is 0, allowed: 1 to 65535"),
        (("file:1:10000",), "record is 10000, allowed: 0 to 9999"),
        (("file:1:9999", "2"), "the last record is 9999"),
        (("file:1:0", "0"), "count is 0"),
        (("file:1:0", "x"), "COUNT is 'x'"),
        (("file:1:0", "1", "2"), "unexpected extra argument (2)"),
        (("file:1:0", "--type", "int16"), "can't be used with file:1:0"),
        (("fifo:1", "--every", "1s"), "can't be used with fifo:1"),
    ],
)
def test_what_no_file_has_is_wrong_usage(words: tuple[str, ...], told: str) -> None:
    assert told in usage_error("read", "tcp://127.0.0.1:1", *words)


REPEATED = ("--every", "0.01", "--times", "3")
SLOW_READS = {
    "read": ("read", "hr:7", *REPEATED),
    "tags": ("read", "--tags", str(ROOT / "examples" / "tags" / "heater.yaml"), *REPEATED),
    "describe": ("describe", "--units", "1-10"),
}


@pytest.mark.parametrize("as_json", [(), ("--json",)])
@pytest.mark.parametrize("arguments", SLOW_READS.values(), ids=SLOW_READS)
def test_replies_after_the_timeout_are_a_hint(
    arguments: tuple[str, ...], as_json: tuple[str, ...]
) -> None:
    with Stream("tcp", then=Late()) as device:
        command, *rest = arguments
        found = invoke(command, device.url, *rest, "--timeout", "0.05", *as_json)
    *_, last = found.stderr.splitlines(keepends=True)
    assert cli.LATE.fullmatch(last), found.stderr


@pytest.mark.parametrize("place", [("hr", "7"), ("hr:7",)], ids=["once", "one tag"])
def test_a_single_read_waits_for_a_late_reply_to_hint_at(place: tuple[str, ...]) -> None:
    with Stream("tcp", then=Late()) as device:
        # Long enough for a loaded machine to tell a late reply from one that never comes.
        found = invoke("read", device.url, *place, "--timeout", "2")
    *_, last = found.stderr.splitlines(keepends=True)
    assert "longer than --timeout 2 s: use --timeout " in last, found.stderr


def test_without_late_replies_there_is_no_hint(server: holdfast.Server) -> None:
    assert invoke("read", cli.url(server), "hr:7", *REPEATED).stderr == ""


def test_bits_are_shown_sixteen_a_line(server: holdfast.Server, memory: holdfast.Memory) -> None:
    memory.write("coils", 3, [1, 0, 1])
    memory.write("coils", 20, [1])
    head, first, second = done("read", cli.url(server), "coils", "3", "18")
    assert head.split() == ["coils", *(f"+{offset}" for offset in range(16))]
    assert first.split() == ["3", "1", "0", "1", *"0" * 13]
    assert second.split() == ["19", "0", "1"]


def test_one_value_is_read_if_no_count_is_given(server: holdfast.Server) -> None:
    assert len(done("read", cli.url(server), "input_registers", "0x10")) == 2


@pytest.mark.parametrize("address", ["0", "0x3E7"])
@pytest.mark.parametrize(
    ("name", "area"),
    [
        ("co", "coils"),
        ("di", "discrete_inputs"),
        ("hr", "holding_registers"),
        ("ir", "input_registers"),
        ("c", "coils"),
        ("DISC", "discrete_inputs"),
        ("holding", "holding_registers"),
        ("input-registers", "input_registers"),
    ],
)
def test_an_area_has_short_names(
    server: holdfast.Server,
    memory: holdfast.Memory,
    name: str,
    area: Area,
    address: str,
) -> None:
    memory.write(area, int(address, 0), [1])
    found = answer("read", cli.url(server), name, address)
    assert (found["area"], found["address"]) == (area, int(address, 0))
    assert (found.get("registers") or found["bits"]) == [1]


def test_typed_values_are_shown_with_their_registers(
    server: holdfast.Server, memory: holdfast.Memory
) -> None:
    floats = struct.unpack(">4H", struct.pack(">2f", 21.5, 0.1))
    memory.write("holding_registers", 100, floats)
    assert done("read", cli.url(server), "hr", "100", "2", "--type", "float32") == [
        "holding_registers  registers  float32",
        "          100-101  41AC 0000  21.5",
        "          102-103  3DCC CCCD  0.1",
    ]
    found = answer("read", cli.url(server), "hr", "100", "--type", "float32[2]")
    assert found["values"] == [21.5, 0.1]
    assert (found["count"], found["registers"], found["type"]) == (4, list(floats), "float32")


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        ("float32", [21.5, 0.1]),
        ("float32[2]", [21.5, 0.1]),
        ("bit:3", [True, False, True, True]),
        ("uint64", [0x41AC00003DCCCCCD]),
        ("bytes:3", ["41ac00", "3dcccc"]),
    ],
)
def test_the_last_address_is_the_last_that_is_read_whatever_the_type(
    server: holdfast.Server, memory: holdfast.Memory, kind: str, values: list[object]
) -> None:
    memory.write("holding_registers", 10, struct.unpack(">4H", struct.pack(">2f", 21.5, 0.1)))
    found = answer("read", cli.url(server), "hr:10-13", "--type", kind)
    assert (found["address"], found["count"]) == (10, 4)
    assert found["values"] == values
    assert answer("read", cli.url(server), "co:0-2", "--type", "bool")["values"] == [False] * 3


@pytest.mark.parametrize(
    ("kind", "raw", "told", "value"),
    [
        ("int16", [0xFFFB], "-5", -5),
        ("bit:3", [8], "true", True),
        ("bcd16", [0x1234], "1234", 1234),
        ("string:4", [0x4142, 0x1B00], '"AB\\u001b"', "AB\x1b"),
        ("bytes:3", [0x0102, 0x0300], "01 02 03", "010203"),
        ("float16", [0x7C00], "inf", None),
        ("bool", [7], "true", True),
    ],
)
def test_every_type_is_shown(
    server: holdfast.Server,
    memory: holdfast.Memory,
    kind: str,
    raw: list[int],
    told: str,
    value: object,
) -> None:
    memory.write("input_registers", 0, raw)
    [_, line] = done("read", cli.url(server), "ir", "0", "--type", kind)
    assert line.endswith(f"  {told}")
    assert answer("read", cli.url(server), "ir", "0", "--type", kind)["values"] == [value]


def test_order_and_encoding_are_those_of_the_library(
    server: holdfast.Server, memory: holdfast.Memory
) -> None:
    memory.write("holding_registers", 0, [0, 0x41AC, 0xC3A4])
    [_, line] = done("read", cli.url(server), "hr", "0", "--type", "float32", "--order", "CDAB")
    assert line.split() == ["0-1", "0000", "41AC", "21.5"]
    [_, line] = done("read", cli.url(server), "hr", "2", "--type", "string:2", "--encoding", "utf8")
    assert line.split() == ["2", "C3A4", '"ä"']


def test_what_is_no_value_is_told_and_the_others_are_shown(
    server: holdfast.Server, memory: holdfast.Memory
) -> None:
    memory.write("holding_registers", 0, [0x12A4, 0x1234])
    result = invoke("read", cli.url(server), "hr", "0", "2", "--type", "bcd16")
    assert result.exit_code == 1
    assert result.stdout.splitlines()[1:] == [
        "                0  12A4       ? digits 0x12A4 are not bcd16, allowed: 0 to 9",
        "                1  1234       1234",
    ]
    found = answer("read", cli.url(server), "hr", "0", "2", "--type", "bcd16", code=1)
    assert found["values"] == [None, 1234]
    assert (found["ok"], found["reason"], list(found["errors"])) == (False, "undecodable", ["0"])


@pytest.mark.parametrize(
    ("number", "area", "address"),
    [
        ("40001", "holding_registers", 0),
        ("400001", "holding_registers", 0),
        ("4x0001", "holding_registers", 0),
        ("4X1000", "holding_registers", 999),
        ("30011", "input_registers", 10),
        ("3x00011", "input_registers", 10),
        ("10001", "discrete_inputs", 0),
        ("00002", "coils", 1),
        ("000016", "coils", 15),
    ],
)
def test_a_modicon_number_names_area_and_address(
    server: holdfast.Server, number: str, area: str, address: int
) -> None:
    found = answer("read", cli.url(server), number)
    assert (found["area"], found["address"]) == (area, address)
    head, row = done("read", cli.url(server), number)
    assert (head.split()[0], row.split()[0]) == (area, str(address))


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (
            ("40000",),
            "'40000' is not a Modicon number, as in 40001, 400001 or 4x0001, and 0,",
        ),
        (("465537",), "'465537' is not a Modicon number"),
        (("20001",), "'20001' has no area"),
        (("hr", "40001", "--modicon"), "no --modicon any more: type the number alone, as in 40001"),
        (("100",), "'100' has no area: type hr:100 for a holding register, counted from 0"),
        (("0x0001",), "type co:0 for the Modicon number, or name the area of the address 1"),
        (("hr:0", "40001"), "type hr:0-40000 for that many, or hr:0 for the Modicon number."),
        (("40001", "40003"), "type hr:0-40002 for that many, or hr:2 for the Modicon number."),
        (("ir", "4x0001"), "4x0001 is in holding_registers, not in input_registers."),
        (("hr", "400001"), "did you mean hr:0, Modicon's 400001?"),
        (("%MD4",), "type hr:4:uint32 or hr:8:uint32, as controllers count words or pairs"),
        (("%MD0",), "'%MD0' is not an item: type hr:0:uint32."),
        (("%mf0",), "'%mf0' is not an item: type hr:0:float32."),
        (("%IW0",), "'%IW0' is not clear: type ir:0 or, with CODESYS, hr:0."),
        (("%IW3",), "'%IW3' is not clear: type ir:3 or, with CODESYS, hr:3."),
        (("%MB3",), "'%MB3' is not an item, allowed: %MW0 for hr:0, %M0 for co:0"),
        (("holdng_registers", "0"), "did you mean 'holding_registers'?"),
        (("hr:0", "--type", "flaot32"), "did you mean 'float32'?"),
        (("hr:0:flaot32",), "did you mean 'float32'?"),
        (("hr:0:real",), "did you mean 'float32'?"),
        (("hr:0:u16",), "did you mean 'uint16'?"),
        (("hr", "65536"), "ADDRESS is '65536', allowed: 0 to 65535, decimal or 0x."),
        (("co:1.3",), "ADDRESS is '1.3', allowed: 0 to 65535, decimal or 0x."),
        (("hr:1.16",), "ADDRESS is '1.16', allowed: 0 to 65535, decimal or 0x."),
        (("10101.3",), "'10101.3' is not an area, allowed: "),
        (("hr", "-1"), "No such option '-1'."),
        (("registers", "1"), "'registers' is not an area"),
        (("", "1"), "'' is not an area"),
        (("hr",), "Missing argument 'ADDRESS'."),
        ((), "Missing argument 'ITEM' (AREA ADDRESS, AREA:ADDRESS), or --tags."),
        (("hr", "0", "0"), "COUNT is '0', allowed: 1 to 65536."),
        (("hr", "0", "x"), "COUNT is 'x', allowed: 1 to 65536."),
        (("hr", "0", "1", "2"), "Got unexpected extra argument (2)."),
        (("hr", "65535", "2"), "2 registers from address 65535: the last address is 65535."),
        (("hr", "0", "--order", "CDAB"), "--order and --encoding require --type."),
        (("hr", "0", "--type", "float33"), "type 'float33' is unknown"),
        (("hr", "0", "--type", "float32", "--order", "ABDC"), "order 'ABDC' is unknown"),
        (("co", "0", "--type", "float32"), "coils contain bits; the only type is bool."),
        (
            ("hr:0-8", "--type", "uint32"),
            "'hr:0-8' is 9 registers, allowed with uint32: a multiple of 2.",
        ),
        (
            ("hr:0-5", "--type", "float32[2]"),
            "'hr:0-5' is 6 registers, allowed with float32[2]: a multiple of 4.",
        ),
        (("hr", "0", "--times", "2"), "--times requires --every. For 10 values, type hr:0 10."),
        (
            ("hr", "0", "--every", "nan"),
            "'nan' is not a time, as in 500ms, 2s or 2 (seconds): more than 0, up to 86400 s.",
        ),
        (
            ("hr", "0", "--timeout", "0"),
            "'0' is not a time, as in 500ms, 2s or 2 (seconds): more than 0, up to 86400 s.",
        ),
        (("hr", "0", "--unit", "256"), "found 256, allowed: 0 to 255."),
    ],
)
def test_wrong_usage_is_told(words: tuple[str, ...], told: str) -> None:
    assert told in usage_error("read", "tcp://127.0.0.1", *words)


def test_a_wrong_url_is_wrong_usage() -> None:
    assert "'plc' is not the URL of a device, allowed: tcp://host:502" in usage_error(
        "read", "plc", "hr", "0"
    )


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("hr:0:flot",), "did you mean 'float32'?"),
        (("hr", "0", "--type", "UNIT16"), "did you mean 'uint16'?"),
        (("hr:0:unit32[4]",), "did you mean 'uint32[4]'?"),
        (("Holding-Registres", "0"), "did you mean 'holding_registers'?"),
        (("hr100", "1"), "did you mean 'hr:100', counted from 0?"),
        (("hr100:7",), "did you mean 'hr:100', counted from 0?"),
        (("HR100",), "did you mean 'HR:100', counted from 0?"),
        (("co.1",), "did you mean 'co:1', counted from 0?"),
        (("holding registers7", "1"), "did you mean 'holding registers:7', counted from 0?"),
        (("hr_1", "1"), "did you mean 'hr:1', counted from 0?"),
        (("40101.3",), "did you mean '40101:bit:3'?"),
        (("hr:12345.3",), "did you mean 'hr:12345:bit:3'?"),
        (("4x0101.03",), "did you mean '4x0101:bit:3'?"),
        (("hr:100.15",), "did you mean 'hr:100:bit:15'?"),
        (("ir", "100.3"), "did you mean 'ir:100:bit:3'?"),
        (("hr", "0", "--type", "float32", "--order", "le"), "did you mean 'DCBA'?"),
        (("4hr", "1"), "did you mean 'hr'?"),
        (("hr:5-2",), "in FIRST-LAST, the lower address is first: 2-5."),
    ],
)
def test_a_suggestion_ends_an_error(words: tuple[str, ...], told: str) -> None:
    assert usage_error("read", "tcp://127.0.0.1", *words).endswith(f"; {told}")


def test_a_suggestion_for_a_url_ends_an_error() -> None:
    assert usage_error("read", "tpc://127.0.0.1", "hr", "0").endswith("; did you mean 'tcp'?")
    url = "rtu:///dev/ttyUSB0?boud=9600"
    assert usage_error("read", url, "hr", "0").endswith("; did you mean 'baud'?")


def test_a_modicon_number_as_address_is_what_it_says_and_hinted_at(
    server: holdfast.Server,
) -> None:
    url = cli.url(server)
    assert failure("read", url, "hr", "40011") == [
        f"holdfast: {url}: exception 02 (Illegal Data Address)",
        "hint: addresses count from 0; as a Modicon number 40011 is hr:10",
        f"hint: 'holdfast describe map {url}' finds the addresses that exist",
    ]
    assert len(failure("read", url, "ir", "40011")) == 2


def test_an_item_is_written_in_many_ways(server: holdfast.Server, memory: holdfast.Memory) -> None:
    memory.write("holding_registers", 0, [1, 2, 3, 4])
    url = cli.url(server)
    for words in (
        ("hr", "0"),
        ("HR", "0"),
        ("Holding-Registers", "0"),
        ("40001",),
        ("400001",),
        ("4x0001",),
        ("%MW0",),
        ("%mw0",),
        ("hr", "4x1"),
    ):
        found = cli.answer("read", url, *words)
        assert (found["area"], found["address"]) == ("holding_registers", 0)
        assert found["registers"] == [1]
    for text in ("hr:0 2", "hr:0-1", "40001 2", "%MW0 2"):
        assert cli.answer("read", url, *text.split())["registers"] == [1, 2]
    assert cli.answer("read", url, "hr:0:UINT32", "2")["values"] == [0x10002, 0x30004]
    for text in ("hr 0:uint32", "hr 0 --type uint32", "hr:0 --type uint32"):
        assert cli.answer("read", url, *text.split())["values"] == [0x10002]
    found = cli.answer("read", url, "4x0001", "%MW1", "hr", "2", "hr:3:int16")
    assert found["values"] == {"hr:0": 1, "hr:1": 2, "hr:2": 3, "hr:3": 4}


def test_old_options_work_with_a_hint(server: holdfast.Server) -> None:
    url = cli.url(server)
    result = invoke("watch", url, "hr:0", "--count=1")
    assert result.exit_code == 0
    assert result.stderr.startswith("hint: '--count 1' is now '--times 1'\n")
    result = invoke("read", url, "hr:0", "--count", "2")
    assert result.exit_code == 2
    assert result.stderr.startswith("hint: '--count 2' is now '--times 2'\n")
    result = invoke("describe", "guess", url, "--count", "2", "hr:0", "--every", "1ms")
    assert result.stderr == "hint: '--count 2' is now '2'\n"
    assert result.stdout.startswith("holding_registers 0 to 1:")
    result = invoke("bench", url, "--area", "ir", "--address", "2", "--seconds", "0.05")
    assert result.stderr.splitlines() == [
        "hint: '--area ir' is now 'ir'",
        "hint: '--address 2' is now '2'",
        "hint: '--seconds 0.05' is now '--duration 0.05'",
    ]
    assert "input_registers 2 to 11" in result.stdout
    result = invoke("check", "plan", url, "--read", "hr:4:3")
    assert result.stderr == "hint: '--read hr:4:3' is now 'hr:4-6'\n"
    for spelling in ("50ms", "0.05s", ".05", "5e-2"):
        assert invoke("bench", url, "--duration", spelling).exit_code == 0
    assert "write 2min or 2ms" in usage_error("read", url, "hr:0", "--timeout", "2m")


def test_errors_are_told_to_programs(server: holdfast.Server) -> None:
    found = answer("read", cli.url(server), "hr", "1000", code=1)
    assert (found["ok"], found["reason"], found["code"]) == (False, "exception", 2)
    assert found["detail"] == "exception 02 (Illegal Data Address)"


def test_silence_is_told() -> None:
    with FakeDevice(lambda _: None) as device:
        found = answer("read", device.url, "hr", "0", "--timeout", "0.05", code=1)
    assert (found["ok"], found["reason"]) == (False, "timeout")


@pytest.mark.parametrize("kind", ["tcp", "udp", "rtu"])
def test_every_transport_is_read_and_written(kind: str, run: Run) -> None:
    host, port = transports.address(run(transports.configuration(kind)))
    url = f"{'rtu+tcp' if kind == 'rtu' else kind}://{host}:{port}"
    done("write", url, "hr", "5", "21.5", "--type", "float32", "--verify")
    assert answer("read", url, "hr", "5", "--type", "float32")["values"] == [21.5]


def test_repeated_readings_are_a_line_each(
    server: holdfast.Server, memory: holdfast.Memory
) -> None:
    memory.write("holding_registers", 5, [1, 2])
    options = ("--every", "0.001", "--times", "3")
    head, *lines = done("read", cli.url(server), "hr", "5", "2", *options)
    assert head.split() == ["time", "5", "6"]
    assert [line.split()[1:] for line in lines] == [["1", "2"]] * 3
    result = invoke("read", cli.url(server), "hr", "5", "2", *options, "--json")
    found = [json.loads(line) for line in result.stdout.splitlines()]
    assert [each["registers"] for each in found] == [[1, 2]] * 3
    assert found[0]["time"] <= found[2]["time"]


def test_repeated_readings_go_on_after_an_error() -> None:
    numbers = itertools.count()

    def answers(pdu: bytes) -> bytes:
        return exception(pdu, 6) if next(numbers) == 1 else registers(pdu, 7)

    with FakeDevice(answers) as device:
        options = ("hr", "0", "--every", "0.001", "--times", "3")
        result = invoke("read", device.url, *options)
        programs = invoke("read", device.url, *options, "--json")
    assert result.exit_code == 1
    _, first, second, third = result.stdout.splitlines()
    assert second.endswith("  exception 06 (Server Device Busy)")
    assert first.split()[1:] == third.split()[1:] == ["7"]
    assert [json.loads(line)["ok"] for line in programs.stdout.splitlines()] == [True] * 3


def test_ticks_do_not_drift_and_leave_out_what_was_missed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = 100.0
    seen = []

    def wait(seconds: float) -> None:
        nonlocal now
        now += seconds

    monkeypatch.setattr(time, "monotonic", lambda: now)
    for tick, taken in zip(schedule.ticks(2.0, wait=wait), (0.5, 1.5, 4.5, 0, 2), strict=False):
        seen.append((tick, now))
        now += taken
    assert seen == [(0, 100), (1, 102), (2, 104), (3, 110), (4, 112)]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_repeated_readings(server: holdfast.Server, number: signal.Signals) -> None:
    process = Command("read", cli.url(server), "hr", "0", "--every", "0.01")
    try:
        assert process.stdout is not None
        assert process.stdout.readline().split() == ["time", "0"]
        assert process.stdout.readline()
        process.send_signal(number)
        _, log = process.communicate(timeout=wire.DEADLINE)
    finally:
        process.kill()
        process.communicate()
    assert (process.returncode, log) == (0, "")


def test_changes_are_coloured_on_a_terminal_unless_that_is_not_wanted(
    server: holdfast.Server, memory: holdfast.Memory
) -> None:
    arguments = ("read", cli.url(server), "hr", "0", "--every", "0.01")
    with Terminal(*arguments) as terminal:
        terminal.until("time", " 0\n")
        memory.write("holding_registers", 0, [4711])
        terminal.until("4711")
        assert terminal.end(signal.SIGINT) == 0
        assert "\x1b[33m\x1b[1m 4711\x1b[0m" in terminal.shown
    with Terminal(*arguments, NO_COLOR="1") as terminal:
        terminal.until(" 4711\n")
        memory.write("holding_registers", 0, [815])
        terminal.until(" 815\n")
        terminal.keys("\x03")
        assert terminal.end() == 0
        assert plain(terminal.shown) == terminal.shown.replace("\r", "")


def test_an_old_option_before_the_url_becomes_an_item_behind_it(server: holdfast.Server) -> None:
    url = cli.url(server)
    after = done("bench", url, "ir", "2", "--duration", "0.05", "--json")
    before = invoke("bench", "--area", "ir", "--address", "2", url, "--duration", "0.05", "--json")
    assert json.loads(before.stdout).keys() == json.loads("\n".join(after)).keys()
    assert before.stderr == "hint: '--area ir' is now 'ir'\nhint: '--address 2' is now '2'\n"
