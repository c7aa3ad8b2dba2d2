"""Polled devices that deviate from the standard, and how many requests they get at once."""

from __future__ import annotations

import itertools
import time
from typing import TYPE_CHECKING, Any

import pytest

from support import wire
from support.fake_device import (
    DATAGRAMS,
    Asked,
    Connection,
    ScriptedDevice,
    Stream,
    Udp,
    good,
    silent,
)
from support.polled import block, configuration, counters, device, read, status, until_polled

if TYPE_CHECKING:
    from collections.abc import Callable

    from support.fake_device import Behaviour
    from support.running import Run

TIMEOUT = 0x8001
READ = read("holding_registers", 7, 2, ("holding_registers", 7))


def made(kind: str, behaviour: Behaviour) -> ScriptedDevice:
    if kind in DATAGRAMS:
        return Udp(then=behaviour, kind=kind)
    return Stream(kind, then=behaviour)


def from_unit_9() -> Behaviour:
    return lambda asked: asked.answer(unit=9)


def padded() -> Behaviour:
    return lambda asked: asked.answer(asked.reply + b"\0\0")


def every_other(failure: Behaviour) -> Callable[[], Behaviour]:
    """Fails at the first request, answers the second, and so on."""

    def begin() -> Behaviour:
        behaviours = itertools.cycle([failure, good])
        return lambda asked: next(behaviours)(asked)

    return begin


def busy(asked: Asked) -> None:
    asked.answer(bytes([asked.pdu[0] | 0x80, 6]))


def close(asked: Asked) -> None:
    assert isinstance(asked.peer, Connection)
    asked.peer.close()


def in_need_of_a_pause() -> Behaviour:
    """Drops what comes within 50 ms of the request before."""
    ready = 0.0

    def behave(asked: Asked) -> None:
        nonlocal ready
        was_ready = time.monotonic() >= ready
        ready = time.monotonic() + 0.05
        if was_ready:
            asked.answer()

    return behave


HALF_DEAF = every_other(silent)

NEEDS: list[tuple[str, Callable[[], Behaviour], dict[str, Any]]] = [
    ("tcp", from_unit_9, {"accept_unit": 9}),
    ("rtu+tcp", from_unit_9, {"accept_unit": "any"}),
    ("ascii+tcp", from_unit_9, {"accept_unit": 9}),
    ("rtu+udp", from_unit_9, {"accept_unit": 9}),
    ("tcp", padded, {"pad": True}),
    ("udp", padded, {"pad": True}),
    ("tcp", HALF_DEAF, {"retries": 1}),
    ("rtu+udp", HALF_DEAF, {"retries": 1}),
    ("tcp", every_other(busy), {"retries": 1, "retry_busy": True}),
    ("tcp", in_need_of_a_pause, {"pause": 0.1}),
]


@pytest.mark.parametrize(("kind", "behaviour", "tolerance"), NEEDS)
def test_a_device_that_needs_tolerance_is_polled_with_it(
    kind: str, behaviour: Callable[[], Behaviour], tolerance: dict[str, Any], run: Run
) -> None:
    with made(kind, behaviour()) as fake:
        meter = device(fake.url, READ, status=block(0), timeout=0.1)
        appliance = run(configuration({"meter": meter}))
        wire.until(lambda: counters(appliance, "meter")["failures"], "it fails without tolerance")
        appliance.stop()

    def is_polled(timeout: float) -> bool:
        with made(kind, behaviour()) as fake:
            more: dict[str, Any] = {"timeout": timeout, "tolerance": tolerance}
            meter = device(fake.url, READ, status=block(0, keep_last_error=True), **more)
            appliance = run(configuration({"meter": meter}))
            until_polled(appliance, "meter", 5)
            found = status(appliance.memories["status"])
            appliance.stop()
        if found.last_error == TIMEOUT:
            return False
        assert found.most_failures == 0
        assert appliance.memories["mirror"].read("holding_registers", 6, 4) == [0, 7, 8, 0]
        return True

    timeout = 0.1 if behaviour is HALF_DEAF else wire.DEADLINE
    wire.until_long_enough(is_polled, "it is polled", timeout)


