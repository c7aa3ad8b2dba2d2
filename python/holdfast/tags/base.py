"""What the tags of a tag list and those of the scanner have in common. Does no I/O."""

from __future__ import annotations

from abc import ABC, abstractmethod
from operator import index
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

from holdfast.types import BIT_AREAS
from holdfast.values.types import parsed, whole_elements

if TYPE_CHECKING:
    from collections.abc import Set

    from holdfast.types import Area

Marker: TypeAlias = bool | int | float | str
"""What registers hold when a device has no value."""


class TagError(ValueError):
    """A tag that can't be: `key` is the wrong part, such as `scale`."""

    def __init__(self, key: str, message: str) -> None:
        super().__init__(key, message)  # Its arguments, so that it can be pickled.
        self.key = key
        self._message = message

    def __str__(self) -> str:
        return self._message


class Scaled(NamedTuple):
    """A value that was made with the scale of the same reply."""

    value: Any


class BaseTag(ABC):
    """A place in a device, and the type of its value."""

    # A subclass has slots or not: the scanner keeps a million tags.
    __slots__ = ()

    area: Area
    address: int
    """The first address."""
    type: str
    order: str
    """The byte order."""
    encoding: str | None
    """The encoding of text; `None` for ASCII."""
    null: Set[Marker]
    """What the registers hold when no value is available; NaN never is one."""

    @property
    @abstractmethod
    def source(self) -> BaseTag | None:
        """The register that contains the scale, if one does."""

    @abstractmethod
    def value(self, raw: Any) -> Any:
        """The value of what the registers hold; `None` if none is available."""

    @abstractmethod
    def scaled(self, raw: Any, content: Any) -> Scaled:
        """The value, from the contents of its registers and of that of its scale.

        Raises `ValueError` if there is a number, but no scale.
        """

    @property
    def count(self) -> int:
        """The number of bits or registers."""
        return parsed(self.type).registers

    @property
    def end(self) -> int:
        """The address after the last one."""
        return self.address + self.count

    @property
    def span(self) -> range:
        """The addresses that one request must read: those of the value and of its scale."""
        of = self.source
        if of is None:
            return range(self.address, self.end)
        return range(min(self.address, of.address), max(self.end, of.end))

    def parts(self, max_registers: int, max_bits: int) -> list[range]:
        """The addresses that one request must read, for each request of at most this length.

        An array that is longer is cut between its elements: a device may change them between two
        requests, and half of a number and half of another one are a third. Only a text that does
        not fit into a request is cut itself, as by a client. What is longer than a request in spite
        of this is not read.
        """
        span, of_type = self.span, parsed(self.type)
        most = max(1, index(max_bits if self.of_bits else max_registers))  # The core refuses 0.
        element = 1 if self.of_bits else of_type.width // 2
        if self.source is not None or len(span) <= most or (of_type.is_number and element > most):
            return [span]
        size = whole_elements(most, element)
        return [span[at : at + size] for at in range(0, len(span), size)]

    @property
    def of_bits(self) -> bool:
        """Whether the tag is in an area of bits."""
        return self.area in BIT_AREAS

    def is_null(self, raw: Any) -> bool:
        """Whether what the registers hold stands for no value."""
        return bool(raw != raw or (self.null and raw in self.null))
