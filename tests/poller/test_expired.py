"""Writes that can't be sent in time: nobody expects them any more, so they are not sent."""

from __future__ import annotations

import threading
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

import pytest

from holdfast._core import Caller, Memory, Request
from support import wire
from support.fake_device import Stream
from support.native_poller import (
    EXPIRED,
    WITHDRAWN,
    Made,
    ReportingPoller,
    device,
    taken,
    written,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from support.fake_device import Asked

WRITE = Request.write_register(3, 7)


class Busy(Stream):
    """Its unit 2 holds the reply to its first read until `go_on`."""

    is_modelled = False

    def __init__(self, kind: str) -> None:
        super().__init__(kind, then=self._answer)
        self.is_reading, self.go_on = threading.Event(), threading.Event()
        self.writes: list[bytes] = []

    def _answer(self, asked: Asked) -> None:
        if asked.pdu[0] == 6:
            self.writes.append(asked.pdu)
            asked.answer(asked.pdu)
            return
        if asked.unit == 2 and not self.is_reading.is_set():
            self.is_reading.set()
            assert self.go_on.wait(wire.DEADLINE)
        asked.answer(b"\x03\x02\0\0")


@contextmanager
def busy(kind: str) -> Iterator[Busy]:
    with Busy(kind) as made:
        try:
            yield made
        finally:
            made.go_on.set()


@pytest.mark.parametrize("kind", ["tcp", "rtu+tcp"])
def test_a_write_that_waits_for_another_device_of_its_connection(
    poller: ReportingPoller, kind: str
) -> None:
    with busy(kind) as line:
        made = partial(device, line, transport=kind)
        poller.add(made("slow", unit=2, timeout=4 * wire.DEADLINE))
        assert line.is_reading.wait(wire.DEADLINE)
        poller.add(made("a", timeout=0.1))
        assert written(poller, poller.write("a", WRITE, within=0.05)) == EXPIRED
        line.go_on.set()
        taken(poller, lambda polls, _: {name for name, *_ in polls} == {"slow", "a"})
        assert not line.writes
        poller.add(made("b", timeout=wire.DEADLINE))
        assert written(poller, poller.write("b", WRITE, within=wire.DEADLINE)) == 0
        assert len(line.writes) == 1


def test_a_write_that_waits_for_the_end_of_the_connection_before(
    poller: ReportingPoller,
) -> None:
    with busy("rtu+tcp") as line:
        made = partial(device, line, transport="rtu+tcp")
        poller.add(made("slow", unit=2, timeout=4 * wire.DEADLINE))
        assert line.is_reading.wait(wire.DEADLINE)
        poller.remove("slow")
        poller.add(made("a", timeout=0.1, in_flight=2, start_within=3600.0))
        assert written(poller, poller.write("a", WRITE, within=0.05)) == EXPIRED


each_way_to_go = pytest.mark.parametrize(
    "change",
    [
        lambda poller, _: poller.remove("a"),
        lambda poller, made: poller.replace("a", made("a", unit=3)),
    ],
    ids=["removed", "another unit"],
)


@pytest.mark.parametrize("kind", ["tcp", "rtu+tcp"])
@each_way_to_go
def test_a_write_that_waits_is_not_sent_once_its_device_has_gone(
    poller: ReportingPoller, kind: str, change: Callable[[ReportingPoller, partial[Made]], object]
) -> None:
    with busy(kind) as line:
        made = partial(device, line, transport=kind, timeout=4 * wire.DEADLINE)
        poller.add(made("slow", unit=2))
        assert line.is_reading.wait(wire.DEADLINE)
        poller.add(made("a"))
        number = poller.write("a", WRITE)
        change(poller, made)
        assert written(poller, number) == WITHDRAWN
        line.go_on.set()
        poller.add(made("b"))
        assert written(poller, poller.write("b", WRITE)) == 0
        assert len(line.writes) == 1


@pytest.mark.parametrize("kind", ["tcp", "rtu+tcp"])
@each_way_to_go
def test_a_passed_write_that_waits_is_not_sent_once_its_device_has_gone(
    poller: ReportingPoller, kind: str, change: Callable[[ReportingPoller, partial[Made]], object]
) -> None:
    mirror = Memory(holding_registers=1)
    reads = [("holding_registers", 0, 1, (mirror, "holding_registers", 0, None))]
    passage = poller.passage(mirror, ("holding_registers", 0, 1, "a", 0, False))
    with busy(kind) as line, busy("tcp") as elsewhere:
        made = partial(device, line, transport=kind, timeout=4 * wire.DEADLINE)
        poller.add(made("a", reads=reads))
        taken(poller, lambda polls, _: polls)
        poller.add(made("slow", unit=2))
        assert line.is_reading.wait(wire.DEADLINE)
        caller = Caller()
        ticket = passage.call(caller, "holding_registers", 0, [7])
        poller.add(device(elsewhere, "elsewhere"))  # The write waits when this is polled.
        taken(poller, lambda polls, _: polls)
        change(poller, partial(made, reads=reads))
        line.go_on.set()
        ended: list[Any] = []

        def has_ended() -> bool:
            ended.extend(caller.take())
            return bool(ended)

        wire.until(has_ended, "the write has ended")
        [(number, is_sent, error)] = ended
        assert (number, is_sent, error.code) == (ticket, False, 10)
        assert not line.writes


@pytest.mark.parametrize("within", [-1.0, float("nan"), float("inf"), 1e9])
def test_a_time_that_is_none_is_refused(poller: ReportingPoller, within: float) -> None:
    with busy("tcp") as line:
        line.go_on.set()
        poller.add(device(line))
        with pytest.raises(ValueError, match=r"within is .*, allowed: 0 to 31622400 seconds"):
            poller.write("a", WRITE, within=within)
