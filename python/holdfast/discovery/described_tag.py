"""A tag of a description, and how sure it is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from holdfast.tags import Tag


@dataclass(frozen=True)
class DescribedTag:
    """A tag, and how sure it is."""

    tag: Tag
    confidence: float
    """The probability of type and order; 1 if they are known."""
    values: tuple[Any, ...]
    """The numbers, bits or texts of each read, without scale."""
    reasons: tuple[str, ...]
    shown: Tag | None = None
    """The tag with the scale that its register contained; `None` if no register does."""
