"""The interface of the diagnostics that adapters show. The appliance implements it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from holdfast.polling import Reading

HEALTH = ("unknown", "ok", "error", "stale", "disabled", "standby")
"""How a device can be."""


class DiagnosticsSource(Protocol):
    """Snapshots of counters and states. Thread-safe; plain data without secrets."""

    def memories(self) -> dict[str, Any]:
        """Returns, for each memory, the start and size of its areas and the state of its seal."""

    def stats(self) -> dict[str, Any]:
        """Returns all counters since the start."""

    def tag_values(self) -> list[tuple[Reading, float]]:
        """Returns the last reading of each tag, and its age in seconds."""

    def adapter(self, name: str) -> dict[str, Any] | None:
        """Returns the state and the counters of one adapter; `None` if it does not exist."""
