"""Which of many events are let through: whom they come from, and how many of a kind there were."""

from __future__ import annotations

import ipaddress
import math
import threading
from collections import Counter
from typing import TYPE_CHECKING, NamedTuple

from holdfast.events import ecs

if TYPE_CHECKING:
    from collections.abc import Mapping


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

    The defaults are for events in the log. The audit log has its own, in `audit.refusal_summaries`.
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
