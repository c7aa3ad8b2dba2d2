"""Tag lists of requests: names of profiles, or the text of a list; and values to write as text."""

from __future__ import annotations

from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any
from weakref import WeakValueDictionary

from holdfast import values
from holdfast.config import ConfigError
from holdfast.config.tag_files.read import parse_tags
from holdfast.config.tag_files.write import scale_as_data
from holdfast.net.http.fields import Field, malformed
from holdfast.net.http.requests import shown
from holdfast.runtime.own_thread import OwnThread
from holdfast.runtime.suggestion import suggestion
from holdfast.runtime.text import listing
from holdfast.tags.scale import RegisterScale
from holdfast.tags.text import plain, text_of, value_from
from holdfast.types import BIT_AREAS
from holdfast.values.digits import shortest

if TYPE_CHECKING:
    from collections.abc import Mapping

    from holdfast.gateway.endpoint import Answer, Given
    from holdfast.tags import Tag, TagList

MAX_TAGS = 2000
"""The most tags of one list."""
MAX_ITEMS = 20_000
"""The most bits, registers and states of the tags of one list."""
MAX_VALUES = 20_000
"""The most values of a list in YAML, with aliases expanded: each tag copies what an alias names."""
MAX_PROBLEMS = 10
"""The most problems of a tag list that an answer names."""
MAX_TEXT = 65536
SHORT_SIZE = 8192
"""Requests and tag lists up to this size don't wait until longer ones are parsed."""
MAX_PARSED = 16
"""Parsed lists that are kept, because clients send their list with each request. Each takes up to
2 MB."""

TEXT = Field(
    "tags",
    {"type": "string", "minLength": 1, "maxLength": MAX_TEXT, "pattern": r"^[\s\S]*$"},
    "A tag list as text",
    None,
)
FORMAT = Field(
    "format", {"type": "string", "enum": ["yaml", "csv"]}, "The format of `tags`", "yaml"
)
PROFILE = Field(
    "profile",
    {"type": "string", "minLength": 1, "maxLength": 64},
    "In place of `tags`: a profile of the appliance's configuration",
    None,
    allowed="the name of a profile",
)
NAME = Field(
    "name", {"type": "string", "minLength": 1, "maxLength": 128}, "The name of a tag of the list"
)
VALUE = Field(
    "value",
    {"type": "string", "minLength": 0, "maxLength": 1024, "pattern": r"^[\s\S]*$"},
    "The value as text: a number in the unit of the tag, or the name of a state",
)
LIST = (TEXT, FORMAT, PROFILE)

_SHORT, _LONG = OwnThread("holdfast-short-tag-lists"), OwnThread("holdfast-long-tag-lists")
_KNOWN: WeakValueDictionary[tuple[str, bool], TagList] = WeakValueDictionary()
"""The lists in the cache of `_parsed`, which can't be looked into without a call. Requests with one
of them wait for no thread.
"""


async def tags_of(given: Given, profiles: Mapping[str, TagList]) -> TagList:
    """Returns the tag list of a request. Raises `BadRequest`."""
    text, profile = given["tags"], given["profile"]
    if (text is None) == (profile is None):
        raise malformed("one of tags and profile is required")
    if profile is None:
        # Parsing a long list takes a second, in which other requests are answered.
        parser = _LONG if len(text) > SHORT_SIZE else _SHORT
        key = text, given["format"] == "csv"
        tags = _KNOWN.get(key)
        return await parser.call(partial(_parsed, *key)) if tags is None else tags
    if profile not in profiles:
        known = listing(profiles) or "none, the configuration has no profiles"
        hint = suggestion(profile, profiles)
        raise malformed(f"no profile {shown(profile)}, allowed: {known}{hint or ''}")
    return profiles[profile]


