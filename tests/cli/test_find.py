"""`holdfast find`, as people and programs use it."""

from __future__ import annotations

import fcntl
import itertools
import json
import re
import signal
import socket
import sys
import threading
from typing import TYPE_CHECKING

import pytest

import holdfast
from holdfast.client import SyncClient
from holdfast.discovery import device_search
from holdfast.server import Identity
from support import cli, lines, wire
from support.cli import answer, done, failure, usage_error
from support.commands import Command
from support.fake_device import (
    HANG_UP,
    FakeDevice,
    Late,
    Serial,
    Stream,
    Udp,
    exception,
    registers,
    silent,
)
from support.terminal import Terminal, plain

if TYPE_CHECKING:
    from pathlib import Path

    from support.fake_device import Asked, Behaviour
    from support.running import Serve


TCGETS2 = 0x802C542A
"""Linux: reads the settings of a line, with the speed as a number."""


@pytest.mark.parametrize("as_json", [(), ("--json",)])
def test_replies_after_the_timeout_are_a_hint(as_json: tuple[str, ...]) -> None:
    with Stream("tcp", then=Late()) as device:
        port = device.url.rpartition(":")[2]
        for arguments in (
            (device.url, "--units", "1-3"),
            ("127.0.0.1", "--port", port, "--units", "1-3"),
        ):
            found = cli.invoke("find", *arguments, "--timeout", "0.05", *as_json)
            assert cli.LATE.fullmatch(found.stderr)
            if as_json:
                assert json.loads(found.stdout)["ok"] is False


def test_hosts_that_answer_are_found_and_others_told_apart(serve: Serve) -> None:
    identity = Identity(vendor_name="Acme", product_code="PLANT", revision="1.0")
    server = serve({1: holdfast.Memory(coils=8)}, identity=identity)
    port = server.address[1]

    def are_found(timeout: float) -> bool:
        options = ("--port", str(port), "--timeout", str(timeout))
        with socket.create_server(("127.0.0.2", port)):
            table = cli.invoke("find", "127.0.0.0/29", *options)
            document = cli.invoke("find", "127.0.0.1", "127.0.0.2", *options, "--json")
        if not ("Acme" in table.stdout and "0 do not respond" in table.stdout):
            return False
        if "Acme" not in document.stdout:
            return False
        assert (table.exit_code, table.stderr, document.exit_code, document.stderr) == (
            0,
            "",
            0,
            "",
        )
        [head, modbus, other, empty, counts] = table.stdout.splitlines()
        assert head.split() == ["url", "unit", "answer", "identification"]
        assert re.fullmatch(
            rf"tcp://127.0.0.1:{port} +1 +exception 02 \(Illegal Data Address\) +Acme PLANT 1.0",
            modbus,
        )
        assert re.fullmatch(rf"tcp://127.0.0.2:{port} +no Modbus: .*", other)
        assert empty == ""
        assert counts == (
            "6 addresses: 1 answer Modbus, 1 accept connections but do not answer Modbus, "
            "4 refuse them, 0 do not respond"
        )
        found = json.loads(document.stdout)
        assert (found["ok"], found["complete"]) == (True, True)
        states = {"modbus": 1, "open": 1, "refused": 0, "silent": 0, "asked": 2, "not_asked": 0}
        assert found["counts"] == states
        hosts = sorted(found["found"], key=lambda host: host["host"])
        assert hosts[0]["identification"]["vendor_name"] == "Acme"
        assert (hosts[0]["url"], hosts[0]["unit"]) == (cli.url(server), 1)
        return True

    wire.until_long_enough(are_found, "the device answers, and no host is silent")


def test_a_host_that_answers_only_another_unit_id_is_found() -> None:
    def behave(asked: Asked) -> None:
        if asked.unit == 255:
            asked.answer(exception(asked.pdu, 2))

    def is_found(timeout: float) -> bool:
        with Stream("tcp", then=behave) as host:
            options = ("--port", str(host.port), "--timeout", str(timeout), "--json")
            result = cli.invoke("find", "127.0.0.1", *options)
        return result.exit_code == 0 and json.loads(result.stdout)["found"][0]["unit"] == 255

    wire.until_long_enough(is_found, "unit id 255 answers")


