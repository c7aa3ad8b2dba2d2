"""Converts configurations of other programs to Holdfast configurations.

Call `read_mma`. A `Note` reports every setting that can't be converted; nothing is dropped
silently. This package never starts anything, and secrets leave it only as hashes.
"""

from __future__ import annotations

from holdfast.importing.mma import ORDINALS, Imported, NotImportable, read_mma
from holdfast.importing.notes import Kind, Note

__all__ = ["ORDINALS", "Imported", "Kind", "NotImportable", "Note", "read_mma"]
