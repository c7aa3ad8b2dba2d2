"""Clients of Modbus devices, over every transport: `Client` for asyncio, `SyncClient` without it.

Both have the same methods, carry out the same steps (`requests`) and know the same errors
(`holdfast.errors`). This room must never poll.

A connection is made when it is needed, and kept. When it is lost, the calls that waited fail, and
the next one makes a new connection; no call is repeated.
"""

from __future__ import annotations

from holdfast.client.async_client import Client
from holdfast.client.sync_client import SyncClient

__all__ = ["Client", "SyncClient"]
