"""`holdfast describe map`, as people and programs use it."""

from __future__ import annotations

import json
import re
import signal
import threading
import time
from typing import TYPE_CHECKING

import pytest

import holdfast
from holdfast.discovery.address_search import USUAL_STARTS
from holdfast.types import AREAS
from support import cli, wire
from support.cli import answer, done, failure, invoke, usage_error
from support.commands import Command
from support.fake_device import HANG_UP, FakeDevice, exception, registers, whole_floats
from support.paths import DOCS
from support.terminal import Terminal, plain

if TYPE_CHECKING:
    from support.fake_device import Answer
    from support.running import Serve


@pytest.fixture
def url(serve: Serve) -> str:
    memory = holdfast.Memory(coils=64, holding_registers=(1000, 16384), input_registers=(65000, 10))
    return cli.url(serve({1: memory}))


def split(lines: list[str]) -> tuple[list[str], list[str]]:
    """The table of the ranges, and the lines behind it."""
    end = lines.index("")
    return lines[:end], lines[end + 1 :]


def test_ranges_are_a_picture_and_a_table(url: str) -> None:
    ranges, [head, empty, *lines] = split(done("describe", "map", url))
    assert [line.split() for line in ranges] == [
        ["area", "first", "last", "count"],
        ["holding_registers", "1000", "17383", "16384"],
        ["input_registers", "65000", "65009", "10"],
        ["coils", "0", "63", "64"],
    ]
    assert empty == ""
    assert re.fullmatch(
        rf"{url}, unit 1: 16458 addresses; samples read, \d+ requests in \d+\.\d s", head
    )
    coils, inputs, holding, registers, scale, empty, *table = lines
    assert empty == ""
    assert re.fullmatch(r"coils +▁·{59}", coils)
    assert re.fullmatch(r"discrete inputs +·{60}", inputs)
    assert re.fullmatch(r"holding registers +[▁-▇]█{14}[▁-▇]·{44}", holding)
    assert re.fullmatch(r"input registers +·{59}▁", registers)
    assert scale.split() == ["0", "16384", "32768", "49152", "65535"]
    rows = [line.split() for line in table[:5]]
    assert rows[0] == ["area", "searched", "exist", "absent", "failed", "not", "asked"]
    for area, searched, *counts in rows[1:]:
        assert (area in AREAS, searched) == (True, "yes")
        assert sum(map(int, counts)) == 65536
    assert table[6] == (
        "Nothing is known about addresses that were not asked: a range without a sample is missed."
    )


def test_a_program_gets_the_same(url: str) -> None:
    found = answer("describe", "map", url)
    assert (found["ok"], found["exact"]) == (True, False)
    assert {area: each["ranges"] for area, each in found["areas"].items()} == {
        "coils": [[0, 63]],
        "discrete_inputs": [],
        "holding_registers": [[1000, 17383]],
        "input_registers": [[65000, 65009]],
    }
    assert found["found"] == [
        {"area": "holding_registers", "address": 1000, "count": 16384},
        {"area": "input_registers", "address": 65000, "count": 10},
        {"area": "coils", "address": 0, "count": 64},
    ]
    assert {each["not_searched_from"] for each in found["areas"].values()} == {None}
    assert found["requests"] == sum(each["requests"] for each in found["areas"].values())
    assert found["areas"]["holding_registers"]["largest_read"] == 125


def test_exact_finds_what_samples_miss() -> None:
    def hidden(pdu: bytes) -> bytes:
        address, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
        inside = address >= 1012 and address + count <= 1015
        return registers(pdu) if inside else exception(pdu, 2)

    with FakeDevice(hidden) as device:
        options = ("--areas", "hr", "--range", "900-1099")
        fast = answer("describe", "map", device.url, *options)["areas"]["holding_registers"]
        exact = answer("describe", "map", device.url, *options, "--exact")["areas"][
            "holding_registers"
        ]
    assert (fast["ranges"], exact["ranges"]) == ([], [[1012, 1014]])
    assert (fast["absent"][0], fast["absent"][-1]) == ([900, 901], [1099, 1099])
    assert fast["not_asked"] == 200 - sum(last - first + 1 for first, last in fast["absent"])
    assert (exact["absent"], exact["not_asked"]) == ([[900, 1011], [1015, 1099]], 0)
    assert fast["requests"] < 100 < exact["requests"] < 220


