"""What adapters show of a running appliance. Whoever runs them provides it."""

from __future__ import annotations

from typing import Any, Protocol


class DiagnosticsSource(Protocol):
    """Snapshots of counters and states, from any thread: plain data, nothing secret."""

    def memories(self) -> dict[str, Any]:
        """Each memory: its areas with start and size, sealed or not, how often it opened."""

    def stats(self) -> dict[str, Any]:
        """Every counter, since the start."""

    def adapter(self, name: str) -> dict[str, Any] | None:
        """How one adapter does, and what came in by it; `None` when there is none."""
