"""`holdfast watch`, as people and programs use it."""

from __future__ import annotations

import contextlib
import json
import re
import signal
from typing import TYPE_CHECKING

import pytest
from rich.text import Text

import holdfast
from holdfast.cli.live.appliance_sources import Rest, by_modbus
from holdfast.cli.live.changes import RATE_WINDOW_S, Tracker
from holdfast.cli.live.registers_view import View
from holdfast.cli.live.screen import with_whole_parts
from holdfast.cli.live.sources import WatchedRange, cut, within
from holdfast.config import load
from support import cli, wire
from support.cli import answer, failure, invoke, usage_error
from support.commands import Command
from support.fake_device import FakeDevice, exception, registers, whole_floats
from support.running import endpoint
from support.terminal import Terminal, plain
from support.web import token

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from holdfast.appliance import Appliance
    from support.running import Run, Serve

OFTEN = ("--every", "0.01")
FRESH = "\x1b[1;7;33m"

MEMORIES = """
memories:
  boiler: {coils: 8, holding_registers: {start: 100, size: 20}}
  pumps: {input_registers: 4}
"""
LISTENER = """
listeners:
  other: {type: modbus-udp, bind: 127.0.0.1:0, rules: [
    {sources: [127.0.0.1], units: {1: pumps}, access: read-only}]}
  scada: {type: modbus-tcp, bind: 127.0.0.1:SCADA, rules: [
    {sources: [10.0.0.1], units: {1: pumps}, access: read-only},
    {sources: [127.0.0.0/8], units: {3: boiler, 4: boiler, 5: pumps},
     access: read-only, deny: [1]}]}
"""
REST = "rest: {bind: 127.0.0.1:REST, sources: [127.0.0.1], tokens: TOKENS}\n"


