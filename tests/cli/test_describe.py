"""`holdfast describe`, as people and programs use it."""

from __future__ import annotations

import json
import re
import signal
import struct
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import pytest

import holdfast
from holdfast import values
from holdfast.cli.devices.describe_output import described_lines
from holdfast.config.tag_files.read import load_tags
from holdfast.discovery import device_search, segments
from holdfast.discovery.address_search import Survey
from holdfast.discovery.described_tag import DescribedTag
from holdfast.discovery.description import Description
from holdfast.tags import Tag
from support import cli, sunspec_device, wire
from support.cli import answer, done, usage_error
from support.commands import Command
from support.fake_device import FakeDevice, Stream, exception, registers, silent, whole_floats
from support.terminal import Terminal, plain

if TYPE_CHECKING:
    from support.fake_device import Asked
    from support.running import Serve

QUICK = ("--times", "1", "--areas", "hr,co")


@pytest.fixture
def plant(serve: Serve) -> str:
    memory = holdfast.Memory(coils=20, holding_registers=(100, 12))
    volts = [each for v in (230.1, 231.4) for each in values.encode(v, "float32", "CDAB")]
    memory.write("holding_registers", 100, [*volts, 455, 65481])
    inverter = holdfast.Memory(holding_registers=(40000, 130))
    content = sunspec_device.registers(sunspec_device.common(), sunspec_device.inverter())
    inverter.write("holding_registers", 40000, content)
    return cli.url(serve({1: memory, 4: inverter}))


def test_a_device_is_a_table_and_a_file_that_is_read_again(plant: str, tmp_path: Path) -> None:
    file = tmp_path / "device.yaml"
    lines = done("describe", plant, "--units", "1", *QUICK, "--output", str(file))
    assert lines[:2] == [
        "Unit 1 answers.",
        f"{plant}: unit ids that answer: 1; not asked: all others",
    ]
    assert [line.split() for line in lines[5:8]] == [
        ["area", "first", "last", "count"],
        ["holding_registers", "100", "111", "12"],
        ["coils", "0", "19", "20"],
    ]
    rows = [re.split(r" {2,}", line) for line in lines]
    assert ["co_0 … co_19", "coils", "0-19", "bool[20]", "0000000000000000…", "1.00"] in rows
    place = ["hr_100", "holding_registers", "100-101", "float32", "CDAB"]
    assert place in [row[:5] for row in rows]
    assert "Byte order: probably CDAB" in lines[9]
    assert any(line.startswith("Nothing is known about addresses") for line in lines)
    assert lines[-1] == f"Written: {file}"
    tags = load_tags(file)
    assert (tags["hr_100"].type, tags["hr_100"].order) == ("float32", "CDAB")
    assert tags["hr_105"].type == "int16"
    assert "confidence" in tags["hr_100"].description


def test_every_unit_id_has_a_file(plant: str, tmp_path: Path) -> None:
    file = tmp_path / "device.csv"
    found = answer("describe", plant, "--units", "1-4", *QUICK, "--output", str(file))
    assert (found["answering"], found["silent"], found["ok"]) == ([1, 4], [2, 3], True)
    assert found["files"] == [str(tmp_path / f"device-unit{unit}.csv") for unit in (1, 4)]
    assert found["not_described"] == []
    first, second = found["units"]
    assert first["sunspec"] is None
    models = second["sunspec"]["models"]
    assert [(model["id"], model["without_value"]) for model in models] == [(1, 1), (103, 13)]
    assert second["areas"]["holding_registers"]["exist"] == 130
    current = next(tag for tag in second["tags"] if tag["name"] == "inverter_three_phase_A")
    assert (current["values"], current["confidence"]) == ([215], 1.0)
    factor = "inverter_three_phase_A_SF"
    assert current["scale"] == {"from": factor, "as": "exponent"}
    assert [each["values"] for each in second["tags"] if each["name"] == factor] == [[-1]]
    again = ("describe", plant, "--units", "1-4", *QUICK, "--output", str(file))
    edited = tmp_path / "device-unit1.csv"
    edited.write_text("by hand")
    refused = answer(*again, code=1)
    detail = f"{edited} exists; --force replaces it"
    assert (refused["reason"], refused["detail"], refused["files"]) == ("file", detail, [])
    assert edited.read_text() == "by hand"
    assert answer(*again, "--force")["files"] == found["files"]
    tags = load_tags(tmp_path / "device-unit4.csv")
    assert tags["inverter_three_phase_A"].with_scale(-1).scale == 0.1


