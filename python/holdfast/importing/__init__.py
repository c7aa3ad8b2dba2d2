"""Configurations of other programs, made into ours.

`read_mma` is the way in. What can't be carried over is told in a `Note`, never left out in silence.
This room must never start anything, and no secret that it reads may leave it but as a hash.
"""

from __future__ import annotations

from holdfast.importing.mma import ORDINALS, Imported, NotImportable, read_mma
from holdfast.importing.notes import Kind, Note

__all__ = ["ORDINALS", "Imported", "Kind", "NotImportable", "Note", "read_mma"]
