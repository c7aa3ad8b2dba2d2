"""`holdfast write`, as people and programs use it."""

from __future__ import annotations

import json
import struct
from typing import TYPE_CHECKING

import pytest

from holdfast import values
from support import cli, wire
from support.brokers import free_port
from support.cli import answer, done, failure, usage_error
from support.fake_device import FakeDevice, Serial, exception, silent
from support.lines import RTU

if TYPE_CHECKING:
    from pathlib import Path

    import holdfast
    from holdfast.types import Area

NOWHERE = "tcp://127.0.0.1:1"


@pytest.mark.parametrize(
    ("words", "area", "address", "stored"),
    [
        (("hr", "3", "7"), "holding_registers", 3, [7]),
        (("hr", "3", "7", "0xFFFF", "0X10"), "holding_registers", 3, [7, 65535, 16]),
        (("co", "3", "on"), "coils", 3, [1]),
        (("coils", "3", "true", "FALSE", "on", "off", "1", "0"), "coils", 3, [1, 0, 1, 0, 1, 0]),
        (("40004", "9"), "holding_registers", 3, [9]),
        (("00004", "1"), "coils", 3, [1]),
        (("hr", "0", "-5", "--type", "int16"), "holding_registers", 0, [0xFFFB]),
        (("hr", "0", "--type", "int16", "--", "-0x5"), "holding_registers", 0, [0xFFFB]),
        (("hr", "0", "-1", "2", "--type", "int16"), "holding_registers", 0, [0xFFFF, 2]),
        (("hr", "0", "1", "2", "--type", "int16[2]"), "holding_registers", 0, [1, 2]),
        (
            ("hr", "0", "21.5", "--type", "float32", "--order", "CDAB"),
            "holding_registers",
            0,
            [0, 0x41AC],
        ),
        (("hr", "0", "-.5", "--type", "float16"), "holding_registers", 0, [0xB800]),
        (("hr", "0", "-inf", "--type", "float16"), "holding_registers", 0, [0xFC00]),
        (("hr", "0", "ABC", "--type", "string:4"), "holding_registers", 0, [0x4142, 0x4300]),
        (("hr", "0", "01 02", "--type", "bytes:2"), "holding_registers", 0, [0x0102]),
        (("hr", "0", "0x0102", "--type", "bytes:2"), "holding_registers", 0, [0x0102]),
        (("hr", "0", "1234", "--type", "bcd16"), "holding_registers", 0, [0x1234]),
        (("hr", "0", "true", "off", "--type", "bool"), "holding_registers", 0, [1, 0]),
    ],
)
def test_values_are_written_and_read_back(
    server: holdfast.Server,
    memory: holdfast.Memory,
    words: tuple[str, ...],
    area: Area,
    address: int,
    stored: list[int],
) -> None:
    last = address + len(stored) - 1
    where = f"{address}" if len(stored) == 1 else f"{address} to {last}"
    call = ("write", cli.url(server), "--verify", *words)
    assert done(*call) == [f"Written: {area} {where}, 1 request; read back alike."]
    assert memory.read(area, address, len(stored)) == stored


def test_one_bit_of_a_register_is_written_and_the_others_are_kept(
    server: holdfast.Server, memory: holdfast.Memory
) -> None:
    memory.write("holding_registers", 4, [0x0F0F])
    url = cli.url(server)
    done("write", url, "hr", "4", "on", "--type", "bit:15", "--verify")
    assert memory.read("holding_registers", 4, 1) == [0x8F0F]
    done("write", url, "hr", "4", "off", "--type", "bit:0", "--verify")
    assert memory.read("holding_registers", 4, 1) == [0x8F0E]


def test_a_dry_run_prints_the_functions_that_the_device_gets() -> None:
    url = f"{NOWHERE}?write_multiple=1"
    assert done("write", url, "hr", "5", "7", "--dry-run") == ["100005000102" + "0007"]
    assert done("write", url, "co", "5", "on", "--dry-run") == ["0f000500010101"]


