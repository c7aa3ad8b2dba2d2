"""What `guess` and `describe` claim with confidence is true."""

from __future__ import annotations

import pytest

from calibration import judge, tuning
from holdfast.discovery.segments import confidence

BLOCKS = range(0, 300, 12)
"""The blocks of the tuning half that are judged in every run: about 300 values."""


@pytest.fixture(scope="module")
def claims() -> list[judge.Claim]:
    return judge.judged(map(tuning.case, BLOCKS))


def test_at_most_two_percent_of_sure_claims_are_wrong(claims: list[judge.Claim]) -> None:
    sure = [each for each in claims if each.confidence >= judge.SURE and each.is_true is not None]
    wrong = judge.wrong(claims)
    assert len(sure) >= 200
    assert len(wrong) <= 0.02 * len(sure), "\n".join(map(str, wrong))


def test_the_tuning_half_is_well_formed_and_always_the_same() -> None:
    made = list(tuning.cases(40))
    for case in made:
        case.check()
    assert made == list(tuning.cases(40))
    assert {case.live for case in made} == {True, False}


def test_confidence_is_in_the_order_of_probability() -> None:
    chances = [0.0, 1e-12, 0.2, 0.5, 0.9, 0.99, 1.0]
    found = [confidence(each) for each in chances]
    assert found == sorted(found)
    assert (found[0], found[3], found[-1]) == (0.0, 0.5, 1.0)
    assert confidence(0.95) < 0.95
