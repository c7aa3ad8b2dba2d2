"""Devices that deviate from the standard: each fails a client that follows it, and works with the
option that tolerates what the device does.
"""

from __future__ import annotations

import asyncio
import threading
import time
from contextlib import ExitStack, suppress
from functools import partial
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from holdfast.client.tolerance import Tolerance
from holdfast.client.url import NetworkTarget, in_folder, parse
from support import wire
from support.faces import FACES, Dial, connected, dialling, run
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

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from support.fake_device import Behaviour

SHORT = 0.1
"""Seconds that are waited for."""

FRAMED = ("rtu+tcp", "ascii+tcp", "rtu+udp")
NETWORK = ("tcp", "udp", *FRAMED)


@pytest.fixture(params=FACES)
def dial(request: pytest.FixtureRequest) -> Iterator[Dial]:
    yield from dialling(request.param)


class Make:
    """Makes devices that stop when the test ends."""

    def __init__(self, stack: ExitStack) -> None:
        self._stack = stack

    def __call__(self, kind: str, *script: Behaviour, **options: Any) -> ScriptedDevice:
        made: ScriptedDevice
        if kind in DATAGRAMS:
            made = Udp(*script, kind=kind, **options)
        else:
            made = Stream(kind, *script, **options)
        return self._stack.enter_context(made)


@pytest.fixture
def make() -> Iterator[Make]:
    with ExitStack() as stack:
        yield Make(stack)


def connections(device: ScriptedDevice) -> int:
    assert isinstance(device, Stream)
    return device.connections


def close(asked: Asked) -> None:
    assert isinstance(asked.peer, Connection)
    asked.peer.close()


def codes(device: ScriptedDevice) -> list[int]:
    """The functions that were asked for, in order."""
    return [asked.pdu[0] for asked in device.requests]


# New transports


@pytest.mark.parametrize("kind", FRAMED)
def test_frames_of_a_serial_line_travel_over_a_network(kind: str, make: Make, dial: Dial) -> None:
    device = make(kind)
    client = dial(device.url)

    client.write_registers(7, [70, 80])
    client.write_coil(3, True)
    assert client.read_holding_registers(6, 4) == [6, 70, 80, 9]
    assert client.read_coils(2, 3) == [False, True, False]
    with pytest.raises(holdfast.ModbusException, match="exception 02"):
        client.read_holding_registers(1000, 1)
    assert len(device.requests) == 5
    if kind == "ascii+tcp":
        assert {asked.raw[:1] for asked in device.requests} == {b":"}


@pytest.mark.parametrize("kind", FRAMED)
def test_a_late_reply_of_such_a_device_is_not_taken_for_the_next(
    kind: str, make: Make, dial: Dial
) -> None:
    device = make(kind, good, silent)
    client = connected(dial, device.url, SHORT)
    with pytest.raises(holdfast.RequestTimeout):
        client.read_holding_registers(7, 1)
    device.await_requests(2)
    device.requests[1].answer()
    client.timeout = wire.DEADLINE

    assert client.read_holding_registers(8, 1) == [8]


@pytest.mark.parametrize("kind", FRAMED)
def test_a_second_reply_of_such_a_device_is_not_taken_for_the_next(
    kind: str, make: Make, dial: Dial
) -> None:
    sent = threading.Event()

    def twice(asked: Asked) -> None:
        asked.send(asked.frame(), asked.frame())
        sent.set()

    device = make(kind, twice)
    client = dial(device.url)

    assert client.read_holding_registers(7, 1) == [7]
    assert sent.wait(wire.DEADLINE)
    # Whatever the device sends unasked comes before the reply that it sends next.
    assert client.read_holding_registers(8, 1) == [8]


@pytest.mark.parametrize("kind", FRAMED)
def test_a_datagram_or_stream_without_a_reply_times_out_and_is_sent_once(
    kind: str, make: Make, dial: Dial
) -> None:
    device = make(kind, good, silent)
    client = connected(dial, device.url, SHORT)
    with pytest.raises(holdfast.RequestTimeout):
        client.read_holding_registers(7, 1)
    client.timeout = wire.DEADLINE
    assert client.read_holding_registers(8, 1) == [8]
    assert len(device.requests) == 3


