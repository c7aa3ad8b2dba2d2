"""The scanner as a part of an appliance: in a thread, until the appliance stops it."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

from holdfast.scanner.service import Scanner

if TYPE_CHECKING:
    from holdfast.scanner.service import Settings
    from holdfast.stop import Stop


class ScannerAdapter:
    """One scanner, under a supervisor.

    It ends by itself when a message asks for that. `settings.servers` hold no secrets in their
    URLs: `status` shows them.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._scanner = Scanner(settings)

    def run(self, stop: Stop) -> None:
        """Serves until `stop`, or until it is asked to end. Raises `OSError` for files."""
        asyncio.run(self._serve(stop))

    async def _serve(self, stop: Stop) -> None:
        loop = asyncio.get_running_loop()

        def end() -> None:
            with contextlib.suppress(RuntimeError):  # It has ended by itself.
                loop.call_soon_threadsafe(self._scanner.end)

        stop.then(end)
        await self._scanner.run()

    def status(self) -> dict[str, object]:
        """Whether it is connected, how many devices it polls, and what became of messages."""
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
