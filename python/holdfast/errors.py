"""What can go wrong between a client and a device, as errors of clients.

    ModbusError
    ├── ModbusException      the device answered with an exception: code, name
    ├── ConnectionLost       the connection ended before the reply
    │   ├── ConnectFailed    no connection could be made: nothing was sent
    │   └── TlsFailed        the two sides do not agree on TLS: reason
    ├── RequestTimeout       no reply within the timeout
    └── InvalidResponse      bytes that can't be the reply: reason

The texts are for people; programs decide by class and attributes.
"""

from __future__ import annotations


class ModbusError(Exception):
    """Anything that keeps a call from its result. All other errors of a client derive from it."""


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
    """The connection ended before the reply, or could not be made.

    `maybe_sent` says whether the device may have carried the request out.
    """

    maybe_sent = True


class ConnectFailed(ConnectionLost):
    """No connection could be made. Nothing was sent.

    `target` is the URL that was tried, without options; `detail` is why, in words.
    """

    maybe_sent = False

    def __init__(self, target: str, detail: str) -> None:
        self.target = target
        self.detail = detail
        super().__init__(target, detail)

    def __str__(self) -> str:
        return f"can't connect to {self.target}: {self.detail}"


class TlsFailed(ConnectionLost):
    """TLS failed, most often during its handshake.

    `reason` is one word of docs/modbus-tls.md, such as `expired` or `wrong_name`; `target` is the
    URL, without options; `detail` is the reason in words.
    """

    def __init__(self, reason: str, target: str, detail: str, maybe_sent: bool = False) -> None:
        self.reason = reason
        self.target = target
        self.detail = detail
        self.maybe_sent = maybe_sent
        super().__init__(reason, target, detail, maybe_sent)

    def __str__(self) -> str:
        if self.maybe_sent:
            return f"connection lost: {self.detail}"
        return f"can't connect to {self.target}: {self.detail}"


class RequestTimeout(ModbusError, TimeoutError):
    """There was no reply within the timeout. The device may have carried the request out."""


class InvalidResponse(ModbusError):
    """Received bytes can't be the reply to the request.

    `reason` is one word of docs/client.md, such as `unit_id` or `length`.
    """

    def __init__(self, detail: str, reason: str = "content") -> None:
        self.detail = detail
        self.reason = reason
        super().__init__(detail, reason)

    def __str__(self) -> str:
        return self.detail
