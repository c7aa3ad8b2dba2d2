"""The log: one line per event, as text, JSON or ECS documents, with the same fields.

Log lines never contain secrets or values from memory.
"""

from __future__ import annotations

import ipaddress
import json
import logging
import math
import sys
import threading
import time
from collections import Counter
from typing import TYPE_CHECKING, Literal, NamedTuple, TypeAlias

from holdfast import ecs
from holdfast.log_output import QueuedHandler

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

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
    count(logging.WARNING, event, fields, kind=kind)


def limited(level: int, event: str, *, kind: object, **fields: object) -> None:
    """Logs an event that peers can cause. The number of a kind is limited, see `Throttle`."""
    count(level, event, fields, kind=kind)


def count(
    level: int,
    event: str,
    fields: Mapping[str, object],
    *,
    kind: object,
    times: int = 1,
    observed: bool = True,
    throttle: Throttle | None = None,
) -> None:
    """Does what `limited` does for an event that occurred so many `times`.

    Observers get it if `observed`. `throttle` is the limit, in place of that of all events.
    """
    by = origin(event, fields)
    limit = _REFUSALS if throttle is None else throttle
    admitted, held_back = limit.admit((event, kind), time.monotonic(), by, times)
    if admitted:
        more = {"held_back": held_back} if held_back else {}
        write(level, event, **fields, **more)
    for observer in tuple(_OBSERVERS) if observed else ():
        observer(event, fields, by, times)


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
    held_back = _REFUSALS.rest() if all_of_them else _REFUSALS.over(time.monotonic())
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


class Origin(NamedTuple):
    """Whom an event comes from: what a limit distinguishes."""

    source: str = ""
    """An address, or the network /64 of an IPv6 address; empty if there is none."""
    subject: str = ""
    """The subject of a certificate, or the name of a token or a topic filter."""
    key: str = ""
    """The field of the log that has the subject."""

    def fields(self) -> dict[str, str]:
        """Returns what is known, as fields of the log."""
        found = {"peer": self.source, self.key: self.subject}
        return {key: value for key, value in found.items() if value}


NOBODY = Origin()
OTHERS = "others"
"""Stands for sources or subjects beyond those that a limit distinguishes."""


def origin(event: str, fields: Mapping[str, object]) -> Origin:
    """Returns whom an event with these fields comes from."""
    source = _source(str(fields.get("peer", "")))
    for key in () if event in ecs.MESSAGES else ("subject", "source", "who"):
        name = str(fields.get(key, ""))
        if name not in ("", ecs.UNKNOWN):
            return Origin(source, name, key)
    return Origin(source)


def _source(peer: str) -> str:
    """The address of a peer without its port. A host has as many IPv6 addresses as it wants."""
    for host in (peer, peer.rpartition(":")[0].strip("[]")):
        try:
            address = ipaddress.ip_address(host)
        except ValueError:
            continue
        if isinstance(address, ipaddress.IPv6Address):
            return str(ipaddress.IPv6Network((int(address) >> 64 << 64, 64)))
        return str(address)
    return "" if peer == ecs.UNKNOWN else peer


class _Held:
    """The events of a kind and an origin in the present window."""

    def __init__(self, began: float) -> None:
        self.began = began
        self.held_back = 0


class Throttle:
    """Admits the first event of each kind and origin in each `window` of seconds.

    More of them are admitted while fewer than `burst` of the kind were admitted, whoever they came
    from. So a noisy source uses up the burst, but does not hide others. `admit` returns whether to
    log an event, and how many events of its kind and origin were held back before; `over` returns
    the same for those without further events. The log includes that number, so no event is lost
    without a trace.

    At most `most` kinds and origins are distinguished in a window, `of_source` of each source.
    Further subjects of a source are counted together, and so are events of further sources.
    """

    def __init__(
        self, burst: int = 20, window: float = 10.0, most: int = 500, of_source: int = 16
    ) -> None:
        self._burst = burst
        self._window = window
        self._most = most
        self._most_of_source = of_source
        self._of_kind: dict[object, tuple[float, int]] = {}
        self._held: dict[tuple[object, Origin], _Held] = {}
        self._of_source: Counter[str] = Counter()
        self._lock = threading.Lock()

    def admit(
        self, kind: object, now: float, by: Origin = NOBODY, times: int = 1
    ) -> tuple[bool, int]:
        """Whether to log an event at this time, and how many were held back before.

        Of an event that occurred several `times`, one is logged.
        """
        with self._lock:
            began, admitted = self._of_kind.get(kind, (now, 0))
            if now - began >= self._window:
                began, admitted = now, 0
            key = (kind, self._distinguished(kind, by))
            held = self._held.get(key)
            held_back = 0
            is_first = held is None or now - held.began >= self._window
            if held is None:
                held = self._held[key] = _Held(now)
                self._of_source[key[1].source] += 1
            elif is_first:
                held_back, held.began, held.held_back = held.held_back, now, 0
            is_admitted = is_first or admitted < self._burst
            self._of_kind[kind] = (began, admitted + is_admitted)
            held.held_back += times - is_admitted
            return is_admitted, held_back

    def over(self, now: float) -> list[tuple[object, Origin, int]]:
        """Forgets what is older than a window. Returns the events that were held back in it."""
        with self._lock:
            window = self._window
            over = [key for key, held in self._held.items() if now - held.began >= window]
            found = [(*key, self._forget(key).held_back) for key in over]
            for kind in [
                kind for kind, (began, _) in self._of_kind.items() if now - began >= window
            ]:
                del self._of_kind[kind]
        return [each for each in found if each[2] > 0]

    def rest(self) -> list[tuple[object, Origin, int]]:
        """Forgets everything. Returns the events that were held back."""
        return self.over(math.inf)

    def _distinguished(self, kind: object, by: Origin) -> Origin:
        """The origin by which an event is counted."""
        if (kind, by) in self._held or not (by.source or by.subject):
            return by
        if by.subject and self._of_source[by.source] >= self._most_of_source:
            by = Origin(by.source, OTHERS, by.key)
        if len(self._held) >= self._most and (kind, by) not in self._held:
            return Origin(OTHERS)
        return by

    def _forget(self, key: tuple[object, Origin]) -> _Held:
        source = key[1].source
        self._of_source[source] -= 1
        if not self._of_source[source]:
            del self._of_source[source]
        return self._held.pop(key)


_REFUSALS = Throttle()

Observer: TypeAlias = "Callable[[str, Mapping[str, object], Origin, int], object]"
_OBSERVERS: list[Observer] = []
