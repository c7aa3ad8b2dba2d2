"""Names of devices: lookups that take long, and names with several addresses."""

from __future__ import annotations

import asyncio
import copy
import socket
import threading
from contextlib import suppress
from typing import TYPE_CHECKING

import pytest

import holdfast
from support import wire
from support.fake_device import Stream, silent

if TYPE_CHECKING:
    from collections.abc import Iterator

FOUND = (socket.AF_INET, socket.SOCK_STREAM, 6, "")


async def read(url: str, timeout: float) -> list[int]:
    async with holdfast.Client(url, timeout=timeout) as plc:
        return await plc.read_holding_registers(7, 1)


@pytest.fixture
def unanswered(monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Event]:
    """No lookup ends before the test. The event is set when one has begun."""
    begun, ended = threading.Event(), threading.Event()

    def slow(*_: object, **__: object) -> list[object]:
        begun.set()
        ended.wait()
        return []

    monkeypatch.setattr(socket, "getaddrinfo", slow)
    yield begun
    ended.set()


def test_a_lookup_has_the_timeout_of_the_request(unanswered: threading.Event) -> None:
    """Neither the call nor the end of the event loop waits for it."""
    expected = r"^no connection to tcp://plc7:502 within 0\.1 s: its name was not resolved$"
    with pytest.raises(holdfast.RequestTimeout, match=expected):
        asyncio.run(read("tcp://plc7", 0.1))
    assert unanswered.is_set()


def test_a_call_that_is_cancelled_leaves_its_lookup_behind(unanswered: threading.Event) -> None:
    async def main() -> None:
        # Another name than before: equal lookups are shared, and the last one may still end.
        reading = asyncio.create_task(read("tcp://plc8", 10 * wire.DEADLINE))
        assert await asyncio.to_thread(unanswered.wait, wire.DEADLINE)
        reading.cancel()
        with pytest.raises(asyncio.CancelledError):
            await reading

    asyncio.run(main())


def test_a_connection_that_is_not_made_in_time_is_told_without_the_name() -> None:
    with wire.dead_address() as (host, port):
        expected = rf"^no connection to tcp://{host}:{port} within 0\.1 s$"
        with pytest.raises(holdfast.RequestTimeout, match=expected) as awaited:
            asyncio.run(read(f"tcp://{host}:{port}", 0.1))
        with (
            holdfast.SyncClient(f"tcp://{host}:{port}", timeout=0.1) as plc,
            pytest.raises(holdfast.RequestTimeout, match=expected) as blocking,
        ):
            plc.read_holding_registers(7, 1)
    assert not awaited.value.maybe_sent
    assert not blocking.value.maybe_sent
    assert copy.copy(awaited.value).maybe_sent is False


def test_a_request_without_a_reply_may_have_been_sent() -> None:
    with (
        Stream("tcp", then=silent) as device,
        holdfast.SyncClient(device.url, timeout=0.1) as plc,
        pytest.raises(holdfast.RequestTimeout) as error,
    ):
        plc.read_holding_registers(7, 1)
    assert error.value.maybe_sent


def test_a_name_that_is_not_known_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(*_: object, **__: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    expected = r"^can't connect to tcp://plc9:502: Name or service not known$"
    with pytest.raises(holdfast.ConnectFailed, match=expected):
        asyncio.run(read("tcp://plc9", wire.DEADLINE))


def test_a_dead_address_of_a_name_leaves_time_for_the_next(monkeypatch: pytest.MonkeyPatch) -> None:
    with Stream("tcp") as device, wire.dead_address() as dead:
        found = [(*FOUND, address) for address in (dead, ("127.0.0.1", device.port))]
        monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: found)

        def is_read(timeout: float) -> bool:
            with suppress(holdfast.RequestTimeout):
                assert asyncio.run(read(f"tcp://plc7:{device.port}", timeout)) == [7]
                return True
            return False

        wire.until_long_enough(is_read, "the other address answers in its share")


@pytest.mark.parametrize("kind", ["tcp", "rtu+tcp"])
def test_a_blocking_client_finds_a_device_by_name(kind: str) -> None:
    with (
        Stream(kind) as device,
        holdfast.SyncClient(f"{kind}://localhost:{device.port}", timeout=wire.DEADLINE) as plc,
    ):
        assert plc.read_holding_registers(7, 1) == [7]