# accept_unit


def from_unit_9(asked: Asked) -> None:
    asked.answer(unit=9)


@pytest.mark.parametrize("kind", ["tcp", *FRAMED])
def test_a_reply_from_another_unit_is_invalid_unless_accepted(
    kind: str, make: Make, dial: Dial
) -> None:
    device = make(kind, then=from_unit_9)

    with pytest.raises(holdfast.InvalidResponse) as caught:
        dial(device.url).read_holding_registers(7, 2)
    assert caught.value.reason == "unit_id"
    for unit in ("any", 9):
        client = dial(f"{device.url}?accept_unit={unit}")
        assert client.read_holding_registers(7, 2) == [7, 8]
        client.write_register(7, 7)
    with pytest.raises(holdfast.InvalidResponse):
        dial(f"{device.url}?accept_unit=8").read_holding_registers(7, 2)


def test_a_datagram_from_another_unit_is_late_unless_accepted(make: Make, dial: Dial) -> None:
    device = make("udp", then=from_unit_9)

    with pytest.raises(holdfast.RequestTimeout):
        dial(device.url, timeout=SHORT).read_holding_registers(7, 2)
    assert dial(f"{device.url}?accept_unit=9").read_holding_registers(7, 2) == [7, 8]


# pad


def padded(asked: Asked) -> None:
    asked.answer(asked.reply + b"\0\0")


@pytest.mark.parametrize("kind", ["tcp", "udp", "ascii+tcp"])
def test_surplus_bytes_of_a_reply_are_invalid_unless_ignored(
    kind: str, make: Make, dial: Dial
) -> None:
    device = make(kind, then=padded)

    with pytest.raises(holdfast.InvalidResponse) as caught:
        dial(device.url).read_holding_registers(7, 2)
    assert caught.value.reason == "length"
    client = dial(f"{device.url}?pad=1")
    assert client.read_holding_registers(7, 2) == [7, 8]
    client.write_registers(7, [70])
    assert client.read_holding_registers(7, 2) == [70, 8]
    with pytest.raises(holdfast.ModbusException, match="exception 02"):
        client.read_holding_registers(1000, 1)
    if kind != "udp":
        assert connections(device) == 2


def with_the_length_of_the_data(asked: Asked) -> None:
    asked.send(wire.frame(b"\x83\x02", 1, asked.transaction, length=7))


def test_an_exception_with_a_wrong_length_times_out_unless_tolerated(
    make: Make, dial: Dial
) -> None:
    device = make("tcp", good, then=with_the_length_of_the_data)

    with pytest.raises(holdfast.RequestTimeout):
        connected(dial, device.url, SHORT).read_holding_registers(7, 2)
    client = dial(f"{device.url}?pad=1")
    for _ in range(2):
        with pytest.raises(holdfast.ModbusException, match="exception 02"):
            client.read_holding_registers(7, 2)
    device.then = good
    assert client.read_holding_registers(7, 2) == [7, 8]
    assert connections(device) == 2


# echo


def only_echoing(asked: Asked) -> None:
    asked.send(asked.raw)


def echoing(asked: Asked) -> None:
    asked.send(asked.raw)
    asked.answer()


@pytest.mark.parametrize("kind", FRAMED)
def test_an_echo_is_no_confirmation_of_a_write_where_it_is_announced(
    kind: str, make: Make, dial: Dial
) -> None:
    """Without a reply, the echo of a write looks like its confirmation."""
    device = make(kind, then=only_echoing)
    dial(device.url).write_register(7, 70)

    device.then = echoing
    client = connected(dial, f"{device.url}?echo=1", SHORT)
    device.then = only_echoing
    with pytest.raises(holdfast.RequestTimeout):
        client.write_register(7, 70)

    device.then = echoing
    client.timeout = wire.DEADLINE
    client.write_register(7, 70)
    client.write_registers(8, [80])
    assert client.read_holding_registers(7, 2) == [70, 80]


@pytest.mark.parametrize("kind", ["rtu+tcp", "ascii+tcp"])
def test_an_echo_over_tcp_is_noticed_by_the_first_read(kind: str, make: Make, dial: Dial) -> None:
    device = make(kind, then=echoing)
    client = dial(device.url)

    assert client.read_holding_registers(7, 2) == [7, 8]
    client.write_register(7, 70)
    assert client.read_holding_registers(7, 2) == [70, 8]
    assert (connections(device), len(device.requests)) == (1, 3)


