"""Adapters: ways into memory in Python, each supervised for itself.

An adapter is made by a factory, `factory(context) -> Adapter`, and lives in a thread of its own:
`run` works until it is stopped. When it raises, or ends by itself, it is logged and made anew after
a pause; the others don't notice. Adapters must never reach past their door to memory.

`rest`, `mqtt`, `nats`, `gateway` and `metrics` are built in. Others are found by the entry point
group `holdfast.adapters`, see docs/adapters.md.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

from holdfast.ingest import Counts, Grant, MemoryAccess, Refused, Written
from holdfast.stop import Stop

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["Adapter", "Context", "Counts", "Grant", "MemoryAccess", "Refused", "Stop", "Written"]

ENTRY_POINTS = "holdfast.adapters"


class Adapter(Protocol):
    """What the appliance runs."""

    def run(self, stop: Stop) -> None:
        """Works until `stop`. Called once, in a thread of its own."""

    def status(self) -> Mapping[str, object]:
        """What diagnostics show of it, from any thread: plain data, nothing secret."""


@dataclass(frozen=True)
class Context:
    """What an adapter is given."""

    name: str
    """Its name in the configuration."""
    memory_access: MemoryAccess
    """Its way to memory."""
    grant: Grant
    """What the configuration lets it do."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Its own part of the configuration."""

    @property
    def door(self) -> MemoryAccess:
        """The former name of `memory_access`. Deprecated: it goes with the next release."""
        warnings.warn(
            "Context.door is now Context.memory_access; the old name goes with the next release",
            DeprecationWarning,
            stacklevel=2,
        )
        return self.memory_access
