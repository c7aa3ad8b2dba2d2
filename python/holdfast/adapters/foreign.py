"""Adapters of others, found by their entry points."""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import TYPE_CHECKING

from holdfast.adapters import ENTRY_POINTS, Context, Grant

if TYPE_CHECKING:
    from collections.abc import Callable
    from importlib.metadata import EntryPoint

    from holdfast.adapters import Adapter, MemoryAccess
    from holdfast.config import AdapterConfig


class UnknownAdapter(ValueError):
    """An adapter of the configuration that is not installed."""


def entry_point(name: str, settings: AdapterConfig) -> EntryPoint:
    """Where the adapter's code is, which is not loaded yet.

    Raises `UnknownAdapter` when no installed package has an entry point of that type.
    """
    known = entry_points(group=ENTRY_POINTS)
    for entry in known:
        if entry.name == settings.type:
            return entry
    installed = ", ".join(sorted(known.names)) or "none"
    message = f"adapters.{name}.type: found {settings.type!r}, installed: {installed}"
    raise UnknownAdapter(message)


def factory(
    name: str, settings: AdapterConfig, memory_access: MemoryAccess
) -> Callable[[], Adapter]:
    """What makes the adapter. Its code is loaded when it is made: a fault of it is its own.

    Raises `UnknownAdapter`, as `entry_point`.
    """
    found = entry_point(name, settings)
    grant = Grant(name, settings.memories, settings.areas, settings.access == "read-write")
    context = Context(name, memory_access, grant, settings.options)

    def make() -> Adapter:
        adapter: Adapter = found.load()(context)
        return adapter

    return make
