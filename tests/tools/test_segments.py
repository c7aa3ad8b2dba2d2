"""Registers are divided into values without gaps and overlaps."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from holdfast import values
from holdfast.tools.clock_fields import length
from holdfast.tools.segments import divide
from support.cases import examples


@given(
    st.lists(st.lists(st.integers(0, 65535), min_size=9, max_size=9), min_size=1, max_size=3),
)
@settings(max_examples=examples(50))
def test_every_register_belongs_to_one_value(reads: list[list[int]]) -> None:
    division = divide(reads)
    at = 0
    for value, chance in division.best:
        assert value.offset == at
        assert 0 <= chance <= 1
        at += value.registers
    assert at == 9
    for starting in division.starting:
        assert sum(chance for _, chance in starting) == pytest.approx(1)


@pytest.mark.parametrize("order", ["ABCD", "CDAB"])
def test_values_of_several_types_are_told_from_each_other(order: str) -> None:
    kinds = ["float32", "float32", "uint32", "uint16", "int16", "string:8"]
    reads: list[list[int]] = []
    for found in (
        [230.134, 49.985, 1234567, 455, -55, "PUMP-01"],
        [230.417, 50.004, 1234581, 457, -56, "PUMP-01"],
        [229.891, 49.991, 1234588, 457, -55, "PUMP-01"],
    ):
        registers: list[int] = []
        for kind, value in zip(kinds, found, strict=True):
            registers += values.encode(value, kind, "ABCD" if kind == "string:8" else order)
        reads.append(registers)
    division = divide(reads)
    assert [value.type for value, _ in division.best] == kinds
    assert {value.order for value, _ in division.best if value.registers == 2} == {order}
    assert all(chance > 0.5 for _, chance in division.best)
    assert division.shares[order] > 0.9


def test_a_value_of_the_other_common_order_is_recognised() -> None:
    reads = []
    for volts, energy in ((230.1369, 1234567), (230.4122, 1234571), (229.9817, 1234579)):
        behind = [value for each in (4.9, 5.1) for value in values.encode(each, "float32", "CDAB")]
        own = values.encode(volts, "float32", "CDAB")
        reads.append([*own, *behind, *[0] * 9, *values.encode(energy, "uint32")])
    found = {value.offset: (value.type, value.order) for value, _ in divide(reads).best}
    assert (found[0], found[15]) == (("float32", "CDAB"), ("uint32", "ABCD"))


def test_registers_that_contain_nothing_are_one_value() -> None:
    [(value, _), (one, _)] = divide([[0] * 20 + [455]]).best
    assert (value.type, value.registers, value.reasons) == ("uint16", 20, ("always 0",))
    assert (one.type, one.found) == ("uint16", (455,))


@pytest.mark.parametrize(
    ("registers", "size"),
    [
        ([0x2026, 0x1122, 0x0959, 0x3100], 4),
        ([0x2026, 0x1122, 0x0959], 3),
        ([0x2611, 0x2209, 0x5930], 3),
        ([0x5930, 0x1022, 0x1126], 3),
        ([0x2613, 0x2209, 0x5930], 0),
        ([0x2611, 0x2209, 0x593A], 0),
        ([0x2611, 0x2209], 0),
        ([0, 0, 0], 0),
    ],
)
def test_a_date_and_time_in_decimal_digits_is_recognised(registers: list[int], size: int) -> None:
    assert length(registers) == size