def test_nothing_is_written_to_the_device() -> None:
    def answers(pdu: bytes) -> bytes:
        if pdu[0] not in (3, 4, 1, 2):
            return exception(pdu, 1)
        first, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
        return registers(pdu) if pdu[0] == 3 and first + count <= 9 else exception(pdu, 2)

    with FakeDevice(answers) as device:
        assert cli.invoke("describe", device.url, "--units", "1", "--times", "1").exit_code == 0
        assert {pdu[0] for pdu in device.asked} == {1, 2, 3, 4, 17, 43}


@pytest.mark.parametrize("code", [2, 3])
def test_a_meter_that_only_gives_whole_values_is_described(code: int) -> None:
    with FakeDevice(whole_floats(code)) as device:
        options = ("--units", "1", "--areas", "ir", "--range", "0-399", "--times", "1")
        found = answer("describe", device.url, *options)
    [unit] = found["units"]
    assert unit["areas"]["input_registers"]["exist"] == 300
    assert unit["tags"][0]["type"] == "float32"


def test_failures_are_printed_and_counted() -> None:
    def answers(pdu: bytes) -> bytes:
        first, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
        if pdu[0] == 3:
            return exception(pdu, 4 if first <= 5 < first + count else 2)
        return exception(pdu, 1)

    with FakeDevice(answers) as device:
        options = ("--units", "1", "--areas", "hr,ir", "--range", "0-9", "--exact")
        shown = done("describe", device.url, *options)
        areas = answer("describe", device.url, *options)["units"][0]["areas"]
    assert [line.split() for line in shown if "_registers " in line] == [
        ["holding_registers", "yes", "0", "9", "1", "0"],
        ["input_registers", "skipped", "0", "0", "1", "9"],
    ]
    assert shown[-2:] == [
        "holding_registers: exception 04 (Server Device Failure) at 5",
        "input_registers: exception 01 (Illegal Function); area skipped",
    ]
    [failed] = areas["holding_registers"]["failures"]
    assert (failed["code"], failed["ranges"]) == (4, [[5, 5]])
    assert areas["input_registers"]["given_up"]["code"] == 1


def test_what_can_not_be_read_again_is_a_failure() -> None:
    def answers(pdu: bytes) -> bytes:
        first, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
        if pdu[0] != 3 or first + count > 1:
            return exception(pdu, 1)
        reads.append(pdu)  # Whether the unit id answers, the search, and the reading after it.
        return registers(pdu) if len(reads) < 3 else exception(pdu, 4)

    reads: list[bytes] = []
    with FakeDevice(answers) as device:
        options = ("--units", "1", "--areas", "hr", "--range", "0-0", "--times", "1")
        found = answer("describe", device.url, *options, code=1)
    assert (found["ok"], found["reason"]) == (False, "exception")
    [unit] = found["units"]
    assert not unit["complete"]
    assert unit["not_described"] == [{"area": "holding_registers", "address": 0, "count": 1}]


def test_a_device_that_ignores_unit_ids_is_described_once() -> None:
    def answers(pdu: bytes) -> bytes:
        first, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
        return registers(pdu) if pdu[0] == 3 and first + count <= 9 else exception(pdu, 2)

    with FakeDevice(answers) as device:
        found = answer("describe", device.url, "--units", "1-3", *QUICK)
    assert (found["ignores_unit"], found["alike"]) == (True, [1, 2, 3])
    assert [each["unit"] for each in found["units"]] == [1]


@pytest.mark.parametrize(
    ("others", "alike", "described"), [("refused", [2, 4], [1, 3]), ("same", [2, 3, 4], [1, 2])]
)
def test_unit_ids_that_answer_otherwise_than_a_rare_one_are_devices(
    others: str, alike: list[int], described: list[int]
) -> None:
    """Behind a gateway that refuses other unit ids with an exception, or answers them itself."""

    def behave(asked: Asked) -> None:
        if asked.pdu[0] == 17 and asked.unit == 1:
            asked.answer(bytes([17, 5]) + b"METER")
        elif asked.pdu[0] != 3 or (others == "refused" and asked.unit not in (1, 3)):
            asked.answer(exception(asked.pdu, 4))
        else:
            asked.answer(registers(asked.pdu))

    options = ("--areas", "hr", "--range", "0-8", "--times", "1")
    with Stream("tcp", then=behave) as gateway:
        found = answer("describe", gateway.url, "--units", "1-4", *options)
        told = done("find", gateway.url, "--units", "1-4")[-1]
    assert (found["ignores_unit"], found["alike"]) == (False, alike)
    assert [each["unit"] for each in found["units"]] == described
    assert told.endswith("answer as 231 does: probably no devices of their own.")