# pause, pause_after_connect: the device drops what comes too early


class Slow:
    """Answers only requests that come so many seconds after the last one, or after connecting."""

    def __init__(self, seconds: float, *, at_first: bool) -> None:
        self._at_first = at_first
        self.begin(seconds)

    def begin(self, seconds: float) -> None:
        """Takes so much time from now on, and is ready."""
        self._seconds = seconds
        self._ready = 0.0

    def greet(self, *_: object) -> None:
        if self._at_first:
            self._ready = time.monotonic() + self._seconds

    def __call__(self, asked: Asked) -> None:
        ready = time.monotonic() >= self._ready
        if not self._at_first:
            self._ready = time.monotonic() + self._seconds
        if ready:
            asked.answer()


def test_a_device_that_needs_a_pause_after_each_request_gets_it(make: Make, dial: Dial) -> None:
    slow = Slow(wire.DEADLINE, at_first=False)
    device = make("tcp", then=slow)
    hasty = dial(device.url)
    assert hasty.read_holding_registers(7, 1) == [7]
    hasty.timeout = SHORT
    with pytest.raises(holdfast.RequestTimeout):
        hasty.read_holding_registers(7, 1)

    slow.begin(SHORT)
    client = dial(f"{device.url}?pause={2 * SHORT}")
    for _ in range(3):
        assert client.read_holding_registers(7, 1) == [7]
    assert len(device.requests) == 5


@pytest.mark.parametrize("option", ["pause", "pause_after_connect"])
def test_a_call_that_is_cancelled_during_a_pause_sends_nothing(option: str) -> None:
    async def is_cancelled(pause: float) -> bool:
        began = time.monotonic()
        with Stream("tcp") as device:
            url = f"{device.url}?{option}={pause}"
            async with holdfast.Client(url, timeout=wire.DEADLINE) as plc:
                if option == "pause":
                    await plc.read_holding_registers(6, 1)
                task = asyncio.create_task(plc.write_register(7, 70))
                await asyncio.to_thread(wire.until, lambda: connections(device), "it connects")
                await asyncio.sleep(0)
                task.cancel()
                await asyncio.wait([task])
                if time.monotonic() - began >= pause:
                    return False
                assert task.cancelled()
                assert await plc.read_holding_registers(7, 1) == [7]
            assert 6 not in codes(device)
            return True

    wire.until_long_enough(lambda pause: run(partial(is_cancelled, pause)), "it is cancelled")


@pytest.mark.parametrize("kind", ["tcp", "rtu+tcp", "ascii+tcp"])
def test_a_device_that_needs_a_pause_after_connecting_gets_it(
    kind: str, make: Make, dial: Dial
) -> None:
    def device_that_needs(seconds: float) -> ScriptedDevice:
        slow = Slow(seconds, at_first=True)
        return make(kind, then=slow, greet=slow.greet)

    with pytest.raises(holdfast.RequestTimeout):
        dial(device_that_needs(wire.DEADLINE).url, timeout=SHORT).read_holding_registers(7, 1)

    def is_answered(pause: float) -> bool:
        # The device may notice a connection later than its client.
        device = device_that_needs(pause / 2)
        client = dial(f"{device.url}?pause_after_connect={pause}", timeout=10 * pause)
        with suppress(holdfast.RequestTimeout):
            assert client.read_holding_registers(7, 1) == [7]
            client.timeout = wire.DEADLINE
            assert client.read_holding_registers(8, 1) == [8]
            assert len(device.requests) == 2
            return True
        return False

    wire.until_long_enough(is_answered, "the device is ready")


# retries, retry_busy


