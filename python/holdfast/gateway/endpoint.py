"""What an endpoint is: its fields, what it does, and how it is described."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

from holdfast.gateway.device import exception_text
from holdfast.gateway.fields import (
    HOST,
    PORT,
    REGISTER,
    SERVER_NAME,
    TRANSPORT,
    UNIT,
    Field,
    Schema,
)
from holdfast.web.openapi import array_of

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
"""The device of examples."""


def exception_answer(given: Given, device: RequestedDevice, error: ModbusException) -> Answer:
    """What a Modbus exception is answered with."""
    about = {"address": given["address"]} if "address" in given else {}
    return {"success": False, "error": exception_text(error), **device.told, **about}


def always(_: Given) -> bool:
    """Every request changes something."""
    return True


def never(_: Given) -> bool:
    """No request changes anything."""
    return False


@dataclass(frozen=True)
class Operation:
    """One thing that can be asked of a device."""

    path: str
    name: str
    summary: str
    fields: tuple[Field, ...]
    carry_out: Callable[[Given, RequestedDevice], Awaitable[Answer]]
    properties: dict[str, Schema]
    """The schemas of the answer's fields, but for those that all answers have."""
    examples: dict[str, dict[str, Any]]
    """Requests, by a title."""
    answer: dict[str, Any]
    """The answer to the first example, but for what all answers have."""
    description: str = ""
    writes: Callable[[Given], bool] = never
    """Whether a request changes something on the device."""
    broadcast: bool = False
    """Whether it may go to all units of a serial line; the answer has a `note` then."""
    timeout: int = 10_000
    optional: tuple[str, ...] = ()
    """Fields of the answer that are there only sometimes."""
    on_exception: Callable[[Given, RequestedDevice, ModbusException], Answer] = exception_answer


REGISTERS = array_of(REGISTER)
