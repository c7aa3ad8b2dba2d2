"""Adapters connect memories to other protocols. Each is written in Python and supervised alone.

A factory, `factory(context) -> Adapter`, creates an adapter. `run` runs in a thread of its own
until it is stopped. When an adapter raises an exception or returns, the supervisor logs it, waits,
and creates a new one; other adapters are not affected. Adapters must use memory only through their
`MemoryAccess`.

`rest`, `mqtt`, `nats`, `gateway` and `metrics` are built in. Other packages provide adapters with
the entry point group `holdfast.adapters`, see docs/adapters.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

from holdfast.runtime.heartbeat import Heartbeat
from holdfast.runtime.lazy_names import imported_on_use
from holdfast.runtime.stop import Stop

if TYPE_CHECKING:
    from collections.abc import Mapping

    from holdfast.ingest import Counts, Grant, MemoryAccess, Refused, Written
else:
    _INGEST = ("Counts", "Grant", "MemoryAccess", "Refused", "Written")
    __getattr__ = imported_on_use(__name__, dict.fromkeys(_INGEST, "holdfast.ingest"))

__all__ = [
    "Adapter",
    "Context",
    "Counts",
    "Grant",
    "Heartbeat",
    "MemoryAccess",
    "Refused",
    "Stop",
    "Written",
]

ENTRY_POINTS = "holdfast.adapters"


class Adapter(Protocol):
    """The interface of an adapter.

    An adapter with an event loop, or another loop of its own, can have an attribute `heartbeat`, a
    `Heartbeat` on which the loop calls `beat` once a second. If it does not for 10 seconds, the
    adapter is logged as stalled, and the watchdog of the service manager is not fed any more.
    """

    def run(self, stop: Stop) -> None:
        """Runs until `stop` is set. Called once, in a thread of its own."""

    def status(self) -> Mapping[str, object]:
        """Returns plain data for diagnostics, without secrets. Called from any thread."""


@dataclass(frozen=True)
class Context:
    """The arguments of an adapter's factory."""

    name: str
    """The adapter's name in the configuration."""
    memory_access: MemoryAccess
    """Reads and writes memories."""
    grant: Grant
    """The permissions that the configuration grants."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """The adapter's own options in the configuration."""
