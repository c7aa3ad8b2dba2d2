"""The gateway of an appliance: devices that the appliance uses are asked over its connections."""

from __future__ import annotations

import socket
import threading
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest

from holdfast.config import load
from holdfast.gateway import device as gateway_device
from holdfast.gateway.device import RequestedDevice
from support import wire
from support.fake_device import HANG_UP, FakeDevice, Stream, exception, silent
from support.machine import needs_127_0_0_2
from support.routed import Held, await_count, counters
from support.running import endpoint
from support.shared import Careful, ask, polled, read, unanswered, with_gateway

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from holdfast.appliance import Appliance
    from support.fake_device import Asked
    from support.running import Connect, Run

READ = bytes.fromhex("0300050001")
UNSENT = (
    "Connection timeout: the request was not sent: there was no connection, or it waited behind "
    "other requests to this device"
)


@pytest.fixture
def threads() -> Iterator[ThreadPoolExecutor]:
    with ThreadPoolExecutor(16) as made:
        yield made


def failure(answer: Any) -> tuple[int, str, str]:
    return answer.status, answer.headers["holdfast-reason"], answer.json["error"]


def held_back(appliance: Appliance, threads: ThreadPoolExecutor, held: Stream) -> Any:
    """A read that is in flight until the device is released, so that others wait."""
    first = threads.submit(read, appliance, held.port, 100)
    held.await_requests(1)
    return first


def test_polls_routes_and_the_gateway_share_one_connection(
    run: Run, connect: Connect, threads: ThreadPoolExecutor
) -> None:
    careful = Careful()
    with Stream("tcp", then=careful, in_turn=True) as device:
        appliance = run(with_gateway(device.url, **polled(device.url)))
        front = connect(endpoint(appliance, "scada"))
        asked = [threads.submit(read, appliance, device.port, number) for number in range(60)]
        for number in range(60):
            assert front.ask(b"\3" + number.to_bytes(2) + b"\0\1")[2:] == number.to_bytes(2)
        answers = [each.result().json["values"] for each in asked]
        wire.until(lambda: appliance.memories["plant"].read("holding_registers", 9, 1) == [9], "it")
    assert answers == [[number] for number in range(60)]
    assert (device.connections, careful.overlaps) == (1, 0)


def test_a_device_that_is_only_polled_is_shared_too(run: Run) -> None:
    with Stream("tcp", in_turn=True) as device, Stream("tcp") as other:
        appliance = run(with_gateway(other.url, **polled(device.url)))
        wire.until(lambda: device.requests, "it is polled")
        assert read(appliance, device.port, 7).json["values"] == [7]
    assert device.connections == 1


def test_another_device_is_asked_over_a_connection_of_the_gateway(run: Run) -> None:
    with Stream("tcp") as device, Stream("tcp") as other:
        appliance = run(with_gateway(device.url))
        assert read(appliance, other.port, 7).json["values"] == [7]
        assert (device.connections, other.connections) == (0, 1)
    assert counters(appliance)["requests"] == 0


def test_a_device_that_is_configured_by_its_name_is_shared_when_asked_by_it(run: Run) -> None:
    with Stream("tcp", in_turn=True) as device:
        url = f"tcp://LOCALHOST:{device.port}"
        appliance = run(with_gateway(url, **polled(url)))
        wire.until(lambda: device.requests, "it is polled")
        body = {"host": "localhost", "functionCode": 3, "address": 7}
        assert ask(appliance, "/read", device.port, **body).json["values"] == [7]
    assert device.connections == 1


