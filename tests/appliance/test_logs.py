"""The log: one line an event, and floods held back without losing their number."""

from __future__ import annotations

import json
import logging

import pytest

from holdfast import logs


def record(**fields: object) -> logging.LogRecord:
    made = logging.LogRecord("holdfast", logging.WARNING, "", 0, "refused", (), None)
    made.fields = fields
    made.created, made.msecs = 0.25, 250
    return made


def test_text_has_time_level_event_and_fields() -> None:
    line = logs.TextFormatter().format(record(listener="scada", peer="10.0.0.9:1"))
    assert line == "1970-01-01T00:00:00.250Z warning refused listener=scada peer=10.0.0.9:1"


@pytest.mark.parametrize("value", ["a b", "a=b", 'a"b', "a\nb", ""])
def test_a_field_that_could_be_mistaken_is_quoted(value: str) -> None:
    line = logs.TextFormatter().format(record(name=value))
    assert line.endswith(f"name={json.dumps(value)}")


def test_json_has_the_same_fields() -> None:
    line = json.loads(logs.JsonFormatter().format(record(listener="scada", count=3)))
    assert line == {
        "time": "1970-01-01T00:00:00.250Z",
        "level": "warning",
        "event": "refused",
        "listener": "scada",
        "count": 3,
    }


def test_what_was_held_back_is_told_even_if_nothing_follows(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    throttle = logs.Throttle(burst=2, window=10)
    for now in (0.0, 1.0, 2.0, 3.0):
        throttle.admit("a", now)
    throttle.admit("b", 0.0)
    assert throttle.over(9.9) == []
    assert throttle.over(10.0) == [("a", 2)]
    # It begins anew.
    assert throttle.over(30.0) == []
    assert throttle.admit("a", 11.0) == (True, 0)

    throttle = logs.Throttle(burst=1, window=3600)
    monkeypatch.setattr(logs, "_REFUSALS", throttle)
    for _ in range(4):
        logs.refused("refused_source", kind=("scada", None))
    logs.tell_held_back()
    throttle._window = 0
    logs.tell_held_back()
    [told] = [vars(each)["fields"] for each in caplog.records if each.message == "held_back"]
    assert told == {"of": "refused_source", "kind": "scada", "count": 3}


def test_a_flood_is_held_back_and_its_number_told() -> None:
    throttle = logs.Throttle(burst=2, window=10.0)
    assert [throttle.admit("kind", now) for now in (0.0, 1.0, 2.0, 3.0)] == [
        (True, 0),
        (True, 0),
        (False, 0),
        (False, 0),
    ]
    assert throttle.admit("other", 3.0) == (True, 0)
    assert throttle.admit("kind", 10.0) == (True, 2)
    assert throttle.admit("kind", 21.0) == (True, 0)
