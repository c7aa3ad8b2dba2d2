"""What can go wrong between a client and a device: errors of clients, faults of polled devices.

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

from holdfast import _core


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


FAULTS = _core.FAULTS
"""Why a polled device did not answer, in a word, with the codes that the poller has for it. A fault
of another code is an exception of the device.
"""

NO_CONNECTION = FAULTS["refused"]

_WORDS = {code: word for word, code in FAULTS.items()}
_TEXTS = {
    FAULTS["timeout"]: "no reply in time",
    NO_CONNECTION: "no connection",
    FAULTS["reset"]: "the connection was lost",
    FAULTS["invalid reply"]: "an invalid reply",
    FAULTS["no plan"]: "no plan to read the device",
    FAULTS["not stored"]: "memory refused the values",
    FAULTS["internal error"]: "an internal error",
}


def is_exception(fault: int) -> bool:
    """Whether a fault is an exception; otherwise the request or its reply got lost."""
    return fault not in _WORDS


def fault_word(fault: int) -> str:
    """A fault as logs have it: `timeout`, `exception 02`, `none` for 0."""
    if fault == 0:
        return "none"
    return _WORDS.get(fault, f"exception {fault:02X}")


def fault_text(fault: int) -> str:
    """A fault in words for people: `no reply in time`, `exception 02 (Illegal Data Address)`."""
    if fault in _core.EXCEPTIONS:
        return str(ModbusException(fault, _core.EXCEPTIONS[fault]))
    return fault_word(fault) if is_exception(fault) else _TEXTS[fault]
