"""The event loops that Holdfast is measured in."""

from __future__ import annotations

import asyncio
import sys
from typing import Any


def use(name: str) -> None:
    """Makes this process use asyncio's own event loop, or uvloop. Call it before other imports."""
    modules: Any = sys.modules
    if name == "uvloop":  # HTTP hosts choose it themselves, but not those of older checkouts.
        import uvloop

        asyncio.set_event_loop_policy(uvloop.EventLoopPolicy())
    else:  # As if uvloop was not installed.
        modules["uvloop"] = None
