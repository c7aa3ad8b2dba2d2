"""The identification of a device (function 43/14), and how it is read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from holdfast._core import Request
from holdfast.client.requests import REFUSALS
from holdfast.errors import InvalidResponse, ModbusException

if TYPE_CHECKING:
    from holdfast.client.requests import Steps

OBJECT_NAMES = (
    "vendor_name",
    "product_code",
    "revision",
    "vendor_url",
    "product_name",
    "model_name",
    "user_application_name",
)

MANDATORY_OBJECTS = frozenset(range(3))
"""Those of the basic category."""


@dataclass(frozen=True)
class Identification:
    """The identification of a device (function 43/14); a missing object is `None`."""

    vendor_name: str | None
    product_code: str | None
    revision: str | None
    vendor_url: str | None
    product_name: str | None
    model_name: str | None
    user_application_name: str | None
    conformity_level: int
    """The categories that the device supports, and how to read them (V1.1b3, 6.21)."""
    objects: dict[int, bytes]
    """All objects as received, by object id."""


def identify() -> Steps[Identification]:
    """All objects that the device has, in as many requests as it wants.

    A device may refuse the read codes of categories that it does not have, or leave out the objects
    of lower categories: then these are asked for too.
    """
    objects: dict[int, bytes] = {}
    levels: list[int] = []
    for code in (3, 2, 1):
        try:
            levels.append((yield from _stream(code, objects)))
        except ModbusException as error:
            if not levels and (error.code not in REFUSALS or code == 1):
                raise
        except InvalidResponse:
            # What the device has said already stands.
            if not levels:
                raise
            break
        if objects.keys() >= MANDATORY_OBJECTS:
            break
    conformity = levels[0]
    names = {
        name: objects[number].decode("utf-8", "replace") if number in objects else None
        for number, name in enumerate(OBJECT_NAMES)
    }
    return Identification(**names, conformity_level=conformity, objects=objects)


def _stream(code: int, objects: dict[int, bytes]) -> Steps[int]:
    """Reads the objects of one read code. Returns the conformity level."""
    following: int | None = 0
    conformity = 0
    while following is not None:
        first = following
        conformity, following, found = yield Request.identification(code, first)
        objects.update(found)
        if following is not None and (following <= first or not found):
            raise InvalidResponse(f"object {following} can't follow object {first}")
    return conformity
