"""Runs each adapter in a thread of its own, and restarts it after a failure.

Adapter threads have a lower priority than the threads that serve Modbus, on systems where a thread
can lower its own priority.
"""

from __future__ import annotations

import contextlib
import logging
import os
import sys
import threading
import time
from typing import TYPE_CHECKING

from holdfast.config.fingerprint import fingerprint
from holdfast.events import log_lines
from holdfast.runtime.backoff import PROVEN_S, Backoff
from holdfast.runtime.heartbeat import Heartbeat
from holdfast.runtime.stop import Stop

if TYPE_CHECKING:
    from collections.abc import Callable

    from holdfast.adapters import Adapter
    from holdfast.ingest import MemoryAccess
    from holdfast.net.http.port import Port
    from holdfast.types import ThreadHeartbeat

FIRST_PAUSE_S = 1.0
MAX_PAUSE_S = 60.0
"""The pause before a failed adapter restarts. Each failure doubles it, up to the maximum."""

STOP_TIMEOUT_S = 5.0
"""How long to wait for an adapter to stop."""

NICE = 19
"""The nice value of adapter threads. With a lower value the scheduler sometimes lets them finish a
tick while a Modbus request waits."""


class Starter:
    """Starts threads for an adapter that have the priority of the process.

    A thread has the priority of the thread that starts it, and may not raise it. So a thread that
    has not lowered its own starts them.
    """

    def __init__(self) -> None:
        from concurrent.futures import ThreadPoolExecutor

        self._executor = ThreadPoolExecutor(1, "holdfast-starter")

    def open(self) -> None:
        """Begins. To be called by a thread that has the priority of the process."""
        self._executor.submit(int)

    def close(self) -> None:
        """Ends. The threads that it has started go on."""
        self._executor.shutdown(wait=False)

    def start(self, thread: threading.Thread) -> None:
        """Starts a thread. Raises `RuntimeError` as `Thread.start` does."""
        self._executor.submit(thread.start).result()


class Supervisor:
    """Supervises one adapter from `start` to `stop`.

    The adapter is replaced when `settings`, or the contents of their files, change. `access` is its
    way to memories. With `may_end`, an adapter that returns is not restarted. With `port`, the
    adapter is created once that port is bound. The adapter may use `starter` while it runs.
    """

    def __init__(
        self,
        name: str,
        factory: Callable[[], Adapter],
        *settings: object,
        access: MemoryAccess | None = None,
        may_end: bool = False,
        port: Port | None = None,
        starter: Starter | None = None,
    ) -> None:
        self.name = name
        self._factory = factory
        self.fingerprint = fingerprint(*settings, id(port))
        """Changes with what the adapter must be replaced for."""
        self._access = access
        self._may_end = may_end
        self._port = port
        self._starter = starter
        self._stop = Stop()
        self._thread = threading.Thread(target=self._run, name=f"holdfast-{name}", daemon=True)
        self._adapter: Adapter | None = None
        self._state = "stopped"
        self._created = Heartbeat()
        self._has_ended = False
        self._restarts = 0
        self._last_error: str | None = None

    def start(self) -> None:
        """Starts the thread."""
        if self._starter is not None:
            self._starter.open()
        self._thread.start()

    def stop(self) -> None:
        """Requests the stop of the adapter; `join` waits for it."""
        self._stop.set()

    def join(self) -> None:
        """Waits for the adapter to stop, at most `STOP_TIMEOUT_S`."""
        if self._thread.ident is None:
            return
        self._thread.join(STOP_TIMEOUT_S)
        if self._thread.is_alive():
            log_lines.write(logging.ERROR, "adapter_does_not_stop", adapter=self.name)

    def heartbeat(self) -> ThreadHeartbeat | None:
        """Returns the heartbeat of the adapter's loop, if it has one; otherwise of the thread.

        `None` before the start, and once the adapter was stopped. Thread-safe.
        """
        if self._thread.ident is None or self._has_ended:
            return None
        age = 0.0
        if not self._thread.is_alive():
            age = self._created.age
        elif self._state == "running":
            own = getattr(self._adapter, "heartbeat", None)
            age = own.age if isinstance(own, Heartbeat) else 0.0
        return self._thread.name, age, self._thread.native_id

    def serves(self) -> bool | None:
        """Returns whether the port is bound and the adapter runs; `None` without a port.

        Thread-safe. Does not call the adapter, unlike `status`.
        """
        if self._port is None:
            return None
        return self._port.is_bound and self._state == "running"

    def status(self) -> dict[str, object]:
        """Returns the state of the supervision and the adapter's own status."""
        adapter = self._adapter
        try:
            own = {} if adapter is None else dict(adapter.status())
        except Exception:  # A faulty adapter must not break diagnostics.
            log_lines.problem("adapter_status_failed", adapter=self.name)
            own = {}
        if self._port is not None:
            own |= self._port.status()
        return {
            **own,
            "state": self._state,
            "restarts": self._restarts,
            "last_error": own.get("last_error") or self._last_error,
            **({} if self._access is None else self._access.counts()),
        }

    def _run(self) -> None:
        _lower_priority()
        backoff = Backoff(FIRST_PAUSE_S, MAX_PAUSE_S, jitter=False, proven_s=PROVEN_S)
        if self._port is not None:
            if self._port.error is not None:
                self._state = "failed"
            self._port.bind_when_free(self._stop)
        while not self._stop.is_set():
            began = time.monotonic()
            ended = self._once()
            if self._stop.is_set():
                break
            if ended and self._may_end:
                log_lines.write(logging.WARNING, "adapter_stopped", adapter=self.name)
                break
            if ended:
                self._last_error = "the adapter returned before it was stopped"
                log_lines.write(logging.ERROR, "adapter_ended", adapter=self.name)
            self._state = "failed"
            self._restarts += 1
            self._stop.wait(backoff.failed(time.monotonic() - began))
        if self._starter is not None:
            self._starter.close()
        self._state = "stopped"
        self._has_ended = True

    def _once(self) -> bool:
        """Creates and runs the adapter. Returns whether it ended without an exception."""
        try:
            self._adapter = self._factory()
            self._state = "running"
            self._adapter.run(self._stop)
        except (Exception, SystemExit) as error:
            self._last_error = f"{type(error).__name__}: {error}"
            log_lines.LOGGER.error(
                "adapter_failed", extra={"fields": {"adapter": self.name}}, exc_info=True
            )
            return False
        return True


def _lower_priority() -> None:
    """Lowers the priority of this thread. Only Linux has a nice value for each thread."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICE)