@pytest.mark.parametrize("kind", [kind for kind in NETWORK if kind != "udp"])
def test_a_read_that_fails_is_retried_as_often_as_allowed(
    kind: str, make: Make, dial: Dial
) -> None:
    def is_sent(times: int, timeout: float) -> bool:
        """Whether a silent device gets a read so often; never more often.

        Less often on a loaded machine: the timeout of each try includes connecting.
        """
        device = make(kind, then=silent)
        client = dial(f"{device.url}?retries={times - 1}", timeout=timeout)
        with pytest.raises(holdfast.RequestTimeout):
            client.read_holding_registers(7, 1)
        assert len(device.requests) <= times
        return len(device.requests) == times

    def is_answered(timeout: float) -> bool:
        client = dial(f"{make(kind, silent).url}?retries=1", timeout=timeout)
        with suppress(holdfast.RequestTimeout):
            assert client.read_holding_registers(7, 1) == [7]
            return True
        return False

    for retries in (0, 2):
        wire.until_long_enough(partial(is_sent, 1 + retries), "all are sent")
    wire.until_long_enough(is_answered, "the retry is answered")


@pytest.mark.parametrize("options", ["retries=2", "pause=0.01"])
@pytest.mark.parametrize("kind", ["tcp", "rtu+tcp"])
def test_a_timeout_is_told_as_it_was_given(kind: str, options: str, make: Make, dial: Dial) -> None:
    client = dial(f"{make(kind, good, then=silent).url}?{options}")
    assert client.read_holding_registers(7, 1) == [7]
    client.timeout = 0.05
    with pytest.raises(
        holdfast.RequestTimeout, match=r"^no (reply|connection to \S+) within 0\.05 s$"
    ):
        client.read_holding_registers(8, 2)


@pytest.mark.parametrize("failure", [silent, from_unit_9, close])
@pytest.mark.parametrize("kind", ["tcp", "rtu+tcp"])
def test_a_write_is_never_retried(failure: Behaviour, kind: str, make: Make, dial: Dial) -> None:
    device = make(kind, good, failure)
    client = dial(f"{device.url}?retries=3&retry_busy=1", timeout=SHORT)
    client.timeout = wire.DEADLINE
    assert client.read_holding_registers(7, 1) == [7]
    client.timeout = SHORT
    with pytest.raises(holdfast.ModbusError):
        client.write_register(7, 70)
    client.timeout = wire.DEADLINE
    assert client.read_holding_registers(8, 1) == [8]
    assert codes(device) == [3, 6, 3]


@pytest.mark.parametrize("code", [5, 6])
def test_a_busy_device_is_asked_again(code: int, make: Make, dial: Dial) -> None:
    def busy(asked: Asked) -> None:
        asked.answer(bytes([asked.pdu[0] | 0x80, code]))

    device = make("tcp", busy, busy, busy)
    with pytest.raises(holdfast.ModbusException, match=f"exception 0{code}"):
        dial(f"{device.url}?retries=1").read_holding_registers(7, 1)

    client = dial(f"{device.url}?retries=2&retry_busy=1")
    assert client.read_holding_registers(7, 1) == [7]
    assert len(device.requests) == 4
    device.then = busy
    with pytest.raises(holdfast.ModbusException):
        client.write_register(7, 70)
    assert len(device.requests) == 5


# A device that closes the connection after each reply


def answer_and_close(asked: Asked) -> None:
    asked.answer()
    close(asked)


@pytest.mark.parametrize("kind", ["tcp", "rtu+tcp", "ascii+tcp"])
def test_reads_from_a_device_that_closes_after_each_reply_all_come(
    kind: str, make: Make, dial: Dial
) -> None:
    device = make(kind, then=answer_and_close)
    client = dial(device.url)

    for address in range(20):
        assert client.read_holding_registers(address, 1) == [address]


def test_calls_at_once_to_a_device_that_closes_after_each_reply_all_come(make: Make) -> None:
    device = make("tcp", then=answer_and_close)

    async def main() -> None:
        async with holdfast.Client(device.url, timeout=wire.DEADLINE) as plc:
            reads = [plc.read_holding_registers(address, 1) for address in range(20)]
            assert await asyncio.gather(*reads) == [[address] for address in range(20)]

    run(main)


@pytest.mark.parametrize("kind", ["tcp", "rtu+tcp", "ascii+tcp"])
def test_a_write_to_a_device_that_closes_is_never_sent_twice(
    kind: str, make: Make, dial: Dial
) -> None:
    device = make(kind, then=answer_and_close)
    client = dial(device.url)
    sent = 0
    for value in range(20):
        try:
            client.write_register(7, value)
            sent += 1
        except holdfast.ConnectionLost as error:
            sent += error.maybe_sent
    values = [int.from_bytes(asked.pdu[3:5]) for asked in device.requests]
    assert values == sorted(set(values))
    assert len(values) <= sent


