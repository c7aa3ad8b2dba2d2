"""Which commands come too late.

A command waits in the socket while the process is stopped, or its machine is suspended. Its caller
has given up long before, so a late write could move a machine that nobody expects to move.
"""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

from nats.errors import Error

from holdfast.net.nats.tolerant_client import Received
from holdfast.polling.write_ttl import WRITE_TTL_S
from holdfast.runtime.standstill import Standstill, now
from holdfast.scanner.errors import Refused

if TYPE_CHECKING:
    from collections.abc import Callable

    from nats.aio.msg import Msg

    from holdfast.net.nats.tolerant_client import SafeClient

SEND_AGAIN = "send it again if it is still wanted"


class Lateness:
    """Refuses the commands that the server may have sent before the end of a standstill.

    Afterwards the server is pinged: what it sends after its answer is new. How long a standstill is
    at least, `runtime.standstill` decides.
    """

    def __init__(self, standstill_s: float) -> None:
        self._standstill = Standstill("scanner", standstill_s)

    def check(self, message: Msg) -> float:
        """Returns how many seconds a command may wait now.

        Call it at the last moment before the write, since it may also wait in this process. Raises
        `Refused` for a command that must not be written any more.
        """
        assert isinstance(message, Received), "it is from a SafeClient"
        self._standstill.look()
        if message.sent_after < self._standstill.ended:
            seconds = self._standstill.lasted
            raise Refused(
                f"not written: this scanner stood still for {seconds:.0f} s; {SEND_AGAIN}"
            )
        if (waited := now() - message.received) > WRITE_TTL_S:
            raise Refused(f"not written: the command waited for {waited:.0f} s; {SEND_AGAIN}")
        return WRITE_TTL_S - waited

    async def run(self, client: Callable[[], SafeClient | None]) -> None:
        """Looks for standstills, and pings the server after each, until it is cancelled."""
        while True:
            self._standstill.look()
            connected = client()
            if connected is not None:
                with contextlib.suppress(Error, OSError):  # A new connection is pinged, too.
                    await connected.ping_unless_pinged(since=self._standstill.ended)
            await asyncio.sleep(self._standstill.look_interval_s)