def test_a_gateway_without_its_device_is_found() -> None:
    with FakeDevice(lambda pdu: exception(pdu, 0x0B)) as host:
        found = answer("find", "127.0.0.1", "--port", str(host.port))
    assert (found["found"][0]["modbus"], found["found"][0]["unit"]) == (True, None)


def test_a_host_without_function_43_is_asked_for_function_17() -> None:
    def behave(asked: Asked) -> None:
        reports = asked.pdu[0] == 17
        asked.answer(b"\x11\x0a\x01\xffPUMP 7.1" if reports else exception(asked.pdu, 1))

    with Stream("tcp", then=behave) as host:
        found = done("find", "127.0.0.1", "--port", str(host.port))
    assert "PUMP 7.1" in "".join(found)


def test_nothing_is_a_failure() -> None:
    with socket.create_server(("127.0.0.1", 0)) as unused:
        port = unused.getsockname()[1]
    result = cli.invoke("find", "127.0.0.1", "--port", str(port))
    assert (result.exit_code, result.stderr) == (1, "")
    assert result.stdout.startswith("1 address: 0 answer Modbus")


def test_connections_begin_at_the_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    waits: list[float] = []

    async def sleep(seconds: float) -> None:
        waits.append(seconds)

    monkeypatch.setattr(device_search, "sleep", sleep)
    monkeypatch.setattr(device_search, "monotonic", lambda: 100.0)
    with socket.create_server(("127.0.0.1", 0)) as unused:
        port = unused.getsockname()[1]
    cli.invoke("find", "127.0.0.0/29", "--port", str(port), "--rate", "4")
    assert waits == [0.0, 0.25, 0.5, 0.75, 1.0, 1.25]


def test_hosts_so_far_are_shown_when_it_is_interrupted(serve: Serve) -> None:
    server = serve({1: holdfast.Memory(holding_registers=8)})
    port = server.address[1]
    with socket.create_server(("127.0.0.2", port)) as deaf:
        networks = ("127.0.0.1", "127.0.0.2")
        with Terminal("find", *networks, "--port", str(port), "--timeout", "60") as terminal:
            waiting, _ = deaf.accept()
            with waiting:
                terminal.until("1 found", f"tcp://127.0.0.1:{port}     1  answers")
                terminal.process.send_signal(signal.SIGINT)
                assert terminal.end() == 1
    shown = plain(terminal.shown)
    assert f"tcp://127.0.0.1:{port}" in shown
    assert "2 addresses: 1 answer Modbus" in shown
    assert ", 1 were not asked" in shown
    assert "interrupted" in shown


def answering_before(unit: int, reached: threading.Event) -> Behaviour:
    """A device that answers unit ids, but for one."""

    def behave(asked: Asked) -> None:
        if asked.unit == unit:
            reached.set()
        else:
            asked.answer(registers(asked.pdu) if asked.pdu[0] == 3 else exception(asked.pdu, 1))

    return behave


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_unit_ids_are_printed_as_they_are_found(number: signal.Signals) -> None:
    reached = threading.Event()
    with Stream("tcp", then=answering_before(3, reached)) as device:
        process = Command("find", device.url, "--units", "1-9", "--timeout", "60", "--json")
        assert reached.wait(wire.DEADLINE)
        early = cli.early_lines(process, 5)
        process.send_signal(number)
        output, log = process.communicate(wire.DEADLINE)
    assert [each["unit"] for each in cli.elements(early[3:])] == [1, 2]
    found = json.loads("".join(early) + output)
    assert (process.returncode, log) == (1, "")
    assert (found["ok"], found["complete"], found["detail"]) == (False, False, "interrupted")
    assert ([each["unit"] for each in found["found"]], found["not_asked"]) == (
        [1, 2],
        [3, 4, 5, 6, 7, 8, 9],
    )


