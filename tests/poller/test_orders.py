"""What a poller is told while it polls: writes, and devices that take the place of others."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

import pytest

from holdfast._core import Endpoint, Poller, Request
from holdfast.client.endpoint import endpoint
from holdfast.client.url import parse
from support import wire
from support.fake_device import HANG_UP, Serial
from support.lines import RTU
from support.native_poller import (
    INVALID,
    REFUSED,
    RESET,
    TIMEOUT,
    WITHDRAWN,
    ReportingPoller,
    device,
    device_at,
    taken,
    written,
)
from support.polled import Fake, asked, data, exception, reply

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from holdfast.types import Forward
    from support.fake_device import Asked


def writable(request: wire.Frame) -> bytes:
    return data(request) if request.pdu[0] <= 4 else reply(request, request.pdu)


def test_a_write_is_confirmed_under_its_number(poller: ReportingPoller) -> None:
    with Fake(lambda each: data(each) if each.pdu[0] <= 4 else reply(each, each.pdu[:5])) as fake:
        poller.add(device(fake))
        requests = [
            Request.write_register(3, 4711),
            Request.write_coil(1, True),
            Request.write_registers(3, [1, 2]),
            Request.write_coils(3, [1, 0, 1]),
        ]
        numbers = [poller.write("a", request) for request in requests]
        assert len(set(numbers)) == len(numbers)
        _, writes = taken(poller, lambda _, writes: len(writes) == len(numbers))
        assert sorted(writes) == [(number, 0) for number in sorted(numbers)]
        assert [each.pdu for each in fake.requests if each.pdu[0] > 4] == [
            request.pdu for request in requests
        ]


@pytest.mark.parametrize(
    ("answer", "fault"),
    [
        (lambda each: exception(each, 2), 2),
        (lambda each: exception(each, 0x63), 0x63),
        (lambda _: None, TIMEOUT),
        (lambda _: HANG_UP, RESET),
        (lambda each: reply(each, each.pdu[:3] + b"\xff\xff"), INVALID),
        (lambda each: wire.frame(each.pdu, 9, each.transaction), INVALID),
    ],
)
def test_a_write_that_is_not_confirmed_has_a_fault(
    poller: ReportingPoller, answer: Callable[[wire.Frame], bytes | None], fault: int
) -> None:
    with Fake(lambda each: data(each) if each.pdu[0] <= 4 else answer(each)) as fake:
        poller.add(device(fake, timeout=0.2 if fault == TIMEOUT else 10.0))
        taken(poller, lambda polls, _: polls)
        assert written(poller, poller.write("a", Request.write_register(0, 1))) == fault


def test_a_write_to_nobody_is_refused_at_once(poller: ReportingPoller) -> None:
    fake = Fake(data)
    with pytest.raises(ValueError, match="device a: there is no device of that name"):
        poller.write("a", Request.write_register(0, 1))
    poller.add(device(fake))
    with pytest.raises(ValueError, match="device a: function 3 does not write"):
        poller.write("a", Request.read("holding_registers", 0, 1))
    assert written(poller, poller.write("a", Request.write_register(0, 1))) == REFUSED


def test_a_write_waits_for_the_read_under_way_and_goes_before_the_next(
    poller: ReportingPoller,
) -> None:
    begun, go_on = threading.Event(), threading.Event()

    def answer(request: wire.Frame) -> bytes:
        if request.pdu[0] == 3 and asked(request)[0] == 0:
            begun.set()
            assert go_on.wait(wire.DEADLINE)
        return writable(request)

    with Fake(answer) as fake:
        reads = [("holding_registers", address, 1, None) for address in (0, 10, 20)]
        poller.add(device(fake, reads=reads))
        assert begun.wait(wire.DEADLINE)
        number = poller.write("a", Request.write_register(0, 1))
        assert len(fake.requests) == 1
        go_on.set()
        assert written(poller, number) == 0
        wire.until(lambda: len(fake.requests) == 4, "the poll is over")
        assert [each.pdu[0] for each in fake.requests] == [3, 6, 3, 3]


def test_the_end_of_a_device_ends_the_writes_that_were_not_sent(poller: ReportingPoller) -> None:
    begun, go_on = threading.Event(), threading.Event()

    def answer(request: wire.Frame) -> bytes:
        if request.pdu[0] == 6:
            begun.set()
            assert go_on.wait(wire.DEADLINE)
        return writable(request)

    with Fake(answer) as fake:
        poller.add(device(fake))
        number, *waiting = [poller.write("a", Request.write_register(0, 1)) for _ in range(3)]
        assert begun.wait(wire.DEADLINE)
        assert poller.remove("a")
        _, writes = taken(poller, lambda _, writes: len(writes) == 2)
        assert sorted(writes) == [(each, WITHDRAWN) for each in waiting]
        go_on.set()
        assert written(poller, number) == 0
        assert [each.pdu[0] for each in fake.requests].count(6) == 1


def test_a_forgotten_link_is_closed_before_the_next_one_is_opened(
    poller: ReportingPoller, tmp_path: Path
) -> None:
    begun, go_on = threading.Event(), threading.Event()

    def hold(asked: Asked) -> None:
        begun.set()
        assert go_on.wait(wire.DEADLINE)
        asked.answer()

    with Serial(RTU, tmp_path / "line", hold) as line, Fake(data) as elsewhere:
        at, other = (endpoint(parse(line.url + more)) for more in ("", "&close_after=3"))
        link = poller.link(at)
        poller.add(device_at(at, "a", timeout=2 * wire.DEADLINE))
        assert begun.wait(wire.DEADLINE)
        poller.remove("a")
        del link
        poller.forget_links()
        poller.add(device_at(other, "b", timeout=2 * wire.DEADLINE))
        poller.add(device(elsewhere, "elsewhere", interval=0.01))
        wire.until(lambda: poller.counters()["elsewhere"]["polls"] >= 5, "b had time to open it")
        go_on.set()
        polls, _ = taken(poller, lambda polls, _: "b" in {name for name, *_ in polls})
        [[block]] = [blocks for name, _, blocks in polls if name == "b"]
        assert block[4] == 0


def test_the_end_of_a_poller_ends_the_wait_for_results() -> None:
    poller = Poller([])
    found: list[Any] = []
    results = poller.new_receiver()
    waiting = threading.Thread(target=lambda: found.append(results.take(3600)))
    waiting.start()
    poller.stop()
    waiting.join()
    assert found == [None]
    assert results.take(3600) is None
    assert poller.new_receiver().take(3600) is None


def test_a_device_takes_the_place_of_another_with_its_connection_and_counters(
    poller: ReportingPoller,
) -> None:
    with Fake(data) as fake:
        poller.add(device(fake))
        taken(poller, lambda polls, _: polls)
        poller.replace("a", device(fake, "b", reads=[("input_registers", 7, 2, None)]))
        [(name, _, [block])], _ = taken(poller, lambda polls, _: polls)
        assert (name, block[:5]) == ("b", ("input_registers", 7, 2, bytes(4), 0))
        assert fake.connections == 1
        [(name, counted)] = poller.counters().items()
        assert (name, counted["polls"], counted["valid"]) == ("b", 2, 2)
        poller.replace("b", device(fake, "b"))
        taken(poller, lambda polls, _: polls)
        assert poller.remove("b")
        assert not poller.remove("a")


def test_a_poller_that_has_been_stopped_refuses_orders(poller: ReportingPoller) -> None:
    fake = Fake(data)
    poller.add(device(fake))
    poller.stop()
    for order in (
        lambda: poller.add(device(fake, "b")),
        lambda: poller.replace("a", device(fake, "b")),
        lambda: poller.write("a", Request.write_register(0, 1)),
    ):
        with pytest.raises(RuntimeError, match="the poller has been stopped"):
            order()
    assert list(poller.counters()) == ["a"]
    assert (poller.remove("b"), poller.remove("a"), poller.remove("a")) == (False, True, False)
    poller.stop()


def test_a_read_that_no_packet_can_carry_is_not_forwarded(poller: ReportingPoller) -> None:
    fake = Fake(data)
    packets: Forward = ("v1", "required", 1, 1.0, [], None)
    receiver = (Endpoint.network("tcp", "127.0.0.1", 9), packets)
    for count, forward in ((65535, [receiver]), (65536, None)):
        poller.add(device(fake, str(count), reads=[("coils", 0, count, None)], forward=forward))
    reads = [("coils", 0, 1, None), ("coils", 0, 65536, None)]
    with pytest.raises(ValueError, match="device c: read 1 has 65536 items, a forwarded packet"):
        poller.add(device(fake, "c", reads=reads, forward=[receiver]))
    assert sorted(poller.counters()) == ["65535", "65536"]


def test_a_poll_under_way_is_completed_before_the_device_is_replaced(
    poller: ReportingPoller,
) -> None:
    begun, go_on = threading.Event(), threading.Event()

    def answer(request: wire.Frame) -> bytes:
        begun.set()
        assert go_on.wait(wire.DEADLINE)
        return data(request)

    with Fake(answer) as fake:
        poller.add(device(fake))
        assert begun.wait(wire.DEADLINE)
        for name in ("b", "c", "d"):
            poller.replace({"b": "a", "c": "b", "d": "c"}[name], device(fake, name))
        go_on.set()
        polls, _ = taken(poller, lambda polls, _: len(polls) == 2)
        assert [name for name, *_ in polls] == ["a", "d"]


def test_polls_have_the_name_that_their_device_had_when_they_began(poller: ReportingPoller) -> None:
    begun, go_on = threading.Event(), threading.Event()

    def answer(request: wire.Frame) -> bytes:
        begun.set()
        assert go_on.wait(wire.DEADLINE)
        return data(request)

    with Fake(answer) as fake:
        poller.add(device(fake, reported_as="before"))
        assert begun.wait(wire.DEADLINE)
        poller.replace("a", device(fake, reported_as="after"))
        go_on.set()
        polls, _ = taken(poller, lambda polls, _: len(polls) == 2)
        assert [name for name, *_ in polls] == ["before", "after"]
        assert list(poller.counters()) == ["a"]


def test_a_unit_that_is_given_a_rest_keeps_it_when_its_device_is_replaced(
    poller: ReportingPoller,
) -> None:
    with Fake(lambda _: None) as fake:
        poller.add(device(fake, interval=0.05, timeout=0.05, retry=(60, 60)))
        taken(poller, lambda polls, _: len(polls) == 3)
        reads = len(fake.requests)
        fake.answer = writable
        poller.replace("a", device(fake, interval=0.05))
        assert written(poller, poller.write("a", Request.write_register(0, 1))) == 0
        # Then it is read at once.
        assert fake.requests[reads].pdu[0] == 6


def test_what_can_not_be_replaced_stays(poller: ReportingPoller) -> None:
    with Fake(data) as fake:
        poller.add(device(fake))
        poller.add(device(fake, "b"))
        with pytest.raises(ValueError, match="device c: there is no device of that name"):
            poller.replace("c", device(fake, "d"))
        with pytest.raises(ValueError, match="device b: the name is already in use"):
            poller.replace("a", device(fake, "b"))
        assert sorted(poller.counters()) == ["a", "b"]
