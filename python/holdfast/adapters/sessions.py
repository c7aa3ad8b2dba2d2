"""The open connections of listeners, as adapters list and end them. The appliance implements it."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from collections.abc import Mapping

FORM = "LISTENER/NUMBER, as in the list of sessions"

MAX_NUMBER = 2**64 - 1


class SessionControl(Protocol):
    """Lists and ends open connections. Thread-safe."""

    def sessions(self) -> list[dict[str, Any]]:
        """Returns the open connections of all listeners."""

    def end_session(self, listener: str, number: int, by: Mapping[str, str]) -> bool:
        """Ends a connection. Returns whether there was one.

        `by` is who has requested it, as fields of the audit log.
        """


def parse_session_id(text: str) -> tuple[str, int]:
    """Returns listener and number of an id such as `scada/17`. Raises `ValueError`."""
    found = re.fullmatch("([^/]+)/([0-9]{1,20})", text)
    if found is None or int(found[2]) > MAX_NUMBER:
        raise ValueError(f"found {text[:100]!r}, allowed: {FORM}")
    return found[1], int(found[2])
