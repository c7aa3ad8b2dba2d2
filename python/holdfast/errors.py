"""Errors of clients, as a tree of exceptions.

    ModbusError
    ├── ModbusException      the device answered with an exception: code, name,
    │                        maybe_executed
    ├── ConnectionLost       the connection ended before the reply
    │   ├── ConnectFailed    could not connect: nothing was sent
    │   └── TlsFailed        TLS failed: reason
    ├── RequestTimeout       no reply within the timeout, or nothing could be sent
    └── InvalidResponse      an invalid reply: reason

Messages are for people. Programs should use classes and attributes.
"""

from __future__ import annotations

from holdfast.protocol import (
    BUSY,
    ILLEGAL_ADDRESS,
    ILLEGAL_FUNCTION,
    ILLEGAL_VALUE,
    PATH_UNAVAILABLE,
)

NOT_EXECUTED = (ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE, BUSY, PATH_UNAVAILABLE)
"""Exceptions of a device that has certainly not executed the request.

After another one it may have, or may still do it. 04 is an error while the device carried it out;
with 0B, a gateway answers a request that it has sent and whose reply did not come in time.
"""


class ModbusError(Exception):
    """The base class of all errors of a client after the request was checked.

    `written` is how many coils or registers earlier requests of the same call have written; 0
    without `split`.
    """

    written = 0
    _already = ""

    def __str__(self) -> str:
        return self._text() + self._already

    def note_written(self, count: int, of: str) -> None:
        """Notes that earlier requests have written `count` of what is named."""
        self.written = count
        self._already = f"; the first {count} of {of} are written"

    def _text(self) -> str:
        return super().__str__()


class ModbusException(ModbusError):
    """The device answered with an exception (V1.1b3, 7).

    `code` is the exception code, `name` its name in the standard, or `unknown`.
    """

    def __init__(self, code: int, name: str | None = None) -> None:
        self.code = code
        self.name = name or "unknown"
        super().__init__(code, name)

    def _text(self) -> str:
        return f"exception {self.code:02X} ({self.name})"

    @property
    def maybe_executed(self) -> bool:
        """Whether the device may have executed the request, or has executed earlier ones of the
        call. False only if the first request got 01, 02, 03, 06 or 0A.
        """
        return self.written > 0 or self.code not in NOT_EXECUTED


class ConnectionLost(ModbusError, ConnectionError):
    """The connection was lost before the reply, or could not be opened.

    `maybe_sent` says whether the device may have executed the request, or has executed earlier ones
    of the call.
    """

    maybe_sent = True

    def note_written(self, count: int, of: str) -> None:
        """As for every error. The device has executed a part of the call."""
        super().note_written(count, of)
        self.maybe_sent = True


class ConnectFailed(ConnectionLost):
    """Could not connect. Nothing was sent, but for earlier requests of the call.

    `target` is the URL, without options; `detail` is the reason as text; `errno` is the number of
    the system's error, or `None`.
    """

    maybe_sent = False

    def __init__(self, target: str, detail: str, errno: int | None = None) -> None:
        self.target = target
        self.detail = detail
        # Not by the constructor of `OSError`: it takes two arguments for an errno and its text.
        super().__init__()
        self.args = target, detail, errno
        self.errno, self.strerror = errno, detail

    def _text(self) -> str:
        return f"can't connect to {self.target}: {self.detail}"


class TlsFailed(ConnectionLost):
    """TLS failed, most often during its handshake.

    `reason` is a word from docs/modbus-tls.md, such as `expired` or `wrong_name`; `target` is the
    URL, without options; `detail` is the reason as text.
    """

    def __init__(self, reason: str, target: str, detail: str, maybe_sent: bool = False) -> None:
        self.reason = reason
        self.target = target
        self.detail = detail
        self.maybe_sent = maybe_sent
        self._was_connected = maybe_sent
        super().__init__()  # As in `ConnectFailed`.
        self.args = reason, target, detail, maybe_sent
        self.strerror = detail

    def _text(self) -> str:
        if self._was_connected:
            return f"connection lost: {self.detail}"
        return f"can't connect to {self.target}: {self.detail}"


class RequestTimeout(ModbusError, TimeoutError):
    """No reply arrived within the timeout, or nothing could be sent in that time.

    `maybe_sent` says whether the device may have executed the request, or has executed earlier ones
    of the call.
    """

    def __init__(self, text: str = "", maybe_sent: bool = True) -> None:
        self.maybe_sent = maybe_sent
        super().__init__(text)

    def note_written(self, count: int, of: str) -> None:
        """As for every error. The device has executed a part of the call."""
        super().note_written(count, of)
        self.maybe_sent = True


class InvalidResponse(ModbusError):
    """The received bytes are not a valid reply to the request.

    `reason` is a word from docs/client.md, such as `unit_id` or `length`.
    """

    def __init__(self, detail: str, reason: str = "content") -> None:
        self.detail = detail
        self.reason = reason
        super().__init__(detail, reason)

    def _text(self) -> str:
        return self.detail
