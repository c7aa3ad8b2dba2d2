"""Notifies a service manager: when the appliance serves, reloads and stops, and that it is live.

systemd sets `NOTIFY_SOCKET` for services of `Type=notify` and `Type=notify-reload`, and
`WATCHDOG_USEC` with `WatchdogSec`. Without them, nothing is sent.
"""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import time
from typing import TYPE_CHECKING

from holdfast.events import log_lines

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

TIMEOUT_S = 1.0
"""Seconds to wait for room in the queue of the service manager."""


class ServiceManager:
    """The service manager that started this process, if it wants notifications."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self._socket = _connected(environment.get("NOTIFY_SOCKET", ""))
        self._interval = _interval(environment)
        self._fed = -self._interval
        self._failed = False

    def ready(self) -> None:
        """Notifies that the appliance serves."""
        self._send("READY=1")

    def stopping(self) -> None:
        """Notifies that the appliance begins to stop."""
        self._send("STOPPING=1")

    @contextlib.contextmanager
    def reloading(self) -> Iterator[None]:
        """Notifies that the appliance reloads, and that it serves again when the block ends."""
        self._send(f"RELOADING=1\nMONOTONIC_USEC={time.monotonic_ns() // 1000}")
        try:
            yield
        finally:
            self.ready()

    def feed_watchdog(self) -> None:
        """Notifies that the appliance is live, if a notification is due."""
        now = time.monotonic()
        if self._interval and now - self._fed >= self._interval:
            self._fed = now
            self._send("WATCHDOG=1")

    def close(self) -> None:
        """Closes the socket."""
        if self._socket is not None:
            self._socket.close()

    def _send(self, text: str) -> None:
        if self._socket is None:
            return
        try:
            self._socket.send(text.encode())
        except OSError as error:
            if not self._failed:
                _log_failure(str(error))
            self._failed = True
        else:
            self._failed = False


def _connected(address: str) -> socket.socket | None:
    """A socket to the address in `NOTIFY_SOCKET`: a path, or an abstract name after `@`."""
    if not address:
        return None
    if address[0] not in "/@" or not hasattr(socket, "AF_UNIX"):
        _log_failure(f"NOTIFY_SOCKET={address} is not supported")
        return None
    made = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    made.settimeout(TIMEOUT_S)
    try:
        made.connect(f"\0{address[1:]}" if address[0] == "@" else address)
    except OSError as error:
        made.close()
        _log_failure(f"NOTIFY_SOCKET={address}: {error}")
        return None
    return made


def _log_failure(reason: str) -> None:
    log_lines.write(logging.WARNING, "notify_failed", reason=reason)


def _interval(environment: Mapping[str, str]) -> float:
    """Seconds between two feeds of the watchdog: half of its time. 0 without a watchdog."""
    time_limit, process = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID")
    if not time_limit.isdecimal() or process not in (None, str(os.getpid())):
        return 0.0
    return int(time_limit) / 2_000_000
