"""A Modbus TCP device that answers as a test wants: with what it likes, or not at all."""

from __future__ import annotations

import contextlib
import socket
import threading
from typing import TYPE_CHECKING

from support import wire

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import TracebackType
    from typing import Self

    Answer = Callable[[bytes], bytes | None]

HANG_UP = b""
"""Instead of a reply: closes the connection."""


def exception(pdu: bytes, code: int) -> bytes:
    return bytes([pdu[0] | 0x80, code])


def registers(pdu: bytes, value: int = 0) -> bytes:
    """Builds the reply to a read of registers; all have one value."""
    count = int.from_bytes(pdu[3:5])
    return bytes([pdu[0], 2 * count]) + value.to_bytes(2) * count


class FakeDevice:
    """Answers requests with a function of their PDUs, one connection after the other."""

    def __init__(self, answer: Answer) -> None:
        self.answer = answer
        self.asked: list[bytes] = []
        self._listening = socket.create_server(("127.0.0.1", 0))
        self._connection: socket.socket | None = None
        self._thread = threading.Thread(target=self._serve)

    @property
    def port(self) -> int:
        found: int = self._listening.getsockname()[1]
        return found

    @property
    def url(self) -> str:
        return f"tcp://127.0.0.1:{self.port}"

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for each in (self._listening, self._connection):
            if each is not None:
                with contextlib.suppress(OSError):
                    each.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._listening.close()

    def _serve(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                connection, _ = self._listening.accept()
                self._connection = connection
                with connection, contextlib.suppress(OSError):
                    self._talk(connection)

    def _talk(self, connection: socket.socket) -> None:
        received = b""
        while piece := connection.recv(65536):
            whole, received = wire.split(received + piece)
            for transaction, unit, pdu in whole:
                self.asked.append(pdu)
                reply = self.answer(pdu)
                if reply == HANG_UP:
                    return
                if reply is not None:
                    connection.sendall(wire.frame(reply, unit, transaction))
