"""Tags: names, types and units for the bits and registers of a device. Does no I/O.

A `TagList` is the same for everything that shows, publishes or writes values: the command line, the
console, the scanner, outputs and `holdfast.Poller`.
"""

from __future__ import annotations

from holdfast.tags.base import TagError
from holdfast.tags.tag import Tag, TagList

__all__ = ["Tag", "TagError", "TagList"]
