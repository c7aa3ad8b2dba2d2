"""The requests that wait for a device, and which of them share a reply.

Equal reads that wait for their turn are sent as one. A read never joins one that is sent already,
nor one that waits before a later write: its value could be older than the read.
"""

from __future__ import annotations

import copy
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from holdfast.protocol import READ_FUNCTIONS

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable

    from holdfast._core import Request

READS = frozenset(each.code for each in READ_FUNCTIONS.values())
"""The functions of which equal requests can share a reply."""


@dataclass(eq=False)
class Waiting:
    """A request that waits for its turn, or has it, and the callers that wait for its reply."""

    request: Request
    unit: int
    timeout: float
    """The longest timeout of its callers."""
    check: Callable[[Request], None]
    """Raises if it must not be sent any more. It never does for a read."""
    callers: list[asyncio.Future[Any]] = field(default_factory=list)
    worker: asyncio.Task[None] | None = None
    """Sends it; `None` before its turn, and after its end."""
    is_queued: bool = True
    is_sent: bool = False
    """Whether the device may have received it."""

    def note_sent(self) -> None:
        """The device may receive it from now on, unless `check` raises."""
        self.check(self.request)
        self.is_sent = True

    def end(self, outcome: Any) -> None:
        """Gives all callers the result or the error."""
        self.worker = None
        for caller in self.callers:
            if caller.done():
                continue
            # Each has an own one, because callers may change what they get.
            own = outcome if caller is self.callers[0] else copy.copy(outcome)
            if isinstance(own, Exception):
                caller.set_exception(own)
            else:
                caller.set_result(own)


class WaitingRequests:
    """The requests that wait for one device, in the order of their arrival."""

    def __init__(self) -> None:
        self._queue: deque[Waiting] = deque()
        self._reads: dict[tuple[int, bytes], Waiting] = {}
        """Reads that equal ones can join, by unit id and PDU."""

    def __bool__(self) -> bool:
        return bool(self._queue)

    @property
    def first(self) -> Waiting:
        """The request that is next."""
        return self._queue[0]

    def join(
        self, request: Request, unit: int, timeout: float, check: Callable[[Request], None]
    ) -> Waiting:
        """Queues a request, or returns an equal read that waits."""
        read = unit, request.pdu
        is_read = request.pdu[0] in READS
        if not is_read:
            # Reads after it must see what it changes.
            self._reads.clear()
        elif read in self._reads:
            equal = self._reads[read]
            equal.timeout = max(equal.timeout, timeout)
            return equal
        new = Waiting(request, unit, timeout, check)
        self._queue.append(new)
        if is_read:
            self._reads[read] = new
        return new

    def leave(self, one: Waiting) -> None:
        """Removes a request, because it is sent now or has no callers any more."""
        self._queue.remove(one)
        one.is_queued = False
        read = one.unit, one.request.pdu
        if self._reads.get(read) is one:
            del self._reads[read]
