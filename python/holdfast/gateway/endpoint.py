"""The definition of an endpoint on devices: its fields, its function and its description."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

from holdfast.gateway.device import exception_text
from holdfast.gateway.fields import HOST, PORT, REGISTER, SERVER_NAME, TRANSPORT, UNIT
from holdfast.web.fields import Field
from holdfast.web.schemas import Schema, array_of

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from holdfast.errors import ModbusException
    from holdfast.gateway.device import RequestedDevice

    Given: TypeAlias = Mapping[str, Any]
    Answer: TypeAlias = dict[str, Any]

TARGET: tuple[Field, ...] = (HOST, PORT, UNIT, TRANSPORT, SERVER_NAME)
"""The fields that name a device."""

MILLISECONDS: Schema = {"type": "integer", "minimum": 0}

EXAMPLE: dict[str, Any] = {"host": "plc.factory.local", "port": 502, "unitId": 1}
"""The device in examples."""


def exception_answer(given: Given, device: RequestedDevice, error: ModbusException) -> Answer:
    """Returns the answer for a Modbus exception."""
    about = {"address": given["address"]} if "address" in given else {}
    return {"success": False, "error": exception_text(error), **device.told, **about}


def always(_: Given) -> bool:
    """Every request is a write."""
    return True


def never(_: Given) -> bool:
    """No request is a write."""
    return False


@dataclass(frozen=True)
class Endpoint:
    """One operation on a device."""

    path: str
    name: str
    summary: str
    fields: tuple[Field, ...]
    carry_out: Callable[[Given, RequestedDevice], Awaitable[Answer]]
    properties: dict[str, Schema]
    """The schemas of the answer's fields, except the fields that all answers have."""
    examples: dict[str, dict[str, Any]]
    """Example requests by title."""
    answer: dict[str, Any]
    """The answer to the first example, without the fields that all answers have."""
    description: str = ""
    writes: Callable[[Given], bool] = never
    """Returns whether a request is a write."""
    broadcast: bool = False
    """Whether the request may be a broadcast; the answer then has a `note`."""
    timeout: int = 10_000
    """The default timeout in milliseconds."""
    optional: tuple[str, ...] = ()
    """Optional fields of the answer."""
    on_exception: Callable[[Given, RequestedDevice, ModbusException], Answer] = exception_answer


REGISTERS = array_of(REGISTER)
