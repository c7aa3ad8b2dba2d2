"""The base classes of all kinds of types, which convert elements one by one."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

from holdfast.values.errors import DoesNotFit, Undecodable, at
from holdfast.values.orders import move

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from holdfast.values.orders import Order
    from holdfast.values.types import Type


class Kind(ABC):
    """Elements of one type in one order. All bytes are as on the wire, except for `order.swapped`,
    which the conversion between registers and bytes handles.
    """

    struct_format: str
    """The format of an element for `struct`, in the byte order `mark`."""
    finish: Callable[[Any], Any] | None = None
    """Converts the result of `struct` to the value; `None` if they are equal."""

    def __init__(self, type: Type, order: Order) -> None:
        self.name = type.element
        self.width = type.width
        self.order = order
        self.mark = "<" if order.reversed else ">"

    @abstractmethod
    def unpack_one(self, data: bytes) -> Any:
        """The value of an element's bytes. Raises `Undecodable`."""

    @abstractmethod
    def pack_one(self, value: Any) -> bytes:
        """The bytes of an element's value. Raises `DoesNotFit`."""

    def unpack_many(self, data: bytes) -> list[Any]:
        """The values of any number of elements. Raises `Undecodable`."""
        width, values = self.width, []
        try:
            for start in range(0, len(data), width):
                values.append(self.unpack_one(data[start : start + width]))
        except Undecodable as error:
            raise at(f"values[{len(values)}]", error) from None
        return values

    def pack_many(self, values: Sequence[Any]) -> bytes:
        """The bytes of any number of values. Raises `DoesNotFit`."""
        packed: list[bytes] = []
        try:
            for value in values:
                packed.append(self.pack_one(value))
        except DoesNotFit as error:
            raise at(f"values[{len(packed)}]", error) from None
        return b"".join(packed)

    def arrange(self, data: bytes) -> bytes:
        """Applies the order to one element, except for `order.swapped`; it is its own inverse."""
        if self.order.reversed:
            return data[::-1]
        return move(data, self.order.places) if self.order.places else data


class Bytewise(Kind):
    """Elements that `struct` unpacks as bytes."""

    def __init__(self, type: Type, order: Order) -> None:
        super().__init__(type, order)
        self.struct_format = f"{self.width}s"
        self.finish = self.unpack_one
