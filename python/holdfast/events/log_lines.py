"""The log: one line per event, as text, JSON or ECS documents, with the same fields.

Log lines never contain secrets or values from memory.
"""

from __future__ import annotations

import contextlib
import json
import logging
import sys
import time
from typing import TYPE_CHECKING, TypeAlias

from holdfast.events import ecs
from holdfast.events.throttle import Throttle, origin
from holdfast.events.writer import QueuedHandler

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from holdfast.events import Format
    from holdfast.events.throttle import Origin

LOGGER = logging.getLogger("holdfast")

MAX_REQUESTS = 1_000
"""After a start, programs request everything at once: that is no flood."""


def configure(level: str, form: Format) -> None:
    """Sends the log to standard error; `level` is debug, info, warning or error."""
    handler = QueuedHandler(sys.stderr)
    handler.setFormatter(LineFormatter(form))
    LOGGER.handlers[:] = [handler]
    LOGGER.setLevel(level.upper())
    LOGGER.propagate = False


def change(level: str, form: Format) -> None:
    """Changes level and format of a log that `configure` has begun."""
    for handler in LOGGER.handlers:
        handler.setFormatter(LineFormatter(form))
    LOGGER.setLevel(level.upper())


def dropped() -> int:
    """Returns the number of lines that nobody read, or that could not be written."""
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
    count(logging.WARNING, event, fields, kind=kind)


def limited(level: int, event: str, *, kind: object, **fields: object) -> None:
    """Logs an event that peers can cause. The number of a kind is limited, see `Throttle`."""
    count(level, event, fields, kind=kind)


def requested(level: int, event: str, **fields: object) -> bool:
    """Logs a request of a client. The limit of each event is `MAX_REQUESTS` in 10 s.

    Returns whether it was logged.
    """
    return count(level, event, fields, kind="request", throttle=_REQUESTS)


def count(
    level: int,
    event: str,
    fields: Mapping[str, object],
    *,
    kind: object,
    times: int = 1,
    observed: bool = True,
    throttle: Throttle | None = None,
) -> bool:
    """Does what `limited` does for an event that occurred so many `times`. Returns whether it was
    logged.

    Observers get it if `observed`. `throttle` is the limit, in place of that of all events; see
    `own_limit`.
    """
    by = origin(event, fields)
    limit = _REFUSALS if throttle is None else throttle
    admitted, held_back = limit.admit((event, kind), time.monotonic(), by, times)
    if admitted:
        more = {"held_back": held_back} if held_back else {}
        write(level, event, **fields, **more)
    for observer in tuple(_OBSERVERS) if observed else ():
        observer(event, fields, by, times)
    return admitted


def problem(event: str, **fields: object) -> None:
    """Logs an error with the current exception, limited like refusals."""
    admitted, held_back = _REFUSALS.admit((event, "fault"), time.monotonic())
    if admitted:
        more = {"held_back": held_back} if held_back else {}
        LOGGER.error(event, extra={"fields": fields | more}, exc_info=True)


def tell_held_back(*, all_of_them: bool = False) -> None:
    """Logs how many events were held back, for kinds of which none came since. Call it often.

    At the end, have it log `all_of_them`, also where more could follow.
    """
    for throttle in (_REFUSALS, _REQUESTS, *_OWN_LIMITS):
        _tell_held_back(throttle, all_of_them=all_of_them)


@contextlib.contextmanager
def own_limit(throttle: Throttle) -> Iterator[None]:
    """Has `tell_held_back` log what this throttle holds back too, and logs the rest at the end."""
    _OWN_LIMITS.append(throttle)
    try:
        yield
    finally:
        _OWN_LIMITS.remove(throttle)
        _tell_held_back(throttle, all_of_them=True)


def _tell_held_back(throttle: Throttle, *, all_of_them: bool) -> None:
    held_back = throttle.rest() if all_of_them else throttle.over(time.monotonic())
    for kind, by, count in held_back:
        event, of = kind if isinstance(kind, tuple) else (kind, "")
        parts = of if isinstance(of, tuple) else (of,)
        shown = " ".join(str(part) for part in parts if part is not None)
        write(logging.WARNING, "held_back", of=event, kind=shown, **by.fields(), count=count)


def observe(observer: Observer) -> None:
    """Calls `observer` with the events of `limited`, logged or not, until `forget`.

    It gets the event, its fields, its origin, and how often it occurred. It must not wait.
    """
    _OBSERVERS.append(observer)


def forget(observer: Observer) -> None:
    """Ends `observe`."""
    _OBSERVERS.remove(observer)


class LineFormatter(logging.Formatter):
    """Formats one line per record.

    * text: `2026-01-31T12:00:00.000Z warning refused_source listener=scada peer=10.0.0.9:51200`
    * json: an object with `time`, `level`, `event`, and the fields
    * ecs: a document of the Elastic Common Schema
    """

    def __init__(self, form: Format) -> None:
        super().__init__()
        self._form = form

    def format(self, record: logging.LogRecord) -> str:
        """The line, without a line end."""
        time, level = timestamp(record.created), record.levelname.lower()
        event, fields = record.getMessage(), _fields(record)
        if self._form == "text":
            return f"{time} {level} {message(record)}"
        made = {"time": time, "level": level, "event": event, **fields}
        if self._form == "ecs":
            made = ecs.document(time, level, event, fields, message(record))
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


_REFUSALS = Throttle()
_REQUESTS = Throttle(burst=MAX_REQUESTS)
_OWN_LIMITS: list[Throttle] = []

Observer: TypeAlias = "Callable[[str, Mapping[str, object], Origin, int], object]"
_OBSERVERS: list[Observer] = []
