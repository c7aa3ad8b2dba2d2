"""Faults of polled devices: the codes of the native poller, as words and as texts."""

from __future__ import annotations

from holdfast import _core
from holdfast.errors import ModbusException

FAULTS = _core.FAULTS
"""Why a polled device did not answer, as a word, with the fault code of the poller. A fault with
another code is an exception of the device: the low byte is its number, and 0x0100 is exception 00,
as 0 is no fault.
"""

NO_CONNECTION = FAULTS["refused"]
UNREACHABLE = FAULTS["unreachable"]
LOST = FAULTS["reset"]
STANDBY = FAULTS["standby"]
EXPIRED = FAULTS["expired"]
WITHDRAWN = FAULTS["withdrawn"]

_WORDS = {code: word for word, code in FAULTS.items()}
_TEXTS = {
    FAULTS["timeout"]: "no reply in time",
    NO_CONNECTION: "no connection",
    UNREACHABLE: "the device can't be reached",
    LOST: "the connection was lost",
    FAULTS["invalid reply"]: "an invalid reply",
    FAULTS["no plan"]: "no plan to read the device",
    FAULTS["not stored"]: "memory refused the values",
    FAULTS["internal error"]: "an internal error",
    FAULTS["flooded"]: "a flood of data that was not requested",
    STANDBY: "this node may not use the device now; another node may be using it",
    EXPIRED: "it has waited too long",
    WITHDRAWN: "its device was removed or changed",
}


def is_exception(fault: int) -> bool:
    """Whether a fault is an exception of the device; otherwise there was no valid reply."""
    return fault not in _WORDS


def fault_word(fault: int) -> str:
    """A fault as a word for logs: `timeout`, `exception 02`, `none` for 0."""
    if fault == 0:
        return "none"
    return _WORDS.get(fault, f"exception {fault & 0xFF:02X}")


def fault_text(fault: int) -> str:
    """A fault as text: `no reply in time`, `exception 02 (Illegal Data Address)`."""
    if fault in _core.EXCEPTIONS:
        return str(ModbusException(fault, _core.EXCEPTIONS[fault]))
    return fault_word(fault) if is_exception(fault) else _TEXTS[fault]