def test_sparse_reads_fewer_samples_and_says_how_far_they_are_apart() -> None:
    with FakeDevice(lambda pdu: exception(pdu, 2)) as device:
        options = ("--areas", "hr", "--range", "0-999", "--sparse")
        found = answer("describe", "map", device.url, *options)
        shown = invoke("describe", "map", device.url, *options).stdout
        usage_error("describe", "map", device.url, "--sparse", "--exact")
    # Multiples of 50 and of 256 below 1000, and 1, 10, 20 and 999.
    assert found["areas"]["holding_registers"]["not_asked"] == 1000 - (20 + 3 + 4)
    assert "Samples are 50 apart below 10000, 256 above." in shown


def test_reads_stay_within_what_is_allowed() -> None:
    with FakeDevice(registers) as device:
        options = ("--areas", "ir,hr", "--range", "0x10-99", "--max-quantity", "7")
        found = answer("describe", "map", device.url, *options)
        asked = [
            (pdu[0], int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])) for pdu in device.asked
        ]
    assert [area["ranges"] for area in found["areas"].values()] == [[[16, 99]]] * 2
    assert list(found["areas"]) == ["holding_registers", "input_registers"]
    assert max(count for _, _, count in asked) == 7
    assert (min(at for _, at, _ in asked), max(at + n for _, at, n in asked)) == (16, 100)


def test_failures_are_told_apart() -> None:
    def answers(pdu: bytes) -> bytes | None:
        address, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
        if pdu[0] != 3:
            return exception(pdu, 1)
        if address <= 5 < address + count:
            return exception(pdu, 4)
        return registers(pdu) if address + count <= 9 else exception(pdu, 2)

    with FakeDevice(answers) as device:
        lines = done("describe", "map", device.url, "--exact", "--range", "0-15")
        areas = answer("describe", "map", device.url, "--exact", "--range", "0-15")["areas"]
    assert "holding registers  █████!███·······" in lines
    assert lines[-4:] == [
        "coils: exception 01 (Illegal Function); area skipped",
        "discrete_inputs: exception 01 (Illegal Function); area skipped",
        "holding_registers: exception 04 (Server Device Failure) at 5",
        "input_registers: exception 01 (Illegal Function); area skipped",
    ]
    assert areas["coils"]["given_up"]["code"] == 1
    [failed] = areas["holding_registers"]["failures"]
    assert (failed["reason"], failed["code"], failed["ranges"]) == ("exception", 4, [[5, 5]])


def test_values_that_can_not_be_read_in_part_are_found() -> None:
    with FakeDevice(whole_floats(2)) as device:
        options = ("--areas", "ir", "--exact", "--range", "0-399")
        lines = done("describe", "map", device.url, *options)
    assert lines[1].split() == ["input_registers", "0", "299", "300"]


def test_a_gateway_without_the_device_is_hinted_at_once() -> None:
    with FakeDevice(lambda pdu: exception(pdu, 11)) as device:
        result = invoke("describe", "map", device.url, "--areas", "hr,ir", "--range", "0-9")
        hint = f"hint: 'holdfast find {device.url}' finds the unit ids that answer"
        assert result.stderr.splitlines() == [hint]


def test_a_device_without_addresses_is_no_failure() -> None:
    with FakeDevice(lambda pdu: exception(pdu, 2)) as device:
        assert "No address was found." in done("describe", "map", device.url, "--range", "0-99")


