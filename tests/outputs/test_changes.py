"""What an output publishes when it publishes changes."""

from __future__ import annotations

from typing import Any

import pytest

from holdfast.outputs import Changes
from support.readings import reading, tag


def published(values: list[Any], heartbeat: float | None = None, **settings: Any) -> list[Any]:
    changes = Changes("change", heartbeat)
    of = tag(**settings)
    found = [changes.of([reading(value, at, tag=of)]) for at, value in enumerate(values)]
    return [each[0].value for each in found if each]


@pytest.mark.parametrize(
    ("values", "deadband", "expected"),
    [
        ([1, 1, 2, 2, 1], 0, [1, 2, 1]),
        ([10, 12, 15, 16, 9], 5, [10, 16, 9]),
        ([None, None, 3, None, 3], 5, [None, 3, None, 3]),
        ([True, True, False], 0, [True, False]),
        (["a", "a", "b"], 0, ["a", "b"]),
        ([[1, 1], [1, 1], [1, 2]], 0, [[1, 1], [1, 2]]),
        ([[1, 1], [3, 1], [1, 9]], 5, [[1, 1], [1, 9]]),
        ([[1, None], [1, 2]], 5, [[1, None], [1, 2]]),
        ([0, 4, 8, 12], 5, [0, 8]),
    ],
)
def test_a_value_is_published_when_it_has_changed(
    values: list[Any], deadband: float, expected: list[Any]
) -> None:
    settings: dict[str, Any] = {"deadband": deadband} if deadband else {}
    assert published(values, **settings) == expected


def test_an_unchanged_value_is_published_again_after_the_heartbeat() -> None:
    assert len(published([7] * 10, heartbeat=3)) == 4


def test_a_clock_that_goes_back_does_not_silence_a_tag() -> None:
    changes = Changes("change", 10)
    assert [len(changes.of([reading(1, at)])) for at in (1000, 1001, 5, 6)] == [1, 0, 1, 0]


def test_devices_and_tags_are_told_apart() -> None:
    changes = Changes("change", None)
    readings = [
        reading(1),
        reading(1, device="other"),
        reading(1, tag=tag("u")),
        reading(1),
    ]
    assert changes.of(readings) == readings[:3]
    changes.forget(["other"])
    assert changes.of(readings) == [readings[1]]
    changes.forget_tags([("pump", "u"), ("gone", "u")])
    assert changes.of(readings) == [readings[2]]


def test_every_reading_of_a_scan_is_published() -> None:
    readings = [reading(1), reading(1)]
    assert Changes("scan", None).of(readings) == readings
