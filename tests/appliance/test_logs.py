"""The log: one line an event, and floods held back without losing their number."""

from __future__ import annotations

import json
import logging

import pytest

from holdfast.events import log_lines
from holdfast.events.throttle import NOBODY, OTHERS, Origin, Throttle, origin


def record(**fields: object) -> logging.LogRecord:
    made = logging.LogRecord("holdfast", logging.WARNING, "", 0, "refused", (), None)
    made.fields = fields
    made.created, made.msecs = 0.25, 250
    return made


def test_text_has_time_level_event_and_fields() -> None:
    line = log_lines.LineFormatter("text").format(record(listener="scada", peer="10.0.0.9:1"))
    assert line == "1970-01-01T00:00:00.250Z warning refused listener=scada peer=10.0.0.9:1"


@pytest.mark.parametrize("value", ["a b", "a=b", 'a"b', "a\nb", ""])
def test_a_field_that_could_be_mistaken_is_quoted(value: str) -> None:
    line = log_lines.LineFormatter("text").format(record(name=value))
    assert line.endswith(f"name={json.dumps(value)}")


def test_json_has_the_same_fields() -> None:
    line = json.loads(log_lines.LineFormatter("json").format(record(listener="scada", count=3)))
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
    throttle = Throttle(burst=2, window=10)
    for now in (0.0, 1.0, 2.0, 3.0):
        throttle.admit("a", now)
    throttle.admit("b", 0.0)
    assert throttle.over(9.9) == []
    assert throttle.over(10.0) == [("a", NOBODY, 2)]
    # It begins anew.
    assert throttle.over(30.0) == []
    assert throttle.admit("a", 11.0) == (True, 0)

    throttle = Throttle(burst=1, window=3600)
    monkeypatch.setattr(log_lines, "_REFUSALS", throttle)
    for _ in range(4):
        log_lines.refused("refused_source", kind=("scada", None))
    log_lines.tell_held_back()
    assert not [each for each in caplog.records if each.message == "held_back"]
    log_lines.tell_held_back(all_of_them=True)
    [told] = [vars(each)["fields"] for each in caplog.records if each.message == "held_back"]
    assert told == {"of": "refused_source", "kind": "scada", "count": 3}


def test_what_an_own_limit_holds_back_is_told_while_there_is_one(
    caplog: pytest.LogCaptureFixture,
) -> None:
    def told() -> list[int]:
        records = [each for each in caplog.records if each.message == "held_back"]
        return [vars(each)["fields"]["count"] for each in records]

    def count(times: int) -> None:
        log_lines.count(logging.INFO, "event", {}, kind="a", times=times, throttle=throttle)

    throttle = Throttle(window=0.0)
    with log_lines.own_limit(throttle):
        count(4)
        log_lines.tell_held_back()
        assert told() == [3]
        count(3)
    assert told() == [3, 2]
    count(4)
    log_lines.tell_held_back(all_of_them=True)
    assert told() == [3, 2]


def test_a_flood_is_held_back_and_its_number_told() -> None:
    throttle = Throttle(burst=2, window=10.0)
    assert [throttle.admit("kind", now) for now in (0.0, 1.0, 2.0, 3.0)] == [
        (True, 0),
        (True, 0),
        (False, 0),
        (False, 0),
    ]
    assert throttle.admit("other", 3.0) == (True, 0)
    assert throttle.admit("kind", 10.0) == (True, 2)
    assert throttle.admit("kind", 21.0) == (True, 0)


NOISE = Origin("10.0.0.9")


def test_a_noisy_source_does_not_hide_others() -> None:
    throttle = Throttle(burst=20, window=10.0)
    assert sum(throttle.admit("kind", 0.0, NOISE)[0] for _ in range(1000)) == 20
    others = [Origin("10.0.0.9", "CN=a", "subject"), Origin("10.0.0.7"), Origin("10.0.0.8")]
    assert [throttle.admit("kind", 1.0, by) for by in others] == [(True, 0)] * 3
    assert [throttle.admit("kind", 2.0, by) for by in others] == [(False, 0)] * 3
    counts = {NOISE: 980, **dict.fromkeys(others, 1)}
    assert {by: count for _, by, count in throttle.over(11.0)} == counts


def test_events_that_were_counted_before_are_held_back_except_one() -> None:
    throttle = Throttle(burst=20, window=10.0)
    assert throttle.admit("kind", 0.0, NOISE, times=100) == (True, 0)
    assert throttle.admit("kind", 10.0, NOISE) == (True, 99)


def test_sources_and_subjects_beyond_the_table_are_counted_together() -> None:
    throttle = Throttle(burst=0, window=10.0, most=8, of_source=2)
    for subject in range(100):
        throttle.admit("kind", 0.0, Origin("10.0.0.9", f"CN={subject}", "subject"), times=2)
    for source in range(100):
        throttle.admit("kind", 0.0, Origin(f"10.0.1.{source}"), times=2)
    assert {by: count for _, by, count in throttle.over(10.0)} == {
        Origin("10.0.0.9", "CN=0", "subject"): 1,
        Origin("10.0.0.9", "CN=1", "subject"): 1,
        Origin("10.0.0.9", OTHERS, "subject"): 98 * 2 - 1,
        **{Origin(f"10.0.1.{source}"): 1 for source in range(5)},
        Origin(OTHERS): 95 * 2 - 1,
    }
    # The table has room again.
    assert throttle.admit("kind", 11.0, Origin("10.0.1.99")) == (True, 0)
    assert throttle.over(11.0) == []
    assert throttle.rest() == []


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({"peer": "10.0.0.9:51200"}, Origin("10.0.0.9")),
        ({"peer": "[2001:db8::9]:51200"}, Origin("2001:db8::/64")),
        ({"peer": "[2001:db8:0:0:ffff::1]:1"}, Origin("2001:db8::/64")),
        ({"peer": "2001:db8::9"}, Origin("2001:db8::/64")),
        ({"peer": "broker:1883"}, Origin("broker:1883")),
        ({"peer": "-", "source": "-"}, NOBODY),
        ({"peer": "10.0.0.9:1", "subject": "CN=a"}, Origin("10.0.0.9", "CN=a", "subject")),
        ({"peer": "10.0.0.9:1", "source": "panel"}, Origin("10.0.0.9", "panel", "source")),
        ({"peer": "10.0.0.9:1", "who": "panel"}, Origin("10.0.0.9", "panel", "who")),
    ],
)
def test_the_origin_of_an_event_is_its_source_and_its_subject(
    fields: dict[str, object], expected: Origin
) -> None:
    assert origin("refused", fields) == expected


def test_the_subject_of_a_message_is_nobody() -> None:
    assert origin("message_malformed", {"subject": "modbus.x"}) == NOBODY


def test_what_was_held_back_is_told_with_its_origin(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(log_lines, "_REFUSALS", Throttle(burst=1, window=0))
    fields = {"listener": "scada", "peer": "10.0.0.9:51200", "subject": "CN=a"}
    log_lines.count(logging.WARNING, "tls_failed", fields, kind=("scada", "expired"), times=7)
    log_lines.tell_held_back()
    [told] = [vars(each)["fields"] for each in caplog.records if each.message == "held_back"]
    assert told == {
        "of": "tls_failed",
        "kind": "scada expired",
        "peer": "10.0.0.9",
        "subject": "CN=a",
        "count": 6,
    }
