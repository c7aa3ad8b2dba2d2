"""The base class of both clients: target, unit id and timeout."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NoReturn, TypeAlias

from holdfast.client.serial_settings import SerialTarget
from holdfast.client.url import parse
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

MIN_INTERVAL_S, MAX_INTERVAL_S = 0.01, 31_622_400
"""Seconds between polls of a device."""

BROADCAST = "unit 0 of a serial line is the broadcast"


class ForeignAttribute:
    """A name that other libraries have for a setting, or that is only an argument here. Clients and
    servers have `__slots__`, so that nothing can be set that has no effect. This has a better text
    than Python, and holds for subclasses, which have attributes of their own. One may define it.
    """

    def __init__(self, instead: str) -> None:
        self.__doc__ = f"not an attribute of Holdfast: {instead}"

    def __get__(self, client: object, owner: type) -> NoReturn:
        raise AttributeError(self.__doc__)

    def __set__(self, client: object, value: object) -> NoReturn:
        raise AttributeError(self.__doc__)


class BaseClient:
    """The settings of a client, checked."""

    __slots__ = ("__weakref__", "_target", "_timeout", "_unit")

    if not TYPE_CHECKING:  # Type checkers refuse these names as all that do not exist.
        unit_id = address = slave = slave_id = device_id = ForeignAttribute("set `unit`")
        slaveaddress = slave_address = dev_id = unit_id
        url = host = port = mode = ForeignAttribute("make a client with another URL")
        handle_local_echo = ForeignAttribute("set `echo=1` in the URL")
        retries = ForeignAttribute("set `retries` in the URL")
        auto_close = close_port_after_each_call = ForeignAttribute("set `close_after=1` in the URL")
        byteorder = wordorder = ForeignAttribute("the order is an argument of `read` and `write`")
        trace = max_in_flight = ForeignAttribute("it is an argument of the constructor")

    def __init__(self, url: str, unit: int, timeout: float) -> None:
        self._target = parse(url)
        self.unit = unit
        self.timeout = timeout

    def __repr__(self) -> str:
        return f"{type(self).__name__}('{self._target}', unit={self._unit})"

    @property
    def target(self) -> Target:
        """The device, as its URL says."""
        return self._target

    @property
    def unit(self) -> int:
        """The unit id of calls that name none."""
        return self._unit

    @unit.setter
    def unit(self, unit: int) -> None:
        self._unit = checked_unit(unit)

    @property
    def timeout(self) -> float:
        """Seconds for a request and its reply."""
        return self._timeout

    @timeout.setter
    def timeout(self, seconds: float) -> None:
        self._timeout = checked_seconds("timeout", seconds, MAX_TIMEOUT_S)

    def unit_for(self, request: Request, unit: int | None) -> int:
        """The unit id of a call. Raises `ValueError` for a function that can't be broadcast."""
        unit = self._unit if unit is None else checked_unit(unit)
        if is_broadcast(self._target, unit):
            code = request.pdu[0]
            if code not in BROADCAST_CODES:
                raise ValueError(f"{BROADCAST}; function {code} can't be broadcast")
        return unit


def is_broadcast(target: Target, unit: int) -> bool:
    """Whether a unit id is the broadcast of a serial line, which has no reply."""
    return unit == 0 and isinstance(target, SerialTarget)


def checked_seconds(name: str, seconds: float, most: float, least: float | None = None) -> float:
    """The seconds as a float: from `least`, or more than 0, up to `most`."""
    lower = "more than 0, up" if least is None else f"{least}"
    refusal = f"{name} is {seconds!r}, allowed: {lower} to {most:.0f} seconds"
    try:
        is_allowed = (seconds > 0 if least is None else seconds >= least) and seconds <= most
    except TypeError:
        raise TypeError(refusal) from None
    if not is_allowed:
        raise ValueError(refusal)
    return float(seconds)


def checked_unit(unit: int) -> int:
    """The unit id as an integer: 0 to 255."""
    number = as_integer(unit)
    if number is None or not 0 <= number <= MAX_UNIT:
        raise ValueError(f"unit is {unit!r}, allowed: 0 to {MAX_UNIT}")
    return number
