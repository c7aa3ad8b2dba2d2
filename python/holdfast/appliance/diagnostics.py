"""The diagnostics of a running appliance, for REST, metrics and logs."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from holdfast.events import log_lines

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from holdfast._core import Memory
    from holdfast.appliance.liveness import Liveness
    from holdfast.appliance.parts.part import Part
    from holdfast.appliance.services.supervision import Supervisor
    from holdfast.polling import Reading


@dataclass(eq=False)
class Diagnostics:
    """Reads counters and states of a running appliance. Thread-safe; changes nothing."""

    _memories: Mapping[str, Memory]
    _liveness: Liveness
    _parts: Sequence[Part]
    adapters: dict[str, Supervisor]
    tag_values: Callable[[], list[tuple[Reading, float]]]
    """Returns the last reading of each tag of the configured devices, and its age in seconds."""
    _began: float = field(default_factory=time.monotonic)
    _reload: dict[str, Any] = field(
        default_factory=lambda: {"failed": False, "succeeded_at": time.time()}
    )
    """The result of the last reload. The start counts as one."""

    def note_reload(self, *, is_done: bool) -> None:
        """Notes the result of a reload."""
        succeeded_at = time.time() if is_done else self._reload["succeeded_at"]
        self._reload = {"failed": not is_done, "succeeded_at": succeeded_at}

    def memories(self) -> dict[str, Any]:
        """Returns, for each memory, the start and size of its areas and the state of its seal."""
        return {
            name: {
                "areas": {
                    area: {"start": addresses.start, "size": len(addresses)}
                    for area, addresses in memory.areas.items()
                },
                "sealed": memory.sealed,
                "opened": memory.seal_changes[0],
                "closed": memory.seal_changes[1],
            }
            for name, memory in self._memories.items()
        }

    def stats(self) -> dict[str, Any]:
        """Returns all counters: those of the parts, of adapters, threads, and the log."""
        # A reload may have removed one since the list was made.
        adapters = [(name, self.adapter(name)) for name in list(self.adapters)]
        found = {
            "uptime": round(time.monotonic() - self._began, 3),
            "adapters": {name: status for name, status in adapters if status is not None},
            "log_dropped": log_lines.dropped(),
            "reload": self._reload,
            "threads": self._liveness.threads(),
        }
        for part in self._parts:
            found |= part.stats()
        return found

    def adapter(self, name: str) -> dict[str, Any] | None:
        """Returns the state and the counters of one adapter; `None` if it does not exist."""
        supervisor = self.adapters.get(name)
        return None if supervisor is None else supervisor.status()