def test_unit_ids_stay_known_if_the_device_goes_away() -> None:
    reached = threading.Event()
    with Stream("tcp", then=answering_before(2, reached)) as device:
        process = Command("find", device.url, "--units", "1-3", "--timeout", "60")
        assert reached.wait(wire.DEADLINE)
    output, log = process.communicate(wire.DEADLINE)
    assert re.search(r"^ +1  answers$", output, re.M)
    assert re.search(r"^not asked: (2-)?3$", output, re.M)
    assert log.startswith(f"holdfast: {device.url}: can't connect")
    assert process.returncode == 1


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("10.0.0.0/8",), "16777216 addresses, allowed: 1024; --large allows more."),
        (("10.0.0.0/8", "--large"), "16777216 addresses, allowed: 65536."),
        (("fd00::/64",), "allowed: 1024; --large"),
        (("10.0.0.1/24",), "has host bits set: the network is 10.0.0.0/24"),
        (("plc1",), "type 'holdfast find tcp://plc1'."),
        (("10.0.0.1:5020",), "type 'holdfast find tcp://10.0.0.1:5020'. The port of the hosts"),
        (("tcp://a", "--port", "5"), "--port is for NETWORK, it can't be used with URL."),
        (("/dev/ttyX", "--delay", "5"), "--delay is for URL, it can't be used with SERIAL."),
        (("rtu:///dev/ttyX?baud=9600", "--baud", "9600"), "--baud is for SERIAL, it can't be used"),
        (("tcp://a", "10.0.0.1"), "Give one URL or one serial line, or several networks."),
        (("10.0.0.1", "--units", "1-300"), "'1-300' is not a unit id or FIRST-LAST"),
        (("10.0.0.1", "--rate", "0"), "found 0, allowed: 0.1 to 1000"),
        (("/dev/ttyX", "--baud", "fast"), "'fast' is not a list of bauds, as in 9600,19200."),
        (("/dev/ttyX", "--parity", "mark"), "'mark' is not a list of none, even, odd."),
        (("/run/lines/a", "--units", "0-3"), "Unit id 0 is the broadcast on a serial line"),
        (("/dev/ttyX", "--units", "0-3"), "Unit id 0 is the broadcast on a serial line"),
    ],
)
def test_wrong_usage_is_told(arguments: tuple[str, ...], told: str) -> None:
    assert told in usage_error("find", *arguments)


def behind_gateway(asked: Asked) -> None:
    """A gateway with devices 3 and 17; unit 20 never answers."""
    if asked.unit in (3, 17):
        asked.answer(registers(asked.pdu) if asked.pdu[0] == 3 else exception(asked.pdu, 1))
    elif asked.unit != 20:
        asked.answer(exception(asked.pdu, 0x0B))


def test_unit_ids_behind_a_gateway_are_found() -> None:
    def are_found(timeout: float) -> bool:
        with Stream("tcp", then=behind_gateway) as host:
            options = ("--units", "1-5,17,20", "--timeout", str(timeout))
            table = cli.invoke("find", host.url, *options)
            document = cli.invoke("find", host.url, *options, "--json")
        found = json.loads(document.stdout)
        if "2 unit ids of 7" not in table.stdout or len(found["found"]) < 2:
            return False
        assert (table.exit_code, table.stderr, document.exit_code, document.stderr) == (
            0,
            "",
            0,
            "",
        )
        assert [line.split() for line in table.stdout.splitlines()] == [
            ["unit", "answer", "identification"],
            ["3", "answers"],
            ["17", "answers"],
            [],
            f"{host.url}: 2 unit ids of 7 asked answer".split(),
            ["no", "device:", "1-2,", "4-5,", "20"],
        ]
        assert [each["unit"] for each in found["found"]] == [3, 17]
        assert (found["asked"], found["not_asked"]) == ([1, 2, 3, 4, 5, 17, 20], [])
        assert found["ignores_unit"] is False
        return True

    wire.until_long_enough(are_found, "two unit ids answer")


def test_a_device_that_ignores_unit_ids_is_told() -> None:
    with FakeDevice(registers) as device:
        shown = done("find", device.url, "--units", "1-3")
    assert shown[-1] == "The device answers every unit id: it probably ignores them."


