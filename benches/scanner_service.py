"""Runs the scanner under test, with the NATS server in the first argument.

With a second argument, it is the only node of the fleet of that name.
"""

from __future__ import annotations

import asyncio
import resource
import sys

from holdfast.net.nats.connection import Servers
from holdfast.scanner.service import Scanner
from holdfast.scanner.settings import FleetSettings, Settings

hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


async def main() -> None:
    """Serves until it is killed."""
    fleet = FleetSettings(sys.argv[2], "only") if len(sys.argv) > 2 else None
    scanner = Scanner(Settings(Servers((f"nats://{sys.argv[1]}",)), fleet=fleet))
    running = asyncio.create_task(scanner.run())
    while not scanner.serves:
        await asyncio.sleep(0.01)
    print("listening -", flush=True)
    await running


asyncio.run(main())
