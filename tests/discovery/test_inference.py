"""What registers are guessed to be: values as plants have them are recognised."""

from __future__ import annotations

import json
import math
import random
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from holdfast import values
from holdfast.discovery.type_guess import guess
from support import plant_data
from support.paths import ROOT

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.discovery.type_guess import Guess

NOW = 1_764_064_800.0
"""2025-11-25 10:00 UTC."""

ORDERS = ("ABCD", "CDAB", "BADC", "DCBA")
COMMON = ("ABCD", "CDAB")


def reads(kind: str, order: str, *found: Any, size: int = 4) -> list[list[int]]:
    """Reads in which a value of a type was found, with another value of the device behind it."""
    behind = values.encode(found[0] + 1, kind, order)
    return [(values.encode(each, kind, order) + behind)[:size] for each in found]


def place(guesses: Sequence[Guess], kind: str, order: str) -> int:
    """The rank of a type in an order, 1 the best; that it is there is taken for granted."""
    ranks = [
        rank
        for rank, each in enumerate(guesses, 1)
        if kind in (each.type, each.also) and each.order == order
    ]
    return ranks[0]


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize(
    ("kind", "found"),
    [
        ("float32", (21.5,)),
        ("float32", (230.1, 230.4, 229.9)),
        ("float32", (21.534217, 21.55123, 21.61234)),
        ("float32", (0.1,)),
        ("float32", (-7.25, -7.5)),
        ("float32", (49.98, 50.01)),
        ("float64", (21.534217123, 21.55123, 21.61234)),
        ("float64", (1013.25, 1013.5)),
    ],
)
def test_a_float_is_recognised_in_every_order(
    kind: str, found: tuple[float, ...], order: str
) -> None:
    guesses = guess(reads(kind, order, *found))
    rank = place(guesses, kind, order)
    assert rank == 1 if order in COMMON else rank <= 3
    assert guesses[rank - 1].values == pytest.approx(found, rel=1e-6)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize(
    ("kind", "found"),
    [
        ("int32", (100000, 100001, 100003)),
        ("uint32", (1234567, 1234667)),
        ("int32", (-5,)),
    ],
)
def test_a_long_integer_is_among_the_first(kind: str, found: tuple[int, ...], order: str) -> None:
    guesses = guess(reads(kind, order, *found))
    assert place(guesses, kind, order) <= 5


@pytest.mark.parametrize(
    ("kind", "found"),
    [("uint16", (215,)), ("uint16", (2150, 2151, 2149)), ("int16", (-5, -6)), ("int16", (-5,))],
)
def test_a_single_register_is_recognised(kind: str, found: tuple[int, ...]) -> None:
    best = guess([[each, 1234, 17, 0x9000] for each in [each & 0xFFFF for each in found]])[0]
    assert kind in (best.type, best.also)
    assert (best.order, best.values) == ("ABCD", found)


@pytest.mark.parametrize("order", ["ABCD", "BADC"])
def test_text_is_recognised(order: str) -> None:
    best = guess([values.encode("PUMP-01", "string:8", order)])[0]
    assert (best.type, best.order, best.values) == ("string:8", order, ("PUMP-01",))
    assert "printable text" in best.reasons


def test_text_ends_where_something_else_begins() -> None:
    best = guess([[*values.encode("BOILER", "string:6"), 0x0001, 0x9000]])[0]
    assert (best.type, best.values) == ("string:6", ("BOILER",))


@pytest.mark.parametrize("registers", [[0x2020, 0x2020], [0x4142], [0, 0], [0xFFFF, 0xFFFF]])
def test_what_is_no_text_is_not_taken_for_one(registers: list[int]) -> None:
    assert not any(each.type.startswith("string") for each in guess([registers]))


def test_signed_and_unsigned_are_one_guess_where_they_say_the_same() -> None:
    found = guess([[100], [200]])
    best = found[0]
    assert (best.type, best.also) == ("uint16", "int16")
    assert not any(each.type == "int16" and each.order == "ABCD" for each in found)
    found = guess([[100], [40000]])
    kinds = {each.type: each for each in found if each.order == "ABCD"}
    assert kinds["uint16"].also is None
    assert kinds["int16"].values == (100, 40000 - 65536)


