"""Typed values of the command line: what `--type`, `--order` and `--encoding` come to."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import click

from holdfast import values
from holdfast.types import BIT_AREAS
from holdfast.values import ConversionError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from holdfast.types import Area

Command = TypeVar("Command", bound="Callable[..., Any]")

TYPES = "int16, uint32, float32, bcd16, bit:N, string:N, bytes:N, bool, and arrays as float32[10]"
ORDERS = "ABCD, CDAB, BADC, DCBA, or eight letters for eight bytes"


def typed_options(command: Command) -> Command:
    """Adds `--type`, `--order` and `--encoding`."""
    kind = click.option("--type", "kind", metavar="TYPE", help=f"{TYPES}.")
    order = click.option(
        "--order", default="ABCD", show_default=True, metavar="ORDER", help=f"Of bytes: {ORDERS}."
    )
    encoding = click.option(
        "--encoding", metavar="NAME", help="Of strings, such as utf-8.  [default: ascii]"
    )
    return kind(order(encoding(command)))


@dataclass(frozen=True)
class Typed:
    """A number of values of one type, one behind the other."""

    element: str
    """The type of a value, without a count."""
    count: int
    order: str
    encoding: str | None
    width: int
    """The registers that a value takes."""

    @property
    def registers(self) -> int:
        """The registers that all of them take."""
        return self.width * self.count

    def decode(self, raw: Sequence[int]) -> list[Any]:
        """The values; in place of one that can't be, the error."""
        return [self._value(raw[at : at + self.width]) for at in range(0, len(raw), self.width)]

    def _value(self, raw: Sequence[int]) -> Any:
        try:
            return values.decode(raw, self.element, self.order, encoding=self.encoding)
        except ConversionError as error:
            return error


def typed(
    kind: str | None, order: str, encoding: str | None, area: Area, count: int
) -> Typed | None:
    """What the options ask for, `count` times; `None` if they ask for no type."""
    if kind is None:
        if order != "ABCD" or encoding is not None:
            raise click.UsageError("--order and --encoding go with --type.")
        return None
    match = re.fullmatch(r"(.+)\[([0-9]{1,6})\]", kind)
    element, size = (match[1], int(match[2])) if match else (kind, 1)
    try:
        values.register_count(kind)
        width = values.register_count(element)
        values.decode(bytes(2 * width), element, order, encoding=encoding)
    except ConversionError as error:
        raise click.UsageError(f"{error}.") from error
    if area in BIT_AREAS and element != "bool":
        raise click.UsageError(f"{area} hold bits, whose type is bool.")
    return Typed(element, size * count, order, encoding, width)
