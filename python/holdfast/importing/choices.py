"""What the caller of an import chooses where the source did something else than it was meant to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from holdfast.config.source import KeyPath
    from holdfast.importing.notes import Desk
    from holdfast.types import Area


@dataclass(frozen=True)
class Choices:
    """How keys that the source ignored are converted, and what is granted beyond what it did."""

    as_meant: bool = False
    keep_published_tokens: bool = False
    grant_rest: Sequence[Area] = ()
    """Areas that REST may write, in addition to those that it could."""
    grant_mqtt: Sequence[Area] = ()
    """The same for MQTT."""

    def note(self, desk: Desk, path: KeyPath, *, ran: str, meant: str) -> None:
        """Adds a note about a key with two meanings, which says the one that is used."""
        used, other = ("it was meant", "it ran") if self.as_meant else ("it ran", "it was meant")
        told, rest = (meant, ran) if self.as_meant else (ran, meant)
        message = f"as {used}: {told}; as {other}: {rest} (--as-{other.replace(' ', '-')})"
        desk.note("changed" if self.as_meant else "left out", path, message)