@pytest.mark.parametrize("kind", ["tcp", "rtu+tcp", "ascii+tcp"])
@pytest.mark.parametrize("every", [1, 3])
def test_close_after_leaves_a_device_that_closes_no_call_to_lose(
    every: int, kind: str, make: Make, dial: Dial
) -> None:
    count = 0

    def answer(asked: Asked) -> None:
        nonlocal count
        count += 1
        asked.answer()
        if count % every == 0:
            close(asked)

    device = make(kind, then=answer)
    client = dial(f"{device.url}?close_after={every}")
    for value in range(9):
        client.write_register(7, value)
    assert codes(device) == [6] * 9
    assert connections(device) == 9 // every


def test_reconnecting_waits_as_long_as_a_device_needs(make: Make, dial: Dial) -> None:
    """The device drops connections that come too soon after the last one."""
    seconds, ready = wire.DEADLINE, 0.0
    dropped: list[object] = []

    def greet(peer: Connection, _: int) -> None:
        if time.monotonic() < ready:
            dropped.append(peer)
            peer.close()

    def answer_once(asked: Asked) -> None:
        nonlocal ready
        if asked.peer not in dropped:
            ready = time.monotonic() + seconds
            asked.answer()

    device = make("tcp", then=answer_once, greet=greet)
    hasty = dial(f"{device.url}?close_after=1")
    assert hasty.read_holding_registers(7, 1) == [7]
    with pytest.raises(holdfast.ConnectionLost):
        hasty.read_holding_registers(7, 1)

    seconds, ready = SHORT, 0.0
    client = dial(f"{device.url}?close_after=1&reconnect={2 * SHORT}")
    for _ in range(3):
        assert client.read_holding_registers(7, 1) == [7]
    assert (len(dropped), connections(device)) == (1, 5)


# Requests in flight


def test_a_client_has_one_request_in_flight() -> None:
    async def main() -> None:
        with Stream("tcp", then=silent) as device:
            async with holdfast.Client(device.url, timeout=wire.DEADLINE) as plc:
                tasks = [asyncio.create_task(plc.read_holding_registers(at, 1)) for at in range(4)]
                for number in range(4):
                    await asyncio.to_thread(device.await_requests, number + 1)
                    device.requests[number].answer()
                    assert await tasks[number] == [number]

    run(main)


@pytest.mark.parametrize("option", ["pause=0.001", "close_after=100"])
def test_some_options_leave_one_request_in_flight(option: str) -> None:
    async def main() -> None:
        with Stream("tcp", then=silent) as device:
            url = f"{device.url}?{option}"
            async with holdfast.Client(url, timeout=wire.DEADLINE, max_in_flight=8) as plc:
                tasks = [asyncio.create_task(plc.read_holding_registers(at, 1)) for at in range(4)]
                for number in range(4):
                    await asyncio.to_thread(device.await_requests, number + 1)
                    device.requests[number].answer()
                    assert await tasks[number] == [number]

    run(main)


def test_a_gateway_that_answers_one_after_the_other_has_the_whole_timeout_for_each() -> None:
    """Six requests at once, which take longer than the timeout together."""

    async def are_answered(timeout: float) -> bool:
        waiting: list[Asked] = []
        with Stream("tcp", then=waiting.append) as device:
            async with holdfast.Client(device.url, timeout=timeout, max_in_flight=6) as plc:
                tasks = [asyncio.create_task(plc.read_holding_registers(at, 1)) for at in range(6)]
                await asyncio.to_thread(device.await_requests, 6)
                for task, asked in zip(tasks, waiting, strict=True):
                    await asyncio.sleep(timeout / 4)
                    asked.answer()
                    try:
                        assert await task == [asked.pdu[2]]
                    except holdfast.RequestTimeout:
                        await asyncio.gather(*tasks, return_exceptions=True)
                        return False
                assert (device.connections, plc.late) == (1, 0)
                return True

    wire.until_long_enough(
        lambda timeout: run(partial(are_answered, timeout)), "all are answered", 0.4
    )


