"""Runs the scanner in an appliance, in a thread of its own."""

from __future__ import annotations

import asyncio
import threading
from functools import partial
from typing import TYPE_CHECKING

from holdfast.net import event_loop
from holdfast.runtime import tasks
from holdfast.runtime.heartbeat import Heartbeat
from holdfast.scanner.service import Scanner

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast._core import Poller
    from holdfast.replication.leases.thread import StartThread
    from holdfast.runtime.stop import Stop
    from holdfast.scanner.messages.types import SubscriptionRequest
    from holdfast.scanner.settings import Settings


class ScannerAdapter:
    """A scanner with the interface of an adapter.

    It returns when a shutdown message arrives. The URLs in `settings.servers` must not contain
    secrets, because `status` shows them. Devices are polled by `poller`, if it is given; no other
    scanner may use it then. The thread of leases is started by `start_thread`. It begins with the
    subscriptions of a `former` scanner.
    """

    def __init__(
        self,
        settings: Settings,
        poller: Poller | None = None,
        start_thread: StartThread = threading.Thread.start,
        former: Iterable[SubscriptionRequest] = (),
    ) -> None:
        self._settings = settings
        self._scanner = Scanner(settings, poller, start_thread, former)
        self.heartbeat = Heartbeat()
        self.subscriptions = list(former)
        """Requests that make its subscriptions, after its end; none after a shutdown message."""

    def run(self, stop: Stop) -> None:
        """Serves until `stop` is set, or until a shutdown message.

        Raises `OSError` for a file of the settings that can't be used.
        """
        event_loop.run(self._serve(stop))

    async def _serve(self, stop: Stop) -> None:
        loop = asyncio.get_running_loop()
        stop.then(partial(tasks.call_soon, loop, self._scanner.end))
        async with tasks.beating(self.heartbeat):
            try:
                await self._scanner.run()
            finally:
                # After a failure, only what was not tried yet: the cause may be among the others.
                left = self._scanner.stored_requests() if stop.is_set() else self._scanner.former
                self.subscriptions = list(left)

    def status(self) -> dict[str, object]:
        """Returns the state of the connection, the number of devices, and counts of messages."""
        scanner = self._scanner
        return {
            "connected": scanner.serves,
            "servers": list(self._settings.servers.urls),
            "prefix": self._settings.prefix,
            "devices": scanner.devices,
            "published": scanner.outbox.sent,
            "replaced": scanner.outbox.replaced,
            "dropped": scanner.outbox.dropped,
        }
