"""Refusals of HTTP applications: which status a reason has, and what that means.

An application has one table. Its handlers take the status of a reason from it, and its OpenAPI
document is made of the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    from holdfast.web.host import Headers

UNREAD = (408, 413)
"""Statuses of requests of which more may come: the connection ends with the answer."""

HEADERS = {401: ("WWW-Authenticate", "Bearer"), 503: ("Retry-After", "1")}
"""Headers that go with a status."""


def headers_with(status: int) -> Headers:
    """The headers that go with a status, as an answer has them."""
    found = [HEADERS[status]] if status in HEADERS else []
    return [(name.lower().encode(), value.encode()) for name, value in found]


@dataclass(frozen=True)
class Refusal:
    """One status: its reasons, each in a word, what they mean, and what is said of one, say."""

    status: int
    reasons: tuple[str, ...]
    means: str
    example: str


class Refusals:
    """The refusals of an application; each reason has one status."""

    def __init__(self, *rows: Refusal) -> None:
        self.rows = rows
        self.reasons = tuple(reason for row in rows for reason in row.reasons)
        """All of them, each once."""
        self._rows = {reason: row for row in rows for reason in row.reasons}
        assert len(self._rows) == len(self.reasons), "a reason has two statuses"

    def status(self, reason: str) -> int:
        """The status of a reason."""
        return self._rows[reason].status

    def of(self, reasons: Iterable[str]) -> list[Refusal]:
        """Those that have some of these reasons, by status."""
        found = {row.status: row for row in map(self._rows.__getitem__, reasons)}
        return [found[status] for status in sorted(found)]