def test_a_device_that_does_not_answer_is_a_failure() -> None:
    with FakeDevice(lambda _: None) as device:
        assert failure("describe", "map", device.url, "--timeout", "0.02") == [
            f"holdfast: {device.url}: no answer to 4 reads"
        ]
        found = answer("describe", "map", device.url, "--timeout", "0.02", code=1)
    assert (found["ok"], found["detail"]) == (False, "no answer to 4 reads")


def test_only_ascii_is_shown_where_there_is_no_more(url: str) -> None:
    with Terminal(
        "describe", "map", url, "--areas", "hr", columns=80, PYTHONIOENCODING="ascii"
    ) as terminal:
        assert re.search(r"holding registers  -#{14}-\.{44}\n", terminal.until("searched"))


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("--areas", "hr,x"), "'x' is not an area"),
        (("--range", "5-4"), "'5-4' is not FIRST-LAST, as in 0-999, up to 65535."),
        (("--range", "0-65536"), "'0-65536' is not FIRST-LAST"),
        (("--range", "-4"), "'-4' is not FIRST-LAST"),
        (("--max-quantity", "0"), "found 0, allowed: 1 or more."),
    ],
)
def test_wrong_usage_is_told(arguments: tuple[str, ...], told: str) -> None:
    assert told in usage_error("describe", "map", "tcp://127.0.0.1:1", *arguments)


def test_the_requests_are_announced_and_the_progress_fits_a_narrow_terminal(url: str) -> None:
    with Terminal("describe", "map", url, columns=40) as terminal:
        shown = terminal.until("Nothing is known")
        assert terminal.end() == 0
    assert re.search(r"At least \d{4} requests if nothing exists, at most 20000\.", shown)
    bars = [line for line in re.split("[\r\n]", terminal.shown) if "Mapping" in line]
    assert bars
    assert all(len(plain(line)) <= 40 for line in bars)


def test_progress_is_shown_on_a_terminal_and_the_picture_has_its_width(url: str) -> None:
    with Terminal("describe", "map", url, columns=60) as terminal:
        terminal.until("Mapping", "input_registers")
        assert terminal.end() == 0
    shown = plain(terminal.shown)
    assert "100%" in shown
    assert re.search(r"\d+ requests", shown)
    assert re.search(r"^discrete inputs +·{40}$", shown, re.M)


def test_addresses_below_a_narrow_picture_are_apart(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "32")
    shown = done("describe", "map", url, "--areas", "hr", "--range", "0-999")
    assert ["0", "250", "750"] in [line.split() for line in shown]


def test_what_was_found_is_shown_when_it_is_interrupted() -> None:
    reached, go_on = threading.Event(), threading.Event()

    def answers(pdu: bytes) -> bytes:
        if int.from_bytes(pdu[1:3]) >= 500:
            reached.set()
            go_on.wait(wire.DEADLINE)
        return registers(pdu)

    with FakeDevice(answers) as device:
        options = ("--areas", "hr", "--exact", "--timeout", "60")
        with Terminal("describe", "map", device.url, *options) as terminal:
            assert reached.wait(wire.DEADLINE)
            terminal.process.send_signal(signal.SIGINT)
            go_on.set()
            assert terminal.end() == 1
    shown = plain(terminal.shown)
    assert re.search(r"holding_registers +0 +\d+", shown)
    assert f"holdfast: {device.url}: interrupted" in shown
    assert "every address read" not in shown
    assert re.search(r"^holding_registers +0 +(\d+) +\d+$", shown, re.M)
    assert (
        "Incomplete. Not searched: holding_registers from 0 on (only some usual starts there)."
        in shown
    )
    [(exist, unknown)] = re.findall(r"^holding_registers +starts +(\d+) +0 +0 +(\d+)$", shown, re.M)
    assert int(exist) + int(unknown) == 65536


