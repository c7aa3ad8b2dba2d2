"""`SyncClient`, which is blocking. It never imports asyncio: the command line uses it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Self

from holdfast.client.base import DEFAULT_TIMEOUT_S
from holdfast.client.endpoint import endpoint
from holdfast.client.fork import BlockingConnection
from holdfast.client.sync_operations import SyncOperations

if TYPE_CHECKING:
    from holdfast.client.base import Trace


class SyncClient(SyncOperations):
    """A blocking client: every method returns when the device has answered.

    `url` names the device: `tcp://host:502`, `tls://host:802?ca=ca.pem`, `udp://host:502`,
    `rtu+tcp://host:502`, `rtu+udp://host:502`, `ascii+tcp://host:502`,
    `rtu:///dev/ttyUSB0?baud=19200&parity=even` or `ascii:///dev/ttyUSB0`, with options for a device
    that deviates from the standard. `unit` is the unit id, 0 to 255, that a call can replace.
    `timeout` in seconds covers connecting, sending and receiving.

    Reads the files of a `tls` URL now; raises `OSError` or `ValueError` if they can't be used.

    A read is sent again when a connection that was used before ends without a byte of the reply,
    and as often as `retries` of the URL says. A write is never sent twice.

    Threads may share a client; their calls take turns, for which `timeout` does not count.

    `trace` is called with `"sent"` or `"received"` and the bytes, as they come, in the thread of
    the call: what is inside TLS, and a frame perhaps in several parts. Its errors are only
    reported, to `sys.unraisablehook`.

    Methods raise `ValueError` or `TypeError` before anything is sent, and `ModbusException`,
    `ConnectionLost`, `RequestTimeout` or `InvalidResponse` after; all four are `ModbusError`.

    >>> with holdfast.SyncClient("tcp://plc") as plc:
    ...     plc.read_holding_registers(0, 3)
    [11, 22, 33]
    """

    __slots__ = ()

    def __init__(
        self,
        url: str,
        *,
        unit: int = 1,
        timeout: float = DEFAULT_TIMEOUT_S,
        trace: Trace | None = None,
    ) -> None:
        super().__init__(url, unit, timeout)
        self._transport = BlockingConnection(endpoint(self._target), trace)

    def close(self) -> None:
        """Closes the connection after the calls before it. A later call reconnects.

        In a signal handler during a call, it ends the calls of all threads with `ConnectionLost`.
        """
        self._transport.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
