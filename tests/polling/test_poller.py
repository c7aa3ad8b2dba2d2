"""`holdfast.Poller`: the values of tags in batches, and writes between them."""

from __future__ import annotations

import _thread
import asyncio
import contextlib
import itertools
import signal
import sys
import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import pytest

import holdfast
from holdfast import Tag, TagList
from holdfast.client.endpoint import endpoint
from holdfast.polling import Batch, DevicePoll, Poller, Reading, WriteFailed
from holdfast.polling import poller as poller_module
from holdfast.polling.faults import NO_CONNECTION
from holdfast.tags.scale import RegisterScale
from support import wire
from support.brokers import free_port
from support.fake_device import Asked, FakeDevice, Serial, Stream, exception, good, registers
from support.lines import RTU

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

PLACES: dict[str, tuple[Any, ...]] = {
    "temp": ("holding_registers", 0, "float32", "CDAB"),
    "name": ("holding_registers", 2, "string:4"),
    "flag": ("holding_registers", 4, "bit:3"),
    "many": ("input_registers", 0, "uint16[300]"),
    "on": ("coils", 3),
    "bits": ("discrete_inputs", 5, "bool[2500]"),
}


@pytest.fixture
def memory() -> holdfast.Memory:
    made = holdfast.Memory(holding_registers=10, input_registers=400, coils=8, discrete_inputs=3000)
    made.write("holding_registers", 0, [0x0000, 0x4248, 0x6162, 0x6300, 8, 215, 65535])
    made.write("input_registers", 0, list(range(300)))
    made.write("coils", 3, [1])
    made.write("discrete_inputs", 5, [1, 0, 1] + [0] * 2496 + [1])
    return made


@pytest.fixture
def device(memory: holdfast.Memory) -> Iterator[holdfast.Server]:
    with holdfast.Server({1: memory}, bind="127.0.0.1:0", access="read-write") as server:
        yield server


@pytest.fixture
def poller() -> Iterator[Poller]:
    with Poller() as made:
        yield made


def taken(poller: Poller) -> list[Reading]:
    batch = poller.take(wire.DEADLINE)
    assert batch is not None
    return list(batch)


def url(server: holdfast.Server) -> str:
    host, port = server.address
    return f"tcp://{host}:{port}"


def values(poller: Poller) -> dict[str, Any]:
    return {reading.name: reading.value for reading in taken(poller)}


def test_tags_of_every_kind_come_in_one_batch(device: holdfast.Server, poller: Poller) -> None:
    host, port = device.address
    assert poller.add(url(device), PLACES) == f"{host}:{port}"
    found = values(poller)
    assert found == {
        "temp": 50.0,
        "name": "abc",
        "flag": True,
        "many": list(range(300)),
        "on": True,
        "bits": [True, False, True] + [False] * 2496 + [True],
    }
    assert list(found) == list(PLACES)


def test_scale_markers_and_states_are_those_of_the_tag(
    device: holdfast.Server, poller: Poller
) -> None:
    scaled = Tag("t", "holding_registers", 5, scale=0.1, unit="°C")
    none = Tag("n", "holding_registers", 6, null={65535})
    poller.add(url(device), TagList([scaled, none]), name="oven")
    t, n, *_ = taken(poller)
    assert (t.device, t.tag, t.value, t.fault, t.error) == ("oven", scaled, 21.5, 0, None)
    assert (n.value, n.error) == (None, None)


def test_rows_are_plain(device: holdfast.Server, poller: Poller) -> None:
    poller.add(url(device), {"t": ("holding_registers", 5)}, name="oven")
    batch = poller.take(wire.DEADLINE)
    assert batch is not None
    assert len(batch) == 1
    [row] = batch.rows()
    time = row.pop("time")
    assert row == {"device": "oven", "tag": "t", "value": 215, "unit": "", "error": None}
    assert time == next(iter(batch)).time