def test_bcd_is_a_guess_only_where_all_digits_are_decimal() -> None:
    assert any(each.type == "bcd16" for each in guess([[0x1234], [0x9999]]))
    assert not any(each.type == "bcd16" for each in guess([[0x1234], [0x123A]]))


def test_a_type_needs_its_registers() -> None:
    kinds = {each.type for each in guess([[1, 2]])}
    assert {"uint16", "uint32", "float32"} <= kinds
    assert not kinds & {"uint64", "float64"}


def test_a_known_value_decides() -> None:
    best = guess(reads("float32", "CDAB", 21.53), like=21.5)[0]
    assert (best.type, best.order, best.scale) == ("float32", "CDAB", 1)
    assert best.reasons[0] == "0.14 % off"


@pytest.mark.parametrize(("scale", "raw"), [(1, 215), (0.1, 2150), (0.01, 21500), (10, 21)])
def test_a_known_value_may_be_scaled(scale: float, raw: int) -> None:
    best = guess([[raw, 0x9234]], like=raw * scale)[0]
    assert (best.type, best.scale, best.reasons[0]) == ("uint16", scale, "equal")


def test_a_known_value_is_found_anywhere() -> None:
    registers = [9, 9, *values.encode(-17.25, "float32", "CDAB"), 9, 9]
    assert guess([registers], like=-17.25) == []
    best = guess([registers], like=-17.25, anywhere=True)[0]
    assert (best.type, best.order, best.offset) == ("float32", "CDAB", 2)


def test_a_known_value_may_be_that_of_any_read() -> None:
    best = guess(reads("float32", "ABCD", 20.0, 30.0, 40.0), like=30)[0]
    assert (best.values, best.reasons[0]) == ((20.0, 30.0, 40.0), "equal")


def test_zero_can_be_known() -> None:
    assert guess([[0, 0]], like=0)[0].reasons[0] == "equal"


@given(
    found=st.lists(st.lists(st.integers(0, 65535), min_size=4, max_size=4), min_size=1, max_size=4),
    anywhere=st.booleans(),
    like=st.none() | st.floats(-1e6, 1e6),
)
def test_every_guess_is_what_the_registers_hold(
    found: list[list[int]], anywhere: bool, like: float | None
) -> None:
    guesses = guess(found, anywhere=anywhere, like=like)
    scores = [each.score for each in guesses]
    assert scores == sorted(scores, reverse=True)
    assert all(0 <= score <= 1 for score in scores)
    for each in guesses:
        size = values.register_count(each.type)
        held = [read[each.offset : each.offset + size] for read in found]
        assert each.values == tuple(values.decode(raw, each.type, each.order) for raw in held)
        assert not any(isinstance(v, float) and not math.isfinite(v) for v in each.values)
    if like is None:
        assert {"uint16", "int16"} & {each.type for each in guesses}


CASES = json.loads((ROOT / "tests" / "vectors" / "guess.json").read_text())["cases"]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case["name"])
def test_values_of_usual_devices_are_recognised(case: dict[str, Any]) -> None:
    best = guess(case["reads"])[0]
    assert case["type"] in (best.type, best.also)
    assert best.order == case["order"]


def test_most_random_values_are_recognised_and_nearly_all_are_among_the_first_three() -> None:
    ranks = []
    for seed in range(300):
        sample = plant_data.sample(random.Random(f"device {seed}"))
        names = [(each.also or each.type, each.type, each.order) for each in guess(sample.reads)]
        ranks.append(
            next(at for at, each in enumerate(names, 1) if _is(sample.kind, sample.order, each))
        )
    assert ranks.count(1) >= 0.85 * len(ranks)
    assert sum(rank <= 3 for rank in ranks) >= 0.97 * len(ranks)


