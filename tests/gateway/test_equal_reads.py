"""Equal reads that wait for a device: one request answers them, and none gets an older value."""

from __future__ import annotations

import asyncio
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import pytest

from holdfast._core import Request
from holdfast.client.url import NetworkTarget
from holdfast.gateway.device_routes import Route
from holdfast.gateway.pool import Pool
from support import gateways, wire
from support.fake_device import HANG_UP, Stream, Udp, exception, registers, silent
from support.routed import Held

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from support import web
    from support.fake_device import Asked
    from support.gateways import Running

MINUTE = 60_000
"""A timeout in milliseconds that no test waits for."""


class Asking:
    """Sends requests to one device through a gateway, each in a thread of its own."""

    def __init__(self, gateway: Running, threads: ThreadPoolExecutor) -> None:
        self.gateway = gateway
        self._threads = threads
        self._client = gateway.client()
        self._requests = 0

    def start(self, device: Stream | Udp, path: str = "/read", **body: Any) -> Future[web.Answer]:
        """Returns when the request is at the device, or waits for it."""
        transport, _, address = device.url.partition("://")
        host, _, port = address.rpartition(":")
        where = {"host": host, "port": int(port), "transport": transport, "timeout": MINUTE}
        what = {"functionCode": 3, "address": 5} if path == "/read" else {}
        self._requests += 1
        answer = self._threads.submit(self.gateway.ask, path, {**where, **what, **body})
        wire.until(self._has_all, "the request has arrived")
        # It has been queued, or sent, when a request after it has an answer.
        self._requests += 1
        assert self._client.get("/api/gateway").status == 200
        return answer

    def hold_back(self, device: Stream | Udp) -> Future[web.Answer]:
        """A read that is in flight until the device is released, so that others wait."""
        first = self.start(device, address=100)
        device.await_requests(1)
        return first

    def _has_all(self) -> bool:
        return self.gateway.gateway.status()["requests"] == self._requests


@pytest.fixture
def asking() -> Iterator[Asking]:
    with gateways.running() as gateway, ThreadPoolExecutor(16) as threads:
        yield Asking(gateway, threads)


def values(answers: list[Future[web.Answer]]) -> list[Any]:
    return [each.result(wire.DEADLINE).json["values"] for each in answers]


