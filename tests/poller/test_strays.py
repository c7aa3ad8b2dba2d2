"""Devices that send what nobody requested: it is counted, logged once, and costs little."""

from __future__ import annotations

import itertools
import threading
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.config import load
from holdfast.events import log_lines
from support import web, wire
from support.polled import (
    Datagrams,
    Fake,
    configuration,
    counters,
    data,
    device,
    read,
    reply,
    until_polled,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from holdfast.appliance import Appliance
    from holdfast.config import Config
    from support.running import Run

FLOODED = 0x8008
READ_TOO = read("holding_registers", 0, 1, ("holding_registers", 1))
READS = [read("holding_registers", 0, 1, ("holding_registers", 0))]


@pytest.fixture
def records() -> Iterator[web.Records]:
    handler = web.Records()
    log_lines.LOGGER.addHandler(handler)
    yield handler
    log_lines.LOGGER.removeHandler(handler)


def polled(run: Run, url: str, **more: Any) -> Appliance:
    return run(configuration({"meter": device(url, *READS, **more)}))


def until_counted(appliance: Appliance, key: str, least: int = 1) -> None:
    wire.until(lambda: counters(appliance, "meter")[key] >= least, f"{key} is at least {least}")


def guessed(request: wire.Frame) -> bytes:
    """The reply to the request after this one, which was not sent yet."""
    later = wire.Frame((request.transaction + 1) & 0xFFFF, request.unit, request.pdu)
    return data(later, 666)


@pytest.mark.parametrize(
    ("sent", "replies"),
    [
        (lambda request: data(request, 7) + guessed(request), 1),
        (lambda request: data(request, 7) * 2, 1),
        (lambda request: data(request, 7) + b"\x00\x00\xff\xff garbage", 0),
    ],
    ids=["guessed", "twice", "garbage"],
)
@pytest.mark.usefixtures("health_is_checked_at_once")
def test_what_follows_a_reply_is_counted_and_reaches_no_memory(
    sent: Callable[[wire.Frame], bytes], replies: int, run: Run, records: web.Records
) -> None:
    with Fake(sent) as fake:
        appliance = polled(run, fake.url)
        until_polled(appliance, "meter", 5)
        until_counted(appliance, "stray_bytes")
        told = counters(appliance, "meter")
        assert (told["unexpected_replies"] > 0) == bool(replies)
        assert told["late_replies"] == 0
        assert appliance.memories["mirror"].read("holding_registers", 0, 1) == [7]

        def logged() -> bool:
            appliance.log_events(timeout=0.01)
            return bool(records.of("unrequested_data"))

        wire.until(logged, "it is logged")
        more = counters(appliance, "meter")["stray_bytes"]
        until_counted(appliance, "stray_bytes", more + 1)
        appliance.log_events(timeout=0)
    [event] = records.of("unrequested_data")
    assert event["device"] == "meter"
    assert event["bytes"] > 0


@pytest.mark.parametrize("becomes", ["added_again", "moved"])
@pytest.mark.usefixtures("health_is_checked_at_once")
def test_after_a_reload_unrequested_data_of_another_device_is_logged(
    becomes: str, tmp_path: Path, run: Run, records: web.Records
) -> None:
    sends = threading.Event()

    def twice_when_told(request: wire.Frame) -> bytes:
        return data(request, 7) * (2 if sends.is_set() else 1)

    def loaded(url: str, **more: Any) -> Config:
        file = tmp_path / "changed.yaml"
        file.write_text(configuration({"meter": device(url, *READS, **more)}))
        return load(file)

    with Fake(lambda request: data(request, 7) * 2) as fake, Fake(twice_when_told) as other:
        appliance = polled(run, fake.url)

        def is_logged(times: int) -> bool:
            appliance.log_events(timeout=0.01)
            return len(records.of("unrequested_data")) == times

        wire.until(lambda: is_logged(1), "it is logged")
        before = counters(appliance, "meter")["stray_bytes"]
        if becomes == "added_again":
            appliance.reload(loaded(fake.url, enabled=False))
        appliance.reload(loaded(other.url))
        if becomes == "added_again":
            # Its counter is higher when it is looked at next.
            sends.set()
            until_counted(appliance, "stray_bytes", before + 1)
        else:
            wire.until(lambda: counters(appliance, "meter")["stray_bytes"] == 0, "it has moved")
            assert is_logged(1)
            sends.set()
        wire.until(lambda: is_logged(2), "it is logged again")


def test_an_unsolicited_frame_before_any_reply_fails_the_request(run: Run) -> None:
    with Fake(lambda request: guessed(request) + data(request)) as fake:
        appliance = polled(run, fake.url)
        wire.until(
            lambda: counters(appliance, "meter")["transport_errors"] > 0, "the request has failed"
        )
        until_counted(appliance, "unexpected_replies")
        assert appliance.memories["mirror"].read("holding_registers", 0, 1) == [0]


def test_a_late_reply_is_no_unexpected_one(run: Run) -> None:
    def is_late(timeout: float) -> bool:
        number = itertools.count()
        held: list[bytes] = []

        def answer(request: wire.Frame) -> bytes | None:
            if next(number) == 0:
                held.append(data(request))
                return None
            return b"".join([*held, data(request)])

        with Fake(answer) as fake:
            appliance = polled(run, fake.url, timeout=timeout)
            until_counted(appliance, "timeouts")
            until_counted(appliance, "late_replies")
            told = counters(appliance, "meter")
        if told["timeouts"] > 1:
            return False
        # Only the first reply with that id was late.
        assert told["late_replies"] == 1
        return True

    wire.until_long_enough(is_late, "one reply is late")


@pytest.mark.usefixtures("health_is_checked_at_once")
def test_a_device_that_is_always_late_is_polled_with_more_time(
    run: Run, records: web.Records
) -> None:
    timeout = 0.1

    def slow(request: wire.Frame) -> bytes:
        threading.Event().wait(1.4 * timeout)
        return data(request, 7)

    with Fake(slow) as fake:
        appliance = polled(run, fake.url, timeout=timeout)
        until_counted(appliance, "raised_timeouts", 2)
        mirror = appliance.memories["mirror"]
        wire.until(lambda: mirror.read("holding_registers", 0, 1) == [7], "it has a value")

        def logged() -> bool:
            appliance.log_events(timeout=0.01)
            return bool(records.of("timeout_raised"))

        wire.until(logged, "it is logged")


def test_a_good_device_has_no_strays(run: Run) -> None:
    with Fake(data) as fake:
        appliance = polled(run, fake.url)
        until_polled(appliance, "meter", 10)
        told = counters(appliance, "meter")
    keys = ("unexpected_replies", "stray_bytes", "late_replies", "raised_timeouts", "floods")
    assert [told[key] for key in keys] == [0] * 5


def test_a_device_that_floods_is_left_alone_for_a_while(run: Run) -> None:
    junk = bytes(16 * 1024)
    with Fake(lambda request: data(request) + junk) as fake, Fake(data) as good:
        flooding = device(fake.url, *READS, retry={"first": 3600, "most": 3600})
        appliance = run(configuration({"meter": flooding, "other": device(good.url, READ_TOO)}))
        until_counted(appliance, "floods")
        wire.until(lambda: counters(appliance, "meter")["health"] == "error", "it is in error")
        connections, told = fake.connections, counters(appliance, "meter")
        assert told["last_error"] == FLOODED
        assert told["stray_bytes"] < 100 * len(junk), "little of the flood was read"
        until_polled(appliance, "other", 20)
        assert fake.connections == connections
        assert counters(appliance, "meter")["floods"] == 1
        assert counters(appliance, "other")["health"] == "ok"


def test_a_device_is_polled_again_when_its_flood_is_over(run: Run) -> None:
    flooding = threading.Event()
    flooding.set()
    junk = bytes(16 * 1024)

    def answer(request: wire.Frame) -> bytes:
        return data(request) + (junk if flooding.is_set() else b"")

    with Fake(answer) as fake:
        appliance = polled(run, fake.url, retry={"first": 0.05, "most": 0.05})
        until_counted(appliance, "floods", 3)
        flooding.clear()
        wire.until(lambda: counters(appliance, "meter")["health"] == "ok", "it is polled")


def test_forged_datagrams_are_counted_and_dropped(run: Run) -> None:
    def answer(request: wire.Frame) -> bytes:
        return reply(wire.Frame(request.transaction ^ 1, request.unit, b""), data(request)[7:])

    with Datagrams(answer) as fake:
        appliance = polled(run, fake.url, timeout=0.3)
        until_counted(appliance, "unexpected_replies", 3)
        until_counted(appliance, "timeouts")
        assert appliance.memories["mirror"].read("holding_registers", 0, 1) == [0]


def test_transaction_ids_of_datagrams_are_not_predictable(run: Run) -> None:
    seen: list[int] = []

    def answer(request: wire.Frame) -> bytes:
        seen.append(request.transaction)
        return data(request)

    with Datagrams(answer) as fake:
        appliance = polled(run, fake.url)
        wire.until(lambda: len(seen) > 20, "requests have come")
        assert counters(appliance, "meter")["stray_bytes"] == 0
    assert any(second != (first + 1) & 0xFFFF for first, second in itertools.pairwise(seen))
    assert len(set(seen)) > 10
