"""Publishes the log of the scanner to NATS, in the form of the other tentacle services.

Only records of the scanner's own thread are published: in an appliance, the log also has the events
of the other services. A record is lost while NATS is not connected.
"""

from __future__ import annotations

import itertools
import logging
import threading
from typing import TYPE_CHECKING

from holdfast.events import log_lines
from holdfast.net.nats import batch
from holdfast.scanner.messages.types import LogEntry

if TYPE_CHECKING:
    from collections.abc import Callable

LEVELS = {logging.DEBUG: "debug", logging.INFO: "info", logging.WARNING: "warn"}
"""The words for levels; `error` for all others."""

MAX_MESSAGE_CHARS = 4096
"""The most characters of a published message."""


class LogMirror(logging.Handler):
    """Passes the records of the thread that creates it to `publish`, as text for NATS."""

    def __init__(self, prefix: str, publish: Callable[[object, bytes], None]) -> None:
        super().__init__()
        self._prefix = prefix
        self._subject = f"service.logs.modbus.{prefix}"
        self._publish = publish
        self._thread = threading.get_ident()
        self._numbers = itertools.count()
        self._refused = False

    def emit(self, record: logging.LogRecord) -> None:
        """Publishes a record. Stops at the first error about the own subject."""
        if record.thread != self._thread or self._refused:
            return
        text = log_lines.message(record)
        if record.getMessage() == "nats_error" and self._subject in text:
            self._refused = True  # Each further message would cause another error.
            return
        entry = LogEntry(
            timestamp=int(record.created * 1000),
            level=LEVELS.get(record.levelno, "error"),
            message=text[:MAX_MESSAGE_CHARS],
            service_type="modbus",
            module_id=self._prefix,
            logger=f"{self._prefix}:scanner",
        )
        key = ("log", next(self._numbers))
        self._publish(key, batch.message(self._subject, entry))