def test_a_refused_address_costs_only_its_own_tag(device: holdfast.Server, poller: Poller) -> None:
    tags = {"good": ("holding_registers", 5), "bad": ("holding_registers", 10)}
    poller.add(url(device), tags, interval=0.05)

    def settled() -> bool:
        *_, good, bad = taken(poller)
        return (good.value, bad.value, bad.fault, good.fault) == (215, None, 2, 0)

    wire.until(settled, "only the bad tag is refused")


def test_a_refused_tag_does_not_cost_those_that_overlap_it(
    device: holdfast.Server, poller: Poller
) -> None:
    tags = {
        "inside": ("holding_registers", 5),
        "partly": ("holding_registers", 4, "uint32"),
        "bad": ("holding_registers", 5, "uint16[9]"),
        "last": ("holding_registers", 9),
    }
    poller.add(url(device), tags, interval=0.05)
    batches = iter(poller)
    for _ in range(3):
        for poll in next(batches).polls:
            found = {each.name: (each.value, each.fault) for each in poll.readings}
            assert found == {
                "inside": (215, 0),
                "partly": (8 << 16 | 215, 0),
                "bad": (None, 2),
                "last": (0, 0),
            }


def test_nothing_is_polled_from_all_units_of_a_line(poller: Poller) -> None:
    with pytest.raises(ValueError, match="unit 0 of a serial line is the broadcast"):
        poller.add("rtu:///dev/x", {"a": ("coils", 0)}, unit=0)
    assert poller.counters() == {}


def test_a_device_that_can_not_be_reached_has_readings_too(poller: Poller) -> None:
    tags = {"a": ("coils", 0), "b": ("input_registers", 100)}
    poller.add(f"tcp://127.0.0.1:{free_port()}", tags)
    readings = taken(poller)[:2]
    assert [(each.name, each.value, each.fault) for each in readings] == [
        ("a", None, NO_CONNECTION),
        ("b", None, NO_CONNECTION),
    ]
    assert {each.error for each in readings} == {"no connection"}


def test_what_can_not_be_decoded_says_why(
    device: holdfast.Server, memory: holdfast.Memory, poller: Poller
) -> None:
    memory.write("holding_registers", 5, [0xABCD])
    poller.add(url(device), {"b": ("holding_registers", 5, "bcd16"), "c": ("coils", 3)})
    b, c, *_ = taken(poller)
    assert (b.value, b.fault, c.value) == (None, 0, True)
    assert b.error is not None
    assert "bcd16" in b.error


def test_a_value_is_written_between_two_reads(
    device: holdfast.Server, memory: holdfast.Memory, poller: Poller
) -> None:
    scaled = Tag("t", "holding_registers", 5, scale=0.1, writable=True, min=5, max=30)
    others = [Tag("in", "input_registers", 0), Tag("fixed", "holding_registers", 6)]
    poller.add(url(device), TagList([scaled, *others]), name="oven")
    poller.write("oven", "t", 19.5)
    assert memory.read("holding_registers", 5, 1) == [195]
    for tag, value, error in (
        ("t", 31, ValueError),
        ("t", 19.55, ValueError),
        ("in", 1, ValueError),
        ("fixed", 1, ValueError),
    ):
        with pytest.raises(error):
            poller.write("oven", tag, value)
    with pytest.raises(KeyError, match="device oven has no tag 'x'"):
        poller.write("oven", "x", 1)
    with pytest.raises(KeyError, match="device 'x' is unknown, allowed: oven"):
        poller.write("x", "t", 1)
    with pytest.raises(KeyError, match="device 'x' is unknown, allowed: oven"):
        poller.remove("x")
    assert memory.read("holding_registers", 5, 1) == [195]


def test_a_write_that_is_refused_says_so(device: holdfast.Server, poller: Poller) -> None:
    poller.add(url(device), {"x": ("holding_registers", 99)}, name="oven")
    with pytest.raises(WriteFailed, match=r"oven\.x: exception 02") as caught:
        poller.write("oven", "x", 1)
    assert caught.value.fault == 2


