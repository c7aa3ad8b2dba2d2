"""The options that name tags: `selection` and `files` find the tags.

These are imported only where an argument names tags: configurations take several times as long to
import as everything else that reads a device.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Literal, TypeAlias

import click

from holdfast.cli.options import item
from holdfast.cli.options.option import (
    FILE,
    file_option,
    flag,
    number_option,
    option,
    option_group,
)
from holdfast.cli.options.url import checked_url
from holdfast.protocol import LAST_ADDRESS

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from holdfast.cli.tags.selection import TaggedDevice
Form: TypeAlias = Literal["text", "csv", "json"]


@dataclass(frozen=True)
class TagFiles:
    """The values of the options `--tags`, `--profile` and `--config`."""

    tags: Path | None
    profile: str | None
    config: Path | None

    @property
    def given(self) -> bool:
        """Whether any is set."""
        return self.tags is not None or self.profile is not None or self.config is not None

    def device(self, url: str, unit: int, timeout: float) -> TaggedDevice:
        """The device and its tags. Raises `click.UsageError`, and exits for an invalid file."""
        from holdfast.cli.tags import files, selection

        if self.config is not None:
            if self.tags is not None or self.profile is not None:
                raise click.UsageError("--config can't be used with --tags or --profile.")
            return files.configured(self.config, url, unit, timeout)
        if self.tags is None:
            raise click.UsageError("--profile requires --tags.")
        tags = files.tags_of(self.tags, self.profile)
        return selection.TaggedDevice(url, unit, timeout, tags)


@dataclass(frozen=True)
class Selection:
    """The values of options that only several values have: which tags, and in which form."""

    only: tuple[str, ...]
    max_gap: int
    csv: bool
    record: Path | None

    def refuse(self) -> None:
        """Refuses these options where one item is read. Raises `click.UsageError`."""
        for name, value in asdict(self).items():
            if value:
                name = name.replace("_", "-")
                raise click.UsageError(
                    f"--{name} requires --tags, or each value as an item, as in hr:0 hr:1:int16."
                )


tag_file_options = option_group(
    file_option("--tags", "The tags of this list (YAML or CSV)."),
    option("--profile", "NAME", "With --tags: the profile of a configuration FILE."),
    option(
        "--config",
        "FILE",
        "URL is the name of a device in this configuration: its URL, unit id and tags.",
        FILE,
        is_eager=True,
    ),
    into=("files", TagFiles),
)
"""Adds `--tags`, `--profile` and `--config`: the argument `files`."""

selection_options = option_group(
    option("--only", "NAME", "Only these tags; * stands for any text. Repeatable.", multiple=True),
    number_option("--max-gap", "Read gaps of up to N between tags with them.", 0, LAST_ADDRESS, 0),
    flag("--csv", "Print CSV: the time, and a column for each tag."),
    file_option("--record", "Append every reading to this CSV file."),
    into=("selection", Selection),
)
"""Adds `--only`, `--max-gap`, `--csv` and `--record`: the argument `selection`."""


def _url(ctx: click.Context, _param: click.Parameter, value: str) -> str:
    """Checks a URL, unless it is the name of a device."""
    return value if ctx.params.get("config") else checked_url(value)


url_argument = click.argument("url", callback=_url, metavar="URL")


def device_of(
    files: TagFiles,
    url: str,
    words: Sequence[str],
    only: Sequence[str],
    typed: tuple[str | None, str, str | None],
    unit: int,
    timeout: float,
) -> TaggedDevice | None:
    """The device and tags of the arguments; `None` if they name one place and no tags.

    `typed` are the values of `--type`, `--order` and `--encoding`.
    """
    kind, order, encoding = typed
    is_typed = kind is not None or order != "ABCD"
    if not files.given and ((is_typed and len(words) == 1) or not item.are_several(words)):
        return None
    from holdfast.cli.tags import selection

    if is_typed:
        raise click.UsageError(
            "--type and --order can't be used with tags or several items; an item can have its "
            "own, as in hr:0:float32:CDAB."
        )
    if files.given:
        if encoding is not None:
            raise click.UsageError("--encoding can't be used with tags.")
        if words:
            raise click.UsageError(f"{' '.join(words)!r} can't be used with --tags or --config.")
        found = files.device(url, unit, timeout)
    else:
        tags = selection.items(words, encoding=encoding)
        found = selection.TaggedDevice(url, unit, timeout, tags)
    return replace(found, tags=selection.chosen(found.tags, only))


def form_of(as_json: bool, as_csv: bool) -> Form:
    """The form of `--json` and `--csv`. Raises `click.UsageError`."""
    if as_json and as_csv:
        raise click.UsageError("--json and --csv can't be used together.")
    return "json" if as_json else "csv" if as_csv else "text"
