"""The log: one line per event, as text, JSON or ECS documents, with the same fields.

Log lines never contain secrets or values from memory.
"""

from __future__ import annotations

import json
import logging
import sys
import threading
import time
from typing import Literal, TypeAlias

from holdfast import ecs
from holdfast.log_output import QueuedHandler

LOGGER = logging.getLogger("holdfast")

Format: TypeAlias = Literal["text", "json", "ecs"]


def configure(level: str, form: Format) -> None:
    """Sends the log to standard error; `level` is debug, info, warning or error."""
    handler = QueuedHandler(sys.stderr)
    handler.setFormatter(_formatter(form))
    LOGGER.handlers[:] = [handler]
    LOGGER.setLevel(level.upper())
    LOGGER.propagate = False


def change(level: str, form: Format) -> None:
    """Changes level and format of a log that `configure` has begun."""
    for handler in LOGGER.handlers:
        handler.setFormatter(_formatter(form))
    LOGGER.setLevel(level.upper())


def dropped() -> int:
    """Returns the number of lines that were dropped because nobody read the log."""
    return sum(getattr(handler, "dropped", 0) for handler in LOGGER.handlers)


def write(level: int, event: str, **fields: object) -> None:
    """Logs an event with its fields."""
    LOGGER.log(level, event, extra={"fields": fields})


def listening(listener: str, address: str, port: int | None = None) -> None:
    """Logs that a listener or service is ready. A serial device has no port."""
    if port is not None:
        ecs.note_port(listener, port)
    write(logging.INFO, "listening", listener=listener, address=address)


def refused(event: str, *, kind: object, **fields: object) -> None:
    """Logs a refusal. The number of logged refusals of a kind is limited, see `Throttle`."""
    limited(logging.WARNING, event, kind=kind, **fields)


def limited(level: int, event: str, *, kind: object, **fields: object) -> None:
    """Logs an event that peers can cause. The number of a kind is limited, see `Throttle`."""
    admitted, held_back = _REFUSALS.admit((event, kind), time.monotonic())
    if admitted:
        more = {"held_back": held_back} if held_back else {}
        write(level, event, **fields, **more)


def problem(event: str, **fields: object) -> None:
    """Logs an error with the current exception, limited like refusals."""
    admitted, held_back = _REFUSALS.admit((event, "fault"), time.monotonic())
    if admitted:
        more = {"held_back": held_back} if held_back else {}
        LOGGER.error(event, extra={"fields": fields | more}, exc_info=True)


def tell_held_back() -> None:
    """Logs how many events were held back, for kinds of which none came since. Call it often."""
    for kind, count in _REFUSALS.over(time.monotonic()):
        event, of = kind if isinstance(kind, tuple) else (kind, "")
        parts = of if isinstance(of, tuple) else (of,)
        shown = " ".join(str(part) for part in parts if part is not None)
        write(logging.WARNING, "held_back", of=event, kind=shown, count=count)


def _formatter(form: Format) -> logging.Formatter:
    return {"text": TextFormatter, "json": JsonFormatter, "ecs": EcsFormatter}[form]()


class TextFormatter(logging.Formatter):
    """`2026-01-31T12:00:00.000Z warning refused_source listener=scada peer=10.0.0.9:51200`."""

    def format(self, record: logging.LogRecord) -> str:
        """The line, without a line end."""
        return f"{timestamp(record.created)} {record.levelname.lower()} {message(record)}"


class JsonFormatter(logging.Formatter):
    """One JSON object per line: `time`, `level`, `event`, and the fields."""

    def format(self, record: logging.LogRecord) -> str:
        """The line, without a line end."""
        head = {
            "time": timestamp(record.created),
            "level": record.levelname.lower(),
            "event": record.getMessage(),
        }
        return json.dumps(head | _fields(record), default=str)


class EcsFormatter(logging.Formatter):
    """One document of the Elastic Common Schema per line."""

    def format(self, record: logging.LogRecord) -> str:
        """The line, without a line end."""
        made = ecs.document(
            timestamp(record.created),
            record.levelname.lower(),
            record.getMessage(),
            _fields(record),
            message(record),
        )
        return json.dumps(made, default=str)


def message(record: logging.LogRecord) -> str:
    """Returns the event of a record with its fields, as text."""
    fields = "".join(f" {key}={_quoted(value)}" for key, value in _fields(record).items())
    return f"{record.getMessage()}{fields}"


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
    """Formats seconds since 1970 as UTC, with milliseconds."""
    moment = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(seconds))
    return f"{moment}.{int(seconds % 1 * 1000):03d}Z"


class Throttle:
    """Admits the first `burst` events of a kind in each `window` of seconds.

    `admit` returns whether to log an event, and how many events of its kind the window before held
    back; `over` returns the same for kinds without further events. The log includes that number, so
    no event is lost without a trace.
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

    def over(self, now: float) -> list[tuple[object, int]]:
        """Forgets kinds whose window is over. Returns those with the events that were held back."""
        with self._lock:
            over = [kind for kind, (began, _) in self._seen.items() if now - began >= self._window]
            counts = [(kind, self._seen.pop(kind)[1] - self._burst) for kind in over]
        return [(kind, count) for kind, count in counts if count > 0]


_REFUSALS = Throttle()
