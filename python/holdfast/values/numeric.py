"""Numbers: integers and floats, which `struct` converts, also whole arrays in one call, and BCD."""

from __future__ import annotations

import contextlib
import struct
from abc import abstractmethod
from math import inf, isinf, nextafter
from numbers import Real
from operator import not_
from typing import TYPE_CHECKING, Any

from holdfast.values.digits import FLOATS
from holdfast.values.errors import DoesNotFit, Undecodable, shown
from holdfast.values.integers import as_integer
from holdfast.values.kinds import Bytewise, Kind
from holdfast.values.orders import move
from holdfast.values.types import FIXED

if TYPE_CHECKING:
    from collections.abc import Sequence
    from fractions import Fraction

    from holdfast.values.orders import Order
    from holdfast.values.types import Type

INTEGERS = {"int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q"}
FLOAT_MAX = {
    "float16": 65504.0,
    "float32": 3.4028234663852886e38,
    "float64": 1.7976931348623157e308,
}

MAX_EXACT = 1 << 53
"""The integers up to this one are floats too."""


MAX_EXPONENT = 400
"""Of a `Decimal` that becomes a fraction. No float has as large or as small a number."""

MAX_DIGITS = 800
"""Of a `Decimal` that becomes a fraction. Floats, and numbers halfway between two, have fewer."""


def as_real(value: Any) -> Any:
    """A number of any library, also a `Decimal`; `None` for anything else.

    A `Decimal` of more than `MAX_DIGITS` digits is rounded so that it is still on the same side of
    every number of a few digits less: rounding it again gives the same as the exact number.
    """
    if isinstance(value, bool):
        return None
    if isinstance(value, Real):
        return value
    import decimal  # Who has none does not need it.
    from fractions import Fraction

    if not isinstance(value, decimal.Decimal) or value.is_snan():
        return None
    if not value or not value.is_finite():
        return float(value)
    # `ROUND_05UP` is to decimal digits what rounding to odd is to binary ones. It makes neither
    # 0 nor infinity of what is beyond the exponents, whose fraction would fill the memory.
    context = decimal.Context(MAX_DIGITS, decimal.ROUND_05UP, -MAX_EXPONENT, MAX_EXPONENT, traps=[])
    return Fraction(context.plus(value))


def limits(base: str) -> tuple[float, float]:
    """The least and the greatest number of a type. Of integers and BCD, both are integers."""
    if base in FLOAT_MAX:
        return -FLOAT_MAX[base], FLOAT_MAX[base]
    size = FIXED[base]
    if base.startswith("bcd"):
        return 0, 10 ** (2 * size) - 1
    least = -(1 << 8 * size - 1) if base.startswith("i") else 0
    return least, least + (1 << 8 * size) - 1


def nearest_float(number: float | Fraction, base: str) -> float:
    """The nearest number of a floating-point type. Raises `OverflowError` beyond the type."""
    form = f">{FLOATS[base]}"
    # Of an integer beyond the type, `struct` has an error of its own.
    found: float = struct.unpack(form, struct.pack(form, round_to_odd(number, base)))[0]
    return found


def round_to_odd(number: Any, base: str) -> float:
    """The float that `struct` rounds to the nearest number of a type.

    Avoids double rounding: an inexact number is rounded to odd at 53 bits (Boldo and Melquiond).
    """
    found = float(number)
    if base == "float64" or found == number or struct.pack("<d", found)[0] % 2:
        return found
    return nextafter(found, inf if number > found else -inf)


class Number(Kind):
    """Elements with a format of `struct`."""

    plain: frozenset[type]
    """Python types whose values go to `struct` without a check."""

    def __init__(self, type: Type, order: Order, code: str) -> None:
        super().__init__(type, order)
        self._least, self._most = limits(type.base)
        self.struct_format = code
        if order.places:
            self.struct_format = f"{self.width}s"
            self.finish = self.unpack_one
        self._one = struct.Struct(f"{self.mark}{code}")
        many = self.mark + code if type.count is None else f"{self.mark}{type.count}{code}"
        self._many = struct.Struct(many)

    def unpack_one(self, data: bytes) -> Any:
        """The number."""
        return self._one.unpack(self._moved(data))[0]

    def unpack_many(self, data: bytes) -> list[Any]:
        """The numbers of a whole array."""
        return list(self._many.unpack(self._moved(data)))

    def pack_one(self, value: Any) -> bytes:
        """The bytes of a number. Raises `DoesNotFit`."""
        try:
            number = value if type(value) in self.plain else self._number(value)
            data = self._one.pack(number)
        except (struct.error, OverflowError):
            raise _outside(value, self._least, self._most, self.name) from None
        return self._moved(data)

    def pack_many(self, values: Sequence[Any]) -> bytes:
        """The bytes of a whole array. Raises `DoesNotFit`."""
        if self._are_plain(values):
            try:
                data = self._many.pack(*values)
            except (struct.error, OverflowError):
                return super().pack_many(values)
            return self._moved(data)
        return super().pack_many(values)

    def _are_plain(self, values: Sequence[Any]) -> bool:
        return self.plain.issuperset(map(type, values))

    @abstractmethod
    def _number(self, value: Any) -> Any:
        """Converts a value of another type for `struct`. Raises `DoesNotFit`."""

    def _moved(self, data: bytes) -> bytes:
        """Applies an order of eight letters. `struct` handles reversed orders."""
        return move(data, self.order.places) if self.order.places else data