def test_exception_00_is_an_error(poller: Poller) -> None:
    with FakeDevice(lambda pdu: exception(pdu, 0)) as device:
        poller.add(device.url, {"x": ("holding_registers", 0)}, name="oven")
        with pytest.raises(WriteFailed, match=r"oven\.x: exception 00"):
            poller.write("oven", "x", 1)
        reading = next(iter(taken(poller)))
    assert (reading.value, reading.error) == (None, "exception 00")


def test_devices_can_be_added_and_removed(device: holdfast.Server, poller: Poller) -> None:
    names = [poller.add(url(device), {"x": ("coils", 0)}, interval=0.05) for _ in range(2)]
    assert names == [at := url(device).removeprefix("tcp://"), f"{at}#1"]
    found: set[str] = set()

    def all_came() -> bool:
        found.update(reading.device for reading in taken(poller))
        return found == set(names)

    wire.until(all_came, "both devices are polled")
    poller.remove(names[0])
    assert list(poller.counters()) == names[1:]
    wire.until(lambda: {each.device for each in taken(poller)} == {names[1]}, "one is left")
    with pytest.raises(KeyError):
        poller.remove(names[0])


def test_devices_can_be_added_and_removed_by_several_threads(
    poller: Poller, monkeypatch: pytest.MonkeyPatch
) -> None:
    def yields(target: Any) -> Any:
        time.sleep(0)  # Another thread may run.
        return endpoint(target)

    monkeypatch.setattr(poller_module, "endpoint", yields)
    together = threading.Barrier(4)

    def add(_: int) -> list[str]:
        together.wait()
        return [poller.add("tcp://127.0.0.1:1", {"x": ("coils", 0)}) for _ in range(5)]

    with ThreadPoolExecutor(4) as threads:
        names = [name for added in threads.map(add, range(4)) for name in added]
        assert len(set(names)) == 20
        assert poller.counters().keys() == set(names)
        list(threads.map(poller.remove, names))
    assert poller.counters() == {}


def test_queued_polls_of_a_removed_device_are_not_those_of_the_next(
    device: holdfast.Server, poller: Poller
) -> None:
    tags = {"t": ("holding_registers", 0)}
    earlier = holdfast.Memory(holding_registers=1)
    earlier.write("holding_registers", 0, [215])
    with holdfast.Server({1: earlier}, bind="127.0.0.1:0", access="read-only") as server:
        poller.add(url(server), tags, name="oven", interval=0.01)
        wire.until(lambda: poller.counters()["oven"]["polls"] >= 3, "polls are queued")
        poller.remove("oven")
        poller.add(url(device), tags, name="oven", interval=0.01)
        wire.until(lambda: poller.counters()["oven"]["polls"] >= 3, "polls of the next are queued")
    assert {(reading.device, reading.value) for reading in taken(poller)} == {("oven", 0)}
    poller.write("oven", "t", 5)
    assert list(poller.counters()) == ["oven"]
    with pytest.raises(ValueError, match="device oven: the name is already in use"):
        poller.add(url(device), tags, name="oven")


