"""`holdfast describe guess`, as people and programs use it."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import pytest

from holdfast import values
from support import cli
from support.cli import answer, done, failure, usage_error
from support.fake_device import FakeDevice

if TYPE_CHECKING:
    import holdfast

AT_ONCE = ("--every", "0.001")


def test_the_best_guess_is_first(server: holdfast.Server, memory: holdfast.Memory) -> None:
    memory.write("holding_registers", 100, [*values.encode(21.5, "float32", "CDAB"), 0x3A91, 7])
    head, empty, columns, best, *others = done(
        "describe", "guess", cli.url(server), "hr", "100", *AT_ONCE
    )
    assert head == "holding_registers 100 to 103: 0000 41AC 3A91 0007, the same in 5 reads"
    assert empty == ""
    assert columns.split() == ["score", "address", "type", "order", "value", "why"]
    assert best.split()[1:] == ["100", "float32", "CDAB", "21.5", "few", "digits"]
    assert len(others) == 9
    assert len(done("describe", "guess", cli.url(server), "hr", "100", *AT_ONCE, "--all")) > 13


def test_a_program_gets_all_guesses(server: holdfast.Server, memory: holdfast.Memory) -> None:
    memory.write("input_registers", 0, [215])
    found = answer("describe", "guess", cli.url(server), "ir", "0", "1", *AT_ONCE, "--times", "2")
    assert (found["ok"], found["area"], found["reads"]) == (True, "input_registers", [[215]] * 2)
    best = found["guesses"][0]
    assert (best["type"], best["also"], best["values"]) == ("uint16", "int16", [215, 215])
    assert {each["type"] for each in found["guesses"]} == {"uint16", "int16", "float16"}


def test_a_known_value_is_looked_for(server: holdfast.Server, memory: holdfast.Memory) -> None:
    memory.write("holding_registers", 41, [215])
    arguments = ("60", "--like", "21.5", "--anywhere", *AT_ONCE)
    _, _, columns, *best = done("describe", "guess", cli.url(server), "40001", *arguments)
    assert "times" in columns
    assert any(
        line.split()[1:9]
        == [
            "41",
            "uint16",
            "or",
            "int16",
            "ABCD",
            "0.1",
            "21.5",
            "equal",
        ]
        for line in best
    )
    assert done("describe", "guess", cli.url(server), "hr", "41", "--like", "99", *AT_ONCE)[-1] == (
        "No type matches that value."
    )


def test_what_changes_is_shown_from_the_first_to_the_last() -> None:
    numbers = itertools.count(2150)

    def counting(_: bytes) -> bytes:
        return bytes([3, 2]) + next(numbers).to_bytes(2)

    with FakeDevice(counting) as device:
        lines = done("describe", "guess", device.url, "hr", "0", "1", "--times", "3", *AT_ONCE)
    assert lines[0] == "holding_registers 0 to 0: 0868, 3 reads"
    assert lines[3].split()[-5:] == ["2150", "…", "2152", "changes", "smoothly"]


def test_fewer_registers_are_looked_at_where_there_are_no_more(
    server: holdfast.Server, memory: holdfast.Memory
) -> None:
    memory.write("holding_registers", 997, [1, 2, 3])
    [head, *_] = done("describe", "guess", cli.url(server), "hr", "997", *AT_ONCE)
    assert head.startswith("holding_registers 997 to 999: 0001 0002 0003")
    [head, *_] = done("describe", "guess", cli.url(server), "hr", "998", "2", *AT_ONCE)
    assert head.startswith("holding_registers 998 to 999")


def test_nothing_is_guessed_from_zeros(server: holdfast.Server) -> None:
    assert done("describe", "guess", cli.url(server), "hr", "0", *AT_ONCE)[-1] == (
        "All registers are 0: every type decodes to 0."
    )


def test_errors_are_told(server: holdfast.Server) -> None:
    url = cli.url(server)
    assert failure("describe", "guess", url, "hr", "1000") == [
        f"holdfast: {url}: exception 02 (Illegal Data Address)",
        f"hint: 'holdfast describe map {url}' finds the addresses that exist",
    ]
    assert failure("describe", "guess", url, "hr", "999", "2")
    assert answer("describe", "guess", url, "hr", "1000", code=1)["code"] == 2


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("co", "0"), "coils contain bits; guess requires registers."),
        (("hr", "0", "4", "5"), "Got unexpected extra argument (5)."),
        (("hr", "65535", "2"), "the last address is 65535"),
        (("hr", "0", "--like", "nan"), "--like requires a finite number."),
    ],
)
def test_wrong_usage_is_told(server: holdfast.Server, words: tuple[str, ...], told: str) -> None:
    assert told in usage_error("describe", "guess", cli.url(server), *words)
