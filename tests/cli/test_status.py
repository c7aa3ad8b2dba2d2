"""`holdfast describe status`, as people and programs use it."""

from __future__ import annotations

from support.cli import answer, done, failure
from support.fake_device import FakeDevice, exception

REPLIES = {
    7: bytes.fromhex("076d"),
    11: bytes.fromhex("0bffff0108"),
    12: bytes.fromhex("0c08000001080121" + "2000"),
}
"""Of the examples of the standard (V1.1b3, 6.7, 6.9 and 6.10)."""


def test_a_device_says_how_it_communicates() -> None:
    with FakeDevice(lambda pdu: REPLIES[pdu[0]]) as device:
        lines = done("describe", "status", device.url)
        found = answer("describe", "status", device.url)
    assert lines == [
        "Exception status (function 7)",
        *(f"  output {number}  {'on' if 0x6D >> number & 1 else 'off'}" for number in range(8)),
        "",
        "Event counter (function 11)",
        "  busy    yes",
        "  events  264",
        "",
        "Event log (function 12)",
        "  busy          no",
        "  events        264",
        "  messages      289",
        "  latest first  20 00",
    ]
    assert found == {
        "ok": True,
        "target": device.url,
        "unit": 1,
        "exception_status": {"ok": True, "outputs": 0x6D},
        "event_counter": {"ok": True, "busy": True, "events": 264},
        "event_log": {"ok": True, "busy": False, "events": 264, "messages": 289, "log": "2000"},
    }


def test_one_answer_is_enough() -> None:
    with FakeDevice(lambda pdu: REPLIES[7] if pdu[0] == 7 else exception(pdu, 1)) as device:
        found = answer("describe", "status", device.url)
    assert found["ok"] is True
    assert found["exception_status"] == {"ok": True, "outputs": 0x6D}
    assert (found["event_log"]["ok"], found["event_log"]["code"]) == (False, 1)


def test_no_answer_is_a_failure() -> None:
    with FakeDevice(lambda pdu: exception(pdu, 1)) as device:
        told = failure("describe", "status", device.url)
        found = answer("describe", "status", device.url, code=1)
    refused = "exception 01 (Illegal Function)"
    assert told == [f"holdfast: {device.url}: function {code}: {refused}" for code in REPLIES]
    assert (found["ok"], found["reason"], found["code"]) == (False, "exception", 1)
