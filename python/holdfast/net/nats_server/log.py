"""Reads the log of nats-server."""

from __future__ import annotations

import logging
import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

_LINE = re.compile(r"\[\d+\] [\d/]+ [\d:.]+ \[(?P<level>[A-Z]{3})\] ?(?P<text>.*)")
_LEVELS = {"INF": logging.DEBUG, "WRN": logging.WARNING, "ERR": logging.ERROR, "FTL": logging.ERROR}
_LISTENING = "Listening for client connections on "
_READY = "Server is ready"
_FAILED = re.compile("[Cc]ritical write error|failed to store a msg")
_FULL = "resource limits exceeded"


class ServerLog:
    """The log of one server: whether it is ready, where it listens, and its last error."""

    def __init__(
        self,
        take: Callable[[int, str], None] | None = None,
        failed: Callable[[], None] | None = None,
        full: Callable[[], None] | None = None,
    ) -> None:
        """`take` gets the level and the text of each line.

        `failed` is called for each line that says that a server which is ready could not write,
        `full` for each that says that it has stored as much as it may.
        """
        self._take, self._failed, self._full = take, failed, full
        self.begin()

    def begin(self) -> None:
        """Forgets what a former run has said."""
        self.is_ready = False
        self.error = ""
        self.address = ""
        """Host and port, as soon as the server listens."""

    def take(self, line: str) -> None:
        """Takes a line of the log."""
        match = _LINE.fullmatch(line)
        text = line if match is None else match["text"]
        if not text.strip():
            return
        level = logging.ERROR if match is None else _LEVELS.get(match["level"], logging.DEBUG)
        if level >= logging.ERROR:
            self.error = text
        if text.startswith(_LISTENING):
            self.address = text.removeprefix(_LISTENING)
        self.is_ready = self.is_ready or text == _READY
        if self._take is not None:
            self._take(level, text)
        if self._failed is not None and self.is_ready and _FAILED.search(text):
            self._failed()
        if self._full is not None and self.is_ready and _FULL in text:
            self._full()
