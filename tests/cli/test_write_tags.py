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
            "hint: mode was possibly written",
            "Not written: pump",
        ]
        assert len(device.asked) == 2
        found = answer("write", device.url, *words, *tags, code=1)
        assert found["written"] == ["setpoint"]
        assert (found["failed"], found["not_written"]) == ("mode", ["pump"])
        assert (found["maybe_written"], found["code"]) == (True, 4)


def test_a_write_without_a_reply_was_possibly_carried_out(tags: tuple[str, str]) -> None:
    with FakeDevice(lambda _: None) as device:
        arguments = ("write", device.url, "pump=run", *tags, "--timeout", "0.02")
        assert failure(*arguments)[1] == "hint: pump was possibly written"
        assert answer(*arguments, code=1)["maybe_written"]


@pytest.mark.parametrize("code", [0x05, 0x0B])
def test_an_exception_can_leave_it_open_whether_a_write_was_carried_out(
    tags: tuple[str, str], code: int
) -> None:
    with FakeDevice(lambda pdu: exception(pdu, code)) as device:
        arguments = ("write", device.url, "pump=run", *tags)
        assert failure(*arguments)[1] == "hint: pump was possibly written"
        assert answer(*arguments, code=1)["maybe_written"]


def test_what_can_not_be_read_back_is_written(tags: tuple[str, str]) -> None:
    with FakeDevice(lambda pdu: pdu if pdu[0] in (5, 6) else exception(pdu, 1)) as device:
        found = answer("write", device.url, "pump=run", *tags, "--verify", code=1)
    assert (found["written"], found["maybe_written"]) == (["pump"], False)


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


SCALED = """
tags:
  limit: {area: holding_registers, address: 0, scale: {from: sf, as: exponent}, writable: true,
          unit: W}
  sf: {area: holding_registers, address: 5, type: int16, writable: true}
"""


@pytest.fixture
def scaled(tmp_path: Path) -> tuple[str, str]:
    file = tmp_path / "inverter.yaml"
    file.write_text(SCALED)
    return "--tags", str(file)


def test_a_scale_in_a_register_is_read_before_the_write(
    server: holdfast.Server, memory: holdfast.Memory, scaled: tuple[str, str]
) -> None:
    words = ("write", cli.url(server), "limit=4320", *scaled)
    for exponent, number in ((0, 4320), (1, 432), (0xFFFF, 43200)):
        memory.write("holding_registers", 5, [exponent])
        assert done(*words, "--verify")[-1] == "Read back alike."
        assert memory.read("holding_registers", 0, 1) == [number]
    memory.write("holding_registers", 5, [2])
    assert "4320 is between two values of the registers, allowed: steps of 100" in usage_error(
        *words
    )
    memory.write("holding_registers", 5, [0x8000])
    assert "limit: the scale in holding_registers 5 is 10^-32768" in usage_error(*words)
    assert "which has to be read first" in usage_error(*words, "--dry-run")
    changed = usage_error(*words, "sf=1")
    assert "limit: sf changes its scale, allowed: one write after the other" in changed
    assert memory.read("holding_registers", 0, 1) == [43200]


@pytest.mark.parametrize("kind", ["float16", "float32", "float64"])
def test_floats_with_a_scale_in_a_register_are_read_back_alike(
    server: holdfast.Server, memory: holdfast.Memory, tmp_path: Path, kind: str
) -> None:
    file = tmp_path / "inverter.yaml"
    file.write_text(SCALED.replace("address: 0,", f"address: 0, type: {kind},"))
    memory.write("holding_registers", 5, [0xFFFF])
    for text in ("0.01", "-4.32", "0.3", "1"):
        words = ("write", cli.url(server), f"limit={text}", "--tags", str(file), "--verify")
        assert done(*words)[-1] == "Read back alike."


def test_a_scale_that_moves_during_a_write_is_noticed(scaled: tuple[str, str]) -> None:
    scales = iter([0, 1])

    def moving(pdu: bytes) -> bytes:
        if pdu[0] == 6:
            return pdu
        first, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
        whole = {0: 4320, 5: next(scales)}
        content = [whole.get(each, 0).to_bytes(2) for each in range(first, first + count)]
        return bytes([3, 2 * count]) + b"".join(content)

    with FakeDevice(moving) as device:
        found = invoke("write", device.url, "limit=4320", *scaled, "--verify")
    assert found.exit_code == 1
    assert "holdfast: limit: read back 43200" in found.stderr
