"""The options `--type`, `--order` and `--encoding`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

from holdfast import values
from holdfast.cli.options.option import option, option_group
from holdfast.values import ConversionError, WrongArea

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.types import Area

TYPES = "int16, uint32, float32, bcd16, bit:N, string:N, bytes:N, bool, or arrays: float32[10]"
ORDERS = "ABCD, CDAB, BADC, DCBA, or eight letters for eight bytes"


typed_options = option_group(
    option("--type kind", "TYPE", f"{TYPES}.", str.lower),
    option("--order", "ORDER", f"Byte order: {ORDERS}.", str.upper, "ABCD"),
    option("--encoding", "NAME", "Encoding of strings, such as utf-8.  [default: ascii]"),
)
"""Adds `--type`, `--order` and `--encoding`."""


@dataclass(frozen=True)
class Typed:
    """Consecutive values of one type."""

    element: str
    """The type of a value, without a count."""
    count: int
    order: str
    encoding: str | None
    width: int
    """Registers per value."""

    @property
    def name(self) -> str:
        """The type of all values: an array type if there are several."""
        return self.element if self.count == 1 else f"{self.element}[{self.count}]"

    @property
    def registers(self) -> int:
        """Registers of all values."""
        return self.width * self.count

    def decode(self, raw: Sequence[int]) -> list[Any]:
        """The values, with the error instead of a value that can't be decoded."""
        return [self._value(raw[at : at + self.width]) for at in range(0, len(raw), self.width)]

    def _value(self, raw: Sequence[int]) -> Any:
        try:
            return values.decode(raw, self.element, self.order, encoding=self.encoding)
        except ConversionError as error:
            return error


def typed(
    kind: str | None, order: str, encoding: str | None, area: Area, count: int
) -> Typed | None:
    """The type of the options, `count` times; `None` without `--type`."""
    if kind is None:
        if order != "ABCD" or encoding is not None:
            raise click.UsageError("--order and --encoding require --type.")
        return None
    try:
        type = values.codec_for(area, kind, order, encoding).type
    except WrongArea as error:
        raise click.UsageError(f"{area} contain bits; the only type is bool.") from error
    except ConversionError as error:
        raise click.UsageError(str(error)) from error
    size = 1 if type.count is None else type.count
    return Typed(type.element, size * count, order, encoding, type.width // 2)
