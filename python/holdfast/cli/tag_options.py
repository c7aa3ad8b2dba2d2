"""The tags that a command reads or writes: of a tag list, a configuration, or in place."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click
from click.core import ParameterSource

from holdfast.cli import device, places
from holdfast.cli.configuration import WRONG, load_or_exit, show_problems
from holdfast.config import ConfigError
from holdfast.config.tag_files import load_tags
from holdfast.protocol import LAST_ADDRESS
from holdfast.runtime.text import guess, listing
from holdfast.tags import Tag, TagError, TagList
from holdfast.types import AREAS
from holdfast.values.types import parsed

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from holdfast.types import Area

Command = TypeVar("Command", bound="Callable[..., Any]")

MAX_TAGS = 8192
"""Maximum number of values: nobody can look at more."""

SHORT = dict(zip(AREAS, ("co", "di", "hr", "ir"), strict=True))
SIZED = ("bit", "string", "bytes")
"""Types whose name has a colon."""

FORM = "AREA:ADDRESS[:TYPE[:ORDER]], as in hr:100:float32:CDAB"

_file = click.Path(dir_okay=False, path_type=Path)


def tag_file_options(command: Command) -> Command:
    """Adds `--tags`, `--profile` and `--config`."""
    tags = click.option(
        "--tags",
        "tag_file",
        type=_file,
        metavar="FILE",
        help="The tags of this list (YAML or CSV).",
    )
    profile = click.option(
        "--profile", metavar="NAME", help="With --tags: the profile of a configuration FILE."
    )
    config = click.option(
        "--config",
        "config_file",
        type=_file,
        is_eager=True,
        metavar="FILE",
        help="URL is the name of a device in this configuration: its URL, unit id and tags.",
    )
    return tags(profile(config(command)))


def tag_options(command: Command) -> Command:
    """Adds the options of `tag_file_options`, `--only` and `--max-gap`."""
    only = click.option(
        "--only",
        multiple=True,
        metavar="NAME",
        help="Only these tags; * stands for any text. Repeatable.",
    )
    gap = click.option(
        "--max-gap",
        type=click.IntRange(0, LAST_ADDRESS),
        default=0,
        show_default=True,
        metavar="N",
        help="Read gaps of up to N between tags with them.",
    )
    return tag_file_options(only(gap(command)))


def output_options(command: Command) -> Command:
    """Adds `--csv` and `--record`."""
    as_csv = click.option(
        "--csv", "as_csv", is_flag=True, help="Print CSV: the time, and a column for each tag."
    )
    record = click.option(
        "--record",
        type=_file,
        metavar="FILE",
        help="Append every reading to this CSV file.",
    )
    return as_csv(record(command))


def _url(ctx: click.Context, _param: click.Parameter, value: str) -> str:
    """Checks a URL, unless it is the name of a device."""
    return value if ctx.params.get("config_file") else device.checked_url(value)


url_argument = click.argument("url", callback=_url, metavar="URL")


@dataclass(frozen=True)
class TaggedDevice:
    """A device, and the tags that a command uses."""

    url: str
    unit: int
    timeout: float
    tags: TagList


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
        if self.config is not None:
            if self.tags is not None or self.profile is not None:
                raise click.UsageError("--config and --tags can't be used together.")
            return self._configured(url, unit, timeout)
        if self.tags is None:
            raise click.UsageError("--profile requires --tags.")
        return TaggedDevice(url, unit, timeout, tags_of(self.tags, self.profile))

    def _configured(self, name: str, unit: int, timeout: float) -> TaggedDevice:
        assert self.config is not None
        config = load_or_exit(self.config)
        if name not in config.devices:
            known = listing(config.devices) or "none, there are no devices"
            raise click.UsageError(
                f"{self.config} has no device {name!r}, allowed: {known}"
                f"{guess(name, config.devices) or '.'}"
            )
        settings, tags = config.devices[name], config.tags(name)
        if not len(tags):
            raise click.UsageError(f"{self.config}: device {name} has no tags.")
        source = click.get_current_context().get_parameter_source
        return TaggedDevice(
            settings.url,
            settings.unit if source("unit") is ParameterSource.DEFAULT else unit,
            settings.timeout if source("timeout") is ParameterSource.DEFAULT else timeout,
            tags,
        )


def device_of(
    files: TagFiles,
    url: str,
    words: Sequence[str],
    only: Sequence[str],
    typed: tuple[str | None, str, str | None],
    modicon: bool,
    unit: int,
    timeout: float,
) -> TaggedDevice | None:
    """The device and tags of the arguments; `None` if they name one place and no tags.

    `typed` are the values of `--type`, `--order` and `--encoding`.
    """
    kind, order, encoding = typed
    if not files.given and not are_items(words):
        return None
    if kind is not None or order != "ABCD":
        raise click.UsageError("--type and --order can't be used with AREA:ADDRESS and tags.")
    if files.given:
        if encoding is not None:
            raise click.UsageError("--encoding can't be used with tags.")
        if words:
            raise click.UsageError(f"Got unexpected extra argument ({' '.join(words)}).")
        found = files.device(url, unit, timeout)
    else:
        tags = items(words, modicon=modicon, encoding=encoding)
        found = TaggedDevice(url, unit, timeout, tags)
    return replace(found, tags=chosen(found.tags, only))


def require_tags(**options: object) -> None:
    """Refuses options that only tags have, as there are none. Raises `click.UsageError`."""
    for name, value in options.items():
        if value:
            option = name.removeprefix("as_").replace("_", "-")
            raise click.UsageError(f"--{option} requires AREA:ADDRESS or --tags.")


def tags_of(file: Path, profile: str | None) -> TagList:
    """The tags of a list, or of a profile of a configuration; prints problems and exits with 2."""
    if profile is None:
        try:
            return load_tags(file)
        except ConfigError as error:
            show_problems(error)
            raise SystemExit(WRONG) from None
    config = load_or_exit(file)
    if profile not in config.profiles:
        known = listing(config.profiles) or "none, there are no profiles"
        raise click.UsageError(
            f"{file} has no profile {profile!r}, allowed: {known}"
            f"{guess(profile, config.profiles) or '.'}"
        )
    return config.profiles[profile].tag_list


def chosen(tags: TagList, only: Sequence[str]) -> TagList:
    """The tags whose names match one of the patterns of `--only`; all without patterns."""
    names = [tag.name for tag in tags]
    for pattern in only:
        if not any(fnmatchcase(name, pattern) for name in names):
            hint = guess(pattern, names)
            raise click.UsageError(f"No tag has the name {pattern!r}{hint or '.'}")
    if not only:
        return tags
    return TagList(tag for tag in tags if any(fnmatchcase(tag.name, pattern) for pattern in only))


def are_items(words: Sequence[str]) -> bool:
    """Whether arguments are AREA:ADDRESS, and not AREA and ADDRESS."""
    return bool(words) and ":" in words[0]


def items(words: Sequence[str], *, modicon: bool, encoding: str | None) -> TagList:
    """Parses AREA:ADDRESS[:TYPE[:ORDER]]; an array is one tag for each element."""
    found: list[tuple[Tag, str]] = []
    for word in words:
        found += _item(word, modicon, encoding)
        if len(found) > MAX_TAGS:
            raise click.UsageError(f"{word!r}: more than {MAX_TAGS} values.")
    names = Counter(tag.name for tag, _ in found)
    try:
        return TagList(_renamed(tag, full) if names[tag.name] > 1 else tag for tag, full in found)
    except TagError as error:
        raise click.UsageError(f"{error}.") from error


def _item(word: str, modicon: bool, encoding: str | None) -> Iterable[tuple[Tag, str]]:
    """The tags of an argument, and their names with type and order."""
    parts = word.split(":")
    place, left = places.taken(parts, modicon=modicon)
    kind = left.pop(0) if left else ""
    if kind in SIZED and left:
        kind += f":{left.pop(0)}"
    order = left.pop(0).upper() if left else "ABCD"
    if left or word.endswith(":"):
        raise click.UsageError(f"{word!r} is not {FORM}.")
    try:
        whole = _tag(place.area, place.address, kind, order, encoding)
        of = parsed(whole.type)
        if of.count is None:
            return [_named(whole)]
        if of.count > MAX_TAGS:
            raise click.UsageError(f"{word!r}: more than {MAX_TAGS} values.")
        width = whole.count // of.count
        return [
            _named(_tag(place.area, place.address + at * width, of.element, order, encoding))
            for at in range(of.count)
        ]
    except TagError as error:
        raise click.UsageError(f"{word!r}: {error}.") from error


def _tag(area: Area, address: int, kind: str, order: str, encoding: str | None) -> Tag:
    text = encoding if kind.startswith("string") else None
    return Tag(f"{SHORT[area]}:{address}", area, address, kind, order, text)


def _named(tag: Tag) -> tuple[Tag, str]:
    order = "" if tag.order == "ABCD" else f":{tag.order}"
    return tag, f"{tag.name}:{tag.type}{order}"


def _renamed(tag: Tag, name: str) -> Tag:
    return Tag(name, tag.area, tag.address, tag.type, tag.order, tag.encoding)
