"""What can go wrong between a client and a device."""

from __future__ import annotations


class ModbusError(Exception):
    """Anything that keeps a call from its result. Each of these derives from it."""


class ModbusException(ModbusError):
    """The device answered with an exception (V1.1b3, 7).

    `code` is the exception code, `name` the standard's name of it, if it has one.
    """

    def __init__(self, code: int, name: str | None = None) -> None:
        self.code = code
        self.name = name or "unknown"
        super().__init__(code, name)

    def __str__(self) -> str:
        return f"exception {self.code:02X} ({self.name})"


class ConnectionLost(ModbusError, ConnectionError):
    """The connection could not be made, or ended before the reply.

    When it ended, the request may have been carried out.
    """


class RequestTimeout(ModbusError, TimeoutError):
    """There was no reply within the timeout. The request may have been carried out."""


class InvalidResponse(ModbusError):
    """What came can't be the reply to the request."""
