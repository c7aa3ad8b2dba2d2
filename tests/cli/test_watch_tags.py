"""`holdfast watch` with several values: lines of changes, CSV, and the live view."""

from __future__ import annotations

import json
import re
import signal
from typing import TYPE_CHECKING, Any

import pytest
from rich.cells import cell_len

from holdfast.cli.tags.changes import TagTracker
from holdfast.cli.tags.view import TagView
from holdfast.client.tag_reading import Reading
from holdfast.errors import ModbusException, RequestTimeout
from holdfast.tags import Tag
from support import cli, wire
from support.cli import failure, invoke, usage_error
from support.commands import Command
from support.fake_device import FakeDevice, exception, registers
from support.terminal import Terminal, plain

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    import holdfast

LIST = """
tags:
  temperature_of_the_third_boiler_in_the_north:
    {area: holding_registers, address: 0, type: int16, scale: 0.1, unit: "°C"}
  state: {area: holding_registers, address: 1, states: {0: off, 1: running}}
  energy: {area: holding_registers, address: 2, type: uint64, unit: kWh}
"""


@pytest.fixture
def tags(tmp_path: Path) -> str:
    file = tmp_path / "boiler.yaml"
    file.write_text(LIST)
    return str(file)


class Watching:
    """`holdfast watch` without a terminal."""

    def __init__(self, *arguments: str) -> None:
        self.process = Command("watch", *arguments, "--every", "0.01")

    def __enter__(self) -> Watching:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.communicate()

    def line(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline().rstrip()

    def end(self, number: signal.Signals = signal.SIGINT) -> int:
        self.process.send_signal(number)
        self.process.communicate(timeout=wire.DEADLINE)
        return self.process.wait()


def test_every_change_of_a_tag_is_a_line(
    server: holdfast.Server, memory: holdfast.Memory, tags: str
) -> None:
    memory.write("holding_registers", 0, [215, 1])
    only = ("--only", "t*", "--only", "state")
    with Watching(cli.url(server), "--tags", tags, *only) as watching:
        name = "temperature_of_the_third_boiler_in_the_north"
        time, _, said = watching.line().partition("  ")
        assert re.fullmatch(r"\d\d:\d\d:\d\d\.\d\d\d", time)
        assert said == f"{name}: 21.5 °C"
        assert watching.line().endswith("  state: running (1)")
        memory.write("holding_registers", 0, [216])
        assert watching.line().endswith(f"  {name}: 21.5 -> 21.6 °C")
        memory.write("holding_registers", 1, [0])
        assert watching.line().endswith("  state: running (1) -> off (0)")
        assert watching.end(signal.SIGTERM) == 0


def test_changes_are_json_for_programs(server: holdfast.Server, memory: holdfast.Memory) -> None:
    with Watching(cli.url(server), "hr:0:int16", "coil:3", "--json") as watching:
        first = json.loads(watching.line())
        assert (first["ok"], first["name"], first["was"], first["now"]) == (True, "hr:0", None, 0)
        assert json.loads(watching.line())["name"] == "co:3"
        memory.write("coils", 3, [1])
        found = json.loads(watching.line())
        assert (found["name"], found["was"], found["now"]) == ("co:3", False, True)


def test_csv_has_a_line_for_every_reading(server: holdfast.Server, tmp_path: Path) -> None:
    record = tmp_path / "values.csv"
    often = ("--every", "0.01", "--times", "3")
    result = invoke(
        "watch", cli.url(server), "hr:0", "co:3", *often, "--csv", "--record", str(record)
    )
    assert result.exit_code == 0
    head, *rows = result.stdout.splitlines()
    assert head == "time,hr:0,co:3"
    assert [row.partition(",")[2] for row in rows] == ["0,false"] * 3
    assert record.read_text() == result.stdout


def test_an_error_is_one_line_and_watching_continues() -> None:
    def continues(timeout: float) -> bool:
        with (
            FakeDevice(registers) as device,
            Watching(device.url, "hr:0", "hr:9", "--timeout", str(timeout)) as watching,
        ):

            def said() -> list[str]:
                return [" ".join(watching.line().split()[1:]) for _ in range(2)]

            first = said()
            device.answer = lambda pdu: exception(pdu, 6) if pdu[2] == 9 else registers(pdu, 5)
            second = said()
            if any("no reply" in line for line in first + second):
                return False
            assert first == ["hr:0: 0", "hr:9: 0"]
            assert set(second) == {"hr:0: 0 -> 5", "hr:9: exception 06 (Server Device Busy)"}
            device.answer = lambda _: None
            if "hr:9: no reply" in (line := watching.line()):
                return False  # The device fell silent between the two reads.
            assert line.split()[1:3] == ["no", "reply"]
            device.answer = lambda pdu: registers(pdu, 5)
            assert set(said()) == {"hr:0: 5", "hr:9: 0 -> 5"}
            return True

    wire.until_long_enough(continues, "all but one read is answered")


def test_a_device_that_does_not_answer_can_not_be_watched() -> None:
    with FakeDevice(lambda _: None) as device:
        [line] = failure("watch", device.url, "hr:0", "--timeout", "0.02")
        assert line.startswith(f"holdfast: {device.url}, unit 1: no reply")


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("tcp://127.0.0.1", "hr:0", "--memory", "x"), "--memory requires FILE."),
        (("plant.yaml", "hr:0"), "AREA:ADDRESS and --tags require URL, not FILE."),
        (("plant.yaml", "--tags", "x.yaml"), "AREA:ADDRESS and --tags require URL, not FILE."),
        (("tcp://127.0.0.1", "hr", "0", "--csv"), "--csv requires --tags, or each value"),
        (("foo://127.0.0.1", "hr:0"), "is not the URL of a device"),
    ],
)
def test_wrong_usage_is_told(arguments: tuple[str, ...], told: str) -> None:
    assert told in usage_error("watch", *arguments)


