"""A fence in the native poller: nothing is sent to a device while another node may use it."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Any

import pytest

from holdfast._core import Endpoint, Fence, PolledDevice, Request
from support import wire
from support.fake_device import Stream
from support.native_poller import TIMEOUT, ReportingPoller, device, taken, written
from support.polled import Fake, data

if TYPE_CHECKING:
    from collections.abc import Iterator

    from support.fake_device import Asked

STANDBY = 0x8009
FAR = 3600.0


@pytest.fixture
def fake() -> Iterator[Fake]:
    with Fake(lambda asked: data(asked) if asked.pdu[0] < 5 else _echo(asked)) as fake:
        yield fake


def _echo(asked: wire.Frame) -> bytes:
    return wire.frame(asked.pdu[:5], asked.unit, asked.transaction)


def health(poller: ReportingPoller, name: str = "a") -> str:
    found: str = poller.counters()[name]["health"]
    return found


def is_disconnected(fake: Stream) -> bool:
    fake.sources()
    return not fake._peers


def test_a_device_is_polled_while_its_fence_is_open(poller: ReportingPoller, fake: Fake) -> None:
    fence = Fence(1)
    poller.add(device(fake, interval=0.01, fence=fence))
    wire.until(lambda: health(poller) == "standby", "it stands by")
    assert fake.connections == 0
    fence.open(time.monotonic() + FAR)
    taken(poller, lambda polls, _: len(polls) > 3)
    assert health(poller) == "ok"
    assert fence.in_use > 0
    fence.close()
    taken(poller, lambda polls, _: polls and not polls[-1][2])  # Behind its last poll.
    wire.until(lambda: health(poller) == "standby", "it stands by again")
    wire.until(lambda: fence.in_use == 0, "nothing is in use")
    wire.until(lambda: is_disconnected(fake), "the connection is closed")
    polls = len(fake.requests)
    fence.renew(time.monotonic() + FAR)
    assert not fence.allows
    fence.open(time.monotonic() + FAR)
    wire.until(lambda: len(fake.requests) > polls, "it is polled again")
    assert fake.connections == 2


def test_an_end_that_is_not_moved_ends_polls_and_closes_the_connection(
    poller: ReportingPoller, fake: Fake
) -> None:
    fence = Fence(1)
    # The device is polled once an hour: nothing else would close its connection.
    fence.open(time.monotonic() + 0.3)
    poller.add(device(fake, interval=3600.0, fence=fence))

    # The end is moved until the device was polled, however long that takes.
    def is_polled(polls: list[Any], _: list[Any]) -> bool:
        fence.renew(time.monotonic() + 0.3)
        return bool(polls)

    taken(poller, is_polled)
    wire.until(lambda: health(poller) == "standby", "it stands by")
    wire.until(lambda: is_disconnected(fake), "the connection is closed")
    assert not fence.allows
    connections = fake.connections
    fence.renew(time.monotonic() + FAR)
    wire.until(lambda: fake.connections > connections, "it goes on when the end has moved")


def test_a_lease_that_was_taken_too_late_to_be_used_can_be_renewed() -> None:
    fence = Fence(1)
    fence.open(time.monotonic() - 1)
    assert not fence.allows
    fence.renew(time.monotonic() + FAR)
    assert fence.is_open


def test_a_time_that_is_no_number_is_refused() -> None:
    with pytest.raises(ValueError, match=r"until is NaN, allowed: a time of time\.monotonic"):
        Fence(1).open(math.nan)


def test_a_poll_that_has_begun_ends_before_a_lease_is_given_back(poller: ReportingPoller) -> None:
    waiting: list[Asked] = []
    with Stream("tcp", then=waiting.append) as slow:
        fence = Fence(1)
        fence.open(time.monotonic() + FAR)
        endpoint = Endpoint.network("tcp", "127.0.0.1", slow.port)
        reads = [("holding_registers", 0, 1, None), ("holding_registers", 500, 1, None)]
        settings: dict[str, Any] = {"unit": 1, "interval": 0.0, "timeout": 10.0, "reads": reads}
        poller._poller.add(
            PolledDevice("a", endpoint, fence=fence, receiver=poller.results, **settings)
        )
        wire.until(lambda: len(waiting) == 1, "the first block is asked for")
        fence.end()
        assert not fence.is_open
        waiting[0].answer(bytes.fromhex("03020007"))
        wire.until(lambda: len(waiting) == 2, "the second block is asked for")
        assert fence.in_use > 0
        waiting[1].answer(bytes.fromhex("03020008"))
        [(_, _, blocks), *_], _ = taken(poller, lambda polls, _: polls)
        assert [block[3] for block in blocks] == [b"\0\7", b"\0\10"]
        wire.until(lambda: fence.in_use == 0, "nothing is in use")
        wire.until(lambda: is_disconnected(slow), "the connection is closed")
        assert len(waiting) == 2


def test_a_reply_after_the_end_is_not_passed_on(poller: ReportingPoller) -> None:
    waiting: list[Asked] = []
    with Stream("tcp", then=waiting.append) as slow:
        fence = Fence(1)
        fence.open(time.monotonic() + FAR)
        poller.add(device(slow, interval=0.0, fence=fence))
        wire.until(lambda: len(waiting) == 1, "it is asked")
        fence.close()
        waiting[0].answer(bytes.fromhex("03020007"))
        wire.until(lambda: fence.in_use == 0, "nothing is in use")
        [(_, _, blocks)], _ = taken(poller, lambda polls, _: polls)
        assert blocks == []
        assert poller.results.take(0.1) == ([], [])
        assert len(waiting) == 1


def test_a_write_without_the_lease_is_not_sent(poller: ReportingPoller, fake: Fake) -> None:
    fence = Fence(1)
    poller.add(device(fake, fence=fence))
    write = Request.write_register(3, 7)
    assert written(poller, poller.write("a", write)) == STANDBY
    assert fake.connections == 0
    fence.open(time.monotonic() + FAR)
    assert written(poller, poller.write("a", write)) == 0


def test_writes_wait_for_what_a_former_holder_has_sent_and_keep_their_order(
    poller: ReportingPoller, fake: Fake
) -> None:
    def are_written(timeout: float) -> bool:
        fence = Fence(1)
        before = len(fake.requests)
        poller.add(device(fake, interval=0.01, timeout=timeout, fence=fence))
        opened = time.monotonic()
        fence.open(opened + FAR, settle=timeout)
        tickets = [poller.write("a", Request.write_register(3, value)) for value in range(5)]
        polls, writes = taken(poller, lambda _, writes: len(writes) == 5)
        assert polls, "it is polled meanwhile"
        # The time to settle, and the timeout of the device.
        assert time.monotonic() >= opened + 2 * timeout
        written(poller, poller.write("a", Request.write_register(3, 9)))
        poller.remove("a")
        if any(fault == TIMEOUT for _, fault in writes):
            return False
        assert writes == [(ticket, 0) for ticket in tickets]
        sent = [asked.pdu for asked in fake.requests[before:] if asked.pdu[0] == 6]
        assert [pdu[-1] for pdu in sent] == [*range(5), 9]
        return True

    wire.until_long_enough(are_written, "all are answered", 0.3)


def test_a_write_that_waits_is_refused_when_the_lease_is_lost(
    poller: ReportingPoller, fake: Fake
) -> None:
    fence = Fence(1)
    poller.add(device(fake, fence=fence))
    fence.open(time.monotonic() + FAR, settle=3600.0)
    ticket = poller.write("a", Request.write_register(3, 7))
    wire.until(lambda: fake.requests, "it is polled")
    fence.close()
    assert written(poller, ticket) == STANDBY
    assert not [asked for asked in fake.requests if asked.pdu[0] == 6]


def test_a_device_with_one_connection_is_connected_to_when_that_of_a_former_holder_has_ended(
    poller: ReportingPoller, fake: Fake
) -> None:
    fence = Fence(1)
    poller.add(device(fake, timeout=0.2, release=True, fence=fence))
    opened = time.monotonic()
    fence.open(opened + FAR, settle=0.5)
    wire.until(lambda: fake.connections, "it is polled")
    assert time.monotonic() >= opened + 0.7


@pytest.mark.parametrize("kind", ["rtu+tcp", "ascii+tcp"])
def test_other_transports_obey_too(poller: ReportingPoller, kind: str) -> None:
    with Stream(kind) as slow:
        fence = Fence(1)
        endpoint = Endpoint.network(kind, "127.0.0.1", slow.port)  # type: ignore[arg-type]
        reads = [("holding_registers", 0, 1, None)]
        settings: dict[str, Any] = {"unit": 1, "interval": 0.01, "timeout": 10.0, "reads": reads}
        poller._poller.add(
            PolledDevice("a", endpoint, fence=fence, receiver=poller.results, **settings)
        )
        write = Request.write_register(3, 7)
        assert written(poller, poller.write("a", write)) == STANDBY
        fence.open(time.monotonic() + FAR)
        taken(poller, lambda polls, _: len(polls) > 3)
        fence.close()
        wire.until(lambda: fence.in_use == 0, "nothing is in use")
        wire.until(lambda: is_disconnected(slow), "the connection is closed")


def test_a_device_that_is_replaced_while_it_stands_by_stands_by(
    poller: ReportingPoller, fake: Fake
) -> None:
    fence = Fence(1)
    poller.add(device(fake, interval=0.01, fence=fence))
    poller.replace("a", device(fake, "b", interval=0.01, fence=fence))
    wire.until(lambda: health(poller, "b") == "standby", "the new one stands by")
    assert fake.connections == 0
    fence.open(time.monotonic() + FAR)
    taken(poller, lambda polls, _: any(poll[0] == "b" for poll in polls))


def test_a_device_that_loses_its_fence_while_it_stands_by_is_polled(
    poller: ReportingPoller, fake: Fake
) -> None:
    poller.add(device(fake, fence=Fence(1)))
    wire.until(lambda: health(poller) == "standby", "it stands by")
    poller.replace("a", device(fake))
    taken(poller, lambda polls, _: any(blocks for *_, blocks in polls))
    assert health(poller) == "ok"
    assert poller.counters()["a"]["missed"] == 0