@pytest.mark.parametrize("kind", ["tcp", "rtu+tcp", "ascii+tcp"])
@pytest.mark.parametrize("tolerance", [{}, {"tolerance": {"close_after": 1}}])
def test_a_device_that_closes_after_each_reply_is_polled(
    kind: str, tolerance: dict[str, Any], run: Run
) -> None:
    def answer_and_close(asked: Asked) -> None:
        asked.answer()
        close(asked)

    with made(kind, answer_and_close) as fake:
        more = {"interval": 0.01, **tolerance}
        appliance = run(configuration({"meter": device(fake.url, READ, status=block(0), **more)}))
        until_polled(appliance, "meter", 20)
        assert status(appliance.memories["status"]).most_failures == 0
        appliance.stop()


@pytest.mark.parametrize("kind", ["rtu+tcp", "ascii+tcp", "rtu+udp"])
def test_frames_of_a_serial_line_are_polled_over_a_network(kind: str, run: Run) -> None:
    with made(kind, good) as fake:
        appliance = run(configuration({"meter": device(fake.url, READ, status=block(0))}))
        until_polled(appliance, "meter")
        assert status(appliance.memories["status"]).most_failures == 0
        assert appliance.memories["mirror"].read("holding_registers", 6, 4) == [0, 7, 8, 0]
        appliance.stop()


def units(fake: ScriptedDevice, count: int, **more: Any) -> dict[str, Any]:
    """So many devices at one address, which all want a request at any time."""
    return {
        f"unit-{number}": device(
            fake.url, read("coils", number, 1, ("coils", number)), timeout=60, **more
        )
        for number in range(count)
    }


@pytest.mark.parametrize(("settings", "most"), [({}, 1), ({"in_flight": 3}, 3)])
def test_devices_at_one_address_have_so_many_requests_in_flight(
    settings: dict[str, Any], most: int, run: Run
) -> None:
    with Stream("tcp", then=silent) as fake:
        run(configuration(units(fake, 5, **settings)))
        fake.await_requests(most)
        for number in range(10):
            fake.requests[number].answer()
            fake.await_requests(most + number + 1)


def elapsed(seconds: float) -> Callable[[], bool]:
    """Whether so much time has passed since now."""
    until = time.monotonic() + seconds
    return lambda: time.monotonic() >= until


def test_auto_falls_back_to_one_request_where_a_gateway_answers_one_after_the_other(
    run: Run,
) -> None:
    waiting: list[Asked] = []
    in_flight: list[int] = []
    with Stream("tcp", then=waiting.append) as fake:
        run(configuration(units(fake, 4, in_flight="auto")))
        while 2 not in in_flight or set(in_flight[-10:]) != {1}:
            assert len(in_flight) < 300, in_flight
            wire.until(lambda: waiting, "a request has come")
            wire.until(elapsed(0.02), "the gateway has worked")
            in_flight.append(len(waiting))
            waiting.pop(0).answer()
        assert set(in_flight[:20]) == {1}


def test_auto_has_more_requests_in_flight_while_a_gateway_answers_them_as_fast(run: Run) -> None:
    def has_more(seconds: float) -> bool:
        """Whether it has, if the gateway takes so long for its work: all else adds to it."""
        waiting: list[Asked] = []
        with Stream("tcp", then=waiting.append) as fake:
            appliance = run(configuration(units(fake, 6, in_flight="auto")))
            # It judges twice, each time after 20 answers.
            for _ in range(60):
                wire.until(lambda: waiting, "a request has come")
                wire.until(elapsed(seconds), "the gateway has worked on all of them")
                if len(waiting) >= 3:
                    return True
                while waiting:
                    waiting.pop(0).answer()
            appliance.stop()
        return False

    wire.until_long_enough(has_more, "three requests are in flight", 0.02)