# A device without functions 5 and 6


@pytest.mark.parametrize("kind", ["tcp", "udp", "rtu+tcp", "ascii+tcp"])
def test_single_writes_take_the_functions_for_several(kind: str, make: Make, dial: Dial) -> None:
    device = make(kind)
    client = dial(f"{device.url}?write_multiple=1")
    client.write_register(7, 70)
    client.write("holding_registers", 8, -1, "int16")
    client.write_coil(3, True)
    client.write_registers(9, [90, 100])
    assert codes(device) == [16, 16, 15, 16]
    assert client.read_holding_registers(7, 4) == [70, 0xFFFF, 90, 100]
    assert client.read_coils(2, 3) == [False, True, False]


# URLs


ALL_OPTIONS = (
    "accept_unit=any&pad=1&pause=0.5&pause_after_connect=1&retries=2&retry_busy=1"
    "&close_after=100&reconnect=60&write_multiple=1"
)
ALL = Tolerance(
    accept_unit="any",
    pad=True,
    pause=0.5,
    pause_after_connect=1.0,
    retries=2,
    retry_busy=True,
    close_after=100,
    reconnect=60.0,
    write_multiple=True,
)


@pytest.mark.parametrize(
    "place", [*[f"{kind}://plc" for kind in (*NETWORK, "tls")], "rtu:///dev/a", "ascii:///dev/a"]
)
def test_every_url_has_the_options(place: str) -> None:
    assert parse(f"{place}?{ALL_OPTIONS}").tolerance == ALL
    assert parse(place).tolerance == Tolerance()
    assert parse(f"{place}?accept_unit=0").tolerance == Tolerance(accept_unit=0)


@pytest.mark.parametrize(
    ("option", "text"),
    [
        ("accept_unit=256", "accept_unit is '256', allowed: any, 0 to 255"),
        ("accept_unit=all", "accept_unit is 'all'"),
        ("accept_unit=-1", "accept_unit is '-1'"),
        ("pad=yes", "pad is 'yes', allowed: 0, 1"),
        ("pause=60.1", "pause is '60.1', allowed: seconds, up to 60"),
        ("pause=-1", "pause is '-1'"),
        ("pause=nan", "pause is 'nan'"),
        ("pause_after_connect=61", "pause_after_connect is '61', allowed: seconds, up to 60"),
        ("retries=11", "retries is '11', allowed: 0 to 10"),
        ("retries=1.5", "retries is '1.5'"),
        ("retry_busy=2", "retry_busy is '2', allowed: 0, 1"),
        ("close_after=65536", "close_after is '65536', allowed: 0 to 65535"),
        ("reconnect=", "reconnect is '', allowed: seconds, up to 60"),
        ("pad=1&pad=1", "option 'pad' is given twice"),
    ],
)
@pytest.mark.parametrize("place", ["tcp://plc", "tls://plc", "rtu+udp://plc", "rtu:///dev/a"])
def test_options_have_limits(place: str, option: str, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        parse(f"{place}?{option}")


@pytest.mark.parametrize("kind", ["tcp", "tls", "udp"])
def test_echo_is_an_option_of_rtu_and_ascii_frames(kind: str) -> None:
    with pytest.raises(ValueError, match="unknown option 'echo'"):
        parse(f"{kind}://plc?echo=1")
    for framed in FRAMED:
        assert parse(f"{framed}://plc?echo=1").tolerance == Tolerance(echo=True)


def test_options_stay_when_files_become_absolute(tmp_path: Path) -> None:
    url = "tls://plc:1802?pad=1&ca=ca.pem&retries=2&name=plc7&close_after=1"

    changed = in_folder(url, tmp_path)

    target, before = parse(changed), parse(url)
    assert isinstance(target, NetworkTarget)
    assert isinstance(before, NetworkTarget)
    assert target.tolerance == before.tolerance
    assert target.tls == before.tls.in_folder(tmp_path)
    assert changed.count("name=") == 1
    assert in_folder(f"tcp://plc?{ALL_OPTIONS}", tmp_path) == f"tcp://plc?{ALL_OPTIONS}"
