"""The two faces of the client behind plain calls, so that one set of tests serves both."""

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
"""What tests call: a client that waits, or an `Awaited` that looks like one."""


class Awaited:
    """A `Client` in an event loop that runs all the time, in a thread of its own."""

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
        """That of the client."""
        return self._client.timeout

    @timeout.setter
    def timeout(self, seconds: float) -> None:
        self._client.timeout = seconds

    def end(self) -> None:
        """Closes everything; nothing may have gone wrong unseen."""
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
    """Makes a client that is closed when the test ends."""

    def __call__(self, url: str, **options: Any) -> Face: ...


FACES = {"sync": holdfast.SyncClient, "asyncio": Awaited}


def dialling(name: str) -> Iterator[Dial]:
    """What a fixture yields that has one face."""
    with ExitStack() as opened:

        def dial(url: str, **options: Any) -> Face:
            made = FACES[name](url, timeout=options.pop("timeout", wire.DEADLINE), **options)
            opened.callback(made.end if isinstance(made, Awaited) else made.close)
            return cast("Face", made)

        yield dial


def run(main: Callable[[], Coroutine[Any, Any, Result]]) -> Result:
    """Runs a coroutine in debug mode; nothing may go wrong unseen."""
    faults: list[dict[str, Any]] = []

    async def watched() -> Result:
        asyncio.get_running_loop().set_exception_handler(lambda _, fault: faults.append(fault))
        return await main()

    result = asyncio.run(watched(), debug=True)
    assert faults == []
    return result
