"""The log: one line an event, as text or as JSON, with the same fields.

It says what happened and to whom; it never holds a secret or a value from memory.
"""

from __future__ import annotations

import json
import logging
import sys
import threading
import time
from typing import Literal

LOGGER = logging.getLogger("holdfast")


def configure(level: str, form: Literal["text", "json"]) -> None:
    """Sends the log to standard error; `level` is debug, info, warning or error."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter() if form == "json" else TextFormatter())
    LOGGER.handlers[:] = [handler]
    LOGGER.setLevel(level.upper())
    LOGGER.propagate = False


def write(level: int, event: str, **fields: object) -> None:
    """One event with its fields."""
    LOGGER.log(level, event, extra={"fields": fields})


def refused(event: str, *, kind: object, **fields: object) -> None:
    """A refusal: of one kind only so many are logged in a time, see `Throttle`."""
    admitted, held_back = _REFUSALS.admit((event, kind), time.monotonic())
    if admitted:
        more = {"held_back": held_back} if held_back else {}
        write(logging.WARNING, event, **fields, **more)


def problem(event: str, **fields: object) -> None:
    """A fault, with the exception that is being handled; throttled as refusals are."""
    admitted, held_back = _REFUSALS.admit((event, "fault"), time.monotonic())
    if admitted:
        more = {"held_back": held_back} if held_back else {}
        LOGGER.error(event, extra={"fields": fields | more}, exc_info=True)


class TextFormatter(logging.Formatter):
    """`2026-01-31T12:00:00.000Z warning refused_source listener=scada peer=10.0.0.9:51200`."""

    def format(self, record: logging.LogRecord) -> str:
        """The line, without its end."""
        fields = "".join(f" {key}={_quoted(value)}" for key, value in _fields(record).items())
        return (
            f"{timestamp(record.created)} {record.levelname.lower()} {record.getMessage()}{fields}"
        )


class JsonFormatter(logging.Formatter):
    """One JSON object a line: `time`, `level`, `event`, and the fields."""

    def format(self, record: logging.LogRecord) -> str:
        """The line, without its end."""
        head = {
            "time": timestamp(record.created),
            "level": record.levelname.lower(),
            "event": record.getMessage(),
        }
        return json.dumps(head | _fields(record), default=str)


def _fields(record: logging.LogRecord) -> dict[str, object]:
    fields: dict[str, object] = getattr(record, "fields", {})
    if record.exc_info and record.exc_info[0]:
        fields = fields | {"error": f"{record.exc_info[0].__name__}: {record.exc_info[1]}"}
    return fields


def _quoted(value: object) -> str:
    text = str(value)
    plain = text.isprintable() and text and not set(text) & set(' "=')
    return text if plain else json.dumps(text)


def timestamp(seconds: float) -> str:
    """A time since 1970 as logs write it: UTC, to the millisecond."""
    moment = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(seconds))
    return f"{moment}.{int(seconds % 1 * 1000):03d}Z"


class Throttle:
    """Lets the first `burst` events of a kind through in each `window` of seconds.

    `admit` says whether an event may be logged, and how many of its kind were held back in the
    window before: that number is logged with it, so that none is lost without a trace.
    """

    def __init__(self, burst: int = 20, window: float = 10.0) -> None:
        self._burst = burst
        self._window = window
        self._seen: dict[object, tuple[float, int]] = {}
        self._lock = threading.Lock()

    def admit(self, kind: object, now: float) -> tuple[bool, int]:
        """Whether to log an event of this kind at this time, and how many were held back before."""
        with self._lock:
            began, count = self._seen.get(kind, (now, 0))
            held_back = 0
            if now - began >= self._window:
                held_back = max(0, count - self._burst)
                began, count = now, 0
            self._seen[kind] = (began, count + 1)
            return count < self._burst, held_back


_REFUSALS = Throttle()