class Watch:
    """`holdfast watch` without a terminal."""

    def __init__(self, *arguments: str) -> None:
        self.process = Command("watch", *arguments, *OFTEN)
        assert self.process.stderr is not None
        self.greeting = self.process.stderr.readline()

    def line(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline()

    def end(self, number: signal.Signals = signal.SIGINT) -> int:
        self.process.send_signal(number)
        _, log = self.process.communicate(timeout=wire.DEADLINE)
        assert log == ""
        return self.process.wait()


@pytest.fixture
def watch() -> Iterator[Callable[..., Watch]]:
    with contextlib.ExitStack() as started:

        def start(*arguments: str) -> Watch:
            running = Watch(*arguments)
            started.callback(running.process.communicate)
            started.callback(running.process.kill)
            return running

        yield start


@pytest.fixture
def plant(run: Run, tmp_path: Path) -> Callable[..., tuple[Appliance, str]]:
    """Runs an appliance, and writes a file that names the ports that it has."""

    def start(*parts: str, tokens: str = "none") -> tuple[Appliance, str]:
        text = "".join(parts).replace("TOKENS", tokens)
        appliance = run(re.sub("SCADA|REST", "0", text))
        for name, mark in (("scada", "SCADA"), ("rest", "REST")):
            if mark in text:
                text = text.replace(mark, str(endpoint(appliance, name)[1]))
        file = tmp_path / "running.yaml"
        file.write_text(text)
        return appliance, str(file)

    return start


def test_changes_of_a_device_are_lines(
    server: holdfast.Server, memory: holdfast.Memory, watch: Callable[..., Watch]
) -> None:
    watching = watch(cli.url(server), "hr", "5", "10")
    assert watching.greeting == f"watching {cli.url(server)}, unit 1\n"
    wire.until(lambda: server.counters()["requests"].get(3, 0) > 1, "it reads")
    memory.write("holding_registers", 4, [1, 2, 3])
    time, *words = watching.line().split()
    assert re.fullmatch(r"\d\d:\d\d:\d\d\.\d\d\d", time)
    assert words == ["holding_registers", "5:", "0", "->", "2", "+2"]
    assert watching.line().split()[1:] == ["holding_registers", "6:", "0", "->", "3", "+3"]
    assert watching.end(signal.SIGTERM) == 0


def test_changes_are_objects_for_programs(
    server: holdfast.Server, memory: holdfast.Memory, watch: Callable[..., Watch]
) -> None:
    watching = watch(cli.url(server), "co", "0", "8", "--json")
    wire.until(lambda: server.counters()["requests"].get(1, 0) > 1, "it reads")
    memory.write("coils", 3, [1])
    change = json.loads(watching.line())
    assert change.pop("time").endswith("Z")
    whose = {"ok": True, "target": cli.url(server), "unit": 1}
    assert change == {**whose, "area": "coils", "address": 3, "was": 0, "now": 1}
    assert watching.end() == 0


def test_all_that_a_device_has_is_watched_if_nothing_is_named(
    serve: Serve, watch: Callable[..., Watch]
) -> None:
    memory = holdfast.Memory(discrete_inputs=10, input_registers=(1000, 10))
    server = serve({1: memory})
    watching = watch(cli.url(server))
    assert "searching for addresses" in watching.greeting
    assert watching.process.stderr is not None
    assert watching.process.stderr.readline() == f"watching {cli.url(server)}, unit 1\n"
    reads = server.counters()["requests"][4]
    wire.until(lambda: server.counters()["requests"][4] > reads + 1, "it reads")
    memory.write_many([("discrete_inputs", 9, [1]), ("input_registers", 1009, [7])])
    assert watching.line().split()[1:] == ["discrete_inputs", "9:", "0", "->", "1"]
    assert watching.line().split()[1:] == ["input_registers", "1009:", "0", "->", "7", "+7"]
    assert watching.end() == 0


def test_a_meter_that_only_gives_whole_values_is_watched(watch: Callable[..., Watch]) -> None:
    with FakeDevice(whole_floats(2)) as device:
        watching = watch(device.url)
        assert watching.process.stderr is not None
        assert watching.process.stderr.readline() == f"watching {device.url}, unit 1\n"
        asked = len(device.asked)
        wire.until(lambda: len(device.asked) > asked + 5, "it reads")
        assert watching.end() == 0


def test_errors_are_told_and_it_goes_on(watch: Callable[..., Watch]) -> None:
    with FakeDevice(registers) as device:
        watching = watch(device.url, "hr", "0")
        wire.until(lambda: len(device.asked) > 2, "it reads")
        device.answer = lambda pdu: exception(pdu, 6)
        assert watching.line().split(maxsplit=1)[1] == "exception 06 (Server Device Busy)\n"
        device.answer = lambda pdu: registers(pdu, 9)
        while "->" not in (line := watching.line()):
            assert "exception 06" in line
        assert line.split()[1:] == ["holding_registers", "0:", "0", "->", "9", "+9"]
        assert watching.end() == 0


def test_an_appliance_is_watched_over_rest(
    plant: Callable[..., tuple[Appliance, str]], watch: Callable[..., Watch]
) -> None:
    appliance, file = plant(MEMORIES, LISTENER, REST)
    watching = watch(file)
    host, port = endpoint(appliance, "rest")
    assert watching.greeting == f"watching REST at http://{host}:{port}\n"

    def reads() -> int:
        rest = appliance.diagnostics.adapter("rest")
        assert rest is not None
        counted: int = rest["reads"]
        return counted

    wire.until(lambda: reads() > 6, "it reads")
    appliance.memories["boiler"].write("holding_registers", 119, [7])
    appliance.memories["pumps"].write("input_registers", 0, [8])
    lines = {" ".join(watching.line().split()[1:]) for _ in range(2)}
    assert lines == {
        "boiler holding_registers 119: 0 -> 7 +7",
        "pumps input_registers 0: 0 -> 8 +8",
    }
    assert watching.end() == 0


def test_a_token_opens_what_it_may_read(
    plant: Callable[..., tuple[Appliance, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    granted = token("panel", "s3cret", memories=("pumps", "boiler"), areas=("coils",))
    _, file = plant(MEMORIES, REST, tokens=json.dumps([granted]))
    result = invoke("watch", file, "--times", "1")
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr == f"{file}: rest requires a token: set HOLDFAST_TOKEN\n"
    monkeypatch.setenv("HOLDFAST_TOKEN", "other")
    assert "rest does not accept the token" in invoke("watch", file, "--times", "1").stderr
    monkeypatch.setenv("HOLDFAST_TOKEN", "s3cret")
    result = invoke("watch", file, "--times", "2", *OFTEN)
    assert (result.exit_code, result.stdout) == (0, "")


def test_an_appliance_without_rest_is_watched_over_modbus(
    plant: Callable[..., tuple[Appliance, str]], watch: Callable[..., Watch]
) -> None:
    appliance, file = plant(MEMORIES, LISTENER)
    watching = watch(file)
    host, port = endpoint(appliance, "scada")
    assert watching.greeting == f"watching listener scada at tcp://{host}:{port}\n"

    def reads() -> int:
        counted: int = appliance.diagnostics.stats()["listeners"]["scada"]["requests"].get(4, 0)
        return counted

    wire.until(lambda: reads() > 1, "it reads")
    appliance.memories["pumps"].write("input_registers", 2, [9])
    assert watching.line().split()[1:] == ["pumps", "input_registers", "2:", "0", "->", "9", "+9"]
    assert watching.end() == 0
    assert 1 not in appliance.diagnostics.stats()["listeners"]["scada"]["requests"]


@pytest.mark.parametrize(
    ("parts", "arguments", "told"),
    [
        (
            (MEMORIES, LISTENER),
            ("--memory", "fans"),
            "has no memory 'fans', allowed: boiler, pumps.",
        ),
        (
            (MEMORIES, LISTENER),
            ("--memory", "pumps", "hr", "0"),
            "none of the requested addresses can be read",
        ),
        ((MEMORIES, LISTENER), ("co", "0", "8"), "none of the requested addresses can be read"),
        (
            (MEMORIES, LISTENER.replace("127.0.0.0/8", "127.0.0.2")),
            (),
            "no rule of listener scada admits 127.0.0.1",
        ),
        (
            (MEMORIES, LISTENER.replace("SCADA", "0")),
            (),
            "the port of listener scada is 0, so the port in use is not known",
        ),
        (
            (MEMORIES, LISTENER, REST.replace("REST", "0")),
            (),
            "the port of rest is 0, so the port in use is not known",
        ),
        (
            (MEMORIES, LISTENER.replace("modbus-tcp", "modbus-rtu-over-tcp")),
            (),
            "found neither rest nor a listener of type modbus-tcp",
        ),
        (("memories: {}\n",), (), "problem"),
    ],
)
def test_an_appliance_that_can_not_be_watched_is_told(
    parts: tuple[str, ...], arguments: tuple[str, ...], told: str, tmp_path: Path
) -> None:
    file = tmp_path / "plant.yaml"
    text = "".join(parts).replace("TOKENS", "none").replace("SCADA", "5020")
    file.write_text(text.replace("REST", "5021"))
    result = invoke("watch", str(file), *arguments)
    assert (result.exit_code, result.stdout) == (2, "")
    assert told in result.stderr


def test_units_that_are_devices_are_not_watched(tmp_path: Path) -> None:
    file = tmp_path / "plant.yaml"
    listener = LISTENER.replace("{3: boiler, 4: boiler, 5: pumps}", "{1-2: {route: d}, 3-5: pumps}")
    devices = "links: {d: {url: 'tcp://10.0.0.9'}}\n"
    file.write_text(MEMORIES + listener.replace("SCADA", "5020") + devices)
    _, _, blocks = by_modbus(load(file))
    assert [(block.memory, block.unit) for block in blocks] == [("pumps", 3)]


def test_what_a_unit_may_not_read_is_not_watched(tmp_path: Path) -> None:
    file = tmp_path / "plant.yaml"
    units = (
        "{1: {memory: pumps, functions: [6]}, 2: {memory: pumps, read: [{area: holding_registers, "
        "start: 2, end: 4}]}}"
    )
    listener = LISTENER.replace("{3: boiler, 4: boiler, 5: pumps}", units)
    memories = "memories: {pumps: {coils: 8, holding_registers: 10}}\n"
    file.write_text(memories + listener.replace("SCADA", "5020"))
    _, _, blocks = by_modbus(load(file))
    assert blocks == [WatchedRange("pumps", 2, "holding_registers", 2, 3)]


@pytest.mark.parametrize(
    ("source", "host"), [("127.0.0.0/8", "127.0.0.1"), ('"::1"', "[::1]"), ('"::/0"', "[::1]")]
)
def test_what_listens_everywhere_is_read_from_a_source_that_it_admits(
    source: str, host: str, tmp_path: Path
) -> None:
    file = tmp_path / "plant.yaml"
    listener = LISTENER.replace("127.0.0.1:SCADA", '"[::]:5020"').replace("127.0.0.0/8", source)
    granted = token("panel", "s3cret", memories=("pumps",))
    rest = REST.replace("127.0.0.1:REST", '"[::]:5021"').replace("TOKENS", json.dumps([granted]))
    file.write_text(MEMORIES + listener + rest.replace("127.0.0.1", source))
    config = load(file)
    _, address, blocks = by_modbus(config)
    assert (address, len(blocks)) == (f"{host}:5020", 2)
    assert config.rest is not None
    assert Rest(config.rest, [], None, 1).url == f"http://{host}:5021"


def test_the_first_reading_must_succeed(server: holdfast.Server, tmp_path: Path) -> None:
    url = cli.url(server)
    assert failure("watch", url, "hr", "999", "2") == [
        f"holdfast: {url}, unit 1: exception 02 (Illegal Data Address)",
        f"hint: 'holdfast describe map {url}' finds the addresses that exist",
    ]
    found = answer("watch", url, "hr", "999", "2", code=1)
    assert found["ok"] is False
    file = tmp_path / "plant.yaml"
    file.write_text(MEMORIES + REST.replace("REST", "1").replace("TOKENS", "none"))
    [line] = failure("watch", str(file))
    assert line.startswith("holdfast: REST at http://127.0.0.1:1: ")


def test_a_device_that_refuses_reads_across_borders_is_watched_in_parts() -> None:
    def answers(pdu: bytes) -> bytes:
        first, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
        if pdu[0] != 3 or first // 20 != (first + count - 1) // 20 or first + count > 50:
            return exception(pdu, 2)
        return registers(pdu)

    with FakeDevice(answers) as device:
        result = invoke("watch", device.url, "--times", "2", *OFTEN)
    assert (result.exit_code, result.stdout) == (0, "")
    assert result.stderr.splitlines()[-1] == f"watching {device.url}, unit 1"


@pytest.mark.parametrize(
    ("code", "times", "end"),
    [
        (3, 1000, ["holding_registers 17 is not watched: exception 03 (Illegal Data Value)"]),
        (6, 1, []),
    ],
)
def test_what_a_device_refuses_after_the_search_is_left_out_and_told(
    code: int, times: int, end: list[str]
) -> None:
    """The search asks for coils last."""
    failures = iter(range(times))

    def answers(pdu: bytes) -> bytes:
        first, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
        if pdu[0] != 3 or count > 20 or first + count > 50:
            return exception(pdu, 2)
        is_searched = any(each[0] == 1 for each in device.asked)
        if is_searched and first <= 17 < first + count and next(failures, None) is not None:
            return exception(pdu, code)
        return registers(pdu)

    with FakeDevice(answers) as device:
        result = invoke("watch", device.url, "--times", "2", *OFTEN)
        reads = [each[1:] for each in device.asked[-6:]]
    assert (result.exit_code, result.stdout) == (0, "")
    told = [f"{device.url}, unit 1: searching for addresses", *end]
    assert result.stderr.splitlines() == [*told, f"watching {device.url}, unit 1"]
    left_out = [each for each in reads if each[1] <= 17 < each[1] + each[3]]
    assert bool(left_out) == (not end)


def test_a_device_that_fails_after_the_search_is_not_watched_in_part() -> None:
    def answers(pdu: bytes) -> bytes:
        first, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
        if pdu[0] != 3 or count > 20 or first + count > 50:
            return exception(pdu, 2)
        is_searched = any(each[0] == 1 for each in device.asked)
        return exception(pdu, 4) if is_searched and first <= 17 < first + count else registers(pdu)

    with FakeDevice(answers) as device:
        error = failure("watch", device.url, *OFTEN)[-1]
    assert error == f"holdfast: {device.url}, unit 1: exception 04 (Server Device Failure)"


def test_a_device_without_addresses_can_not_be_watched() -> None:
    with FakeDevice(lambda pdu: exception(pdu, 1)) as device:
        assert failure("watch", device.url)[-1] == f"holdfast: {device.url}: no address was found"
    assert failure("watch", "tcp://127.0.0.1:1")[-1].startswith(
        "holdfast: tcp://127.0.0.1:1: can't"
    )


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("tcp://127.0.0.1", "--memory", "x"), "--memory requires FILE."),
        (("foo://127.0.0.1",), "is not the URL of a device"),
        (("tcp://127.0.0.1", "hr"), "Missing argument 'ADDRESS'."),
        (("tcp://127.0.0.1", "hr", "65535", "2"), "the last address is 65535."),
    ],
)
def test_wrong_usage_is_told(arguments: tuple[str, ...], told: str) -> None:
    assert told in usage_error("watch", *arguments)


def frame(terminal: Terminal) -> list[str]:
    """The last whole screen."""
    return plain(terminal.shown.split("\x1b[H")[-1]).splitlines()


def test_a_terminal_shows_values_and_highlights_what_changed(
    server: holdfast.Server, memory: holdfast.Memory
) -> None:
    memory.write("holding_registers", 0, [11, 22, 33])
    arguments = ("watch", cli.url(server), "hr", "0", "32", "--every", "0.05")
    with Terminal(*arguments, lines=24, columns=80) as terminal:
        shown = terminal.until("11    22    33", "q quits")
        assert "changing" not in shown
        memory.write("holding_registers", 1, [4711])
        terminal.until("holding_registers 1:  4711", "1 change")
        assert f"{FRESH}4711" in terminal.shown
        memory.write("holding_registers", 1, [4712])
        terminal.until("holding_registers 1:  4712", "2 changes")
        terminal.keys("q")
        assert terminal.end() == 0
    assert terminal.shown.endswith("\x1b[?25h\x1b[?1049l")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_leaves_the_terminal_as_it_was(
    server: holdfast.Server, number: signal.Signals
) -> None:
    with Terminal("watch", cli.url(server), "hr", "0") as terminal:
        terminal.until("q quits")
        assert terminal.end(number) == 0
    assert terminal.shown.endswith("\x1b[?25h\x1b[?1049l")


@pytest.mark.parametrize("words", [("hr", "0"), ("hr:0", "hr:1")])
@pytest.mark.parametrize("code", [None, 2])
def test_a_terminal_that_is_closed_ends_the_view_like_a_signal(
    words: tuple[str, ...], code: int | None
) -> None:
    with (
        FakeDevice(registers) as device,
        Terminal("watch", device.url, *words, "--every", "0.05") as terminal,
    ):
        terminal.until("q quits")
        if code is not None:  # What the device answers last is a reason for a hint.
            device.answer = lambda pdu: exception(pdu, code)
            terminal.until(f"exception 0{code}")
        assert terminal.hang_up() == 0


def test_ctrl_z_leaves_the_screen_until_the_view_continues(server: holdfast.Server) -> None:
    # Without a shell that could continue it, the process is not stopped, but continues at once.
    with Terminal("watch", cli.url(server), "hr", "0", "--every", "1h") as terminal:
        terminal.until("q quits")
        terminal.wait_for_enter()
        terminal.keys("\x1a")
        terminal.until("q quits")
        terminal.keys("q")
        assert terminal.end() == 0
    modes = re.findall(r"\x1b\[\?(1049.|25.)", terminal.shown)
    assert modes == ["1049h", "25l", "1049l", "25h", "1049h", "25l", "25h", "1049l"]


@pytest.mark.parametrize("kind", ["dumb", "unknown"])
@pytest.mark.parametrize("words", [("hr", "0"), ("hr:0", "hr:1")])
def test_a_terminal_that_redraws_nothing_gets_lines(
    server: holdfast.Server, memory: holdfast.Memory, words: tuple[str, ...], kind: str
) -> None:
    with Terminal("watch", cli.url(server), *words, "--every", "0.05", TERM=kind) as terminal:
        terminal.until("watching tcp://")
        memory.write("holding_registers", 0, [4711])
        terminal.until(" 0 -> 4711")
        assert terminal.end(signal.SIGINT) == 0
    assert "\x1b" not in terminal.shown


def test_colours_are_left_out_if_they_are_not_wanted(
    server: holdfast.Server, memory: holdfast.Memory
) -> None:
    arguments = ("watch", cli.url(server), "hr", "0", "--every", "0.05")
    with Terminal(*arguments, NO_COLOR="1") as terminal:
        terminal.until("q quits")
        memory.write("holding_registers", 0, [4711])
        terminal.until("4711", "1 change")
        terminal.keys("q")
        assert terminal.end() == 0
    assert "\x1b[1;7m4711" in terminal.shown
    assert not re.search(r"\x1b\[[0-9;]*3[0-9]m", terminal.shown)


def test_the_size_of_the_terminal_may_change(server: holdfast.Server) -> None:
    arguments = ("watch", cli.url(server), "hr", "0", "300", "--every", "0.05")
    with Terminal(*arguments, lines=20, columns=60) as terminal:
        terminal.until("n, p turn pages (1/3)")
        assert "    8 " in plain(terminal.shown)
        terminal.resize(60, 120)
        shown = terminal.until("   16 ", "  288 ", "q quits")
        assert "turn pages" not in shown.rpartition("  288 ")[2]
        terminal.resize(8, 30)
        terminal.until("(1/")
        terminal.resize(8, 20)
        terminal.until("tcp://127.0.0.1:", "…", "holding_registers")
        terminal.keys("q")
        assert terminal.end() == 0


def test_changes_leave_room_for_values_and_keys(
    server: holdfast.Server, memory: holdfast.Memory
) -> None:
    arguments = ("watch", cli.url(server), "hr", "0", "8", "--every", "0.05")
    with Terminal(*arguments, lines=10, columns=100) as terminal:
        terminal.until("q quits")
        memory.write("holding_registers", 0, range(1, 9))
        terminal.until("changing")
        terminal.until("holding_registers", "    0      1     2", "changing", "q quits")
        terminal.resize(6, 20)
        terminal.until("holding_registers", "    0      1     2", "    2      3     4", "q quits")


def test_pages_are_turned(server: holdfast.Server) -> None:
    arguments = ("watch", cli.url(server), "hr", "0", "300", "--every", "0.05")
    with Terminal(*arguments, lines=20, columns=60) as terminal:
        terminal.until("(1/3)")
        terminal.keys("n")
        terminal.until("(2/3)")
        terminal.keys(" ")
        terminal.until("  296 ", "(3/3)")
        terminal.keys("n")
        terminal.keys("p")
        terminal.until("(2/3)")
        terminal.keys("\x03")
        assert terminal.end() == 0


def test_errors_are_shown_on_a_terminal_and_it_goes_on() -> None:
    with FakeDevice(registers) as device:
        arguments = ("watch", device.url, "hr", "0", "--every", "0.05")
        with Terminal(*arguments) as terminal:
            terminal.until("q quits")
            device.answer = lambda pdu: exception(pdu, 6)
            terminal.until("exception 06 (Server Device Busy)", "error")
            device.answer = lambda pdu: registers(pdu, 4711)
            terminal.until("4711")
            terminal.keys("q")
            assert terminal.end() == 0


def test_it_ends_after_so_many_readings(server: holdfast.Server) -> None:
    arguments = ("watch", cli.url(server), "hr", "0", *OFTEN, "--times", "3")
    with Terminal(*arguments) as terminal:
        assert terminal.end() == 0
    assert "3 readings" in plain(terminal.shown)
    assert server.counters()["requests"][3] == 3


REGISTERS = WatchedRange(None, 1, "holding_registers", 100, 4)


def test_rates_are_taken_over_the_last_time() -> None:
    tracker = Tracker([REGISTERS])
    for second in range(8):
        tracker.update(second, [[2 * second, 5, 65530 + second if second < 6 else second - 6, 0]])
    found = {address: (value, history) for _, address, value, history in tracker.latest(9)}
    assert list(found) == [100, 102]
    assert [found[address][1].rate(7) for address in found] == [2, 1]
    assert found[100][1].changes == 7
    assert found[100][1].rate(7 + RATE_WINDOW_S + 1) == 0
    for second in range(8, 30):
        tracker.update(second, [[14 - second, 5, 1, 0]])
    assert found[100][1].rate(29) == pytest.approx(-1)


class Silence:
    """A source of the live view that is never read."""

    where = "tcp://127.0.0.1:5020, unit 1"
    url = "tcp://127.0.0.1:5020"

    def __init__(self, blocks: list[WatchedRange]) -> None:
        self.blocks = blocks

    def read(self) -> list[list[int]]:
        raise AssertionError("not read")

    def close(self) -> None: ...


@pytest.mark.parametrize("memory", [None, "boiler_house_north_ring_main"])
def test_no_number_is_cut_on_a_narrow_terminal(memory: str | None) -> None:
    block = WatchedRange(memory, 1, "holding_registers", 12340, 8)
    view = View(Silence([block]), [[0] * 8], 1, None)
    view._tracker.update(view._tracker.at + 1, [[0] * 5 + [54321] + [0] * 2])
    [(_, _, _, history)] = view._tracker.latest(1)
    rate = history.rate(view._tracker.at)
    whole = {"12345:", "54321", f"{rate:+.3g}", "/s", "1", "change", "…"}
    for width in range(120, 10, -1):
        [title, line] = [text.plain for text in view.foot(width)]
        assert (title, len(line) <= width) == ("changing", True)
        name, _, numbers = line.rpartition(" 12345: ")
        words = numbers.split()
        assert set(words) <= whole
        # What does not fit is left out from the end, and the value last.
        assert words[0] == ("54321" if width >= len("hr 12345: 54321") else "…")
        assert name.split()[-1] in ("hr", "holding_registers")
        assert memory is None or width < 40 or name.startswith("boiler_house_north")
        for row in view.body(width)[1:]:
            assert len(row.plain) <= width
            assert set(row.plain.split()) <= {*map(str, range(12340, 12348)), "0", "54321"}
    [*_, row, _, _] = view.body(10)
    assert row.plain.split() == ["12345", "…"]


@pytest.mark.parametrize("width", range(5, 90, 3))
def test_parts_of_a_line_are_whole(width: int) -> None:
    parts = [("every 0.25 s", ""), ("12345 readings", "")]
    line = with_whole_parts(Text(Silence.where), parts, width).plain
    longer = [
        f"{Silence.where}   every 0.25 s   12345 readings",
        f"{Silence.where}   every 0.25 s",
    ]
    assert line == next((each for each in longer if len(each) <= width), Silence.where)


def test_only_the_latest_changes_are_listed() -> None:
    tracker = Tracker([REGISTERS])
    for values in ([0, 0, 0, 0], [1, 0, 0, 0], [1, 1, 0, 1], [1, 1, 1, 1]):
        changes = tracker.update(tracker.at + 1, [values])
    assert [(change.address, change.was, change.now) for change in changes] == [(102, 0, 1)]
    assert [address for _, address, _, _ in tracker.latest(3)] == [101, 102, 103]
    assert [tracker.age(0, address) for address in range(100, 104)] == [2, 1, 0, 1]


def test_blocks_are_cut_to_what_is_asked_for_and_to_what_is_allowed() -> None:
    coils = WatchedRange("m", 1, "coils", 0, 10)
    assert within([coils, REGISTERS], "holding_registers", 102, 50) == [
        WatchedRange(None, 1, "holding_registers", 102, 2)
    ]
    assert within([coils], "coils", 10, 5) == []
    assert cut([coils, REGISTERS], 12) == (
        [coils, WatchedRange(None, 1, "holding_registers", 100, 2)],
        2,
    )
