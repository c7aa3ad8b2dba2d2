"""The base class of both clients: target, unit id and timeout."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, TypeAlias

from holdfast.client.url import SerialTarget, parse
from holdfast.protocol import BROADCAST_CODES, MAX_UNIT
from holdfast.values.integers import as_integer

if TYPE_CHECKING:
    from holdfast._core import Request
    from holdfast.client.url import Target

Trace: TypeAlias = Callable[[str, bytes], object]
"""What is called with `"sent"` or `"received"`, and the bytes."""

DEFAULT_TIMEOUT_S = 1.0
"""Seconds for a request and its reply, of clients and of devices that are polled."""

MAX_TIMEOUT_S = 86_400.0

BROADCAST = "unit 0 of a serial line is the broadcast"


class BaseClient:
    """The settings of a client, checked."""

    def __init__(self, url: str, unit: int, timeout: float) -> None:
        self.target = parse(url)
        self.unit = _unit(unit)
        self.timeout = _timeout(timeout)

    def unit_for(self, request: Request, unit: int | None) -> int:
        """The unit id of a call. Raises `ValueError` for a function that can't be broadcast."""
        unit = self.unit if unit is None else _unit(unit)
        if is_broadcast(self.target, unit):
            code = request.pdu[0]
            if code not in BROADCAST_CODES:
                raise ValueError(f"{BROADCAST}, not allowed for function {code}")
        return unit


def is_broadcast(target: Target, unit: int) -> bool:
    """Whether a unit id is the broadcast of a serial line, which has no reply."""
    return unit == 0 and isinstance(target, SerialTarget)


def _timeout(seconds: float) -> float:
    refusal = f"timeout is {seconds!r}, allowed: more than 0, up to 86400 seconds"
    try:
        is_allowed = 0 < seconds <= MAX_TIMEOUT_S
    except TypeError:
        raise TypeError(refusal) from None
    if not is_allowed:
        raise ValueError(refusal)
    return float(seconds)


def _unit(unit: int) -> int:
    number = as_integer(unit)
    if number is None or not 0 <= number <= MAX_UNIT:
        raise ValueError(f"unit is {unit!r}, allowed: 0 to {MAX_UNIT}")
    return number