@pytest.fixture
def moved(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """When called, lets the gateway find another address of `localhost` than the appliance."""
    real = socket.getaddrinfo

    def elsewhere(host: Any, *arguments: Any, **options: Any) -> Any:
        return real("127.0.0.2" if host == "localhost" else host, *arguments, **options)

    return lambda: monkeypatch.setattr(socket, "getaddrinfo", elsewhere)


@needs_127_0_0_2
@pytest.mark.parametrize("is_polled", [True, False])
@pytest.mark.parametrize("kind", ["tcp", "rtu+tcp"])
def test_a_connection_by_name_to_another_address_is_not_taken(
    run: Run, moved: Callable[[], None], kind: str, is_polled: bool
) -> None:
    with Stream(kind, in_turn=True) as device:
        url = f"{kind}://localhost:{device.port}"
        appliance = run(with_gateway(url, **(polled(url) if is_polled else {})))
        wire.until(lambda: device.requests or not is_polled, "it is polled")
        moved()
        body = {"host": "localhost", "transport": kind, "address": 7, "value": 1}
        answer = ask(appliance, "/write/register", device.port, **body)
        assert failure(answer)[:2] == (500, "no_connection")
    assert {asked.pdu[0] for asked in device.requests} == ({3} if is_polled else set())
    assert device.connections == is_polled


@needs_127_0_0_2
def test_an_equal_read_over_a_connection_to_another_address_is_not_shared(
    run: Run, connect: Connect, threads: ThreadPoolExecutor, moved: Callable[[], None]
) -> None:
    held = Held()
    with Stream("tcp", held) as device:
        appliance = run(with_gateway(f"tcp://localhost:{device.port}"))
        fronts = [connect(endpoint(appliance, "scada")) for _ in range(2)]
        first = threads.submit(fronts[0].ask, bytes.fromhex("0300640001"))
        device.await_requests(1)
        routed = threads.submit(fronts[1].ask, READ)
        await_count(appliance, "waiting", 2)
        moved()
        named = threads.submit(read, appliance, device.port, 5, host="localhost")
        await_count(appliance, "waiting", 3)
        held.release()
        assert failure(named.result())[:2] == (500, "no_connection")
        assert (first.result()[2:], routed.result()[2:]) == (b"\0\x64", b"\0\5")


def test_all_writes_take_the_shared_connection(run: Run) -> None:
    with Stream("tcp", in_turn=True) as device:
        appliance = run(with_gateway(device.url))
        for path, body in (
            ("/write/register", {"address": 1, "value": 51}),
            ("/write/registers", {"address": 2, "values": [52, 53]}),
            ("/write/mask", {"address": 3, "andMask": 0xFFF0, "orMask": 2}),
            ("/write/coil", {"address": 4, "value": True}),
            ("/write/coils", {"address": 5, "values": [1, 1]}),
        ):
            assert ask(appliance, path, device.port, **body).json["success"], path
        assert read(appliance, device.port, 1, quantity=3).json["values"] == [51, 52, 50]
    assert device.connections == 1
    assert counters(appliance)["requests"] == 6


def test_single_writes_take_the_functions_for_several_where_the_device_needs_it(run: Run) -> None:
    with Stream("tcp", in_turn=True) as device:
        url = f"{device.url}?write_multiple=1"
        appliance = run(with_gateway(url))
        assert ask(appliance, "/write/register", device.port, address=1, value=51).json["success"]
        assert ask(appliance, "/write/coil", device.port, address=4, value=True).json["success"]
        assert read(appliance, device.port, 1).json["values"] == [51]
    assert [asked.pdu[0] for asked in device.requests] == [16, 15, 3]


def test_single_writes_to_a_device_that_is_only_polled_do_so_too(run: Run) -> None:
    with Stream("tcp", in_turn=True) as device, Stream("tcp") as other:
        appliance = run(with_gateway(other.url, **polled(f"{device.url}?write_multiple=1")))
        assert ask(appliance, "/write/register", device.port, address=1, value=51).json["success"]
    assert 16 in {asked.pdu[0] for asked in device.requests}


def test_a_silent_device_is_waited_for_no_longer_than_by_clients_of_the_link(run: Run) -> None:
    with Stream("tcp", then=silent) as device:
        appliance = run(with_gateway(device.url, link={"timeout": 0.1}))
        asked = ask(appliance, "/read", device.port, functionCode=3, address=5, timeout=60_000)
    assert failure(asked) == (500, "timeout", "Connection timeout")


def test_a_reload_changes_how_long_the_gateway_waits_for_a_silent_device(
    run: Run, tmp_path: Path
) -> None:
    with Stream("tcp", then=silent) as device:
        appliance = run(with_gateway(device.url))
        file = tmp_path / "appliance.yaml"
        file.write_text(with_gateway(device.url, link={"timeout": 0.1}))
        appliance.reload(load(file))
        asked = ask(appliance, "/read", device.port, functionCode=3, address=5, timeout=60_000)
    assert failure(asked) == (500, "timeout", "Connection timeout")


def test_a_read_of_the_gateway_always_asks_the_device(run: Run) -> None:
    with Stream("tcp", in_turn=True) as device:
        appliance = run(with_gateway(device.url, link={"cache": 3600}))
        assert [read(appliance, device.port, 5).json["values"] for _ in range(2)] == [[5], [5]]
    assert len(device.requests) == 2


MAX_TIMEOUT = 60_000
"""The longest timeout of a request in milliseconds, for what does not wait for it."""

FAULTS: dict[str, tuple[Callable[[Asked], object], int, int, str, str]] = {
    "silence": (silent, 300, 500, "timeout", "Connection timeout"),
    "the end of the connection": (
        lambda asked: asked.end_with(HANG_UP),
        MAX_TIMEOUT,
        500,
        "connection_lost",
        "connection lost: closed by the peer",
    ),
    "another function": (
        lambda asked: asked.answer(b"\x04\x02\0\7"),
        MAX_TIMEOUT,
        500,
        "invalid_reply",
        "invalid response: function code 0x04, expected 0x03",
    ),
}


@pytest.mark.parametrize("fault", FAULTS.values(), ids=FAULTS)
def test_failures_are_those_of_a_connection_of_its_own(
    run: Run, fault: tuple[Callable[[Asked], object], int, int, str, str]
) -> None:
    behaviour, timeout, *expected = fault
    with Stream("tcp", then=behaviour) as device, Stream("tcp", then=behaviour) as other:
        appliance = run(with_gateway(device.url))
        found = [
            failure(read(appliance, port, 5, timeout=timeout)) for port in (device.port, other.port)
        ]
    assert found == [tuple(expected)] * 2
    assert counters(appliance)["requests"] == 1


@pytest.mark.parametrize("code", [1, 2, 4, 6, 10, 11, 0x55])
def test_an_exception_is_that_of_the_device(run: Run, code: int) -> None:
    with FakeDevice(lambda pdu: exception(pdu, code)) as device:
        appliance = run(with_gateway(device.url))
        answer = read(appliance, device.port, 5)
    assert answer.status == 200
    assert answer.json["success"] is False
    assert f"(code 0x{code:x})" in answer.json["error"]


def test_a_refused_connection_is_explained_before_and_during_the_pause(run: Run) -> None:
    device = Stream("tcp")
    device.release()
    appliance = run(with_gateway(device.url))
    refused = f"can't connect to 127.0.0.1:{device.port}: Connection refused"
    for _ in range(3):
        found = failure(read(appliance, device.port, 5))
        assert found == (500, "no_connection", refused)
    assert counters(appliance)["requests"] == 3


def test_a_silent_unit_is_asked_whenever_the_gateway_wants(run: Run, connect: Connect) -> None:
    """A survey must find out for each address; its timeouts do not count for others."""
    with Stream("tcp", *[silent] * 5) as device:
        appliance = run(with_gateway(device.url))
        for _ in range(5):
            assert failure(read(appliance, device.port, 5, timeout=50))[1] == "timeout"
        front = connect(endpoint(appliance, "scada"))
        assert front.ask(READ) == bytes.fromhex("03020005")
    assert counters(appliance)["refused_down"] == 0


def test_a_write_that_was_given_up_before_its_turn_is_never_sent(
    run: Run, threads: ThreadPoolExecutor
) -> None:
    held = Held()
    with Stream("tcp", held) as device:
        appliance = run(with_gateway(device.url))
        first = held_back(appliance, threads, device)
        late = ask(appliance, "/write/register", device.port, address=5, value=1, timeout=50)
        assert failure(late) == (500, "timeout", UNSENT)
        held.release()
        assert first.result().json["values"] == [100]
        assert read(appliance, device.port, 6).json["values"] == [6]
        await_count(appliance, "withdrawn", 1)
    assert [asked.pdu[0] for asked in device.requests] == [3, 3]


KINDS = [("tcp", True), ("tcp", False), ("rtu+tcp", False)]


@pytest.mark.parametrize(("kind", "is_shared"), KINDS)
def test_a_write_is_not_sent_if_its_client_goes_during_a_standstill(
    run: Run, monkeypatch: pytest.MonkeyPatch, kind: str, is_shared: bool
) -> None:
    arrived, goes_on = threading.Event(), threading.Event()
    ask_device = RequestedDevice.ask

    async def stands_still(self: RequestedDevice, call: Any) -> Any:
        arrived.set()
        assert goes_on.wait(wire.DEADLINE)
        return await ask_device(self, call)

    with Stream(kind) as device, Stream("tcp") as other:
        appliance = run(with_gateway((device if is_shared else other).url))
        where = {"transport": kind}
        assert read(appliance, device.port, 7, **where).json["values"] == [7]
        monkeypatch.setattr(RequestedDevice, "ask", stands_still)
        body = {"host": "127.0.0.1", "port": device.port, **where, "address": 9, "value": 1}
        gone = unanswered(appliance, "/write/register", body)
        assert arrived.wait(wire.DEADLINE)
        gone.close()
        goes_on.set()
        assert read(appliance, device.port, 8, **where).json["values"] == [8]
    assert {asked.pdu[0] for asked in device.requests} == {3}


@pytest.mark.parametrize(("kind", "is_shared"), KINDS)
def test_a_write_is_not_sent_after_its_timeout_has_passed_in_a_standstill(
    run: Run, monkeypatch: pytest.MonkeyPatch, kind: str, is_shared: bool
) -> None:
    with Stream(kind) as device, Stream("tcp") as other:
        appliance = run(with_gateway((device if is_shared else other).url))
        clock = SimpleNamespace(now=iter([0.0, *[61.0] * 9]).__next__)
        monkeypatch.setattr(gateway_device, "standstill", clock)
        body = {"transport": kind, "timeout": 60_000, "address": 9, "value": 1}
        answer = ask(appliance, "/write/register", device.port, **body)
        assert failure(answer) == (500, "timeout", UNSENT)
        assert answer.headers["holdfast-maybe-written"] == "false"
        assert not device.requests


@pytest.mark.parametrize("is_shared", [True, False], ids=["shared", "own"])
def test_a_write_without_a_connection_was_not_sent(
    run: Run, threads: ThreadPoolExecutor, *, is_shared: bool
) -> None:
    with wire.dead_address() as (_, port), Stream("tcp") as other:
        used = port if is_shared else other.port
        appliance = run(with_gateway(f"tcp://127.0.0.1:{used}"))
        # The turn of the second one comes when the first one has ended.
        late = [
            threads.submit(
                ask, appliance, "/write/register", port, address=5, value=1, timeout=timeout
            )
            for timeout in (100, 300)
        ]
        for each in late:
            answer = each.result()
            assert failure(answer) == (500, "timeout", UNSENT)
            assert answer.headers["holdfast-maybe-written"] == "false"


def test_a_device_that_returns_has_its_new_settings(run: Run, tmp_path: Path) -> None:
    with Stream("tcp", in_turn=True) as device, Stream("tcp") as other:
        file = tmp_path / "appliance.yaml"
        before = polled(device.url)
        appliance = run(with_gateway(other.url, **before))
        assert read(appliance, device.port, 5).json["values"] == [5]
        for sections in ({**before, "devices": {}}, polled(f"{device.url}?write_multiple=1")):
            file.write_text(with_gateway(other.url, **sections))
            appliance.reload(load(file))
        assert ask(appliance, "/write/register", device.port, address=1, value=51).json["success"]
        assert 16 in {asked.pdu[0] for asked in device.requests}


def test_a_write_goes_before_reads_that_wait(run: Run, threads: ThreadPoolExecutor) -> None:
    held = Held()
    with Stream("tcp", held) as device:
        appliance = run(with_gateway(device.url))
        first = held_back(appliance, threads, device)
        later = []
        for number in range(3):
            later.append(threads.submit(read, appliance, device.port, number))
            await_count(appliance, "waiting", 2 + number)
        body = {"address": 5, "value": 1}
        later.append(threads.submit(ask, appliance, "/write/register", device.port, **body))
        await_count(appliance, "waiting", 5)
        # The link takes requests in order: once it has this one, it has them all.
        later.append(threads.submit(read, appliance, device.port, 1))
        await_count(appliance, "coalesced", 1)
        held.release()
        assert all(each.result().json["success"] for each in [first, *later])
    assert [asked.pdu[0] for asked in device.requests] == [3, 6, 3, 3, 3]


def test_equal_reads_that_wait_are_answered_by_one_request(
    run: Run, connect: Connect, threads: ThreadPoolExecutor
) -> None:
    held = Held()
    with Stream("tcp", held) as device:
        appliance = run(with_gateway(device.url))
        first = held_back(appliance, threads, device)
        equal = [threads.submit(read, appliance, device.port, 5) for _ in range(8)]
        front = connect(endpoint(appliance, "scada"))
        routed = threads.submit(front.ask, READ)
        # One of them waits; the others wait for its reply.
        await_count(appliance, "coalesced", 8)
        held.release()
        assert first.result().json["values"] == [100]
        assert [each.result().json["values"] for each in equal] == [[5]] * 8
        assert routed.result() == bytes.fromhex("03020005")
    assert len(device.requests) == 2
    assert counters(appliance)["coalesced"] == 8


def test_the_gateway_leaves_room_in_the_queue(run: Run, threads: ThreadPoolExecutor) -> None:
    held = Held()
    with Stream("tcp", held) as device:
        appliance = run(with_gateway(device.url, link={"queue": 8}))
        first = held_back(appliance, threads, device)
        more = []
        for number in range(3):
            more.append(threads.submit(read, appliance, device.port, number))
            await_count(appliance, "waiting", 2 + number)
        full = f"too many requests wait for 127.0.0.1:{device.port}, try again later"
        assert failure(read(appliance, device.port, 50)) == (503, "busy", full)
        held.release()
        assert all(each.result().json["success"] for each in [first, *more])


def test_a_broadcast_takes_the_shared_connection(run: Run) -> None:
    with Stream("rtu+tcp", silent, in_turn=True) as device:
        appliance = run(with_gateway(device.url))
        body = {"transport": "rtu+tcp", "unitId": 0, "address": 5, "value": 1}
        answer = ask(appliance, "/write/register", device.port, **body)
        assert answer.json["note"] == "the broadcast was sent; devices do not confirm broadcasts"
        more = {"transport": "rtu+tcp"}
        assert read(appliance, device.port, 6, **more).json["values"] == [6]
    assert [(asked.unit, asked.pdu[0]) for asked in device.requests] == [(0, 6), (1, 3)]


def test_a_request_in_flight_is_answered_when_the_appliance_stops(
    run: Run, threads: ThreadPoolExecutor
) -> None:
    held = Held()
    with Stream("tcp", held) as device:
        appliance = run(with_gateway(device.url))
        first = held_back(appliance, threads, device)
        stopped = threads.submit(appliance.stop)
        held.release()
        assert first.result().json["values"] == [100]
        stopped.result()


def test_a_client_that_goes_away_leaves_the_connection_to_others(run: Run) -> None:
    held = Held()
    with Stream("tcp", held) as device:
        appliance = run(with_gateway(device.url))
        body = {"host": "127.0.0.1", "port": device.port, "functionCode": 3, "address": 1}
        left = unanswered(appliance, "/read", body)
        device.await_requests(1)
        left.close()
        held.release()
        assert read(appliance, device.port, 6).json["values"] == [6]
    assert device.connections == 1
