"""A blocking interface for both clients, so that the same tests cover both."""

from __future__ import annotations

import asyncio
import threading
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, Protocol, cast

import holdfast
from support import wire

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterator
    from typing import TypeVar

    Result = TypeVar("Result")

Face = holdfast.SyncClient
"""A blocking client, or an `Awaited` with the same methods."""


class Awaited:
    """A `Client` in an event loop that runs in its own thread."""

    def __init__(self, url: str, **options: Any) -> None:
        self._client = holdfast.Client(url, **options)
        self._loop = asyncio.new_event_loop()
        self._loop.set_debug(True)
        self._faults: list[dict[str, Any]] = []
        self._loop.set_exception_handler(lambda _, fault: self._faults.append(fault))
        self._thread = threading.Thread(target=self._loop.run_forever)
        self._thread.start()

    def __getattr__(self, name: str) -> Any:
        attribute = getattr(self._client, name)
        if not asyncio.iscoroutinefunction(attribute):
            return attribute
        return lambda *args, **named: self._wait(attribute(*args, **named))

    @property
    def timeout(self) -> float:
        return self._client.timeout

    @timeout.setter
    def timeout(self, seconds: float) -> None:
        self._client.timeout = seconds

    def end(self) -> None:
        """Closes everything, and checks that no exception was lost."""
        try:
            self.close()
            self._wait(self._loop.shutdown_default_executor())
        finally:
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join()
            self._loop.close()
        assert self._faults == []

    def _wait(self, coroutine: Coroutine[Any, Any, Any]) -> Any:
        return asyncio.run_coroutine_threadsafe(coroutine, self._loop).result(4 * wire.DEADLINE)


class Dial(Protocol):
    """Creates a client that is closed when the test ends."""

    def __call__(self, url: str, **options: Any) -> Face: ...


FACES = {"sync": holdfast.SyncClient, "asyncio": Awaited}


def dialling(name: str) -> Iterator[Dial]:
    """The type of a fixture for one of the clients."""
    with ExitStack() as opened:

        def dial(url: str, **options: Any) -> Face:
            made = FACES[name](url, timeout=options.pop("timeout", wire.DEADLINE), **options)
            opened.callback(made.end if isinstance(made, Awaited) else made.close)
            return cast("Face", made)

        yield dial


def connected(dial: Dial, url: str, timeout: float) -> Face:
    """A client with a connection: it sends its next request however short the timeout of that is.

    The device must answer a first request.
    """
    client = dial(url)
    client.read_coils(0, 1)
    client.timeout = timeout
    return client


def run(main: Callable[[], Coroutine[Any, Any, Result]]) -> Result:
    """Runs a coroutine in debug mode, and checks that no exception was lost."""
    faults: list[dict[str, Any]] = []

    async def watched() -> Result:
        asyncio.get_running_loop().set_exception_handler(lambda _, fault: faults.append(fault))
        return await main()

    result = asyncio.run(watched(), debug=True)
    assert faults == []
    return result