@pytest.mark.parametrize("columns", [40, 100])
def test_the_live_view_shows_values_units_and_states(
    server: holdfast.Server, memory: holdfast.Memory, tags: str, columns: int
) -> None:
    memory.write("holding_registers", 0, [215, 1])
    arguments = ("watch", cli.url(server), "--tags", tags, "--every", "0.05")
    with Terminal(*arguments, lines=24, columns=columns) as terminal:
        terminal.until("21.5 °C", "running (1)", "0 kWh", "q quits")
        memory.write("holding_registers", 0, [216])
        terminal.until("21.6 °C")
        assert "\x1b[1;7;33m21.6" in terminal.shown
        terminal.keys("q")
        assert terminal.end() == 0
    lines = [line for frame in terminal.shown.split("\x1b[H") for line in plain(frame).splitlines()]
    assert max(map(cell_len, lines)) <= columns


def test_values_of_a_hung_device_are_dimmed_with_their_age(tags: str) -> None:
    with FakeDevice(lambda pdu: registers(pdu, 1)) as device:
        arguments = ("watch", device.url, "--tags", tags, "--every", "0.05", "--timeout", "0.5")
        with Terminal(*arguments) as terminal:
            terminal.until("running (1)", "q quits")
            device.answer = lambda _: None
            terminal.until("no reply", "error", "0 s old", "1 s old")
            assert "\x1b[2mrunning (1)" in terminal.shown
            device.answer = lambda pdu: registers(pdu, 0)
            terminal.until("off (0)")
            terminal.keys("q")
            assert terminal.end() == 0


class Source:
    """A source that has no device."""

    where = "nowhere"

    def __init__(self, tags: Sequence[Tag]) -> None:
        self.tags = tags


def shown(width: int, *readings: Reading) -> list[str]:
    """The lines of the live view after these readings."""
    source: Any = Source([each.tag for each in readings])
    return [line.plain.rstrip() for line in TagView(source, readings, 1).body(width)]