def test_a_search_ends_after_its_requests_and_says_what_was_not_asked() -> None:
    def answers(pdu: bytes) -> bytes:
        address, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
        return registers(pdu) if address + count <= 5 else exception(pdu, 2)

    with FakeDevice(answers) as device:
        options = ("--areas", "hr,ir", "--max-requests", "30")
        found = answer("describe", "map", device.url, *options, code=1)
        result = cli.invoke("describe", "map", device.url, *options)
    assert (found["ok"], found["complete"], found["requests"]) == (False, False, 30)
    assert found["detail"] == "stopped after 30 requests; --max-requests sets the limit"
    holding, inputs = found["areas"].values()
    assert (holding["state"], holding["ranges"]) == ("partly", [[0, 4]])
    assert holding["not_asked"] == 65536 - 5 - sum(b - a + 1 for a, b in holding["absent"])
    assert (inputs["state"], inputs["searched_to"], inputs["not_searched_from"]) == (
        "partly",
        None,
        0,
    )
    assert result.exit_code == 1
    assert "incomplete, 30 requests" in result.stdout
    assert re.search(r"^input_registers +starts +5 +\d+ +0 +\d+$", result.stdout, re.M)


def test_requests_can_be_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    pauses: list[float] = []
    monkeypatch.setattr(time, "sleep", pauses.append)
    with FakeDevice(lambda pdu: exception(pdu, 2)) as device:
        options = ("--areas", "co", "--range", "0-9", "--exact", "--delay", "0.25")
        assert answer("describe", "map", device.url, *options)["requests"] == 10
    assert pauses == [0.25] * 9


def test_short_ranges_at_usual_places_are_found() -> None:
    layout = [
        *((0, 2), (100, 4), (210, 3), (350, 2), (501, 2), (1000, 2), (2001, 4), (4096, 2)),
        *((5020, 2), (8000, 1), (12300, 2), (20000, 5), (30001, 6), (40001, 100)),
        *((40230, 4), (50000, 2)),
    ]
    memory = {address for first, count in layout for address in range(first, first + count)}

    def answers(pdu: bytes) -> bytes:
        first, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
        return (
            registers(pdu) if memory.issuperset(range(first, first + count)) else exception(pdu, 2)
        )

    with FakeDevice(answers) as device:
        found = answer("describe", "map", device.url, "--areas", "hr")["areas"]["holding_registers"]
    assert found["ranges"] == [[first, first + count - 1] for first, count in layout]
    assert found["requests"] < 2700


def held_at(address: int, reached: threading.Event, go_on: threading.Event) -> Answer:
    """A device with 9 registers of each kind, which answers from an address on when it may."""

    def answers(pdu: bytes) -> bytes:
        first, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
        if first == address:
            reached.set()
            go_on.wait(wire.DEADLINE)
        return registers(pdu) if pdu[0] >= 3 and first + count <= 9 else exception(pdu, 2)

    return answers


