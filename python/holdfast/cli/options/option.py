"""Options of commands, each in a line or two, and several of them as one decorator."""

from __future__ import annotations

import functools
import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from holdfast.cli import answers
from holdfast.runtime.suggestion import suggestion
from holdfast.runtime.text import clip, listing

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable

Command = TypeVar("Command", bound="Callable[..., Any]")
Parsed = TypeVar("Parsed")

FILE = click.Path(dir_okay=False, path_type=Path)
EXISTING_FILE = click.Path(exists=True, dir_okay=False, path_type=Path)

config_argument = click.argument("file", type=click.Path(path_type=Path))
"""Adds FILE, a configuration. Loading it reports its errors, also that it does not exist."""


def option(
    names: str, metavar: str | None, help: str, type: Any = None, default: Any = None, **more: Any
) -> Callable[[Command], Command]:
    """Adds an option. `names` are its name and, after a space, that of the parameter.

    The help shows its default, if there is one.
    """
    # Click takes `None` for a default too: it would not ask for an option that is required.
    if default is not None:
        more = {"default": default, "show_default": default != "", **more}
    return click.option(*names.split(), type=type, metavar=metavar, help=help, **more)


def flag(names: str, help: str, default: bool = False, **more: Any) -> Callable[[Command], Command]:
    """Adds an option without a value. The help shows a default that is `True`."""
    return click.option(
        *names.split(), is_flag=True, default=default, show_default=default, help=help, **more
    )


class WholeNumber(click.IntRange):
    """A whole number within limits."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """Parses the number."""
        try:
            return super().convert(value, param, ctx)
        except click.BadParameter:
            self.fail(_out_of_range(self, value), param, ctx)


class DecimalNumber(click.FloatRange):
    """A number within limits."""

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Parses the number."""
        try:
            return super().convert(value, param, ctx)
        except click.BadParameter:
            self.fail(_out_of_range(self, value), param, ctx)


def _out_of_range(limits: click.IntRange | click.FloatRange, value: object) -> str:
    most = "or more" if limits.max is None else f"to {limits.max}"
    return f"found {clip(str(value))}, allowed: {limits.min} {most}."


def number_option(
    names: str, help: str, least: int = 1, most: int | None = None, default: int | None = None
) -> Callable[[Command], Command]:
    """Adds an option for a number from `least` to `most`."""
    return option(names, "N", help, WholeNumber(least, most), default)


def choice(
    names: str, help: str | None, allowed: Iterable[str], default: str | None = None
) -> Callable[[Command], Command]:
    """Adds an option for one of the words `allowed`, in any case."""
    return option(names, None, help or "", click.Choice(list(allowed), False), default)


def file_option(names: str, help: str, type: click.Path = FILE) -> Callable[[Command], Command]:
    """Adds an option for the path of a file."""
    return option(names, "FILE", help, type)


json_option = flag("--json as_json", "Print JSON for programs.", callback=answers.note_wanted)


def schema_option(help: str, schema: Callable[[], object]) -> Callable[[Command], Command]:
    """Adds `--schema`, which prints a schema instead of what the command does."""

    def printed(ctx: click.Context, _: click.Parameter, wanted: bool) -> None:
        if wanted:
            click.echo(json.dumps(schema(), indent=2))
            ctx.exit()

    return click.option(
        "--schema", is_flag=True, is_eager=True, expose_value=False, callback=printed, help=help
    )


def parsed_by(parse: Callable[[str], Parsed]) -> Callable[[str], Parsed]:
    """The type of an option that `parse` reads. A `ValueError` of it is a usage error."""

    def parsed(text: str) -> Parsed:
        try:
            return parse(text)
        except ValueError as error:
            raise click.BadParameter(str(error)) from error

    return parsed


def option_group(
    *options: Callable[[Any], Any], into: tuple[str, Callable[..., object]] | None = None
) -> Callable[[Command], Command]:
    """Adds options and arguments, which the help shows in this order.

    With `into`, a name and a function, the command gets what the function makes of the values of
    these options, under that name.
    """

    def added(command: Command) -> Command:
        if into is not None:
            command = _collecting(command, _names(options), *into)
        for each in reversed(options):
            command = each(command)
        return command

    return added


def _names(options: Iterable[Callable[[Any], Any]]) -> list[str]:
    """The names of the parameters that options add."""

    def probe() -> None:
        """Takes the options."""

    for each in options:
        each(probe)
    return [parameter.name for parameter in probe.__click_params__]  # type: ignore[attr-defined]


def _collecting(
    command: Command, own: Iterable[str], name: str, make: Callable[..., object]
) -> Command:
    @functools.wraps(command)
    def collected(*args: Any, **given: Any) -> Any:
        values = {key: given.pop(key) for key in own}
        return command(*args, **given, **{name: make(**values)})

    return collected  # type: ignore[return-value]


def require_known(name: str, names: Collection[str], unknown: str, kind: str) -> None:
    """Raises `click.UsageError` if `name` is not one of `names`; `kind` says what they are."""
    if name not in names:
        known = listing(names) or f"none, there are no {kind}"
        near = suggestion(name, names)
        raise click.UsageError(f"{unknown} {name!r}, allowed: {known}{near}")


def whole_number(text: str) -> int | None:
    """Parses a non-negative integer, decimal or 0x. Returns `None` for other text."""
    if re.fullmatch("0[xX][0-9a-fA-F]{1,20}", text):
        return int(text, 16)
    return int(text) if re.fullmatch("[0-9]{1,20}", text) else None
