"""What a poller makes of a device that refuses a read: what it can't read costs nothing else."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from holdfast._core import Request
from support import wire
from support.cases import examples
from support.native_poller import INVALID, TIMEOUT, ReportingPoller, device, taken, written
from support.polled import Fake, asked, data, exception, reply

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable


INTERVAL = 0.005


def fields(addresses: Iterable[int], count: int = 1, area: str = "holding_registers") -> list[Any]:
    return [(area, address, count, None) for address in addresses]


def without(
    bad: Iterable[int], code: int = 2, most: int = 2000
) -> Callable[[wire.Frame], bytes | None]:
    """A device that lacks some addresses, and bears so many items in one request."""
    lacking = set(bad)

    def answer(request: wire.Frame) -> bytes:
        if request.pdu[0] > 4:
            return reply(request, request.pdu)
        address, count = asked(request)
        if count > most:
            return exception(request, 3)
        lacks = lacking & set(range(address, address + count))
        return exception(request, code) if lacks else data(request, 7)

    return answer


def settled(poller: ReportingPoller, number: int = 1) -> list[Any]:
    """The blocks of a poll when all has been learned: area, address, count and fault."""
    polls, _ = taken(poller, lambda polls, _: len(polls) > number)
    return [(area, address, count, fault) for area, address, count, _, fault, _ in polls[-1][2]]


def requests(fake: Fake, poller: ReportingPoller) -> list[tuple[int, int]]:
    """What one poll asks for, when all has been learned."""
    settled(poller, 2)
    before = poller.counters()["a"]["polls"]
    settled(poller, 4)
    polls = poller.counters()["a"]["polls"]
    per_poll = poller.counters()["a"]["requests_per_poll"]
    assert polls > before
    return sorted({asked(request) for request in fake.requests[-per_poll:]})


@pytest.mark.parametrize("code", [2, 3])
@pytest.mark.parametrize("bad", [0, 50, 124])
def test_one_bad_address_costs_its_own_read_and_one_more_request(
    poller: ReportingPoller, code: int, bad: int
) -> None:
    with Fake(without([bad], code)) as fake:
        poller.add(device(fake, interval=INTERVAL, reads=fields(range(125))))
        blocks = settled(poller, 3)
        good = [(at, count) for _, at, count, fault in blocks if not fault]
        assert {at + n for at, count in good for n in range(count)} == set(range(125)) - {bad}
        assert [(at, fault) for _, at, _, fault in blocks if fault] == [(bad, code)]
        assert len(requests(fake, poller)) == (1 if bad in (0, 124) else 2)


def test_a_bad_address_of_one_area_does_not_keep_longer_reads_of_another_back(
    poller: ReportingPoller,
) -> None:
    """The input registers answer 03, the holding registers hold values of four registers."""

    def answer(request: wire.Frame) -> bytes | None:
        return without([3], 3)(request) if request.pdu[0] == 4 else data(request)

    reads = [*fields(range(8), area="input_registers"), *fields([0], 4), *fields([10], 2)]
    with Fake(answer) as fake:
        poller.add(device(fake, interval=INTERVAL, reads=reads))
        found = {(area, at): fault for area, at, _, fault in settled(poller, 5)}
        assert found[("input_registers", 3)] == 3
        assert [fault for fault in found.values() if fault] == [3]
        assert ("holding_registers", 0) in found


@pytest.mark.parametrize("code", [2, 3])
def test_a_bad_address_that_nobody_wants_costs_one_more_request(
    poller: ReportingPoller, code: int
) -> None:
    with Fake(without([9], code)) as fake:
        reads = fields([0, 3, 6, 12, 15, 18])
        poller.add(device(fake, interval=INTERVAL, reads=reads, max_gap=10))
        blocks = settled(poller, 3)
        assert not any(fault for *_, fault in blocks)
        if code == 2:
            assert requests(fake, poller) == [(0, 7), (12, 7)]


@pytest.mark.parametrize("most", [64, 100, 124])
def test_a_device_that_bears_less_gets_shorter_requests(poller: ReportingPoller, most: int) -> None:
    with Fake(without([], most=most)) as fake:
        poller.add(device(fake, interval=INTERVAL, reads=fields(range(250))))
        blocks = settled(poller, 3)
        assert sum(count for *_, count, _ in blocks) == 250
        assert not any(fault for *_, fault in blocks)
        assert all(count <= most for _, count in requests(fake, poller))
        assert len(requests(fake, poller)) <= 5


def test_a_device_that_can_not_read_across_an_address_is_read_in_two(
    poller: ReportingPoller,
) -> None:
    def answer(request: wire.Frame) -> bytes:
        address, count = asked(request)
        across = address < 100 < address + count
        return exception(request, 2) if across else data(request)

    with Fake(answer) as fake:
        poller.add(device(fake, interval=INTERVAL, reads=fields(range(60, 140))))
        assert not any(fault for *_, fault in settled(poller, 3))
        assert requests(fake, poller) == [(60, 40), (100, 40)]


def test_what_was_learned_outlives_a_change_of_what_is_read(poller: ReportingPoller) -> None:
    with Fake(without([50])) as fake:
        poller.add(device(fake, interval=3600.0, reads=fields(range(100))))
        settled(poller, 0)
        learned = len(fake.requests)
        poller.replace("a", device(fake, interval=3600.0, reads=fields(range(101))))
        found = settled(poller, 0)
        assert [asked(request) for request in fake.requests[learned:]] == [(0, 50), (51, 50)]
        assert [(at, fault) for _, at, _, fault in found if fault] == [(50, 2)]


def test_what_nobody_wants_any_more_is_not_told_and_not_read(poller: ReportingPoller) -> None:
    with Fake(without([50])) as fake:
        poller.add(device(fake, interval=3600.0, reads=fields(range(100)), max_gap=10))
        settled(poller, 0)
        learned = len(fake.requests)
        reads = fields([*range(50), *range(51, 100)])
        poller.replace("a", device(fake, interval=3600.0, reads=reads, max_gap=10))
        assert not any(fault for *_, fault in settled(poller, 0))
        assert [asked(request) for request in fake.requests[learned:]] == [(0, 50), (51, 49)]
        assert poller.counters()["a"]["health"] == "ok"


def test_a_device_that_refuses_everything_is_asked_all_the_same(poller: ReportingPoller) -> None:
    with Fake(without(range(65536))) as fake:
        poller.add(device(fake, interval=INTERVAL, reads=fields([1, 5, 200])))
        blocks = settled(poller, 5)
        assert sorted((at, fault) for _, at, _, fault in blocks) == [(1, 2), (5, 2), (200, 2)]
        assert poller.counters()["a"]["health"] == "error"
        fake.answer = data
        wire.until(lambda: poller.counters()["a"]["health"] == "ok", "it is read again")


def test_a_device_whose_replies_are_wrong_is_given_a_rest(poller: ReportingPoller) -> None:
    def answer(request: wire.Frame) -> bytes:
        return wire.frame(b"\x03\x02\0\0", 9, request.transaction)

    with Fake(answer) as fake:
        poller.add(device(fake, interval=0.001))
        polls, _ = taken(poller, lambda polls, _: len(polls) == 4)
        assert {fault for _, _, blocks in polls for *_, fault, _ in blocks} == {INVALID}
        # The schedule goes on behind the rest, which takes 0.75 to 1 s.
        assert polls[3][1] - polls[2][1] > 0.7


def test_a_write_that_succeeds_ends_a_rest(poller: ReportingPoller) -> None:
    """The rest would take longer than a test waits."""
    with Fake(lambda _: None) as fake:
        poller.add(device(fake, interval=0.02, timeout=0.2, retry=(3600, 3600)))
        polls, _ = taken(poller, lambda polls, _: len(polls) == 3)
        assert polls[-1][2][0][4] == TIMEOUT
        fake.answer = without([])
        write = Request.write_register(0, 1)
        wire.until(lambda: written(poller, poller.write("a", write)) == 0, "a write is answered")
        taken(poller, lambda polls, _: polls and polls[-1][2][0][4] == 0)


@settings(max_examples=examples(40))
@given(
    st.sets(st.integers(0, 60), min_size=1, max_size=40),
    st.sets(st.integers(0, 61), max_size=8),
    st.sampled_from([2, 3]),
    st.integers(1, 3),
    st.integers(0, 10),
)
def test_whatever_a_device_lacks_the_rest_is_read(
    addresses: set[int], bad: set[int], code: int, count: int, max_gap: int
) -> None:
    """Values of one length, which may overlap: those that do are read together or not at all."""
    starts = sorted(addresses)
    alone = [
        at
        for before, at, after in zip([-9, *starts], starts, [*starts[1:], 99], strict=False)
        if before + count <= at and at + count <= after
    ]
    poller = ReportingPoller()
    try:
        with Fake(without(bad, code)) as fake:
            poller.add(device(fake, interval=0.005, reads=fields(starts, count), max_gap=max_gap))
            blocks = settled(poller, 2)
            for at in alone:
                faults = [fault for _, start, n, fault in blocks if start <= at < start + n]
                assert faults == [code if bad & set(range(at, at + count)) else 0]
    finally:
        poller.stop()