@pytest.mark.parametrize(
    ("words", "pdus"),
    [
        (("co", "172", "on"), ["0500acff00"]),
        (("hr", "1", "3"), ["0600010003"]),
        (("co", "19", *"1011001110"), ["0f0013000a02cd01"]),
        (("hr", "1", "10", "258"), ["100001000204000a0102"]),
        (("hr", "1", "1.5", "--type", "float32"), ["1000010002043fc00000"]),
        (("hr", "4", "on", "--type", "bit:1"), ["160004fffd0002"]),
        (
            ("hr", "0", *["7"] * 124, "--split"),
            ["100000007bf6" + "0007" * 123, "10007b0001020007"],
        ),
        (
            ("hr", "0", *["1.5"] * 31, "--type", "float64", "--split"),
            ["1000000078f0" + "3ff8000000000000" * 30, "100078000408" + "3ff8000000000000"],
        ),
        (
            ("hr", "0", "1.", "+.5", " 2E-1 ", "-Infinity", "--type", "float32"),
            ["1000000008103f8000003f0000003e4ccccdff800000"],
        ),
        (("hr", "0", "nan", "--type", "float16"), ["0600007e00"]),
    ],
)
def test_a_dry_run_prints_the_requests_and_sends_nothing(
    words: tuple[str, ...], pdus: list[str]
) -> None:
    assert done("write", NOWHERE, *words, "--dry-run") == pdus
    found = answer("write", NOWHERE, *words, "--dry-run")
    assert (found["ok"], found["target"], found["pdus"]) == (True, NOWHERE, pdus)


def test_many_values_are_written_by_several_requests_if_that_is_wanted(
    server: holdfast.Server, memory: holdfast.Memory
) -> None:
    many = [str(number) for number in range(300)]
    told = usage_error("write", cli.url(server), "hr", "0", *many)
    assert told.startswith("Error: 300 values, one request writes at most 123; use --split ")
    found = answer("write", cli.url(server), "hr", "0", *many, "--split", "--verify")
    assert (found["ok"], found["count"], found["verified"]) == (True, 300, True)
    assert memory.read("holding_registers", 0, 300) == list(range(300))


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("hr", "0", "65536"), "65536 is outside 0 to 65535 of uint16."),
        (
            ("hr", "0", "1", "-1"),
            "values[1]: -1 is outside 0 to 65535 of uint16; negative numbers "
            "require --type, as in --type int16.",
        ),
        (("hr", "0", "-5", "--type", "uint32"), "-5 is outside 0 to 4294967295 of uint32."),
        (
            ("hr", "0", "1.5"),
            "'1.5' is not an integer, decimal or 0x; other values require --type.",
        ),
        (
            ("hr", "0", "1_0"),
            "'1_0' is not an integer, decimal or 0x; other values require --type.",
        ),
        (("co", "0", "2"), "'2' is not true, false, on, off, 1 or 0."),
        (("hr", "0", "x", "--type", "float32"), "'x' is not a number."),
        (("hr", "0", "1_0.5", "--type", "float32"), "'1_0.5' is not a number."),
        (("hr", "0", "21_5", "--type", "float64"), "'21_5' is not a number."),
        (("hr", "0", "２1.5", "--type", "float32"), "'２1.5' is not a number."),
        (("hr", "0", "٣", "--type", "float16"), "'٣' is not a number."),
        (("hr", "0", "1e1_0", "--type", "float32"), "'1e1_0' is not a number."),
        (("hr", "0", ".", "--type", "float32"), "'.' is not a number."),
        (("hr", "0", "ınf", "--type", "float32"), "'ınf' is not a number."),
        (("hr", "0", "0x10", "--type", "float32"), "'0x10' is not a number."),
        (("hr", "0", "1e99", "--type", "float32"), "of float32."),
        (("hr", "0", "1e999", "--type", "float64"), "'1e999' is outside the range of float64."),
        (("hr", "0", "-1e999", "--type", "float16"), "'-1e999' is outside the range of float16."),
        (
            ("hr", "0", "1e-400", "--type", "float64"),
            "is too small for float64, which would hold 0.",
        ),
        (("hr", "0", "xy", "--type", "bytes:1"), "'xy' is not hex, allowed: pairs of hex digits."),
        (("hr", "0", "ABC", "--type", "string:2"), "allowed in string:2: up to 2."),
        (("hr", "0", "1", "--type", "int16[2]"), "int16[2] takes 2 values, found 1."),
        (("hr", "0", "1", "0", "--type", "bit:1"), "bit:1 takes one value, found 2."),
        (("co", "0", "1", "--type", "int16"), "coils contain bits; the only type is bool."),
        (("hr", "0"), "Missing argument 'VALUE...'."),
        (("setpoint=21.5",), "'setpoint=21.5': NAME=VALUE requires --tags or --config."),
        (("hr", "0", "21,5", "--type", "float32"), "'21,5' is not a number; did you mean '21.5'?"),
        (("ir", "0", "1"), "input_registers can't be written, only read."),
        (("30001", "1"), "input_registers can't be written, only read."),
        (("hr", "0", "1", "--tpye", "int16"), "No such option '--tpye'."),
        (("hr", "0", "1", "-v"), "No such option '-v'."),
        (("hr", "0", "1", "-v", "--", "-w"), "No such option '-v'."),
        (("hr", "0", "-5h", "--type", "int16"), "'-5h' is not an integer"),
        (("hr", "65535", "1", "2"), "65535"),
        (
            ("hr:0-1", "1", "--type", "uint64"),
            "'hr:0-1' is 2 registers, the values are 4.",
        ),
        (("co:0-2", "1"), "'co:0-2' is 3 bits, the values are 1."),
    ],
)
def test_wrong_usage_is_told(words: tuple[str, ...], told: str) -> None:
    assert told in usage_error("write", NOWHERE, *words)


