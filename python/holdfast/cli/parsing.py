"""Types of options, from functions that parse text."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

import click

if TYPE_CHECKING:
    from collections.abc import Callable

Parsed = TypeVar("Parsed")


def by(parse: Callable[[str], Parsed]) -> Callable[[str], Parsed]:
    """The type of an option whose text this function parses. Its `ValueError` is a usage error."""

    def parsed(text: str) -> Parsed:
        try:
            return parse(text)
        except ValueError as error:
            raise click.BadParameter(f"{error}.") from error

    return parsed