@lru_cache(MAX_PARSED)
def _parsed(text: str, is_csv: bool) -> TagList:
    try:
        tags = parse_tags(text, "tags", is_csv=is_csv, max_values=MAX_VALUES)
    except ConfigError as error:
        problems = [str(each) for each in error.problems[:MAX_PROBLEMS]]
        more = len(error.problems) - len(problems)
        raise malformed("\n".join([*problems, *([f"and {more} more"] if more else [])])) from None
    if len(tags) > MAX_TAGS:
        raise malformed(f"tags: found {len(tags)} tags, allowed: up to {MAX_TAGS}")
    items = sum(tag.count + len(tag.states) for tag in tags)
    if items > MAX_ITEMS:
        found = f"{items} bits, registers and states"
        raise malformed(f"tags: found {found}, allowed: up to {MAX_ITEMS}")
    _KNOWN[text, is_csv] = tags
    return tags


def described(tag: Tag) -> dict[str, Any]:
    """Returns a tag for JSON."""
    return {
        "name": tag.name,
        "area": tag.area,
        "address": tag.address,
        "count": tag.count,
        "type": tag.type,
        "order": tag.order,
        "unit": tag.unit,
        "scale": scale_as_data(tag.scale) if isinstance(tag.scale, RegisterScale) else tag.scale,
        "offset": tag.offset,
        "writable": tag.writable,
        "min": tag.min,
        "max": tag.max,
        "minText": _limit(tag.min),
        "maxText": _limit(tag.max),
        "states": {str(value): name for value, name in tag.states.items()},
        "description": tag.description,
    }


def _limit(value: float | None) -> str:
    """A limit as text, because a browser has not all digits of 64 bits; empty for none."""
    if isinstance(value, float):
        return shortest(value, "")
    return "" if value is None else str(value)


async def parse(given: Given, profiles: Mapping[str, TagList]) -> Answer:
    """Answers with the tags of a list. Raises `BadRequest`."""
    tags = await tags_of(given, profiles)
    return {"success": True, "tags": [described(tag) for tag in tags]}


async def encode(given: Given, profiles: Mapping[str, TagList]) -> Answer:
    """Answers with what a write of a tag sends; nothing is sent. Raises `BadRequest`."""
    tags = await tags_of(given, profiles)
    name, text = given["name"], given["value"]
    if name not in tags:
        raise malformed(
            f"the list has no tag {shown(name)}{suggestion(name, [t.name for t in tags])}"
        )
    tag = tags[name]
    if not tag.writable:
        reason = tag.unwritable or "writable is not true in the tag list"
        raise malformed(f"{name} can't be written: {reason}")
    try:
        raw = tag.raw(value_from(tag, text))
        return {"success": True, "tag": described(tag), **_written(tag, raw)}
    except ValueError as error:
        raise malformed(f"{name}: {error}") from None


def _written(tag: Tag, raw: Any) -> Answer:
    """Returns the registers, bits or masks that hold a value, and the value as it is then read.

    Raises `ValueError` for what does not fit the type.
    """
    of = tag.of_type
    if tag.area in BIT_AREAS:
        codec = values.codec_for(tag.area, tag.type, tag.order, tag.encoding)
        bits = [bool(each) for each in codec.encode(raw)]
        value = tag.value(bits if of.count is not None else bits[0])
        return {"form": "coils", "values": bits, **_shown(tag, value)}
    if of.base == "bit":
        mask = 1 << _wire_bit(tag)
        sent = [0xFFFF ^ mask, mask if raw else 0]
        return {"form": "mask", "values": sent, **_shown(tag, tag.value(bool(raw)))}
    registers = values.encode(raw, tag.type, tag.order, encoding=tag.encoding)
    back = values.decode(registers, tag.type, tag.order, encoding=tag.encoding)
    return {"form": "registers", "values": registers, **_shown(tag, tag.value(back))}


def _wire_bit(tag: Tag) -> int:
    """Returns the number of a bit in the register as it is transmitted."""
    found = [bit for bit in range(16) if values.decode([1 << bit], tag.type, tag.order) is True]
    return found[0]


def _shown(tag: Tag, value: Any) -> dict[str, Any]:
    return {"value": plain(tag, value), "text": text_of(tag, value)}