def sunspec_from_0(pdu: bytes) -> bytes:
    content = sunspec_device.registers(sunspec_device.common(), sunspec_device.inverter())
    first, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
    if pdu[0] != 3:
        return exception(pdu, 1)
    if first + count > len(content):
        return exception(pdu, 2)
    return bytes([3, 2 * count]) + struct.pack(f">{count}H", *content[first : first + count])


def test_points_without_a_value_are_counted() -> None:
    with FakeDevice(sunspec_from_0) as device:
        shown = done("describe", device.url, "--units", "1", *QUICK, "--range", "0-200")
    [told] = [line for line in shown if line.startswith("Points without a value")]
    assert "of model 103. Describe the device while it works." in told


def test_range_quantity_and_delay_are_those_of_every_request(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    waits: list[float] = []
    monkeypatch.setattr(device_search, "pause", waits.append)
    monkeypatch.setattr(time, "sleep", waits.append)
    options = ("--range", "0-79", "--max-quantity", "10", "--delay", "300ms")
    with FakeDevice(sunspec_from_0) as device:
        found = answer("describe", device.url, "--units", "1", *QUICK, *options)
    assert waits == [0.3] * (len(device.asked) - 1)
    reads = [(pdu[1:3], pdu[3:5]) for pdu in device.asked if pdu[0] == 3]
    assert max(int.from_bytes(first) + int.from_bytes(count) for first, count in reads) == 80
    assert max(int.from_bytes(count) for _, count in reads) == 10
    [unit] = found["units"]
    assert [each["id"] for each in unit["sunspec"]["models"]] == [1]
    ends = {each["name"]: each["address"] for each in unit["tags"]}
    assert ends["common_Mn_1"] == 4
    assert max(ends.values()) < 80


@pytest.mark.parametrize(("limit", "models"), [(1, []), (5, [1]), (40, [1, 103])])
def test_every_request_to_a_unit_id_counts(limit: int, models: list[int]) -> None:
    options = ("--units", "1", *QUICK, "--max-requests", str(limit))
    with FakeDevice(sunspec_from_0) as device:
        found = answer("describe", device.url, *options, code=1)
    asking = 3  # Whether the unit id answers, and who it is.
    assert len(device.asked) == asking + limit
    assert found["detail"] == f"stopped after {limit} requests; --max-requests sets the limit"
    sunspec = found["units"][0]["sunspec"]
    assert [each["id"] for each in (sunspec or {"models": []})["models"]] == models


def test_readings_after_the_search_count_towards_the_limit() -> None:
    with FakeDevice(small) as device:
        options = ("--units", "1", "--areas", "hr", "--range", "0-0", "--every", "0.01")
        found = answer("describe", device.url, *options, "--max-requests", "3", code=1)
    assert len([pdu for pdu in device.asked if pdu[0] == 3]) == 1 + 3
    assert [each["name"] for each in found["units"][0]["tags"]] == ["hr_0"]


def test_invalid_replies_are_told_apart_from_silence() -> None:
    with Stream("tcp", then=lambda asked: asked.answer(unit=9)) as device:
        options = ("--units", "1-2", "--timeout", "0.2")
        found = answer("describe", device.url, *options, code=1)
        told = cli.invoke("describe", device.url, *options).stdout
    assert (found["silent"], found["garbled"]) == ([], [1, 2])
    assert "invalid replies: 1-2; not asked" in told


def test_a_silent_device_is_a_failure() -> None:
    def is_hinted(timeout: float) -> bool:
        with Stream("tcp", then=silent) as device:
            options = ("--units", "1-2", "--timeout", str(timeout))
            found = answer("describe", device.url, *options, code=1)
            told, *hints = cli.invoke("describe", device.url, *options).stderr.splitlines()
        assert (found["detail"], found["silent"]) == ("no unit id answered", [1, 2])
        assert told == f"holdfast: {device.url}: no unit id answered"
        return f"'{device.url}?pause_after_connect=2'" in "".join(hints)

    wire.until_long_enough(is_hinted, "the device accepts connections")


def test_the_description_so_far_is_written_when_it_is_interrupted(tmp_path: Path) -> None:
    reached = threading.Event()

    def answers(pdu: bytes) -> bytes | None:
        first, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
        if pdu[0] == 3 and first == 450:
            reached.set()
            return None
        return registers(pdu, 455) if pdu[0] == 3 and first + count <= 9 else exception(pdu, 2)

    file = tmp_path / "device.yaml"
    with FakeDevice(answers) as device:
        options = ("--units", "1", "--areas", "hr", "--timeout", "60", "--output", str(file))
        with Terminal("describe", device.url, *options) as terminal:
            assert reached.wait(wire.DEADLINE)
            terminal.process.send_signal(signal.SIGINT)
            assert terminal.end() == 1
    shown = plain(terminal.shown)
    assert re.search(r"holding_registers +to 449 +9", shown)
    assert (
        "Incomplete. Not searched: holding_registers from 450 on (only usual starts there)."
        in shown
    )
    assert f"holdfast: {device.url}: interrupted" in shown
    assert len(load_tags(file)) == 9


def test_a_signal_ends_the_inference(monkeypatch: pytest.MonkeyPatch) -> None:
    def divide(*_args: Any, **_options: Any) -> NoReturn:
        signal.raise_signal(signal.SIGTERM)
        raise AssertionError("the signal was lost")

    monkeypatch.setattr(segments, "divide", divide)
    options = ("--units", "1", "--range", "0-99", "--areas", "hr")
    with FakeDevice(small) as device:
        result = cli.invoke("describe", device.url, *options)
        found = answer("describe", device.url, *options, code=1)
    assert result.exit_code == 1
    assert "Incomplete. Not described: holding_registers 0-8." in result.stdout
    assert result.stderr == f"holdfast: {device.url}: interrupted\n"
    assert (found["ok"], found["detail"]) == (False, "interrupted")
    [unit] = found["units"]
    left = [{"area": "holding_registers", "address": 0, "count": 9}]
    assert (unit["complete"], unit["not_described"]) == (False, left)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--output", "device.txt"), "'device.txt' ends with none of .yaml, .yml, .csv."),
        (("--output", "/nowhere/device.yaml"), "the folder of '/nowhere/device.yaml' does not"),
        (("--units", "x"), "'x' is not a unit id or FIRST-LAST"),
    ],
)
def test_wrong_usage_is_told(options: tuple[str, ...], told: str) -> None:
    assert told in usage_error("describe", "tcp://127.0.0.1:1", *options)