def tag(name: str, kind: str = "float64", **more: Any) -> Tag:
    return Tag(name, "holding_registers", 0, kind, **more)


@pytest.mark.parametrize("width", [20, 30, 40, 60, 120])
def test_no_line_is_too_long_and_no_number_is_cut(width: int) -> None:
    readings = [
        Reading(tag("a_name_that_is_quite_long_for_a_tag", unit="m³/h"), -1234.56789012345),
        Reading(tag("温度計の値段と名前", unit="°C"), 21.5),
        Reading(tag("energy", "uint64", unit="kWh"), 2**64 - 1),
        Reading(tag("text", "string:64"), "x" * 64),
        Reading(tag("refused"), error=ModbusException(2, "Illegal Data Address")),
    ]
    lines = shown(width, *readings)
    assert max(map(cell_len, lines)) <= width
    assert "-1234.56789012345" in " ".join(lines)
    if width > 20:
        assert "18446744073709551615" in " ".join(lines)
    assert width > 70 or any("…" in line for line in lines if "xxx" in line)


@pytest.mark.parametrize(
    ("width", "lines"),
    [
        (
            28,
            [
                "power",
                "  -8.637298209918441e-62 kWh",
                "count  18446744073709551615",
                "all    [12345,12346,-12347]",
                "state       running hot (1)",
            ],
        ),
        (
            24,
            [
                "power",
                "  -8.637298209918441e-62",
                "count",
                "  18446744073709551615",
                "all",
                "  [12345,12346,-12347]",
                "state",
                "  running hot (1)",
            ],
        ),
        (
            20,
            [
                "power",
                "  … kWh",
                "count",
                "18446744073709551615",
                "all",
                "[12345,12346,-12347]",
                "state",
                "  running hot (1)",
            ],
        ),
        (
            14,
            [
                "power",
                "  … kWh",
                "count",
                "  …",
                "all",
                "[12345,12346,…",
                "state",
                "running hot (…",
            ],
        ),
        (4, ["pow…", "  …", "cou…", "  …", "all", "  …", "sta…", "run…"]),
    ],
)
def test_without_room_a_number_is_left_out_not_cut(width: int, lines: list[str]) -> None:
    assert (
        shown(
            width,
            Reading(tag("power", unit="kWh"), -8.637298209918441e-62),
            Reading(tag("count", "uint64"), 2**64 - 1),
            Reading(tag("all", "int16[3]"), [12345, 12346, -12347]),
            Reading(tag("state", "uint16", states={1: "running hot"}), 1),
        )
        == lines
    )


def test_columns_are_aligned() -> None:
    refused = ModbusException(2, "Illegal Data Address")
    assert shown(
        60,
        Reading(tag("power", unit="W"), 5.0),
        Reading(tag("voltage", unit="V"), 230.1),
        Reading(tag("other"), error=refused),
        Reading(tag("none"), None),
    ) == [
        "power           5 W",
        "voltage     230.1 V",
        "other           -    exception 02 (Illegal Data Address)",
        "none     no value",
    ]


def test_a_value_keeps_its_age_while_it_can_not_be_read() -> None:
    it = tag("t")
    tracker = TagTracker([it])
    [first] = tracker.update(5, [Reading(it, 1.0)])
    assert (first.was, first.now) == (None, 1.0)
    assert tracker.update(6, [Reading(it, 1.0)]) == []
    error = RequestTimeout("no reply")
    [change] = tracker.update(7, [Reading(it, error=error)])
    assert change.error is error
    assert tracker.update(8, [Reading(it, error=RequestTimeout("no reply"))]) == []
    [tracked] = tracker.tracked
    assert (tracked.value, tracked.at, tracker.errors) == (1.0, 6, 2)
    [change] = tracker.update(9, [Reading(it, 1.0)])
    assert (change.now, change.error, tracker.error) == (1.0, None, None)
    assert tracker.age(tracked) is None
