"""Refusals of HTTP applications: the status code and the meaning of each reason.

Each application has one table. Its handlers and its OpenAPI document both use it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast.net.http.requests import Headers

UNREAD = (408, 413)
"""Status codes of requests whose body is not fully read; the connection is closed after them."""

HEADERS = {401: ("WWW-Authenticate", "Bearer"), 503: ("Retry-After", "1")}
"""Response headers that a status code requires."""


def headers_with(status: int) -> Headers:
    """Returns the response headers that a status code requires."""
    found = [HEADERS[status]] if status in HEADERS else []
    return [(name.lower().encode(), value.encode()) for name, value in found]


@dataclass(frozen=True)
class Refusal:
    """A status code: its reasons as words, what they mean, and an example message."""

    status: int
    reasons: tuple[str, ...]
    means: str
    example: str


COMMON = (
    Refusal(401, ("unauthorized",), "The token is missing or unknown", "unknown token"),
    Refusal(
        405,
        ("method_not_allowed",),
        "The resource does not support this method",
        "allowed: POST, OPTIONS",
    ),
    Refusal(
        408,
        ("timeout",),
        "The body did not arrive in time; the connection is closed",
        "the body is incomplete: 1024 bytes arrived in time",
    ),
    Refusal(
        413,
        ("too_large",),
        "The body, or what it writes, is too large; the connection is closed",
        "the body has more than 65536 bytes",
    ),
)
"""Refusals that applications have in common."""


class Refusals:
    """The refusals of an application; each reason has one status."""

    def __init__(self, *rows: Refusal) -> None:
        self.rows = rows
        self.reasons = tuple(reason for row in rows for reason in row.reasons)
        """All reasons."""
        self._rows = {reason: row for row in rows for reason in row.reasons}
        assert len(self._rows) == len(self.reasons), "a reason has two statuses"

    def status(self, reason: str) -> int:
        """Returns the status code of a reason."""
        return self._rows[reason].status

    def of(self, reasons: Iterable[str]) -> list[Refusal]:
        """Returns the refusals with at least one of these reasons, sorted by status code."""
        found = {row.status: row for row in map(self._rows.__getitem__, reasons)}
        return [found[status] for status in sorted(found)]
