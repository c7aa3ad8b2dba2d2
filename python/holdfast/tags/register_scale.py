"""A scale that a device has in a register, such as the scale factors of SunSpec."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol, TypeAlias

from holdfast.tags.linear import Linear
from holdfast.values.digits import shortest

if TYPE_CHECKING:
    from holdfast.types import Area
    from holdfast.values.types import Type

Form: TypeAlias = Literal["factor", "exponent"]

EXPONENTS = range(-10, 11)
"""The exponents that SunSpec allows; 0x8000 is that of a point without a value."""


class Scaled(NamedTuple):
    """A value that was made with the scale of the same reply."""

    value: Any


class PlacedRegisters(Protocol):
    """What is needed to decode registers."""

    @property
    def area(self) -> Area:
        """The area."""

    @property
    def address(self) -> int:
        """The first address."""

    @property
    def type(self) -> str:
        """The type."""

    @property
    def order(self) -> str:
        """The byte order."""

    @property
    def encoding(self) -> str | None:
        """The encoding of text; `None` for ASCII."""

    @property
    def count(self) -> int:
        """The number of bits or registers."""

    @property
    def end(self) -> int:
        """The address after the last one."""


class Source(PlacedRegisters, Protocol):
    """What is needed of the tag of a scale."""

    @property
    def of_type(self) -> Type:
        """The type, split into its parts."""

    def value(self, raw: Any) -> Any:
        """The value of what the registers hold; `None` if none is available."""


@dataclass(frozen=True)
class RegisterScale:
    """Where the scale of a tag is, and what its value means."""

    form: Form
    """`factor`: the value is the scale. `exponent`: the scale is 10 to the power of the value."""
    name: str | None = None
    """The tag of the register, in the same tag list; `None` if only its place is known."""
    source: Source | None = None
    """The register. With a name, `None` until a tag list has found it."""

    def __str__(self) -> str:
        return f"{self.form} from {self.name or self.where}"

    @property
    def where(self) -> str:
        """The register, for messages."""
        assert self.source is not None, "a tag list finds the registers of all scales"
        return f"{self.source.area} {self.source.address}"

    def factor(self, content: Any) -> float:
        """The scale for the decoded content of the register. Raises `ValueError` without one."""
        assert self.source is not None, "a tag list finds the registers of all scales"
        value = self.source.value(content)
        if value is None:
            raise ValueError(f"the scale in {self.where} has no value")
        if self.form == "exponent":
            if value not in EXPONENTS:
                allowed = f"exponents from {EXPONENTS[0]} to {EXPONENTS[-1]}"
                raise ValueError(f"the scale in {self.where} is 10^{value}, allowed: {allowed}")
            return 10 ** int(value) if value >= 0 else float(f"1e{int(value)}")
        if value == 0 or not math.isfinite(value):
            allowed = "a finite number other than 0"
            raise ValueError(f"the scale in {self.where} is {value}, allowed: {allowed}")
        if value == content and isinstance(value, float):
            return float(shortest(value, self.source.of_type.base))
        return float(value) if isinstance(value, float) else int(value)

    def linear(self, content: Any, offset: float) -> Linear:
        """Scale and offset for the decoded content of the register. Raises `ValueError`."""
        return linear_of(self.factor(content), offset)


@lru_cache(1024)
def linear_of(scale: float, offset: float) -> Linear:
    """Scale and offset, cached."""
    return Linear(scale, offset)