@pytest.mark.parametrize(
    ("kind", "order", "shown"),
    [
        ("uint16", "ABCD", []),
        ("uint16", "CDAB", []),
        ("uint16", "DCBA", ["DCBA"]),
        ("int16", "BADC", ["BADC"]),
        ("uint32", "ABCD", ["ABCD"]),
    ],
)
def test_an_order_is_shown_where_it_has_an_effect(kind: str, order: str, shown: list[str]) -> None:
    found = Description(1, Survey(["holding_registers"]))
    tag = Tag("it", "holding_registers", 7, kind, order)
    found.tags = [DescribedTag(tag, 0.9, (5,), ())]
    [row] = [line.split() for line in described_lines(found, None) if line.startswith("it")]
    assert row[3:] == [kind, *shown, "5", "0.90"]


def test_a_file_is_not_replaced_without_force(plant: str, tmp_path: Path) -> None:
    file = tmp_path / "device.yaml"
    file.write_text("mine")
    options = ("--units", "1", *QUICK, "--output", str(file))
    assert f"{file} exists; --force replaces it." in usage_error("describe", plant, *options)
    assert file.read_text() == "mine"
    assert cli.invoke("describe", plant, *options, "--force").exit_code == 0
    assert len(load_tags(file)) > 20


def test_a_tag_list_that_is_too_long_is_told(
    plant: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("holdfast.cli.devices.describe.MAX_BYTES", 100)
    file = tmp_path / "device.yaml"
    result = cli.invoke("describe", plant, "--units", "1", *QUICK, "--output", str(file))
    assert result.exit_code == 1
    assert f"{file} has {file.stat().st_size} bytes, and other commands read" in result.stderr


def small(pdu: bytes) -> bytes:
    """The answer of a device with 9 holding registers."""
    first, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
    return registers(pdu, 455) if pdu[0] == 3 and first + count <= 9 else exception(pdu, 2)


def test_findings_are_printed_before_the_search_ends() -> None:
    reached, go_on = threading.Event(), threading.Event()

    def answers(pdu: bytes) -> bytes:
        if pdu[0] == 3 and int.from_bytes(pdu[1:3]) == 100:
            reached.set()
            go_on.wait(wire.DEADLINE)
        return small(pdu)

    with FakeDevice(answers) as device:
        process = Command("describe", device.url, "--units", "1", "--range", "0-199", "--json")
        assert reached.wait(wire.DEADLINE)
        early = cli.early_lines(process, 5)
        go_on.set()
        output, _ = process.communicate(wire.DEADLINE)
    assert cli.elements(early[3:]) == [
        {"unit": 1, "identification": {}},
        {"unit": 1, "area": "holding_registers", "address": 0, "count": 9},
    ]
    assert json.loads("".join(early) + output)["ok"] is True


def test_a_unit_id_is_written_before_the_next_one_is_searched(tmp_path: Path) -> None:
    reached = threading.Event()

    def behave(asked: Asked) -> None:
        if asked.unit == 7 and asked.pdu[0] == 3 and int.from_bytes(asked.pdu[1:3]) == 100:
            reached.set()
        elif asked.unit in (5, 7, 9):
            asked.answer(small(asked.pdu))
        else:
            asked.answer(exception(asked.pdu, 0x0B))

    file = tmp_path / "device.yaml"
    with Stream("tcp", then=behave) as device:
        options = ("--units", "5-9", *QUICK, "--range", "0-199", "--output", str(file))
        process = Command("describe", device.url, *options, "--json")
        assert reached.wait(wire.DEADLINE)
        assert len(load_tags(tmp_path / "device-unit5.yaml")) == 9
        process.send_signal(signal.SIGTERM)
        output, _ = process.communicate(wire.DEADLINE)
    found = json.loads(output)
    assert process.returncode == 1
    assert (found["ok"], found["detail"]) == (False, "interrupted")
    assert (found["answering"], found["not_described"]) == ([5, 7, 9], [9])
    assert found["files"] == [str(tmp_path / f"device-unit{unit}.yaml") for unit in (5, 7)]
    assert [each["complete"] for each in found["units"]] == [True, False]
    assert found["units"][1]["areas"]["holding_registers"]["not_searched_from"] == 0


def test_a_device_that_goes_away_leaves_what_was_found(tmp_path: Path) -> None:
    reads, again = [0], threading.Event()

    def answers(pdu: bytes) -> bytes:
        if pdu[0] == 3 and pdu[1:5] == bytes([0, 0, 0, 4]):
            reads[0] += 1
            if reads[0] > 5:
                again.set()
        return small(pdu)

    file = tmp_path / "device.yaml"
    options = ("--units", "1", "--areas", "hr", "--range", "0-99", "--max-quantity", "4")
    with FakeDevice(answers) as device:
        process = Command(
            *("describe", device.url, *options, "--output", str(file)),
            *("--times", "100", "--every", "0.01", "--timeout", "5"),
        )
        assert again.wait(wire.DEADLINE)
    output, log = process.communicate(wire.DEADLINE)
    assert process.returncode == 1
    assert log.startswith(f"holdfast: {device.url}: ")
    assert re.search(r"^holding_registers +0 +8 +9$", output, re.M)
    assert len(load_tags(file)) == 9


def test_a_file_that_can_not_be_replaced_stays_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    file = tmp_path / "device.yaml"
    file.write_text("mine")
    monkeypatch.setattr(Path, "replace", fail)
    options = ("--units", "1", *QUICK, "--range", "0-99", "--output", str(file), "--force")
    with FakeDevice(small) as device:
        result = cli.invoke("describe", device.url, *options)
    problem = f"{file} can't be written: No space left on device"
    assert (result.exit_code, result.stderr) == (1, f"holdfast: {device.url}: {problem}\n")
    assert re.search(r"^hr_8 +holding_registers", result.stdout, re.M)
    assert re.search(r"^holding_registers +0 +8 +9$", result.stdout, re.M)
    assert file.read_text() == "mine"
    assert list(tmp_path.iterdir()) == [file]
    monkeypatch.undo()
    file.write_text("order: " + result.stdout.partition("\n\norder: ")[2])
    assert len(load_tags(file)) == 9


@pytest.mark.parametrize("name", ["folder.yaml", f"{'a' * 300}.yaml"], ids=len)
def test_a_file_that_can_not_be_written_is_told_before_the_first_request(
    name: str, tmp_path: Path
) -> None:
    (tmp_path / "folder.yaml").mkdir()
    with FakeDevice(small) as device:
        error = usage_error("describe", device.url, "--output", str(tmp_path / name), "--force")
        assert not device.asked
    assert f"{name} is a folder." in error or f"{name} can't be written: " in error
