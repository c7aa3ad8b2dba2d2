"""The definition of an endpoint on devices: its fields, its function and its description."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

from holdfast.gateway.device import exception_text
from holdfast.gateway.fields import (
    HOST,
    PORT,
    REGISTER,
    SERVER_NAME,
    TIMEOUT_MS,
    TRANSPORT,
    UNIT,
)
from holdfast.net.http.fields import Field
from holdfast.net.http.schemas import Schema, array_of

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from holdfast.errors import ModbusException
    from holdfast.gateway.device import RequestedDevice

    Given: TypeAlias = Mapping[str, Any]
    Answer: TypeAlias = dict[str, Any]

TARGET_FIELDS: tuple[Field, ...] = (HOST, PORT, UNIT, TRANSPORT, SERVER_NAME)
"""The fields that name a device."""

EXAMPLE: dict[str, Any] = {"host": "plc.factory.local", "port": 502, "unitId": 1}
"""The device in examples."""


def exception_answer(given: Given, device: RequestedDevice, error: ModbusException) -> Answer:
    """Returns the answer for a Modbus exception."""
    about = {"address": given["address"]} if "address" in given else {}
    return {"success": False, "error": exception_text(error), **device.target_fields, **about}


def always(_: Given) -> bool:
    """Every request is a write."""
    return True


def never(_: Given) -> bool:
    """No request is a write."""
    return False


@dataclass(frozen=True, kw_only=True)
class Endpoint:
    """One operation on a device, without the fields that all requests and answers have."""

    path: str
    name: str
    summary: str
    description: str
    fields: tuple[Field, ...] = ()
    execute: Callable[[Given, RequestedDevice], Awaitable[Answer]]
    properties: dict[str, Schema]
    """The schemas of the answer's fields."""
    optional: tuple[str, ...] = ()
    """Optional fields of the answer."""
    examples: dict[str, dict[str, Any]]
    """Example requests by title."""
    answer: dict[str, Any]
    """The answer to the first example."""
    writes: Callable[[Given], bool] = never
    """Returns whether a request is a write."""
    has_rtt: bool = True
    """Whether the answer has the duration of the last call to the device, in milliseconds."""
    broadcast: bool = False
    """Whether the request may be a broadcast; the answer then has a `note`."""
    timeout_ms: int = TIMEOUT_MS
    """The default timeout."""
    on_exception: Callable[[Given, RequestedDevice, ModbusException], Answer] = exception_answer


REGISTERS = array_of(REGISTER)