class Counter:
    """Behaves as a device whose registers all have the number of the request that reads them."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, asked: Asked) -> None:
        self.count += 1
        asked.answer(registers(asked.pdu, self.count))


@pytest.mark.parametrize("kind", ["tcp", "rtu+tcp", "udp"])
def test_one_request_answers_all_that_wait(asking: Asking, kind: str) -> None:
    held = Held()
    with Udp(held) if kind == "udp" else Stream(kind, held) as device:
        first = asking.hold_back(device)
        equal = [asking.start(device, quantity=2) for _ in range(8)]
        typed = asking.start(device, datatype="float32", timeout=MINUTE - 1)
        held.release()
        assert values([first, *equal, typed]) == [[100], *[[5, 6]] * 9]
        assert typed.result().json["typedText"] == ["4.59186e-40"]
        assert len(device.requests) == 2


def test_a_read_that_is_sent_already_is_not_joined(asking: Asking) -> None:
    """Whether it was sent at once, or had waited."""
    helds, counter = [Held(), Held()], Counter()

    def held_back(asked: Asked) -> None:
        counter.count += 1
        asked.reply = registers(asked.pdu, counter.count)
        helds[counter.count - 1](asked)

    with Stream("tcp", held_back, held_back, then=counter) as device:
        first = asking.start(device)
        device.await_requests(1)
        second = [asking.start(device) for _ in range(3)]
        helds[0].release()
        device.await_requests(2)
        third = [asking.start(device) for _ in range(3)]
        helds[1].release()
        assert values([first, *second, *third]) == [[1], *[[2]] * 3, *[[3]] * 3]


def test_a_read_does_not_pass_a_write_before_it(asking: Asking) -> None:
    held = Held()
    with Stream("tcp", held) as device:
        first = asking.hold_back(device)
        before = [asking.start(device) for _ in range(2)]
        write = asking.start(device, "/write/register", address=5, value=77)
        after = [asking.start(device) for _ in range(2)]
        held.release()
        assert write.result(wire.DEADLINE).json["success"]
        assert values([first, *before, *after]) == [[100], [5], [5], [77], [77]]
    assert [asked.pdu[0] for asked in device.requests] == [3, 3, 6, 3]


@pytest.mark.parametrize(
    ("path", "body", "function"),
    [
        ("/write/coil", {"address": 1, "value": True}, 5),
        ("/readwrite", {"readAddress": 0, "readQuantity": 1, "writeAddress": 5, "values": [9]}, 23),
        ("/diagnostics", {}, 8),
    ],
)
def test_reads_are_not_shared_across_a_request_that_may_change_something(
    asking: Asking, path: str, body: dict[str, Any], function: int
) -> None:
    held = Held()
    with Stream("tcp", held) as device:
        first = asking.hold_back(device)
        before = asking.start(device)
        between = asking.start(device, path, **body)
        after = asking.start(device)
        held.release()
        assert all(each.result(wire.DEADLINE) for each in (first, before, between, after))
    assert [asked.pdu[0] for asked in device.requests] == [3, 3, function, 3]


def test_what_differs_is_never_shared(asking: Asking) -> None:
    """The unit id, the function, the address, the quantity and the device."""
    held = Held()

    def own(asked: Asked) -> None:
        asked.answer(registers(asked.pdu, 10 * asked.unit + asked.pdu[0]))

    def held_back(asked: Asked) -> None:
        asked.reply = registers(asked.pdu)
        held(asked)

    with Stream("tcp", held_back, then=own) as device, Stream("tcp") as other:
        first = asking.hold_back(device)
        bodies: list[dict[str, Any]] = [
            {"unitId": 2},
            {"unitId": 3},
            {"functionCode": 4},
            {"address": 6},
            {"quantity": 2},
        ]
        several = [asking.start(device, **body) for body in bodies]
        elsewhere = asking.start(other)
        assert values([elsewhere]) == [[5]]
        held.release()
        assert values(several) == [[23], [33], [14], [13], [13, 13]]
        assert first.result().json["success"]
        assert len(device.requests) == 6


@pytest.mark.parametrize("leaves", [0, 1, 2])
def test_a_caller_that_gives_up_leaves_the_others(asking: Asking, leaves: int) -> None:
    held = Held()
    with Stream("tcp", held) as device:
        first = asking.hold_back(device)
        timeouts = [MINUTE] * 3
        timeouts[leaves] = 200
        equal = [asking.start(device, timeout=timeout) for timeout in timeouts]
        gone = equal.pop(leaves).result(wire.DEADLINE)
        assert "waited behind other requests" in gone.json["error"]
        held.release()
        assert values([first, *equal]) == [[100], [5], [5]]
        assert len(device.requests) == 2


def test_a_read_that_all_callers_gave_up_is_not_sent(asking: Asking) -> None:
    held = Held()
    with Stream("tcp", held) as device:
        first = asking.hold_back(device)
        equal = [asking.start(device, timeout=100) for _ in range(2)]
        assert all("was not sent" in each.result(wire.DEADLINE).json["error"] for each in equal)
        last = asking.start(device, address=6)
        held.release()
        assert values([first, last]) == [[100], [6]]
        assert [asked.pdu[2] for asked in device.requests] == [100, 6]


@pytest.mark.parametrize("kind", ["tcp", "rtu+tcp"])
def test_a_caller_that_gives_up_a_sent_read_leaves_the_others(asking: Asking, kind: str) -> None:
    def is_sent(timeout: float) -> bool:
        held, slow = Held(), Held()
        with Stream(kind, held, slow) as device:
            first = asking.hold_back(device)
            impatient = asking.start(device, timeout=round(1000 * timeout))
            patient = asking.start(device)
            held.release()
            assert values([first]) == [[100]]
            told = impatient.result(wire.DEADLINE).json["error"]
            slow.release()
            assert values([patient]) == [[5]]
            assert (len(device.requests), device.connections) == (2, 1)
        return bool(told == "Connection timeout")

    wire.until_long_enough(is_sent, "the read is sent before a caller gives up")


def test_a_sent_read_that_all_callers_gave_up_ends(asking: Asking) -> None:
    def is_sent(timeout: float) -> bool:
        held = Held()
        with Stream("tcp", held, silent) as device:
            first = asking.hold_back(device)
            equal = [asking.start(device, timeout=round(1000 * timeout)) for _ in range(2)]
            held.release()
            assert values([first]) == [[100]]
            told = [each.result(wire.DEADLINE).json["error"] for each in equal]
            if told != ["Connection timeout"] * 2:
                return False
            # It would have to wait for a minute, were the one before it still under way.
            assert values([asking.start(device, address=6)]) == [[6]]
            assert device.connections == 2
        return True

    wire.until_long_enough(is_sent, "the read is sent before its callers give up")


@pytest.mark.parametrize(
    ("behaviour", "status", "says"),
    [
        (lambda asked: asked.answer(exception(asked.pdu, 2)), 200, "Illegal data address"),
        (lambda asked: asked.end_with(HANG_UP), 500, "closed by the peer"),
        (lambda asked: asked.answer(b"\x04\x02\0\7"), 500, "function code 0x04, expected 0x03"),
    ],
    ids=["an exception", "the end of the connection", "another function"],
)
def test_what_goes_wrong_is_told_to_all(
    asking: Asking, behaviour: Callable[[Asked], object], status: int, says: str
) -> None:
    held = Held()
    with Stream("tcp", held, then=behaviour) as device:
        first = asking.hold_back(device)
        equal = [asking.start(device) for _ in range(3)]
        held.release()
        answers = [each.result(wire.DEADLINE) for each in equal]
        assert [each.status for each in answers] == [status] * 3
        assert all(says.lower() in each.json["error"].lower() for each in answers)
        assert values([first]) == [[100]]
    # A read is repeated once if its connection, which was used before, has ended.
    assert len(device.requests) <= 3


def test_a_late_reply_answers_nobody(asking: Asking) -> None:
    """After the callers of an equal read have given up."""

    def is_sent(timeout: float) -> bool:
        held, counter = Held(), Counter()
        late: list[Asked] = []

        def first_late(asked: Asked) -> None:
            asked.peer.send(late[0].frame(registers(asked.pdu, 99)))
            counter(asked)

        with Stream("tcp", held, late.append, first_late, then=counter) as device:
            first = asking.hold_back(device)
            equal = [asking.start(device, timeout=round(1000 * timeout)) for _ in range(2)]
            held.release()
            assert values([first]) == [[100]]
            told = [each.result(wire.DEADLINE).json["error"] for each in equal]
            if told != ["Connection timeout"] * 2:
                return False
            assert values([asking.start(device), asking.start(device)]) == [[1], [2]]
        return True

    wire.until_long_enough(is_sent, "the read is sent before its callers give up")


class SlowTransport:
    """Keeps its calls until each is released."""

    late, longest_late = 0, 0.0

    def __init__(self) -> None:
        self.calls: list[tuple[int, asyncio.Event]] = []

    async def call(
        self,
        request: Request,
        unit: int,  # noqa: ARG002
        timeout: float,  # noqa: ARG002
        note_sent: Callable[[], None] | None = None,  # noqa: ARG002
    ) -> Any:
        released = asyncio.Event()
        self.calls.append((request.pdu[0], released))
        await released.wait()
        return [0]

    async def close(self) -> None:
        pass


def test_a_write_whose_caller_gives_up_when_its_turn_comes_is_not_sent() -> None:
    transport = SlowTransport()
    target = NetworkTarget("tcp", "127.0.0.1", 502)
    route = Route(target, (target,))

    async def run() -> None:
        pool = Pool(most=1, in_flight=1, idle=60, dial=lambda _target, _in_flight: transport)

        def start(request: Request) -> asyncio.Task[Any]:
            return asyncio.create_task(
                pool.run(route, 60, lambda turns: turns.call(request, 1, 60))
            )

        reads = [start(Request.read("coils", number, 1)) for number in range(2)]
        write = start(Request.write_register(0, 1))
        while not transport.calls:
            await asyncio.sleep(0)
        transport.calls[0][1].set()
        while len(transport.calls) < 2:
            await asyncio.sleep(0)
        # The pool goes on first, when the caller of the write can't have left its queue.
        transport.calls[1][1].set()
        write.cancel()
        assert await asyncio.gather(*reads) == [[0], [0]]
        with pytest.raises(asyncio.CancelledError):
            await write
        last = start(Request.read("coils", 9, 1))
        while len(transport.calls) < 3:
            await asyncio.sleep(0)
        transport.calls[2][1].set()
        assert await last == [0]

    asyncio.run(asyncio.wait_for(run(), wire.DEADLINE))
    assert [code for code, _ in transport.calls] == [1, 1, 1]
