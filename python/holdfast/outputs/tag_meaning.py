"""What values of a tag mean, to recognise values that were read before the tag was changed."""

from __future__ import annotations

from typing import TYPE_CHECKING
from zlib import crc32

if TYPE_CHECKING:
    from holdfast.tags import Tag


def meaning_of(tag: Tag) -> int:
    """A checksum of all that values of a tag need to be shown; equal in each run."""
    states = sorted(tag.states.items())
    return crc32(f"{tag.type} {tag.scale} {tag.offset} {tag.unit} {states}".encode())
