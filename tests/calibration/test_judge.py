"""The judge of claims about blocks, with planted claims, and the form of the judging corpus."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from random import Random
from typing import TYPE_CHECKING

import pytest

from calibration import judge, judging
from calibration.blocks import Device as Made
from calibration.blocks import Row as Value
from calibration.blocks import build, constant, empty, near
from calibration.cases import EMPTY, NOW, READS, Case, Truth
from calibration.judge import Claim, Row, verdict
from holdfast.discovery import description
from holdfast.discovery.described_tag import DescribedTag
from holdfast.discovery.description import Description
from holdfast.discovery.type_guess import Guess
from holdfast.values import encode

if TYPE_CHECKING:
    from collections.abc import Sequence


def block(*values: tuple[str, str, object], what: str = "value") -> Case:
    """A still block of values: type, order and content of each."""
    registers: list[int] = []
    truths = []
    for type, order, content in values:
        truths.append(Truth(len(registers), type, order, what))
        if type == EMPTY:
            assert isinstance(content, int)
            registers.append(content)
        else:
            registers += encode(content, type, order)
    return Case("block", "kind", False, [list(registers) for _ in range(READS)], truths)


def judgement(case: Case, offset: int, type: str, order: str = "ABCD") -> bool | None:
    return verdict(case, offset, type, order, len(case.reads[0]))


def test_a_claim_with_the_type_and_order_of_the_truth_is_true() -> None:
    case = block(("uint16", "ABCD", 7), ("float32", "CDAB", 230.5))
    assert judgement(case, 1, "float32", "CDAB") is True


@pytest.mark.parametrize(
    ("type", "order"), [("float32", "ABCD"), ("uint32", "CDAB"), ("uint16", "ABCD")]
)
def test_a_claim_of_another_type_or_order_or_size_is_wrong(type: str, order: str) -> None:
    assert judgement(block(("float32", "CDAB", 230.5)), 0, type, order) is False


def test_a_claim_that_begins_inside_a_value_is_wrong() -> None:
    assert judgement(block(("uint32", "ABCD", 70_000), ("uint16", "ABCD", 7)), 1, "uint32") is False


def test_a_number_that_takes_a_register_too_much_is_wrong_though_it_is_the_same() -> None:
    case = block(("uint16", "ABCD", 7), (EMPTY, "ABCD", 0))
    assert judgement(case, 0, "uint32", "CDAB") is False


def test_the_other_sign_is_true_if_all_reads_are_the_same_number_and_else_wrong() -> None:
    case = block(("int16", "ABCD", 230), ("int16", "ABCD", -230))
    assert judgement(case, 0, "uint16") is True
    assert judgement(case, 1, "uint16") is False


def test_one_read_with_another_number_makes_a_twin_wrong() -> None:
    case = block(("int16", "ABCD", 5))
    case.reads[3][0] = 0xFFFF
    assert judgement(case, 0, "uint16") is False


def test_an_order_without_effect_is_true() -> None:
    case = block(("uint32", "ABCD", 0x00050005))
    assert judgement(case, 0, "uint32", "CDAB") is True
    assert judgement(case, 0, "uint32", "DCBA") is False


def test_numbers_that_are_not_a_number_are_the_same_type_only() -> None:
    case = block(("float32", "ABCD", float("nan")))
    assert judgement(case, 0, "float32") is True
    assert judgement(case, 0, "uint32") is False


def test_bits_have_no_sign_and_each_of_their_registers_may_stand_alone() -> None:
    case = block(("uint32", "ABCD", 0x80000001), what="alarm bits")
    assert judgement(case, 0, "int32") is True
    assert judgement(case, 1, "uint16") is True
    assert judgement(case, 0, "uint32", "CDAB") is False
    assert judgement(block(("uint32", "ABCD", 0x80000001)), 0, "uint16") is False


def test_the_bytes_of_an_address_are_an_integer_of_this_size() -> None:
    case = block(("bytes:4", "ABCD", bytes([192, 168, 0, 7])))
    assert judgement(case, 0, "uint32") is True
    assert judgement(case, 0, "uint32", "CDAB") is False


def test_a_plain_integer_over_a_register_without_a_value_is_not_judged() -> None:
    case = block((EMPTY, "ABCD", 0), ("uint16", "ABCD", 50))
    assert judgement(case, 0, "uint16") is None
    assert judgement(case, 0, "uint32") is False


def test_an_array_is_judged_by_those_of_its_registers_that_have_a_value() -> None:
    case = block(
        (EMPTY, "ABCD", 0), ("uint16", "ABCD", 0), (EMPTY, "ABCD", 0), ("uint32", "ABCD", 0)
    )
    assert judgement(case, 0, "uint16[3]") is True
    assert judgement(case, 0, "uint16[1]") is None
    assert judgement(case, 0, "uint16[5]") is False


def test_a_text_is_true_if_it_is_whole_and_swallows_only_registers_without_a_value() -> None:
    case = block(("string:8", "ABCD", "PM5320"), (EMPTY, "ABCD", 0), ("string:4", "ABCD", "V1.2"))
    assert judgement(case, 0, "string:6") is True
    assert judgement(case, 0, "string:10") is True
    assert judgement(case, 0, "string:4") is False
    assert judgement(case, 0, "string:8", "BADC") is False
    assert judgement(case, 0, "string:14") is False
    followed_by_zero = block(("string:4", "ABCD", "V1.2"), ("uint16", "ABCD", 0))
    assert judgement(followed_by_zero, 0, "string:6") is False


def test_two_texts_that_are_claimed_as_one_are_wrong() -> None:
    case = block(("string:4", "ABCD", "AB12"), ("string:4", "ABCD", "CD34"))
    assert judgement(case, 0, "string:8") is False


def test_the_padding_of_a_text_has_no_value() -> None:
    case = block(("string:8", "ABCD", "PM53"))
    assert judgement(case, 2, "uint16") is None
    assert judgement(case, 1, "uint16") is False


def test_a_long_text_is_judged_by_the_registers_that_were_known() -> None:
    case = block(("string:20", "ABCD", "SMART-METER 5000"))
    assert verdict(case, 0, "string:8", "ABCD", 4) is True
    assert verdict(case, 0, "string:8", "ABCD", 10) is False


def test_a_guess_is_judged_with_its_other_name(monkeypatch: pytest.MonkeyPatch) -> None:
    case = block(("int16", "ABCD", -5), (EMPTY, "ABCD", 0), ("uint16", "ABCD", 9))
    windows = []

    def guess(reads: Sequence[Sequence[int]], *, now: float) -> list[Guess]:
        windows.append([list(read) for read in reads])
        assert now == NOW
        return [Guess("uint16", "ABCD", 0, (0,) * READS, 0.93, (), also="int16")]

    monkeypatch.setattr(judge, "guess", guess)
    claims = list(judge.of_guess(case))
    assert [(each.offset, each.is_true, each.confidence) for each in claims] == [
        (0, True, 0.93),
        (2, True, 0.93),
    ]
    assert windows == [[[0xFFFB, 0, 9]] * READS, [[9]] * READS]


def test_a_planted_false_description_is_counted_as_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    made = build(
        "meter", "kind",
        [*(Value("voltage", "float32", near(230, 0, 0.5)) for _ in range(8))],
        Made(Random(1)),
    )  # fmt: skip
    before = list(judge.of_describe(made))
    assert [each.is_true for each in before if each.confidence >= judge.SURE] == [True] * 8

    conclude = description.conclude

    def planted(found: Description, now: float) -> None:
        conclude(found, now)
        found.tags = [_with_order(each, "CDAB") for each in found.tags]

    monkeypatch.setattr(judge, "conclude", planted)
    after = list(judge.of_describe(made))
    assert [each.is_true for each in after] == [False] * 8
    assert not judge.held(after)
    assert len(judge.wrong(after)) == 8
    assert "float32 CDAB" in str(judge.wrong(after)[0])


def _with_order(described: DescribedTag, order: str) -> DescribedTag:
    return replace(described, tag=replace(described.tag, order=order))


def claims(*answers: tuple[float, bool | None]) -> list[Claim]:
    case = block(("uint16", "ABCD", 1))
    return [
        Claim(case, "guess", 0, "uint16", "ABCD", confidence, case.values[0], answer)
        for confidence, answer in answers
    ]


def test_buckets_count_claims_by_confidence_and_leave_out_what_is_not_judged() -> None:
    some = claims((0.0, True), (0.9, True), (0.949, False), (0.95, True), (1.0, True), (1.0, None))
    counted = {row.name: (row.count, row.true, row.wrong) for row in judge.buckets(some)}
    assert counted["0.00 to 0.30"] == (1, 1, 0)
    assert counted["0.90 to 0.95"] == (2, 1, 1)
    assert counted["0.95 to 0.99"] == (1, 1, 0)
    assert counted["0.99 to 1.00"] == (1, 1, 0)
    assert sum(count for count, _, _ in counted.values()) == 5


def test_sure_claims_are_counted_by_name() -> None:
    some = claims((0.89, False), (0.9, True), (0.99, False), (0.99, None))
    assert judge.by(some, lambda each: each.case.kind) == [Row("kind", 2, 1)]
    assert judge.by(some, lambda each: each.case.kind)[0].share == 0.5
    assert judge.wrong(some) == [some[2]]


def test_what_is_held_is_true_and_sure() -> None:
    assert judge.held(claims((0.95, True))) == {("block", 0, "guess")}
    assert not judge.held(claims((0.89, True), (0.95, False), (0.95, None)))


def test_a_case_whose_truths_do_not_cover_each_register_once_is_refused() -> None:
    case = block(("uint32", "ABCD", 1), ("uint16", "ABCD", 1))
    case.check()
    with pytest.raises(ValueError, match="required: each of the 3 registers once"):
        replace(case, values=case.values[:1]).check()
    with pytest.raises(ValueError, match="4 reads, required: 5"):
        replace(case, reads=case.reads[:4]).check()


def test_the_judging_corpus_is_the_same_in_every_run() -> None:
    assert judging.cases() == judging.cases()
    assert judging.cases(seed=1) != judging.cases()


def test_the_judging_corpus_has_the_shares_that_it_states() -> None:
    made = judging.cases()
    kinds = Counter(case.kind for case in made for truth in case.values if truth.type != EMPTY)
    total = sum(kinds.values())
    assert total >= 2500
    assert len({case.name for case in made}) == len(made)
    assert kinds["float meter"] + kinds["integer meter"] == pytest.approx(total / 4, rel=0.1)
    assert kinds["inverter"] == pytest.approx(total / 4, rel=0.1)
    assert kinds["building"] == pytest.approx(total / 8, rel=0.1)
    assert kinds["controller"] == pytest.approx(total / 9, rel=0.1)
    assert sum(case.live for case in made) / len(made) == pytest.approx(0.7, abs=0.05)


def test_a_still_device_does_not_change_and_an_idle_one_has_no_flow() -> None:
    rows = [Value("current", "uint16", near(500, 0, 50, idle=0)), *empty(1)]
    rows += [Value("limit", "uint16", constant(16))]
    for moves, idle, live in ((True, False, True), (False, False, False), (True, True, False)):
        made = build("one", "kind", rows, Made(Random(1), moves=moves, idle=idle))
        assert made.live is live
        assert (made.reads[0][0] == 0) is idle