def test_a_backlog_comes_in_several_batches(
    device: holdfast.Server, poller: Poller, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(poller_module, "MAX_CONVERTING_S", 0.0)
    poller.add(url(device), {"t": ("holding_registers", 0)}, name="oven", interval=0.01)
    # The last one that is counted may not be queued yet.
    wire.until(lambda: poller.counters()["oven"]["polls"] >= 4, "polls are queued")
    poller.close()
    batches = list(poller)
    assert len(batches) >= 3
    assert {len(batch) for batch in batches} == {1}


def test_a_tag_has_the_name_of_its_key(
    device: holdfast.Server, memory: holdfast.Memory, poller: Poller
) -> None:
    scale = RegisterScale("exponent", "power")
    tags = {
        "flow": Tag("x", "holding_registers", 5, scale=0.1, writable=True),
        "level": Tag("y", "input_registers", 300, "int16", scale=scale),
        "power": Tag("z", "input_registers", 301, "int16"),
    }
    memory.write("input_registers", 300, [3, 2])
    poller.add(url(device), tags, name="oven")
    assert values(poller) == {"flow": 21.5, "level": 300, "power": 2}
    poller.write("oven", "flow", 19.5)
    assert memory.read("holding_registers", 5, 1) == [195]
    with pytest.raises(KeyError):
        poller.write("oven", "x", 1)


def test_a_scale_that_no_request_can_reach_is_told(device: holdfast.Server, poller: Poller) -> None:
    source = Tag("", "input_registers", 100, "int16")
    power = Tag("power", "input_registers", 0, scale=RegisterScale("exponent", source=source))
    poller.add(url(device), {"power": power, "on": ("coils", 3)}, max_registers=10)
    found = {each.name: (each.value, each.fault, each.error) for each in taken(poller)}
    assert found == {
        "power": (None, 0, "no request has read it together with its scale"),
        "on": (True, 0, None),
    }


def test_a_number_is_from_one_request(
    device: holdfast.Server, memory: holdfast.Memory, poller: Poller
) -> None:
    memory.write("holding_registers", 0, [0, 1, 0, 2])
    tags = {
        "whole": ("holding_registers", 0, "uint32[2]"),
        "wide": ("holding_registers", 0, "uint64"),
    }
    poller.add(url(device), tags, max_registers=3)
    assert [(each.value, each.error) for each in taken(poller)] == [
        ([1, 2], None),
        (None, "no request has read it whole"),
    ]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"tags": {}}, "tags is empty, allowed: at least one tag"),
        ({"tags": {"x": ("coils",)}}, "the tag x is"),
        ({"tags": {"x": ("coil", 1)}}, "area is 'coil', allowed: coils"),
        ({"url": "http://a"}, "http"),
        ({"unit": 256}, "unit"),
        ({"interval": -1}, "interval"),
        ({"interval": 0}, "interval is 0, allowed: 0.01 to 31622400 seconds"),
        ({"interval": float("nan")}, "interval is nan"),
        ({"timeout": 0}, "timeout is 0, allowed: more than 0, up to 86400 seconds"),
    ],
)
def test_wrong_arguments_are_refused(
    poller: Poller, arguments: dict[str, Any], message: str
) -> None:
    settings: dict[str, Any] = {"url": "tcp://127.0.0.1", "tags": {"x": ("coils", 1)}}
    with pytest.raises(ValueError, match=message):
        poller.add(**(settings | arguments))
    assert poller.counters() == {}


@pytest.mark.parametrize("tags", [[Tag("x", "coils", 1)], [("x", "coils", 1)], None])
def test_tags_have_names(poller: Poller, tags: Any) -> None:
    found = f"tags is a {type(tags).__name__}, allowed: a holdfast.TagList, or a tag for each name"
    with pytest.raises(TypeError, match=found):
        poller.add("tcp://127.0.0.1", tags)
    assert poller.counters() == {}


@pytest.mark.parametrize(
    ("gather", "error"),
    [(-1, ValueError), (float("nan"), ValueError), (1e9, ValueError), ("x", TypeError)],
)
def test_a_wait_that_is_no_time_is_refused(gather: Any, error: type[Exception]) -> None:
    with pytest.raises(error, match=r"^gather is .*, allowed: 0 to 86400 seconds"):
        Poller(gather=gather)
    Poller(gather=0).close()


@pytest.mark.parametrize(("timeout", "error"), [(float("nan"), ValueError), ("x", TypeError)])
def test_a_timeout_of_take_is_a_number(
    poller: Poller, timeout: Any, error: type[Exception]
) -> None:
    with pytest.raises(error, match=rf"^timeout is {timeout!r}, allowed"):
        poller.take(timeout)
    assert poller.take(-1) is None


