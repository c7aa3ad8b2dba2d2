"""`holdfast read`, as people and programs use it."""

from __future__ import annotations

import itertools
import json
import signal
import struct
import time
from typing import TYPE_CHECKING

import pytest

from holdfast.cli import pace
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
        "address  decimal     hex               binary",
        "      7      215  0x00D7  0000 0000 1101 0111",
        "      8    65535  0xFFFF  1111 1111 1111 1111",
        "      9        0  0x0000  0000 0000 0000 0000",
    ]


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
        found = invoke("read", device.url, *place, "--timeout", "0.5")
    *_, last = found.stderr.splitlines(keepends=True)
    assert "longer than --timeout 0.5 s: use --timeout " in last, found.stderr


def test_without_late_replies_there_is_no_hint(server: holdfast.Server) -> None:
    assert invoke("read", cli.url(server), "hr:7", *REPEATED).stderr == ""


def test_bits_are_shown_sixteen_a_line(server: holdfast.Server, memory: holdfast.Memory) -> None:
    memory.write("coils", 3, [1, 0, 1])
    memory.write("coils", 20, [1])
    head, first, second = done("read", cli.url(server), "coils", "3", "18")
    assert head.split() == ["address", *(f"+{offset}" for offset in range(16))]
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
        "address  registers  float32",
        "100-101  41AC 0000  21.5",
        "102-103  3DCC CCCD  0.1",
    ]
    found = answer("read", cli.url(server), "hr", "100", "--type", "float32[2]")
    assert found["values"] == [21.5, struct.unpack(">f", struct.pack(">f", 0.1))[0]]
    assert (found["count"], found["registers"], found["type"]) == (4, list(floats), "float32")


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
        "      0  12A4       ? digits 0x12A4 are not bcd16, allowed: 0 to 9",
        "      1  1234       1234",
    ]
    found = answer("read", cli.url(server), "hr", "0", "2", "--type", "bcd16", code=1)
    assert found["values"] == [None, 1234]
    assert list(found["undecodable"]) == ["0"]


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
        ("0x0010", "coils", 9),
        ("000016", "coils", 15),
    ],
)
def test_a_modicon_number_names_area_and_address(
    server: holdfast.Server, number: str, area: str, address: int
) -> None:
    found = answer("read", cli.url(server), number, "--modicon")
    assert (found["area"], found["address"]) == (area, address)
    assert answer("read", cli.url(server), area, number, "1", "--modicon") == found


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (
            ("41", "--modicon"),
            "'41' is not a Modicon number, as in 40001, 400001 or 4x0001, and 0,",
        ),
        (("40000", "--modicon"), "'40000' is not a Modicon number"),
        (("465537", "--modicon"), "'465537' is not a Modicon number"),
        (("20001", "--modicon"), "'20001' is not a Modicon number"),
        (("coils", "40001", "--modicon"), "40001 is in holding_registers, not in coils."),
        (("40001",), "'40001' is not an area, allowed: coils, discrete_inputs, holding_registers"),
        (("40001",), "did you mean 40001 --modicon?"),
        (("hr", "4x0001"), "did you mean 4x0001 --modicon?"),
        (("hr", "400001"), "did you mean 400001 --modicon?"),
        (("hr", "65536"), "ADDRESS is '65536', allowed: 0 to 65535, decimal or 0x."),
        (("hr", "-1"), "No such option '-1'."),
        (("registers", "1"), "'registers' is not an area"),
        (("", "1"), "'' is not an area"),
        (("hr",), "Missing argument 'ADDRESS'."),
        ((), "Missing argument 'AREA ADDRESS [COUNT]', AREA:ADDRESS or --tags."),
        (("hr", "0", "0"), "COUNT is '0', allowed: 1 to 65536."),
        (("hr", "0", "x"), "COUNT is 'x', allowed: 1 to 65536."),
        (("hr", "0", "1", "2"), "Got unexpected extra argument (2)."),
        (("hr", "0", "1", "--count", "2"), "COUNT and --count are the same: give only one."),
        (("hr", "65535", "2"), "2 registers from address 65535: the last address is 65535."),
        (("hr", "0", "--order", "CDAB"), "--order and --encoding require --type."),
        (("hr", "0", "--type", "float33"), "type 'float33' is unknown"),
        (("hr", "0", "--type", "float32", "--order", "ABDC"), "order 'ABDC' is unknown"),
        (("co", "0", "--type", "float32"), "coils contain bits; the only type is bool."),
        (("hr", "0", "--times", "2"), "--times requires --every."),
        (
            ("hr", "0", "--every", "nan"),
            "'nan' is not a number of seconds, more than 0, up to 86400.",
        ),
        (
            ("hr", "0", "--timeout", "0"),
            "'0' is not a number of seconds, more than 0, up to 86400.",
        ),
        (("hr", "0", "--unit", "256"), "256 is not in the range 0<=x<=255."),
    ],
)
def test_wrong_usage_is_told(words: tuple[str, ...], told: str) -> None:
    assert told in usage_error("read", "tcp://127.0.0.1", *words)


def test_a_wrong_url_is_wrong_usage() -> None:
    assert "'plc' is not the URL of a device, allowed: tcp://host:502" in usage_error(
        "read", "plc", "hr", "0"
    )


def test_a_modicon_number_as_address_is_what_it_says_and_hinted_at(
    server: holdfast.Server,
) -> None:
    url = cli.url(server)
    assert failure("read", url, "hr", "40011") == [
        f"holdfast: {url}: exception 02 (Illegal Data Address)",
        "hint: addresses count from 0; as a Modicon number (--modicon) 40011 is 10",
    ]
    assert len(failure("read", url, "ir", "40011")) == 1


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
    for tick, taken in zip(pace.ticks(2.0, wait=wait), (0.5, 1.5, 4.5, 0, 2), strict=False):
        seen.append((tick, now))
        now += taken
    assert seen == [(0, 100), (1, 102), (2, 104), (3, 110), (4, 112)]


def test_a_signal_ends_repeated_readings(server: holdfast.Server) -> None:
    process = Command("read", cli.url(server), "hr", "0", "--every", "0.01")
    try:
        assert process.stdout is not None
        assert process.stdout.readline().split() == ["time", "0"]
        assert process.stdout.readline()
        process.send_signal(signal.SIGINT)
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
