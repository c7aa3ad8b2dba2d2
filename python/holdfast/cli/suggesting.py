"""A group of commands that suggests another one for an unknown one."""

from __future__ import annotations

import difflib
from typing import TYPE_CHECKING

import click

from holdfast.runtime.text import either

if TYPE_CHECKING:
    from collections.abc import Iterable


class SuggestingGroup(click.Group):
    """A group whose error for an unknown command says what was probably meant."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """The command of the arguments."""
        name = args[0]
        known = self.list_commands(ctx)
        if name not in known and not name.startswith("-"):
            ctx.fail(f"No such command {name!r}.{_suggestion(name, known)}")
        return super().resolve_command(ctx, args)


def _suggestion(name: str, known: Iterable[str]) -> str:
    """What was probably meant, as the end of a message."""
    if "://" in name:
        return f" Did you mean 'holdfast read {name}'?"
    close = difflib.get_close_matches(name.lower(), known, n=3, cutoff=0.6)
    return f" Did you mean {either(map(repr, close))}?" if close else ""