@pytest.mark.parametrize("interval", ["1", None])
def test_an_interval_is_a_number(poller: Poller, interval: Any) -> None:
    with pytest.raises(TypeError, match=f"interval is {interval!r}, allowed: 0.01 to"):
        poller.add("tcp://127.0.0.1", {"x": ("coils", 1)}, interval=interval)


@pytest.mark.parametrize(
    ("first", "second", "message"),
    [
        ("tcp://127.0.0.1:1?accept_unit=255", "tcp://127.0.0.1:1", "accept_unit is None, but"),
        ("tcp://127.0.0.1:1", "tcp://127.0.0.1:1?write_multiple=1", "write_multiple is True, but"),
        ("rtu:///dev/x", "rtu:///dev/x?baud=9600", "baud is 9600, but other devices at"),
        ("rtu:///dev/x?parity=none", "rtu:///dev/x?stop_bits=2", "parity is 'even', but"),
    ],
)
def test_devices_at_one_address_have_equal_options(
    poller: Poller, first: str, second: str, message: str
) -> None:
    tags = {"x": ("coils", 1)}
    poller.add(first, tags, name="a")
    poller.add(first, tags, name="b", unit=2)
    poller.remove("a")
    with pytest.raises(ValueError, match=message):
        poller.add(second, tags, name="c")
    with pytest.raises(ValueError, match=r"in_flight is 2, but .* have 1, allowed: the same"):
        poller.add(first, tags, name="c", in_flight=2)
    poller.remove("b")
    poller.add(second, tags, name="c")
    assert list(poller.counters()) == ["c"]


def test_a_device_that_is_added_again_has_its_own_options(poller: Poller) -> None:
    tags = {"x": ("holding_registers", 5)}

    def first(url: str) -> Reading:
        poller.add(url, tags, name="a", interval=0.01, timeout=wire.DEADLINE)
        [reading, *_] = taken(poller)
        poller.remove("a")
        return reading

    with Stream("tcp", then=lambda asked: asked.answer(unit=9)) as server:
        assert first(f"{server.url}?accept_unit=any").value == 5
        assert first(server.url).error == "an invalid reply"
        assert first(f"{server.url}?accept_unit=9").value == 5


def test_the_end_ends_the_iteration(device: holdfast.Server) -> None:
    with Poller() as poller:
        poller.add(url(device), {"x": ("coils", 3)}, interval=0.05)
        count = 0
        for batch in poller:
            count += len(batch)
            if count >= 3:
                poller.close()
    assert count >= 3
    assert poller.take(0) is None
    with pytest.raises(RuntimeError):
        poller.add("tcp://127.0.0.1", {"x": ("coils", 3)})


def test_a_batch_that_a_cancelled_task_waited_for_is_not_lost(device: holdfast.Server) -> None:
    async def first(made: Poller) -> list[Reading]:
        async for batch in made:
            return list(batch)
        raise AssertionError("the iteration has ended")

    async def steps() -> None:
        with Poller() as made:
            waiting = asyncio.ensure_future(first(made))
            await asyncio.sleep(0)
            waiting.cancel()
            with pytest.raises(asyncio.CancelledError):
                await waiting
            made.add(url(device), {"x": ("coils", 3)}, interval=3600)
            [reading] = await asyncio.wait_for(first(made), wire.DEADLINE)
            assert reading.value is True
        assert [batch async for batch in made] == []

    asyncio.run(steps())


