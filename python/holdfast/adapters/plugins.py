"""Adapters of other packages, found by their entry points."""

from __future__ import annotations

from typing import TYPE_CHECKING

from holdfast import ingest
from holdfast.adapters import ENTRY_POINTS, Context
from holdfast.runtime.interpreter import complete_hashlib

if TYPE_CHECKING:
    from collections.abc import Callable
    from importlib.metadata import EntryPoint

    from holdfast.adapters import Adapter, MemoryAccess
    from holdfast.config.models.services import AdapterConfig


class UnknownAdapter(ValueError):
    """The configuration names an adapter that is not installed."""


def entry_point(name: str, settings: AdapterConfig) -> EntryPoint:
    """Returns the adapter's entry point without loading its code.

    Raises `UnknownAdapter` when no installed package provides the type.
    """
    from importlib.metadata import entry_points

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
    """Returns the adapter's factory.

    The factory loads the adapter's code, so an error in that code only stops this adapter.
    Raises `UnknownAdapter` as `entry_point` does.
    """
    found = entry_point(name, settings)
    grant = ingest.Grant(name, settings.memories, settings.areas, settings.access == "read-write")
    context = Context(name, memory_access, grant, settings.options)

    def make() -> Adapter:
        complete_hashlib()
        adapter: Adapter = found.load()(context)
        return adapter

    return make
