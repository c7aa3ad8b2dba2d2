"""The TCP port of an HTTP service, which is bound at the start or as soon as it is free.

A port that can't be bound must not affect other services, so it is tried again until the service is
stopped.
"""

from __future__ import annotations

import errno
import logging
import threading
import time
from typing import TYPE_CHECKING

from holdfast._core import ListeningSocket as ListeningSocket
from holdfast.events import log_lines
from holdfast.net.addresses import joined
from holdfast.runtime.backoff import Backoff

if TYPE_CHECKING:
    from holdfast.runtime.stop import Stop

FIRST_PAUSE_S = 1.0
MAX_PAUSE_S = 10.0
"""Seconds before a port is tried again. Each failure doubles the pause, up to the maximum."""

LOG_INTERVAL_S = 60.0
"""Seconds after which a failure is logged again, if its reason is still the same."""

FIRST_WITHOUT_PRIVILEGE = 1024
PRIVILEGE = "ports below 1024 require a privilege, on Linux CAP_NET_BIND_SERVICE"


def listen(host: str, port: int) -> ListeningSocket:
    """Returns a socket that listens on an IP address; `::` includes IPv4. Raises `OSError`."""
    try:
        return ListeningSocket(joined(host, port))
    except ValueError as error:
        raise OSError(str(error)) from None


def explained(error: OSError, port: int) -> str:
    """Returns why a port can't be bound, with a hint about privileges."""
    text = error.strerror or str(error)
    is_privileged = error.errno == errno.EACCES and port < FIRST_WITHOUT_PRIVILEGE
    return f"{text} ({PRIVILEGE})" if is_privileged else text


class Port:
    """The port of one service. Bound by one of the `bind` methods, and then until `close`."""

    def __init__(self, name: str, host: str, port: int) -> None:
        self.name = name
        self.error: str | None = None
        """Why the port is not bound; `None` once it is."""
        self._host = host
        self._port = port
        self._listener: ListeningSocket | None = None
        self._bound: tuple[str, int] | None = None
        self._backoff = Backoff(FIRST_PAUSE_S, MAX_PAUSE_S, jitter=False)
        self._pause = 0.0
        self._logged: tuple[str, float] | None = None
        self._lock = threading.Lock()
        self._is_logged = False

    @property
    def failures(self) -> int:
        """Attempts that failed."""
        return self._backoff.failures

    @property
    def bind_address(self) -> str:
        """The address of the configuration."""
        return joined(self._host, self._port)

    @property
    def is_bound(self) -> bool:
        """Whether the port is bound. Thread-safe."""
        return self._bound is not None

    @property
    def listener(self) -> ListeningSocket:
        """The listening socket. Raises `RuntimeError` if the port is not bound."""
        if self._listener is None:
            raise RuntimeError(f"{self.name}: {self.bind_address} is not bound")
        return self._listener

    @property
    def address(self) -> tuple[str, int]:
        """Host and port: of the listening socket, otherwise those of the configuration."""
        return (self._host, self._port) if self._bound is None else self._bound

    def status(self) -> dict[str, object]:
        """Returns the address, whether it is bound, and how many attempts failed. Thread-safe."""
        error = self.error
        failure = (
            {} if error is None else {"last_error": f"can't listen on {self.bind_address}: {error}"}
        )
        return {
            "address": joined(*self.address),
            "listening": self.is_bound,
            "failed_binds": self.failures,
            **failure,
        }

    def bind(self) -> None:
        """Binds the port. Raises `OSError`, with the name of the service."""
        try:
            self._listen()
        except OSError as error:
            at = self.bind_address
            raise OSError(
                f"{self.name}: can't listen on {at}: {explained(error, self._port)}"
            ) from error

    def try_bind(self) -> bool:
        """Tries once to bind the port. A failure is logged. Returns whether the port is bound."""
        try:
            self._listen()
        except OSError as error:
            self._note(explained(error, self._port))
            return False
        return True

    def _listen(self) -> None:
        if self._listener is None:
            listener = listen(self._host, self._port)
            host, port = listener.getsockname()[:2]
            self._listener, self._bound = listener, (host, port)
            self.error = None

    def bind_when_free(self, stop: Stop) -> bool:
        """Tries to bind the port until it succeeds. Returns `False` if `stop` was set."""
        while not stop.is_set():
            late = self.error is not None
            if late and stop.wait(self._pause):
                break
            if self.try_bind():
                if late:
                    self.log_listening()
                return True
        return False

    def log_listening(self) -> None:
        """Logs once that the port is bound. Thread-safe."""
        with self._lock:
            if self._bound is None or self._is_logged:
                return
            self._is_logged = True
            host, port = self._bound
        log_lines.listening(self.name, joined(host, port), port)

    def close(self) -> None:
        """Frees the port."""
        self._bound = None
        if self._listener is not None:
            self._listener.close()

    def _note(self, reason: str) -> None:
        """Logs a failure: the first one, another reason, and otherwise once in a while."""
        self.error = reason
        self._pause = self._backoff.failed()
        now = time.monotonic()
        if self._logged and self._logged[0] == reason and now - self._logged[1] < LOG_INTERVAL_S:
            return
        self._logged = reason, now
        log_lines.write(
            logging.ERROR,
            "adapter_not_listening",
            adapter=self.name,
            bind=self.bind_address,
            reason=reason,
            attempts=self.failures,
            retry_in=self._pause,
        )
