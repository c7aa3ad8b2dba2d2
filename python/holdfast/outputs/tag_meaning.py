"""What values of a tag mean, to recognise values that were read before the tag was changed."""

from __future__ import annotations

import json
from zlib import crc32

from holdfast.tags import Tag
from holdfast.tags.scale import RegisterScale


def meaning_of(tag: Tag) -> int:
    """A checksum of all that values of a tag need to be shown; equal in each run."""
    states = sorted(tag.states.items())
    return crc32(f"{tag.type} {tag.scale} {tag.offset} {tag.unit} {states}".encode())


def definition_text(tag: Tag) -> str:
    """What values of a tag need to be shown, and its area, as text for `tag_from`."""
    scale: object = tag.scale
    if isinstance(scale, RegisterScale):
        scale = scale.form, scale.name or scale.where
    return json.dumps((tag.area, tag.type, scale, tag.offset, tag.unit, [*tag.states.items()]))


def tag_from(name: str, text: str | bytes) -> Tag:
    """A tag with a definition as `definition_text` returns it, for values that were read."""
    area, type, scale, offset, unit, states = json.loads(text)
    if isinstance(scale, list):
        scale = RegisterScale(*scale)
    return Tag(name, area, 0, type, scale=scale, offset=offset, unit=unit, states=dict(states))