@pytest.mark.parametrize("text", ["-ab", "-h", "--", "-5h"])
def test_words_behind_two_hyphens_are_values(
    server: holdfast.Server, memory: holdfast.Memory, text: str
) -> None:
    done("write", cli.url(server), "hr", "0", "--type", "string:4", "--", text)
    written = values.encode(text, "string:4")
    assert memory.read("holding_registers", 0, 2) == written


@pytest.mark.parametrize("word", ["-h", "--help"])
def test_the_help_is_a_word_of_its_own(word: str) -> None:
    assert done("write", NOWHERE, "hr", "0", word)[0].startswith("Usage: ")


def test_a_refusal_is_told(server: holdfast.Server) -> None:
    url = cli.url(server)
    assert failure("write", url, "hr", "1000", "1") == [
        f"holdfast: {url}: exception 02 (Illegal Data Address)",
        "hint: the address does not exist, or may not be written; if Holdfast serves it, see "
        "'holdfast check FILE --as ADDRESS', and 'writes' of the device in FILE",
    ]
    found = answer("write", url, "hr", "1000", "1", code=1)
    assert (found["ok"], found["code"], found["maybe_written"]) == (False, 2, False)


def test_a_device_without_the_function_may_have_another() -> None:
    def multiple(pdu: bytes) -> bytes:
        return exception(pdu, 1) if pdu[0] == 6 else pdu[:5]

    with FakeDevice(multiple) as device:
        assert failure("write", device.url, "hr", "0", "1") == [
            f"holdfast: {device.url}: exception 01 (Illegal Function)",
            "hint: the device lacks the function, or lets this client only read: some write one "
            "coil or register with write_multiple=1 in the URL; if Holdfast serves it, see "
            "'holdfast check FILE --as ADDRESS'",
        ]
        assert answer("write", f"{device.url}?write_multiple=1", "hr", "0", "1")["ok"] is True


def test_silence_leaves_it_open_whether_something_was_written() -> None:
    with FakeDevice(lambda _: None) as device:
        found = answer("write", device.url, "hr", "0", "1", "--timeout", "0.05", code=1)
    assert (found["reason"], found["maybe_written"]) == ("timeout", True)


def forgetful(pdu: bytes) -> bytes | None:
    """A device that accepts every write, and holds 8 in every register."""
    if pdu[0] == 3:
        return bytes([3, 2 * pdu[4]]) + struct.pack(">H", 8) * pdu[4]
    return pdu[:5]


@pytest.mark.parametrize(
    "words",
    [
        "read URL hr 0",
        "read URL hr:0 co:1",
        "read URL fifo:0 --json",
        "watch URL hr 0",
        "describe map URL --json",
        "describe identify URL",
        "describe status URL",
        "bench URL hr:0 1",
        "write URL hr 0 7 --verify",
        "write URL file:4:0 7 --verify",
        "write URL level=7 --tags TAGS --verify",
    ],
)
def test_only_writes_go_to_all_units_of_a_line(tmp_path: Path, words: str) -> None:
    tags = tmp_path / "tags.yaml"
    tags.write_text("tags: {level: {area: holding_registers, address: 0, writable: true}}")
    call = words.replace("TAGS", str(tags)).replace("URL", "rtu:///dev/missing").split()
    told = "Unit id 0 is the broadcast on a serial line: nobody answers it."
    if "--json" in call:
        found = cli.invoke(*call, "--unit", "0")
        assert (found.exit_code, json.loads(found.stdout)["detail"]) == (2, told)
    else:
        assert usage_error(*call, "--unit", "0") == f"Error: {told}"


def test_a_write_to_all_units_of_a_line_is_sent(tmp_path: Path) -> None:
    with Serial(RTU, tmp_path / "line", then=silent) as device:
        written = done("write", device.url, "hr", "5", "7", "--unit", "0")
        wire.until(lambda: device.requests, "the request is there")
    assert written == ["Written: holding_registers 5, 1 request."]
    assert [(asked.unit, asked.pdu.hex()) for asked in device.requests] == [(0, "0600050007")]