def ignores_two(reply: bytes | None) -> Behaviour:
    """Unit id 1 of a device that answers from the third request on."""
    asked_so_far = itertools.count(1)

    def behave(asked: Asked) -> None:
        if next(asked_so_far) <= 2:
            asked.end_with(reply)
        elif asked.unit == 1:
            asked.answer(registers(asked.pdu) if asked.pdu[0] == 3 else exception(asked.pdu, 1))

    return behave


@pytest.mark.parametrize("command", ["find", "describe", "find network"])
@pytest.mark.parametrize("first", [None, HANG_UP], ids=["silent", "closes"])
def test_a_device_that_ignores_what_comes_first_is_found(command: str, first: bytes | None) -> None:
    def is_found(timeout: float) -> bool:
        with Stream("tcp", then=ignores_two(first)) as host:
            target = [host.url, "--units", "1-3"]
            if command == "find network":
                target = ["127.0.0.1", "--port", str(host.port)]
            name, *_ = command.split()
            shown = cli.invoke(name, *target, "--timeout", str(timeout)).stdout
        return "1  answers" in shown or "Unit 1 answers." in shown

    wire.until_long_enough(is_found, "unit id 1 answers")


def test_a_device_on_a_line_that_ignores_what_comes_first_is_found(tmp_path: Path) -> None:
    def is_found(timeout: float) -> bool:
        with Serial(lines.RTU, tmp_path / "line", then=ignores_two(None)) as line:
            options = ("--units", "1-3", "--timeout", str(timeout))
            return "1  answers" in cli.invoke("find", line.url, *options).stdout

    wire.until_long_enough(is_found, "unit id 1 answers")


def test_unit_ids_are_yielded_as_soon_as_they_were_asked() -> None:
    with Stream("tcp", then=silent) as host, SyncClient(host.url, timeout=0.05) as client:
        found = device_search.units(client, [1, 2, 3])
        assert next(found).unit == 1
        assert all(each.unit == 1 for each in host.requests)
        assert [each.unit for each in found] == [2, 1, 3]


def test_silence_after_connecting_is_a_hint() -> None:
    def is_hinted(timeout: float) -> bool:
        with Stream("tcp", then=silent) as host:
            for target in ((host.url, "--units", "1-2"), ("127.0.0.1", "--port", str(host.port))):
                [*told] = failure("find", *target, "--timeout", str(timeout))
                if not told or f"'{host.url}?pause_after_connect=2'" not in told[-1]:
                    return False
        return True

    wire.until_long_enough(is_hinted, "the host accepts connections")


def not_modbus(asked: Asked) -> None:
    asked.send(b"HTTP/1.0 400 Bad Request\r\n\r\n")


@pytest.mark.parametrize(
    ("kind", "behave"),
    [
        ("tcp", lambda asked: asked.answer(exception(asked.pdu, 0x0B))),
        ("tcp", not_modbus),
        ("tcp", lambda asked: not_modbus(asked) if asked.unit == 1 else None),
        ("udp", silent),
        ("rtu+udp", silent),
    ],
    ids=["gateway", "web server", "invalid, then silent", "udp", "rtu+udp"],
)
def test_what_is_not_silent_after_connecting_gets_no_hint(kind: str, behave: Behaviour) -> None:
    is_tcp = kind == "tcp"
    with Stream(kind, then=behave) if is_tcp else Udp(then=behave, kind=kind) as host:
        quick = () if is_tcp else ("--timeout", "0.05")
        assert failure("find", host.url, "--units", "1-2", *quick) == []
        if is_tcp:
            assert [each.unit for each in host.requests] == [1, 2]
            port = host.url.rpartition(":")[2]
            assert cli.invoke("find", "127.0.0.1", "--port", port).stderr == ""


def test_no_unit_id_is_a_failure() -> None:
    with Stream("tcp", then=silent) as host:
        result = cli.invoke("find", host.url, "--units", "1-2", "--timeout", "0.05")
        assert (result.exit_code, result.stdout.splitlines()[-1]) == (1, "no device: 1-2")
    [told] = failure("find", host.url, "--units", "1-2")
    assert told.startswith(f"holdfast: {host.url}: can't connect")


