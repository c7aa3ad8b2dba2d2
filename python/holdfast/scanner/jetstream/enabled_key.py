"""Whether the scanner is enabled: a key of a bucket that programs of tentacle-next write.

Without JetStream, and without the key, it is enabled.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

import msgspec

from holdfast import logs
from holdfast.scanner.jetstream.key_watch import KeyWatch

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from nats.aio.client import Client

    from holdfast.scanner.jetstream.key_watch import WatchTimes, Written

BUCKET = "service_enabled"


class _State(msgspec.Struct):
    enabled: bool


class EnabledKey:
    """Follows the key of the scanner."""

    def __init__(self, key: str, times: WatchTimes) -> None:
        self._key = key
        self._watch = KeyWatch(BUCKET, key, self._on_change, times)
        self._last_reported: bool | None = None
        self.enabled = True

    def connected(self, client: Client | None) -> None:
        """Sets the client; `None` while there is no connection."""
        self._watch.connected(client)

    async def read(self) -> None:
        """Waits until the key is read for the first time, but not for long."""
        await self._watch.read()

    async def run(self, enable: Callable[[bool], None]) -> None:
        """Calls `enable` with the first state and each new one, until it is cancelled."""
        self._enable = enable
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._watch.run())
            tasks.create_task(self._report_first())

    async def _report_first(self) -> None:
        """Enables the scanner if the key can't be read."""
        await self._watch.tried.wait()
        self._report()

    async def _on_change(self, found: Mapping[str, Written | None], is_all: bool) -> None:
        """Takes the state; a malformed one changes nothing."""
        if self._key not in found and not is_all:
            return
        written = found.get(self._key)
        try:
            enabled = written is None or msgspec.json.decode(written.value, type=_State).enabled
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            logs.refused(
                "enabled_entry_malformed", kind="enabled", key=self._key, reason=str(error)
            )
            return
        if enabled != self.enabled:
            self.enabled = enabled
            level = logging.INFO if enabled else logging.WARNING
            logs.write(level, "scanner_enabled" if enabled else "scanner_disabled", key=self._key)
        self._report()

    def _report(self) -> None:
        if self._last_reported is not self.enabled:
            self._last_reported = self.enabled
            self._enable(self.enabled)