def test_what_is_not_read_back_alike_is_told() -> None:
    with FakeDevice(forgetful) as device:
        call = ("write", device.url, "hr", "5", "7", "8", "9", "--verify")
        assert failure(*call) == [
            "holdfast: holding_registers 5: wrote 7, read back 8",
            "holdfast: holding_registers 7: wrote 9, read back 8",
        ]
        found = answer(*call, code=1)
    assert (found["ok"], found["verified"]) == (False, False)


def test_what_can_not_be_read_back_is_told() -> None:
    with FakeDevice(lambda pdu: exception(pdu, 1) if pdu[0] == 3 else pdu[:5]) as device:
        call = ("write", device.url, "hr", "5", "7", "--verify")
        assert failure(*call) == [
            "Written: holding_registers 5, 1 request; could not be read back",
            f"holdfast: {device.url}: exception 01 (Illegal Function)",
        ]
        found = answer(*call, code=1)
    assert (found["ok"], found["code"]) == (False, 1)
    assert (found["written"], found["maybe_written"]) == (1, False)


def test_records_of_a_file_are_written_and_read_back() -> None:
    records = "06af04be"

    def file(pdu: bytes) -> bytes:
        return pdu if pdu[0] == 21 else bytes.fromhex("14060506" + records)

    request = "150b0600040007000206af04be"
    call = ("write", "file:4:7", "1711", "0x4BE")
    with FakeDevice(file) as device:
        to = (call[0], device.url, *call[1:])
        written = "Written: file 4 records 7 to 8, 1 request"
        assert done(*to) == [f"{written}."]
        assert done(*to, "--verify") == [f"{written}; read back alike."]
        assert answer(*to) == {
            "ok": True,
            "target": device.url,
            "unit": 1,
            "file": 4,
            "record": 7,
            "count": 2,
        }
        records = "06af04bf"
        assert "file 4 record 8: wrote 1214, read back 1215" in cli.invoke(*to, "--verify").stderr
        assert done(*to, "--dry-run") == [request]
    assert [pdu.hex() for pdu in device.asked if pdu[0] == 21] == [request] * 4


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("fifo:1", "7"), "A queue can't be written"),
        (("file:4:7",), "Missing argument 'VALUE...'"),
        (("file:4:7", "65536"), "65536"),
        (("file:4:7", "x"), "'x' is not an integer"),
        (("file:4:7", *["1"] * 123), "count is 123, allowed: 1 to 122"),
        (("file:4:7", "1", "--type", "int16"), "can't be used with file:4:7"),
    ],
)
def test_what_cannot_be_written_to_a_file_is_wrong_usage(words: tuple[str, ...], told: str) -> None:
    assert told in usage_error("write", NOWHERE, *words)


@pytest.mark.parametrize("area", ["hr100", "hr100:7", "hr40001", "4hr", "hr.1", "hr²", "_", " "])
def test_an_address_without_a_colon_is_never_another_address(area: str) -> None:
    told = usage_error("write", NOWHERE, area, "1", "5", "--dry-run")
    assert told.startswith(f"Error: {area.partition(':')[0]!r} is not an area, allowed: coils, ")


@pytest.mark.parametrize(
    "area", ["hr", "HR", "holding_registers", "holding-registers", "Holding R"]
)
def test_an_area_can_be_written_with_blanks_and_hyphens(area: str) -> None:
    assert done("write", NOWHERE, area, "1", "5", "--dry-run") == ["0600010005"]


@pytest.mark.parametrize("code", [0x05, 0x0B])
def test_an_exception_that_leaves_it_open_whether_something_was_written(code: int) -> None:
    with FakeDevice(lambda pdu: exception(pdu, code)) as device:
        found = answer("write", device.url, "hr", "0", "1", code=1)
    assert (found["code"], found["maybe_written"]) == (code, True)


@pytest.mark.parametrize("code", [3, 4])
@pytest.mark.parametrize("refused", [0, 123])
def test_a_split_write_that_is_refused_says_what_is_written(refused: int, code: int) -> None:
    with FakeDevice(
        lambda pdu: exception(pdu, code) if int.from_bytes(pdu[1:3]) == refused else pdu[:5]
    ) as device:
        write = ("write", device.url, "hr", "0", *["1"] * 200, "--split")
        found = answer(*write, code=1)
        is_in_doubt = code == 4
        rest = f"holding_registers {refused} to 199 were possibly written"
        assert (f"hint: {rest}" in failure(*write)) == is_in_doubt
    assert (found["code"], found["written"], found["maybe_written"]) == (code, refused, is_in_doubt)
    assert ("the first 123 of 200 registers are written" in found["detail"]) == (refused > 0)


def test_without_a_connection_nothing_was_written() -> None:
    found = answer("write", f"tcp://127.0.0.1:{free_port()}", "hr", "0", "1", code=1)
    assert (found["reason"], found["maybe_written"]) == ("connection", False)