def test_unit_ids_so_far_are_shown_when_it_is_interrupted() -> None:
    reached = threading.Event()

    def behave(asked: Asked) -> None:
        if asked.unit == 3:
            reached.set()
        elif asked.unit < 3:
            asked.answer(registers(asked.pdu) if asked.pdu[0] == 3 else exception(asked.pdu, 1))

    with (
        Stream("tcp", then=behave) as host,
        Terminal("find", host.url, "--timeout", "60") as terminal,
    ):
        assert reached.wait(wire.DEADLINE)
        terminal.process.send_signal(signal.SIGINT)
        assert terminal.end() == 1
    shown = plain(terminal.shown)
    # The first one is asked twice if nothing answers.
    assert "247 unit ids, at most 14880 s if none answers." in shown
    assert f"{host.url}: 2 unit ids of 2 asked answer" in shown
    assert "not asked: 3-247" in shown
    assert "interrupted" in shown


def baud(terminal: lines.Terminal) -> int:
    """The speed that the opener of a pseudo-terminal has set."""
    settings = fcntl.ioctl(terminal.end, TCGETS2, bytes(44))
    return int.from_bytes(settings[-4:], sys.byteorder)


def test_the_baud_of_a_line_is_found(tmp_path: Path) -> None:
    def behave(asked: Asked) -> None:
        if baud(device.terminal) == 57600 and asked.unit == 2:
            asked.answer(registers(asked.pdu) if asked.pdu[0] == 3 else exception(asked.pdu, 1))

    url = f"rtu://{tmp_path / 'line'}"
    line = f"{url}?baud=57600&parity=none&stop_bits=1"
    options = ("--baud", "9600,57600,1200", "--parity", "none", "--units", "1-2")

    def is_found(timeout: float) -> bool:
        table = cli.invoke("find", url, *options, "--timeout", str(timeout))
        document = cli.invoke("find", url, *options, "--timeout", str(timeout), "--json")
        if table.exit_code or document.exit_code:
            return False
        assert (table.stderr, document.stderr) == ("", "")
        _, found, *_, last = table.stdout.splitlines()
        assert found.split() == ["2", line, "answers"]
        assert last == (
            f"{tmp_path / 'line'}: 1 unit id found; unit ids asked: 1-2, 3 settings tried"
        )
        assert json.loads(document.stdout)["found"] == [
            {"url": line, "unit": 2, "detail": "answers", "identification": {}},
        ]
        return True

    with Serial(lines.RTU, tmp_path / "line", then=behave) as device:
        wire.until_long_enough(is_found, "the device answers")


def test_invalid_bytes_on_a_line_are_told(tmp_path: Path) -> None:
    with Serial(
        lines.RTU,
        tmp_path / "line",
        then=lambda asked: asked.send(lines.RTU.damaged(registers(asked.pdu), asked.unit)),
    ):
        url = f"rtu://{tmp_path / 'line'}"
        options = ("--baud", "9600", "--parity", "none", "--units", "1", "--timeout", "1")
        result = cli.invoke("find", url, *options)
    assert result.exit_code == 1
    assert result.stdout.splitlines()[-1] == (
        "Invalid bytes came at 9600 none: a device with other settings, or noise on the line."
    )


def test_unit_ids_with_invalid_replies_are_told(tmp_path: Path) -> None:
    def behave(asked: Asked) -> None:
        if asked.unit == 2:
            asked.send(lines.RTU.damaged(registers(asked.pdu), asked.unit))

    def are_told(timeout: float) -> bool:
        options = ("--units", "1-3", "--timeout", str(timeout))
        text = cli.invoke("find", device.url, *options).stdout.splitlines()
        found = json.loads(cli.invoke("find", device.url, *options, "--json").stdout)
        return text[1:] == ["no device: 1, 3", "invalid replies: 2"] and found["garbled"] == [2]

    with Serial(lines.RTU, tmp_path / "line", then=behave) as device:
        wire.until_long_enough(are_told, "the reply of unit 2 is invalid")


def test_a_line_that_is_not_there_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "missing"
    [told] = failure("find", f"rtu://{path}")
    assert told.startswith(f"holdfast: {path}: can't connect")