def _is(kind: str, order: str, guessed: tuple[str, str, str]) -> bool:
    if kind.startswith("string"):
        return guessed[1].startswith("string") and guessed[2] == "ABCD"
    return kind in guessed[:2] and order == guessed[2]


@given(st.integers(0, 9999), st.integers(0, 9999))
@example(8192, 8192)  # bcd16, because the decimal number has few bits set
@example(5460, 5460)  # float16, because 70.0 has few digits
@example(5100, 6394)
def test_a_rare_type_needs_evidence(first: int, second: int) -> None:
    registers = [int(str(first), 16), int(str(second), 16), 0, 0]
    if any(registers):
        best = guess([registers])[0]
        assert not best.type.startswith("bcd")
        assert best.type != "float16"


def test_decimal_digits_that_count_are_evidence() -> None:
    best = guess([values.encode(each, "bcd32") * 2 for each in (899, 912, 1003, 1101)])[0]
    assert (best.type, best.order) == ("bcd32", "ABCD")


def test_a_clock_is_recognised_by_the_time() -> None:
    now = 1_795_341_600.0
    seconds = [int(now) - 2, int(now) - 1, int(now)]
    found = guess([[*values.encode(each, "uint32"), 0, 0] for each in seconds], now=now)[0]
    assert (found.type, found.reasons[0]) == ("uint32", "the current Unix time")


def test_voltages_in_tenths_are_no_clock() -> None:
    """2307, 2321, 2325 are also 15 September 2015, 09:03:09, in decimal digits."""
    for reads_ in ([[2307, 2321, 2325, 4998]] * 5, [[2307, 2321, 2325, 0]]):
        for now in (None, NOW):
            best = guess(reads_, now=now)[0]
            assert (best.type, best.also) == ("uint16", "int16")


@pytest.mark.parametrize("seconds", [[0x5930] * 5, [0x5930, 0x5930, 0x5931, 0x5931, 0x5932]])
def test_a_clock_in_decimal_digits_is_recognised_if_it_shows_the_present_or_advances(
    seconds: list[int],
) -> None:
    is_still = seconds[0] == seconds[-1]
    found = [[0x2511, 0x2510, each] for each in seconds]
    assert guess(found, now=NOW if is_still else None)[0].type == "bcd16"
    assert (guess(found)[0].type == "bcd16") is not is_still


@pytest.mark.parametrize("order", COMMON)
@pytest.mark.parametrize("number", [0xC0A80A64, 0x44A024DA, 0x43A1B2C3, 0x41F21A33])
@pytest.mark.parametrize("behind", [[0, 0], [0, 17]])
def test_a_constant_number_is_not_surely_a_float(
    number: int, order: str, behind: list[int]
) -> None:
    """An address, a status word, serial numbers: their bits are also floats of usual size."""
    best = guess([values.encode(number, "uint32", order) + behind] * 5)[0]
    assert best.type != "float32" or best.score < 0.9


def test_two_constant_floats_of_one_order_are_recognised() -> None:
    found = values.encode(230.41, "float32", "CDAB") + values.encode(231.87, "float32", "CDAB")
    best = guess([found] * 5)[0]
    assert (best.type, best.order) == ("float32", "CDAB")
    assert best.score > 0.9


def test_text_that_goes_on_has_no_sure_length() -> None:
    best = guess([values.encode("Delta Meter", "string:12")[:4]])[0]
    assert best.type == "string:8"
    assert best.score < 0.6


def test_zeros_say_nothing_about_a_type() -> None:
    for registers in ([0, 0, 0, 0], [0, 230, 0, 0]):
        zeros = [each for each in guess([registers] * 5) if not any(each.values)]
        assert zeros
        assert all(each.score <= 0.3 for each in zeros)


@pytest.mark.parametrize("found", [[], [[]], [[1], [1, 2]]])
def test_reads_without_registers_or_of_other_sizes_are_refused(found: list[list[int]]) -> None:
    with pytest.raises(ValueError, match="all reads require the same number of registers"):
        guess(found)