@pytest.mark.parametrize("is_async", [True, False])
def test_a_cancelled_wait_ends_neither_the_iteration_nor_loses_its_batch(
    is_async: bool, device: holdfast.Server, poller: Poller, monkeypatch: pytest.MonkeyPatch
) -> None:
    has_come, is_cancelled = threading.Event(), threading.Event()

    def late(polls: list[DevicePoll]) -> Batch:
        has_come.set()
        is_cancelled.wait(wire.DEADLINE)
        return Batch(polls)

    monkeypatch.setattr(poller_module, "Batch", late)
    poller.add(url(device), {"x": ("coils", 3)}, interval=3600)

    async def steps() -> None:
        batches = aiter(poller)
        waiting = asyncio.ensure_future(anext(batches))
        assert await asyncio.to_thread(has_come.wait, wire.DEADLINE)
        waiting.cancel()
        with pytest.raises(asyncio.CancelledError):
            await waiting
        is_cancelled.set()
        following = anext(batches) if is_async else asyncio.to_thread(poller.take, wire.DEADLINE)
        batch = await asyncio.wait_for(following, wire.DEADLINE)
        assert batch is not None
        assert [reading.value for reading in batch] == [True]

    asyncio.run(steps())


def test_batches_of_two_cancelled_waits_come_in_order(
    device: holdfast.Server, poller: Poller, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, ends = ([threading.Event(), threading.Event()] for _ in range(2))
    made = list[Batch]()

    def late(polls: list[DevicePoll]) -> Batch:
        made.append(Batch(polls))
        number = len(made) - 1
        if number < 2:
            begun[number].set()
            ends[number].wait(wire.DEADLINE)
        return made[number]

    monkeypatch.setattr(poller_module, "Batch", late)
    poller.add(url(device), {"x": ("coils", 3)}, interval=0.01)

    async def steps() -> None:
        for waiting, has_begun, end in zip(
            [asyncio.ensure_future(anext(aiter(poller))) for _ in range(2)],
            begun,
            ends,
            strict=True,
        ):
            assert await asyncio.to_thread(has_begun.wait, wire.DEADLINE)
            waiting.cancel()
            with pytest.raises(asyncio.CancelledError):
                await waiting
            end.set()

    asyncio.run(steps())
    came = [poller.take(wire.DEADLINE) for _ in range(3)]
    assert [made.index(batch) for batch in came if batch is not None] == [0, 1, 2]


def test_a_batch_that_failed_after_its_wait_was_cancelled_is_one_error(
    device: holdfast.Server, poller: Poller, monkeypatch: pytest.MonkeyPatch
) -> None:
    has_begun, is_cancelled = threading.Event(), threading.Event()

    def fail(polls: list[DevicePoll]) -> Batch:  # noqa: ARG001
        has_begun.set()
        is_cancelled.wait(wire.DEADLINE)
        monkeypatch.undo()
        raise MemoryError

    monkeypatch.setattr(poller_module, "Batch", fail)
    poller.add(url(device), {"x": ("coils", 3)}, interval=0.01)

    async def steps() -> None:
        waiting = asyncio.ensure_future(anext(aiter(poller)))
        assert await asyncio.to_thread(has_begun.wait, wire.DEADLINE)
        waiting.cancel()
        with pytest.raises(asyncio.CancelledError):
            await waiting

    result = Future.result

    def ends_at_the_timeout(waiting: Future[Batch | None], timeout: float | None) -> Batch | None:
        try:
            return result(waiting, timeout)
        except TimeoutError:
            is_cancelled.set()
            wire.until(waiting.done, "the batch has failed")
            raise

    asyncio.run(steps())
    monkeypatch.setattr(Future, "result", ends_at_the_timeout)
    assert poller.take(0) is None
    with pytest.raises(MemoryError):
        poller.take(wire.DEADLINE)
    assert len(taken(poller)) > 0


def test_an_iteration_can_be_closed_and_another_goes_on(
    device: holdfast.Server, poller: Poller
) -> None:
    poller.add(url(device), {"x": ("coils", 3)}, interval=0.01)

    async def steps() -> None:
        for _ in range(2):
            batches: Any = aiter(poller)
            async with contextlib.aclosing(batches):
                await asyncio.wait_for(anext(batches), wire.DEADLINE)

    asyncio.run(steps())


def test_a_batch_that_a_closed_event_loop_waited_for_is_not_lost(
    device: holdfast.Server, poller: Poller
) -> None:
    async def first() -> list[Reading]:
        return list(await anext(aiter(poller)))

    async def given_up() -> None:
        waiting = asyncio.ensure_future(first())
        await asyncio.sleep(0)
        waiting.cancel()
        with pytest.raises(asyncio.CancelledError):
            await waiting

    loop = asyncio.new_event_loop()
    loop.run_until_complete(given_up())
    loop.close()
    poller.add(url(device), {"x": ("coils", 3)}, interval=3600)
    [reading] = asyncio.run(asyncio.wait_for(first(), wire.DEADLINE))
    assert reading.value is True


def test_a_write_that_a_close_has_interrupted_may_have_been_carried_out(poller: Poller) -> None:
    def close(asked: Asked) -> None:
        poller.close()
        asked.answer()

    reads = {"x": ("holding_registers", 5)}
    with Stream("tcp", good, then=close) as server:
        poller.add(server.url, reads, name="oven", interval=3600, timeout=wire.DEADLINE)
        taken(poller)
        with pytest.raises(WriteFailed, match=r"oven\.x: the poller was closed"):
            poller.write("oven", "x", 1)
    assert [asked.pdu[0] for asked in server.requests] == [3, 6]
    with pytest.raises(RuntimeError):
        poller.write("oven", "x", 1)


@pytest.fixture
def _ctrl_c() -> Iterator[None]:
    """Ctrl-C is an exception, also in jobs of a shell that ignore it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("_ctrl_c")
def test_a_write_that_a_signal_interrupts_is_not_sent_later(poller: Poller) -> None:
    interrupted, main = threading.Event(), threading.get_ident()

    def hold(asked: Asked) -> None:
        interrupted.wait(wire.DEADLINE)
        asked.answer()

    def is_waiting() -> bool:
        frame = sys._current_frames()[main]
        return frame.f_code is Poller.write.__code__ and "number" in frame.f_locals

    def interrupt() -> None:
        wire.until(is_waiting, "the write waits")
        _thread.interrupt_main()

    with Stream("tcp", hold) as server, ThreadPoolExecutor(1) as other:
        reads = {"x": ("holding_registers", 5)}
        poller.add(server.url, reads, name="oven", interval=0.05, timeout=wire.DEADLINE)
        server.await_requests(1)
        interrupting = other.submit(interrupt)
        with pytest.raises(KeyboardInterrupt):
            poller.write("oven", "x", 1)
        interrupted.set()
        interrupting.result()
        wire.until(lambda: len(server.requests) >= 3, "it is polled again")
    assert {asked.pdu[0] for asked in server.requests} == {3}


def test_a_scale_in_a_register_is_that_of_the_same_poll(
    poller: Poller, device: holdfast.Server, memory: holdfast.Memory
) -> None:
    scale = RegisterScale("exponent", "sf")
    power = Tag("power", "input_registers", 0, "int16", scale=scale)
    steps = itertools.cycle([[432, 1], [4320, 0], [1, 0x8000]])

    def step() -> None:
        number, exponent = next(steps)
        memory.write_many([("input_registers", 0, [number]), ("input_registers", 100, [exponent])])

    step()
    tags = TagList([power, Tag("sf", "input_registers", 100, "int16")])
    poller.add(url(device), tags, interval=0.01)
    seen: set[tuple[Any, bool]] = set()

    def known() -> bool:
        step()
        for reading in taken(poller):
            if reading.name == "power":
                seen.add((reading.value, reading.error is None))
        return len(seen) >= 2 and (None, False) in seen

    wire.until(known, "numbers and bad values")
    assert seen == {(4320, True), (None, False)}


def test_a_write_needs_a_scale_that_was_read(poller: Poller, device: holdfast.Server) -> None:
    source = Tag("", "holding_registers", 6, "int16")
    scale = RegisterScale("exponent", source=source)
    tags = TagList([Tag("limit", "holding_registers", 5, scale=scale, writable=True)])
    name = poller.add(url(device), tags)
    with pytest.raises(ValueError, match="the scale is in holding_registers 6"):
        poller.write(name, "limit", 20)


# Serial lines


def adapter(device: Path, value: int) -> Serial:
    """A serial adapter. Registers of all units at its line have one value."""
    return Serial(RTU, device, then=lambda asked: asked.answer(registers(asked.pdu, value)))


@pytest.mark.parametrize("between", [False, True], ids=["", "after others"])
def test_a_line_is_closed_before_it_is_opened_with_other_settings(
    poller: Poller, device: holdfast.Server, tmp_path: Path, *, between: bool
) -> None:
    begun, go_on = threading.Event(), threading.Event()

    def hold(asked: Asked) -> None:
        begun.set()
        assert go_on.wait(wire.DEADLINE)
        asked.answer()

    tags = {"x": ("holding_registers", 5)}
    with Serial(RTU, tmp_path / "line", hold) as line:
        poller.add(line.url, tags, name="a", timeout=2 * wire.DEADLINE)
        assert begun.wait(wire.DEADLINE)
        poller.remove("a")
        poller.add(url(device), {"y": ("coils", 3)}, name="other", interval=0.01)
        if between:
            poller.add(f"{line.url}&close_after=4", tags, name="between")
            poller.remove("between")
            wire.until(lambda: poller.counters()["other"]["polls"] >= 5, "it had time to close")
        url_of_b = f"{line.url}&close_after=3"
        poller.add(url_of_b, tags, name="b", interval=0.01, timeout=2 * wire.DEADLINE)
        polls = poller.counters()["other"]["polls"] + 5
        wire.until(lambda: poller.counters()["other"]["polls"] >= polls, "b had time to open it")
        go_on.set()
        found: list[Reading] = []

        def is_read() -> bool:
            found.extend(each for each in taken(poller) if each.device == "b")
            return bool(found)

        wire.until(is_read, "b is read")
        assert (found[0].value, found[0].error) == (5, None)
        poller.close()


def plugged(link: Path, device: Path) -> None:
    """From now on, `link` names the adapter `device`."""
    link.unlink(missing_ok=True)
    link.symlink_to(device)


def add_at(poller: Poller, link: Path, name: str, unit: int = 1) -> None:
    # The line is opened for each request: nobody has it open when its adapter is exchanged.
    line = f"rtu://{link}?parity=none&baud=4000000&close_after=1"
    poller.add(line, {"value": ("holding_registers", 0)}, name=name, unit=unit, interval=0.01)


def until_read(poller: Poller, name: str, value: int) -> None:
    """Waits until a device has a value."""

    def is_read() -> bool:
        return any((each.device, each.value) == (name, value) for each in taken(poller))

    wire.until(is_read, f"{name} has {value}")


def test_a_device_has_the_line_that_its_url_names_now(poller: Poller, tmp_path: Path) -> None:
    a, b = tmp_path / "by-id-a", tmp_path / "by-id-b"
    one, two = tmp_path / "ttyUSB0", tmp_path / "ttyUSB1"
    with adapter(one, 1), adapter(two, 2):
        plugged(a, one)
        plugged(b, two)
        add_at(poller, a, "a")
        add_at(poller, b, "b")
        until_read(poller, "a", 1)
        until_read(poller, "b", 2)
        plugged(a, two)
        plugged(b, one)
        until_read(poller, "a", 2)
        until_read(poller, "b", 1)

        add_at(poller, a, "new", unit=2)
        until_read(poller, "new", 2)
        poller.close()


def test_a_serial_line_has_one_name(poller: Poller, tmp_path: Path) -> None:
    link, device = tmp_path / "by-id", tmp_path / "ttyUSB0"
    plugged(link, device)
    with adapter(device, 1):
        add_at(poller, link, "a")
        with pytest.raises(ValueError, match=r"another name, allowed: '.*/by-id'"):
            add_at(poller, device, "b", unit=2)
        poller.close()
