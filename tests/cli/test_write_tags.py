"""`holdfast write` with tags: what is written, and what is refused before anything is sent."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

import holdfast
from support import cli
from support.cli import answer, done, failure, invoke, usage_error
from support.fake_device import FakeDevice, exception, registers

if TYPE_CHECKING:
    from pathlib import Path

LIST = """
order: CDAB
tags:
  setpoint: {area: holding_registers, address: 0, type: int16, scale: 0.1, unit: "°C",
             writable: true, min: -10, max: 30}
  flow: {area: holding_registers, address: 2, type: float32, unit: m³/h, writable: true}
  mode: {area: holding_registers, address: 4, states: {0: off, 1: running}, writable: true}
  flag: {area: holding_registers, address: 5, type: "bit:3", writable: true}
  name: {area: holding_registers, address: 6, type: "string:8", writable: true}
  pump: {area: coils, address: 3, writable: true, states: {0: stop, 1: run}}
  power: {area: holding_registers, address: 12}
  limit: {area: holding_registers, address: 20, writable: true, "null": [200]}
  level: {area: input_registers, address: 0}
"""


@pytest.fixture
def tags(tmp_path: Path) -> tuple[str, str]:
    file = tmp_path / "boiler.yaml"
    file.write_text(LIST)
    return "--tags", str(file)


def test_tags_are_written_by_name(
    server: holdfast.Server, memory: holdfast.Memory, tags: tuple[str, str]
) -> None:
    memory.write("holding_registers", 5, [0b1001_0000])
    words = ("setpoint=-1.5", "flow=230.1", "mode=running", "flag=on", "name=P 1=a", "pump=run")
    assert done("write", cli.url(server), *words, *tags, "--verify") == [
        "Written: setpoint = -1.5 °C",
        "Written: flow = 230.1 m³/h",
        "Written: mode = running (1)",
        "Written: flag = true",
        "Written: name = P 1=a",
        "Written: pump = run (1)",
        "Read back alike.",
    ]
    assert memory.read("holding_registers", 0, 1) == [0x10000 - 15]
    flow = holdfast.values.encode(230.1, "float32", "CDAB")
    assert memory.read("holding_registers", 2, 2) == flow
    assert memory.read("holding_registers", 4, 2) == [1, 0b1001_1000]
    assert memory.read("coils", 3, 1) == [1]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("setpoint=21,5",), "setpoint: '21,5' has a decimal comma, allowed: a decimal point"),
        (("setpoint=31",), "setpoint: 31 is outside -10.0 to 30.0"),
        (("setpoint=21.53",), "setpoint: 21.53 is between two values of the registers"),
        (("setpoint=warm",), "setpoint: 'warm' is not a number."),
        (("mode=stopped",), "mode: 'stopped' is no state, allowed: off, running."),
        (("mode=70000",), "mode: 70000 is outside 0 to 65535 of uint16"),
        (("flow=1e40",), "flow: 1e+40 is outside"),
        (("pump=2",), "pump: '2' is not stop, run, true, false, on, off, 1 or 0."),
        (("name=much too long",), "name: "),
        (("power=1",), "power: not writable in the tag list."),
        (("level=1",), "level: input_registers can't be written."),
        (("setpiont=1",), "did you mean 'setpoint'?"),
        (("setpoint=1", "setpoint=2"), "setpoint: given twice."),
        (("setpoint",), "'setpoint' is not NAME=VALUE, as in setpoint=21.5."),
        (("--setpoint",), "No such option '--setpoint'."),
        ((), "Missing argument 'NAME=VALUE...'."),
        (("setpoint=1", "--split"), "can't be used with tags"),
    ],
)
def test_nothing_is_written_if_one_value_is_refused(
    tags: tuple[str, str], words: tuple[str, ...], told: str
) -> None:
    with FakeDevice(registers) as device:
        first = ("flag=1",) if words else ()
        assert told in usage_error("write", device.url, *first, *words, *tags)
        assert device.asked == []


def test_requests_can_be_shown_instead_of_sent(tags: tuple[str, str]) -> None:
    words = ("setpoint=21.5", "pump=run", "flag=off")
    assert done("write", "tcp://127.0.0.1:1", *words, *tags, "--dry-run") == [
        "06000000d7",
        "050003ff00",
        "160005fff70000",
    ]


def test_writing_ends_at_the_first_error(tags: tuple[str, str]) -> None:
    def answering(pdu: bytes) -> bytes:
        return exception(pdu, 4) if pdu[2] == 4 else pdu

    words = ("setpoint=1", "mode=off", "pump=run")
    with FakeDevice(answering) as device:
        result = invoke("write", device.url, *words, *tags)
        assert (result.exit_code, result.stdout) == (1, "Written: setpoint = 1.0 °C\n")
        assert result.stderr.splitlines() == [
            f"holdfast: {device.url}: mode: exception 04 (Server Device Failure)",
            "Not written: pump",
        ]
        assert len(device.asked) == 2
        found = answer("write", device.url, *words, *tags, code=1)
        assert found["written"] == ["setpoint"]
        assert (found["failed"], found["not_written"]) == ("mode", ["pump"])
        assert (found["maybe_written"], found["code"]) == (False, 4)


def test_a_write_without_a_reply_was_possibly_carried_out(tags: tuple[str, str]) -> None:
    with FakeDevice(lambda _: None) as device:
        arguments = ("write", device.url, "pump=run", *tags, "--timeout", "0.02")
        assert failure(*arguments)[1] == "hint: pump was possibly written"
        assert answer(*arguments, code=1)["maybe_written"]


def test_a_value_that_is_read_back_different_is_a_failure(tags: tuple[str, str]) -> None:
    def stubborn(pdu: bytes) -> bytes:
        return pdu if pdu[0] == 6 else registers(pdu, 200)

    with FakeDevice(stubborn) as device:
        arguments = ("write", device.url, "setpoint=21.5", *tags, "--verify")
        assert failure(*arguments) == ["holdfast: setpoint: read back 20.0"]
        other = ("write", device.url, "limit=1", *tags, "--verify")
        assert failure(*other) == ["holdfast: limit: read back no value"]
        found = answer(*arguments, code=1)
        assert (found["ok"], found["verified"]) == (False, False)
