"""Holds leases in a thread of its own, so that nothing else in a process delays a renewal.

The thread has an event loop and a connection that only the leases use. Only this thread opens and
moves fences: if it hangs or fails, they close by themselves, and nothing is sent to a device.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Coroutine, Iterable
from typing import TYPE_CHECKING, Any, TypeAlias

from holdfast.events import log_lines
from holdfast.net.event_loop import EventLoop
from holdfast.runtime import tasks
from holdfast.runtime.heartbeat import Heartbeat

if TYPE_CHECKING:
    from nats.aio.client import Client

    from holdfast.replication.leases.leases import Leases, Watcher
    from holdfast.types import ThreadHeartbeat

Connect: TypeAlias = "Callable[[Callable[[Client | None], None]], Coroutine[Any, Any, None]]"
"""Keeps a connection until it is cancelled, and passes on the client, or `None` without one."""

StartThread: TypeAlias = "Callable[[threading.Thread], None]"
"""Starts a thread, with a priority that does not delay renewals."""

RETRY_S = 5.0
"""Seconds before another attempt after a failure that is not of the network."""


class LeaseThread:
    """The thread of the leases of one bucket, from `start` to `stop`."""

    def __init__(
        self,
        leases: Leases,
        connect: Connect,
        name: str,
        start_thread: StartThread = threading.Thread.start,
        retry_s: float = RETRY_S,
    ) -> None:
        self._leases = leases
        self._retry_s = retry_s
        self._start_thread = start_thread
        self._connect = connect
        self._name = name
        self._heartbeat = Heartbeat()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stopping = asyncio.Event()
        self._stop_limit_s = 0.0
        self._thread: threading.Thread | None = None
        self._tasks: set[asyncio.Task[bool]] = set()

    def start(self) -> None:
        """Begins to hold what is wanted."""
        self._loop = EventLoop()
        self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
        self._start_thread(self._thread)

    def stop(self, limit: float) -> None:
        """Gives all leases back, each after `limit` seconds at the latest, and ends the thread.

        Blocks until then.
        """
        if self._thread is not None:
            self._stop_limit_s = limit
            self._soon(self._stopping.set)
            self._thread.join()

    @property
    def heartbeat(self) -> ThreadHeartbeat | None:
        """The heartbeat of the thread, while there is one. Thread-safe."""
        if self._thread is None:
            return None
        return self._name, self._heartbeat.age, self._thread.native_id

    def want(self, keys: Iterable[str]) -> None:
        """Takes these leases as soon as they are free. Thread-safe."""
        self._soon(self._leases.want, frozenset(keys))

    def give_back_soon(self, key: str, limit: float) -> None:
        """Begins to give a lease back, and does not wait for it. Thread-safe."""
        self._soon(self._begin_to_give_back, key, limit)

    async def give_back(self, key: str, limit: float) -> None:
        """Gives a lease back when all polls and writes have ended, or after `limit` seconds.

        To be called in another event loop.
        """
        await self._do(self._leases.give_back, key, limit)

    async def renew_now(self, key: str) -> None:
        """Renews a lease at once. To be called in another event loop."""
        await self._do(self._leases.renew_now, key)

    def _soon(self, call: Callable[..., object], *arguments: object) -> None:
        assert self._loop is not None, "it was started"
        tasks.call_soon(self._loop, call, *arguments)

    async def _do(
        self, work: Callable[..., Coroutine[Any, Any, object]], *arguments: object
    ) -> None:
        assert self._loop is not None, "it was started"
        coroutine = work(*arguments)
        try:
            future = asyncio.run_coroutine_threadsafe(coroutine, self._loop)
        except RuntimeError:  # The thread has ended, and holds nothing.
            coroutine.close()
            return
        await asyncio.wrap_future(future)

    def _begin_to_give_back(self, key: str, limit: float) -> None:
        tasks.begin(self._leases.give_back(key, limit), self._tasks)

    def _run(self) -> None:
        loop = self._loop
        assert loop is not None, "it was started"
        with asyncio.Runner(loop_factory=lambda: loop) as runner:
            runner.run(self._hold())

    async def _hold(self) -> None:
        running = [asyncio.create_task(self._keep_connected()), asyncio.create_task(self._keep())]
        async with tasks.beating(self._heartbeat):
            await self._stopping.wait()
            self._leases.want(())
            await self._leases.give_all_back(self._stop_limit_s)
            await tasks.end(running)

    async def _keep_connected(self) -> None:
        while True:
            try:
                await self._connect(self._leases.connected)
            except OSError as error:  # A file that can't be used.
                self._leases.set_reason(str(error))
            except Exception as error:
                log_lines.problem("leases_failed", bucket=self._leases.bucket)
                self._leases.set_reason(repr(error))
            await asyncio.sleep(self._retry_s)

    async def _keep(self) -> None:
        """Holds leases again after an error in this program: until then, others have them."""
        while True:
            try:
                await self._leases.run()
            except Exception:
                log_lines.problem("leases_failed", bucket=self._leases.bucket)
            await asyncio.sleep(self._retry_s)


class Relay:
    """Tells a watcher in another event loop, in the same order."""

    def __init__(self, watcher: Watcher) -> None:
        self._watcher = watcher
        self._loop: asyncio.AbstractEventLoop | None = None
        self._has_changed = False

    def attach(self, loop: asyncio.AbstractEventLoop) -> None:
        """Sets the loop of the watcher. Call it before there is anything to tell."""
        self._loop = loop

    def taken(self, key: str) -> None:
        """A lease was taken."""
        self._soon(self._watcher.taken, key)

    def lost(self, key: str, reason: str) -> None:
        """A lease is not held any more."""
        self._soon(self._watcher.lost, key, reason)

    def changed(self) -> None:
        """Somebody else has taken or left a lease; several changes at once are reported as one."""
        if not self._has_changed:
            self._has_changed = True
            self._soon(self._pass_on_change)

    def availability_changed(self, reason: str | None) -> None:
        """The bucket works; or it does not, for this reason."""
        self._soon(self._watcher.availability_changed, reason)

    def _pass_on_change(self) -> None:
        self._has_changed = False
        self._watcher.changed()

    def _soon(self, call: Callable[..., object], *arguments: object) -> None:
        assert self._loop is not None, "it is attached"
        tasks.call_soon(self._loop, call, *arguments)
