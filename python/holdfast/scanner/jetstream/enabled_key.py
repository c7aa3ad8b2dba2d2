"""Whether the scanner is enabled: a key of a bucket that programs of tentacle-next write.

Without JetStream, and without the key, it is enabled.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

import msgspec

from holdfast import logs
from holdfast.scanner.jetstream.key_watch import Watch

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from nats.aio.client import Client

    from holdfast.scanner.jetstream.key_watch import WatchTimes, Written

BUCKET = "service_enabled"


class _State(msgspec.Struct):
    enabled: bool


class Enabling:
    """Follows the key of the scanner."""

    def __init__(self, key: str, enable: Callable[[bool], None], times: WatchTimes) -> None:
        """`enable` is called with the first state and each new one."""
        self._key = key
        self._enable = enable
        self._watch = Watch(BUCKET, key, self._changed, times)
        self._told: bool | None = None
        self.enabled = True

    def connected(self, client: Client | None) -> None:
        """Sets the client; `None` while there is no connection."""
        self._watch.connected(client)

    async def read(self) -> None:
        """Waits until the key is read for the first time, but not for long."""
        await self._watch.read()

    async def run(self) -> None:
        """Follows the key, until it is cancelled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._watch.run())
            tasks.create_task(self._begin())

    async def _begin(self) -> None:
        """Enables the scanner if the key can't be read."""
        await self._watch.tried.wait()
        self._tell()

    async def _changed(self, found: Mapping[str, Written | None], is_all: bool) -> None:
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
        self._tell()

    def _tell(self) -> None:
        if self._told is not self.enabled:
            self._told = self.enabled
            self._enable(self.enabled)
