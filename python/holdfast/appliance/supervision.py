"""Keeps an adapter running: in a thread of its own, made anew when it fails.

Adapter threads step back behind the threads that serve Modbus: where the system lets a thread lower
its own priority, they do.
"""

from __future__ import annotations

import contextlib
import logging
import os
import sys
import threading
import time
from typing import TYPE_CHECKING

from holdfast import logs
from holdfast.stop import Stop

if TYPE_CHECKING:
    from collections.abc import Callable

    from holdfast.adapters import Adapter

FIRST_PAUSE = 1.0
MAX_PAUSE = 60.0
"""Seconds before an adapter is made anew: doubled with each failure, up to the longest."""

PROVEN = 60.0
"""Seconds after which an adapter that ran is held to be well again."""

STOP_TIMEOUT = 5.0
"""Seconds that an adapter has to end."""

POLITENESS = 19
"""The nice value of adapter threads: with less, the scheduler lets them finish a tick now and then
while a request waits."""

SWITCH_INTERVAL = 0.05
"""Seconds that a thread may keep the interpreter while others wait for it. Each handover wakes one,
and gives the scheduler a reason to run it before the threads that serve Modbus."""


def give_way() -> None:
    """Lets this process hand its interpreter on less often: for one that serves Modbus beside."""
    sys.setswitchinterval(SWITCH_INTERVAL)


class Supervisor:
    """One adapter, from `start` to `stop`. With `may_end` it may end by itself, for good."""

    def __init__(self, name: str, factory: Callable[[], Adapter], *, may_end: bool = False) -> None:
        self.name = name
        self._factory = factory
        self._may_end = may_end
        self._stop = Stop()
        self._thread = threading.Thread(target=self._run, name=f"holdfast-{name}", daemon=True)
        self._adapter: Adapter | None = None
        self._state = "stopped"
        self._restarts = 0
        self._last_error: str | None = None

    def start(self) -> None:
        """Starts the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Tells the adapter to end; `join` waits for it."""
        self._stop.set()

    def join(self) -> None:
        """Waits for the adapter to end, for a while."""
        if self._thread.ident is None:
            return
        self._thread.join(STOP_TIMEOUT)
        if self._thread.is_alive():
            logs.write(logging.ERROR, "adapter_does_not_stop", adapter=self.name)

    def status(self) -> dict[str, object]:
        """How it does, and what it says of itself."""
        adapter = self._adapter
        try:
            own = {} if adapter is None else dict(adapter.status())
        except Exception:  # A foreign adapter's fault must not become that of diagnostics.
            logs.problem("adapter_status_failed", adapter=self.name)
            own = {}
        return {
            **own,
            "state": self._state,
            "restarts": self._restarts,
            "last_error": own.get("last_error") or self._last_error,
        }

    def _run(self) -> None:
        _step_back()
        pause = FIRST_PAUSE
        while not self._stop.is_set():
            began = time.monotonic()
            ended = self._once()
            if self._stop.is_set():
                break
            if ended and self._may_end:
                logs.write(logging.WARNING, "adapter_stopped", adapter=self.name)
                break
            if ended:
                self._last_error = "ended by itself"
                logs.write(logging.ERROR, "adapter_ended", adapter=self.name)
            if time.monotonic() - began >= PROVEN:
                pause = FIRST_PAUSE
            self._state = "failed"
            self._restarts += 1
            self._stop.wait(pause)
            pause = min(2 * pause, MAX_PAUSE)
        self._state = "stopped"

    def _once(self) -> bool:
        """Makes the adapter and runs it to its end; whether it came there without an error."""
        try:
            self._adapter = self._factory()
            self._state = "running"
            self._adapter.run(self._stop)
        except (Exception, SystemExit) as error:
            self._last_error = f"{type(error).__name__}: {error}"
            logs.LOGGER.error(
                "adapter_failed", extra={"fields": {"adapter": self.name}}, exc_info=True
            )
            return False
        return True


def _step_back() -> None:
    """Linux has priorities of threads; elsewhere they are those of the whole process."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), POLITENESS)
