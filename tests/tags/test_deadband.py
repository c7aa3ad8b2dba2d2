"""Whether a value has changed, so that it is published."""

from __future__ import annotations

import math
from typing import Any

import pytest

from holdfast.tags.deadband import differs


@pytest.mark.parametrize(
    ("value", "last", "deadband"),
    [
        (21.5, 21.0, 0.5),
        (21.0, 21.5, 0.5),
        (-1, 1, 2),
        (1, 1.0, 0),
        (math.inf, math.inf, 0),
        (True, True, 0),
        ("off", "off", 5),
        (None, None, 0),
        ([1, 20.5], [1.5, 20.0], 0.5),
        *((step / 10, (step + 1) / 10, 0.1) for step in (2, 3, 7, 2300)),
        (1e20, 1e20, 0.1),
        (2**64, 2**64 + 10, 10),
        ([], [], 0),
    ],
    ids=repr,
)
def test_a_value_within_the_deadband_has_not_changed(
    value: Any, last: Any, deadband: float
) -> None:
    assert differs(value, last, deadband) is False


@pytest.mark.parametrize(
    ("value", "last", "deadband"),
    [
        (21.75, 21.0, 0.5),
        (0.3, 0.2, 0.0999),
        (0.3, 0.2, 0.09999999999999999),
        (1e20, 1e20 + 16384, 0.1),
        (2**64, 2**64 + 11, 10),
        (20.25, 21.0, 0.5),
        (2, 1, 0),
        (-1, 1, 1.5),
        (math.inf, -math.inf, 5),
        (math.inf, 5, 5),
        (True, False, 5),
        (5, False, 10),
        (True, 5, 10),
        ("off", "on", 5),
        (5, None, 10),
        (None, 5.0, 10),
        (None, [1], 10),
        ([1], None, 10),
        ([1, 3], [1, 1], 1),
        ([3, 1], [1, 1], 1),
    ],
    ids=repr,
)
def test_a_value_beyond_the_deadband_or_of_another_kind_has_changed(
    value: Any, last: Any, deadband: float
) -> None:
    assert differs(value, last, deadband) is True
