"""Registers are divided into values without gaps and overlaps."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from holdfast import values
from holdfast.discovery import byte_order_habits, clock_fields
from holdfast.discovery.segments import confidence, divide
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
    assert byte_order_habits.order_shares(division.habits)[order] > 0.9


def test_a_value_of_the_other_common_order_is_recognised() -> None:
    reads = []
    for volts, energy in ((230.1369, 1234567), (230.4122, 1234571), (229.9817, 1234579)):
        behind = [value for each in (4.9, 5.1) for value in values.encode(each, "float32", "CDAB")]
        own = values.encode(volts, "float32", "CDAB")
        reads.append([*own, *behind, *[0] * 9, *values.encode(energy, "uint32")])
    found = {value.offset: (value.type, value.order) for value, _ in divide(reads).best}
    assert (found[0], found[15]) == (("float32", "CDAB"), ("uint32", "ABCD"))


def texts(*fields: tuple[str, int]) -> list[tuple[str, float]]:
    """What texts in fields of these lengths are divided into, with numbers behind them."""
    registers = [each for text, size in fields for each in values.encode(text, f"string:{size}")]
    division = divide([[*registers, 455, 600]] * 3, is_open=False)
    return [(value.type, chance) for value, chance in division.best if value.kind == "string"]


@pytest.mark.parametrize(
    ("first", "second"), [("iEM-3155", "V2.13"), ("20240312", "V1.02"), ("SN123456", "ACME")]
)
def test_text_without_padding_may_be_two_texts(first: str, second: str) -> None:
    [(_, chance), *_] = texts((first, 8), (second, 8))
    assert confidence(chance) < 0.9


@pytest.mark.parametrize("padding", ["", " " * 8])
def test_padding_separates_texts(padding: str) -> None:
    found = texts((f"Voltwerk{padding}", 16), ("PM5000", 8))
    assert [kind for kind, _ in found] == ["string:16", "string:8"]
    assert all(confidence(chance) > 0.9 for _, chance in found)


def test_neighbours_of_one_type_are_alike() -> None:
    """Three voltages in tenths are three numbers; the last two alone may be one."""
    [(value, alone), *_] = divide([[2321, 2325]]).best
    [(_, _), (second, beside), *_] = divide([[2307, 2321, 2325]]).best
    assert (value.type, second.type) == ("uint16", "uint16")
    assert beside > alone


def test_a_negative_number_is_no_other_type_than_its_neighbours() -> None:
    division = divide([[215, 230, 0xC000, 221, 198]] * 3)
    assert confidence(division.best[2][1]) < 0.9


def test_single_registers_of_a_device_have_their_bytes_swapped_together() -> None:
    volts = [2307, 2321, 2325, 2318, 2299, 2310]
    reads = [[values.encode(each + turn, "uint16", "BADC")[0] for each in volts] for turn in (0, 1)]
    assert {(value.type, value.order) for value, _ in divide(reads).best} == {("uint16", "BADC")}


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
    clock = clock_fields.description([registers], None)
    assert (clock[1] if clock else 0) == size


def test_registers_that_contain_nothing_are_no_reason_for_the_type_before_them() -> None:
    """A small number of two registers may have its high word behind it: that is no single one."""
    best, *_ = divide([[2291, 0, 0, 0]] * 5).starting[0]
    assert (best[0].type, best[0].order) == ("uint16", "ABCD")
    assert confidence(best[1]) < 0.9


def test_evident_long_values_tell_something_about_small_ones() -> None:
    """What is before counters of two registers more probably has two registers as well."""
    chances = []
    for count in (0, 6):
        reads = []
        for turn in range(3):
            words = [*values.encode(230 + turn, "uint32"), *values.encode(16, "uint32"), 455, 17]
            for counter in range(count):
                words += values.encode(1234567 * (counter + 1) + 7 * turn, "uint32")
            reads.append(words)
        found = {(each.type, each.order): sure for each, sure in divide(reads).starting[2]}
        chances.append(found["uint32", "ABCD"])
    assert chances[1] > chances[0] + 0.05


def test_the_best_division_follows_the_probabilities_of_all_habits() -> None:
    reads = [[0, 230 + turn, 0, 17, 2306, 2310 + turn] for turn in range(3)]
    division = divide(reads)
    registers = sum(value.registers * chance for value, chance in division.best)
    single = sum(
        next(chance for value, chance in division.starting[at] if value.type == "uint16")
        for at in range(2)
    )
    assert registers > single


def test_confidence_in_a_float_is_higher_than_in_the_length_of_a_text() -> None:
    assert confidence(0.95, "float32") > confidence(0.95) > confidence(0.95, "string")
