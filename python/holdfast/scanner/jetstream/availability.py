"""Whether JetStream works for one purpose, and why not. A change of it is logged once."""

from __future__ import annotations

import logging
from enum import Enum

from nats.errors import NoRespondersError, TimeoutError
from nats.js.errors import APIError

from holdfast.events import log_lines
from holdfast.net.nats.connection import NO_JETSTREAM, nats_reason

JETSTREAM_TIMEOUT_S = 2.0
"""Time to wait for an answer of JetStream."""


FIRST_RETRY_S = 0.5
MAX_RETRY_S = 10.0
"""Between attempts while JetStream fails. Each failure doubles the pause, up to the second."""


class State(Enum):
    """What is known of JetStream."""

    UNKNOWN = "not tried yet"
    AVAILABLE = "available"
    UNAVAILABLE = "unavailable"


class Availability:
    """The state of one use of JetStream."""

    def __init__(self, available: str, unavailable: str, **fields: str) -> None:
        """`available` and `unavailable` are the events of the log, with these fields."""
        self._available = available
        self._unavailable = unavailable
        self._fields = fields
        self.state = State.UNKNOWN

    @property
    def is_available(self) -> bool:
        """Whether the last attempt has succeeded."""
        return self.state is State.AVAILABLE

    def succeeded(self) -> None:
        """Notes that an attempt has succeeded."""
        if self.state is not State.AVAILABLE:
            self.state = State.AVAILABLE
            log_lines.write(logging.INFO, self._available, **self._fields)

    def failed(self, error: Exception) -> None:
        """Notes that an attempt has failed."""
        if self.state is not State.UNAVAILABLE:
            self.state = State.UNAVAILABLE
            reason = reason_of(error)
            log_lines.write(logging.WARNING, self._unavailable, **self._fields, reason=reason)


def reason_of(error: Exception) -> str:
    """Returns why JetStream failed."""
    if isinstance(error, APIError):
        return nats_reason(error)
    if isinstance(error, NoRespondersError):
        return NO_JETSTREAM
    if isinstance(error, TimeoutError):
        return f"JetStream did not answer within {JETSTREAM_TIMEOUT_S:g} s"
    return str(error) or type(error).__name__