def test_a_device_is_asked_for_registers_at_usual_starts_first() -> None:
    with FakeDevice(lambda pdu: exception(pdu, 2)) as device:
        done("describe", "map", device.url, "--range", "0-1100")
        alone = [pdu for pdu in device.asked if int.from_bytes(pdu[3:5]) == 1]
        asked = [(pdu[0], int.from_bytes(pdu[1:3])) for pdu in alone]
    starts = (0, 1, 100, 200, 300, 500, 700, 1000, 1001)
    assert asked[: 2 * len(starts)] == [(code, start) for start in starts for code in (3, 4)]
    others = asked[2 * len(starts) : len(asked) // 2]
    assert others[:6] == [(3, 2), (4, 2), (3, 3), (4, 3), (3, 4), (4, 4)]
    assert {code for code, _ in others} == {3, 4}
    assert [code for code, _ in asked[len(asked) // 2 :]] == [1, 2] * (len(asked) // 4)


def test_ranges_are_printed_before_the_search_ends() -> None:
    reached, go_on = threading.Event(), threading.Event()
    with (
        FakeDevice(held_at(1000, reached, go_on)) as device,
        Terminal("describe", "map", device.url, "--range", "0-1999", columns=80) as terminal,
    ):
        assert reached.wait(wire.DEADLINE)
        shown = terminal.until("input_registers")
        go_on.set()
        assert terminal.end() == 0
    assert re.search(r"^holding_registers +0 +8 +9$", shown, re.M)
    assert re.search(r"input_registers +0 +8 +9$", shown, re.M)
    assert "unit 1: 18 addresses" not in shown
    assert plain(terminal.shown).count("holding_registers      0 ") == 1


def test_a_program_can_read_ranges_before_the_search_ends() -> None:
    reached, go_on = threading.Event(), threading.Event()
    with FakeDevice(held_at(1000, reached, go_on)) as device:
        process = Command("describe", "map", device.url, "--json", "--range", "0-1999")
        assert reached.wait(wire.DEADLINE)
        early = cli.early_lines(process, 6)
        go_on.set()
        output, log = process.communicate(wire.DEADLINE)
    assert cli.elements(early[4:]) == [
        {"area": area, "address": 0, "count": 9}
        for area in ("holding_registers", "input_registers")
    ]
    assert (json.loads("".join(early) + output)["ok"], log) == (True, "")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_program_gets_what_was_found_before_an_interruption(number: signal.Signals) -> None:
    reached, go_on = threading.Event(), threading.Event()
    with FakeDevice(held_at(1000, reached, go_on)) as device:
        process = Command("describe", "map", device.url, "--json", "--range", "0-1999")
        assert reached.wait(wire.DEADLINE)
        process.send_signal(number)
        output, log = process.communicate(wire.DEADLINE)
        go_on.set()
    found = json.loads(output)
    assert (process.returncode, log) == (1, "")
    assert (found["ok"], found["detail"], found["complete"]) == (False, "interrupted", False)
    assert [each["area"] for each in found["found"]] == ["holding_registers", "input_registers"]
    assert found["areas"]["holding_registers"]["ranges"] == [[0, 8]]
    assert {
        area: each["not_searched_from"] for area, each in found["areas"].items()
    } == dict.fromkeys(AREAS, 0)


def test_a_second_interruption_ends_the_command_at_once() -> None:
    enough, go_on = threading.Event(), threading.Event()

    def answers(pdu: bytes) -> bytes:
        if int.from_bytes(pdu[1:3]) == 65500:
            enough.set()
            go_on.wait(wire.DEADLINE)
        return exception(pdu, 2)

    with FakeDevice(answers) as device:
        options = ("--areas", "hr")
        process = Command("describe", "map", device.url, "--json", *options)
        assert enough.wait(wire.DEADLINE)
        process.send_signal(signal.SIGINT)
        # Nobody reads the pipe: what was found does not fit, so the command can't end by itself.
        assert process.stdout is not None
        process.stdout.read(1)
        process.send_signal(signal.SIGINT)
        assert process.wait(wire.DEADLINE) == -signal.SIGINT
        go_on.set()
    process.communicate()


def test_a_device_that_goes_away_leaves_what_was_found() -> None:
    gone = threading.Event()

    def answers(pdu: bytes) -> bytes:
        first, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
        if first == 1000:
            gone.set()
        if gone.is_set():
            return HANG_UP
        return registers(pdu) if pdu[0] >= 3 and first + count <= 9 else exception(pdu, 2)

    with FakeDevice(answers) as device:
        result = cli.invoke("describe", "map", device.url, "--areas", "hr")
    assert (result.exit_code, result.stderr) == (
        1,
        f"holdfast: {device.url}: the device stopped answering\n",
    )
    assert re.search(r"^holding_registers +0 +8 +9$", result.stdout, re.M)
    assert "Incomplete. Not searched: holding_registers from 0 on" in result.stdout


def test_the_page_lists_the_usual_starts() -> None:
    page = (DOCS / "cli.md").read_text(encoding="utf-8")
    [listed] = re.findall(r"at the usual starts: ([^;]+);", page)
    assert tuple(map(int, re.findall(r"\d+", listed))) == USUAL_STARTS
