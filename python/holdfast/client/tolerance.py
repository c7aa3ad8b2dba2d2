"""How a client treats a device that deviates from the standard."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Tolerance:
    """How to treat a device that deviates from the standard. The default follows the standard."""

    accept_unit: int | Literal["any"] | None = None
    """A unit id that replies may carry besides that of the request, or any."""
    pad: bool = False
    """Whether surplus bytes at the end of a reply are ignored. Over TCP and UDP, an exception reply
    ends after its exception code whatever length its header has.
    """
    echo: bool | Literal["auto"] = "auto"
    """Whether the adapter repeats what is sent; `auto` detects it at reads."""
    pause: float = 0.0
    """Seconds between the end of a request and the next; one request is in flight then."""
    pause_after_connect: float = 0.0
    """Seconds between connecting and the first request."""
    retries: int = 0
    """How often a read is sent again after a timeout, an invalid reply or a lost connection."""
    retry_busy: bool = False
    """Whether `retries` covers exceptions 05 and 06 too."""
    close_after: int = 0
    """Requests after which the connection is closed, 0 for never; one is in flight then."""
    reconnect: float = 0.0
    """Seconds between the end of a connection and the next attempt to connect."""
    write_multiple: bool = False
    """Whether one coil is written with function 15 and one register with function 16, for a device
    without functions 5 and 6.
    """

    @property
    def is_one_at_a_time(self) -> bool:
        """Whether at most one request is in flight, whatever the transport can carry."""
        return self.pause > 0 or self.close_after > 0

    @property
    def has_pauses(self) -> bool:
        """Whether a request may have to wait before it is sent."""
        return self.pause > 0 or self.pause_after_connect > 0


STRICT = Tolerance()
