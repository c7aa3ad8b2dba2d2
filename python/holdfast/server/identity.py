"""`Identity`: what a server says about itself."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from holdfast._core import __version__
from holdfast.protocol import PRIVATE_OBJECTS
from holdfast.values.integers import as_integer

if TYPE_CHECKING:
    from collections.abc import Mapping


@dataclass(frozen=True, kw_only=True)
class Identity:
    """The identification objects of all units, and names of single units.

    Text is sent as UTF-8, at most 244 bytes each. Optional objects with empty text are omitted.
    `unit_names`, by unit id 0 to 255, override `user_application_name`. `private_objects` are by
    object id, 128 to 255. Raises `ValueError` for a private object with another id.
    """

    vendor_name: str = "Holdfast"
    product_code: str = "HF"
    revision: str = __version__
    vendor_url: str = ""
    product_name: str = ""
    model_name: str = ""
    user_application_name: str = ""
    unit_names: Mapping[int, str] = field(default_factory=dict)
    private_objects: Mapping[int, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for given in self.private_objects:
            number = as_integer(given)
            # The core would serve ids 3 to 6 too, which have arguments of their own.
            if number is None or number not in PRIVATE_OBJECTS:
                allowed = f"{PRIVATE_OBJECTS[0]} to {PRIVATE_OBJECTS[-1]}"
                raise ValueError(f"private_objects has the object id {given!r}, allowed: {allowed}")

    def objects(self) -> list[tuple[int, str]]:
        """Object ids and texts, the three mandatory objects first."""
        mandatory = [self.vendor_name, self.product_code, self.revision]
        optional = [
            self.vendor_url,
            self.product_name,
            self.model_name,
            self.user_application_name,
        ]
        regular = [(index, text) for index, text in enumerate(optional, start=3) if text]
        return [*enumerate(mandatory), *regular, *self.private_objects.items()]

    def names(self) -> list[tuple[int, str]]:
        """Unit ids and names."""
        return list(self.unit_names.items())
