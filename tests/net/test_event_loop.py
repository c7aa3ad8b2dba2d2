"""The event loop that does not wait for lookups of names, and the fastest one."""

from __future__ import annotations

import asyncio
import socket
import sys
import threading

import pytest

from holdfast.net import event_loop


def test_its_end_does_not_wait_for_a_lookup(monkeypatch: pytest.MonkeyPatch) -> None:
    begun, answers = threading.Event(), threading.Event()

    def slow(*_: object, **__: object) -> list[object]:
        begun.set()
        answers.wait()
        return []

    async def main() -> None:
        connecting = asyncio.create_task(asyncio.open_connection("broker.example", 4222))
        while not begun.is_set():
            await asyncio.sleep(0)
        connecting.cancel()

    monkeypatch.setattr(socket, "getaddrinfo", slow)
    try:
        event_loop.run(main())
    finally:
        answers.set()


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1"])
def test_it_connects_to_names_and_addresses(host: str) -> None:
    async def main() -> bytes:
        with socket.create_server(("127.0.0.1", 0)) as listener:
            reader, writer = await asyncio.open_connection(host, listener.getsockname()[1])
            accepted, _ = listener.accept()
            with accepted:
                accepted.sendall(b"here")
            received = await reader.read()
            writer.close()
            await writer.wait_closed()
            return received

    assert event_loop.run(main()) == b"here"


def test_a_name_that_is_not_known_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(*_: object, **__: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    async def main() -> None:
        await asyncio.open_connection("broker.example", 4222)

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    with pytest.raises(OSError, match="Name or service not known"):
        event_loop.run(main())


def test_a_name_without_an_address_of_the_family_is_told() -> None:
    async def main() -> None:
        await asyncio.open_connection("127.0.0.1", 4222, family=socket.AF_INET6)

    with pytest.raises(OSError, match=r"family|Name or service not known"):
        event_loop.run(main())


def test_what_is_no_lookup_for_a_connection_is_as_usual() -> None:
    async def main() -> object:
        loop = asyncio.get_running_loop()
        return await loop.getaddrinfo(None, 502, family=socket.AF_INET, type=socket.SOCK_DGRAM)

    usual = socket.getaddrinfo(None, 502, family=socket.AF_INET, type=socket.SOCK_DGRAM)
    assert event_loop.run(main()) == usual


def test_the_fastest_loop_is_that_of_uvloop() -> None:
    uvloop = pytest.importorskip("uvloop", reason="there is none for Windows")

    async def main() -> bool:
        return isinstance(asyncio.get_running_loop(), uvloop.Loop)

    assert event_loop.run(main(), event_loop.fastest)


def test_the_fastest_loop_without_uvloop_is_the_usual_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "uvloop", None)

    async def main() -> type:
        return type(asyncio.get_running_loop())

    assert event_loop.run(main(), event_loop.fastest) == asyncio.run(main())