class Integer(Number):
    """`int16` to `uint64`."""

    plain = frozenset({int})

    def __init__(self, type: Type, order: Order) -> None:
        super().__init__(type, order, INTEGERS[type.base])

    def _number(self, value: Any) -> int:
        return _required_integer(value, self.name)


class Float(Number):
    """`float16` to `float64`. Integers and more precise floats are rounded to the nearest value.

    A number that would be 0 does not fit: 0 is often another thing than something small, as in a
    divisor or a switch.
    """

    plain = frozenset({float})

    def __init__(self, type: Type, order: Order) -> None:
        super().__init__(type, order, FLOATS[type.base])
        if type.base == "float64":
            self.plain |= {int}  # `struct` rounds them once.

    def pack_one(self, value: Any) -> bytes:
        """The bytes of a number. Raises `DoesNotFit`."""
        data = super().pack_one(value)
        if value != 0 and self.unpack_one(data) == 0:
            raise DoesNotFit(f"{shown(value)} is too small for {self.name}, which would hold 0")
        return data

    def pack_many(self, values: Sequence[Any]) -> bytes:
        """The bytes of a whole array. Raises `DoesNotFit`."""
        data = super().pack_many(values)
        if sum(map(not_, values)) != sum(map(not_, self.unpack_many(data))):
            return Kind.pack_many(self, values)  # It names the value that would be 0.
        return data

    def _are_plain(self, values: Sequence[Any]) -> bool:
        types = {*map(type, values)}
        return types <= self.plain or (
            types <= {float, int}
            and all(abs(each) <= MAX_EXACT for each in values if type(each) is int)
        )

    def _number(self, value: Any) -> float:
        real = as_real(value)
        if real is None:
            raise DoesNotFit(f"{shown(value)} is not a number, which {self.name} requires")
        integer = as_integer(value)  # Those of NumPy are rounded to compare them with floats.
        number = round_to_odd(real if integer is None else integer, self.name)
        # A float of numpy with more bits, which `float` does not refuse.
        if isinf(number) and value != number:
            raise OverflowError
        return number


class Bcd(Bytewise):
    """`bcd16` and `bcd32`: four and eight digits, no sign."""

    def unpack_one(self, data: bytes) -> int:
        """The number. Raises `Undecodable` for a digit above 9."""
        digits = self.arrange(data).hex()
        try:
            return int(digits)
        except ValueError:
            found = f"digits 0x{digits.upper()}"
            raise Undecodable(f"{found} are not {self.name}, allowed: 0 to 9") from None

    def pack_one(self, value: Any) -> bytes:
        """The digits of an integer. Raises `DoesNotFit`."""
        number = _required_integer(value, self.name)
        least, most = limits(self.name)
        if not least <= number <= most:
            raise _outside(value, least, most, self.name)
        return self.arrange(bytes.fromhex(f"{number:0{2 * self.width}d}"))


def _outside(value: Any, least: float, most: float, name: str) -> DoesNotFit:
    return DoesNotFit(f"{_given(value)} is outside {least} to {most} of {name}")


def _given(value: Any) -> str:
    """A number of any library for a message: never a rounded one."""
    if (integer := as_integer(value)) is not None:
        return shown(integer)
    with contextlib.suppress(OverflowError):
        if isinstance(value, Real) and (number := float(value)) == value:
            return shown(number)
    return shown(value)


def _required_integer(value: Any, name: str) -> int:
    number = as_integer(value)
    if number is None:
        raise DoesNotFit(f"{shown(value)} is not an integer, which {name} requires")
    return number
